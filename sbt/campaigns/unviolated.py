"""Requirements that no run violated, beside those that make runs critical: what an estimate has of them, what they may hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sbt.campaigns.gate import Limits
from sbt.campaigns.settings import Settings
from sbt.campaigns.wording import number
from sbt.problem.combination import CombinedRequirement
from sbt.problem.requirement import Requirement
from sbt.store.history import History

__all__ = ["Unviolated"]

Bound = Callable[[float], float]
"""Upper limit of a probability: a function of the confidence."""


@dataclass(frozen=True)
class Unviolated:
    """Requirements of a combination that no run violated, though another one, which is enough, was violated.

    Attributes:
        names: of them.
        untold: of those of which the metric had one value in all runs, so that no metamodel tells where they are violated.
    """

    names: tuple[str, ...] = ()
    untold: tuple[str, ...] = ()

    @classmethod
    def of(cls, history: History, settings: Settings) -> Unviolated:
        """Return those of a campaign; one that knows another setup's, or earlier runs, is told by these where metrics differ."""
        found = _unviolated(settings.scenario.requirement, history)
        known = [history] if settings.prior_runs is None else [history, settings.prior_runs]
        told = settings.transfer is not None
        untold = [item for item in found if not told and any(_of_one_value(part, known) for part in item.parts)]
        return cls(tuple(item.label for item in found), tuple(item.label for item in untold))

    def reached(self, limits: Limits, alone: Bound, whole: Bound) -> Limits:
        """Return limits that have what draws leave to requirements that nothing else is known of.

        Args:
            limits: of the probability of a critical run, by the estimate.
            alone: the most that none of these draws may have met.
            whole: the most that may be critical, by these draws alone.
        """
        if not self.untold:
            return limits
        return limits.reaching(lambda c: min(whole(c), limits.upper(c) + alone(c)))

    def sentences(self, draws: str, most: float) -> tuple[str, ...]:
        """Return what the interval has of them, in words; so many draws leave them that probability at most."""
        said = []
        if self.untold:
            names, value = " and ".join(self.untold), f"metric{'' if len(self.untold) == 1 else 's'} had one value or none"
            leave = f"the upper end has what {draws} leave to it, {number(most, 2)} at most"
            said.append(f"no run violated {names}, whose {value} in all runs: {leave}")
        rest = [name for name in self.names if name not in self.untold]
        if rest:
            expected = f"the interval has of it what its metamodel expects; {draws} leave it {number(most, 2)} at most"
            said.append(f"no run violated {' and '.join(rest)}: {expected}")
        return tuple(said)


def _unviolated(requirement: Requirement, history: History) -> list[Requirement]:
    """Return the largest parts of a requirement that no run violated: itself where none violated it."""
    if not requirement.critical_runs(history).any():
        return [requirement]
    items = requirement.items if isinstance(requirement, CombinedRequirement) else ()
    return [found for item in items for found in _unviolated(item, history)]


def _of_one_value(part: Requirement, histories: list[History]) -> bool:
    """Return whether the metric of a requirement that no run violated had one value, if any, in all runs."""
    values = np.concatenate([part.values(history)[history.ok] for history in histories])
    values = values[~np.isnan(values)]
    return not part.critical.contains(values).any() and bool((values == values[:1]).all())

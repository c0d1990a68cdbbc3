"""What runs that fail leave open: which part of the space gives no metric, and how much of the rest is critical."""

from __future__ import annotations

import numpy as np

from sbt.campaigns.sides import met
from sbt.campaigns.wording import percent
from sbt.loop.learner import FittedMetamodel, Learner
from sbt.loop.stages import Facts
from sbt.metamodels.success import Success
from sbt.problem.arrays import Vector

__all__ = ["by_chance", "failing_range", "failing_words", "open_range"]

Ends = tuple[float, float]
"""The least and the largest share."""
_MATTERS = 0.2  # of the share, by which its ends must differ to be told
_LIKELY = 0.5  # log evidence that inputs decide which runs fail, below which chance is the better account


def open_range(learner: Learner, fitted: FittedMetamodel, met: int) -> Ends | None:
    """Return the least and the largest critical share of what gives a metric; None where no run fails, or it hardly matters.

    Least: where it is open whether a run gives a metric, what is critical fails and the rest does not; largest: the other way
    round. Where runs fail by chance nothing is open: their mean is what counts. Where none of the runs was critical (`met`, how
    many are), none may be.
    """
    success, u = fitted.log_success, learner.probe
    if not isinstance(success, Success) or success.gain < _LIKELY:
        return None
    p = fitted.predict(u).probability(learner.scenario.requirement.critical)
    (rarely, often), ok = success.ends(u), np.exp(success(u))

    def share(critical: Vector, safe: Vector) -> float:
        inside = float((p * critical).sum())
        return inside / max(inside + float(((1.0 - p) * safe).sum()), 1e-300)

    least, most = share(rarely, often) if met else 0.0, share(often, rarely)
    return (least, most) if most - least > _MATTERS * max(share(ok, ok), 1e-12) and most > 1e-3 else None


def failing_range(learner: Learner, fitted: FittedMetamodel, runs: int) -> Ends | None:
    """Return the least and the largest share of the space that gives no metric; None where none is known to.

    No end is closer to the share than what one of the runs stands for: a sharp edge lies anywhere between two of them.
    """
    success, share = fitted.log_success, fitted.record.failing_fraction
    if not isinstance(success, Success) or not success.shown or share is None:
        return None
    (rarely, often), one = success.ends(learner.probe), 1.0 / max(runs, 1)
    return max(min(float(1.0 - often.mean()), share - one), 0.0), min(max(float(1.0 - rarely.mean()), share + one), 1.0)


def by_chance(fitted: FittedMetamodel) -> bool | None:
    """Return whether nothing says that inputs decide which runs fail; None where it is suggested, not asked, or none fails."""
    success = fitted.log_success
    if not isinstance(success, Success):
        return None
    return False if success.shown else None if success.gain >= _LIKELY else True


def failing_words(share: float | None, chance: bool | None, failing: Ends | None, open_: Ends | None, facts: Facts) -> list[str]:
    """Return how much of the space, or how many runs, give no metric, and what that leaves open of the critical share.

    Args:
        share: that gives no metric; None: all do.
        chance: of `by_chance`.
        failing: of `failing_range`.
        open_: of `open_range`.
        facts: of the campaign.
    """
    found = []
    if share is not None and chance:
        found.append(f"About {percent(share)} of all runs give no metric, and nothing shows that the inputs decide which.")
    elif share is not None and chance is None:
        found.append(f"About {percent(share)} of runs give no metric; they suggest, but do not show, that inputs decide which.")
    elif share is not None:
        ends = "" if failing is None else f" ({' to '.join(map(percent, failing))})"
        found.append(f"About {percent(share)}{ends} of the parameter space gives no metric: runs there fail.")
    if open_ is not None:
        least, most = map(percent, open_)
        beside, between = "critical runs lie beside it", f"between {least} and {most}"
        if not met(facts):
            beside, between = "the metamodel expects critical runs there, though none was met", f"at most {most}"
        lead = "Where failing begins is not known sharply, and"
        said = f"{lead} {beside}" if chance is False else "Should inputs decide it after all"
        found.append(f"{said}: of what gives a metric {between} may be critical.")
    return found

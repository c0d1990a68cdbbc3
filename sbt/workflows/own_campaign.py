"""A campaign of somebody's own, checked: what it proposes are runs of the scenario, and errors say whose they are."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sbt.campaigns.records import CONFIRM
from sbt.campaigns.settings import Settings
from sbt.errors import InputError, must_be, naming
from sbt.loop.running import ahead_of
from sbt.loop.stages import Batch, Campaign, Log, Stage
from sbt.problem.space import ParameterSpace
from sbt.store.database import PlannedPoints, PlannedRun

__all__ = ["checked"]

_ROOM = 1e-9
"""Relative to the larger end of a range, by which rounding may take a value beyond it."""


def checked(recipe: Callable[[Settings], object], settings: Settings) -> Campaign:
    """Return the campaign of a user's recipe, whose stages and conclusion are checked.

    Raises:
        InputError: the recipe returned something else.
        SbtError: it raised.
    """
    rule = "a campaign's recipe must return a Campaign"
    with naming(rule):
        campaign = recipe(settings)
    if not isinstance(campaign, Campaign):
        raise InputError(f"{rule}, but returned {campaign!r}")
    return Campaign(tuple(_Checked(stage, settings) for stage in campaign.stages), _concluding(campaign.conclude))


@dataclass(frozen=True)
class _Checked:
    """A stage of which every batch is checked."""

    stage: Stage
    settings: Settings

    @property
    def space(self) -> ParameterSpace:
        """Of the scenario."""
        return self.settings.scenario.space

    @property
    def name(self) -> str:
        """That of the stage."""
        return self.stage.name

    @property
    def ahead(self) -> int:
        """Number of batches in flight that a proposal does not wait for."""
        return ahead_of(self.stage)

    def stop(self, log: Log) -> str | None:
        """Return why the stage is over, or None."""
        rule = f"stage {self.name}: stop must return why it is over, as text, or None"
        with naming(rule):
            reason = self.stage.stop(log)
        must_be(rule, reason, str, type(None))
        return reason

    def propose(self, log: Log) -> Batch:
        """Return the next batch."""
        rule = f"stage {self.name}: propose must return a Batch"
        with naming(rule):
            batch = self.stage.propose(log)
        must_be(rule, batch, Batch)
        if not isinstance(batch.runs, PlannedPoints):
            batch = replace(batch, runs=tuple(self._checked(run) for run in batch.runs))
        self._check_budget(batch.runs, log)
        return batch

    def _check_budget(self, runs: Sequence[PlannedRun], log: Log) -> None:
        """Refuse runs beyond the budget: those of the stage `confirm` come beside it, coarse ones and `reference` ones, too."""
        s, spent = self.settings, int((log.planned.stage != CONFIRM).sum())
        of_design = isinstance(runs, PlannedPoints) and runs.stage != CONFIRM
        more = len(runs) if of_design else sum(run.stage != CONFIRM and not run.level for run in runs)
        if more and spent + more > s.budget + s.reference:
            rule = f"stage {self.name} must stop within the budget of {s.budget:,} runs"
            raise InputError(f"{rule}, but proposed {more:,} after {spent:,}")

    def _checked(self, run: PlannedRun) -> PlannedRun:
        """Return a run with the inputs of the scenario, each a number in its range or one of its choices."""
        rule = f"stage {self.name} must propose runs of the scenario's inputs ({', '.join(self.space.names)})"
        try:
            values = dict(run.inputs)
        except (AttributeError, TypeError, ValueError):
            raise InputError(f"{rule}, but proposed {run!r}") from None
        if set(values) != set(self.space.names):
            raise InputError(f"{rule}, but proposed {', '.join(map(str, values)) or 'none'}")
        for parameter in self.space.parameters:
            given = values[parameter.name]
            number = parameter.number(given)
            room = _ROOM * max(abs(end) for end in parameter.bounds)
            if not (parameter.choices or parameter.low - room <= number <= parameter.high + room):
                raise InputError(f"{rule}, {parameter.name} in {parameter.range}, but proposed {given!r}")
        return replace(run, inputs={name: v.item() if isinstance(v, np.generic) else v for name, v in values.items()})


def _concluding(conclude: Callable[[Log], Any]) -> Callable[[Log], Any]:
    def concluded(log: Log) -> Any:
        rule = "conclude must return a conclusion with to_dict() and sentences(facts), and the fitted metamodel or None"
        with naming(rule):
            found = conclude(log)
        if not isinstance(found, tuple) or len(found) != 2:
            raise InputError(f"{rule}, but returned {found!r}")
        if not all(hasattr(found[0], name) for name in ("to_dict", "sentences")):
            raise InputError(f"{rule}, but returned the conclusion {found[0]!r}")
        rule = "to_dict() of a conclusion must return plain values by name (text, finite numbers, true, false, None, lists)"
        with naming(rule):
            told = found[0].to_dict()
        must_be(rule, told, dict)
        wrong = next(_not_plain(told), None)
        if wrong is not None:
            raise InputError(f"{rule}, but {wrong[0]} is {wrong[1]!r} ({type(wrong[1]).__name__})")
        return found

    return concluded


def _not_plain(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the places of what JSON cannot hold, and what is there."""
    if isinstance(value, dict):
        for key, each in value.items():
            yield from _not_plain(each, f"{place}.{key}".lstrip(".")) if isinstance(key, str) else [(f"a key of {place}", key)]
    elif isinstance(value, list | tuple):
        for k, each in enumerate(value):
            yield from _not_plain(each, f"{place}[{k}]")
    elif not (value is None or isinstance(value, str | int) or (isinstance(value, float) and math.isfinite(value))):
        yield place, value

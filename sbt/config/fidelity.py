"""The coarse level of a configured scenario, and whether its model takes it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from sbt.config.fidelity_model import FidelityChoice
from sbt.config.model import Configuration
from sbt.errors import InputError
from sbt.execution.spec import CoarseLevel, ScenarioSpec
from sbt.problem.scenario import Configurable, LogicalScenario

__all__ = ["check_levels", "coarse_level"]


def coarse_level(config: Configuration, folder: Path) -> CoarseLevel | None:
    """Return the coarse level that is configured, which measures what is required alone; files are absolute."""
    choice, required = config.fidelity, config.requirement
    if choice is None:
        return None
    own = required.metric or ("stl" if required.stl is not None else None)
    metrics = None if required.combined is not None else () if own is None else (own,)
    if choice.scenario is None:
        return CoarseLevel(choice.coarse, metrics=metrics)
    is_file = ".py:" in choice.scenario or choice.scenario.endswith((".yaml", ".yml"))
    name = str(folder.resolve() / Path(choice.scenario).expanduser()) if is_file else choice.scenario
    return CoarseLevel(None, name, metrics)


def check_levels(choice: FidelityChoice, spec: ScenarioSpec, scenario: LogicalScenario) -> None:
    """Refuse a coarse level that is none of this scenario.

    Raises:
        InputError: the scenario has no step, has another one, a coarse step is beyond what its model takes, or a coarser
            scenario has other inputs, metrics or warm-ups.
    """
    if choice.fine is not None and choice.coarse is not None:
        _check_steps(choice.fine, choice.coarse, scenario)
    coarse = spec.at_level(1).resolve()
    missing = [name for name in scenario.space.names if name not in coarse.space.names]
    surplus = [name for name in coarse.space.names if name not in scenario.space.names]
    if missing or surplus:
        names = ", ".join(missing or surplus)
        raise InputError(f"a coarser scenario must have the inputs of the scenario, but {names} {_is(missing, coarse.name)}")
    absent = [part.metric for part in scenario.requirement.parts if part.metric not in coarse.measured]
    if absent:
        rule = f"a coarser scenario must measure {', '.join(absent)}"
        raise InputError(f"{rule}, but {coarse.name} gives {', '.join(coarse.measured)}")
    _check_warm_up(coarse, scenario)


def _check_warm_up(coarse: LogicalScenario, scenario: LogicalScenario) -> None:
    """Refuse a coarser scenario that asks for warm-ups of its own: both runs of a pair begin with the warm-up of one number."""
    own, other = (getattr(each.simulate, "warm", None) for each in (scenario, coarse))
    if other is None or (own is not None and own.until == other.until and other.seeds in (None, own.seeds)):
        return
    rule = "a coarser scenario begins with the warm-ups of the scenario: its warm_up must be left out, or be that of the scenario"
    raise InputError(f"{rule}, which has {_warm_up(own)}, but {coarse.name} asks for {_warm_up(other)}")


def _warm_up(asked: Any) -> str:
    """Return in words what is asked for."""
    if asked is None:
        return "none"
    until = "until: auto" if asked.until is None else f"until: {asked.until:g}"
    return until if asked.seeds is None else f"{until}, seeds: {asked.seeds}"


def _is(missing: list[str], name: str) -> str:
    return f"of the finer one is none of {name}" if missing else f"of {name} is none of the finer one"


def _check_steps(fine: float, coarse: float, scenario: LogicalScenario) -> None:
    """Refuse steps of a scenario without any, another fine step, or a coarse one that its model does not take."""
    simulate = scenario.simulate
    own = simulate.step_length if isinstance(simulate, Configurable) else 0.0
    if own == 0.0 or math.isnan(own):
        why = "its loop decides it" if math.isnan(own) else "it has none"
        rule = f"fidelity.step_length needs a scenario whose step SUMO is given, but of {scenario.name} {why}"
        raise InputError(f"{rule}; a coarser scenario of one's own (fidelity.scenario) needs no step")
    if abs(own - fine) > 1e-9:
        raise InputError(f"the smaller of fidelity.step_length must be the scenario's own step, {own:g} s, but got {fine:g} s")
    for told, period in getattr(simulate, "periods", ()):
        rule = "the coarse step must divide a warm-up and every time in which a driver acts"
        if math.isnan(period):
            raise InputError(f"{rule}, but {told} depends on an input")
        if round(period / coarse) < 1 or abs(period / coarse - round(period / coarse)) > 1e-9:
            raise InputError(f"{rule}, but {told} is {period:g} s and the step {coarse:g} s")

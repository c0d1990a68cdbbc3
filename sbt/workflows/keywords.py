"""The keywords of `run`: a configuration's keys, with objects where a file has names."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypedDict

import numpy as np

from sbt.errors import InputError, must_be, must_take
from sbt.loop.stages import Progress
from sbt.plugins import OBJECT
from sbt.problem.combination import CombinedRequirement
from sbt.problem.distribution import Distribution
from sbt.problem.metric import Metric, metric_from
from sbt.problem.parameter import Parameter
from sbt.problem.plain import Json, JsonMapping
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.trace import Trace

__all__ = ["CampaignKeys", "Setting", "as_data", "check_listener"]

Setting = str | JsonMapping


class CampaignKeys(TypedDict, total=False):
    """Keys of a configuration (but `campaign`), as `run` takes them; see docs/configuration.md."""

    scenario: LogicalScenario | str
    requirement: Requirement | JsonMapping
    inputs: JsonMapping
    correlation: Sequence[Any]
    constraints: Sequence[str]
    features: Mapping[str, str]
    metrics: Sequence[Metric | str | Callable[[Trace], float]]
    ego: Setting | None
    simulation: JsonMapping
    seed: int
    budget: int
    initial: int
    batch: int
    validation: JsonMapping
    metamodel: object
    acquisition: object
    stop: JsonMapping
    gate: Mapping[str, float] | None
    warm_start: JsonMapping | str | Path | None
    covariates: bool | str | None
    fidelity: JsonMapping | None
    judges: Sequence[str] | None
    executor: Setting
    store: str | Path
    workers: int
    report: bool
    progress: Callable[[Progress], None] | None


def check_listener(progress: object) -> None:
    """Refuse a `progress` that cannot be called with where the campaign stands; None: there is none."""
    if progress is None:
        return
    if not callable(progress):
        raise InputError(f"progress must be a function, but got {progress!r}")
    must_take("progress must take one argument, where the campaign stands", progress, 1)


def as_data(keys: JsonMapping) -> tuple[Json, dict[tuple[str, str], Any]]:
    """Return keywords as a configuration's plain data, and the objects among them by kind and name."""
    objects: dict[tuple[str, str], Any] = {}

    def named(kind: str, thing: Any) -> str:
        """Return the name that stands for an object in the configuration."""
        name = OBJECT + str(getattr(thing, "name", "") or getattr(thing, "__name__", None) or type(thing).__name__)
        objects[kind, name] = thing
        return name

    def choice(kind: str, given: Any) -> Any:
        if given is None:
            return None
        if isinstance(given, Mapping):
            return {k: named(kind, v) if k == "kind" and not isinstance(v, str) else _plain(v) for k, v in given.items()}
        return {"kind": str(given) if isinstance(given, str | Path) else named(kind, given)}

    data: Json = {}
    for key, given in keys.items():
        if key in ("metamodel", "acquisition"):
            data[key] = choice(f"{key}s", given)
        elif key in ("scenario", "campaign"):
            data[key] = str(given) if isinstance(given, str | Path) else named(f"{key}s", given)
        elif key == "metrics":
            must_be("metrics must be a list of metrics or names", given, list, tuple)
            data[key] = [m if isinstance(m, str) else named("metrics", metric_from(m)) for m in given]
        elif key in ("ego", "executor") and isinstance(given, str):
            data[key] = {"kind": given}
        elif key == "warm_start" and isinstance(given, str | Path):
            data[key] = {"store": str(given)}
        elif key == "inputs" and isinstance(given, Mapping):
            data[key] = {name: _input(name, change) for name, change in given.items()}
        else:
            data[key] = _plain(given)
    return data, objects


def _input(name: str, change: Any) -> Any:
    """Return the change of an input as plain data: of a range, a distribution, or a whole parameter."""
    if isinstance(change, Parameter):
        if change.name != name:
            raise InputError(f"inputs.{name} must be a change of this input, but got the parameter {change.name}")
        distribution = {} if change.distribution is None else {"distribution": change.distribution}
        likely = dict(zip(change.choices, change.probabilities, strict=False))
        ends = {"min": change.low, "max": change.high, **distribution}
        change = {"choices": likely or change.choices} if change.choices else ends
    if isinstance(change, Distribution):
        change = {"distribution": change}
    if isinstance(change, Mapping):
        return {k: _distribution(v) if isinstance(v, Distribution) else _plain(v) for k, v in change.items()}
    return _plain(change)


def _requirement(given: Requirement, *, named: bool = False) -> Json:
    """Return a requirement as a configuration has it; its name where it is one of several."""
    name = {"name": given.name} if named and given.name else {}
    if isinstance(given, CombinedRequirement):
        return {given.how: [_requirement(item, named=True) for item in given.items], **name}
    return {"metric": given.metric, "critical": [given.low, given.high], **name}


def _distribution(given: Distribution) -> Json:
    return {"kind": given.kind, **dict(given.parameters)}


def _plain(value: Any) -> Any:
    """Return plain data: scalars and arrays of NumPy and paths become Python's own."""
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, Requirement):
        return _requirement(value)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return str(value) if isinstance(value, Path) else value

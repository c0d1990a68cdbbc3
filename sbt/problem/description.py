"""A scenario as plain data: what a store keeps of it, so that reading a store needs no code of the user's."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sbt.errors import InputError
from sbt.problem.combination import from_plain, to_plain
from sbt.problem.distribution import Distribution
from sbt.problem.expression import Expression
from sbt.problem.metric import Metric
from sbt.problem.parameter import Parameter
from sbt.problem.plain import Json, JsonMapping, Values
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.problem.trace import Trace

__all__ = ["describe_scenario", "described_alone", "described_choices", "is_complete", "rebuild_scenario", "scenario_differences"]

_TEXTS = ("description", "title")
"""Keys that may differ between a campaign and its resumption."""


def describe_scenario(scenario: LogicalScenario) -> Json:
    """Return a scenario as JSON data: inputs, requirement, metrics; what is Python code stands there by name only."""
    space, need = scenario.space, scenario.requirement
    return {
        "name": scenario.name, "description": scenario.description,
        "inputs": [_parameter(p) for p in space.parameters],
        "correlation": None if space.correlation is None else [list(row) for row in space.correlation],
        "constraints": [[text, isinstance(rule, Expression)] for text, rule in space.constraints],
        "features": [[name, rule.text if isinstance(rule, Expression) else None] for name, rule in space.features],
        "requirement": to_plain(need),
        "metrics": [
            {"name": m.name, "unit": m.unit, "direction": m.direction, "description": m.description} for m in scenario.metrics
        ]
        or [{"name": name, "unit": "", "direction": "low"} for name in scenario.metric_names],
        "recorded": scenario.pool is not None, "traced": scenario.simulate is not None,
    }  # fmt: skip


def _parameter(p: Parameter) -> Json:
    found = p.distribution
    distribution = None if found is None else {"kind": found.kind, "parameters": [list(pair) for pair in found.parameters]}
    return {
        "name": p.name, "low": _ended(p.low), "high": _ended(p.high), "unit": p.unit, "kind": p.kind,
        "description": p.description, "distribution": distribution,
        **({"choices": list(p.choices), "probabilities": list(p.probabilities)} if p.choices else {}),
    }  # fmt: skip


def _ended(value: float) -> float | str:
    """Return an end of a range as JSON has it: infinite ends are texts."""
    return value if math.isfinite(value) else str(value)


def described_choices(data: JsonMapping) -> dict[str, tuple[str, ...]]:
    """Return the choices of a described scenario's inputs that have some, by name."""
    return {p["name"]: tuple(p["choices"]) for p in data.get("inputs", ()) if p.get("choices")}


def is_complete(data: JsonMapping) -> bool:
    """Return whether the data say all of a scenario but how it runs: no constraint or feature in Python, no recorded rows."""
    formulas = all(written for _, written in data["constraints"]) and all(text is not None for _, text in data["features"])
    return formulas and not data["recorded"]


def described_alone(scenario: LogicalScenario) -> Json:
    """Return a scenario as complete JSON data: without constraints and features in Python, as if it was never recorded."""
    said = describe_scenario(scenario)
    rules, more = said["constraints"], said["features"]
    return {
        **said, "constraints": [rule for rule in rules if rule[1]], "features": [each for each in more if each[1] is not None],
        "recorded": False,
    }  # fmt: skip


def rebuild_scenario(data: JsonMapping) -> LogicalScenario:
    """Return the scenario of these data; it can be asked about, not run.

    Raises:
        InputError: the data are not complete.
    """
    if not is_complete(data):
        raise InputError(f"scenario {data['name']} has constraints or features in Python, or recorded rows: it must be loaded")
    parameters = tuple(
        Parameter(
            p["name"], float(p["low"]), float(p["high"]), p["unit"],
            None if p["distribution"] is None
            else Distribution(p["distribution"]["kind"], tuple((k, v) for k, v in p["distribution"]["parameters"])),
            p["kind"], p["description"], tuple(p.get("choices", ())), tuple(p.get("probabilities", ())),
        )
        for p in data["inputs"]
    )  # fmt: skip
    correlation = None if data["correlation"] is None else tuple(tuple(row) for row in data["correlation"])
    space = ParameterSpace(
        parameters, correlation, tuple((text, Expression(text)) for text, _ in data["constraints"]),
        tuple((name, Expression(text)) for name, text in data["features"]),
    )  # fmt: skip
    need, absent = data["requirement"], _Absent(data["name"])
    metrics = tuple(
        Metric(m["name"], absent.measure, m["unit"], m["direction"], description=m.get("description", ""))
        for m in data["metrics"]
    )
    return LogicalScenario(data["name"], space, from_plain(need), absent, metrics, data["description"])


@dataclass(frozen=True)
class _Absent:
    """Stands where the code of a scenario is not loaded."""

    name: str

    def __call__(self, values: Values, seed: int) -> Trace:
        """Refuse to run."""
        raise InputError(f"scenario {self.name} is known by its description only: its code must be loaded to run it")

    def measure(self, trace: Trace) -> float:
        """Refuse to measure."""
        raise InputError(f"scenario {self.name} is known by its description only: its code must be loaded to measure a run")


def scenario_differences(before: JsonMapping, now: JsonMapping) -> str:
    """Return in words how two described scenarios differ in what is run and asked; "" where they agree."""
    if not before or not now:
        return ""
    one, other = ({p["name"]: p for p in data["inputs"]} for data in (before, now))
    if list(one) != list(other):
        return f"inputs {', '.join(one)} there, {', '.join(other)} now"
    for name, parameter in one.items():
        for key, value in (other[name] | parameter).items():
            if key not in _TEXTS and value != other[name].get(key):
                return f"{key} of input {name}: {parameter.get(key)} there, {other[name].get(key)} now"
    for key in ("name", "requirement", "correlation", "constraints", "features", "recorded", "traced"):
        if before[key] != now[key]:
            return f"{key}: {before[key]} there, {now[key]} now"
    names = [[m["name"] for m in data["metrics"]] for data in (before, now)]
    return "" if names[0] == names[1] else f"metrics {', '.join(names[0])} there, {', '.join(names[1])} now"

"""The verbs of a scenario: simulate, check."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sbt.cli.console import Exit, clean_stdout, fail, print_json
from sbt.errors import InputError

if TYPE_CHECKING:
    from sbt.execution.spec import ScenarioSpec
    from sbt.problem.scenario import LogicalScenario
    from sbt.problem.trace import Trace

__all__ = ["check", "simulate"]

Isolation = Annotated[str, typer.Option(metavar="auto|fresh|reuse|replicas", help="When SUMO is loaded.")]


def simulate(
    scenario: Annotated[str, typer.Argument(metavar="SCENARIO", help="A name, scenario.yaml, or file.py:NAME.")],
    inputs: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME=VALUE]...", help="Inputs; the others are at their centre."),
    ] = None,
    *,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the run.")] = 0,
    ego: Annotated[
        list[str] | None,
        typer.Option(metavar="KEY=VALUE", help="The AV under test, such as kind=...; repeatable."),
    ] = None,
    step: Annotated[float | None, typer.Option(help="Simulation step (s).")] = None,
    isolation: Isolation = "auto",
    trace: Annotated[Path | None, typer.Option(metavar="FILE.csv", help="Write the states of all actors.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as one JSON object.")] = False,
) -> None:
    """Run one concrete scenario and print every metric and the verdict."""
    with clean_stdout():
        from sbt.execution.spec import ScenarioSpec

        choices = _pairs("--ego", ego or []) or None
        _check_choices(choices, step, isolation)
        logical = ScenarioSpec(scenario, str(Path.cwd()), choices, isolation, step).resolve()
        values = logical.space.values({name: _number(name, v) for name, v in _pairs("input", inputs or []).items()})
        result, states = _run(logical, values, seed, with_trace=trace is not None)
        result = {"scenario": scenario, "seed": seed, "inputs": values, **result}
        if trace is not None and states is not None:
            _write_trace(trace, states)
    if as_json:
        print_json(result)
    else:
        _print_result(result, logical)
    if result["status"] != "ok":
        raise typer.Exit(int(Exit.FAILED_RUNS))


def _run(
    logical: LogicalScenario, values: dict[str, float], seed: int, *, with_trace: bool
) -> tuple[dict[str, Any], Trace | None]:
    """Return status, metrics, verdict, reason and seconds of one run, and its trace where there is one."""
    if with_trace and logical.simulate is None:
        raise InputError(f"--trace needs a scenario that is simulated, but {logical.name} gives its metrics directly")
    from sbt.execution.worker import run_traced
    from sbt.problem.outcome import Job

    outcome, states = run_traced(logical, Job(0, values, seed))
    metrics = dict(outcome.metrics)
    need = logical.requirement
    critical = need.critical.low <= metrics[need.metric] <= need.critical.high if metrics else None
    return {
        "status": str(outcome.status),
        "metrics": metrics,
        "critical": critical,
        "reason": outcome.reason,
        "seconds": outcome.seconds,
    }, states


def _print_result(result: dict[str, Any], logical: LogicalScenario) -> None:
    print(f"{result['scenario']}, seed {result['seed']}: " + ", ".join(f"{k}={v:g}" for k, v in result["inputs"].items()))
    if result["status"] != "ok":
        print(f"  {result['status']}: {result['reason']}")
        return
    units = {metric.name: metric.unit for metric in logical.metrics}
    for name, value in result["metrics"].items():
        print(f"  {name:<24}{value:g} {units.get(name, '')}".rstrip())
    need = logical.requirement
    verdict = "critical" if result["critical"] else "not critical"
    print(f"{verdict} ({need.metric} critical in [{need.critical.low:g}, {need.critical.high:g}])")


def _write_trace(path: Path, states: Trace) -> None:
    import csv

    rows = states.rows()
    try:
        with path.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]) if rows else ["time", "actor"])
            writer.writeheader()
            writer.writerows(rows)
    except OSError as error:
        raise InputError(f"--trace must be a file that can be written, but got '{path}': {error.strerror}") from None


def check(
    target: Annotated[str, typer.Argument(metavar="TARGET", help="CONFIG.yaml, scenario.yaml, a name, or file.py:NAME.")],
    *,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the runs.")] = 0,
    isolation: Isolation = "auto",
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as one JSON object.")] = False,
) -> None:
    """Check a scenario: its corners run, and one seed gives one trace, in every process and at every isolation level."""
    with clean_stdout():
        from sbt.workflows.checking import check_scenario

        _check_choices(None, None, isolation)
        spec, scenario = _target(target, isolation)
        findings = check_scenario(spec, seed, scenario)
    broken = sum(not finding.ok for finding in findings)
    if as_json:
        print_json({"target": target, "ok": not broken, "findings": [vars(finding) for finding in findings]})
    else:
        for finding in findings:
            print(f"{'ok  ' if finding.ok else 'FAIL'}  {finding.rule}: {finding.detail}")
    if broken:
        raise fail(f"{target}: {broken} of {len(findings)} rules are broken", Exit.INPUT)


def _target(target: str, isolation: str) -> tuple[ScenarioSpec, LogicalScenario | None]:
    """Return the scenario of a configuration file (with its ranges), or the one with this name."""
    from sbt.execution.spec import ScenarioSpec

    if Path(target).suffix not in (".yaml", ".yml") or _is_scenario(Path(target)):
        return ScenarioSpec(target, str(Path.cwd()), isolation=isolation), None
    from sbt.config.assemble import assemble
    from sbt.config.load import load

    assembly = assemble(load(target))
    return assembly.spec, assembly.scenario


def _is_scenario(path: Path) -> bool:
    """Return whether a YAML file describes a scenario, not a campaign."""
    from sbt.config.scenario_file import is_scenario

    return is_scenario(path)


def _pairs(what: str, texts: list[str]) -> dict[str, Any]:
    """Return name=value texts by name, values read as YAML."""
    from sbt.config.source import read_yaml

    pairs: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise InputError(f"{what} must be name=value, but got '{text}'")
        if name in pairs:
            raise InputError(f"{what} {name} must be given once, but got it twice")
        pairs[name] = read_yaml(value, f"{what} {name}")[0]
    return pairs


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"input {name} must be a number, but got {value!r}")
    return float(value)


def _check_choices(ego: dict[str, Any] | None, step: float | None, isolation: str) -> None:
    if ego is not None and not isinstance(ego.get("kind"), str):
        raise InputError(f"--ego needs kind=NAME, but got {', '.join(ego)}")
    if step is not None and not 0 < step < float("inf"):
        raise InputError(f"--step must be > 0 s, but got {step}")
    if isolation not in ("auto", "fresh", "reuse", "replicas"):
        raise InputError(f"--isolation must be auto, fresh, reuse or replicas, but got '{isolation}'")

"""The verbs of a scenario: simulate, check."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sbt.cli.completion import complete_scenarios
from sbt.cli.console import Exit, clean_stdout, fail, infinite, next_command, print_json
from sbt.errors import InputError

if TYPE_CHECKING:
    from sbt.workflows.front import Run

__all__ = ["check", "simulate"]

Isolation = Annotated[str, typer.Option(metavar="auto|fresh|reuse|replicas", help="When SUMO is loaded.")]


def simulate(
    scenario: Annotated[
        str,
        typer.Argument(metavar="SCENARIO", help="A name, scenario.yaml, or file.py:NAME.", autocompletion=complete_scenarios),
    ],
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
        from sbt.workflows.front import simulate_scenario

        choices = _pairs("--ego", ego or []) or None
        _check_choices(choices, step, isolation)
        values = _texts("input", inputs or [])
        run = simulate_scenario(
            scenario, values, seed=seed, ego=choices, step_length=step, isolation=isolation, traced=trace is not None,
            as_text=True,
        )  # fmt: skip
        if trace is not None:
            _write_trace(trace, run)
    if as_json:
        print_json({**run.to_dict(), **infinite(run.metrics)})
    else:
        _print_run(run)
        next_command("sumo-sbt", "check", scenario)
    if run.status != "ok":
        raise typer.Exit(int(Exit.FAILED_RUNS))


def _print_run(run: Run) -> None:
    print(f"{run.name}, seed {run.seed}: " + run.concrete)
    if run.critical is None:
        print(f"  {run.status}: {run.reason}")
        return
    from sbt.campaigns.wording import written_unit

    units = {metric.name: written_unit(metric.unit) for metric in run.scenario.metrics}
    for name, value in run.metrics.items():
        print(f"  {name:<24}{value:g} {units.get(name, '')}".rstrip())
    need = run.scenario.requirement
    verdict = "critical" if run.critical else "not critical"
    each = "; ".join(f"{part.metric} critical in [{part.low:g}, {part.high:g}]" for part in need.parts)
    print(f"{verdict} ({need.metric}: {each})" if need.combined else f"{verdict} ({each})")
    asked = {part.metric for part in need.parts}
    for metric in run.scenario.metrics:
        if metric.name in asked and metric.description:
            print(f"  {metric.name}: {metric.description}")
    if run.unconfirmed:
        print(f"doubtful: {run.unconfirmed}")


def _write_trace(path: Path, run: Run) -> None:
    import csv

    from sbt.files import as_cell

    if run.states is None:
        return
    rows = run.states.rows()
    try:
        with path.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]) if rows else ["time", "actor"])
            writer.writeheader()
            writer.writerows({key: as_cell(value) for key, value in row.items()} for row in rows)
    except OSError as error:
        raise InputError(f"--trace must be a file that can be written, but got '{path}': {error.strerror}") from None


def check(
    target: Annotated[
        str,
        typer.Argument(
            metavar="TARGET", help="CONFIG.yaml, scenario.yaml, a name, or file.py:NAME.", autocompletion=complete_scenarios
        ),
    ],
    *,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the runs.")] = 0,
    isolation: Isolation = "auto",
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as one JSON object.")] = False,
) -> None:
    """Check a scenario: its corners run, and one seed gives one trace, in every process and at every isolation level."""
    with clean_stdout():
        from sbt.workflows.front import Checked, findings_in

        _check_choices(None, None, isolation)
        coming, found = findings_in(target, seed=seed, isolation=isolation), []
    while True:
        with clean_stdout():
            finding = next(coming, None)
        if finding is None:
            break
        found.append(finding)
        if not as_json:
            print(finding, flush=True)
    checked = Checked(tuple(found))
    if as_json:
        print_json({"target": target, **checked.to_dict()})
    if not checked.ok:
        broken = sum(not finding.ok for finding in checked.findings)
        raise fail(f"{target}: {broken} of {sum(each.is_rule for each in checked.findings)} rules are broken", Exit.INPUT)
    if not as_json:
        campaign = target.endswith((".yaml", ".yml")) and Path(target).name != "scenario.yaml"
        next_command("sumo-sbt", "run" if campaign else "simulate", target)


def _pairs(what: str, texts: list[str]) -> dict[str, Any]:
    """Return name=value texts by name, values read as YAML."""
    from sbt.config.source import read_value

    return {name: read_value(value, f"{what} {name}") for name, value in _texts(what, texts).items()}


def _texts(what: str, texts: list[str]) -> dict[str, str]:
    """Return name=value texts by name."""
    pairs: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise InputError(f"{what} must be name=value, but got '{text}'")
        if name in pairs:
            raise InputError(f"{what} {name} must be given once, but got it twice")
        pairs[name] = value
    return pairs


def _check_choices(ego: dict[str, Any] | None, step: float | None, isolation: str) -> None:
    if ego is not None and not isinstance(ego.get("kind"), str):
        raise InputError(f"--ego needs kind=NAME, but got {', '.join(ego)}")
    if step is not None and not 0 < step < float("inf"):
        raise InputError(f"--step must be > 0 s, but got {step}")
    if isolation not in ("auto", "fresh", "reuse", "replicas", "snapshot"):
        raise InputError(f"--isolation must be auto, fresh, reuse, replicas or snapshot, but got '{isolation}'")

"""The verbs that inform: list, schema, doctor."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sbt.cli.campaign import with_store
from sbt.cli.console import Exit, clean_stdout, print_json
from sbt.errors import InputError, command_of
from sbt.plugins import KINDS

if TYPE_CHECKING:
    from sbt.workflows.status import Diagnosis

__all__ = ["doctor", "list_", "schema"]


def list_(
    kind: Annotated[str | None, typer.Argument(metavar="[KIND]", help=" | ".join(KINDS))] = None,
    *,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """List what is installed, with a line on each."""
    with clean_stdout():
        from sbt.cli.listing import listed

        found = {each: listed(each) for each in ([kind] if kind is not None else KINDS)}
    if as_json:
        print_json({each: [{"name": n, "summary": s} for n, s in entries.items()] for each, entries in found.items()})
        return
    for each, entries in found.items():
        print(f"{each}:" if entries else f"{each}: none installed")
        for name, summary in entries.items():
            print(f"  {name:<28} {summary}".rstrip())


def schema(
    kind: Annotated[str, typer.Argument(metavar="[campaign|scenario|benchmark]", help="Of which file.")] = "campaign",
) -> None:
    """Print the JSON schema of configurations, of scenario.yaml or of a benchmark's file, for editors."""
    if kind not in ("campaign", "scenario", "benchmark"):
        raise InputError(f"a schema must be campaign, scenario or benchmark, but got '{kind}'")
    if kind == "benchmark":
        from sbt.config.benchmark import Benchmark

        print(json.dumps(Benchmark.model_json_schema(), indent=2))
        return
    if kind == "scenario":
        from sbt.config.scenario_model import schema as scenario_schema

        print(json.dumps(scenario_schema(), indent=2))
        return
    from sbt.config.load import schema as configuration_schema

    print(json.dumps(configuration_schema(), indent=2))


def doctor(
    store: Annotated[
        Path | None, typer.Argument(metavar="[DIR]", help="Examine this campaign's store; default: the environment.")
    ] = None,
    *,
    save: Annotated[
        Path | None, typer.Option(metavar="NEW", help="Write a store of what is whole in DIR; run goes on from there.")
    ] = None,
    folder: Annotated[Path, typer.Option("--store", metavar="DIR", help="Where results shall go.")] = Path("runs"),
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Check the environment (versions, SUMO, disk), or whether a store is whole; print advice where something is wrong."""
    if store is not None:
        _examine_store(with_store(store), save, as_json=as_json)
        return
    if save is not None:
        raise InputError("--save needs the store that is damaged: sumo-sbt doctor DIR --save NEW")
    with clean_stdout():
        from sbt.cli.doctor import examine

        checks = examine(folder)
    if as_json:
        print_json({"ok": all(c.state != "broken" for c in checks), "checks": [vars(c) for c in checks]})
    else:
        for c in checks:
            print(f"{c.state:<8}{c.name:<14}{c.detail}" + (f"; {c.advice}" if c.advice else ""))
    if any(c.state == "broken" for c in checks):
        raise typer.Exit(int(Exit.INTERNAL))


def _examine_store(folder: Path, target: Path | None, *, as_json: bool) -> None:
    """Print what of a store is whole, and save that where there is a target; exit 1 where something is damaged."""
    with clean_stdout():
        from sbt.workflows.status import examine, save

        found = examine(folder)
        saved = None if target is None else save(folder, target)
    if as_json:
        told = None if saved is None else {"store": str(target), "runs": saved[0], "planned_again": saved[1]}
        print_json({"store": str(folder), "whole": found.whole, **vars(found), "saved": told})
    else:
        print("\n".join(_told(folder, found)))
        if saved is not None:
            print(f"saved: {saved[0]} runs in {target}, {saved[1]} of them to be run again; run with --store {target} goes on")
    if not found.whole:
        raise typer.Exit(int(Exit.INTERNAL))


def _told(folder: Path, found: Diagnosis) -> Iterator[str]:
    """Yield what of a store is whole, a line each."""
    if found.whole:
        waiting = f", {found.planned} of them not finished" if found.planned else ""
        yield f"{folder} is whole: {found.runs} runs{waiting}"
        return
    yield f"{folder} is damaged; {found.runs} runs can be read"
    numbers = {
        "plan damaged, of runs": found.damaged_plans, "outcome damaged, of runs": found.damaged_outcomes,
        "runs lost": found.lost_runs, "batches damaged": found.damaged_iterations, "batches lost": found.lost_iterations,
        "scores of the metamodel damaged, after runs": found.damaged_fits, "damaged": found.damaged_texts,
        "structure": found.structure,
    }  # fmt: skip
    for what, which in numbers.items():
        if which:
            more = f" and {len(which) - 8} more" if len(which) > 8 else ""
            yield f"  {what}: {', '.join(map(str, which[:8]))}{more}"
    beside = folder / "config.resolved.yaml"
    if not found.runs and beside.is_file():
        yield f"  nothing can be saved; the same campaign anew: {command_of('sumo-sbt', 'run', beside, '--store', 'NEW')}"
    elif not found.runs:
        yield "  nothing can be saved: begin a new campaign"
    elif found.configuration or beside.is_file():
        where = "" if found.configuration else f", with the configuration of {beside}"
        yield f"  save what is whole{where}: {command_of('sumo-sbt', 'doctor', folder, '--save', 'NEW')}"
    else:
        yield "  nothing can go on without the configuration: begin a new campaign"

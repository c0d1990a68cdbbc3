"""The verbs that inform: list, schema, doctor."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from sbt.cli.console import Exit, clean_stdout, print_json
from sbt.errors import InputError
from sbt.plugins import KINDS

__all__ = ["doctor", "list_", "schema"]


def list_(
    kind: Annotated[str | None, typer.Argument(metavar="[KIND]", help=" | ".join(KINDS))] = None,
    *,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """List what is installed, with a line on each."""
    with clean_stdout():
        from sbt.workflows.front import installed

        found = {each: installed(each) for each in ([kind] if kind is not None else KINDS)}
    if as_json:
        print_json({each: [{"name": n, "summary": s} for n, s in entries.items()] for each, entries in found.items()})
        return
    for each, entries in found.items():
        print(f"{each}:" if entries else f"{each}: none installed")
        for name, summary in entries.items():
            print(f"  {name:<28} {summary}".rstrip())


def schema(
    kind: Annotated[str, typer.Argument(metavar="[campaign|scenario]", help="Of which file.")] = "campaign",
) -> None:
    """Print the JSON schema of configurations or of scenario.yaml, for editors."""
    if kind not in ("campaign", "scenario"):
        raise InputError(f"a schema must be campaign or scenario, but got '{kind}'")
    if kind == "scenario":
        from sbt.config.scenario_model import schema as scenario_schema

        print(json.dumps(scenario_schema(), indent=2))
        return
    from sbt.config.load import schema as configuration_schema

    print(json.dumps(configuration_schema(), indent=2))


def doctor(
    folder: Annotated[Path, typer.Option("--store", metavar="DIR", help="Where results shall go.")] = Path("runs"),
    *,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Check the environment: versions, SUMO, disk; print advice where something is wrong."""
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

"""The verbs that inform: list, schema, doctor."""

from __future__ import annotations

import inspect
import json
from pathlib import Path
from typing import Annotated, Any

import typer

from sbt.cli.console import Exit, clean_stdout, print_json
from sbt.errors import InputError, PluginError, did_you_mean

__all__ = ["doctor", "list_", "schema"]

_KINDS = ("scenarios", "sources", "metamodels", "acquisitions", "metrics", "controllers", "campaigns")
_WRITTEN = {"table": "table:FOLDER", "testbed": "testbed:NAME", "yaml": "FOLDER/scenario.yaml"}
"""How a scenario of each source of this package is named; those of others are PREFIX:REST."""


def list_(
    kind: Annotated[str | None, typer.Argument(metavar="[KIND]", help=" | ".join(_KINDS))] = None,
    *,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """List what is installed, with a line on each."""
    if kind is not None and kind not in _KINDS:
        raise InputError(f"KIND must be one of {', '.join(_KINDS)}, but got '{kind}'{did_you_mean(kind, _KINDS)}")
    with clean_stdout():
        found = {each: _entries(each) for each in ([kind] if kind is not None else _KINDS)}
    if as_json:
        print_json(found)
        return
    for each, entries in found.items():
        print(f"{each}:" if entries else f"{each}: none installed")
        for entry in entries:
            print(f"  {entry['name']:<28} {entry['summary']}".rstrip())


def _entries(kind: str) -> list[dict[str, str]]:
    """Return name and summary of everything of one kind; where it cannot be loaded, the error is the summary."""
    from sbt.plugins import load, names

    if kind == "campaigns":
        from sbt.config.kinds import kinds

        return [{"name": name, "summary": kind.description} for name, kind in kinds().items()]
    if kind == "sources":
        return _sources()
    entries = []
    for name in names(kind):
        try:
            summary = _summary(load(kind, name))
        except PluginError as error:
            summary = f"cannot be loaded: {error}"
        entries.append({"name": name, "summary": summary})
    return entries


def _sources() -> list[dict[str, str]]:
    """Return how the scenarios of each source are named, and the testbeds."""
    from sbt import testbeds
    from sbt.plugins import load, names

    found = [{"name": _WRITTEN.get(n, f"{n}:REST"), "summary": _summary(load("sources", n))} for n in names("sources")]
    return found + [{"name": f"testbed:{n}", "summary": testbeds.find(n).title} for n in testbeds.names()]


def _summary(thing: Any) -> str:
    """Return the first line of a description or docstring."""
    text = getattr(thing, "description", "") or inspect.getdoc(thing) or ""
    unit = f" ({thing.unit})" if getattr(thing, "unit", "") else ""
    return (text.strip().splitlines() or [""])[0] + unit


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

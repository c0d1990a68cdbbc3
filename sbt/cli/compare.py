"""The verb compare: other samplers on the same scenario and budget."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sbt.cli.console import clean_stdout, next_command, print_json, resumable

__all__ = ["compare"]

_DEFAULT = "portfolio,random,sobol,cma_es,tpe"


def compare(
    config: Annotated[Path, typer.Argument(metavar="CONFIG.yaml", help="Configuration of a falsification.")],
    *,
    samplers: Annotated[str, typer.Option(help="Comma-separated names.")] = _DEFAULT,
    seeds: Annotated[int, typer.Option(min=1, help="Repetitions, from the configured seed on.")] = 10,
    into: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of the finished cells; default: the store's name and _compare.")
    ] = None,
    changes: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY.PATH=VALUE", help="Change one key; repeatable.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the cells as one JSON object.")] = False,
) -> None:
    """Compare samplers; run again to continue where it was interrupted."""
    with resumable("*") as work, clean_stdout():
        from sbt.config.load import load

        loaded = load(config, list(changes or []))
        from sbt.benchmark import compare as room

        folder = into if into is not None else Path(f"{loaded.config.store}_compare")
        names = [name.strip() for name in samplers.split(",") if name.strip()]
        work.folder = folder
        cells = room.compare(loaded, names, seeds, folder)
    if as_json:
        print_json({"cells": [vars(cell) for cell in cells]})
    else:
        print(room.table(cells))
        next_command("sumo-sbt", "run", config)

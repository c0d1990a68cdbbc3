"""The verb `new`: a commented scenario.yaml for existing SUMO files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sbt.cli.console import clean_stdout, next_command

__all__ = ["new"]


def new(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Where scenario.yaml shall go.")],
    *,
    config: Annotated[Path, typer.Option("--from", metavar="MY.sumocfg", help="Your SUMO configuration.")],
    ego: Annotated[
        str | None, typer.Option(metavar="ID", help="The vehicle under test; default: 'ego', or one of the traffic's midst.")
    ] = None,
) -> None:
    """Write a commented scenario.yaml and campaign.yaml for your own SUMO files, which stay as they are."""
    with clean_stdout():
        from sbt.workflows.starting import write_scenario

        written = write_scenario(folder, config, ego)
    for line in (*written.paths, *written.notes):
        print(line)
    next_command("sumo-sbt", "check", written.paths[0])

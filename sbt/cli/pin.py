"""The verb `pin`: a found failure as a pytest file."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from sbt.cli.campaign import Folder, Trust, with_store
from sbt.cli.console import clean_stdout, next_command

__all__ = ["pin"]


def pin(
    folder: Folder,
    runs: Annotated[list[str], typer.Argument(metavar="RUN...", help="Indices of runs, or mode:1 for the first failure mode.")],
    *,
    into: Annotated[Path, typer.Option("--into", metavar="FOLDER", help="Where the test goes.")],
    trust: Trust = False,
) -> None:
    """Write a pytest file that guards found failures: same start, same metrics, and the requirement for a new ego."""
    with clean_stdout():
        from sbt.workflows.pinning import pin_runs, uncritical

        path = pin_runs(with_store(folder, trust=trust), runs, into)
        harmless = uncritical(folder, runs)
    if harmless:
        told = ", ".join(map(str, harmless[:8])) + (f" and {len(harmless) - 8} more" if len(harmless) > 8 else "")
        print(f"no failures: runs {told} violate nothing; the test guards that they do not begin to", file=sys.stderr)
    print(path)
    next_command("pytest", "-q", path)

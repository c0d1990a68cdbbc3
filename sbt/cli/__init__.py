"""The command line `sumo-sbt`: what answers Ctrl-C before anything else is imported."""

from __future__ import annotations

import os
import signal
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sbt.cli.verbs import app

__all__ = ["app", "main"]

_INTERRUPTED = 130


class _Starting:
    """Answers Ctrl-C while the verbs are imported: nothing was begun that would have to be put away."""

    def __init__(self) -> None:
        self.active = True

    def __call__(self, number: int, frame: Any) -> None:
        if self.active:
            os.write(2, b"interrupted, nothing was run yet\n")
            os._exit(_INTERRUPTED)  # an exception would end in whatever is being imported, which may keep it
        raise KeyboardInterrupt


def main() -> None:
    """Run the command line; ends the process."""
    starting = _Starting()
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not where it is ignored: a shell's background
        signal.signal(signal.SIGINT, starting)
    from sbt.cli.console import process
    from sbt.cli.verbs import app

    with process():
        starting.active = False
        app(prog_name="sumo-sbt")


def __getattr__(name: str) -> Any:
    """Import the verbs when they are asked for."""
    if name != "app":
        raise AttributeError(f"module 'sbt.cli' has no attribute '{name}'")
    from sbt.cli.verbs import app

    return app

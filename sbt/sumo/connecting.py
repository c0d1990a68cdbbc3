"""A connection to a SUMO program in a process of its own, through traci."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from sbt.errors import RunError
from sbt.problem.outcome import Status

__all__ = ["start_quietly", "traci_connection"]


def start_quietly(traci: Any, command: list[str]) -> None:
    """Start a SUMO program without what traci prints and warns of while the program is not up yet; it raises when it gives up."""
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        traci.start(command)


@contextlib.contextmanager
def traci_connection(traci: Any, command: list[str], state: Callable[[], Path] | None = None) -> Iterator[Any]:
    """Start a SUMO program, provide traci connected to it, and close it in the end.

    Args:
        traci: the module.
        command: program and options.
        state: writes what a run is loaded from, and returns a saved state, which is loaded; called when the program is up.
    """
    try:
        start_quietly(traci, command)
        if state is not None:
            traci.simulation.loadState(str(state()))
        yield traci
    except (traci.exceptions.TraCIException, traci.exceptions.FatalTraCIError) as error:
        raise RunError(Status.FAILED, f"SUMO: {error}") from None
    finally:
        with contextlib.suppress(traci.exceptions.FatalTraCIError, traci.exceptions.TraCIException, KeyError):
            traci.close()

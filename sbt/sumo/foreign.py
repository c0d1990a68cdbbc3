"""What goes wrong in a user's loop, and loops that speak to another module than the `sumo` that they are handed.

Scripts `import traci`. In campaigns SUMO runs inside this process, through libsumo: calls to the module `traci` find no
connection, and steps made by the module `libsumo` are not recorded.
"""

from __future__ import annotations

import ast
import contextlib
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sbt.errors import RunError
from sbt.problem.outcome import Status

__all__ = ["check_not_stepped", "error_in_loop", "place_in_loop", "started_another"]

_MODULES = ("traci", "libsumo")
_REMEDY = "let the loop begin with `global traci` and `traci = sumo`, the sumo that it is handed"


def error_in_loop(error: BaseException, client: Any) -> BaseException:
    """Return the error of a run whose loop raised one; SUMO's own errors are returned as they are.

    Args:
        error: what was raised.
        client: SUMO's client module in this run.
    """
    of_traci = type(error).__module__.partition(".")[0] == "traci"
    if of_traci and getattr(client, "__name__", "") != "traci":
        rule = "a loop must call the sumo that it is handed, but it calls the module traci, which has no connection"
        return RunError(Status.FAILED, f"{rule}: {_REMEDY}")
    if "TraCI" in type(error).__name__:
        return error
    return RunError(Status.FAILED, f"{type(error).__name__}: {' '.join(str(error).split())}".removesuffix(": "))


def place_in_loop(error: BaseException, loop: Callable[..., Any]) -> str:
    """Return the last line of the user's file in the traceback of an error, as ` (file:line)`."""
    file = getattr(getattr(loop, "__code__", None), "co_filename", "")
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
    return f" ({file}:{lines[-1]})" if lines else ""


def _first_use(loop: Callable[..., Any]) -> str:
    """Return the first line of the loop's file that calls the module traci or libsumo, as ` (file:line)`; "" without one."""
    file = getattr(getattr(loop, "__code__", None), "co_filename", "")
    try:
        tree = ast.parse(Path(file).read_bytes())
    except (OSError, SyntaxError, ValueError):
        return ""
    names = {
        alias.asname or alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.Import)
        for alias in node.names
        if alias.name in _MODULES
    }
    used = (
        node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in names
    )
    line = min(used, default=0)
    return f" ({file}:{line})" if line else ""


def check_not_stepped(client: Any, expected: float, loop: Callable[..., Any]) -> None:
    """Check that nobody has stepped the simulation beside the recorder.

    Raises:
        RunError: its time is not the one after the last recorded step.
    """
    now = float(client.simulation.getTime())
    if abs(now - expected) > 1e-6:
        raise RunError(
            Status.FAILED,
            f"a loop must step by sumo.simulationStep alone, but another module{_first_use(loop)} has stepped from "
            f"t = {expected:g} s to {now:g} s, which is not recorded: {_REMEDY}",
        )


def started_another(loop: Callable[..., Any]) -> str:
    """Return the hint for a loop that has started the module traci itself, whose SUMO is ended; "" if it has not."""
    traci = sys.modules.get("traci")
    if traci is None or not traci.isLoaded():
        return ""
    with contextlib.suppress(Exception):  # its SUMO may be gone
        traci.close(False)
    return f"; it has started the module traci instead{_first_use(loop)}: {_REMEDY}"

"""Runs a concrete scenario under sumo-gui through traci: the same scene and controllers, in real time."""

from __future__ import annotations

import importlib.util
import os
import shutil
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from sbt.errors import InputError
from sbt.problem.isolation import Isolation
from sbt.sumo.connecting import start_quietly
from sbt.sumo.session import session

__all__ = ["gui_program", "run_in_gui"]

_EGO_COLOR = (193, 39, 45, 255)
_ZOOM = 2000.0


def gui_program() -> str:
    """Return the sumo-gui program, on the path or in the package eclipse-sumo.

    Raises:
        InputError: it is not installed, or there is no display.
    """
    found = shutil.which("sumo-gui")
    package = importlib.util.find_spec("sumo")
    if found is None and package is not None and package.origin:
        found = shutil.which(str(Path(package.origin).parent / "bin" / "sumo-gui"))
    if found is None:
        raise InputError("--gui needs sumo-gui on the path, but it is not there: install the extra 'tools'")
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InputError("--gui needs a display, but neither DISPLAY nor WAYLAND_DISPLAY is set: --gif FILE needs none")
    return found


class _Override:
    """An object with some attributes of another one replaced."""

    def __init__(self, original: Any, **replaced: Any):
        self._original = original
        self.__dict__.update(replaced)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._original, name)


def run_in_gui(
    simulate: Any, values: Any, seed: int, program: str, *, ego: str = "ego", linger: float = 2.0, pace: float = 1.0
) -> Any:
    """Run one concrete scenario in a separate SUMO process and return its trace.

    Args:
        simulate: a simulation that can be `configured` with isolation `fresh`, or begins with warmed traffic.
        values: its inputs.
        seed: of the run.
        program: sumo-gui, or sumo.
        ego: name of the road user under test, which the window follows.
        linger: how long the window shows the first and the last state (s).
        pace: simulated seconds in a second in between; 1: real time; infinite: as fast as it can.

    Raises:
        RunError: the program exits, or the run fails.
    """
    import traci

    next_step: list[float] = []  # clock time of the next step; empty until the ego has been inserted
    has_window = "gui" in Path(program).name

    def start(command: list[str]) -> None:
        options = ["--start", "--quit-on-end", "--window-size", "1200,800"] if has_window else []
        start_quietly(traci, [program, *command[1:], *options])

    def step(*_: Any) -> None:
        if next_step:  # SUMO's own delay has no effect on steps made through TraCI
            time.sleep(max(0.0, next_step[0] - time.monotonic()))
            next_step[0] += traci.simulation.getDeltaT() / pace
        traci.simulationStep()
        if not has_window or next_step:
            return
        domain = next((d for d in (traci.vehicle, traci.person) if ego in d.getIDList()), None)
        if domain is not None:
            domain.setColor(ego, _EGO_COLOR)
            traci.gui.setSchema(traci.gui.DEFAULT_VIEW, "real world")
            traci.gui.trackVehicle(traci.gui.DEFAULT_VIEW, ego)
            traci.gui.setZoom(traci.gui.DEFAULT_VIEW, _ZOOM)
            next_step.append(time.monotonic() + linger)

    client = _Override(traci, simulation=_Override(traci.simulation, step=step), start=start, simulationStep=step)
    with session().using(client):
        try:
            trace = _here(simulate)(values, seed)
            time.sleep(linger if has_window else 0.0)
            return trace
        finally:
            if traci.isLoaded():
                traci.close()


def _here(simulate: Any) -> Any:
    """Return the simulation as it runs through the client of this process, and to the same trace."""
    isolation = getattr(simulate, "isolation", None)
    if isinstance(isolation, Isolation):
        return simulate.isolated(replace(isolation, forking=False))
    return simulate.configured(isolation="fresh")

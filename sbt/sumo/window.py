"""A run under sumo-gui, through traci: the same scene and controllers, at the speed of a spectator."""

from __future__ import annotations

import importlib.util
import os
import shutil
import sys
import time
from pathlib import Path
from typing import Any

from sbt.errors import InputError
from sbt.sumo.session import session

__all__ = ["gui_program", "watch"]

_EGO = (193, 39, 45, 255)
_ZOOM = 2000.0


def gui_program() -> str:
    """Return the sumo-gui program: on the path, or of the package eclipse-sumo.

    Raises:
        InputError: there is none, or no display to open it on.
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


class _Instead:
    """Another object with some of its attributes replaced."""

    def __init__(self, original: Any, **replaced: Any):
        self._original = original
        self.__dict__.update(replaced)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._original, name)


def watch(simulate: Any, values: Any, seed: int, program: str, linger: float = 2.0) -> Any:
    """Run one concrete scenario in another SUMO program, and return its trace.

    Args:
        simulate: a simulation that can be `configured` to isolation `fresh`.
        values: its inputs.
        seed: of the run.
        program: sumo-gui, or sumo.
        linger: how long the window shows the first and the last instant (s); between them it goes in real time.

    Raises:
        RunError: the program ends, or the run fails.
    """
    import traci

    due: list[float] = []  # when, on the clock, the next step is; empty until the ego is there
    in_window = "gui" in Path(program).name

    def start(command: list[str]) -> None:
        shown = ["--start", "--quit-on-end", "--window-size", "1200,800"] if in_window else []
        traci.start([program, *command[1:], *shown])

    def step(*_: Any) -> None:
        if due:  # SUMO's own delay has no effect when traci makes the steps
            time.sleep(max(0.0, due[0] - time.monotonic()))
            due[0] += simulate.step_length
        traci.simulationStep()
        if in_window and not due and "ego" in traci.vehicle.getIDList():
            traci.vehicle.setColor("ego", _EGO)
            traci.gui.setSchema(traci.gui.DEFAULT_VIEW, "real world")
            traci.gui.trackVehicle(traci.gui.DEFAULT_VIEW, "ego")
            traci.gui.setZoom(traci.gui.DEFAULT_VIEW, _ZOOM)
            due.append(time.monotonic() + linger)

    client = _Instead(traci, simulation=_Instead(traci.simulation, step=step), start=start, simulationStep=step)
    with session().through(client):
        try:
            trace = simulate.configured(isolation="fresh")(values, seed)
            time.sleep(linger if in_window else 0.0)
            return trace
        finally:
            if traci.isLoaded():
                traci.close()

"""A run under sumo-gui, through traci: the same scene and controllers, at the speed of a spectator."""

from __future__ import annotations

import importlib.util
import os
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from sbt.errors import InputError
from sbt.sumo.session import session

__all__ = ["gui_program", "watch"]


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


def watch(simulate: Any, values: Any, seed: int, program: str, delay: float = 0.05) -> Any:
    """Run one concrete scenario in another SUMO program, and return its trace.

    Args:
        simulate: a simulation that can be `configured` to isolation `fresh`.
        values: its inputs.
        seed: of the run.
        program: sumo-gui, or sumo.
        delay: wall-clock time of a step (s).

    Raises:
        RunError: the program ends, or the run fails.
    """
    import traci

    seen: list[str] = []

    def start(command: list[str]) -> None:
        shown = ["--start", "--quit-on-end", "--delay", str(round(1000 * delay))] if "gui" in Path(program).name else []
        traci.start([program, *command[1:], *shown])

    def step(*_: Any) -> None:
        traci.simulationStep()
        if shown_in_window and not seen and "ego" in traci.vehicle.getIDList():
            seen.append("ego")
            traci.gui.trackVehicle(traci.gui.DEFAULT_VIEW, "ego")
            traci.gui.setZoom(traci.gui.DEFAULT_VIEW, 800)

    shown_in_window = "gui" in Path(program).name
    simulation = SimpleNamespace(
        step=step,
        getCollisions=traci.simulation.getCollisions,
        getCollidingVehiclesNumber=traci.simulation.getCollidingVehiclesNumber,
    )
    client = SimpleNamespace(
        vehicle=traci.vehicle, person=traci.person, polygon=traci.polygon, route=traci.route, simulation=simulation,
        load=traci.load, isLoaded=traci.isLoaded, start=start, simulationStep=step,
        TraCIException=traci.TraCIException, FatalTraCIError=traci.FatalTraCIError,
    )  # fmt: skip
    with session().through(client):
        try:
            return simulate.configured(isolation="fresh")(values, seed)
        finally:
            if traci.isLoaded():
                traci.close()

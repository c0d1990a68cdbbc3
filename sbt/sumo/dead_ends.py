"""Vehicles that SUMO stops dead: where a lane ends and the route does not go on, one stands still from one step to the next.

Nothing in the scenario asked for that, no vehicle can brake so hard, and who follows runs into it: it is no outcome.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sbt.errors import RunError
from sbt.problem.arrays import Points
from sbt.problem.outcome import Status
from sbt.sumo.actors import Actor

__all__ = ["refuse_dead_ends"]

_HARDEST, _STANDING = 50.0, 0.01
"""Deceleration (m/s^2) beyond all that brakes or a controller's limits give, and the speed (m/s) of who stands."""
_AT_END = 1.0
"""Distance from the end of a lane (m) up to which one stands there."""


def refuse_dead_ends(sumo: Any, actors: tuple[Actor, ...], speed: Points, dt: float, prefix: str = "") -> None:
    """Refuse a run in which a vehicle was stopped dead at the end of a lane; to be called while its last step is there.

    Args:
        sumo: libsumo.
        actors: of the run.
        speed: (t, actors) of each (m/s), NaN where one is not there.
        dt: step (s).
        prefix: of the names of the actors in SUMO.

    Raises:
        RunError: a vehicle was.
    """
    with np.errstate(invalid="ignore"):
        dead = (speed[:-1] - speed[1:] > _HARDEST * dt) & (speed[1:] < _STANDING)
    for k in np.flatnonzero(dead.any(axis=0)):
        actor, name, row = actors[k], prefix + actors[k].name, int(np.argmax(dead[:, k]))
        if actor.person or actor.pose is not None or name not in sumo.vehicle.getIDList():
            continue
        lane = sumo.vehicle.getLaneID(name)
        if lane and sumo.lane.getLength(lane) - sumo.vehicle.getLanePosition(name) <= _AT_END:
            what = f"SUMO stopped it within a step, from {speed[row, k]:.3g} m/s, at t = {(row + 1) * dt:g} s"
            route, lane = " ".join(actor.route), lane.removeprefix(prefix)
            where = f"at the end of lane {lane}, from which its route ({route}) does not go on"
            rule = f"{actor.name} must drive on along its route"
            raise RunError(Status.FAILED, f"{rule}, but {what} {where}: choose another lane or route")

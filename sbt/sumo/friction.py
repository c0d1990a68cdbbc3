"""Friction between tyres and road, which bounds the acceleration and the braking of everybody that drives along lanes.

SUMO's own friction (an attribute of lanes, a device of vehicles) changes the speed that its drivers choose, not how hard
anybody can brake. Here |acceleration| <= mu g holds: SUMO's drivers brake and accelerate at most so hard, also in an emergency,
and vehicles whose speed is commanded, by a controller, a profile or a loop (speed mode 32), get there no faster (SUMO's speed
modes 2 and 4). Lateral acceleration is not bounded, and road users that are moved by position are not either.
"""

from __future__ import annotations

import gzip
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sbt.errors import RunError
from sbt.plugins import kept
from sbt.problem.outcome import Status
from sbt.sumo.grip import Limits, limit_to_friction, set_limits
from sbt.sumo.guided import Motion, Placed
from sbt.sumo.template import fill

__all__ = ["Friction", "has_friction"]

_DRY = 1.0
"""SUMO's friction of lanes where a network says nothing; it bounds nothing."""
_CHUNK = 1 << 22


@kept
def has_friction(net: Path) -> bool:
    """Return whether a network has lanes with a friction of their own; each file is looked at once per process."""
    with gzip.open(net) if net.suffix == ".gz" else net.open("rb") as file:
        tail = b""
        while chunk := file.read(_CHUNK):
            if b" friction=" in tail + chunk:
                return True
            tail = chunk[-16:]
    return False


@dataclass(frozen=True)
class Friction:
    """Bounds everybody in a user's own simulation.

    Args:
        coefficient: of all roads: a number, or a formula of inputs as `${mu}`; None: the friction of each lane.
    """

    coefficient: str | None = None

    def begin(self, sumo: Any, values: Mapping[str, Any]) -> Motion:
        """Return what bounds accelerations in one run.

        Raises:
            RunError: the coefficient is not positive.
        """
        if self.coefficient is None:
            lanes = {lane: sumo.lane.getFriction(lane) for lane in sumo.lane.getIDList()}
            return _Lanes(sumo, {lane: _checked(mu) for lane, mu in lanes.items() if mu != _DRY})
        return _Everywhere(sumo, _checked(float(fill(self.coefficient, values))))


def _checked(mu: float) -> float:
    if not 0 < mu < math.inf:
        raise RunError(Status.INVALID, f"a coefficient of friction must be > 0, but got {mu:g}")
    return mu


class _Everywhere:
    """One coefficient for all roads."""

    def __init__(self, sumo: Any, mu: float):
        self._sumo, self._mu = sumo, mu

    def before_step(self, t: float | None) -> None:
        """Bound who departed in the last step: by now it has its driver."""
        for name in self._sumo.simulation.getDepartedIDList():
            limit_to_friction(self._sumo, name, self._mu)

    def after_step(self) -> Mapping[str, Placed]:
        """Nobody is moved by position."""
        return {}


class _Lanes:
    """A coefficient for each lane: vehicles get their own limits back where they leave the slippery ones."""

    def __init__(self, sumo: Any, friction: Mapping[str, float]):
        self._sumo, self._friction = sumo, friction
        self._limited: dict[str, tuple[float, Limits]] = {}

    def before_step(self, t: float | None) -> None:
        """Bound who is on a slippery lane; between two, the lower friction counts."""
        lane = self._sumo.lane
        now: dict[str, float] = {}
        for name, mu in self._friction.items():
            for vehicle in lane.getLastStepVehicleIDs(name):
                now[vehicle] = min(mu, now.get(vehicle, math.inf))
        changed = [name for name, (mu, _) in self._limited.items() if now.get(name) != mu]
        there = set(self._sumo.vehicle.getIDList()) if changed else set()
        for name in changed:
            _, before = self._limited.pop(name)
            if name in there:
                set_limits(self._sumo, name, before)
        for name, mu in now.items():
            if name not in self._limited:
                self._limited[name] = mu, limit_to_friction(self._sumo, name, mu)

    def after_step(self) -> Mapping[str, Placed]:
        """Nobody is moved by position."""
        return {}

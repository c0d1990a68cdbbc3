"""The AV under test, chosen by name: a controller of ours or the user's, or one of SUMO's models."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sbt import plugins
from sbt.errors import InputError
from sbt.seeds import stream
from sbt.sumo.actors import Controller, VehicleType

__all__ = ["SUMO", "Ego"]

SUMO = "sumo"
"""The kind of ego that one of SUMO's own models drives."""


@dataclass(frozen=True)
class Ego:
    """Kind and settings of the AV under test.

    Args:
        kind: a controller by name or `file.py:NAME`, called as `NAME(rng, set_speed, **settings)`
            once a run; or `sumo`, driven by the car-following model `model` with vType attributes.
        settings: (name, value) pairs.

    Raises:
        InputError: unknown kind or settings (`Ego.of`).
    """

    kind: str = "acc_aeb"
    settings: tuple[tuple[str, Any], ...] = ()

    @classmethod
    def of(cls, kind: str = "acc_aeb", **settings: Any) -> Ego:
        """Return the ego of this kind, its settings tried out once."""
        ego = cls(kind, tuple(sorted(settings.items())))
        if kind != SUMO:
            driver = ego.driver(stream(0, "ego"), 1.0)
            if not callable(getattr(driver, "act", None)):
                raise InputError(f"ego.kind must name a controller with act(t, own, others), but '{kind}' has none")
        elif not all(isinstance(value, (str, int, float)) for value in settings.values()):
            raise InputError(f"ego settings of kind sumo must be vType attributes, but got {settings}")
        return ego

    @property
    def deterministic(self) -> bool:
        """Whether SUMO draws no random numbers for this ego."""
        return self.kind != SUMO

    def driver(self, rng: np.random.Generator, set_speed: float, **overrides: Any) -> Controller | None:
        """Return the controller of one run, None where SUMO drives.

        Args:
            rng: of the run.
            set_speed: the speed it starts with and would keep (m/s).
            overrides: settings that the scenario's inputs decide; they win.
        """
        if self.kind == SUMO:
            return None
        factory = plugins.load("controllers", self.kind)
        settings = {**dict(self.settings), **overrides}
        try:
            built: Controller = factory(rng, set_speed, **settings)
        except TypeError as error:
            raise InputError(f"ego settings must be ones that '{self.kind}' takes, but got {settings}: {error}") from None
        return built

    def vehicle_type(self, base: VehicleType, set_speed: float) -> VehicleType:
        """Return the SUMO type of the ego: `base`, with SUMO's model where that drives."""
        if self.kind != SUMO:
            return base
        given = {("carFollowModel" if k == "model" else k): str(v) for k, v in self.settings}
        wanted = {"maxSpeed": repr(set_speed), "decel": "4.5", "emergencyDecel": "9", "accel": "2.6", "minGap": "2.5"}
        return replace(base, attributes=tuple(sorted({**wanted, **dict(base.attributes), **given}.items())))

"""The AV under test, chosen by name: a controller of ours or the user's, or one of SUMO's models."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

import numpy as np

from sbt import plugins
from sbt.errors import InputError
from sbt.problem.parameter import Parameter
from sbt.seeds import stream
from sbt.sumo.actors import Controller, VehicleType
from sbt.sumo.formatting import format_number, plain
from sbt.sumo.models import unit_of, vtype_attributes

__all__ = ["SUMO", "Ego"]

SUMO = "sumo"
"""The kind of ego that one of SUMO's own models drives."""
_DEFAULTS = {"decel": "4.5", "emergencyDecel": "9", "accel": "2.6", "minGap": "2.5"}
_RANGE = ({"min", "max"}, {"min", "max", "unit"})


@dataclass(frozen=True)
class Ego:
    """Kind and settings of the AV under test.

    A setting that is a range, `{min: 0.5, max: 2.0}`, is an input of the scenario: `ego_` and its name.

    Args:
        kind: a controller by name or `file.py:NAME`, called as `NAME(rng, set_speed, **settings)`
            once a run; or `sumo`, driven by the car-following model `model` with vType attributes.
        settings: (name, value) pairs; a `Parameter` as value is such an input.

    Raises:
        InputError: unknown kind or settings (`Ego.of`).
    """

    kind: str = "acc_aeb"
    settings: tuple[tuple[str, Any], ...] = ()

    @classmethod
    def of(cls, kind: str = "acc_aeb", **settings: Any) -> Ego:
        """Return the ego of this kind, its settings tried out once, ranges at their centre."""
        ego = cls(kind, tuple((name, _setting(name, value)) for name, value in sorted(settings.items())))
        trial = ego.bound({p.name: p.centre for p in ego.inputs})
        if kind == SUMO:
            vtype_attributes(dict(trial.settings))
        elif not callable(getattr(trial.driver(stream(0, "ego"), 1.0), "act", None)):
            raise InputError(f"ego.kind must name a controller with act(t, own, others), but '{kind}' has none")
        return ego

    @property
    def deterministic(self) -> bool:
        """Whether SUMO draws no random numbers for this ego."""
        return self.kind != SUMO

    @property
    def lane_change(self) -> str:
        """SUMO's lane-change model that the settings choose, "" for a controller."""
        settings = dict(self.settings)
        return str(settings.get("lane_change", settings.get("laneChangeModel", "LC2013"))) if self.kind == SUMO else ""

    @property
    def inputs(self) -> tuple[Parameter, ...]:
        """The settings that are inputs of the scenario."""
        return tuple(value for _, value in self.settings if isinstance(value, Parameter))

    def bound(self, values: Mapping[str, float]) -> Ego:
        """Return the ego of one run: every setting that is an input has its value."""
        if not self.inputs:
            return self
        bound = ((name, values[value.name] if isinstance(value, Parameter) else value) for name, value in self.settings)
        return replace(self, settings=tuple(bound))

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
        """Return the SUMO type of the ego: `base`, with SUMO's models where they drive."""
        if self.kind != SUMO:
            return base
        given = vtype_attributes(dict(self.settings))
        length, width = float(given.pop("length", base.length)), float(given.pop("width", base.width))
        attributes = {"maxSpeed": format_number(set_speed), **_DEFAULTS, **dict(base.attributes), **given}
        return replace(base, length=length, width=width, attributes=tuple(sorted(attributes.items())))


def _setting(name: str, value: Any) -> Any:
    """Return a setting with its number plain, or the scenario input that a range such as `{min: 0.5, max: 2.0}` declares."""
    if not isinstance(value, Mapping):
        return plain(value)
    numbers = all(isinstance(value.get(key), Real) and not isinstance(value.get(key), bool) for key in ("min", "max"))
    if set(value) not in _RANGE or not numbers:
        raise InputError(f"ego.{name} must be a value or a range such as {{min: 0.5, max: 2.0}}, but got {dict(value)}")
    unit = str(value.get("unit", unit_of(name)))
    return Parameter(f"ego_{name}", float(value["min"]), float(value["max"]), unit, description=f"setting {name} of the ego")

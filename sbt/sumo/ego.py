"""The AV under test, configured by name: a built-in or user-defined controller, or one of SUMO's models."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

import numpy as np

from sbt import plugins
from sbt.errors import InputError, described
from sbt.problem.parameter import Parameter
from sbt.problem.plain import Values
from sbt.seeds import stream
from sbt.sumo.actors import Actor, Controller, VehicleType
from sbt.sumo.formatting import format_number, plain
from sbt.sumo.models import DEFAULT_LANE_CHANGE, unit_of, vtype_attributes

__all__ = ["SUMO", "Ego"]

SUMO = "sumo"
"""The kind of an ego that one of SUMO's models drives."""
_DEFAULTS = {"decel": "4.5", "emergencyDecel": "9", "accel": "2.6", "minGap": "2.5"}
_SIZE = ("length", "width")
_DECIDED_BEFORE = ("lane_change", "laneChangeModel")
_RANGE_KEYS = ({"min", "max"}, {"min", "max", "unit"})


@dataclass(frozen=True)
class Ego:
    """Kind and settings of the AV under test.

    A setting given as a range, such as `{min: 0.5, max: 2.0}`, or by choices, such as `{choices: [IDM, Krauss]}`, is an input of
    the scenario with the prefix `ego_`.

    Args:
        kind: a controller by name or `file.py:NAME`, constructed as `NAME(rng, set_speed, **settings)` once
            per run; or `sumo`, with the car-following model `model` and vType attributes as settings.
        settings: (name, value) pairs; inputs of the scenario have a `Parameter` as value.
    """

    kind: str = "acc_aeb"
    settings: tuple[tuple[str, Any], ...] = ()

    @classmethod
    def of(cls, kind: str = "acc_aeb", **settings: Any) -> Ego:
        """Return an ego of this kind; tries the settings, with ranges at their centre and each choice in turn.

        Raises:
            InputError: the kind is unknown, or its settings are.
        """
        ego = cls(kind, tuple((name, _setting(name, value)) for name, value in sorted(settings.items())))
        centre = {p.name: p.value(p.centre) for p in ego.inputs}
        for values in (centre, *({**centre, p.name: choice} for p in ego.inputs for choice in p.choices)):
            trial = ego.bind(values)
            if kind == SUMO:
                vtype_attributes(dict(trial.settings))
            elif not callable(getattr(trial.driver(stream(0, "ego"), 1.0), "act", None)):
                raise InputError(f"ego.kind must name a controller with act(t, own, others), but '{kind}' has none")
        return ego

    @property
    def deterministic(self) -> bool:
        """Whether SUMO draws no random numbers to drive this ego."""
        return self.kind != SUMO

    @property
    def lane_change(self) -> str:
        """The lane-change model of SUMO that the settings select; "" for a controller."""
        given = self._lane_change
        return "" if self.kind != SUMO else given if isinstance(given, str) else DEFAULT_LANE_CHANGE

    @property
    def _lane_change(self) -> str | bool | None:
        settings = dict(self.settings)
        given = settings.get("lane_change", settings.get("laneChangeModel"))
        return given if given is None or isinstance(given, bool) else str(given)

    def changes_lanes(self, *, usual: bool) -> bool:
        """Return whether SUMO may change lanes for this ego.

        Args:
            usual: whether it may in this scenario without a setting. `lane_change: true`, `false` or the name of a model decides.
        """
        if self.kind != SUMO or self._lane_change is None:
            return usual
        return self._lane_change is not False

    @property
    def inputs(self) -> tuple[Parameter, ...]:
        """The settings that are inputs of the scenario."""
        return tuple(value for _, value in self.settings if isinstance(value, Parameter))

    def bind(self, values: Values) -> Ego:
        """Return the ego of one run, with the values of the settings that are inputs."""
        if not self.inputs:
            return self
        settings = ((name, values[value.name] if isinstance(value, Parameter) else value) for name, value in self.settings)
        return replace(self, settings=tuple(settings))

    def driver(self, rng: np.random.Generator, set_speed: float, **overrides: Any) -> Controller | None:
        """Return the controller of one run; None where SUMO drives.

        Args:
            rng: random generator of the run.
            set_speed: initial and desired speed (m/s).
            overrides: settings that the scenario determines; they take precedence. A controller that is `complete`, such as
                a reference driver, takes none of them.

        Raises:
            InputError: the controller does not take the settings.
        """
        if self.kind == SUMO:
            return None
        factory = plugins.load("controllers", self.kind)
        settings = {**dict(self.settings), **({} if getattr(factory, "complete", False) else overrides)}
        try:
            built: Controller = factory(rng, set_speed, **settings)
        except TypeError as error:
            raise InputError(f"ego settings must be ones that '{self.kind}' takes, but got {settings}: {error}") from None
        except Exception as error:
            rule = f"ego.kind '{self.kind}' must be constructed with {settings}"
            raise InputError(f"{rule}, but it raised {described(error)}") from None
        return built

    def vehicle_type(self, base: VehicleType, set_speed: float) -> VehicleType:
        """Return the vehicle type of the ego: `base`, extended by the models where SUMO drives."""
        if self.kind != SUMO:
            return base
        given = vtype_attributes(dict(self.settings))
        length, width = float(given.pop("length", base.length)), float(given.pop("width", base.width))
        attributes = {"maxSpeed": format_number(set_speed), **_DEFAULTS, **dict(base.attributes), **given}
        return replace(base, length=length, width=width, attributes=tuple(sorted(attributes.items())))


    def check_driven(self, actor: Actor) -> None:
        """Refuse an actor that leaves settings of SUMO's model out: without the vehicle type they would do nothing.

        Raises:
            InputError: its type has not all that the settings give.
        """
        if self.kind != SUMO or not self.settings:
            return
        given, there = vtype_attributes(dict(self.settings)), {*_SIZE, *dict(actor.type.attributes)}
        lacking = [name for name in given if name not in there] if actor.driver is None else list(given)
        if lacking:
            rule = "the scene must give the ego ego.driver(rng, set_speed) and the type ego.vehicle_type(base, set_speed)"
            raise InputError(f"{rule}, or settings of ego do nothing, but {actor.name} lacks {', '.join(lacking)}")


def _setting(name: str, value: Any) -> Any:
    """Return a setting: a plain number, or the scenario input that a range, or `{choices: [IDM, Krauss]}`, declares."""
    if not isinstance(value, Mapping):
        return plain(value)
    if set(value) == {"choices"}:
        if name in _DECIDED_BEFORE:
            raise InputError(f"ego.{name} must be one value, as it decides how SUMO is started, but got choices")
        return Parameter(f"ego_{name}", kind="categorical", choices=value["choices"], description=f"setting {name} of the ego")
    numbers = all(isinstance(value.get(key), Real) and not isinstance(value.get(key), bool) for key in ("min", "max"))
    if set(value) not in _RANGE_KEYS or not numbers:
        rule = "a value, a range such as {min: 0.5, max: 2.0}, or {choices: [a, b]}"
        raise InputError(f"ego.{name} must be {rule}, but got {dict(value)}")
    unit = str(value.get("unit", unit_of(name)))
    return Parameter(f"ego_{name}", float(value["min"]), float(value["max"]), unit, description=f"setting {name} of the ego")

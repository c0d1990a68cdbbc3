"""The keys of `simulation` in a configuration."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

__all__ = ["FrictionRange", "SimulationChoice"]


class _Strict(BaseModel):
    """Frozen; unknown keys are errors; a string is no number and a boolean no integer."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


def _same_ends(value: Any) -> Any:
    """Return a range for a number."""
    return {"min": value, "max": value} if isinstance(value, int | float) and not isinstance(value, bool) else value


class FrictionRange(_Strict):
    """Friction as an input."""

    min: float = Field(gt=0, allow_inf_nan=False, description="Lower end.")
    max: float = Field(gt=0, allow_inf_nan=False, description="Upper end.")


class SimulationChoice(_Strict):
    """How SUMO simulates."""

    friction: Annotated[FrictionRange, BeforeValidator(_same_ends)] | None = Field(
        default=None, description="Of the roads, or {min, max} as an input: bounds accelerations by mu g; null: no bound."
    )

    step_length: float | None = Field(default=None, gt=0, allow_inf_nan=False, description="Step (s); null: the scenario's own.")

"""The keys of `fidelity` in a configuration: cheaper runs of the same scenario, which teach."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

__all__ = ["FidelityChoice"]

_Step = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class FidelityChoice(BaseModel):
    """A second level of fidelity."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    step_length: Annotated[tuple[_Step, _Step], Field(strict=False)] | None = Field(
        default=None, description="[fine, coarse] steps (s): the smaller is the scenario's own, the other a multiple of it."
    )
    scenario: Annotated[str, Field(min_length=1)] | None = Field(
        default=None, description="Or a coarser scenario of one's own, with the same inputs and metrics."
    )
    cost: Annotated[float, Field(gt=0, lt=1)] | Literal["auto"] = Field(
        default="auto", description="Of a coarse run, in runs; auto: CPU time, measured when the campaign begins, rounded."
    )

    @field_validator("cost", mode="before")
    @classmethod
    def _cost_of_a_run(cls, value: object) -> object:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if value != "auto" and not (number and 0.0 < float(str(value)) < 1.0):
            raise ValueError(f"must be auto, or between 0 and 1 run (without the ends), but got {value!r}")
        return value

    @model_validator(mode="after")
    def _one_of_two(self) -> FidelityChoice:
        if (self.step_length is None) == (self.scenario is None):
            got = "neither" if self.scenario is None else "both"
            raise ValueError(f"must have step_length: [fine, coarse] or a coarser scenario, but got {got}")
        if self.step_length is not None and self.fine == self.coarse:
            raise ValueError(f"step_length must be two different steps, but got {self.fine:g} s twice")
        if self.coarse is not None and self.fine is not None:
            times = self.coarse / self.fine
            if abs(times - round(times)) > 1e-9:
                rule = "the coarse step must be a multiple of the fine one"
                raise ValueError(f"{rule}, but {self.coarse:g} s is {times:g} times {self.fine:g} s")
        return self

    @property
    def fine(self) -> float | None:
        """The smaller step (s); None where a scenario is given."""
        return None if self.step_length is None else min(self.step_length)

    @property
    def coarse(self) -> float | None:
        """The larger step (s); None where a scenario is given."""
        return None if self.step_length is None else max(self.step_length)

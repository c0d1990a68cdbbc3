"""The keys of `requirement`, in a configuration and in a scenario of one's own: one metric, a formula, or several of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, WithJsonSchema, model_validator

from sbt.problem.combination import KINDS
from sbt.problem.requirement import CriticalInterval

__all__ = [
    "MOST", "MOST_RUNS", "Interval", "Name", "RequirementChange", "RequirementItem", "check_numbers", "each_once", "two_values",
]  # fmt: skip

MOST_RUNS = 10**7
"""Most runs that any key may ask for: what is larger is a slip of the pen, and would take all memory or time."""
MOST = 100
"""Most entries of a list whose every entry costs something before the first run."""


def each_once(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return names; refuse one that is given twice."""
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ValueError(f"each must be named once, but got '{twice}' again")
    return names


def check_numbers(settings: Mapping[str, Any]) -> None:
    """Refuse at once what no setting of a metamodel can be; itself it knows more, but its library takes seconds to load."""
    for key, value in settings.items():
        if isinstance(value, int | float) and abs(value) > MOST_RUNS:
            raise ValueError(f"{key} must be within {MOST_RUNS}, but got {value}")


def two_values(value: Any) -> Any:
    """Return a list of two values; refuse anything else."""
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise ValueError(f"must be a list of two values, but got {value!r}")
    return value


def _not_blank(text: str) -> str:
    if not text.strip():
        raise ValueError("must not be empty")
    if len(text) > 4096 or not text.isprintable():
        shown = ascii(text if len(text) <= 60 else f"{text[:57]}...")
        raise ValueError(f"must be text of at most 4096 printable characters, but got {len(text)} of them: {shown}")
    return text


def _open_ends(value: Any) -> Any:
    """Return an interval with infinite ends for those that are null."""
    ends = two_values(value)
    return tuple(end if given is None else given for given, end in zip(ends, (-math.inf, math.inf), strict=True))


def _proper(value: tuple[float, float]) -> tuple[float, float]:
    CriticalInterval(*value)
    return value


Name = Annotated[str, AfterValidator(_not_blank)]
Interval = Annotated[tuple[float, float], BeforeValidator(two_values), Field(strict=False)]
_END = {"type": ["number", "null"]}
Critical = Annotated[
    tuple[float, float], BeforeValidator(_open_ends), AfterValidator(_proper), Field(strict=False),
    WithJsonSchema({"type": "array", "prefixItems": [_END, _END], "minItems": 2, "maxItems": 2}),
]  # fmt: skip


class RequirementChange(BaseModel):
    """Changes the scenario's own requirement."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    metric: Name | None = Field(default=None, description="Safety metric; null: the scenario's own.")
    critical: Critical | None = Field(
        default=None,
        description="Critical values [low, high], closed; an end may be null, -.inf or .inf; null: the own.",
    )
    stl: Name | None = Field(
        default=None, description="A formula such as G[0,20](gap > 2 and ttc > 1.5) instead of a metric; its robustness is "
        "the metric stl, critical in [-.inf, 0].",
    )  # fmt: skip
    any: Annotated[tuple[RequirementItem, ...], Field(strict=False, max_length=MOST)] | None = Field(
        default=None, description="Requirements, of which any one being violated is critical."
    )
    all: Annotated[tuple[RequirementItem, ...], Field(strict=False, max_length=MOST)] | None = Field(
        default=None, description="Requirements that are critical only where all are violated in the same run."
    )

    @model_validator(mode="after")
    def _one_kind(self) -> RequirementChange:
        """Refuse more than one of a metric, a formula and a combination, and a combination of nothing."""
        given = [key for key in ("metric", "stl", *KINDS) if getattr(self, key) is not None]
        if given == ["metric", "stl"]:
            raise ValueError(f"a requirement has a metric or a formula (stl), not both, but got metric {self.metric}")
        if len(given) > 1:
            raise ValueError(f"a requirement has one of metric, stl, any and all, but got {' and '.join(given)}")
        if given and given[0] in KINDS and self.critical is not None:
            raise ValueError(f"critical belongs to each requirement of {given[0]}, but stands beside it")
        if given and given[0] in KINDS and not getattr(self, given[0]):
            raise ValueError(f"{given[0]} must list at least one requirement, but is empty")
        return self

    @property
    def combined(self) -> tuple[str, tuple[RequirementItem, ...]] | None:
        """How several are combined, and which; None where there is one."""
        return next(((how, found) for how in KINDS if (found := getattr(self, how)) is not None), None)

    @property
    def formulas(self) -> tuple[tuple[str, str], ...]:
        """The formulas of a combination: the metric that measures each, and the text."""
        items = () if self.combined is None else self.combined[1]
        return tuple(
            pair for item in items for pair in (((item.name or "stl", item.stl),) if item.stl is not None else item.formulas)
        )


    @property
    def decisive(self) -> tuple[tuple[str, tuple[float, float] | None], ...]:
        """The metrics that decide ("": the scenario's own) with their critical intervals (None: its own); none: all its own."""
        if self.combined is not None:
            return tuple(pair for item in self.combined[1] for pair in item.decisive)
        if self.stl is not None:
            return ((getattr(self, "name", None) or "stl", self.critical or (-math.inf, 0.0)),)
        return () if self.metric is None and self.critical is None else ((self.metric or "", self.critical),)


class RequirementItem(RequirementChange):
    """One of several requirements."""

    name: Name | None = Field(default=None, description="What it is called in results; default: its metric, of a formula stl.")


RequirementChange.model_rebuild()

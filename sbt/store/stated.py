"""What a folder with recorded rows states in `config.yml` beside the layout of the public data set: what is critical."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from sbt.errors import InputError
from sbt.problem.combination import KINDS, CombinedRequirement
from sbt.problem.plain import Json
from sbt.problem.requirement import Requirement

__all__ = ["stated_requirement", "written_requirement"]

_INFINITE = (-math.inf, math.inf)


def written_requirement(requirement: Requirement) -> Json:
    """Return a requirement as a configuration writes it, which `stated_requirement` reads.

    >>> written_requirement(Requirement("ttc_min", high=1.0))
    {'metric': 'ttc_min', 'critical': [None, 1.0]}
    """
    named: Json = {"name": requirement.name} if requirement.name else {}
    if isinstance(requirement, CombinedRequirement):
        return {requirement.how: [written_requirement(item) for item in requirement.items], **named}
    ends = [end if math.isfinite(end) else None for end in (requirement.low, requirement.high)]
    return {"metric": requirement.metric, "critical": ends, **named}


def stated_requirement(stated: object, metrics: Collection[str], path: Path) -> Requirement:
    """Return the requirement that a file states.

    Args:
        stated: under its key `requirement`.
        metrics: that are recorded.
        path: of the file, for messages.

    Raises:
        InputError: it is none, or one on another metric.
    """
    try:
        return _stated(stated, metrics)
    except InputError as error:
        raise InputError(f"{path}: requirement: {error}") from None


def _stated(stated: object, metrics: Collection[str]) -> Requirement:
    rule = "must be {metric: NAME, critical: [low, high]}, or {any: [...]} or {all: [...]} of such"
    if not isinstance(stated, Mapping):
        raise InputError(f"{rule}, but got {stated!r}")
    name = str(stated.get("name", ""))
    for how in KINDS:
        if isinstance(stated.get(how), list):
            return CombinedRequirement(how=how, items=tuple(_stated(item, metrics) for item in stated[how]), name=name)
    ends, metric = stated.get("critical"), stated.get("metric")
    if not isinstance(metric, str) or not isinstance(ends, list) or len(ends) != 2 or not all(map(_is_end, ends)):
        raise InputError(f"{rule}, but got {dict(stated)}")
    if metric not in metrics:
        raise InputError(f"metric must be one of {', '.join(metrics)}, but got '{metric}'")
    low, high = (infinite if end is None else float(end) for end, infinite in zip(ends, _INFINITE, strict=True))
    return Requirement(metric, low, high, name)


def _is_end(value: Any) -> bool:
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool))

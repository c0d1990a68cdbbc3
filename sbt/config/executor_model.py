"""The keys of `executor` in a configuration: where runs are executed, and within which limits."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationInfo, field_validator

from sbt.config.requirement_model import MOST_RUNS, Name
from sbt.errors import did_you_mean

__all__ = ["EXECUTORS", "ExecutorChoice", "Folder"]

EXECUTORS = ("serial", "local", "dask")
"""Where runs can be executed."""
_UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12, "KI": 2**10, "MI": 2**20, "GI": 2**30, "TI": 2**40}


def _one_of(choices: tuple[str, ...]) -> Callable[[str], str]:
    """Return a check for these values."""

    def check(value: str) -> str:
        if value in choices:
            return value
        raise ValueError(f"must be {' or '.join(choices)}, but got '{value}'{did_you_mean(value, choices)}")

    return check


def _bytes_of(value: Any) -> Any:
    """Return bytes for a text such as 2 GiB.

    Raises:
        ValueError: the text is none.
    """
    if not isinstance(value, str):
        return value
    match = re.fullmatch(r"\s*([0-9]{1,6}(?:\.[0-9]{1,6})?)\s*([KMGT]?I?)B\s*", value, re.IGNORECASE)
    if match is None or match[2].upper() not in _UNITS:
        raise ValueError(f"must be bytes such as 2 GiB, 1.5 GB or 800 MB, but got '{value}'")
    return int(float(match[1]) * _UNITS[match[2].upper()])


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


Folder = Annotated[Name, AfterValidator(os.path.expanduser)]
"""A folder of the user's; ~ is the home."""
ExecutorName = Annotated[str, AfterValidator(_one_of(EXECUTORS)), Field(json_schema_extra={"enum": [*EXECUTORS]})]


class _Strict(BaseModel):
    """Frozen; unknown keys are errors; a string is no number and a boolean no integer."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class ExecutorChoice(_Strict):
    """Where runs are executed; never changes their results."""

    kind: ExecutorName = Field(
        default="local", description="serial: in this process; local: worker processes; dask: workers of a dask cluster."
    )
    workers: int = Field(
        default_factory=_cores, le=4096, ge=1,
        description="Worker processes of local, and of dask without an address; default: the usable cores.",
    )  # fmt: skip
    address: Name | None = Field(
        default=None, description="Of dask's scheduler, such as tcp://host:8786; null: dask workers on this machine."
    )
    timeout: float = Field(default=60.0, gt=0, description="Wall-clock time (s) after which a run is stopped; .inf: never.")
    memory: Annotated[int, Field(ge=2**28, le=2**60), BeforeValidator(_bytes_of)] | None = Field(
        default=None,
        description="Memory (such as 2 GiB) that a worker may use, at least 256 MiB; a run that needs more is crashed. "
        "null: no limit.",
    )  # fmt: skip
    recycle: int | None = Field(
        default=None, ge=1, le=MOST_RUNS, description="Runs after which a worker is replaced by a fresh one; null: never."
    )
    isolation: Literal["auto", "fresh", "reuse", "replicas", "snapshot"] = Field(
        default="auto",
        description="SUMO is loaded per run (fresh), kept (reuse, replicas), or its traffic warmed up once (snapshot); auto: the "
        "fastest allowed, snapshot where that spares much.",
    )

    @field_validator("memory", "recycle")
    @classmethod
    def _of_workers(cls, value: int | None, info: ValidationInfo) -> int | None:
        if value is not None and info.data.get("kind") == "serial":
            raise ValueError("worker processes have it, but the executor is serial")
        return value

    @field_validator("address")
    @classmethod
    def _of_dask(cls, value: str | None, info: ValidationInfo) -> str | None:
        if value is not None and info.data.get("kind", "dask") != "dask":
            raise ValueError(f"only the executor dask takes it, but the executor is {info.data['kind']}")
        if value is not None and "://" not in value:
            raise ValueError(f"must be a scheduler's address such as tcp://host:8786, but got '{value}'")
        return value

"""Typed records of what is in the log: frozen dataclasses to plain JSON and back."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, TypeVar

from sbt.errors import StoreError
from sbt.problem.plain import Json, JsonMapping

__all__ = [
    "FitRecord", "Independence", "Iteration", "Judgement", "RequirementFit", "Validation", "from_json", "optional", "to_json",
]  # fmt: skip

T = TypeVar("T")


def optional(default: Any = None) -> Any:
    """Return a dataclass field that is left out of the JSON while it is None."""
    return field(default=default, metadata={"optional": True})


def to_json(record: Any) -> Any:
    """Return a dataclass as plain JSON data; NaN and infinity become null, as they are in no JSON."""
    if dataclasses.is_dataclass(record) and not isinstance(record, type):
        pairs = ((f, getattr(record, f.name)) for f in dataclasses.fields(record))
        return {f.name: to_json(v) for f, v in pairs if not (v is None and f.metadata.get("optional"))}
    if isinstance(record, Mapping):
        return {str(key): to_json(value) for key, value in record.items()}
    if isinstance(record, list | tuple):
        return [to_json(value) for value in record]
    if hasattr(record, "tolist"):  # an array or a scalar of NumPy
        return to_json(record.tolist())
    return None if isinstance(record, float) and not math.isfinite(record) else record


def from_json(kind: type[T], data: Any) -> T:
    """Return a dataclass from its JSON data; keys that it does not know are passed over.

    Raises:
        StoreError: the data are those of something else.
    """
    try:
        found: T = _adapter(kind).validate_python(data)  # type: ignore[arg-type]
    except ValueError as error:
        first = str(error).splitlines()[1:3]
        raise StoreError(f"a record of the log must be a {kind.__name__}, but is not: {' '.join(first)}") from error
    return found


@cache
def _adapter(kind: Any) -> Any:
    from pydantic import TypeAdapter

    return TypeAdapter(kind)


@dataclass(frozen=True)
class Validation:
    """Scores of a metamodel on runs that it had not seen; None where the runs do not tell.

    Attributes:
        log_likelihood, likelihood: of the moment-matched Gaussian, mean over runs (the paper's yardstick).
        log_likelihood_mixture: of the whole mixture.
        rmse, crps: in the metric's unit.
        log_likelihood_critical, rmse_critical: on the critical runs alone.
        average_precision, precision_at_recall_90, f1: of finding critical runs by P(critical).
        calibration_error: mean |P(critical) - frequency| over ten bins.
        coverage_95: share of the runs in their 95 % interval.
        base_rate: share of critical runs.
        error_rate: share on the wrong side of P = 0.5.
        n, n_critical: runs, and critical ones among them.
    """

    log_likelihood: float | None = None
    likelihood: float | None = None
    log_likelihood_mixture: float | None = None
    rmse: float | None = None
    crps: float | None = None
    log_likelihood_critical: float | None = None
    rmse_critical: float | None = None
    average_precision: float | None = None
    precision_at_recall_90: float | None = None
    f1: float | None = None
    calibration_error: float | None = None
    coverage_95: float | None = None
    base_rate: float | None = None
    error_rate: float | None = None
    n: int = 0
    n_critical: int = 0

    def to_dict(self) -> Json:
        """Return the scores by name."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class RequirementFit:
    """One requirement of a combination as its own metamodel sees it.

    Attributes:
        name: of the requirement.
        critical_fraction: mean P(it is violated) over the points of `FitRecord`.
        validation: scores of its metamodel on runs it had not seen, in the unit of its metric.
        weights, chosen_because: as in `FitRecord`.
    """

    name: str
    critical_fraction: float
    validation: Validation | None = None
    weights: Mapping[str, float] | None = optional()
    chosen_because: str | None = optional()


@dataclass(frozen=True)
class Independence:
    """Whether the metrics of a combination are independent given the inputs, as its P(critical) takes them to be.

    Attributes:
        between: the two requirements whose residuals correlate most.
        correlation: of the ranks of their residuals on runs that no metamodel had seen; 0 where they are independent.
        runs: of which it was taken.
        together: whether both are critical at once more often than it states; None: a critical interval has two ends.
        pairs: of requirements, of which this one was chosen; None: there is but one.
    """

    between: tuple[str, str]
    correlation: float
    runs: int
    together: bool | None = optional()
    pairs: int | None = optional()


@dataclass(frozen=True)
class FitRecord:
    """What the log keeps of a fitted metamodel.

    Attributes:
        learned: runs that it learned from.
        critical_fraction: mean P(critical) over 4,096 fixed Sobol points of the space, weighted by P(a run gives a metric).
        expected_misclassified: mean of min(P, 1 - P) there.
        ambiguous_volume: share of them with P between 0.05 and 0.95.
        sides: their classification, as hexadecimal bits.
        validation: scores on runs it had not seen; None without such runs.
        weights: of a metamodel that mixes others, the share of each.
        chosen_because: and why.
        fit_seconds, scoring_seconds: in benchmarks only.
        failing_fraction: mean P(a run gives no metric) over the points; None: all runs gave one.
        requirements: of a combination, each of them; its own scores are those of the margin.
        independence: of their metrics.
        earlier: runs of an earlier campaign that it learned from, too; 0: they do not help; None: there are none.
        over_traffic: mean P(critical) over the traffic that seeds draw, at fixed points, as hexadecimal text; None: traffic was
            not looked at, or tells nothing.
        runs, iteration: of the campaign when it was fitted.
    """

    learned: int
    critical_fraction: float
    expected_misclassified: float
    ambiguous_volume: float
    sides: str
    validation: Validation | None = None
    weights: Mapping[str, float] | None = optional()
    chosen_because: str | None = optional()
    fit_seconds: float | None = optional()
    scoring_seconds: float | None = optional()
    failing_fraction: float | None = optional()
    requirements: tuple[RequirementFit, ...] | None = optional()
    independence: Independence | None = optional()
    earlier: int | None = optional()
    over_traffic: str | None = optional()
    runs: int = 0
    iteration: int = 0

    def score(self, name: str) -> float | int | None:
        """Return one of the scores of `Validation`; None where it is not known."""
        return getattr(self.validation, name, None)


@dataclass(frozen=True)
class Iteration:
    """A batch in the log.

    Attributes:
        number: from 0.
        stage: what asked for it.
        proposal: how it was chosen: the JSON of the stage's own record.
    """

    number: int
    stage: str
    proposal: JsonMapping
    _records: dict[type, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def read(self, kind: type[T]) -> T:
        """Return how it was chosen as the stage's own record; made once, as stages read all batches before each one."""
        found: T | None = self._records.get(kind)
        if found is None:
            found = self._records[kind] = from_json(kind, self.proposal)
        return found


@dataclass(frozen=True)
class Judgement:
    """What a reference driver in the place of the ego made of a run: the same inputs, the same seed.

    Attributes:
        run: index of the run that is judged.
        driver: which one.
        avoided: the requirement holds with it; None: it cannot judge the run.
        collision: it has a collision; None where it cannot judge.
        metric: the requirement's metric with it; None where there is none.
        reason: why it cannot judge; "" where it can.
    """

    run: int
    driver: str
    avoided: bool | None
    collision: bool | None = None
    metric: float | None = None
    reason: str = ""

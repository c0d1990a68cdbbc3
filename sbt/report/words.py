"""What a campaign found, in plain sentences, and what a reader must not conclude from it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sbt.estimators.binomial import interval, upper
from sbt.problem.distribution import Distribution
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.store.database import Store
from sbt.store.history import PLANNED, VALIDATION, History

__all__ = [
    "NOTHING",
    "SCORES",
    "Findings",
    "conclusion_sentences",
    "law_words",
    "number",
    "requirement_words",
    "share",
    "warnings_for",
]

NOTHING = "\N{EN DASH}"
"""Stands where there is no value."""
SCORES: Mapping[str, str] = {
    "log_likelihood": "log likelihood",
    "log_likelihood_critical": "log likelihood, critical runs",
    "rmse": "RMSE",
    "average_precision": "average precision",
    "precision_at_recall_90": "precision at 90 % recall",
    "calibration_error": "calibration error",
}
"""Keys of a fit, as written for people."""
_FEW_CRITICAL = 10
_POOR_CALIBRATION = 0.1


@dataclass(frozen=True)
class Findings:
    """What the sentences are about: the rows, the requirement, and what the campaign concluded.

    Args:
        history: finished runs.
        requirement: metric and critical interval.
        unit: of the metric.
        configuration: resolved.
        conclusion: as `run --json` prints it, empty while the campaign goes on.
        scores: of the last metamodel on held-out runs, empty where there is none.
        planned: runs without an outcome.
        direction: "low" where small values of the metric are bad, "high" where large ones are.
    """

    history: History
    requirement: Requirement
    unit: str
    configuration: Mapping[str, Any]
    conclusion: Mapping[str, Any]
    scores: Mapping[str, Any]
    planned: int
    direction: str = "low"

    @classmethod
    def of(cls, store: Store, scenario: LogicalScenario) -> Findings:
        """Return the findings of a store, at whatever point of the campaign."""
        metric = {metric.name: metric for metric in scenario.metrics}.get(scenario.requirement.metric)
        conclusion, fits = store.conclusion or {}, store.fits()
        scores = _result(conclusion).get("validation") or (fits[-1] if fits else {})
        return cls(
            store.history(), scenario.requirement, metric.unit if metric is not None else "", store.configuration,
            conclusion, scores, store.counts.get(PLANNED, 0), metric.direction if metric is not None else "low",
        )  # fmt: skip

    @property
    def critical(self) -> Any:
        """(n,) the run violates the requirement."""
        return self.requirement.critical.contains(self.history.y(self.requirement.metric))

    @property
    def held_out(self) -> Any:
        """(n,) the run gave metrics and no metamodel learned from it."""
        return self.history.ok & (self.history.stage == VALIDATION)

    @property
    def result(self) -> Mapping[str, Any]:
        """What the campaign concluded, by its kind."""
        return _result(self.conclusion)


def _result(conclusion: Mapping[str, Any]) -> Mapping[str, Any]:
    inner = conclusion.get("conclusion", conclusion)
    return inner if isinstance(inner, Mapping) else {}


def number(value: Any, digits: int = 4) -> str:
    """Return a number for people; a dash where there is none.

    >>> number(0.123456), number(None), number(1234567.0)
    ('0.1235', '–', '1.235e+06')
    """
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return NOTHING
    if isinstance(value, (bool, str)):
        return str(value)
    return f"{value:,}" if isinstance(value, int) else f"{value:.{digits}g}"


def share(value: float) -> str:
    """Return a share as percentage; the space before the sign does not break.

    >>> share(0.0123) == "1.23\N{NO-BREAK SPACE}%"
    True
    """
    return f"{100 * value:.3g}\N{NO-BREAK SPACE}%"


def shares_in_words(weights: Mapping[str, float]) -> str:
    """Return how much of a mixture each part is, the largest first.

    >>> shares_in_words({"gp": 0.25, "et": 0.75, "ensemble": 0.0}).replace("\N{NO-BREAK SPACE}", " ")
    '75 % et, 25 % gp'
    """
    kept = sorted(((-weight, name) for name, weight in weights.items() if weight > 0.0))
    return ", ".join(f"{100 * -weight:.0f}\N{NO-BREAK SPACE}% {name}" for weight, name in kept)


def requirement_words(requirement: Requirement, unit: str) -> str:
    """Return when a run is critical."""
    low, high, name, tail = (
        requirement.critical.low,
        requirement.critical.high,
        requirement.metric,
        f" {unit}" if unit else "",
    )
    if math.isinf(low):
        return f"{name} ≤ {high:g}{tail}"
    if math.isinf(high):
        return f"{name} ≥ {low:g}{tail}"
    return f"{name} in [{low:g}, {high:g}]{tail}"


def law_words(law: Distribution | None) -> str:
    """Return a distribution as its kind and parameters."""
    if law is None or law.kind == "uniform":
        return "uniform"
    parameters = ", ".join(f"{name} {value if isinstance(value, str) else format(value, 'g')}" for name, value in law.parameters)
    return f"{law.kind} ({parameters})" if parameters else law.kind


def conclusion_sentences(found: Findings) -> list[str]:
    """Return what the campaign found, the most important first."""
    ok, critical = int(found.history.ok.sum()), int(found.critical.sum())
    said = [*_estimation(found.result), *_falsification(found.result), *_fraction(found)]
    if ok:
        said.append(f"{critical:,} of {ok:,} runs were critical.{_not_a_share(found)}")
    else:
        said.append("No run has given a metric yet.")
    if found.conclusion.get("stopped"):
        said.append(f"The campaign ended because: {found.conclusion['stopped']}.")
    return said


def _not_a_share(found: Findings) -> str:
    adaptive = set(found.history.stage.tolist()) - {VALIDATION}
    if found.configuration.get("campaign") == "coverage" or not adaptive:
        return ""
    return " Runs are chosen, not drawn at random, so this share is no estimate of their probability."


def _estimation(result: Mapping[str, Any]) -> list[str]:
    """Return the probability with its interval, or the bound where nothing was critical."""
    if result.get("exact_bound") is not None:
        sure = share(result.get("confidence") or 0.95)
        bound = number(result["exact_bound"])
        told = f"No critical run was drawn: with {sure} confidence, the probability of one is at most {bound}."
        return [told, *_verdict(result)]
    if result.get("probability") is None:
        return _verdict(result)
    confidence = share(result.get("confidence") or 0.95)
    said = [
        f"Probability of a critical run under the inputs' distribution: {number(result['probability'])}"
        f" ({confidence} interval {number(result.get('low'))} to {number(result.get('high'))})."
    ]
    details = {
        "coefficient of variation": "cov",
        "effective sample size": "effective_sample_size",
        "hits": "hits",
    }
    given = [f"{name} {number(result[key], 3)}" for name, key in details.items() if result.get(key) is not None]
    if given:
        said.append(f"Behind it: {', '.join(given)}.")
    if result.get("failed_as_critical") not in (None, result["probability"]):
        said.append(f"If every failed run were critical, it would be {number(result['failed_as_critical'])}.")
    if result.get("undetected_mass_bound") is not None:
        said.append(f"A critical region that no run has met may hold up to {number(result['undetected_mass_bound'], 3)} more.")
    return [*said, *_verdict(result)]


def _verdict(result: Mapping[str, Any]) -> list[str]:
    """Return what the gate says, where there is one."""
    gate = result.get("gate")
    return [] if gate is None else [f"Gate: {gate['verdict']}; {gate['statement']}."]


def _falsification(result: Mapping[str, Any]) -> list[str]:
    """Return whether the requirement is falsified, and the campaign's own statement."""
    if "first_critical_run" not in result:
        return []
    said = [str(result["statement"])] if result.get("statement") else []
    if result["first_critical_run"] is None:
        return ["The requirement was not falsified: no critical run was found.", *said]
    modes = result.get("failure_modes")
    count = len(modes) if isinstance(modes, (list, tuple, dict)) else modes
    tail = f"; {count} distinct failure mode{'s' if count != 1 else ''}" if count is not None else ""
    return [f"The requirement is falsified: the first critical run is number {result['first_critical_run']}{tail}.", *said]


def _fraction(found: Findings) -> list[str]:
    """Return the share of the parameter space that is critical: as measured, then as the metamodel sees it."""
    result, said = found.result, []
    measured = result if result.get("low") is not None else result.get("held_out_fraction")
    if measured is None:
        measured = _held_out_fraction(found)
    if measured.get("critical_fraction") is not None and measured.get("low") is not None:
        counted = f", from {measured['counted']:,} runs spread over it" if measured.get("counted") else ""
        said.append(
            f"Critical share of the parameter space: {share(measured['critical_fraction'])}"
            f" ({share(measured.get('confidence') or 0.95)} interval {share(measured['low'])} to"
            f" {share(measured['high'])}){counted}."
        )
    if measured is not result and result.get("critical_fraction") is not None:
        said.append(f"The metamodel takes {share(result['critical_fraction'])} of the parameter space to be critical.")
    if result.get("believed"):
        said.append(f"What the metamodel chose to believe: {result['believed']}.")
    return said


def _held_out_fraction(found: Findings) -> dict[str, Any]:
    """Return the share of critical runs among the held-out ones, which are uniform in the ranges.

    Failed runs count as uncritical for the low end and as critical for the high end.
    """
    n, ok = int((found.history.stage == VALIDATION).sum()), int(found.held_out.sum())
    if ok == 0:
        return {}
    hits = int((found.held_out & found.critical).sum())
    low, high = float(interval(hits, n)[0]), float(interval(hits + n - ok, n)[1])
    return {"critical_fraction": hits / ok, "low": low, "high": high, "counted": n}


def warnings_for(found: Findings) -> list[str]:
    """Return what limits the conclusion, in plain words; empty where nothing does."""
    return [
        *_about_progress(found),
        *_about_runs(found),
        *_about_scores(found),
        *map(str, found.result.get("warnings") or []),
    ]


def _about_progress(found: Findings) -> list[str]:
    if found.conclusion and not found.planned:
        return []
    done, budget = len(found.history), found.configuration.get("budget")
    reference = (found.configuration.get("validation") or {}).get("reference") or 0
    of = f" of {budget + reference:,}" if isinstance(budget, int) else ""
    waiting = f", {found.planned:,} more are planned" if found.planned else ""
    return [f"The campaign has not concluded: {done:,}{of} runs are done{waiting}. What follows may still change."]


def _about_runs(found: Findings) -> list[str]:
    history = found.history
    said: list[str] = []
    failed = history.where(~history.ok).records
    if failed:
        reason, times = Counter(record.reason or record.status for record in failed).most_common(1)[0]
        said.append(
            f"{len(failed):,} of {len(history):,} runs failed ({share(len(failed) / len(history))}) and tell nothing"
            f" about safety. Most frequent reason ({times:,} times): {reason[:200]}"
        )
    said += _about_far_side(found)
    if history.ok.any() and not found.critical.any():
        n = int(found.held_out.sum())
        most = share(float(upper(0, n, 0.95)))
        bound = f" From the {n:,} random held-out runs alone, up to {most} may be critical (95 %)." if n else ""
        said.append(f"No critical run was found. That is no proof that there is none.{bound}")
    if len({record.versions for record in history.records}) > 1:
        said.append("Runs were made with different versions of the software; see the header.")
    return said


def _about_far_side(found: Findings) -> list[str]:
    """Return how many runs are worse than the bad end of the critical interval, and so count as uncritical."""
    y, critical, name = found.history.y(found.requirement.metric), found.requirement.critical, found.requirement.metric
    high = found.direction == "high"
    n, end = int((y > critical.high).sum() if high else (y < critical.low).sum()), critical.high if high else critical.low
    if n == 0:
        return []
    runs = "1 run has" if n == 1 else f"{n:,} runs have"
    side, tail = "above" if high else "below", f" {found.unit}" if found.unit else ""
    return [f"{runs} {name} {side} {end:g}{tail}, beyond the critical interval, and count as uncritical. Is that meant?"]


def _about_scores(found: Findings) -> list[str]:
    scores = found.scores
    said: list[str] = []
    if not scores:
        return said
    n, critical, error = scores.get("n"), scores.get("n_critical"), scores.get("calibration_error")
    if n is not None and not n:
        said.append("The metamodel was never tested: there are no held-out runs.")
    elif critical is not None and critical < _FEW_CRITICAL:
        plural = "s" if critical != 1 else ""
        said.append(
            f"Only {critical} critical run{plural} among the {number(n)} held-out ones: precision and likelihood of critical"
            " runs are noisy, and whole critical regions may be missing from the test."
        )
    if error is not None and error > _POOR_CALIBRATION:
        said.append(
            f"Poor calibration: the metamodel's P(critical) is off by {error:.2f} on average. Do not read it as a probability."
        )
    return said

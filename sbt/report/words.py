"""What a campaign found, in plain sentences, and what a reader must not conclude from it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from textwrap import shorten
from typing import Any

from sbt.campaigns.failures import FalsificationConclusion
from sbt.campaigns.lost import nothing_known
from sbt.campaigns.parts import share_among_held_out
from sbt.campaigns.wording import input_value, number, percent, requirement_words, written_unit
from sbt.estimators.binomial import upper
from sbt.loop.stages import Conclusion, Facts, few_combinations, notes_of, sentences_of
from sbt.problem.outcome import Doubt, reason_alone
from sbt.problem.parameter import Parameter
from sbt.problem.plain import JsonMapping
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.store.database import Store
from sbt.store.history import PLANNED, VALIDATION, History
from sbt.store.records import Validation

__all__ = [
    "SCORES",
    "Findings",
    "conclusion_sentences",
    "distribution_words",
    "requirement_words",
    "warnings_for",
]

SCORES: Mapping[str, str] = {
    "log_likelihood": "log likelihood",
    "log_likelihood_critical": "log likelihood, critical runs",
    "rmse": "RMSE",
    "average_precision": "average precision",
    "precision_at_recall_90": "precision at 90 % recall",
    "calibration_error": "calibration error",
}
"""Keys of a fit, as written for people."""
_DOUBTS = {
    Doubt.UNCONFIRMED: "a contact that SUMO's own list of collisions does not confirm",
    Doubt.STRUCK: "a recorded road user, who does not react, driving into the ego from behind",
}
_FEW_CRITICAL = 10
_POOR_CALIBRATION = 0.1


@dataclass(frozen=True)
class Findings:
    """The facts behind the sentences: the rows, the requirement, and what the campaign concluded.

    Args:
        history: finished runs.
        requirement: metric and critical interval.
        unit: of the metric.
        configuration: resolved.
        conclusion: what the campaign found; None while it goes on.
        ended: how it ended, as `run --json` prints it; empty while it goes on.
        validation: scores of the last metamodel on held-out runs; None where there is none.
        planned: runs without an outcome.
        direction: "low" where small values of the metric are bad, "high" where large ones are.
        units: of inputs and metrics, by name.
        scenario: its name.
        combinations: of the inputs, where they are few.
        meanings: of metrics, by name.
        recorded: its runs are recorded rows.
        notes: in sentences, what is to be known of these rows.
        uneven: why shares of them are none of the parameter space; "": they are.
    """

    history: History
    requirement: Requirement
    unit: str
    configuration: JsonMapping
    conclusion: Conclusion | None
    ended: JsonMapping
    validation: Validation | None
    planned: int
    direction: str = "low"
    units: Mapping[str, str] = field(default_factory=dict)
    scenario: str = ""
    combinations: int | None = None
    meanings: Mapping[str, str] = field(default_factory=dict)
    recorded: bool = False
    notes: tuple[str, ...] = ()
    uneven: str = ""

    @classmethod
    def of(
        cls, store: Store, scenario: LogicalScenario, conclusion: Conclusion | None, *, history: History | None = None
    ) -> Findings:
        """Return the findings of a store, at whatever point of the campaign; of some of its runs, where they are given."""
        fits = store.fits()
        validation = getattr(conclusion, "validation", None) or (fits[-1].validation if fits else None)
        return cls(
            store.history() if history is None else history, scenario.requirement, scenario.unit, store.configuration,
            conclusion, store.conclusion or {},
            validation, store.counts.get(PLANNED, 0), scenario.direction,
            scenario.units, scenario.name, few_combinations(scenario),
            {m.name: m.description for m in scenario.metrics if m.description}, scenario.pool is not None,
            notes_of(scenario), scenario.uneven,
        )  # fmt: skip

    @property
    def critical(self) -> Any:
        """(n,) the run violates the requirement."""
        return self.requirement.critical_runs(self.history)

    @property
    def held_out(self) -> Any:
        """(n,) the run gave metrics and no metamodel learned from it."""
        return self.history.ok & (self.history.stage == VALIDATION)

    @property
    def facts(self) -> Facts:
        """What the conclusion's own sentences may refer to."""
        return Facts(
            self.history, self.requirement, self.unit, self.scenario, self.units, self.combinations, self.meanings, self.recorded,
            self.notes, self.uneven,
        )  # fmt: skip


def distribution_words(parameter: Parameter) -> str:
    """Return the distribution of an input as its kind and parameters, or the probabilities of its choices."""
    if parameter.probabilities:
        return ", ".join(f"{c} {percent(p)}" for c, p in zip(parameter.choices, parameter.probabilities, strict=True))
    if parameter.choices:
        return "equally likely"
    distribution = parameter.distribution
    if distribution is None or distribution.kind == "uniform":
        return "uniform"
    width = parameter.bounds[1] - parameter.bounds[0]
    given = {name: value if isinstance(value, str) else float(value) for name, value in distribution.parameters}
    parameters = ", ".join(f"{name} {input_value(value, width, 6)}" for name, value in given.items())
    return f"{distribution.kind} ({parameters})" if parameters else distribution.kind


def conclusion_sentences(found: Findings) -> list[str]:
    """Return what the campaign found, the most important first: the sentences of `run --json`, or what is known before them."""
    if found.conclusion is not None:
        return sentences_of(found.conclusion, found.facts) or nothing_known(found.facts)
    ok, critical = int(found.history.ok.sum()), int(found.critical.sum())
    if not ok:
        return ["No run has given a metric yet."]
    return [f"{critical:,} of {ok:,} runs were critical.{_not_a_share(found)}", *share_among_held_out(found.facts).sentence()]


def _about_contacts(found: Findings) -> list[str]:
    """Return how many runs have doubtful contacts; nothing where there is none."""
    critical, sentences = int(found.critical.sum()), []
    for doubt, words in _DOUBTS.items():
        n = int((found.critical & found.history.doubtful(doubt)).sum())
        of, has = f"{n:,} of the {critical:,} critical runs", "has" if n == 1 else "have"
        which = "The critical run has" if critical == 1 else f"{of} {has}"
        sentences += [f"{which} {words}; the table of contacts says more."] if n else []
    passed = int(found.history.doubtful(Doubt.OTHER_LEVEL).sum())
    if passed:
        which = f"In {passed:,} run{'s' if passed > 1 else ''} bodies overlap that are not counted as a contact"
        why = "roads that cross without a junction are taken for bridges, since the network has no heights"
        sentences.append(f"{which}: {why}; the table of contacts names them.")
    return sentences


def _not_a_share(found: Findings) -> str:
    adaptive = set(found.history.stage.tolist()) - {VALIDATION}
    if found.configuration.get("campaign") == "coverage" or not adaptive:
        return ""
    return " Runs are chosen, not drawn at random, so this share is no estimate of their probability."


def warnings_for(found: Findings) -> list[str]:
    """Return what limits the conclusion, in plain words; empty where nothing does."""
    return [
        *_about_progress(found),
        *_about_runs(found),
        *_about_contacts(found),
        *_about_scores(found),
        *(f"{said[:1].upper()}{said[1:].rstrip('.')}." for said in map(str, getattr(found.conclusion, "warnings", ()))),
    ]


def _about_progress(found: Findings) -> list[str]:
    if found.ended and not found.planned:
        return []
    done, budget = len(found.history), found.configuration.get("budget")
    reference = (found.configuration.get("validation") or {}).get("reference") or 0
    of = f" of {budget + reference:,}" if isinstance(budget, int) else ""
    waiting = f", {found.planned:,} more are planned" if found.planned else ""
    return [f"The campaign has not concluded: {done:,}{of} runs are done{waiting}. What follows may still change."]


def _about_runs(found: Findings) -> list[str]:
    history = found.history
    sentences: list[str] = []
    failed = history.where(~history.ok)
    if len(failed):
        reasons = (reason or status for reason, status in zip(failed.reason, failed.status, strict=True))
        reason, times = Counter(reason_alone(str(each)) for each in reasons).most_common(1)[0]
        sentences.append(
            f"{len(failed):,} of {len(history):,} runs failed ({percent(len(failed) / len(history))}) and tell nothing"
            f" about safety. Most frequent reason ({times:,} times): {shorten(reason, 200, placeholder=' ...')}"
        )
    sentences += _about_far_side(found)
    if history.ok.any() and not found.critical.any():
        n = int(found.held_out.sum())
        most = percent(float(upper(0, n, 0.95)))
        own = isinstance(found.conclusion, FalsificationConclusion)  # which states a bound by more runs
        bound = f" From the {n:,} random held-out runs alone, up to {most} may be critical (95 %)." if n else ""
        sentences += [] if own else [f"No critical run was found. That is no proof that there is none.{bound}"]
    if len(set(history.versions)) > 1:
        sentences.append("Runs were made with different versions of the software; see the header.")
    return sentences


def _about_far_side(found: Findings) -> list[str]:
    """Return how many runs are worse than the bad end of the critical interval, and so count as uncritical."""
    if found.requirement.combined:
        return []
    y, critical, name = found.history.y(found.requirement.metric), found.requirement.critical, found.requirement.metric
    high = found.direction == "high"
    n, end = int((y > critical.high).sum() if high else (y < critical.low).sum()), critical.high if high else critical.low
    if n == 0:
        return []
    runs = "1 run has" if n == 1 else f"{n:,} runs have"
    side, tail = "above" if high else "below", f" {written_unit(found.unit)}" if found.unit else ""
    meant = "Is that meant?" if found.configuration.get("requirement") else "The scenario's own requirement has it so."
    return [f"{runs} {name} {side} {end:g}{tail}, beyond the critical interval, and count as uncritical. {meant}"]


def _about_scores(found: Findings) -> list[str]:
    scores = found.validation
    sentences: list[str] = []
    if scores is None:
        return sentences
    n, critical, error = scores.n, scores.n_critical, scores.calibration_error
    if not n:
        sentences.append("The metamodel was never tested: there are no held-out runs.")
    elif critical == n:
        sentences.append(f"All {number(n)} held-out runs are critical: the metamodel was not tested on uncritical ones.")
    elif critical < _FEW_CRITICAL:
        few = "No critical run" if critical == 0 else f"Only {critical} critical run{'s' if critical > 1 else ''}"
        sentences.append(
            f"{few} among the {number(n)} held-out ones: precision and likelihood of critical"
            " runs are noisy, and whole critical regions may be missing from the test."
        )
    if error is not None and error > _POOR_CALIBRATION:
        sentences.append(
            f"Poor calibration: the metamodel's P(critical) is off by {error:.2f} on average. Do not read it as a probability."
        )
    return sentences

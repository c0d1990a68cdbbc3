"""Coverage: evenly distributed runs, the baseline of every other campaign and the way data sets are made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from sbt.campaigns.choices import evenly
from sbt.campaigns.each import each_share, shares_words
from sbt.campaigns.explained import ExplainedVariance, explained_variance
from sbt.campaigns.lost import none_gave_a_metric, nothing_known
from sbt.campaigns.parts import BatchStage, CriticalShare, critical_share
from sbt.campaigns.rows import tell_rows
from sbt.campaigns.settings import CampaignKind, Settings
from sbt.campaigns.telling import tell_share
from sbt.campaigns.warmed import conditional_on
from sbt.loop.learner import FittedMetamodel
from sbt.loop.stages import Campaign, Facts, Log
from sbt.problem.plain import Json
from sbt.store.records import Validation, optional, to_json

__all__ = ["COVERAGE", "CoverageConclusion", "recipe"]


@dataclass(frozen=True)
class CoverageConclusion:
    """The share of critical runs of an even design.

    Attributes:
        critical_fraction: of the runs that gave a metric; None: there are none.
        low, high: ends of its exact binomial interval; failed runs count as uncritical for the low end and as critical for the
            high end.
        confidence: of the interval.
        counted: runs.
        validation: scores of the metamodel on held-out runs, where one is configured.
        requirements: of a combination, the share that violates each.
        explained: what inputs and drawn traffic explain of the metric; None: it is not known.
        rows: of a recorded table whose rows are not spread evenly: the shares are of these rows, not of the parameter space.
    """

    critical_fraction: float | None
    low: float
    high: float
    confidence: float = 0.95
    counted: int = 0
    validation: Validation | None = optional()
    requirements: Mapping[str, CriticalShare] | None = optional()
    explained: ExplainedVariance | None = optional()
    rows: int | None = optional()

    def to_dict(self) -> Json:
        """Return the JSON of the command line."""
        found: Json = to_json(self)
        return found

    def sentences(self, facts: Facts) -> list[str]:
        """Return what was found in words."""
        if none_gave_a_metric(facts):
            return nothing_known(facts)
        told = [] if self.explained is None else [self.explained.sentence(facts.requirement.told_as)]
        lost = int((~facts.history.ok).sum())
        whole = CriticalShare(self.critical_fraction, self.low, self.high, self.confidence, self.counted, lost)
        first = tell_share(whole, facts) if self.rows is None else tell_rows(whole, self.rows, facts)
        return [*first, *shares_words(self.requirements), *conditional_on(facts.history), *told]


def recipe(settings: Settings) -> Campaign:
    """Return the campaign: one Sobol sequence in batches, a share held out where there is a metamodel."""

    def conclude(log: Log) -> tuple[CoverageConclusion, FittedMetamodel | None]:
        fitted = settings.learner.telling(log.history).fit(log.history) if settings.learner is not None else None
        share = critical_share(log.history, settings.scenario)
        pool = settings.scenario.pool
        validation = None if fitted is None else fitted.record.validation
        found = CoverageConclusion(
            share.critical_fraction, share.low, share.high, share.confidence, share.counted, validation,
            each_share(log.history, settings.scenario.requirement), explained_variance(settings, log.history),
            len(pool.x) if pool is not None and settings.scenario.uneven else None,
        )  # fmt: skip
        return found, fitted

    return Campaign((BatchStage("even", settings, evenly),), conclude, depends=None)


COVERAGE = CampaignKind(
    "evenly distributed points: the baseline, and data sets", recipe, CoverageConclusion, adaptive=False, target_aware=False
)

"""Coverage: evenly distributed runs, the baseline of every other campaign and the way data sets are made."""

from __future__ import annotations

from typing import Any

from sbt.campaigns.boundary import validation_of
from sbt.campaigns.choices import evenly
from sbt.campaigns.parts import BatchStage, Settings, critical_share, fit_of
from sbt.loop.stages import Campaign, Fit, Log

__all__ = ["recipe"]


def recipe(settings: Settings) -> Campaign:
    """Return the campaign: one Sobol sequence in batches, a share held out where there is a metamodel.

    The conclusion holds the share of critical runs with its interval and, with a metamodel, its
    scores on the held-out runs.
    """

    def conclude(log: Log) -> tuple[dict[str, Any], Fit | None]:
        conclusion = critical_share(log.history, settings.scenario)
        belief = settings.learner.fit(log.history) if settings.learner is not None else None
        if belief is not None:
            conclusion["validation"] = validation_of(belief.scores)
        return conclusion, fit_of(belief)

    return Campaign((BatchStage("even", settings, evenly),), conclude, depends=None)

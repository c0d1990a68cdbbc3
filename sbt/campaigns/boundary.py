"""Boundary identification: runs where the metamodel doubts whether a concrete scenario is critical."""

from __future__ import annotations

from typing import Any

from sbt.campaign import Campaign, Fit, Log
from sbt.campaigns.parts import BatchStage, Settings, critical_share, fit_of
from sbt.errors import InputError
from sbt.history import VALIDATION

__all__ = ["recipe"]

_INTERNAL = ("sides", "critical_fraction")


def recipe(settings: Settings) -> Campaign:
    """Return the campaign: even first, then batches from the acquisition's region of interest.

    The conclusion holds `critical_fraction`, the share of the input space that is critical as the
    metamodel sees it (mean P(critical)), `held_out_fraction`, the same from the held-out random runs
    with its interval and free of any model, and the validation scores on those runs.

    Raises:
        InputError: no metamodel.

    Source:
        Winkelmann et al. (2022), section V-A.
    """
    learner = settings.learner
    if learner is None:
        raise InputError("campaign boundary needs a metamodel, but got none")

    def conclude(log: Log) -> tuple[dict[str, Any], Fit | None]:
        belief = learner.fit(log.history)
        held_out = log.history.where(log.history.stage == VALIDATION)
        conclusion: dict[str, Any] = {"critical_fraction": None, "validation": None}
        if belief is not None:
            conclusion["critical_fraction"] = belief.scores["critical_fraction"]
            conclusion["validation"] = validation_of(belief.scores)
        conclusion["held_out_fraction"] = critical_share(held_out, settings.scenario)
        return conclusion, fit_of(belief)

    return Campaign((BatchStage("boundary", settings, adaptive=True),), conclude)


def validation_of(scores: dict[str, Any]) -> dict[str, Any] | None:
    """Return the scores on held-out runs; None where there were none."""
    found = {k: v for k, v in scores.items() if k not in _INTERNAL}
    return found or None

"""Boundary identification: runs where the metamodel doubts whether a concrete scenario is critical."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from sbt.acquisitions import boundary, expected_feasibility, straddle
from sbt.campaigns.choices import Choice, from_roi, greedily, mixed
from sbt.campaigns.parts import BatchStage, Settings, critical_share, fit_of
from sbt.errors import InputError
from sbt.loop.stages import Campaign, Fit, Log
from sbt.problem.arrays import Points
from sbt.samplers.sobol import SobolSequence
from sbt.samplers.surface import crossings
from sbt.store.history import VALIDATION, History

__all__ = ["boundary_points", "recipe", "validation_of"]

_VOLUMES = ("critical_fraction", "expected_misclassified", "ambiguous_volume")
_INTERNAL = ("sides", "believed", "weights", *_VOLUMES)
_GREEDY = {"u": boundary, "straddle": straddle, "expected_feasibility": expected_feasibility}


def recipe(settings: Settings) -> Campaign:
    """Return the campaign: even first, then batches from the acquisition's region of interest.

    The acquisition decides how: `mix` (exploration where critical runs are rare, representative of a_BI,
    greedy, space filling), `u`, `straddle` and `expected_feasibility` greedily, any acquisition function
    by rejection (`boundary`: the paper's).

    The conclusion holds shares of the input space as the metamodel sees them: `critical_fraction`, the
    mean P(critical), `expected_misclassified`, the mean of min(P, 1 - P), and `ambiguous_volume`,
    where P lies between 0.05 and 0.95; `held_out_fraction`, the critical share from the held-out random
    runs with its interval and free of any model; and the validation scores on those runs.

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
        conclusion: dict[str, Any] = {**dict.fromkeys(_VOLUMES), "validation": None}
        if belief is not None:
            conclusion |= {name: belief.scores[name] for name in _VOLUMES}
            conclusion["validation"] = validation_of(belief.scores)
            conclusion |= {name: belief.scores[name] for name in ("believed", "weights") if name in belief.scores}
        conclusion["held_out_fraction"] = critical_share(held_out, settings.scenario)
        return conclusion, fit_of(belief)

    return Campaign((BatchStage("boundary", *_choice(settings)),), conclude)


def _choice(settings: Settings) -> tuple[Settings, Choice]:
    """Return the rule that chooses batches, and the settings with its criterion."""
    if settings.method in _GREEDY:
        return replace(settings, acquisition=_GREEDY[settings.method]), greedily
    return settings, from_roi if settings.acquisition is not None else mixed


def boundary_points(settings: Settings, history: History, most: int = 500) -> Points:
    """Return up to `most` points (m, d) in the inputs' units where P(critical), learned from all runs, crosses 0.5.

    Raises:
        InputError: there is no metamodel, or fewer than two runs to learn from.
    """
    if settings.learner is None or len(history.finished) < 2:
        raise InputError("boundary points need a metamodel and two finished runs, but there are none")
    predictor = settings.learner.train(history.finished)
    space, critical = settings.scenario.space, settings.scenario.requirement.critical
    u = SobolSequence(space.dimension, settings.seed).points(0, 8192)
    found = crossings(lambda v: predictor(space.metamodel_inputs(v)).probability(critical), u, most)
    x = space.from_unit(found)
    return x[space.feasible(x)]


def validation_of(scores: dict[str, Any]) -> dict[str, Any] | None:
    """Return the scores on held-out runs; None where there were none."""
    found = {k: v for k, v in scores.items() if k not in _INTERNAL}
    return found or None

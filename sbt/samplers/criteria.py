"""Batches by one criterion alone: parts of the portfolio, and the usual criteria to compare it with."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy.special import erfcx, log_ndtr

from sbt.problem.arrays import Points, Vector
from sbt.samplers.room import fill_uniformly
from sbt.samplers.search import Picks, Search, WarpedModel, fit_warped, log_repulsion, refine_best, search_data

__all__ = [
    "CRITERIA", "Criterion", "log_expected_improvement", "lower_confidence_bound", "probability_of_violation", "propose_by",
]  # fmt: skip

Criterion = Callable[[WarpedModel, Points, float], Vector]
"""(model, points (n, d), margin of the best run in warped units) -> (n,) scores, larger is better."""

_KAPPA = 2.0  # standard deviations below the mean, the usual choice
_CLEAR, _CLEAR_OF_RUNS = 0.05, 0.2 * 0.05  # repulsion among picks and from runs, as in the portfolio
_DRAWN = 600  # candidates at which sample paths are drawn: their cost is cubic
_STARTS = 30  # best runs that are candidates again, as many as are refined
_SQRT_HALF_PI, _LOG_SQRT_2PI = np.sqrt(0.5 * np.pi), 0.5 * np.log(2.0 * np.pi)


def probability_of_violation(model: WarpedModel, u: Points, best: float) -> Vector:
    """Return (n,) log P(critical).

    Source:
        Kushner (1964), probability of improvement, with the edge of the critical interval as the level.
    """
    del best
    return model.log_probability(u)


def lower_confidence_bound(model: WarpedModel, u: Points, best: float) -> Vector:
    """Return (n,) minus the margin two standard deviations, times P(a run gives a metric), towards the critical interval.

    Source:
        Cox and John (1992); kappa = 2.
    """
    del best
    p = model(u)
    return _KAPPA * np.exp(model.log_success(u)) * p.sigma - model.critical.margin(p.mu)


def log_expected_improvement(model: WarpedModel, u: Points, best: float) -> Vector:
    """Return (n,) log E[max(best - margin, 0)], the margin measured from the end on which the mean lies; 0 if a run fails.

    Source:
        Ament et al. (2023), arXiv 2310.20708, eq. (9): stable far below the incumbent.
    """
    p = model(u)
    gain = np.log(p.sigma) + _log_h((best - model.critical.margin(p.mu)) / p.sigma)
    return np.asarray(gain + model.log_success(u))


def _log_h(z: Vector) -> Vector:
    """Return log(phi(z) + z Phi(z)), finite for z down to -1e6."""
    out = np.empty_like(z)
    high = z > -1.0
    phi = np.exp(-0.5 * z[high] ** 2 - _LOG_SQRT_2PI)
    out[high] = np.log(phi + z[high] * np.exp(log_ndtr(z[high])))
    low = z[~high]
    mills = _SQRT_HALF_PI * erfcx(-low * np.sqrt(0.5))  # Phi(z) / phi(z)
    rest = np.where(low > -1e3, np.log1p(np.maximum(low * mills, -1.0 + 1e-300)), -2.0 * np.log(-low))
    out[~high] = -0.5 * low**2 - _LOG_SQRT_2PI + rest
    return out


CRITERIA: Mapping[str, Criterion | None] = {
    "log_expected_improvement": log_expected_improvement,
    "probability_of_violation": probability_of_violation,
    "lower_confidence_bound": lower_confidence_bound,
    "thompson": None,
}
"""By name, as in `acquisition.kind`; Thompson sampling draws sample paths and has no score."""


def propose_by(
    name: str, search: Search, u: Points, y: Vector, n: int, rng: np.random.Generator, batch: Vector | None = None
) -> Picks:
    """Return n points by the criterion `name` alone; deflation and arguments as in `portfolio.propose`.

    The points of one batch repel each other, or are each the best of a sample path (`thompson`).

    Raises:
        KeyError: there is no such criterion.
    """
    criterion, d = CRITERIA[name], u.shape[1]
    search, y = search.reached(u, y)
    seen = search_data(search, u, y, batch, rng)
    if len(seen.u) < 2:
        return Picks(fill_uniformly(seen.filling(search, rng), n, d, rng), (name,) * n)
    model = fit_warped(search, seen.u, seen.y, rng, seen.success)
    margin = model.critical.margin(model.warp.values(seen.y))
    start = seen.u[np.argsort(margin, kind="stable")[:_STARTS]]
    best = float(margin.min())
    score = probability_of_violation if criterion is None else criterion
    candidates, values = refine_best(lambda v: score(model, v, best), start, seen.admissible, rng, search.cube)
    if criterion is None:
        return Picks(_thompson(model, candidates[np.argsort(-values, kind="stable")[:_DRAWN]], n, rng), (name,) * n)
    at_candidates = search.cube.embedded(candidates)
    values = values + log_repulsion(at_candidates, search.cube.embedded(u), _CLEAR_OF_RUNS * np.sqrt(d))
    picks = np.empty((n, d))
    for k in range(n):
        at = int(np.argmax(values))
        picks[k] = candidates[at]
        values += log_repulsion(at_candidates, at_candidates[at][None], _CLEAR * np.sqrt(d))
    return Picks(picks, (name,) * n)


def _thompson(model: WarpedModel, candidates: Points, n: int, rng: np.random.Generator) -> Points:
    """Return n points, each the best of a sample path over the candidates; no point twice."""
    margin = -model.expected(-model.critical.margin(model.sample_paths(candidates, n, rng)), candidates)
    picks = np.empty((n, candidates.shape[1]))
    for k in range(n):
        at = int(np.argmin(margin[k]))
        picks[k] = candidates[at]
        margin[:, at] = np.inf
    return picks

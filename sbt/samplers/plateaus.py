"""Plateaus beside the critical set: where many runs share the best uncritical value, what lies beneath is looked for.

A metric that is cut off just outside of the critical interval (a gap that never falls below the standing distance, a time that is
rounded up) shows a flat floor. A metamodel takes the floor for what it is and sees nothing in it. Such values are *censored*:
the metric would be at most so much. Where the slopes around a floor lead, its middle is, and there the search goes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.distance import cdist
from scipy.special import log_ndtr

from sbt.metamodels.base import fitted, named_errors, predicted
from sbt.problem.arrays import Mask, Points, Vector
from sbt.samplers.room import fill_uniformly
from sbt.samplers.search import Search, SearchData

__all__ = ["beneath_plateaus", "plateau"]

_FEWEST = 4  # runs that share the best uncritical value: two may do so by chance, or by a repeated input
_FEWEST_WITHIN = 2  # of them, that lie at no end of a range
_FEWEST_AROUND = 8  # other values, which make the slopes
_EQUAL = 1e-6  # of the range of the margins
_UNIFORM, _CHILDREN, _STEP = 1000, 8, 0.08  # candidates: uniform ones, and steps from each run of a plateau
_LEAST_DEPTH = 0.05  # in median margins, beneath a floor: where slopes lead no deeper it is the least value that they lead to
_BESIDE = 0.25  # share of the picks that look at slopes
_ASIDE, _SLOPE = 0.15, 0.5  # steps from a floor to the slopes around it; how far above it those reach, in median margins
_ALONG = 6  # points of the segment to a known failure: where none rises, the failure explains the place
_BEST = 60  # candidates for which that is asked at once


def plateau(margin: Vector, u: Points) -> Mask:
    """Return (n,) the runs that share the smallest margin > 0; none where they are few, or most, or there is no slope.

    Runs at an end of an input's range are no sign of one: the least of a slope is there, the same whatever other inputs are.
    """
    safe = np.isfinite(margin) & (margin > 0)
    none = np.zeros(len(margin), dtype=bool)
    if not safe.any():
        return none
    low, high = float(margin[safe].min()), float(margin[safe].max())
    flat = safe & (margin <= low + _EQUAL * (high - low))
    count, around = int(flat.sum()), len(np.unique(margin[safe & ~flat]))
    within = int((flat & ((u > 0.0) & (u < 1.0)).all(axis=1)).sum())
    few = count < _FEWEST or around < _FEWEST_AROUND or within < _FEWEST_WITHIN
    return none if few else flat


def beneath_plateaus(
    search: Search, seen: SearchData, u: Points, y: Vector, n: int, rng: np.random.Generator, pending: Points | None = None,
    *, beside: bool = False,
) -> Points:  # fmt: skip
    """Return up to n points (k, d) beneath plateaus: deep by what the slopes say, and far from the runs there.

    Args:
        search: what is searched.
        seen: where to look.
        u: (m, d) all finished runs in the unit cube.
        y: (m,) their metric; NaN where a run failed.
        n: points wanted.
        rng: the only source of randomness.
        pending: (k, d) runs in flight, to keep away from as well.
        beside: the last quarter of the points looks at the slopes around floors beneath which no failure is known: they tell
            where the middle is.

    Source:
        Censored values as the means of truncated normal ones: Tobin (1958), Econometrica 26.
    """
    none = np.empty((0, u.shape[1]))
    margin = search.margins(y)
    flat = plateau(margin, u)
    if n <= 0 or seen.noisy or not flat.any():
        return none
    latent, floor = _latent(search, u, margin, flat, rng)
    hits = u[np.isfinite(margin) & (margin <= 0)]
    steps = np.repeat(u[flat], _CHILDREN, axis=0)
    near = np.clip(steps + _STEP * rng.standard_normal(steps.shape), 0.0, 1.0)
    steps = search.cube.flipped(near, steps, _STEP, rng)
    points = np.vstack([fill_uniformly(seen.admissible, _UNIFORM, u.shape[1], rng), steps[seen.admissible(steps)]])
    depth = floor - latent(points)
    points, depth = points[depth > _LEAST_DEPTH], depth[depth > _LEAST_DEPTH]
    at = search.cube.embedded
    there = u if pending is None else np.vstack([u, pending])
    square = cdist(at(points), at(there), "sqeuclidean").min(axis=1) if len(points) else np.empty(0)
    aside, picks = round(_BESIDE * n) if beside else 0, none
    while len(picks) < n - aside and (depth * square).any():
        order = np.argsort(-depth * square, kind="stable")[:_BEST]
        fresh = order[~_explained(latent, points[order], floor - depth[order], hits)]
        if len(fresh) == 0:
            points, depth, square = (np.delete(a, order, axis=0) for a in (points, depth, square))
            continue
        best = points[fresh[0]]
        picks = np.vstack([picks, best])
        square = np.minimum(square, cdist(at(points), at(best[None]), "sqeuclidean")[:, 0])
        square[fresh[0]] = 0.0
    return np.vstack([picks, _beside(search, seen, u[flat], latent, floor, hits, aside, rng, there)]) if len(picks) else none


def _beside(
    search: Search, seen: SearchData, flat: Points, latent: Callable[[Points], Vector], floor: float, hits: Points, n: int,
    rng: np.random.Generator, there: Points,
) -> Points:  # fmt: skip
    """Return up to n points (k, d) on the slopes around floors that no known failure explains, far from the runs there.

    Where all runs of a neighbourhood lie on the floor, nothing tells where its middle is.
    """
    around, picks = flat[~_explained(latent, flat, latent(flat), hits)], np.empty((0, flat.shape[1]))
    if n <= 0 or len(around) == 0:
        return picks
    centres = around[rng.integers(len(around), size=_UNIFORM)]
    points = np.clip(centres + _ASIDE * rng.standard_normal(centres.shape), 0.0, 1.0)
    points = search.cube.flipped(points, centres, _ASIDE, rng)
    points = points[seen.admissible(points)]
    above = latent(points) - floor if len(points) else np.empty(0)
    points = points[(above > 0.0) & (above <= _SLOPE)]
    at = search.cube.embedded
    square = cdist(at(points), at(there), "sqeuclidean").min(axis=1) if len(points) else np.empty(0)
    while len(picks) < n and square.any():
        best = points[int(np.argmax(square))]
        picks = np.vstack([picks, best])
        square = np.minimum(square, cdist(at(points), at(best[None]), "sqeuclidean")[:, 0])
    return picks


def _latent(
    search: Search, u: Points, margin: Vector, flat: Mask, rng: np.random.Generator
) -> tuple[Callable[[Points], Vector], float]:
    """Return the mean of the margin as it would be without the floor, scaled, as a function of points; and the floor."""
    ok = np.isfinite(margin)
    inputs = search.columns(u)
    scale = float(np.median(np.abs(margin[ok & ~flat])))
    value = np.arcsinh(margin / max(scale, 1e-300))
    floor = float(value[flat].max())
    with named_errors(search.metamodel, int(ok.sum())):
        around = fitted(search.metamodel, inputs[ok & ~flat], value[ok & ~flat], rng)
        guess = predicted(around, inputs[flat])
        mean, std = guess.mu, guess.sigma
        beneath = value.copy()
        beneath[flat] = _truncated(mean, std, floor)
        predictor = fitted(search.metamodel, inputs[ok], beneath[ok], rng)
    quick: Callable[[Points], Vector] | None = getattr(predictor, "mu", None)

    def latent(points: Points) -> Vector:
        inputs = search.columns(points)
        with named_errors(search.metamodel, int(ok.sum())):
            return quick(inputs) if callable(quick) else predicted(predictor, inputs).mu

    return latent, floor


def _truncated(mean: Vector, std: Vector, most: float) -> Vector:
    """Return (n,) means of normal values that are at most `most`."""
    at = (most - mean) / std
    ratio = np.exp(-0.5 * at**2 - 0.5 * np.log(2.0 * np.pi) - log_ndtr(at))
    return np.minimum(mean - std * ratio, most)


def _explained(latent: Callable[[Points], Vector], points: Points, value: Vector, hits: Points) -> Mask:
    """Return (n,) the way from a point to a known failure does not rise: it is that failure's flank."""
    found = np.zeros(len(points), dtype=bool)
    t = np.linspace(0.0, 1.0, _ALONG + 1)[1:-1, None, None]
    for hit in hits:
        left = np.flatnonzero(~found)
        if len(left) == 0:
            break
        way = points[left][None] * (1.0 - t) + hit * t
        there = latent(way.reshape(-1, points.shape[1])).reshape(len(t), len(left))
        found[left] = (np.diff(np.vstack([value[left][None], there]), axis=0) <= 1e-9).all(axis=0)
    return found

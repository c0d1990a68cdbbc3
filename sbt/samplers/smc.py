"""Sequential Monte Carlo: points of a region of interest that is too small for rejection.

Particles move from the uniform distribution to the density proportional to exp(score) through tempered
ones, exp(t score) with t from 0 to 1. Unlike rejection the draws are only asymptotically of that density:
they are marked as such in the log, and are never weighted as if the density were known.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from sbt.errors import InputError
from sbt.problem.arrays import Points, Vector
from sbt.problem.cube import CONTINUOUS, Cube

__all__ = ["SmcDraw", "smc"]

_MOVES = 4  # Metropolis steps a level: resampled duplicates have moved apart
_TARGET_ESS = 0.5  # share of the effective sample size that a tempering step leaves, the usual choice
_CORRECTED_ESS = 0.2  # the same of a step from the rough score's density to the score's: there is no other to go through
_TARGET_ACCEPTANCE = 0.3  # of the Metropolis steps: near the optimal 0.234 to 0.44 (Roberts and Rosenthal 2001)
_MAX_LEVELS = 40  # each halves the region: 2^-40 of the space
_FIRST_SCALE, _SCALES = 0.3, (0.01, 1.5)  # of a step relative to the difference of two particles: at first, and its range
_FLIPPED = 0.2  # chance that a step takes another choice
_OWN_SCALE = 0.02  # of a step that particles do not share: it keeps duplicates from staying duplicates


@dataclass(frozen=True, eq=False)
class SmcDraw:
    """Particles of the region of interest.

    Args:
        u: (m, d) particles in the unit cube.
        log_score: (m,) their log scores.
        log_mean: log of the mean of exp(score) over the cube, estimated.
        levels: tempering steps that were needed.
    """

    u: Points
    log_score: Vector
    log_mean: float
    levels: int


def smc(
    score: Callable[[Points], Vector], dimension: int, rng: np.random.Generator, *, particles: int = 1024, start: int = 4096,
    bound: Callable[[Points], Vector] | None = None, cube: Cube = CONTINUOUS, uniform: Points | None = None,
    rough: Callable[[Points], Vector] | None = None, rough_bound: Callable[[Points], Vector] | None = None,
) -> SmcDraw | None:  # fmt: skip
    """Draw particles with a density proportional to exp(score(u)) on the unit cube.

    Args:
        score: (m, d) points -> (m,) log scores; -inf outside the region.
        dimension: d.
        rng: the only source of randomness.
        particles: how many.
        start: uniform points the first level is resampled from, at least as many.
        bound: quick upper bounds of the scores: a move that they rule out is rejected without its score.
        cube: which coordinates take single values.
        uniform: (m, d) points to begin with, uniform in the part of the cube outside of which the score is -inf; `log_mean`
            is then that of this part. None: `start` points of the cube.
        rough: about the score and many times quicker: the particles move to its density first, and from there to that of the
            score. None: straight to the latter.
        rough_bound: as `bound`, of the rough score.

    Returns:
        The particles; None where no uniform point has a score above -inf.

    Raises:
        InputError: start < particles or a score that is NaN.

    Source:
        Del Moral, Doucet and Jasra (2006), doi 10.1111/j.1467-9868.2006.00553.x; tempering with a bisected
        effective sample size: Jasra et al. (2011).
    """
    if not 2 <= particles <= start:
        raise InputError(f"smc needs 2 <= particles <= start, but got particles = {particles}, start = {start}")
    u = rng.random((start, dimension)) if uniform is None else uniform
    if rough is not None:
        first = smc(rough, dimension, rng, particles=particles, start=start, bound=rough_bound, cube=cube, uniform=u)
        return None if first is None else _corrected(first, score, rough, bound, rng, cube)
    log_score = _checked(score, u)
    if np.isneginf(log_score).all():
        return None
    temper, log_mean, scale, levels = 0.0, 0.0, _FIRST_SCALE, 0
    while temper < 1.0 and levels < _MAX_LEVELS:
        step = _next(log_score, temper)
        log_weight = step * log_score if levels else np.where(np.isneginf(log_score), -np.inf, step * log_score)
        log_mean += float(logsumexp(log_weight) - np.log(len(log_weight)))
        keep = _systematic(np.exp(log_weight - logsumexp(log_weight)), particles, rng)
        u, log_score, temper, levels = u[keep], log_score[keep], temper + step, levels + 1
        u, log_score, scale = _move(score, bound, u, log_score, temper, scale, rng, cube)
    return SmcDraw(u, log_score, log_mean, levels)


def _corrected(
    draw: SmcDraw, score: Callable[[Points], Vector], rough: Callable[[Points], Vector],
    bound: Callable[[Points], Vector] | None, rng: np.random.Generator, cube: Cube,
) -> SmcDraw | None:  # fmt: skip
    """Return particles moved on from a rough score's density, along exp((1 - t) rough + t score), to that of the score."""
    u, log_rough, log_score = draw.u, draw.log_score, _checked(score, draw.u)
    temper, log_mean, scale, levels = 0.0, draw.log_mean, _FIRST_SCALE, draw.levels
    while temper < 1.0:
        gain = log_score - log_rough
        if np.isneginf(gain).all():
            return None
        step = _next(gain, temper, _CORRECTED_ESS) if levels < _MAX_LEVELS else 1.0 - temper
        log_weight = np.where(np.isneginf(gain), -np.inf, step * gain)
        log_mean += float(logsumexp(log_weight) - np.log(len(log_weight)))
        keep = _systematic(np.exp(log_weight - logsumexp(log_weight)), len(u), rng)
        u, temper, levels = u[keep], min(temper + step, 1.0), levels + 1
        if temper == 1.0:
            u, log_score, scale = _move(score, bound, u, log_score[keep], 1.0, scale, rng, cube)
            break
        t = temper

        def between(v: Points, t: float = t) -> Vector:
            return (1.0 - t) * rough(v) + t * score(v)

        def most(v: Points, t: float = t) -> Vector:
            return (1.0 - t) * rough(v) + (0.0 if bound is None else t * bound(v))

        at = (1.0 - t) * log_rough[keep] + t * log_score[keep]
        u, at, scale = _move(between, None if bound is None else most, u, at, 1.0, scale, rng, cube)
        log_rough = _checked(rough, u)
        log_score = (at - (1.0 - t) * log_rough) / t
    return SmcDraw(u, log_score, log_mean, levels)


def _checked(score: Callable[[Points], Vector], u: Points) -> Vector:
    found = np.asarray(score(u), dtype=np.float64)
    if np.isnan(found).any():
        raise InputError("a log score must not be NaN")
    return found


def _next(log_score: Vector, temper: float, kept: float = _TARGET_ESS) -> float:
    """Return the largest step of the temperature that keeps this share of the effective sample size."""
    left = 1.0 - temper

    def size(step: float) -> float:
        log_weight = np.where(np.isneginf(log_score), -np.inf, step * log_score)
        return float(np.exp(2 * logsumexp(log_weight) - logsumexp(2 * log_weight)))

    alive = int((~np.isneginf(log_score)).sum())
    if size(left) >= kept * alive:
        return left
    low, high = 0.0, left
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if size(middle) >= kept * alive else (low, middle)
    return max(low, 1e-12)


def _systematic(weight: Vector, n: int, rng: np.random.Generator) -> np.ndarray:
    """Return n indices, each drawn in proportion to its weight."""
    at = (rng.random() + np.arange(n)) / n
    return np.minimum(np.searchsorted(np.cumsum(weight), at), len(weight) - 1)


def _move(
    score: Callable[[Points], Vector], bound: Callable[[Points], Vector] | None, u: Points, log_score: Vector, temper: float,
    scale: float, rng: np.random.Generator, cube: Cube,
) -> tuple[Points, Vector, float]:  # fmt: skip
    """Return the particles after a few Metropolis steps at this temperature, and the scale adapted to them.

    The proposal is a difference of two other particles (it has their shape) plus a little of its own,
    reflected at the faces of the cube.
    """
    n, d = u.shape
    for _ in range(_MOVES):
        a, b = rng.permutation(n), rng.permutation(n)
        jump = scale * (u[a] - u[b]) + _OWN_SCALE * scale * rng.standard_normal((n, d))
        proposed = cube.flipped(_reflected(u + jump), u, _FLIPPED, rng)
        least = np.log(rng.random(n)) / temper + np.where(np.isneginf(log_score), -1e300, log_score)  # to be accepted
        hopeful = np.ones(n, dtype=bool) if bound is None else bound(proposed) > least
        new = np.full(n, -np.inf)
        if hopeful.any():
            new[hopeful] = _checked(score, proposed[hopeful])
        accepted = new > least
        u = np.where(accepted[:, None], proposed, u)
        log_score = np.where(accepted, new, log_score)
        scale = float(np.clip(scale * np.exp(accepted.mean() - _TARGET_ACCEPTANCE), *_SCALES))
    return u, log_score, scale


def _reflected(u: Points) -> Points:
    """Return points folded back into the unit cube."""
    folded = np.abs(np.mod(u, 2.0))
    return np.clip(np.where(folded > 1.0, 2.0 - folded, folded), 1e-12, 1.0 - 1e-12)

"""Gaussian mixtures in the standard-normal space: proposals with an exact density.

A mixture is fitted to particles from the regions that matter; the nominal and a wide distribution are
always components of it, so that no point of the space has a density of (nearly) zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.spatial.distance import cdist
from scipy.special import gammainccinv, logsumexp

from sbt.errors import InputError
from sbt.estimators.choices import ChoiceScore, log_normal, log_wide
from sbt.problem.arrays import Mask, Points, Vector

__all__ = [
    "Mixture", "Near", "Normals", "effective_size", "fit_mixture", "log_normal", "particles", "reweighted", "wide_scales",
    "within_reach",
]  # fmt: skip

LogTarget = Callable[[Points], Vector]
_BEYOND = 1e-9  # mass of the distribution beyond the ball in normal scores that is looked at
_TAIL = 1e-4  # probability of chi^2 beyond the wide component's radius
_COMPONENTS = (1, 2, 4, 7)  # numbers of normals that are compared: few, as particles are few
_ROWS = 10  # particles a dimension that each of several normals needs
_FEWEST = 8  # particles a dimension that a covariance needs
_LABELLED, _ELSEWHERE = 0.9, 0.1  # of a particle belongs to its nearest centre at first, and to all alike
_PRIOR_SHAPE = 0.05  # of the covariance of all particles: the prior of each normal's
_STEPS = 25  # most of the expectation maximisation, which ends earlier where the likelihood stands still
_NEAR, _NEAR_SHARE = 0.3, 0.25  # standard deviation of candidates around known critical points, and their share
_MOVES, _MOVES_BETWEEN = 6, 3  # Metropolis steps at the end and at each power: resampled duplicates have moved apart
_FEWEST_DISTINCT = 0.25  # effective sample size of reweighted points, relative to their number
_LEVELS, _KEPT = 15, 0.5  # most powers; share of the effective sample size that a power keeps
_STEP, _LONGER, _SHORTER, _ACCEPTANCE = 0.6, 1.3, 0.7, 0.3  # of a Metropolis step: first length, factors, acceptance to reach


def wide_scales(bounded: Vector) -> Vector:
    """Return (d,) standard deviations of the wide component: s on normal scores with a tail, 1 on bounded inputs.

    s^2 d' is the 1 - 1e-4 quantile of chi^2 with d' degrees of freedom, d' the number of inputs with a
    tail. The normal score of a uniform input keeps 1: its nominal distribution covers the range evenly.

    Args:
        bounded: (d,) 1 where the input is uniform on its range, else 0.
    """
    free = int((bounded == 0).sum())
    s = math.sqrt(2.0 * float(gammainccinv(0.5 * free, _TAIL)) / free) if free else 1.0
    return np.where(bounded == 0, s, 1.0)


def within_reach(z: Points) -> Mask:
    """Return which points z (n, d) lie in the ball beyond which 1e-9 of the standard-normal distribution lies.

    What is critical out there alone does not count: no search looks for it, and no proposal is made for it.
    """
    return np.asarray((z**2).sum(axis=1) <= 2.0 * float(gammainccinv(0.5 * z.shape[1], _BEYOND)))


@dataclass(frozen=True, eq=False)
class Normals:
    """k normal components: weight (k,), mean (k, d), lower Cholesky factors (k, d, d).

    With c inputs that have choices, d counts the others, and `masses` has (k, number of choices) for each: the components
    are products of a normal and of masses of the choices.
    """

    weight: Vector
    mean: Points
    factor: Points
    masses: tuple[Points, ...] = ()

    def log_terms(self, z: Points) -> Points:
        """Return (k, n) log density of each component at z (n, d), weights included, choices left out."""
        d, terms = z.shape[1], []
        for weight, mean, factor in zip(self.weight, self.mean, self.factor, strict=True):
            white = solve_triangular(factor, (z - mean).T, lower=True, check_finite=False)  # (d, n)
            norm = math.log(weight) - float(np.log(np.diag(factor)).sum()) - 0.5 * d * math.log(2.0 * math.pi)
            terms.append(norm - 0.5 * (white**2).sum(axis=0))
        return np.array(terms).reshape(len(self.weight), len(z))


@dataclass(frozen=True, eq=False)
class Mixture:
    """The proposal h: the nominal and the wide distribution and fitted normals, with exact density.

    Args:
        wide: (d,) standard deviations of the wide component.
        normals: fitted components; None: there was nothing to fit.
        defence: shares of the nominal and of the wide component where there are fitted ones (defensive mixture:
            Hesterberg 1995); they bound the weights p/h by 10.
        choices: the scores of inputs with choices; the wide component takes them for equally likely.
        most_nominal: largest share of the nominal component; smaller where its points are dear, as within constraints.
    """

    wide: Vector
    normals: Normals | None = None
    defence: tuple[float, float] = (0.1, 0.1)
    choices: tuple[ChoiceScore, ...] = ()
    most_nominal: float = 1.0

    @property
    def shares(self) -> Vector:
        """(2 + k,) shares of the nominal, the wide and the fitted components."""
        if self.normals is None:
            nominal = min(0.5, self.most_nominal)
            return np.array([nominal, 1.0 - nominal])
        return np.concatenate([self._defence, (1.0 - sum(self._defence)) * self.normals.weight])

    @property
    def _defence(self) -> tuple[float, float]:
        return min(self.defence[0], self.most_nominal), self.defence[1]

    def log_density(self, z: Points, log_nominal: Vector | None = None) -> Vector:
        """Return (n,) log h(z), exact; with a nominal component of another log density (n,), such as that within constraints."""
        shares = self.shares
        log_nominal = log_normal(z) if log_nominal is None else log_nominal
        terms = [math.log(shares[0]) + log_nominal, math.log(shares[1]) + log_wide(z, self.wide, self.choices)]
        if self.normals is not None:
            fitted = self.normals.log_terms(_ordered(z, self.choices))
            for choice, masses in zip(self.choices, self.normals.masses, strict=True):
                fitted = fitted + choice.log_ratio(masses, z) + log_normal(z[:, [choice.column]])
            terms += list(math.log(1.0 - sum(self._defence)) + fitted)
        return np.asarray(logsumexp(np.array(terms), axis=0))

    def sample(self, n: int, rng: np.random.Generator) -> tuple[Points, Vector]:
        """Return n points, stratified: each component gives its share of them, and (n,) their component.

        The counts are rounded by one common uniform number, so that their expectation is exact.
        """
        shares = self.shares
        edges = np.floor(n * np.concatenate([[0.0], np.cumsum(shares)]) + rng.random())
        edges[-1] = edges[0] + n
        counts = np.diff(edges).astype(int)
        d = len(self.wide)
        parts = [rng.standard_normal((counts[0], d)), rng.standard_normal((counts[1], d)) * self.wide]
        for choice in self.choices:
            parts[1][:, choice.column] = choice.scores(rng.integers(len(choice.shares), size=counts[1]), rng.random(counts[1]))
        if self.normals is not None:
            for k, (count, mean, factor) in enumerate(zip(counts[2:], self.normals.mean, self.normals.factor, strict=True)):
                ordered = mean + rng.standard_normal((count, len(mean))) @ factor.T
                parts.append(self._with_choices(ordered, k, rng))
        return np.concatenate(parts), np.repeat(np.arange(len(counts)), counts).astype(np.float64)

    def _with_choices(self, ordered: Points, component: int, rng: np.random.Generator) -> Points:
        """Return points (n, d) of their coordinates without choices, the choices drawn by a component's masses."""
        if self.normals is None or not self.choices:
            return ordered
        n, d = len(ordered), len(self.wide)
        z = np.empty((n, d))
        z[:, _columns(d, self.choices)] = ordered
        for choice, masses in zip(self.choices, self.normals.masses, strict=True):
            cells = rng.choice(len(choice.shares), size=n, p=masses[component])
            z[:, choice.column] = choice.scores(cells, rng.random(n))
        return z


@dataclass(frozen=True, eq=False)
class Near:
    """A mixture and normals around known critical points `centres` (k, d): where particles begin."""

    mixture: Mixture
    centres: Points

    @property
    def _share(self) -> float:
        return _NEAR_SHARE if len(self.centres) else 0.0

    def sample(self, n: int, rng: np.random.Generator) -> Points:
        """Return n points."""
        near = round(self._share * n)
        parts = [self.mixture.sample(n - near, rng)[0]]
        if near:
            centres = self.centres[rng.integers(len(self.centres), size=near)]
            parts.append(centres + _NEAR * rng.standard_normal((near, self.centres.shape[1])))
        return np.concatenate(parts)

    def log_density(self, z: Points) -> Vector:
        """Return (n,) log density at z (n, d)."""
        log_mixture = self.mixture.log_density(z)
        if not len(self.centres):
            return log_mixture
        d = z.shape[1]
        kernel = -0.5 * cdist(z, self.centres, "sqeuclidean") / _NEAR**2  # (n, k)
        norm = math.log(len(self.centres)) + d * math.log(_NEAR) + 0.5 * d * math.log(2.0 * math.pi)
        log_near = logsumexp(kernel, axis=1) - norm
        return np.logaddexp(log_mixture + math.log(1.0 - self._share), log_near + math.log(self._share))


def particles(target: LogTarget, start: Near, n: int, rng: np.random.Generator, candidates: int = 4000) -> Points:
    """Return (n, d) particles that approximately follow exp(target); none where the target is 0 at all candidates.

    Candidates are resampled, and the particles moved by Metropolis steps, along start^(1 - t) exp(target)^t: t grows as
    far as half of the particles keep their weight, so that a target far from the start, or sharp in many inputs, is met
    by many distinct particles.

    Args:
        target: (m, d) points to (m,) log density, not normalised; -inf is allowed.
        start: where the candidates come from.
        n: particles.
        rng: the only source of randomness.
        candidates: how many points the particles are first chosen from.

    Source:
        Del Moral, Doucet and Jasra (2006), doi 10.1111/j.1467-9868.2006.00553.x.
    """
    z = start.sample(candidates, rng)
    log_start, value = start.log_density(z), target(z)
    if not np.isfinite(value).any():
        return np.empty((0, z.shape[1]))
    temper, step, wanted = 0.0, _STEP, float(min(2 * n, candidates // 2))
    for level in range(_LEVELS):
        log_w = np.where(np.isfinite(value), value - log_start, -np.inf)
        grown = _tempered(log_w, 1.0 - temper, wanted) if level < _LEVELS - 1 else 1.0 - temper
        rows = _resampled(grown * log_w, n, rng)
        z, log_start, value = z[rows].copy(), log_start[rows].copy(), value[rows].copy()
        temper, wanted = temper + grown, _KEPT * n
        done = temper >= 1.0 - 1e-9
        for _ in range(_MOVES if done else _MOVES_BETWEEN):
            spread = z.std(axis=0) + 0.1
            a, b = rng.permutation(n), rng.permutation(n)
            jump = np.where(rng.random((n, 1)) < 0.5, 0.5 * (z[a] - z[b]), spread * rng.standard_normal(z.shape))
            new = z + step * jump * rng.random((n, 1)) * 2.0 / math.sqrt(z.shape[1])
            new_value, new_start = target(new), log_start if done else start.log_density(new)
            log_new = new_value if done else (1.0 - temper) * new_start + temper * new_value
            log_old = value if done else (1.0 - temper) * log_start + temper * value
            accept = np.log(rng.random(n)) < log_new - log_old
            z[accept], value[accept], log_start[accept] = new[accept], new_value[accept], new_start[accept]
            step *= _LONGER if accept.mean() > _ACCEPTANCE else _SHORTER
        if done:
            break
    return z


def reweighted(log_target: Vector, log_density: Vector, most: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return rows of points with this log density (m,), chosen so that they follow the target (m,), tempered if need be.

    A power of the weights below 1 keeps the effective sample size at a quarter of `most` or more; there are at most twice as
    many rows, since copies of a few points would pass for structure. None where the target is 0 everywhere.
    """
    log_w = np.where(np.isfinite(log_target), log_target - log_density, -np.inf)
    if not np.isfinite(log_w).any():
        return np.empty(0, dtype=np.intp)
    log_w = _tempered(log_w, 1.0, _FEWEST_DISTINCT * most) * log_w
    return _resampled(log_w, min(most, int(2.0 * effective_size(log_w)) + 1), rng)


def effective_size(log_w: Vector) -> float:
    """Return the effective number of points with these log weights (n,); 0 where all weights are 0."""
    top = float(log_w.max())
    if not np.isfinite(top):
        return 0.0
    w = np.exp(log_w - top)
    return float(w.sum() ** 2 / (w**2).sum())


def _resampled(log_w: Vector, n: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return n rows, each in proportion to its weight (m,), systematically."""
    edges = np.cumsum(np.exp(log_w - log_w.max()))
    return np.minimum(np.searchsorted(edges, (np.arange(n) + rng.random()) / n * edges[-1]), len(edges) - 1)


def _tempered(log_w: Vector, most: float, wanted: float) -> float:
    """Return the largest power <= most of the weights at which their effective sample size is at least `wanted`."""

    def size(power: float) -> float:
        return effective_size(power * log_w)

    if size(most) >= wanted:
        return most
    low, high = 0.0, most
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if size(middle) >= wanted else (low, middle)
    return max(low, 1e-3 * most)


def fit_mixture(
    clouds: tuple[Points, ...], wide: Vector, rng: np.random.Generator, inflate: float = 1.25,
    choices: tuple[ChoiceScore, ...] = (),
) -> Mixture:  # fmt: skip
    """Return the mixture whose normals are fitted to each cloud of particles, equal shares, by EM and BIC.

    Args:
        clouds: (n, d) particles each; those too small for a covariance are left out.
        wide: (d,) standard deviations of the wide component.
        rng: the only source of randomness.
        inflate: factor on the covariances: the tails of h must not be thinner than the target's.
        choices: the scores of inputs with choices.
    """
    parts = [
        _em(_ordered(cloud, choices), tuple(_taken(cloud, c) for c in choices), rng)
        for cloud in clouds if len(cloud) >= _FEWEST * cloud.shape[1]
    ]  # fmt: skip
    if not parts:
        return Mixture(wide, choices=choices)
    return Mixture(wide, Normals(
        np.concatenate([p.weight for p in parts]) / len(parts), np.concatenate([p.mean for p in parts]),
        math.sqrt(inflate) * np.concatenate([p.factor for p in parts]),
        tuple(np.concatenate(masses) for masses in zip(*(p.masses for p in parts), strict=True)),
    ), choices=choices)  # fmt: skip


def _columns(d: int, choices: tuple[ChoiceScore, ...]) -> list[int]:
    """Return the columns of the inputs without choices, of d."""
    nominal = {choice.column for choice in choices}
    return [k for k in range(d) if k not in nominal]


def _ordered(z: Points, choices: tuple[ChoiceScore, ...]) -> Points:
    """Return the scores (n, d - c) of the inputs without choices."""
    return np.ascontiguousarray(z[:, _columns(z.shape[1], choices)]) if choices else z


def _taken(z: Points, choice: ChoiceScore) -> Points:
    """Return (n, k) ones where a point takes a choice."""
    return np.eye(len(choice.shares))[choice.cells(z)]


def _em(z: Points, taken: tuple[Points, ...], rng: np.random.Generator) -> Normals:
    """Return the normals (and masses of choices) of best BIC among a few numbers of components."""
    n, d = z.shape
    free = 1 + d + d * (d + 1) / 2 + sum(t.shape[1] - 1 for t in taken)
    best, best_bic = None, math.inf
    for k in _COMPONENTS:
        if best is not None and n < _ROWS * k * (d + len(taken)):
            break
        normals, log_likelihood = _em_of(z, taken, k, rng)
        bic = -2.0 * log_likelihood + len(normals.weight) * free * math.log(n)
        if best is not None and bic >= best_bic:
            break  # more normals pay less and less
        best, best_bic = normals, bic
    if best is None:
        raise InputError(f"a mixture needs particles, but got {n}")
    return best


def _em_of(z: Points, taken: tuple[Points, ...], k: int, rng: np.random.Generator) -> tuple[Normals, float]:
    """Return k normals by expectation maximisation, started from far-apart particles, and their log likelihood."""
    n, d = z.shape
    total = np.cov(z.T).reshape(d, d) + 1e-6 * np.eye(d) if d else np.empty((0, 0))
    white = solve_triangular(np.linalg.cholesky(total), z.T, lower=True).T if d else z
    white = np.hstack([white, *taken])
    centres = [int(rng.integers(n))]
    nearest = np.full(n, np.inf)
    for _ in range(k - 1):
        nearest = np.minimum(nearest, ((white - white[centres[-1]]) ** 2).sum(axis=1))
        centres.append(int(rng.choice(n, p=nearest / nearest.sum())) if nearest.sum() > 0 else int(rng.integers(n)))
    label = np.argmin(((white[:, None] - white[centres]) ** 2).sum(axis=2), axis=1)
    belonging = np.eye(k)[label].T * _LABELLED + _ELSEWHERE / k  # (k, n)
    value = -math.inf
    for _ in range(_STEPS):
        model = _maximise(z, taken, belonging, total)
        terms = model.log_terms(z)
        for masses, one in zip(model.masses, taken, strict=True):
            terms = terms + np.log(masses) @ one.T
        log_total = logsumexp(terms, axis=0)
        belonging = np.exp(terms - log_total)
        if float(log_total.sum()) < value + 1e-3 * n:
            value = max(value, float(log_total.sum()))
            break
        value = float(log_total.sum())
    return model, value


def _maximise(z: Points, taken: tuple[Points, ...], belonging: Points, total: Points) -> Normals:
    """Return the normals of largest likelihood, given the probability (k, n) with which each particle belongs to them."""
    d = z.shape[1]
    mass = belonging.sum(axis=1)
    keep = mass > 1.0
    belonging, mass = belonging[keep], mass[keep]
    mean = belonging @ z / mass[:, None]
    factors = []
    for weights, centre, m in zip(belonging, mean, mass, strict=True):
        off = z - centre
        covariance = (weights * off.T) @ off / m
        prior = d + 2.0
        covariance = (m * covariance + prior * _PRIOR_SHAPE * total) / (m + prior) + 1e-4 * np.eye(d)
        factors.append(np.linalg.cholesky(covariance))
    masses = tuple((belonging @ one + 1.0 / one.shape[1]) / (mass[:, None] + 1.0) for one in taken)
    return Normals(mass / mass.sum(), mean, np.array(factors).reshape(len(mass), d, d), masses)

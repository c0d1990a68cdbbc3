"""The metamodel as the estimator uses it: P(critical) at points of the standard-normal space.

The metric is warped by asinh around the critical edge, on either side with the scale by which left-out runs are predicted best,
so that precision goes where critical meets uncritical and a far tail does not decide the length scales. A ridge trend carries
many inputs; a second fit without trend limits its confidence where it only extrapolates.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from sbt.estimators.leaps import leaping
from sbt.estimators.ridge import ridge_trend
from sbt.estimators.transfer import Trend, trended
from sbt.metamodels.base import Metamodel, Predictor, fitted, named_errors, predicted, sketched, with_target, without_repetitions
from sbt.metamodels.censored import Limit, beyond
from sbt.metamodels.gaps import better_without_gap
from sbt.metamodels.joint import joined_log_probability
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.rounded import in_steps
from sbt.metamodels.saturation import on_side, opened_and_limit
from sbt.metamodels.stacking import cell_shares, surely_positive
from sbt.metamodels.tails import student_mixture
from sbt.metamodels.warp import LogWarp, Warp
from sbt.metamodels.warped import better_warp
from sbt.problem.arrays import Points, Vector
from sbt.problem.combination import CombinedInterval
from sbt.problem.cube import Cube
from sbt.problem.requirement import CriticalInterval, as_passed
from sbt.problem.space import ParameterSpace

__all__ = [
    "MOST_LEARNED", "QUANTILE", "Coordinates", "JointLogProbability", "LogProbability", "fit_log_probability", "settled",
    "sketch_of",
]  # fmt: skip

LogProbability = Callable[[Points], tuple[Vector, Vector]]
"""(n, d) normal scores to (n,) log P(critical) and (n,) log P(uncritical)."""

MOST_LEARNED = 2000
"""Runs, drawn at random, that a Gaussian process of an estimation learns from at most: a proposal costs their square."""
_REACH = 5.0  # normal scores from -5 to 5 are the unit interval: 6e-7 of the distribution lies beyond
QUANTILE = 0.5  # of the distances to the edge: the scale of the warp; a smaller one becomes a step as runs gather there
_NOISE_COUNTS = 0.1  # of the usual distance to the edge: a standard deviation among repeats, beyond which it is learned in full
_FEWEST_SCORED = 16  # runs from which on forms are compared
_HELD_OUT, _MOST_SCORED = 3, 150  # one run in so many scores the forms, of at most so many
_SURE = 1.0  # gain in mean log density (nats a run) of a trend from which on it is trusted alone
_UNEVEN = 2.0  # standard errors by which noise that depends on the input has to predict left-out runs better


@dataclass(frozen=True)
class Coordinates:
    """From points of the standard-normal space to the inputs of the metamodel.

    A uniform input is taken on its range, every other one as its normal score with -5 to 5 as the unit
    interval, whole numbers at the middle of their cell, choices on an axis for each; the values of inputs that leap (`leaping`)
    and derived features of the space follow.
    """

    space: ParameterSpace

    @property
    def bounded(self) -> Vector:
        """(d,) 1 where the input is uniform on its range, else 0."""
        return np.array([float(p.truncated is None) for p in self.space.parameters])

    def __call__(self, z: Points) -> Points:
        """Return (n, d + f) coordinates of normal scores z (n, d)."""
        correlation = self.space.correlation
        scores = z if correlation is None else z @ np.linalg.cholesky(np.asarray(correlation)).T
        for k, p in enumerate(self.space.parameters):
            if p.kind == "integer":
                scores = scores.copy() if scores is z else scores
                scores[:, k] = p.to_normal(p.from_normal(scores[:, k]))
        own = np.where(self.bounded == 1, ndtr(scores), 0.5 + scores / (2.0 * _REACH))
        for k, p in enumerate(self.space.parameters):
            if p.choices:
                own[:, k] = p.to_unit(p.from_normal(scores[:, k]))
        own = Cube(nominal=self.space.cube.nominal).embedded(own)
        further = [np.interp(scores[:, k], *values) for k, values in self._leaping]
        if self.space.features:
            u = self.space.to_unit(self.space.from_normal(z))
            further.append(self.space.metamodel_inputs(u)[:, own.shape[1] :])
        return np.column_stack([own, *further]) if further else np.ascontiguousarray(own)

    @cached_property
    def _leaping(self) -> tuple[tuple[int, tuple[Vector, Vector]], ...]:
        found = ((k, leaping(p)) for k, p in enumerate(self.space.parameters))
        return tuple((k, values) for k, values in found if values is not None)


@dataclass(frozen=True)
class JointLogProbability:
    """P(critical) of a combination from those of its metrics.

    Args:
        critical: which combination.
        parts: (q,) P(critical) of each metric.
    """

    critical: CombinedInterval
    parts: tuple[LogProbability, ...]

    def __call__(self, points: Points) -> tuple[Vector, Vector]:
        """Return (n,) log P(critical) and (n,) log P(uncritical)."""
        return joined_log_probability(self.critical, [part(points) for part in self.parts])

    def sketch(self, rows: int) -> JointLogProbability:
        """Return about the same, learned from fewer runs."""
        return replace(self, parts=tuple(sketch_of(part, rows) for part in self.parts))

    def settled(self, most: float) -> JointLogProbability:
        """Return what would be left to chance if the metrics' means were known."""
        return replace(self, parts=tuple(settled(part, most) for part in self.parts))


def settled(log_probability: LogProbability, most: float) -> LogProbability:
    """Return what would be left to chance if means were known: noise alone, at most so many times the variance that it must have.

    It is itself where nothing tells them apart.
    """
    known: Any = getattr(log_probability, "settled", None)
    return log_probability if known is None else known(most)


def sketch_of(log_probability: LogProbability, rows: int) -> LogProbability:
    """Return about the same, learned from so many runs and many times quicker; itself where that would gain nothing."""
    sketch: Any = getattr(log_probability, "sketch", None)
    return log_probability if sketch is None else sketch(rows)


@dataclass(frozen=True, eq=False)
class _Form:
    """In which form the metric is learned: warped or as it is, whole or what a trend leaves of it.

    Args:
        values: (n,) what is learned, the trend included.
        interval: M_c in its unit.
        log_slope: (n,) log of its derivative by the metric.
        trend: at the metamodel's inputs; None: the whole metric is learned.
        noise: smallest variance of the noise, in its unit.
        limit: what is known, in its unit, of runs with the value that the metric ends with; None: there are none.
    """

    values: Vector
    interval: CriticalInterval
    log_slope: Vector
    trend: Callable[[Points], Vector] | None = None
    noise: float = 0.0
    limit: Limit | None = None

    def fit(self, metamodel: Metamodel, u: Points, rows: NDArray[np.intp], rng: np.random.Generator) -> _Learned:
        """Return the predictor of the values, learned from some rows of u (n, d)."""
        values = self.values if self.trend is None else self.values - self.trend(u)
        target = with_target(metamodel, self.interval) if self.trend is None else metamodel
        predictor = fitted(target, u[rows], values[rows], rng)
        less = self.trend(self.limit.u) if self.limit is not None and self.trend is not None else 0.0
        limit = None if self.limit is None else self.limit.moved(lambda value: value - less)
        return _Learned(self, beyond(predictor, limit), metamodel, len(u))


@dataclass(frozen=True, eq=False)
class _Learned:
    """The predictor of a form's values.

    Args:
        form: what is learned.
        predictor: of what the trend leaves.
        metamodel, n: what was fitted, and to how many runs; errors name them.
        tails: factors on the standard deviation, and their probabilities; None: errors are Gaussian.
    """

    form: _Form
    predictor: Predictor
    metamodel: Metamodel
    n: int
    tails: tuple[Vector, Vector] | None = None

    def __call__(self, inputs: Points) -> Prediction:
        """Return the prediction of the values at the metamodel's inputs (n, d)."""
        with named_errors(self.metamodel, self.n):
            p = self._noisy(predicted(self.predictor, inputs))
        p = p if self.tails is None else p.with_tails(*self.tails)
        trend = self.form.trend
        return p if trend is None else Prediction(p.mean + trend(inputs), p.std, p.weight, p.noise)

    def _noisy(self, p: Prediction) -> Prediction:
        """Return the prediction with at least the noise among repeats."""
        if self.form.noise <= 0.0:
            return p
        lacking = np.maximum(self.form.noise - p.noise**2, 0.0)
        return Prediction(p.mean, np.sqrt(p.std**2 + lacking), p.weight, np.sqrt(p.noise**2 + lacking))

    def settled(self, most: float) -> _Learned:
        """Return the same without doubt about the mean, and with noise of at most so many times the form's variance."""
        largest = math.sqrt(most * self.form.noise)

        def predict(inputs: Points) -> Prediction:
            p = self._noisy(predicted(self.predictor, inputs))
            noise = np.maximum(np.minimum(p.noise, largest), 1e-12 * p.sigma)
            return Prediction.gaussian(p.mu, noise, noise)

        return replace(self, predictor=predict, form=replace(self.form, noise=0.0))

    def with_tails(self, u: Points) -> _Learned:
        """Return the same with tails as heavy as left-out runs at u (n, d) show, where the predictor tells these."""
        left_out = getattr(self.predictor, "leave_one_out", None)
        if left_out is None:
            return self
        values = self.form.values if self.form.trend is None else self.form.values - self.form.trend(u)
        p = self._noisy(left_out(u, values))
        return replace(self, tails=student_mixture((values - p.mu) / p.sigma))


@dataclass(frozen=True, eq=False)
class _Largest:
    """The largest P(critical) of a few fits.

    Args:
        coordinates: normal scores to the metamodel's inputs.
        learned: the fits.
    """

    coordinates: Callable[[Points], Points]
    learned: tuple[_Learned, ...]

    def __call__(self, points: Points) -> tuple[Vector, Vector]:
        """Return (n,) log P(critical) and (n,) log P(uncritical)."""
        inputs = self.coordinates(points)
        each = [predict(inputs).log_probability(predict.form.interval) for predict in self.learned]
        log_pi, log_not = each[0]
        for other_pi, other_not in each[1:]:
            larger = other_pi > log_pi
            log_pi, log_not = np.where(larger, other_pi, log_pi), np.where(larger, other_not, log_not)
        return log_pi, log_not

    def sketch(self, rows: int) -> _Largest:
        """Return about the same, learned from fewer runs."""
        return replace(self, learned=tuple(replace(each, predictor=sketched(each.predictor, rows)) for each in self.learned))

    def settled(self, most: float) -> _Largest:
        """Return what would be left to chance if the means were known."""
        return replace(self, learned=tuple(each.settled(most) for each in self.learned))


def fit_log_probability(
    metamodel: Metamodel, coordinates: Callable[[Points], Points], critical: CriticalInterval, z: Points, y: Vector,
    rng: np.random.Generator, noise: Sequence[float] = (), earlier: Sequence[Trend] = (),
) -> LogProbability:  # fmt: skip
    """Return P(critical) as learned from n >= 2 runs at normal scores z (n, d) with metrics y (n,).

    Of a combination y is (n, q): each metric is learned by itself.

    Held-out runs near the boundary tell in which form the metric is predicted best: warped or as it is, whole or without a
    trend. A trend that wins by far is trusted alone; else the larger P of two fits counts. What an earlier campaign knows is a
    trend; of a very noisy simulator, or a metric that ends or comes in steps, it is one more input instead, so that these are
    learned as ever.

    Args:
        metamodel: learns the metric.
        coordinates: normal scores to the metamodel's inputs.
        critical: M_c.
        z: normal scores of the runs.
        y: their metrics.
        rng: the only source of randomness.
        noise: variance of each metric among runs of the same inputs, as repeats tell, that of the metamodel is not allowed to
            be smaller; empty: nothing is known of it.
        earlier: each metric in an earlier campaign, used where runs are better predicted with it; with it no run is needed.
    """
    if isinstance(critical, CombinedInterval):
        known = np.isfinite(y)
        parts = [
            fit_log_probability(
                metamodel, coordinates, leaf, z[known[:, k]], y[known[:, k], k], rng, noise[k : k + 1], earlier[k : k + 1]
            )
            for k, leaf in enumerate(critical.leaves)
        ]
        return JointLogProbability(critical, tuple(parts))
    u = coordinates(z)
    y = on_side(u, y, critical)
    critical, least = as_passed(critical, y), noise[0] if noise else 0.0
    measured, (y, limit) = y, opened_and_limit(u, y, critical, rng)
    noisy = bool(earlier) and math.sqrt(least) > _NOISE_COUNTS * earlier[0].warp.scale
    if earlier and len(y) >= _FEWEST_SCORED and (noisy or limit is not None or in_steps(u, measured, critical)):
        coordinates = earlier[0].beside(coordinates)
        u = coordinates(z)
        y, limit = opened_and_limit(u, measured, critical, rng)
    elif earlier:
        warp = earlier[0].warp
        belief, edges = trended(metamodel, earlier[0], u, z, warp.values(y), rng), warp.interval(critical)
        if belief is not None:
            return lambda points: belief(coordinates(points), points).log_probability(edges)
    better = _better_warp(metamodel, u, y, critical)
    warp = better or Warp.around_edge(y, critical, quantile=QUANTILE)
    t = warp.values(y)
    metamodel = _for_uneven_noise(metamodel, u, t, rng) if least > 0.0 else metamodel
    smallest = _noise_in(warp, z, y, least)
    warped = None if limit is None else limit.moved(warp.values)
    whole = _Form(t, warp.interval(critical), warp.log_slope(y), noise=smallest, limit=warped)
    plain = _Form(y, critical, np.zeros(len(y)), noise=least, limit=limit)
    wholes = [whole] if better else [whole, plain]
    trends = [replace(form, trend=ridge_trend(u, form.values)) for form in wholes]
    forms = [*wholes, *(form for form in trends if form.trend is not None)]
    if least == 0.0 and (sided := _sided(metamodel, whole, u, rng)) is not None:
        return _Largest(coordinates, (sided,))
    every = np.arange(len(y))
    if len(y) > MOST_LEARNED and getattr(metamodel, "CUBIC", False):
        every = np.sort(rng.permutation(len(y))[:MOST_LEARNED])
    if len(y) < _FEWEST_SCORED:
        chosen = [whole, *forms[len(wholes) :][:1]]
    else:
        gain = _gains(metamodel, forms, u, np.exp(-0.5 * t**2), rng)
        best = int(np.argmax(gain))
        sure = forms[best].trend is None or gain[best] > _SURE
        chosen = [forms[best]] if sure else [whole, forms[best]]
    learned = (form.fit(metamodel, u, every, rng) for form in chosen)
    return _Largest(coordinates, tuple(each.with_tails(u) if least > 0.0 and len(every) == len(y) else each for each in learned))


def _noise_in(warp: Warp, z: Points, y: Vector, variance: float) -> float:
    """Return a variance of noise in the unit of a warp: by its slope at the edge; of a log by what equal inputs z (n, d) gave.

    A few repeats far beyond the edge, where noise is a share of the value, would decide it for the edge.
    """
    if variance == 0.0 or not isinstance(warp, LogWarp):
        return variance / (warp.scale * float(warp.scale_at(np.array(1.0))))
    group = np.unique(z, axis=0, return_inverse=True)[1].reshape(-1)
    count = np.bincount(group)
    warped, own = (((t - (np.bincount(group, t) / count)[group]) ** 2).sum() for t in (warp.values(y), y))
    return variance * float(warped / own) if own > 0.0 else variance / warp.edge**2


def _better_warp(metamodel: Metamodel, u: Points, y: Vector, critical: CriticalInterval) -> Warp | None:
    """Return the warp in which left-out runs are predicted better than as they are; None: there is none, or no process learns."""
    from sbt.metamodels.gaussian_process import GaussianProcess

    if not isinstance(metamodel, GaussianProcess):
        return None
    warp = better_warp(metamodel, u, y, critical)
    other = warp or Warp.around_edge(y, critical, quantile=QUANTILE)
    return better_without_gap(metamodel, *without_repetitions(u, y), critical, other) or warp


def _sided(metamodel: Metamodel, form: _Form, u: Points, rng: np.random.Generator) -> _Learned | None:
    """Return a process of the sides where the metric jumps at the edge and they are better known so; see `better_sided`."""
    from sbt.metamodels.gaussian_process import GaussianProcess
    from sbt.metamodels.sided import better_sided
    from sbt.metamodels.stepped import jumps

    if not isinstance(metamodel, GaussianProcess) or len(u) > MOST_LEARNED or not jumps(form.values, form.interval):
        return None
    u, t = without_repetitions(u, form.values)
    found = better_sided(metamodel, metamodel.fit(u, t, rng), form.interval, u, t, cell_shares(u, rng), rng)
    return None if found is None else _Learned(form, found[0], metamodel, len(u))


def _for_uneven_noise(metamodel: Metamodel, u: Points, t: Vector, rng: np.random.Generator) -> Metamodel:
    """Return the metamodel, with noise that depends on the input where that surely predicts left-out values t (n,) better.

    Where noise is larger than elsewhere, more runs are critical than one noise for all lets expect.
    """
    uneven: Metamodel | None = getattr(metamodel, "with_input_noise", None)
    if uneven is None:
        return metamodel
    rows = rng.permutation(len(t))[:_MOST_SCORED]
    u, t = without_repetitions(u[rows], t[rows])
    scores = []
    for each in (metamodel, uneven):
        predictor: Any = each.fit(u, t, rng)
        scores.append(predictor.leave_one_out(u, t).log_density(t))
    return uneven if surely_positive(scores[1] - scores[0], _UNEVEN) else metamodel


def _gains(metamodel: Metamodel, forms: list[_Form], u: Points, weight: Vector, rng: np.random.Generator) -> Vector:
    """Return by how much each form predicts held-out runs better than the first: log density, with the runs' weights (n,)."""
    rows = rng.permutation(len(u))[:_MOST_SCORED]
    held_out, learned = rows[: len(rows) // _HELD_OUT], rows[len(rows) // _HELD_OUT :]
    scores = []
    for form in forms:
        if form.trend is not None:
            rest = ridge_trend(u[learned], form.values[learned])
            if rest is None:
                scores.append(-np.inf)
                continue
            form = replace(form, trend=rest)
        prediction = form.fit(metamodel, u, learned, rng)(u[held_out])
        log_density = prediction.log_density(form.values[held_out]) + form.log_slope[held_out]
        scores.append(float(np.average(log_density, weights=weight[held_out] + 1e-9)))
    return np.array(scores) - scores[0]

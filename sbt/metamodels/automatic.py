"""The default: a Gaussian process, extra-trees and a deep ensemble, mixed by how well they predict.

Their weights come from runs that they were not fitted to, not from the number of runs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from sbt.errors import InputError
from sbt.metamodels.base import (
    Metamodel,
    Predictor,
    Screened,
    check_rows,
    is_flag,
    once,
    sample_paths,
    sketched,
    without_repetitions,
)
from sbt.metamodels.censored import Limit, beyond
from sbt.metamodels.deep_ensemble import Ensemble
from sbt.metamodels.extra_trees import ExtraTrees
from sbt.metamodels.flags import flag_process
from sbt.metamodels.gaps import better_without_gap
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.labelled import better_labelled
from sbt.metamodels.noise_shape import better_uneven, shaped
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.rounded import Rounding, better_rounded, without_unit
from sbt.metamodels.sided import better_sided
from sbt.metamodels.stacking import Bins, cell_shares, held_out_scores, is_surely_better, mixture_score, stacking_weights
from sbt.metamodels.stepped import better_stepped
from sbt.metamodels.torch_tools import check_device
from sbt.metamodels.warp import Warp
from sbt.metamodels.warped import WarpedPredictor, better_warp
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval

__all__ = ["Auto", "MixturePredictor", "ModelComparison"]

_FEWEST = 10  # rows from which on models are compared: with three folds each learns from at least six
_NEARLY = 0.85  # of the rows that are compared: one fold of 360 will do for 400, as another costs another fit of all models
_WORTH = 0.03  # nats a row, of 0.5 to 2 in all: what is left to gain below it cannot be worth other models
_NOTHING = 1e-6  # nats, below which a number tells nothing more
_LOWEST_TOLD = -99.0  # mean log likelihood of a row, below which nothing but that is told
_LEAST = 0.02  # weight below which a model is left out: its predictions would cost more time than they change
_PACED, _LEAST_PACED, _FASTEST = 1000, 200, 2.0  # rows below which the ensemble takes fewer steps; least; largest factor


@dataclass(frozen=True)
class Auto:
    """Settings of the automatic metamodel.

    Each model is scored on rows it was not fitted to (cross-validation); the weights are those of
    largest likelihood of the mixture there, shrunk a little to equal ones. Then the models that have a weight are
    fitted to all rows. Too few rows to score: equal weights of `gp` and `et`. The preset `quick`, for fits after
    every batch, takes about a quarter of the time: a smaller ensemble, two folds of at most 400 rows, and none below 300.

    For a known critical interval (`with_target`) the metric is learned in the unit of `better_warp`, where that is better
    without a gap beside the edge (`gaps`), and the score is not the density of y but the probability of the range that it fell
    into (see `Bins`). The process leaves out one row at a time, in closed form; the others learn from 80 % of the rows, 90 %
    from 1,000 rows on where all rows are compared (or ten folds are needed to hold as many as are). The first model, `gp` with
    nu 2.5 and one noise, is taken alone unless the mixture is better by three standard errors, and better over the space, too
    (rows crowd at the edge, where a mixture that hedges looks better than it is). Where the metric jumps at the edge, `gp`
    learns a widened jump if that predicts the sides better (see `stepped`); of a noisy one, noise that depends on the inputs
    (`noise_shape`), or beside the values how often runs are critical (`labelled`); of two values, labels (`flags`); of one that
    comes in steps, or ends, the range that each run tells (`rounded`). Where it leaves next to nothing to gain, the others are
    not even tried.

    Args:
        folds: of the cross-validation, >= 2.
        prior: weight >= 0 of equal weights, in rows.
        members: networks of the ensemble, >= 2.
        pace: fraction in (0, 1] of the ensemble's steps that are taken.
        ensemble_rows: rows from which on the ensemble takes part, >= 2.
        gp_rows: rows up to which the Gaussian process takes part, >= 2.
        compare_rows: most rows that the models are compared on, >= 10; drawn by the rng.
        device: auto (CUDA where there is one), cpu or cuda; for the Gaussian process and the ensemble.

    Raises:
        InputError: a value outside its range; at the fit, a device that is not available.

    Source:
        Yao et al. (2018), Using stacking to average Bayesian predictive distributions.
    """

    folds: int = 3
    prior: float = 5.0
    members: int = 10
    pace: float = 1.0
    ensemble_rows: int = 100
    gp_rows: int = 4000
    compare_rows: int = 4000
    device: str = "cpu"

    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "quick": {"folds": 2, "members": 5, "pace": 0.6, "ensemble_rows": 300, "compare_rows": 400}
    }  # fmt: skip

    def __post_init__(self) -> None:
        for name in ("folds", "members", "ensemble_rows", "gp_rows"):
            if not getattr(self, name) >= 2:
                raise InputError(f"{name} must be >= 2, but got {getattr(self, name)}")
        if not self.compare_rows >= _FEWEST:
            raise InputError(f"compare_rows must be >= {_FEWEST}, but got {self.compare_rows}")
        if not 0.0 < self.pace <= 1.0:
            raise InputError(f"pace must be in (0, 1], but got {self.pace}")
        if not self.prior >= 0.0:
            raise InputError(f"prior must be >= 0, but got {self.prior}")
        check_device(self.device)

    def fit(self, u: Points, y: Vector, rng: np.random.Generator) -> MixturePredictor:
        """Return the mixture fitted to u (n, d) and y (n,); see `Metamodel.fit`."""
        return self._fit(*without_repetitions(*check_rows(u, y)), rng, None)

    @property
    def simplest(self) -> GaussianProcess:
        """The metamodel of searches, where there is no time to compare: the process that a known target starts from."""
        return GaussianProcess(nu=2.5, input_noise=False, device=self.device)

    def with_target(self, critical: CriticalInterval) -> _TargetedAuto:
        """Return the same settings for runs whose critical interval is known."""
        return _TargetedAuto(self, critical)

    def _fit(
        self, u: Points, y: Vector, rng: np.random.Generator, critical: CriticalInterval | None, warp: Warp | None = None,
        told: Rounding | None = None,
    ) -> MixturePredictor:  # fmt: skip
        """Fit to y and M_c, both in the unit of the warp where there is one; `told`: by a metric that comes in steps."""
        n = len(y)
        if critical is not None and _FEWEST <= n <= self.gp_rows:
            return self._fit_at_edge(u, y, rng, Bins.around_edge(y, critical, warp), told)
        bins = None if critical is None else Bins.around_edge(y, critical, warp)
        models, compared = self._models(n, n, target_aware=bins is not None), min(n, self.compare_rows)
        if n < _FEWEST:
            weights, scores = np.full(len(models), 1.0 / len(models)), None
        else:
            rows = rng.permutation(n)[:compared] if compared < n else slice(None)
            rivals = self._models(n, compared, target_aware=bins is not None).values()
            scores, _ = held_out_scores(rivals, u[rows], y[rows], self.folds, rng, bins)
            weights = stacking_weights(scores, self.prior)
        comparison = _explain(list(models), weights, scores, compared, self, bins)
        return self._mixed(models, {}, comparison, u, y, rng)

    def _fit_at_edge(
        self, u: Points, y: Vector, rng: np.random.Generator, bins: Bins, told: Rounding | None = None
    ) -> MixturePredictor:
        """Return the process alone, or the mixture where it is better for where the runs fell, at the edge and over the space."""
        n, models = len(y), self._models(len(y), len(y), target_aware=True)
        flag = flag_process(bins.critical, u, y, rng) if bins.critical.one_sided and is_flag(y, bins.critical) else None
        bins = replace(bins, near=np.inf) if told is not None or flag else bins  # no ranges between two steps
        process, own, bins, shares = (*flag, bins, cell_shares(u, rng)) if flag else self._process_at_edge(u, y, rng, bins, told)
        if max(-float(own.mean()), -float(shares @ own)) < _WORTH:
            missed = max(-float(own.mean()), _NOTHING)
            left = f"of {n} rows, each predicted from all others, {missed:.1g}: others could add no more"
            reason = f"100 % gp: it misses a mean log likelihood {left}"
            comparison = ModelComparison({name: float(name == "gp") for name in models}, {"gp": float(own.mean())}, reason)
            return self._mixed(models, {"gp": process}, comparison, u, y, rng)
        folds = max(self.folds, 5 if n < 1000 else 10 if self.compare_rows >= n else min(max(n // self.compare_rows, 5), 10))
        rivals = self._models(n, n - n // folds, target_aware=True)
        enough = self.compare_rows if n < 1000 or self.compare_rows >= n else round(_NEARLY * self.compare_rows)
        others, rows = held_out_scores([rivals[k] for k in rivals if k != "gp"], u, y, folds, rng, bins, enough)
        scores = np.vstack([own[rows], others])
        shares = shares[rows]
        weights = stacking_weights(scores, self.prior, 0.5 + 0.5 * len(rows) * shares / shares.sum())
        comparison = _explain(list(models), weights, scores, len(rows), self, bins, shares)
        return self._mixed(models, {"gp": process}, comparison, u, y, rng)

    def _process_at_edge(
        self, u: Points, y: Vector, rng: np.random.Generator, bins: Bins, told: Rounding | None
    ) -> tuple[Predictor, Vector, Bins, Vector]:
        """Return a process that knows the edge, the score of each row by all others, what is scored, and shares of the space."""
        plain, shares = self.simplest.fit(u, y, rng), cell_shares(u, rng)
        stepped = better_stepped(self.simplest, plain, bins.critical, u, y, shares, rng)
        even = plain if stepped is not None else better_uneven(self.simplest, plain, bins.critical, u, y, shares, rng) or plain
        values = (shaped(even, u, y, bins.critical, rng) or even) if stepped is None else stepped
        own = stepped.log_score(bins, u, y) if stepped is not None else bins.log_score(values.leave_one_out(u, y), y)
        sided = better_sided(self.simplest, values, bins.critical, u, y, shares, rng)
        own = own if sided is None else own + sided[1]
        process: Predictor = values if sided is None else sided[0]
        labelled = better_labelled(self.simplest, values, bins.critical, u, y, shares, rng)
        if labelled is not None:  # of ranges beside the edge labels tell nothing
            (process, own), bins = labelled, replace(bins, near=np.inf)
        rounded = None if told is None else better_rounded(told, own, bins.critical, u, y, bins.warp, shares, rng)
        process = process if rounded is None else rounded[0]
        own = own if rounded is None else own + rounded[1]
        return process, own, bins, shares

    def _mixed(
        self, models: Mapping[str, Metamodel], fitted: Mapping[str, Predictor], comparison: ModelComparison, u: Points, y: Vector,
        rng: np.random.Generator,
    ) -> MixturePredictor:  # fmt: skip
        """Return the mixture of the models that have a weight; those that are not fitted to all rows yet will be."""
        weight = {name: comparison.weights[name] for name in models if comparison.weights[name] > 0.0}
        predictors = tuple(fitted[name] if name in fitted else models[name].fit(u, y, rng) for name in weight)
        return MixturePredictor(predictors, np.array(list(weight.values())), comparison)

    def _models(self, n: int, learned: int, *, target_aware: bool) -> dict[str, Metamodel]:
        """Return the models that take part with n rows, to be fitted to `learned` of them."""
        models: dict[str, Metamodel] = {}
        if n <= self.gp_rows:
            models["gp"] = self.simplest if target_aware else GaussianProcess(device=self.device)
        models["et"] = ExtraTrees()
        if n >= self.ensemble_rows:
            models["ensemble"] = _paced(learned, Ensemble(members=self.members, device=self.device), self.pace)
        return models


@dataclass(frozen=True)
class _TargetedAuto:
    """`Auto` that knows what is critical."""

    settings: Auto
    critical: CriticalInterval
    told: Rounding | None = None

    def with_target(self, critical: CriticalInterval) -> _TargetedAuto:
        """Return the same settings for another interval."""
        return _TargetedAuto(self.settings, critical)

    def with_rounding(self, told: Rounding) -> _TargetedAuto:
        """Return the same settings for rows of a metric that comes in steps, and what each of them tells."""
        return replace(self, told=told)

    def fit(self, u: Points, y: Vector, rng: np.random.Generator) -> MixturePredictor | WarpedPredictor:
        """Return the mixture fitted to u (n, d) and y (n,), in the unit of `better_warp`; see `Metamodel.fit`."""
        u, y = check_rows(u, y)
        kept = once(u, y)
        u, y, told = u[kept], y[kept], None if self.told is None else self.told.take(kept)
        warp = better_warp(self.settings.simplest, u, y, self.critical)
        warp = better_without_gap(self.settings.simplest, u, y, self.critical, warp) or warp
        if warp is None or (told is not None and without_unit(told, self.critical, u, y, warp, rng)):
            return self.settings._fit(u, y, rng, self.critical, told=told)
        warp = warp.reaching(y)
        return WarpedPredictor(self.settings._fit(u, warp.values(y), rng, warp.interval(self.critical), warp, told), warp)


def _paced(n: int, full: Ensemble, pace: float) -> Ensemble:
    """Return the ensemble with fewer and larger steps below 1,000 rows: it is fitted once a fold and once more.

    >>> [_paced(n, Ensemble(), 1.0).steps for n in (200, 500, 5000)]
    [500, 1250, 2500]
    """
    fraction = min(max(n, _LEAST_PACED) / _PACED, 1.0)
    faster = min(fraction**-0.5, _FASTEST)
    return replace(full, steps=round(fraction * pace * full.steps), learning_rate=full.learning_rate * faster)


@dataclass(frozen=True)
class ModelComparison:
    """The models that were compared, and their weights.

    Attributes:
        weights: of each model that took part, by name; 0: left out.
        scores: mean log likelihood of each model on rows it was not fitted to, and of the `mixture`;
            empty where there were too few rows.
        reason: the same in words.
    """

    weights: Mapping[str, float]
    scores: Mapping[str, float]
    reason: str


@dataclass(frozen=True, eq=False)
class MixturePredictor:
    """A mixture of predictors.

    Args:
        predictors: of each model with a weight > 0.
        weight: of each, > 0, sum 1.
        comparison: of the models that took part.
    """

    predictors: tuple[Predictor, ...]
    weight: Vector
    comparison: ModelComparison

    def probability_bounds(self, u: Points, critical: CriticalInterval) -> tuple[Vector, Vector]:
        """Return (n,) lower and (n,) upper bounds of P(y in M_c): quick where the predictors have quick ones."""
        low, high = np.zeros(len(u)), np.zeros(len(u))
        for weight, predict in zip(self.weight, self.predictors, strict=True):
            if isinstance(predict, Screened):
                ends = predict.probability_bounds(u, critical)
            else:
                p = predict(u).probability(critical)
                ends = p * (1.0 - 1e-9), p * (1.0 + 1e-9)
            low, high = low + weight * ends[0], high + weight * ends[1]
        return low, np.minimum(high, 1.0)

    def beyond(self, limit: Limit) -> MixturePredictor:
        """Return the mixture of predictors that know the limit, where they can."""
        return replace(self, predictors=tuple(beyond(p, limit) for p in self.predictors))

    def sketch(self, rows: int) -> MixturePredictor:
        """Return the mixture of the predictors' sketches, or of themselves where they have none."""
        return MixturePredictor(tuple(sketched(p, rows) for p in self.predictors), self.weight, self.comparison)

    def sample_paths(self, u: Points, n: int, rng: np.random.Generator) -> Points:
        """Return (n, m) draws of y as a function at u (m, d), each by one of the predictors."""
        counts = rng.multinomial(n, self.weight)
        return np.concatenate([sample_paths(p, u, k, rng) for p, k in zip(self.predictors, counts.tolist(), strict=True)])

    def __call__(self, u: Points) -> Prediction:
        """Return the prediction at u (n, d)."""
        return Prediction.mixture_of([predict(u) for predict in self.predictors], self.weight)


def _explain(
    names: list[str], weights: Vector, held: Points | None, n: int, settings: Auto, bins: Bins | None,
    shares: Vector | None = None,
) -> ModelComparison:  # fmt: skip
    """Return the comparison, with weight 0 for models that have little; `shares` of the space: each row was left out in turn."""
    mixture = np.where(weights >= _LEAST, weights, 0.0)
    mixture /= mixture.sum()
    alone = held is not None and bins is not None and not is_surely_better(held, mixture, shares)
    final = np.eye(len(names))[0] if alone else mixture
    by_name = {name: float(w) for name, w in zip(names, final, strict=True)}
    mixed = ", ".join(f"{100 * w:.0f} % {name}" for name, w in by_name.items() if w > 0.0)
    if held is None:
        reason = f"{mixed}: {n} rows are too few to compare models (from {_FEWEST} on)"
        return ModelComparison(by_name, {}, reason)
    scores = {name: float(row.mean()) for name, row in zip(names, held, strict=True)}
    scores["mixture"] = float(mixture_score(held, mixture).mean())
    listed = ", ".join(f"{name} {_told(score)}" for name, score in scores.items())
    what = "" if bins is None else f" to fall where they did, of the ranges cut at {bins.told}"
    how = f"other rows ({settings.folds} folds)" if shares is None else "nearly all others"
    reason = f"{mixed}: mean log likelihood of {n} rows{what}, each predicted from {how}: {listed}"
    if alone and len(names) > 1:
        reason += f" (not better than {names[0]} by three standard errors{'' if shares is None else ', and over the space'})"
    if "ensemble" not in names:
        reason += f"; the ensemble takes part from {settings.ensemble_rows} rows on"
    if "gp" not in names:
        reason += f"; the gp takes part up to {settings.gp_rows} rows"
    return ModelComparison(by_name, scores, reason)


def _told(score: float) -> str:
    return f"{score:.2f}" if score >= _LOWEST_TOLD else f"below {_LOWEST_TOLD:g}"

"""The default: a Gaussian process, extra-trees and a deep ensemble, mixed by how well they predict.

What each is worth is decided by runs that it had not seen, not by the number of runs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from sbt.errors import InputError
from sbt.metamodels.base import Metamodel, Predictor, Screened, check_rows, sample_paths
from sbt.metamodels.deep_ensemble import Ensemble
from sbt.metamodels.extra_trees import ExtraTrees
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.stacking import Bins, held_out, mixture_score, stacked, surely_better
from sbt.metamodels.torch_tools import check_device
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval

__all__ = ["Auto", "MixturePredictor", "ModelComparison"]

_FEWEST = 10  # rows from which on a score on held-out rows says something
_LEAST = 0.02  # weight below which a model is left out


@dataclass(frozen=True)
class Auto:
    """Settings of the automatic choice.

    Each model is scored on rows it was not fitted to (cross-validation); the weights are those of
    largest likelihood of the mixture there, shrunk a little to equal ones. Then the models that have a weight are
    fitted to all rows. Too few rows to score: equal weights of `gp` and `et`. The preset `quick`, for fits after
    every batch, takes about a quarter of the time: a smaller ensemble, two folds of at most 400 rows, and none below 300.

    A campaign that looks for the critical edge tells where it is (`with_target`). Then what counts is not the density of y
    but the probability of the range that it fell into (see `Bins`), and the first model, `gp` with nu 2.5 and one noise, is
    believed alone unless the mixture is better by three standard errors: rows crowd at the edge, where a mixture that
    hedges looks better than it is over the space.

    Args:
        folds: of the cross-validation, >= 2.
        prior: rows >= 0 that speak for equal weights.
        members: networks of the ensemble, >= 2.
        pace: share in (0, 1] of the ensemble's steps that are taken.
        ensemble_rows: rows from which on the ensemble takes part, >= 2.
        gp_rows: rows up to which the Gaussian process takes part, >= 2.
        compare_rows: most rows that the models are compared on, >= 10; chosen by the rng.
        device: auto (CUDA where there is one), cpu or cuda; for the Gaussian process and the ensemble.

    Raises:
        InputError: a value outside its range; at the fit, a device that is not there.

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
        return self._fit(u, y, rng, None)

    @property
    def simplest(self) -> Metamodel:
        """What is believed about the critical edge where there is no time to compare."""
        return GaussianProcess(nu=2.5, input_noise=False, device=self.device)

    def with_target(self, critical: CriticalInterval) -> _TargetedAuto:
        """Return the same settings for runs whose critical interval is known."""
        return _TargetedAuto(self, critical)

    def _fit(self, u: Points, y: Vector, rng: np.random.Generator, critical: CriticalInterval | None) -> MixturePredictor:
        u, y = check_rows(u, y)
        n, bins, target_aware = len(y), None if critical is None else Bins.around_edge(y, critical), critical is not None
        models, compared = self._models(n, n, target_aware=target_aware), min(n, self.compare_rows)
        if n < _FEWEST:
            weights, scores = np.full(len(models), 1.0 / len(models)), None
        else:
            rows = rng.permutation(n)[:compared] if compared < n else slice(None)
            rivals = self._models(n, compared, target_aware=target_aware).values()
            scores = held_out(rivals, u[rows], y[rows], self.folds, rng, bins)
            weights = stacked(scores, self.prior)
        comparison = _explain(list(models), weights, scores, compared, self, bins)
        kept = {name: model for name, model in models.items() if comparison.weights[name] > 0.0}
        predictors = tuple(model.fit(u, y, rng) for model in kept.values())
        return MixturePredictor(predictors, np.array([comparison.weights[name] for name in kept]), comparison)

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

    def with_target(self, critical: CriticalInterval) -> _TargetedAuto:
        """Return the same settings for another interval."""
        return _TargetedAuto(self.settings, critical)

    def fit(self, u: Points, y: Vector, rng: np.random.Generator) -> MixturePredictor:
        """Return the mixture fitted to u (n, d) and y (n,); see `Metamodel.fit`."""
        return self.settings._fit(u, y, rng, self.critical)


def _paced(n: int, full: Ensemble, pace: float) -> Ensemble:
    """Return the ensemble with fewer and larger steps below 1,000 rows: it is fitted once a fold and once more.

    >>> [_paced(n, Ensemble(), 1.0).steps for n in (200, 500, 5000)]
    [500, 1250, 2500]
    """
    share = min(max(n, 200) / 1000, 1.0)
    return replace(full, steps=round(share * pace * full.steps), learning_rate=full.learning_rate * min(share**-0.5, 2.0))


@dataclass(frozen=True)
class ModelComparison:
    """What was chosen and why.

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
        comparison: what was chosen and why.
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

    def sample_paths(self, u: Points, n: int, rng: np.random.Generator) -> Points:
        """Return (n, m) draws of y as a function at u (m, d), each from one of the predictors."""
        counts = rng.multinomial(n, self.weight)
        return np.concatenate([sample_paths(p, u, k, rng) for p, k in zip(self.predictors, counts.tolist(), strict=True)])

    def __call__(self, u: Points) -> Prediction:
        """Return the belief at u (n, d)."""
        return Prediction.mixture_of([predict(u) for predict in self.predictors], self.weight)


def _explain(
    names: list[str], weights: Vector, held: Points | None, n: int, settings: Auto, bins: Bins | None
) -> ModelComparison:
    """Return the choice, models with little weight left out."""
    kept = np.where(weights >= _LEAST, weights, 0.0)
    kept /= kept.sum()
    alone = held is not None and bins is not None and not surely_better(held, kept)
    chosen = np.eye(len(names))[0] if alone else kept
    shares = {name: float(w) for name, w in zip(names, chosen, strict=True)}
    mixed = ", ".join(f"{100 * w:.0f} % {name}" for name, w in shares.items() if w > 0.0)
    if held is None:
        reason = f"{mixed}: {n} rows are too few to compare models (from {_FEWEST} on)"
        return ModelComparison(shares, {}, reason)
    scores = {name: float(row.mean()) for name, row in zip(names, held, strict=True)}
    scores["mixture"] = float(mixture_score(held, kept).mean())
    listed = ", ".join(f"{name} {score:.2f}" for name, score in scores.items())
    what = "" if bins is None else f" to fall where they did, of the ranges cut at {', '.join(f'{cut:.3g}' for cut in bins.cuts)}"
    reason = f"{mixed}: mean log likelihood of {n} rows{what}, each predicted from other rows ({settings.folds} folds): {listed}"
    if alone and len(names) > 1:
        reason += f" (not better than {names[0]} by three standard errors)"
    if "ensemble" not in names:
        reason += f"; the ensemble takes part from {settings.ensemble_rows} rows on"
    if "gp" not in names:
        reason += f"; the gp takes part up to {settings.gp_rows} rows"
    return ModelComparison(shares, scores, reason)

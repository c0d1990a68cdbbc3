"""Scores: how well predictions agree with runs that the metamodel has not seen.

The paper's likelihood and RMSE, over all runs and over the critical ones; precision, recall and
calibration of P(y in M_c).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from sbt.errors import InputError
from sbt.metamodels.ended import as_learned, ended, scale_of
from sbt.metamodels.prediction import Prediction
from sbt.problem.arrays import Mask, Vector
from sbt.problem.requirement import CriticalInterval

__all__ = ["precision_recall", "reliability", "scores"]

_TAIL = 0.025
"""On either side of what is covered."""
_BINS = 15  # of the calibration, as in Guo et al. (2017), On calibration of modern neural networks


def scores(
    prediction: Prediction, y: Vector, critical: CriticalInterval, inside: Mask | None = None
) -> dict[str, float | int | None]:
    """Return every score of a prediction at n points against the values y (n,) observed there.

    Keys, in the unit of y where they have one:

    - `log_likelihood`: mean log of the moment-matched Gaussian; `likelihood`: its exponential, eq. (1).
    - `log_likelihood_mixture`: mean log density of the mixture itself. Of a flag both are the mean log probability of its value.
    - `rmse`: root of the mean squared error of mu, eq. (2).
    - `crps`: mean continuous ranked probability score of the moment-matched Gaussian.
    - `log_likelihood_critical`, `rmse_critical`: the same over critical runs.
    - `average_precision`, `precision_at_recall_90`: of P(y in M_c) as a ranking; the second is the
      largest precision among thresholds that find at least 90 % of the critical runs.
    - `f1`, `error_rate`: of the classification P(y in M_c) >= 0.5.
    - `calibration_error`: expected calibration error of P(y in M_c), 15 bins of equal width.
    - `coverage_95`: share of y within the central 95 % of the mixture.
    - `base_rate`, `n`, `n_critical`: share of critical runs, runs, critical runs.

    A value is None where it is undefined: nothing observed, or no critical run for those that need one.

    Args:
        prediction: of n points.
        y: (n,) observed there.
        critical: M_c.
        inside: (n,) which runs were critical; None: where y is in M_c.

    Raises:
        InputError: y is not (n,) or not finite.

    Source:
        Winkelmann et al. (2022), section IV-C, eqs. (1), (2); CRPS: Gneiting & Raftery (2007), eq. (21).
    """
    observed = np.asarray(y, dtype=np.float64)
    if observed.shape != (len(prediction),):
        raise InputError(f"y must have shape ({len(prediction)},), one value a point, but got {observed.shape}")
    if not np.isfinite(observed).all():
        raise InputError("scores need finite y, but got NaN or infinity")
    with np.errstate(over="ignore"):  # squares of enormous errors: -inf, which becomes None
        return _scores(prediction, observed, critical, critical.contains(observed) if inside is None else inside)


def precision_recall(p: Vector, critical: Mask) -> tuple[Vector, Vector, Vector]:
    """Return precision, recall and threshold of "critical where p >= threshold", a point a distinct p.

    Args:
        p: (n,) probabilities, or any score that ranks as they do.
        critical: (n,) what was observed.

    Returns:
        (m,) precision, (m,) recall and (m,) thresholds, from the largest p to the smallest; empty
        without a critical run.

    >>> precision, recall, threshold = precision_recall([0.9, 0.9, 0.1], [True, False, True])
    >>> precision.round(2).tolist(), recall.tolist(), threshold.tolist()
    ([0.5, 0.67], [0.5, 1.0], [0.9, 0.1])
    """
    score, mask = np.asarray(p, dtype=np.float64), np.asarray(critical, dtype=bool)
    if score.shape != mask.shape or score.ndim != 1:
        raise InputError(f"p and critical must be (n,), but got {score.shape} and {mask.shape}")
    if not mask.any():
        return np.empty(0), np.empty(0), np.empty(0)
    order = np.argsort(-score, kind="stable")
    ranked = score[order]
    last = np.flatnonzero(np.append(ranked[1:] != ranked[:-1], True))  # last of each group of ties
    found = np.cumsum(mask[order])[last]
    return found / (last + 1.0), found / mask.sum(), ranked[last]


def reliability(p: Vector, critical: Mask, bins: int = _BINS) -> tuple[Vector, Vector, NDArray[np.int64]]:
    """Return the reliability curve of p (n,): what was predicted and what happened, by bins of p.

    Args:
        p: (n,) probabilities in [0, 1].
        critical: (n,) what was observed.
        bins: number of bins of equal width, >= 1.

    Returns:
        (bins,) mean p, (bins,) frequency of critical runs, both NaN in an empty bin, and (bins,) counts.

    >>> mean_p, frequency, count = reliability([0.1, 0.3, 0.9], [False, True, True], bins=2)
    >>> mean_p.tolist(), frequency.tolist(), count.tolist()
    ([0.2, 0.9], [0.5, 1.0], [2, 1])
    """
    if bins < 1:
        raise InputError(f"reliability needs bins >= 1, but got {bins}")
    probability = np.asarray(p, dtype=np.float64)
    index = np.minimum((probability * bins).astype(np.int64), bins - 1)
    count = np.bincount(index, minlength=bins)
    filled = np.where(count > 0, count, np.nan)
    mean_p = np.bincount(index, weights=probability, minlength=bins) / filled
    frequency = np.bincount(index, weights=np.asarray(critical, dtype=np.float64), minlength=bins) / filled
    return mean_p, frequency, count


def _scores(prediction: Prediction, y: Vector, critical: CriticalInterval, mask: Mask) -> dict[str, float | int | None]:
    log_p, log_not = prediction.log_probability(critical)
    told, mu, scale = ended(prediction), prediction.mu, scale_of(prediction)
    had = np.clip(y, scale.low, scale.high)
    error = told.mu - had
    y = as_learned(scale, y)
    y = np.where((y <= scale.low) & (mu < y) | (y >= scale.high) & (mu > y), mu, y)  # its side alone is known
    gaussian, mixture = prediction.log_density_gaussian(y), prediction.log_density(y)
    level = prediction.cdf(y)
    covered = (level >= _TAIL) & (level <= 1.0 - _TAIL)
    if scale.flag is not None:  # its value has a probability, no density
        gaussian = mixture = np.where(scale.flag.contains(had), log_p, log_not)
    if scale.flag is not None or scale.steps:
        covered = (told.quantile(_TAIL) <= had) & (had <= told.quantile(1.0 - _TAIL))
    log_likelihood = _mean(gaussian)
    result = {
        "log_likelihood": log_likelihood,
        "likelihood": None if log_likelihood is None else _finite(np.exp(min(log_likelihood, 709.0))),
        "log_likelihood_mixture": _mean(mixture),
        "rmse": _root(_mean(error**2)),
        "crps": _mean(_crps(error, told.sigma)),
        "log_likelihood_critical": _mean(gaussian[mask]),
        "rmse_critical": _root(_mean(error[mask] ** 2)),
        **_classification(log_p, log_not, mask),
        "calibration_error": _calibration_error(np.exp(log_p), mask),
        "coverage_95": _mean(covered),
        "base_rate": _mean(mask),
        "error_rate": _mean((log_p >= log_not) != mask),
    }
    return {**result, "n": len(y), "n_critical": int(mask.sum())}


def _classification(log_p: Vector, log_not: Vector, mask: Mask) -> dict[str, float | None]:
    """Return the scores of the ranking and of the classification; None without a critical run."""
    # log odds rank as P does, without ties where P rounds to 0 or 1
    precision, recall, _ = precision_recall(log_p - log_not, mask)
    if len(recall) == 0:
        return {"average_precision": None, "precision_at_recall_90": None, "f1": None}
    predicted = log_p >= log_not
    return {
        "average_precision": float(np.diff(recall, prepend=0.0) @ precision),
        "precision_at_recall_90": float(precision[recall >= 0.9 - 1e-12].max()),
        "f1": float(2.0 * (predicted & mask).sum() / (predicted.sum() + mask.sum())),
    }


def _calibration_error(p: Vector, mask: Mask) -> float | None:
    """Return sum over bins of (share of points) |frequency - mean p|."""
    if len(p) == 0:
        return None
    mean_p, frequency, count = reliability(p, mask)
    return float(np.nansum(count * np.abs(frequency - mean_p)) / len(p))


def _crps(error: Vector, sigma: Vector) -> Vector:
    """Return the (n,) CRPS of Gaussians whose mean is off by `error`."""
    z = error / sigma
    density = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
    return np.asarray(sigma * (z * (2.0 * ndtr(z) - 1.0) + 2.0 * density - 1.0 / np.sqrt(np.pi)))


def _mean(values: Vector | Mask) -> float | None:
    return _finite(float(np.mean(values))) if len(values) > 0 else None


def _root(value: float | None) -> float | None:
    return None if value is None else float(np.sqrt(value))


def _finite(value: float) -> float | None:
    """Return the value where JSON can hold it."""
    return float(value) if np.isfinite(value) else None

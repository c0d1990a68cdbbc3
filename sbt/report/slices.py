"""What the metamodel believes along each input through a run, as a table that a page interpolates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sbt.campaigns.wording import input_value
from sbt.metamodels.ended import ended
from sbt.problem.arrays import Points, Vector
from sbt.problem.parameter import Parameter
from sbt.problem.plain import Json
from sbt.problem.requirement import CriticalInterval
from sbt.problem.space import ParameterSpace
from sbt.report.projection import Predict

__all__ = ["slices_through"]

_GRID = (33, 129)
"""Smallest and largest number of values of an input."""
_CHUNK = 4096
_SCORE = 30.0
"""Largest normal score of P(critical) in the table; beyond 6 or so P is 0 or 1 to the eye."""
_MOST = 60_000
"""Largest number of points at which the metamodel is asked."""


def slices_through(
    predict: Predict, critical: CriticalInterval, space: ParameterSpace, x: Points, runs: Sequence[int]
) -> Json:
    """Return mean, 5 % and 95 % quantile and P(critical) along each input through runs, the other inputs as in the run.

    Args:
        predict: the metamodel on the unit cube.
        critical: critical interval of the metric.
        space: the inputs.
        x: (n, d) inputs of the runs, in their units.
        runs: n indices, the most interesting first; as many are kept as the table may be large.

    Returns:
        `grid`: per input its values; `of`: per run, per input, four lists, the last the normal score of P(critical), which is
        interpolated better than P; `error_p`, `error_mean`: the largest difference between the metamodel and the interpolated
        table at the middles between grid points.
    """
    from scipy.special import ndtr

    values_each = int(np.clip(_MOST / (2 * max(len(runs), 1) * space.dimension), *_GRID))
    grids = [_grid(parameter, values_each) for parameter in space.parameters]
    fine = [np.sort(np.concatenate([g, 0.5 * (g[1:] + g[:-1])])) if not p.discrete else g
            for g, p in zip(grids, space.parameters, strict=True)]  # fmt: skip
    size = sum(map(len, fine))
    kept = min(len(runs), max(_MOST // size, 1))
    points = np.repeat(x[:kept], size, axis=0).reshape(kept, size, space.dimension)
    start = 0
    for k, values in enumerate(fine):
        points[:, start : start + len(values), k] = values
        start += len(values)
    u = np.clip(space.to_unit(points.reshape(-1, space.dimension)), 0.0, 1.0)
    table = _asked(predict, critical, u).reshape(4, kept, size)
    found: list[list[list[list[float]]]] = [[] for _ in range(kept)]
    errors = np.zeros(4)
    start = 0
    for k, values in enumerate(fine):
        part = table[:, :, start : start + len(values)]
        start += len(values)
        there = np.isin(values, grids[k])
        for row in range(kept):
            found[row].append([_short(part[q, row, there]) for q in range(4)])
            for q in range(4):
                guess, true = np.interp(values, grids[k], part[q, row, there]), part[q, row]
                miss = np.abs(ndtr(guess) - ndtr(true)) if q == 3 else np.abs(guess - true)
                errors[q] = max(errors[q], float(np.nanmax(miss, initial=0.0)))
    widths = [p.bounds[1] - p.bounds[0] for p in space.parameters]
    return {
        "grid": [[float(input_value(float(v), w, 6)) for v in g] for w, g in zip(widths, grids, strict=True)],
        "runs": list(runs[:kept]), "of": found,
        "error_p": float(f"{errors[3]:.2g}"), "error_mean": float(f"{errors[:3].max():.2g}"),
    }  # fmt: skip


def _grid(parameter: Parameter, size: int) -> Vector:
    low, high = parameter.bounds
    if parameter.logarithmic:
        return parameter.from_unit(np.linspace(0.0, 1.0, size))
    if not parameter.discrete:
        return np.linspace(low, high, size)
    return np.unique(np.round(np.linspace(low, high, min(size, round(high - low) + 1))))


def _asked(predict: Predict, critical: CriticalInterval, u: Points) -> Vector:
    """Return (4, n): mean, 5 % and 95 % quantile, normal score of P(critical) within its limits."""
    from scipy.special import ndtri_exp

    parts = []
    for k in range(0, len(u), _CHUNK):
        prediction = predict(u[k : k + _CHUNK])
        log_p, log_not = prediction.log_probability(critical)
        score = np.where(log_p < log_not, ndtri_exp(log_p), -ndtri_exp(log_not))
        score = np.clip(score, -_SCORE, _SCORE)
        told = ended(prediction)
        parts.append(np.stack([told.mu, told.quantile(0.05), told.quantile(0.95), score]))
    return np.concatenate(parts, axis=1)


def _short(values: Vector) -> list[float]:
    return [float(f"{v:.4g}") for v in np.nan_to_num(values).tolist()]

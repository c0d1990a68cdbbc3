"""From d inputs to the two that a page can show: which matter, and what is left of P(critical).

Everything is a deterministic function of the campaign's rows: the same rows, the same figure.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from sbt.metamodels.prediction import Prediction
from sbt.problem.arrays import Points, Vector
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import CriticalInterval, Requirement
from sbt.problem.space import ParameterSpace
from sbt.samplers.sobol import SobolSequence
from sbt.store.history import History

__all__ = [
    "Plane",
    "Predict",
    "influence_from_runs",
    "log_probability",
    "most_influential_pairs",
    "probability",
    "probability_plane",
]

Predict = Callable[[Points], Prediction]
"""(n, d) points of the unit cube to the metamodel's prediction of the metric."""
_CHUNK = 8192
_BINS = 8


@dataclass(frozen=True, eq=False)
class Plane:
    """P(critical) on a grid of one or two inputs, averaged over the others.

    Args:
        pair: positions of the inputs on the axes; one for d = 1.
        axes: the grid's values of each, in its unit.
        probability: (len(axes[1]), len(axes[0])), or (len(axes[0]),) for one input; NaN where no
            concrete scenario satisfies the constraints.
        averaged: number of points of the other inputs behind each value, 1 where there are none.
    """

    pair: tuple[int, ...]
    axes: tuple[Vector, ...]
    probability: Vector
    averaged: int


def log_probability(predict: Predict, critical: CriticalInterval, u: Points) -> tuple[Vector, Vector]:
    """Return (n,) log P(critical) and (n,) log P(uncritical) at n >= 1 points of the unit cube.

    In chunks that fit into memory.
    """
    parts = [predict(u[k : k + _CHUNK]).log_probability(critical) for k in range(0, len(u), _CHUNK)]
    return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])


def probability(predict: Predict, critical: CriticalInterval, u: Points) -> Vector:
    """Return (n,) P(critical) at n >= 1 points of the unit cube."""
    return np.exp(log_probability(predict, critical, u)[0])


def influence_from_runs(history: History, requirement: Requirement) -> Vector:
    """Return (d,) how much of the rank of the margin each input explains alone, relative to the largest.

    The correlation ratio over eight bins of equally many runs: it also sees influences that are not
    monotone. An input with choices has a group for each. It needs no metamodel.
    """
    runs = history.where(history.ok)
    if len(runs) < 2 * _BINS:
        return np.zeros(len(history.names))
    margin = requirement.margins(runs)
    rank = np.searchsorted(np.sort(margin), margin).astype(np.float64)
    columns = ((runs.x[:, k], name in runs.choices) for k, name in enumerate(runs.names))
    return _relative(np.array([_explained(x, rank, choices=choices) for x, choices in columns]))


def _explained(x: Vector, y: Vector, *, choices: bool) -> float:
    """Return the variance between bins of x, or between choices, of the mean y."""
    edges = np.unique(x if choices else np.quantile(x, np.linspace(0, 1, _BINS + 1)[1:-1]))
    groups = np.searchsorted(edges, x, side="right")
    return float(sum((groups == g).mean() * (y[groups == g].mean() - y.mean()) ** 2 for g in np.unique(groups)))


def _relative(values: Vector) -> Vector:
    top = values.max(initial=0.0)
    return values / top if top > 0 else np.zeros_like(values)


def most_influential_pairs(weights: Vector, limit: int = 6) -> list[tuple[int, int]]:
    """Return at most `limit` pairs of the four heaviest inputs, those with the largest joint weight first.

    >>> most_influential_pairs(np.array([0.1, 1.0, 0.5]), limit=2)
    [(1, 2), (0, 1)]
    """
    heaviest = np.argsort(-weights, kind="stable")[:4]
    pairs = combinations(sorted(int(k) for k in heaviest), 2)
    return sorted(pairs, key=lambda p: (-float(weights[p[0]] + weights[p[1]]), p))[:limit]


def probability_plane(
    predict: Predict,
    critical: CriticalInterval,
    space: ParameterSpace,
    pair: tuple[int, ...],
    *,
    samples: int = 256,
    fixed: Mapping[int, float] | None = None,
) -> Plane:
    """Return P(critical) over one or two inputs: its mean over `samples` Sobol points of the others.

    Inputs in `fixed`, by position, keep their value.

    Raises:
        ValueError: not one or two inputs.
    """
    if len(pair) not in (1, 2):
        raise ValueError(f"a plane has one or two inputs, but got {len(pair)}")
    held = dict(fixed or {})
    rest = [k for k in range(space.dimension) if k not in pair and k not in held]
    size = 25 if rest else (401 if len(pair) == 1 else 101)
    units = [_grid(space.parameters[k], size) for k in pair]
    mesh = np.stack(np.meshgrid(*units), axis=-1).reshape(-1, len(pair))  # (g, 1 or 2), first input fastest
    others = SobolSequence(len(rest), seed=0).points(0, samples) if rest else np.empty((1, 0))
    u = np.empty((len(mesh), len(others), space.dimension))
    u[:, :, list(pair)] = mesh[:, None, :]
    u[:, :, rest] = others[None, :, :]
    for k, value in held.items():
        u[:, :, k] = space.parameters[k].to_unit(np.array(value))
    flat = u.reshape(-1, space.dimension)
    weight = space.feasible(space.from_unit(flat)).reshape(len(mesh), len(others)).astype(np.float64)
    p = probability(predict, critical, flat).reshape(weight.shape)
    total = weight.sum(axis=1)
    values = np.where(total > 0, (weight * p).sum(axis=1) / np.maximum(total, 1.0), np.nan)
    shape = tuple(len(unit) for unit in reversed(units))
    axes = tuple(space.parameters[k].from_unit(unit) for k, unit in zip(pair, units, strict=True))
    return Plane(pair, axes, values.reshape(shape), len(others))


def _grid(parameter: Parameter, size: int) -> Vector:
    """Return grid coordinates in [0, 1]; for integer inputs and choices the middles of cells, each value once."""
    if not parameter.discrete:
        return np.linspace(0.0, 1.0, size)
    low, high = parameter.bounds
    whole = np.unique(np.round(np.linspace(low, high, min(size, round(high - low) + 1))))
    return np.asarray(parameter.to_unit(whole), dtype=np.float64)

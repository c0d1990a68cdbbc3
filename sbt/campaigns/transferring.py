"""What is taken over from an earlier campaign of another setup: another ego, step, net, version or other inputs."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from sbt.errors import InputError, did_you_mean
from sbt.estimators.surrogate import QUANTILE
from sbt.estimators.transfer import Transfer, Trend
from sbt.loop.earlier import EarlierRuns
from sbt.metamodels.base import Metamodel, fitted, named_errors, predicted
from sbt.metamodels.saturation import opened
from sbt.metamodels.warp import Warp
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.parameter import Parameter
from sbt.problem.plain import Value
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.seeds import stream
from sbt.store.history import History

__all__ = ["earlier_runs", "transfer_of"]

_ROWS, _NEAREST = 250, 180
"""Old runs that the trend learns from, and how many of them are those nearest to the critical edge: every prediction of a trend
costs the square of its rows."""
_POOLED, _POOLED_NEAREST = 500, 350
"""Old runs that a metamodel learns from beside those of its campaign, and how many of them are nearest to the critical edge."""
_INTEGRATED = 16
"""Points over which an input is integrated that only the old campaign has."""


def transfer_of(
    old: LogicalScenario, runs: History, new: LogicalScenario, metamodel: Metamodel, seed: int,
    fixed: Mapping[str, Value] | None = None,
) -> Transfer:  # fmt: skip
    """Return what the runs of an old campaign say about the metrics of a new one, as a trend in its inputs.

    Args:
        old: the scenario of the old campaign.
        runs: of it, with metrics.
        new: the scenario of the new campaign; its requirement decides.
        metamodel: learns the old metrics.
        seed: of the new campaign.
        fixed: values of inputs that only the old one has; the others are integrated over their distribution.

    Raises:
        InputError: no input in common, a metric that was not measured, or a fixed input that the old one does not have.
    """
    _check_common(old.space, runs, new, fixed or {})
    at = _taken(old.space, new.space, runs)
    runs = runs.where(at[1])
    rng = stream(seed, "transfer")
    trends = tuple(_trend(part, old.space, runs, new.space, metamodel, dict(fixed or {}), rng) for part in new.requirement.parts)
    hits = at[0][at[1]][new.requirement.critical_runs(runs)]
    return Transfer(trends, new.space.to_normal(hits[new.space.feasible(hits)]))


def earlier_runs(
    old: LogicalScenario, runs: History, new: LogicalScenario, metamodel: Metamodel, seed: int, *,
    other: bool, fixed: Mapping[str, Value] | None = None,
) -> EarlierRuns:  # fmt: skip
    """Return the runs of an old campaign that a metamodel of a new one learns from beside its own.

    Args:
        old: the scenario of the old campaign.
        runs: of it, with metrics.
        new: the scenario of the new campaign; its requirement decides.
        metamodel: learns the old metrics, where inputs are integrated.
        seed: of the new campaign.
        other: the old campaign had another setup.
        fixed: values of inputs that only the old one has; the others are integrated over their distribution.

    Raises:
        InputError: no input in common, a metric that was not measured, a fixed input that the old one does not have, or fewer
            than two runs to learn from.
    """
    _check_common(old.space, runs, new, fixed or {})
    rng, requirement = stream(seed, "earlier"), new.requirement
    x, inside = _taken(old.space, new.space, runs)
    margin = requirement.margins(runs)
    rows = np.flatnonzero(inside & np.isfinite(margin) & new.space.feasible(x))
    if len(rows) < 2:
        rule = "warm_start.store must have two runs with a metric inside of the ranges and constraints here"
        raise InputError(f"{rule}, but has {len(rows)}")
    if len(rows) > _POOLED:
        order = rows[np.argsort(np.abs(margin[rows]), kind="stable")]
        others = rng.permutation(order[_POOLED_NEAREST:])[: _POOLED - _POOLED_NEAREST]
        rows = np.sort(np.concatenate([order[:_POOLED_NEAREST], others]))
    kept = runs.where(np.isin(np.arange(len(runs)), rows))
    y, gone = requirement.values(kept), [k for k, name in enumerate(old.space.names) if name not in new.space.names]
    if gone:
        columns = []
        for column in np.atleast_2d(y.T):
            known = np.isfinite(column)
            if known.sum() >= 2:
                mean = _mean(metamodel, _inputs(old.space, kept.x[known]), column[known], rng)
                column = _integrated(mean, old.space, kept.x, gone, dict(fixed or {}))
            columns.append(column)
        y = np.squeeze(np.array(columns).T, axis=-1) if y.ndim == 1 else np.array(columns).T
    return EarlierRuns(_inputs(new.space, x[rows]), y, other)


def _check_common(old: ParameterSpace, runs: History, new: LogicalScenario, fixed: Mapping[str, Value]) -> None:
    """Refuse a campaign without an input in common, without a metric, or fixed inputs that it does not have."""
    shared = [name for name in new.space.names if name in old.names]
    if not shared:
        named = ", ".join(old.names), ", ".join(new.space.names)
        raise InputError("warm_start.transfer needs an input in common, but got {} there, {} here".format(*named))
    gone = [name for name in old.names if name not in shared]
    for name in fixed:
        if name not in gone:
            rule = f"warm_start.fixed must name inputs that only the earlier campaign has ({', '.join(gone) or 'none'})"
            raise InputError(f"{rule}, but got '{name}'{did_you_mean(name, gone)}")
        parameter = old.parameters[old.names.index(name)]
        if not parameter.contains(np.array(parameter.number(fixed[name]))):
            rule = f"warm_start.fixed must be a value that the earlier campaign had: {name} in {parameter.range}"
            raise InputError(f"{rule}, but got {fixed[name]}")
    for part in new.requirement.parts:
        if part.metric not in runs.metrics:
            rule = f"warm_start.store must have measured {part.metric}"
            raise InputError(f"{rule}, but only measured {', '.join(runs.metrics) or 'nothing'}")


def _taken(old: ParameterSpace, new: ParameterSpace, runs: History) -> tuple[Points, Mask]:
    """Return old runs at the inputs of the new space, what only that has at its centre, and (n,) whether they lie in it."""
    x = np.array([[p.centre for p in new.parameters]]).repeat(len(runs), axis=0)
    inside = np.ones(len(runs), dtype=bool)
    for k, p in enumerate(new.parameters):
        if p.name in old.names:
            values = runs.x[:, old.names.index(p.name)]
            x[:, k] = _recoded(old.parameters[old.names.index(p.name)], p, values)
            x[:, k] = np.round(x[:, k]) if p.discrete else x[:, k]
            inside &= p.contains(x[:, k])
            x[:, k] = np.clip(x[:, k], *p.bounds)
    return x, inside


def _recoded(old: Parameter, new: Parameter, values: Vector) -> Vector:
    """Return the numbers of an input in the new space, -1 for a choice that it does not have."""
    if bool(old.choices) != bool(new.choices):
        raise InputError(f"warm_start.transfer needs an input to have choices in both campaigns or in none, but not {new.name}")
    if not old.choices:
        return values
    place = np.array([new.choices.index(c) if c in new.choices else -1 for c in old.choices], dtype=np.float64)
    return np.asarray(place[values.astype(np.intp)])


def _trend(
    part: Requirement, old: ParameterSpace, runs: History, new: ParameterSpace, metamodel: Metamodel, fixed: dict[str, Value],
    rng: np.random.Generator,
) -> Trend:  # fmt: skip
    """Return one metric of the old campaign as a function of the new inputs."""
    y = runs.y(part.metric)
    runs, y = runs.where(np.isfinite(y)), y[np.isfinite(y)]
    if len(y) < 2:
        raise InputError(f"warm_start.transfer needs at least two runs with {part.metric}, but got {len(y)}")
    y = opened(_inputs(old, runs.x), y, part.critical, rng)
    warp = Warp.around_edge(y, part.critical, quantile=QUANTILE)
    t = warp.values(y)
    if len(t) > _ROWS:
        order = np.argsort(np.abs(t), kind="stable")
        rows = np.sort(np.concatenate([order[:_NEAREST], rng.permutation(order[_NEAREST:])[: _ROWS - _NEAREST]]))
        runs, t = runs.where(np.isin(np.arange(len(t)), rows)), t[rows]
    gone = [k for k, name in enumerate(old.names) if name not in new.names]
    if gone:
        t = _integrated(_mean(metamodel, _inputs(old, runs.x), t, rng), old, runs.x, gone, fixed)
    columns = [k for k, name in enumerate(new.names) if name in old.names]
    mine = ParameterSpace(tuple(new.parameters[k] for k in columns))
    mean = _mean(metamodel, _inputs(mine, _taken(old, new, runs)[0][:, columns]), t, rng)
    return Trend(warp, lambda z: mean(_inputs(mine, new.from_normal(z)[:, columns])))


def _mean(metamodel: Metamodel, u: Points, t: Vector, rng: np.random.Generator) -> Callable[[Points], Vector]:
    """Return the mean that a metamodel predicts, fitted to u (n, d), t (n,), as a function of points."""
    predictor = fitted(metamodel, u, t, rng)

    def mean(points: Points) -> Vector:
        with named_errors(metamodel, len(t)):
            return predicted(predictor, points).mu

    return mean


def _inputs(space: ParameterSpace, x: Points) -> Points:
    return space.metamodel_inputs(space.to_unit(x))


def _integrated(
    mean: Callable[[Points], Vector], old: ParameterSpace, x: Points, gone: list[int], fixed: dict[str, Value]
) -> Vector:
    """Return the prediction at old runs, with inputs that are gone fixed or integrated over their distribution."""
    from scipy.special import ndtri
    from scipy.stats import qmc

    even = old.from_normal(ndtri(qmc.Sobol(old.dimension, scramble=True, rng=0).random(_INTEGRATED)))
    total = np.zeros(len(x))
    for point in even:
        at = x.copy()
        for k in gone:
            p = old.parameters[k]
            at[:, k] = p.number(fixed[p.name]) if p.name in fixed else point[k]
        total += mean(_inputs(old, at))
    return total / len(even)

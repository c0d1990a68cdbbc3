"""Where the boundary lies: the inputs that it depends on most, and where along them critical meets uncritical."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from sbt.campaigns.wording import input_value, measured, plural
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.plain import Value
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.samplers.sobol import SobolSequence
from sbt.samplers.surface import crossings
from sbt.store.records import optional

__all__ = ["BoundaryPlace", "Cut", "Stretch", "boundary_place", "succeeding"]

_MOST_STRETCHES = 3  # critical stretches of a line across the boundary that a sentence tells
_MOST_FIXED = 4  # inputs beside the two that a sentence names

LogOdds = Callable[[Points], Vector]
"""(n, d) points of the unit cube -> (n,) log P(critical) - log P(uncritical): it still differs where both are near 0 or 1."""
Probability = Callable[[Points], Vector]
_LOOK_FROM = 2048
_CROSSINGS = 64
_STEP = 0.002  # of the unit cube, to both sides, for the direction of the steepest change
_GIVES = 0.8  # P(a run gives a metric) below which it is said that runs may fail there
_CELLS = 400  # of a line on which edges are looked for
_CUTS = ((0.1, 0.2), (0.5, 0.4, 0.6), (0.9, 0.8))
"""Quantiles of the second input along the boundary, where lines along the first cross it: the first, or the next ones instead."""
_ACROSS = (0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8)  # the same of the first one, where the boundary is a face across the second
_ALONG = 0.2  # of the first input's mean share of the direction across the boundary: below it a line runs along the boundary
_FACE, _FACES = 0.99, 0.1  # share of the second input's from which on the boundary is a face across it; of points on such
_ALIKE = 8  # points of the boundary with the same choices and whole numbers that tell its cuts
_APART = 1e-3  # of the unit cube: cuts that are nearer are one
_HALVINGS = 20  # of a cell of a line, for where P crosses 0.5
_MOST = 1e6  # log odds beyond which nothing is told apart
_SURE = 0.95  # outside of this and its complement the metamodel is sure of a side


@dataclass(frozen=True)
class Stretch:
    """A critical stretch of an input, in its unit."""

    low: float
    high: float


@dataclass(frozen=True)
class Cut:
    """A line across the boundary.

    Attributes:
        at: value of the second input; None where there is only one.
        critical: stretches of the first one where P(critical) > 0.5 and a run rather gives a metric.
        unsure: the widest part about an edge with P(critical) between 0.05 and 0.95, half of it, in the unit of the first input.
        lost: a critical stretch ends where runs may fail: there, and beyond, little is known; None: none does.
    """

    at: float | None
    critical: tuple[Stretch, ...]
    unsure: float
    lost: bool | None = optional()


@dataclass(frozen=True)
class BoundaryPlace:
    """The boundary as the metamodel sees it, along the two inputs that it depends on most.

    Attributes:
        inputs: their names, the one first across which P(critical) changes fastest.
        low, high: ends of the range of the first.
        cuts: lines along the first input, at values of the second.
        fixed: what the other inputs are meanwhile: those of a point of the boundary, in the midst of it.
        weights: of every continuous input, its mean share of the direction across the boundary, squared (unit cube).
        across: a line along the second input, where a part of the boundary is a face across it, which no line along the first
            meets; None: none is.
    """

    inputs: tuple[str, ...]
    low: float
    high: float
    cuts: tuple[Cut, ...]
    fixed: Mapping[str, Value]
    weights: Mapping[str, float]
    across: BoundaryPlace | None = optional()

    @property
    def vague(self) -> bool:
        """Whether an edge is less certain than the critical stretch beside it is wide."""
        own = any(cut.unsure >= min(s.high - s.low for s in cut.critical) for cut in self.cuts)
        return own or (self.across is not None and self.across.vague)

    def words(self, units: Mapping[str, str], widths: Mapping[str, float] | None = None, *, edges: bool = True) -> str:
        """Return where critical meets uncritical, in words.

        Args:
            units: of the inputs, by name.
            widths: of their ranges, from which digits follow; None: that of the first input alone is known.
            edges: tell how sure they are.
        """
        widths = widths or {}
        said = self._lines(units, widths, edges=edges)
        if self.across is not None:
            said += f", and where {self.across._lines(units, widths, edges=edges)}"
        if self.fixed:
            names = sorted(self.fixed, key=lambda name: -self.weights.get(name, 0.0))
            values = {name: input_value(self.fixed[name], widths.get(name, np.inf)) for name in names[:_MOST_FIXED]}
            told = [measured(name, value, units.get(name, "")) for name, value in values.items()]
            told += [f"{plural(len(names) - _MOST_FIXED, 'more input')} fixed too"] if len(names) > _MOST_FIXED else []
            said += f", in the section with {', '.join(told)}"
        return said

    def _lines(self, units: Mapping[str, str], widths: Mapping[str, float], *, edges: bool) -> str:
        """Return what the lines tell."""
        first, unit = self.inputs[0], units.get(self.inputs[0], "")
        second = self.inputs[1] if len(self.inputs) > 1 else ""
        at = self._at(widths.get(second, np.inf), units.get(second, ""))
        parts = []
        for k, cut in enumerate(self.cuts):
            if at[k] not in at[:k]:
                where = f" at {second} {at[k]}" if at[k] and not k else f" at {at[k]}" if at[k] else ""
                parts.append(f"{' and '.join(dict.fromkeys(self._stretches(cut, unit)))}{where}")
        unsure = measured("", max(cut.unsure for cut in self.cuts), unit, 2).strip()
        lost = ", as far as runs give a metric" if any(cut.lost for cut in self.cuts) else ""
        sure = f" (edges \N{PLUS-MINUS SIGN}{unsure} at worst, by the metamodel)" if edges else ""
        return f"{first} is {', '.join(parts)}{lost}{sure}"

    def _at(self, width: float, unit: str) -> list[str]:
        """Return where each line lies, in words: different ones differ."""
        values = np.unique([cut.at for cut in self.cuts if cut.at is not None])
        gaps = np.diff(values)
        gap = float(gaps[gaps > _APART * min(width, np.ptp(values))].min(initial=np.inf)) if len(gaps) else np.inf
        said = [None if cut.at is None else input_value(cut.at, width, sure=0.5 * gap) for cut in self.cuts]
        return ["" if each is None else measured("", each, unit).strip() for each in said]

    def _stretches(self, cut: Cut, unit: str) -> list[str]:
        """Return the widest critical stretches of the first input, without ends of its range, and how many others there are."""
        said, widest = [], sorted(cut.critical, key=lambda stretch: stretch.low - stretch.high)[:_MOST_STRETCHES]
        width = self.high - self.low
        for stretch in sorted(widest, key=lambda stretch: stretch.low):
            low, high = (input_value(end, width, sure=cut.unsure) for end in (stretch.low, stretch.high))
            if stretch.low <= self.low:
                said.append(f"below {measured('', high, unit).strip()}")
            elif stretch.high >= self.high:
                said.append(f"above {measured('', low, unit).strip()}")
            else:
                said.append(f"{low} to {measured('', high, unit).strip()}")
        others = len(cut.critical) - len(widest)
        return [*said, f"in {plural(others, 'narrower part')}"] if others else said


def boundary_place(
    log_odds: LogOdds, scenario: LogicalScenario, seed: int, log_success: LogOdds | None = None
) -> BoundaryPlace | None:
    """Return where the boundary lies; None where the metamodel sees none among runs that succeed, or no input is continuous."""
    space = scenario.space
    continuous = [k for k, p in enumerate(space.parameters) if p.kind == "continuous"]
    u = SobolSequence(space.dimension, seed).admissible(lambda v: space.feasible(space.from_unit(v)), _LOOK_FROM, 256)
    if not continuous or len(u) == 0:
        return None
    seen = _Seen(log_odds, log_success, space, continuous)
    edge = space.cube.snapped(crossings(seen.probability, space.cube.snapped(u), _CROSSINGS))
    edge = edge[space.feasible(space.from_unit(edge))] if len(edge) else edge
    edge = edge[succeeding(log_success, edge)]
    if len(edge) == 0:
        return None
    share = seen.shares(edge)
    weight = share.mean(axis=0)
    order = sorted(range(len(continuous)), key=lambda k: -weight[k])[:2]
    least = _ALONG * weight[order[0]]
    meets = share[:, order[0]] >= least
    anchor = edge[meets][np.argmin(np.linalg.norm(edge[meets] - np.median(edge[meets], axis=0), axis=1))]
    alike = (space.cube.cells(edge) == space.cube.cells(anchor[None])).all(axis=1)
    alike = alike if (meets & alike).sum() >= _ALIKE else np.ones(len(edge), dtype=bool)
    cuts = seen.cuts(anchor, edge[meets & alike], order, _CUTS, least)
    if not cuts and space.cube.continuous:
        return None
    found, across, face = seen.place(order, cuts), None, alike & (share[:, order[-1]] >= _FACE)
    if cuts and len(order) > 1 and face.sum() >= _FACES * alike.sum():
        beside = seen.cuts(anchor, edge[face], order[::-1], (_ACROSS,), 0.5)
        across = seen.place(order[::-1], beside) if beside else None
    row = space.named(space.from_unit(anchor[None])[0])
    fixed = {name: row[name] for name in space.names if name not in found.inputs}
    shares = {space.names[k]: float(w) for k, w in zip(continuous, weight, strict=True)}
    return replace(found, fixed=fixed, weights=shares, across=across)


@dataclass(frozen=True)
class _Seen:
    """P(critical) as a metamodel sees it in a space, some inputs of which are continuous."""

    log_odds: LogOdds
    log_success: LogOdds | None
    space: ParameterSpace
    continuous: list[int]

    def probability(self, v: Points) -> Vector:
        """Return (n,) P(critical) at points of the unit cube."""
        return np.asarray(expit(self.log_odds(v)), dtype=np.float64)

    def cuts(
        self, anchor: Vector, edge: Points, order: list[int], quantiles: Sequence[Sequence[float]], least: float
    ) -> list[Cut]:
        """Return lines along the first of two inputs through a point, at quantiles of the second one among points (n, d).

        Of each group of quantiles it is the first whose line never runs along the boundary; where all do, the first of a group.

        Args:
            anchor: (d,) the point.
            edge: of the boundary.
            order: which of the continuous inputs.
            quantiles: in groups.
            least: share of the first input of the direction across the boundary, below which a line runs along it.
        """
        axes = [self.continuous[k] for k in order]
        low, high = self.space.parameters[axes[0]].bounds
        every, meeting = [], []
        taken: list[float] = []
        for group in quantiles if len(axes) > 1 else [(0.0,)]:
            values = np.quantile(edge[:, axes[1]], group).tolist() if len(axes) > 1 else [anchor[axes[0]]]
            values = [value for value in values if len(axes) < 2 or all(abs(value - other) > _APART for other in taken)]
            for k, value in enumerate(values):
                line = _with(anchor, axes[-1], value)
                cut = _cut(self.probability, self.log_success, line, axes, self.space)
                if not cut.critical or _everywhere(cut, low, high):
                    break
                every += [cut] if k == 0 else []
                if (self.shares(_crossings_of(self.probability, line, axes[0]))[:, order[0]] >= least).all():
                    meeting.append(cut)
                    taken.append(value)
                    break
        return meeting or every

    def place(self, order: list[int], cuts: Sequence[Cut]) -> BoundaryPlace:
        """Return lines along the first of two inputs as a place."""
        inputs = [self.space.parameters[self.continuous[k]] for k in order]
        low, high = inputs[0].bounds
        return BoundaryPlace(tuple(p.name for p in inputs), float(low), float(high), tuple(cuts), {}, {})

    def shares(self, edge: Points) -> Points:
        """Return (n, c) the share of each continuous input of the direction in which P(critical) changes at n points, squared."""
        change = np.empty((len(edge), len(self.continuous)))
        for k, axis in enumerate(self.continuous):
            up, down = (_moved(edge, axis, step) for step in (_STEP, -_STEP))
            rise = _finite(self.log_odds(up)) - _finite(self.log_odds(down)) if len(edge) else np.empty(0)
            change[:, k] = rise / np.maximum(up[:, axis] - down[:, axis], 1e-12)
        squared = change**2
        total = squared.sum(axis=1, keepdims=True)
        return np.where(total > 0, squared / np.where(total > 0, total, 1.0), 0.0)


def succeeding(log_success: LogOdds | None, u: Points, least: float = 0.5) -> Mask:
    """Return (n,) where at points of the unit cube P(a run gives a metric) is at least so large; everywhere where none failed."""
    if log_success is None or len(u) == 0:
        return np.ones(len(u), dtype=bool)
    return np.asarray(log_success(u) >= np.log(least))


def _crossings_of(probability: Probability, line: Vector, axis: int) -> Points:
    """Return (m, d) where P crosses 0.5 on a line along an input."""
    t = np.linspace(0.0, 1.0, _CELLS + 1)
    side = probability(_on(line, axis, t)) > 0.5
    cell = np.flatnonzero(side[1:] != side[:-1])
    low, high = t[cell], t[cell + 1]
    for _ in range(_HALVINGS if len(cell) else 0):
        middle = 0.5 * (low + high)
        same = (probability(_on(line, axis, middle)) > 0.5) == side[cell]
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return _on(line, axis, 0.5 * (low + high))


def _on(line: Vector, axis: int, t: Vector) -> Points:
    points = np.repeat(line[None], len(t), axis=0)
    points[:, axis] = t
    return points


def _finite(log_odds: Vector) -> Vector:
    return np.clip(np.nan_to_num(log_odds), -_MOST, _MOST)


def _moved(points: Points, axis: int, step: float) -> Points:
    moved = points.copy()
    moved[:, axis] = np.clip(moved[:, axis] + step, 0.0, 1.0)
    return moved


def _with(point: Vector, axis: int, value: float) -> Vector:
    moved = point.copy()
    moved[axis] = value
    return moved


def _cut(probability: Probability, log_success: LogOdds | None, line: Vector, axes: list[int], space: ParameterSpace) -> Cut:
    """Return the critical stretches of the first axis through a point, as far as constraints admit them; none of all of that."""
    t = np.linspace(0.0, 1.0, _CELLS + 1)
    points = _on(line, axes[0], t)
    p, admitted = probability(points), space.feasible(space.from_unit(points))
    ok = succeeding(log_success, points) & admitted & ~(not admitted.all() and bool((p > 0.5)[admitted].all()))
    x = space.parameters[axes[0]].from_unit(t)
    ends = np.flatnonzero(np.diff(np.concatenate([[0], ((p > 0.5) & ok).astype(int), [0]]))).reshape(-1, 2).tolist()
    sure = succeeding(log_success, points, _GIVES)
    lost = [0 < k < len(x) and not (sure[k - 1] and sure[k]) for pair in ends for k in pair]
    stretches = tuple(Stretch(_edge(x, p, a, 0), _edge(x, p, b, -1)) for a, b in ends)
    unsure = np.flatnonzero(np.diff(np.concatenate([[0], ((p > 1 - _SURE) & (p < _SURE)).astype(int), [0]]))).reshape(-1, 2)
    edges = [e for s in stretches for e in (s.low, s.high)]
    step = max((float(x[k] - x[k - 1]) for pair in ends for k in np.clip(pair, 1, _CELLS)), default=float(x[1] - x[0]))
    wide = [float(x[b - 1] - x[a]) for a, b in unsure if any(x[a] - step <= e <= x[b - 1] + step for e in edges)]
    at = float(space.parameters[axes[1]].from_unit(np.array([line[axes[1]]]))[0]) if len(axes) > 1 else None
    return Cut(at, stretches, 0.5 * max([*wide, step]), any(lost) or None)


def _edge(x: Vector, p: Vector, k: int, inside: int) -> float:
    """Return where P crosses 0.5 between grid points k - 1 and k, the end of the range, or the last point where runs succeed."""
    if k in (0, len(x)):
        return float(x[min(k, len(x) - 1)])
    if (p[k - 1] > 0.5) == (p[k] > 0.5):
        return float(x[k + inside])
    share = (0.5 - p[k - 1]) / (p[k] - p[k - 1])
    return float(x[k - 1] + share * (x[k] - x[k - 1]))


def _everywhere(cut: Cut, low: float, high: float) -> bool:
    return len(cut.critical) == 1 and cut.critical[0].low <= low and cut.critical[0].high >= high

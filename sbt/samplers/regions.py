"""Trust regions: boxes about the best runs of their neighbourhoods, and about runs that surprise the metamodel.

What a region has become is replayed from the runs each time, nothing is remembered between batches.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.cube import CONTINUOUS, Cube

__all__ = ["PATIENCE", "Region", "clusters", "niches", "regions"]

_APART = 0.25  # of the best runs of two trust regions, Chebyshev distance: a little more than DEFLATION
_MOST_REGIONS = 3  # a batch of ten has two Thompson draws for each
_LONGEST, _SHORTEST = 0.8, 2.0**-6  # side of a trust region: TuRBO's first one; it is retired after six halvings
PATIENCE = 3
"""Batches without an improvement before a trust region is halved; two were measured to be worse."""
_BETTER = 0.01
"""Part of a margin that a run has to come nearer to M_c to be an improvement: ever smaller steps to a least value are not."""
_CLUSTER = 0.15  # reach of the neighbourhood that is left out to ask whether a run surprises, Chebyshev
_SURPRISE = 2.5  # standard deviations of a prediction without the cluster
_MOST_IN_CLUSTER = 40  # beyond, the place is well looked at
_NICHE, _NICHE_PATIENCE = 0.25, 2  # first side of a niche, and batches without an improvement before it is halved
_MOST_NICHES = 2
_CLEAR_OF_REGIONS = 0.1  # a surprise nearer than this to a trust region's centre is that region's business


@dataclass(frozen=True, eq=False)
class Region:
    """A trust region: a box around the best run of its neighbourhood.

    Args:
        centre: (d,) the run.
        side: of the box.
        failures: batches in it since the last improvement.
    """

    centre: Vector
    side: float
    failures: int = 0

    def candidates(self, n: int, rng: np.random.Generator, cube: Cube = CONTINUOUS) -> Points:
        """Return (n, d) points of the box, of the cube too; at most about 20 coordinates are moved.

        Another choice is as likely as the candidate's step is long, so that a small box keeps to the choices of its centre.
        """
        d = len(self.centre)
        moved = rng.random((n, d)) < min(1.0, 20.0 / d)
        moved[np.arange(n), rng.integers(0, d, n)] = True
        reach = 0.5 * self.side * 2.0 ** (-3.0 * rng.random((n, 1)))
        step = reach * rng.uniform(-1.0, 1.0, (n, d))
        start = np.tile(self.centre, (n, 1))
        return cube.flipped(np.clip(start + np.where(moved, step, 0.0), 0.0, 1.0), start, reach[:, 0], rng)


def regions(
    u: Points, margin: Vector, batch: Vector, cube: Cube = CONTINUOUS, filling: Mask | None = None, *, minima: bool = True
) -> list[Region]:
    """Return the trust regions around the best runs, at least 0.25 apart or of different choices, the best first.

    A centre is the best run of its own neighbourhood: the flank of a better one is no place of its own. It is also better than
    the median of the runs that fill space; on a plateau none is. The side is replayed from the runs near the centre: halved after
    three batches without an improvement, doubled after two with one; a side below 2^-6 retires the region.

    Args:
        u: (n, d) runs, none of them critical.
        margin: (n,) distance of the metric to the critical interval; inf where a run failed: it found no region, but tried.
        batch: (n,) number of the batch of each run, increasing.
        cube: which coordinates take single values.
        filling: (n,) the run fills space, whatever the results; None: all do.
        minima: see above; False: where margins are expectations of a noisy metric, flanks count as places, since a smooth
            expectation has one or two minima.
    """
    found: list[Region] = []
    at = cube.embedded(u)
    finite = np.isfinite(margin)
    typical = finite if filling is None or not (finite & filling).any() else finite & filling
    left = margin < (np.median(margin[typical]) if typical.any() else -np.inf)
    while left.any() and len(found) < _MOST_REGIONS:
        best = int(np.flatnonzero(left)[np.argmin(margin[left])])
        near = np.abs(at - at[best]).max(axis=1) <= _APART
        if minima and margin[near].min() < margin[best]:
            left[best] = False
            continue
        side, failures = _side(at[near], margin[near], batch[near])
        if side >= _SHORTEST:
            found.append(Region(u[best], side, failures))
        left &= ~near
    return found


def _side(u: Points, margin: Vector, batch: Vector) -> tuple[float, int]:
    """Return side and failures of a trust region from the runs of its neighbourhood, in order."""
    side, best, failures, successes = _LONGEST, -1, 0, 0
    for number in np.unique(batch):
        mine = np.flatnonzero(batch == number)
        leader = int(mine[np.argmin(margin[mine])])
        if best < 0:
            best = leader
            continue
        nearer = _BETTER * abs(margin[best]) if np.isfinite(margin[best]) else 0.0  # where the first run failed any other is
        if margin[leader] < margin[best] - nearer:
            best, successes, failures = leader, successes + 1, 0
            side = min(2 * side, _LONGEST) if successes >= 2 else side
        elif (np.abs(u[mine] - u[best]).max(axis=1) <= 0.5 * side).any():
            failures, successes = failures + 1, 0
            side = side / 2 if failures % PATIENCE == 0 else side
    return side, failures


def niches(
    surprise: Vector, u: Points, margin: Vector, batch: Vector, others: list[Region], cube: Cube = CONTINUOUS
) -> list[Region]:
    """Return small regions about the runs that lie nearest to M_c beyond what the metamodel expects without their neighbours.

    A narrow well beside a broad basin shows first by one such run. The metamodel, which takes it for a whim of its own, would
    pass it by.

    Args:
        surprise: (n,) by how many standard deviations it is nearer to M_c than expected.
        u: (n, d) runs.
        margin: (n,) distance of the metric to the critical interval.
        batch: (n,) number of the batch of each run.
        others: the trust regions there are.
        cube: which coordinates take single values.
    """
    found: list[Region] = []
    at = cube.embedded(u)
    centres = [cube.embedded(r.centre[None])[0] for r in others]
    for k in np.argsort(-surprise, kind="stable"):
        if surprise[k] < _SURPRISE or len(found) >= _MOST_NICHES:
            break
        if any(np.abs(at[k] - c).max() < _CLEAR_OF_REGIONS for c in centres):
            continue
        near = np.abs(at - at[k]).max(axis=1) <= _CLUSTER
        side, failures = _niche_side(margin[near], batch[near])
        if side >= _SHORTEST:
            found.append(Region(u[k], side, failures))
            centres.append(at[k])
    return found


def _niche_side(margin: Vector, batch: Vector) -> tuple[float, int]:
    """Return side and failures of a niche: halved after every second batch without an improvement."""
    side, best, failures = _NICHE, np.inf, 0
    for number in np.unique(batch):
        leader = float(margin[batch == number].min())
        if leader < best:
            best, failures = leader, 0
        else:
            failures += 1
            side = side / 2 if failures % _NICHE_PATIENCE == 0 else side
    return side, failures


def clusters(u: Points, margin: Vector, cube: Cube = CONTINUOUS) -> list[tuple[int, tuple[int, ...]]]:
    """Return the runs that are the best of their neighbourhood, each with the rows of it, where it has few runs."""
    if len(u) == 0:
        return []
    at = cube.embedded(u)
    tree, most = cKDTree(at), min(_MOST_IN_CLUSTER, len(u) - 2)
    few = np.flatnonzero(tree.query_ball_point(at, _CLUSTER, p=np.inf, return_length=True) <= most)
    around = tree.query_ball_point(at[few], _CLUSTER, p=np.inf, return_sorted=True)
    return [(int(k), tuple(near)) for k, near in zip(few, around, strict=True) if margin[k] <= margin[near].min()]

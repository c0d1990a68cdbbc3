"""Drawing from the region of interest (ROI): points with a density proportional to exp(score).

Rejection sampling on one continued Sobol sequence, as in the paper. Points and uniforms are addressed
by the position of the candidate, so that neither the size of the chunks nor an interruption changes
which points are drawn.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from sbt.errors import InputError
from sbt.problem.arrays import Mask, Points, Vector
from sbt.seeds import stream

__all__ = ["Positions", "RoiDraw", "Sequence", "rejection"]

class Sequence(Protocol):
    """Candidates addressed by position: a `SobolSequence`, or the rows of a table."""

    @property
    def dimension(self) -> int:
        """Number of coordinates."""
        ...

    def points(self, start: int, stop: int) -> Points:
        """Return the (m, d) points at positions start, ..., stop - 1."""
        ...


Positions = NDArray[np.int64]
"""(n,) positions in the Sobol sequence."""

_BLOCK = 1024  # positions that share one stream of uniforms
_FIRST_CHUNK = 512


@dataclass(frozen=True, eq=False)
class RoiDraw:
    """What was drawn, and from how many candidates.

    Args:
        u: (n, d) points in the open unit cube, in the order of the sequence.
        positions: (n,) their positions in the sequence.
        next_position: the position at which the next draw starts.
        candidates: admissible candidates that were scored.
        method: "rejection" (the exact density); "short" (the same, but fewer points than asked for); "pool"
            (some points were picked from the rejected candidates, see `rejection`); "even" (no candidate had
            a score above -inf); "smc" (particles took their place).
        acceptance: share of the scored candidates that rejection accepted, in [0, 1].
    """

    u: Points
    positions: Positions
    next_position: int
    candidates: int
    method: Literal["rejection", "short", "pool", "even", "smc"]
    acceptance: float


def rejection(
    score: Callable[[Points], Vector],
    sobol: Sequence,
    n: int,
    *,
    start: int,
    seed: int,
    label: int | str,
    chunk: int = 16384,
    max_candidates: int = 2**19,
    accept_filter: Callable[[Points], Mask] | None = None,
    bound: Callable[[Points], Vector] | None = None,
    fill: bool = True,
) -> RoiDraw:
    """Draw n points with a density proportional to exp(score(u)) by rejection from a Sobol sequence.

    Candidate i is accepted where log U_i < score(u_i). Stops right after the candidate that fills the
    batch. Two ways out where that takes more than `max_candidates`, both named in `method`:

    - "pool": the missing points are drawn without replacement from the rejected candidates, in
      proportion to exp(score) (the Gumbel top-k trick). They favour the best of what was seen, but
      their density is no longer proportional to exp(score): the smaller the pool relative to the
      missing points, the flatter it is. Never weight such points as if it were.
    - "even": all scores are -inf; the first n admissible points of the sequence.

    Args:
        score: (m, d) points -> (m,) log scores <= 0, not NaN; called on admissible points only.
        sobol: the sequence of the campaign.
        n: number of points to draw, >= 0.
        start: position of the first candidate.
        seed: campaign seed of the uniforms.
        label: what the draw is for, e.g. the iteration; another label draws other uniforms.
        chunk: most candidates scored at once; does not change what is drawn.
        max_candidates: most positions looked at, >= n.
        accept_filter: (m, d) points -> (m,) booleans, the constraints of the parameter space.
        bound: (m, d) points -> (m,) upper bounds of their log scores, quicker than `score`: candidates
            that cannot be accepted are not scored. What is drawn is the same, point by point; needs fill False.
        fill: take one of the two ways out; False: return the fewer points there are (`short`).

    Raises:
        InputError: a score above 0 or NaN, or fewer than n admissible candidates.

    Source:
        von Neumann (1951); Winkelmann et al. (2022), section V-A; top-k: Kool et al. (2019).
    """
    if bound is not None and fill:
        raise InputError("a bound leaves candidates without a score, and so there is no pool to fill from: fill must be False")
    if n < 0 or max_candidates < n or chunk < 1:
        raise InputError(
            "rejection needs n >= 0, max_candidates >= n and chunk >= 1, "
            f"but got n = {n}, max_candidates = {max_candidates}, chunk = {chunk}"
        )
    accepted = rejected = _Candidates.none(sobol.dimension)
    position, end, size, scored = start, start + max_candidates, min(_FIRST_CHUNK, chunk), 0
    while len(accepted) < n and position < end:
        stop = min(position + size, end)
        seen, uniform, gumbel = _seen(score, sobol, position, stop, seed, label, accept_filter, bound, fill)
        hit = uniform < np.exp(seen.key)
        last = _index_of(hit, n - len(accepted))
        if last is not None:  # the batch is full: what comes after belongs to the next draw
            seen, hit, gumbel = seen.at(slice(last + 1)), hit[: last + 1], gumbel[: last + 1]
            stop = int(seen.positions[-1]) + 1
        scored += len(seen)
        accepted = accepted.joined(seen.at(hit))
        if fill:
            rejected = rejected.joined(seen.ranked_by(seen.key + gumbel).at(~hit)).best(n)
        position, size = stop, min(_next_size(n, len(accepted), scored, size), chunk)
    if len(accepted) == n:
        share = n / max(scored, 1)
        return RoiDraw(accepted.u, accepted.positions, position, scored, "rejection", share)
    if not fill:
        return RoiDraw(accepted.u, accepted.positions, position, scored, "short", len(accepted) / max(scored, 1))
    return _fall_back(accepted, rejected, n, scored, position)


def _next_size(n: int, accepted: int, scored: int, size: int) -> int:
    """Return how many candidates to look at next: what the missing points will probably take, at most twice as many as last."""
    if accepted == 0:
        return 2 * size
    missing = n - accepted
    return min(2 * size, max(math.ceil((missing + math.sqrt(missing)) * scored / accepted), _FIRST_CHUNK))


@dataclass(frozen=True, eq=False)
class _Candidates:
    """Points (n, d) of the sequence, their positions (n,) and a key (n,) they are ranked by."""

    u: Points
    positions: Positions
    key: Vector

    @classmethod
    def none(cls, dimension: int) -> _Candidates:
        return cls(np.empty((0, dimension)), np.empty(0, np.int64), np.empty(0))

    def __len__(self) -> int:
        return len(self.key)

    def at(self, index: NDArray[np.int64] | Mask | slice) -> _Candidates:
        return _Candidates(self.u[index], self.positions[index], self.key[index])

    def ranked_by(self, key: Vector) -> _Candidates:
        return _Candidates(self.u, self.positions, key)

    def joined(self, other: _Candidates) -> _Candidates:
        return _Candidates(
            np.concatenate([self.u, other.u]),
            np.concatenate([self.positions, other.positions]),
            np.concatenate([self.key, other.key]),
        )

    def best(self, n: int) -> _Candidates:
        """Return the n largest keys; ties (those at -inf) go to the earlier position."""
        return self.at(np.lexsort((self.positions, -self.key))[:n])


def _fall_back(accepted: _Candidates, rejected: _Candidates, n: int, scored: int, end: int) -> RoiDraw:
    """Fill the batch from the best-ranked rejected candidates."""
    filling = rejected.best(n - len(accepted))
    both = accepted.joined(filling)
    if len(both) < n:
        raise InputError(f"the constraints must admit at least {n} of the candidates looked at, but admitted {scored}")
    both = both.at(np.argsort(both.positions))
    if len(accepted) == 0 and np.isneginf(rejected.key).all():
        return RoiDraw(both.u, both.positions, int(both.positions[-1]) + 1, scored, "even", 0.0)
    return RoiDraw(both.u, both.positions, end, scored, "pool", len(accepted) / scored)


def _seen(
    score: Callable[[Points], Vector],
    sobol: Sequence,
    start: int,
    stop: int,
    seed: int,
    label: int | str,
    accept_filter: Callable[[Points], Mask] | None,
    bound: Callable[[Points], Vector] | None,
    fill: bool,
) -> tuple[_Candidates, Vector, Vector]:
    """Return the admissible candidates at the positions, checked log scores as key, uniforms and Gumbel numbers.

    The Gumbel numbers are 0 where they are not needed, without `fill`.

    The key is -inf where the bound already tells that the candidate is rejected.
    """
    u, positions = sobol.points(start, stop), np.arange(start, stop, dtype=np.int64)
    if accept_filter is not None:
        admissible = np.asarray(accept_filter(u), dtype=bool)
        u, positions = u[admissible], positions[admissible]
    uniform, gumbel = _randomness(positions, seed, label, fill)
    log_score = np.full(len(u), -np.inf)
    possible = np.ones(len(u), dtype=bool) if bound is None or len(u) == 0 else uniform < np.exp(bound(u))
    if possible.any():
        log_score[possible] = _checked(score(u[possible]), int(possible.sum()))
    return _Candidates(u, positions, log_score), uniform, gumbel


def _checked(found: Vector, n: int) -> Vector:
    """Return (n,) log scores that rejection can use."""
    log_score = np.asarray(found, dtype=np.float64)
    if log_score.shape != (n,):
        raise InputError(f"a score must return shape ({n},), but got {log_score.shape}")
    if not (log_score <= 1e-9).all():  # also NaN
        bad = log_score[~(log_score <= 1e-9)][0]
        raise InputError(f"a log score used for rejection must be <= 0 and not NaN, but got {bad}")
    return log_score


def _randomness(positions: Positions, seed: int, label: int | str, gumbel: bool) -> tuple[Vector, Vector]:
    """Return (m,) uniforms in [0, 1) and (m,) standard Gumbel numbers (or zeros) that belong to the positions."""
    blocks, inverse = np.unique(positions // _BLOCK, return_inverse=True)
    streams = [stream(seed, "rejection", label, int(block)) for block in blocks]
    uniform = np.array([s.random(_BLOCK) for s in streams]).reshape(-1, _BLOCK)
    at = (inverse, positions % _BLOCK)
    if not gumbel:
        return uniform[at], np.zeros(len(positions))
    exponential = np.array([s.standard_exponential(_BLOCK) for s in streams]).reshape(-1, _BLOCK)
    return uniform[at], -np.log(np.maximum(exponential[at], 1e-300))


def _index_of(hit: Mask, count: int) -> int | None:
    """Return the index of the count-th True (count >= 1), or None where there are fewer."""
    index = np.flatnonzero(hit)
    return int(index[count - 1]) if len(index) >= count else None

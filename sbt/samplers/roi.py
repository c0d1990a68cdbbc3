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

Positions = NDArray[np.int64]
"""(n,) positions in the Sobol sequence."""

_BLOCK = 1024  # positions that share one stream of uniforms
_FIRST_CHUNK = 512  # positions: a batch of 100 at an acceptance of 20 %
_PILOT = 4096  # positions whose largest score is the first bound where scores exceed 0: 1 in 4,096 points may lie above it
_ROUNDING = 1e-9  # above 0, of a score that is bounded by 0


class Sequence(Protocol):
    """Candidates addressed by position: a `SobolSequence`, or the rows of a table."""

    @property
    def dimension(self) -> int:
        """Number of coordinates."""
        ...

    def points(self, start: int, stop: int) -> Points:
        """Return the (m, d) points at positions start, ..., stop - 1."""
        ...


@dataclass(frozen=True, eq=False)
class RoiDraw:
    """What was drawn, and from how many candidates.

    Args:
        u: (n, d) points in the open unit cube, in the order of the sequence.
        positions: (n,) their positions in the sequence.
        next_position: the position at which the next draw starts.
        candidates: admissible candidates up to that position, as far as they had to be scored.
        method: "rejection" (the density of the score); "short" (the same, but fewer points than requested); "pool"
            (some points were picked from the rejected candidates, see `rejection`); "even" (no candidate had
            a score above -inf); "smc" (particles took their place).
        acceptance: share of the scored candidates that rejection accepted, in [0, 1].
        log_bound: the bound of the scores that candidates were accepted against; 0 unless a score exceeded it.
    """

    u: Points
    positions: Positions
    next_position: int
    candidates: int
    method: Literal["rejection", "short", "pool", "even", "smc"]
    acceptance: float
    log_bound: float = 0.0


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

    Candidate i is accepted where log U_i < score(u_i) - M, with the bound M = 0 of the scores. Stops right after the
    candidate that fills the batch. The sequence of candidates decides what is drawn, not the size of the chunks.

    Where a score above 0 comes before the batch is full, 0 is no bound. Then M is the largest score seen so far, at
    least of the first 4,096 positions; when a later candidate exceeds it, all candidates are decided anew with the
    larger M and the same U_i, so that the accepted ones have the density of the score with respect to all candidates
    seen. As a bound of the whole space M is an estimate, from below.

    Two ways out where the batch takes more than `max_candidates`, both named in `method`:

    - "pool": the missing points are drawn without replacement from the rejected candidates, in
      proportion to exp(score) (the Gumbel top-k trick). They favour the best of what was seen, but
      their density is no longer proportional to exp(score): the smaller the pool relative to the
      missing points, the flatter it is. Never weight such points as if it were.
    - "even": all scores are -inf; the first n admissible points of the sequence.

    Args:
        score: (m, d) points -> (m,) log scores < inf, not NaN; called on admissible points only.
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
        InputError: a score that is NaN or +inf, or fewer than n admissible candidates.

    Source:
        von Neumann (1951); Winkelmann et al. (2022), section V-A; bound from the candidates: Caffo, Booth and
        Davis (2002), Empirical supremum rejection sampling, Biometrika 89; top-k: Kool et al. (2019).
    """
    if bound is not None and fill:
        raise InputError("a bound leaves candidates without a score, and so there is no pool to fill from: fill must be False")
    if n < 0 or max_candidates < n or chunk < 1:
        raise InputError(
            "rejection needs n >= 0, max_candidates >= n and chunk >= 1, "
            f"but got n = {n}, max_candidates = {max_candidates}, chunk = {chunk}"
        )
    source = _Source(score, sobol, seed, label, accept_filter, bound, fill)
    accepted = rejected = _Candidates.none(sobol.dimension)
    position, end, size, scored = start, start + max_candidates, min(_FIRST_CHUNK, chunk), 0
    while len(accepted) < n and position < end:
        stop = min(position + size, end)
        seen = source.candidates(position, stop)
        hit = seen.uniform < np.exp(np.minimum(seen.log_score, 0.0))
        last = _index_of(hit, n - len(accepted))
        if last is not None:  # the batch is full: what comes after belongs to the next draw
            seen, hit = seen.at(slice(last + 1)), hit[: last + 1]
            stop = int(seen.positions[-1]) + 1
        if (seen.log_score > _ROUNDING).any():
            return _above_zero(source, n, start, end, chunk)
        scored += len(seen)
        accepted = accepted.joined(seen.at(hit))
        if fill:
            rejected = rejected.joined(seen.at(~hit)).best(n)
        position, size = stop, min(_next_size(n, len(accepted), scored, size), chunk)
    return _drawn(accepted, rejected, n, scored, position, 0.0, fill)


def _above_zero(source: _Source, n: int, start: int, end: int, chunk: int) -> RoiDraw:
    """Return the draw with the largest score seen as the bound; see `rejection`."""
    seen, position, size = _Candidates.none(source.sobol.dimension), start, min(_PILOT, chunk)
    while position < end:
        stop = min(position + size, end)
        seen, position = seen.joined(source.candidates(position, stop)), stop
        if position < min(start + _PILOT, end):
            continue
        full = _first_full(seen, n, int((seen.positions < start + _PILOT).sum()))
        if full is not None:
            last, log_bound = full
            seen = seen.at(slice(last + 1))
            accepted = seen.at(seen.uniform < np.exp(seen.log_score - log_bound))
            return _drawn(accepted, accepted, n, len(seen), int(seen.positions[-1]) + 1, log_bound, source.fill)
        size = min(2 * size, chunk)
    log_bound = max(float(seen.log_score.max(initial=0.0)), 0.0)
    hit = seen.uniform < np.exp(seen.log_score - log_bound)
    return _drawn(seen.at(hit), seen.at(~hit), n, len(seen), end, log_bound, source.fill)


def _first_full(seen: _Candidates, n: int, pilot: int) -> tuple[int, float] | None:
    """Return the first candidate at which n are accepted against the largest score so far, and that score.

    A larger bound accepts fewer, so that a batch which is full under it was not full before.

    Args:
        seen: candidates in order.
        n: >= 1.
        pilot: so many of the first candidates are looked at before any is accepted.
    """
    largest = np.maximum(np.maximum.accumulate(seen.log_score), 0.0)
    if pilot:
        largest[:pilot] = largest[pilot - 1]
    stops = np.flatnonzero(np.diff(largest, append=np.inf))  # the bound stays up to each of them
    for stop in (stops + 1).tolist():
        log_bound = float(largest[stop - 1])
        last = _index_of(seen.uniform[:stop] < np.exp(seen.log_score[:stop] - log_bound), n)
        if last is not None:
            return last, log_bound
    return None


def _drawn(
    accepted: _Candidates, rejected: _Candidates, n: int, scored: int, end: int, log_bound: float, fill: bool
) -> RoiDraw:
    """Return the draw; a batch that is not full is filled from the rejected candidates, where that is wanted."""
    share = len(accepted) / max(scored, 1)
    if len(accepted) >= n or not fill:
        method: Literal["rejection", "short"] = "rejection" if len(accepted) >= n else "short"
        return RoiDraw(accepted.u, accepted.positions, end, scored, method, share, log_bound)
    both = accepted.joined(rejected.best(n - len(accepted)))
    if len(both) < n:
        raise InputError(f"the constraints must admit at least {n} of the candidates looked at, but admitted {scored}")
    both = both.at(np.argsort(both.positions))
    if len(accepted) == 0 and np.isneginf(rejected.log_score).all():
        return RoiDraw(both.u, both.positions, int(both.positions[-1]) + 1, scored, "even", 0.0, log_bound)
    return RoiDraw(both.u, both.positions, end, scored, "pool", share, log_bound)


def _next_size(n: int, accepted: int, scored: int, size: int) -> int:
    """Return how many candidates to look at next: what the missing points will probably take, at most twice as many as last."""
    if accepted == 0:
        return 2 * size
    missing = n - accepted
    return min(2 * size, max(math.ceil((missing + math.sqrt(missing)) * scored / accepted), _FIRST_CHUNK))


@dataclass(frozen=True, eq=False)
class _Candidates:
    """Admissible candidates in the order of the sequence.

    Args:
        u: (n, d) points.
        positions: (n,) in the sequence.
        log_score: (n,) log scores; -inf where the quick bound already tells that the candidate is rejected.
        uniform: (n,) U, uniform in [0, 1).
        gumbel: (n,) standard Gumbel numbers, or zeros where no pool is filled.
    """

    u: Points
    positions: Positions
    log_score: Vector
    uniform: Vector
    gumbel: Vector

    @classmethod
    def none(cls, dimension: int) -> _Candidates:
        nothing = np.empty(0)
        return cls(np.empty((0, dimension)), np.empty(0, np.int64), nothing, nothing, nothing)

    def __len__(self) -> int:
        return len(self.positions)

    def at(self, index: NDArray[np.int64] | Mask | slice) -> _Candidates:
        return _Candidates(
            self.u[index], self.positions[index], self.log_score[index], self.uniform[index], self.gumbel[index]
        )

    def joined(self, other: _Candidates) -> _Candidates:
        both = zip(vars(self).values(), vars(other).values(), strict=True)
        return _Candidates(*(np.concatenate(pair) for pair in both))

    def best(self, n: int) -> _Candidates:
        """Return n candidates drawn without replacement in proportion to exp(score); ties (at -inf) go to the earlier one."""
        return self.at(np.lexsort((self.positions, -(self.log_score + self.gumbel)))[:n])


@dataclass(frozen=True, eq=False)
class _Source:
    """Where candidates come from; the arguments are those of `rejection`."""

    score: Callable[[Points], Vector]
    sobol: Sequence
    seed: int
    label: int | str
    accept_filter: Callable[[Points], Mask] | None
    bound: Callable[[Points], Vector] | None
    fill: bool

    def candidates(self, start: int, stop: int) -> _Candidates:
        """Return the admissible candidates at the positions start, ..., stop - 1."""
        u, positions = self.sobol.points(start, stop), np.arange(start, stop, dtype=np.int64)
        if self.accept_filter is not None:
            admissible = np.asarray(self.accept_filter(u), dtype=bool)
            u, positions = u[admissible], positions[admissible]
        uniform, gumbel = _randomness(positions, self.seed, self.label, self.fill)
        log_score = np.full(len(u), -np.inf)
        undecided = np.ones(len(u), dtype=bool) if self.bound is None or len(u) == 0 else uniform < np.exp(self.bound(u))
        if undecided.any():
            log_score[undecided] = _checked(self.score(u[undecided]), int(undecided.sum()))
        return _Candidates(u, positions, log_score, uniform, gumbel)


def _checked(found: Vector, n: int) -> Vector:
    """Return (n,) log scores that rejection can use."""
    log_score = np.asarray(found, dtype=np.float64)
    if log_score.shape != (n,):
        raise InputError(f"a score must return shape ({n},), but got {log_score.shape}")
    if not (log_score < np.inf).all():  # also NaN
        bad = log_score[~(log_score < np.inf)][0]
        raise InputError(f"a log score used for rejection must be < inf and not NaN, but got {bad}")
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

"""Ways to choose the runs of a batch: evenly, from the region of interest, and the boundary's mix.

A rule is a function of the settings, the fitted metamodel, the log and the number of runs wanted: nothing is
remembered between batches but what the log says.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sbt.acquisitions import boundary, even, log_scores
from sbt.campaigns.exploration import about_regions, exploration_share, explore, should_explore, space_filling
from sbt.campaigns.records import BatchProposal
from sbt.campaigns.repeats import simulator_noise
from sbt.campaigns.settings import Acquisition, Settings
from sbt.campaigns.unscored import are_unscored
from sbt.errors import InputError
from sbt.loop.learner import FittedMetamodel
from sbt.loop.stages import Log
from sbt.metamodels.prediction import Prediction
from sbt.problem.arrays import Mask, Points, Vector
from sbt.samplers.greedy import influence_on_mean, propose_greedily, select_diverse, select_representative
from sbt.samplers.pool import PoolSequence
from sbt.samplers.roi import RoiDraw, rejection
from sbt.samplers.smc import smc
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream

__all__ = ["ChoiceRule", "Chosen", "evenly", "filling", "from_roi", "greedily", "mixed"]

_MAX_REJECTION_CANDIDATES = 2**14  # that the mix looks at before it turns to particles: about a second with a GP
_MOST_EVEN = 2**23  # where none is scored: 8,000 runs of a space of which constraints leave a thousandth
_FILLING = 0.1  # share of the mix that fills the space, held-out runs included
_MOST_FILLING = 0.6  # the same where noise alone decides: where P is said to be small nobody would look again
_SETTLED = 0.5  # the same while edges are known far better than what even runs may have missed
_KNOWN, _SHARP = 0.1, 0.05  # of 1 / the even runs, and of the critical share: expected on the wrong side where they are
_ALIKE = 1.0, 0.6  # the same while all runs have one value, which tells of no direction; while all are critical
_FILLED_INSTEAD, _MOST_LOST = 0.6, 0.25  # the same where so many of the chosen runs fail
_PROBED = 512  # points at which the noise is taken
_TYPICAL = 0.8  # share of what neither explores nor fills the space; the rest is chosen greedily
_DRAWN, _MOST_DRAWN = 600, 2000  # points that the representative ones are chosen from


@dataclass(frozen=True, eq=False)
class Chosen:
    """The runs chosen, (n, d) in the inputs' units, and how."""

    x: Points
    proposal: BatchProposal


ChoiceRule = Callable[[Settings, FittedMetamodel | None, Log, int], Chosen]
"""(settings, fitted metamodel, log, n) -> n runs."""


def evenly(settings: Settings, fitted: FittedMetamodel | None, log: Log, n: int) -> Chosen:
    """Return the next n points of the Sobol sequence, or of a table's random order."""
    del fitted
    draw, x = _draw(settings, None, even, log, n)
    return Chosen(x, _proposal(draw))


def filling(settings: Settings, fitted: FittedMetamodel | None, log: Log, n: int) -> Chosen:
    """Return what `evenly` does, as runs that fill the space."""
    chosen = evenly(settings, fitted, log, n)
    return replace(chosen, proposal=replace(chosen.proposal, filling=n))


def from_roi(settings: Settings, fitted: FittedMetamodel | None, log: Log, n: int) -> Chosen:
    """Return n points with a density proportional to the acquisition, by rejection from the Sobol sequence.

    Where that takes more than half a million candidates the points are particles of a sequential Monte
    Carlo sampler instead (`method: smc`).

    Source:
        Winkelmann et al. (2022), section V-A.
    """
    acquisition = settings.acquisition if settings.acquisition is not None else boundary
    draw, x = _draw(settings, fitted, acquisition, log, n)
    return Chosen(x, replace(_proposal(draw), unscored=_unscored(settings, fitted, acquisition, x)))


def greedily(settings: Settings, fitted: FittedMetamodel | None, log: Log, n: int) -> Chosen:
    """Return the n candidates of the highest acquisition that are far from each other and from earlier runs."""
    if fitted is None:
        return evenly(settings, fitted, log, n)
    acquisition = settings.acquisition if settings.acquisition is not None else boundary
    start = _position(settings, log)
    x, looked = _greedy(settings, fitted, acquisition, log, n, np.empty((0, settings.scenario.space.dimension)))
    if len(x) == n:
        return Chosen(x, BatchProposal("greedy", start, looked))
    draw, rest = _draw(settings, fitted, even, log, n - len(x), taken=x)
    every = np.concatenate([x, rest])
    unscored = _unscored(settings, fitted, acquisition, every)
    return Chosen(every, BatchProposal("greedy", draw.next_position, looked, even=len(rest), unscored=unscored))


def mixed(settings: Settings, fitted: FittedMetamodel | None, log: Log, n: int) -> Chosen:
    """Return a batch of parts: exploration where critical runs are rare, representative, greedy and space-filling runs.

    Four fifths of the batch are representative: of points drawn from a_BI as in the paper those that leave the least
    uncertainty far from a run. One fifth is chosen one by one by a_BI times the squared distance to the nearest run, which also
    looks into the corners. 10 % fill the space; held-out runs count as such; half of the runs where edges are known far better
    than what so few of them may have missed. While all runs are critical at least 60 % do, as uncertainty is largest in the
    corners then. Where the mean P(critical) is below 1 %, half of the batch explores first (see `explore`); beside plateaus all
    of it does, or none, which then looks about the known regions (see `exploration_share`).
    """
    if fitted is None:
        return evenly(settings, fitted, log, n)
    alike = _all_alike(settings, log)
    exploring = should_explore(settings, fitted, log) and alike < 1.0
    share = exploration_share(settings, log) if exploring else 0.0
    fitted = _within(fitted, about_regions(settings, log) if exploring else None)
    looking = explore(settings, log, min(_rounded(share * n, log), n))
    opened = _MOST_FILLING * _open_share(settings, fitted, log)
    filled = max(_FILLING, opened, _settled(fitted, log), alike, _lost(fitted, log))
    even_runs = min(_rounded(max(filled - settings.holdout_fraction, 0.0) * n, log), n - len(looking))
    first, fill = _draw(settings, fitted, even, log, even_runs, taken=looking)
    so_far = np.concatenate([looking, fill])
    second, typical = _typical(settings, fitted, log, _rounded(_TYPICAL * (n - len(so_far)), log), so_far, first.next_position)
    so_far = np.concatenate([so_far, typical])
    greedy, looked = _greedy(settings, fitted, boundary, log, n - len(so_far), so_far)
    so_far, last = np.concatenate([so_far, greedy]), second
    if len(so_far) < n:  # nothing is uncertain
        last, more = _draw(settings, fitted, even, log, n - len(so_far), taken=so_far, start=second.next_position)
        so_far = np.concatenate([so_far, more])
    proposal = BatchProposal(
        "mix", last.next_position, second.candidates + looked, second.acceptance, random=second.method, explored=len(looking),
        filling=len(fill), representative=len(typical), greedy=len(greedy),
    )  # fmt: skip
    return Chosen(so_far, proposal)


def _settled(fitted: FittedMetamodel, log: Log) -> float:
    """Return the share of runs that fill the space while edges are known, and regions that no run met are not; else 0.

    A region next to which nothing tells of it is met by even runs alone, of size 1 / n by n of them.
    """
    record, n = fitted.record, int(space_filling(log).sum())
    wrong = record.expected_misclassified
    return _SETTLED if n and wrong < _KNOWN / n and wrong < _SHARP * record.critical_fraction else 0.0


def _lost(fitted: FittedMetamodel, log: Log) -> float:
    """Return the share of runs that fill the space while those that are chosen fail, and most of the space does not; else 0.

    Then all that is unsure lies where runs begin to fail, which the next ones would tell no more of.
    """
    chosen, failing = log.history.where(~space_filling(log)), fitted.record.failing_fraction
    if failing is None or not len(chosen):
        return 0.0
    return _FILLED_INSTEAD if float(1.0 - chosen.ok.mean()) > max(_MOST_LOST, 2.0 * failing) else 0.0


def _all_alike(settings: Settings, log: Log) -> float:
    """Return the share of runs that fill the space while all are critical, or have one value: where others are is not known."""
    requirement, training = settings.scenario.requirement, log.history.training
    if not len(training):
        return 0.0
    same = not np.ptp(requirement.margins(training)) > 0.0
    return _ALIKE[0] if same else _ALIKE[1] if requirement.critical_runs(training).all() else 0.0


def _open_share(settings: Settings, fitted: FittedMetamodel, log: Log) -> float:
    """Return the share in [0, 1] of the variance of "critical or not" that inputs leave open; 0 of a deterministic simulator."""
    scenario = settings.scenario
    if scenario.pool is not None or not simulator_noise(log.history, scenario.requirement).noisy:
        return 0.0
    at = SobolSequence(scenario.space.dimension, settings.seed).points(0, _PROBED)
    p = fitted.predict(at).probability(scenario.requirement.critical)
    mean = float(p.mean())
    return float((p * (1.0 - p)).mean()) / (mean * (1.0 - mean)) if 0.0 < mean < 1.0 else 0.0


def _within(fitted: FittedMetamodel, places: Callable[[Points], Mask] | None) -> FittedMetamodel:
    """Return the metamodel for which runs elsewhere show nothing; None: they do."""
    if places is None:
        return fitted
    success = fitted.log_success

    def log_success(u: Points) -> Vector:
        there = np.where(places(u), 0.0, -np.inf)
        return there if success is None else there + success(u)

    return replace(fitted, log_success=log_success)


def _typical(settings: Settings, fitted: FittedMetamodel, log: Log, n: int, taken: Points, start: int) -> tuple[RoiDraw, Points]:
    """Return a draw from a_BI, and the n of its points that represent it best beside the runs there are."""
    space = settings.scenario.space
    drawn = max(n, min(_DRAWN + 2 * n, _MOST_DRAWN)) if n else 0
    draw, x = _draw(settings, fitted, boundary, log, drawn, taken=taken, start=start, most=_MAX_REJECTION_CANDIDATES)
    u, there = (np.clip(space.to_unit(p), 0.0, 1.0) for p in (x, np.concatenate([log.planned.x, taken])))
    rng = stream(settings.seed, "representative", log.iteration)
    scale = influence_on_mean(fitted.sketch or fitted.predict, space.dimension, rng)
    weight = np.exp(_score(settings, fitted, boundary)(u))  # a_BI once more: sharper than it was drawn
    at = space.cube.embedded
    return draw, x[select_representative(at(u), weight, at(there), n, space.cube.spread(scale))]


def _rounded(wanted: float, log: Log) -> int:
    """Return the number rounded so that over the iterations the share is right."""
    return math.floor(wanted * (log.iteration + 1)) - math.floor(wanted * log.iteration)


def _proposal(draw: RoiDraw) -> BatchProposal:
    return BatchProposal(draw.method, draw.next_position, draw.candidates, draw.acceptance)


def _position(settings: Settings, log: Log) -> int:
    """Return where the Sobol sequence goes on; behind the first runs of an earlier campaign of the same scenario and seed."""
    last, earlier = log.last(BatchProposal), None if settings.learner is None else settings.learner.earlier
    begin = 0 if earlier is None or earlier.other else len(earlier)
    return begin if last is None else last.next_position


def _score(settings: Settings, fitted: FittedMetamodel | None, acquisition: Acquisition) -> Callable[[Points], Vector]:
    if fitted is None or acquisition is even:
        return lambda u: np.zeros(len(u))
    return _score_by(settings, fitted, acquisition, fitted.predict)


def _unscored(settings: Settings, fitted: FittedMetamodel | None, acquisition: Acquisition, x: Points) -> int | None:
    """Return how many of the runs (n, d) an acquisition was to choose and did not; None where it did."""
    u = np.clip(settings.scenario.space.to_unit(x), 0.0, 1.0)
    return len(x) if are_unscored(_score(settings, fitted, acquisition), u) else None


def _rough_score(settings: Settings, fitted: FittedMetamodel, acquisition: Acquisition) -> Callable[[Points], Vector] | None:
    """Return about the score, many times quicker; None where there is no such thing."""
    return None if fitted.sketch is None else _score_by(settings, fitted, acquisition, fitted.sketch)


_WARY = 2.0
"""Power of P(a run gives a metric): one that fails shows nothing. With 1, draws go to where failing begins in the end."""


def _score_by(
    settings: Settings, fitted: FittedMetamodel, acquisition: Acquisition, predict: Callable[[Points], Prediction]
) -> Callable[[Points], Vector]:
    space, critical = settings.scenario.space, settings.scenario.requirement.critical

    def score(u: Points) -> Vector:
        found = log_scores(acquisition, predict(u), critical, space.log_density_in_cube(u))
        return found if fitted.log_success is None else found + _WARY * fitted.log_success(u)

    return score


def _admissible(settings: Settings) -> Callable[[Points], Mask] | None:
    space = settings.scenario.space
    return (lambda u: space.feasible(space.from_unit(u))) if space.constraints else None


def _draw(
    settings: Settings, fitted: FittedMetamodel | None, acquisition: Acquisition, log: Log, n: int, *,
    taken: Points | None = None, start: int | None = None, most: int = 2**19,
) -> tuple[RoiDraw, Points]:  # fmt: skip
    """Return n points drawn by an acquisition, and their values exactly as recorded where they are.

    `taken` (k, d) are the rows of this batch so far in the inputs' units, `start` the position in the Sobol
    sequence (None: where the last batch ended), `most` the candidates to look at before particles are used.
    """
    scenario = settings.scenario
    score, label = _score(settings, fitted, acquisition), f"{log.iteration}/{0 if taken is None else len(taken)}"
    if scenario.pool is not None:
        rows = _rows(settings, log, taken)
        n = min(n, len(rows))
        draw = rejection(
            score, rows, n, start=0, seed=settings.seed, label=label, max_candidates=max(len(rows), 1),
            accept_filter=_admissible(settings),
        )  # fmt: skip
        return draw, scenario.pool.x[rows.rows[draw.positions]]
    sobol = SobolSequence(scenario.space.dimension, settings.seed)
    begin = _position(settings, log) if start is None else start
    bound = fitted.log_ambiguity_bound if fitted is not None and acquisition is boundary else None
    most = _MOST_EVEN if acquisition is even or fitted is None else most
    draw = rejection(
        score, sobol, n, start=begin, seed=settings.seed, label=label, max_candidates=max(most, n),
        accept_filter=_admissible(settings), bound=bound, fill=False,
    )  # fmt: skip
    if draw.method == "short" and acquisition is not even:
        rough = None if fitted is None else _rough_score(settings, fitted, acquisition)
        rough_bound = None if fitted is None or bound is None else fitted.sketch_bound
        draw = _particles(settings, score, rough, bound, rough_bound, draw, label, n)
        if draw.method == "short":  # the score is -inf wherever one looks
            return _draw(settings, fitted, even, log, n, taken=taken, start=begin)
    if len(draw.u) < n and fitted is not None and fitted.log_success is not None:  # too little of the space is worth a run
        return _draw(settings, None, even, log, n, taken=taken, start=begin)
    if len(draw.u) < n:
        raise InputError(f"the constraints must admit {n} of {draw.candidates} candidates, but admitted {len(draw.u)}")
    return draw, scenario.space.from_unit(draw.u)


def _particles(
    settings: Settings, score: Callable[[Points], Vector], rough: Callable[[Points], Vector] | None,
    bound: Callable[[Points], Vector] | None, rough_bound: Callable[[Points], Vector] | None, draw: RoiDraw, label: str, n: int,
) -> RoiDraw:  # fmt: skip
    """Return the draw with points of a sequential Monte Carlo sampler instead of picks among the rejected."""
    rng, admissible = stream(settings.seed, "smc", label), _admissible(settings)

    def inside(value_of: Callable[[Points], Vector]) -> Callable[[Points], Vector]:
        return value_of if admissible is None else lambda u: np.where(admissible(u), value_of(u), -np.inf)

    found = smc(
        inside(score), settings.scenario.space.dimension, rng, particles=max(1024, 2 * n), start=max(4096, 2 * n), bound=bound,
        cube=settings.scenario.space.cube, uniform=_feasible(settings), rough=None if rough is None else inside(rough),
        rough_bound=rough_bound,
    )  # fmt: skip
    if found is None:
        return draw
    distinct = np.unique(found.u, axis=0, return_index=True)[1]
    if len(distinct) < n:
        return draw
    picks = rng.choice(distinct, n, replace=False)
    return RoiDraw(found.u[picks], draw.positions, draw.next_position, draw.candidates, "smc", draw.acceptance)


def _feasible(settings: Settings) -> Points | None:
    """Return uniform feasible points where there are constraints: of a narrow space, others would find next to none."""
    return settings.learner.probe if settings.learner is not None and settings.scenario.space.constraints else None


def _rows(settings: Settings, log: Log, taken: Points | None) -> PoolSequence:
    """Return the recorded rows that are left to choose from."""
    scenario = settings.scenario
    if scenario.pool is None:
        raise ValueError("only a recorded table has rows")
    u = np.clip(scenario.space.to_unit(scenario.pool.x), 0.0, 1.0)
    gone = log.planned.x if taken is None else np.concatenate([log.planned.x, taken])
    return PoolSequence(u, scenario.pool.taken(gone), settings.seed)


def _greedy(
    settings: Settings, fitted: FittedMetamodel, acquisition: Acquisition, log: Log, n: int, taken: Points
) -> tuple[Points, int]:
    """Return up to n points in the inputs' units, and the number of candidates looked at."""
    scenario, space = settings.scenario, settings.scenario.space
    rng = stream(settings.seed, "greedy", log.iteration)
    score, admissible = _score(settings, fitted, acquisition), _admissible(settings)
    scale = influence_on_mean(fitted.sketch or fitted.predict, space.dimension, rng)
    there = np.clip(space.to_unit(np.concatenate([log.planned.x, taken])), 0.0, 1.0)
    if scenario.pool is not None:
        rows = _rows(settings, log, taken)
        u = rows.points(0, len(rows))
        at = space.cube.embedded
        picks = select_diverse(at(u), score(u), at(there), n, space.cube.spread(scale))
        return scenario.pool.x[rows.rows[picks]], len(u)

    def snap(v: Points) -> Points:  # integers are what will be run
        return np.clip(space.to_unit(space.from_unit(v)), 0.0, 1.0)

    u, looked = propose_greedily(
        score, there, n, scale, rng, snap=snap, admissible=admissible, cube=space.cube, uniform=_feasible(settings),
        rough=_rough_score(settings, fitted, acquisition),
    )  # fmt: skip
    return space.from_unit(u), looked

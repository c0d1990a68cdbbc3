"""What the log keeps of how a batch was chosen: one record for each kind of stage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from sbt.store.records import optional

__all__ = [
    "CONFIRM", "COUNT", "EXPLORE", "LEARN", "LINK", "RACE", "BatchProposal", "CoarseDraws", "CountedDraws", "EstimationProposal",
    "EventDraws", "LevelsRecord", "NominalDraws", "PoolSummary", "ScreenRecord", "SearchProposal",
]  # fmt: skip

EXPLORE, LEARN, COUNT = "explore", "learn", "count"
"""Phases of an estimation: a search for modes, draws that only teach, draws that count."""
CONFIRM = "confirm"
"""Stage of the runs that repeat a failure mode's representative with fresh seeds; they come beside the budget."""
RACE, LINK = "race", "link"
"""Methods of a batch of that stage: repetitions that decide which of several modes comes first; runs between critical ones, that
tell whether these are of one mode."""


@dataclass(frozen=True)
class BatchProposal:
    """How a batch of a boundary or coverage campaign was chosen.

    Attributes:
        method: rejection, smc, pool, greedy or mix.
        next_position: in the campaign's Sobol sequence.
        candidates: points that were scored.
        acceptance: share of them that rejection accepted; None where nothing was rejected.
        held_out: random runs that only score the metamodel.
        random: of a mix, how its random points were drawn.
        explored: of a mix, runs that searched for unknown critical regions: the first ones of the batch.
        filling, representative, greedy: of a mix, runs that fill the space, represent a_BI, or were chosen one by one.
        even: of a greedy batch, runs that fill the space because nothing else was left.
        repeats: runs that repeat inputs with other seeds: the last ones of the batch before those held out.
        pairs: runs before these whose seeds were chosen by what they draw.
        unscored: runs that an acquisition of -inf everywhere was to choose: they fill the space.
    """

    method: str
    next_position: int
    candidates: int = 0
    acceptance: float | None = None
    held_out: int = 0
    random: str | None = optional()
    explored: int | None = optional()
    filling: int | None = optional()
    representative: int | None = optional()
    greedy: int | None = optional()
    even: int | None = optional()
    repeats: int | None = optional()
    pairs: int | None = optional()
    unscored: int | None = optional()


@dataclass(frozen=True)
class ScreenRecord:
    """What coarse runs were worth to a falsification when a batch was chosen.

    Attributes:
        times: candidates that are run coarse for each run; 1: screening did not pay, and there were none.
        rate: share of the candidates that are critical.
        correlation: of the ranks of the metric at both levels, over pairs that no coarse run chose; None: they tell none.
        pairs: number of these.
        gain: critical runs for the same cost over those without; None: too little was known.
        random: of the batch, its first runs, which no coarse run chose.
    """

    times: int
    rate: float
    correlation: float | None
    pairs: int
    gain: float | None = None
    random: int = 0


@dataclass(frozen=True)
class SearchProposal:
    """How a batch of a falsification was chosen.

    Attributes:
        method: portfolio, another criterion, an acquisition, even (the first batch), link, race or repeat (confirmations).
        next_position: in the campaign's Sobol sequence.
        criteria: how many runs each criterion of the method chose.
        even: runs that fill the space.
        held_out: random runs that only score the metamodel.
        repeats: runs that repeat inputs with other seeds.
        coarse: with two levels of fidelity, what coarse runs were worth.
        ends: of each run of a batch by link, the indices of the two critical runs that it is between.
    """

    method: str
    next_position: int
    criteria: Mapping[str, int] = field(default_factory=dict)
    even: int = 0
    held_out: int = 0
    repeats: int | None = optional()
    coarse: ScreenRecord | None = optional()
    ends: tuple[tuple[int, int], ...] | None = optional()


@dataclass(frozen=True)
class PoolSummary:
    """The pool that a batch of an estimation was drawn from.

    Attributes:
        size: points.
        probability: mean P(critical) of the metamodel over the pool, under the inputs' distribution.
        anticipated: variance of one draw that the metamodel anticipates.
        components: of the mixture that the pool was sampled from.
        fallback: an earlier metamodel was used, because the newest one had lost its precision.
    """

    size: int
    probability: float
    anticipated: float
    components: int
    fallback: bool = False


@dataclass(frozen=True)
class EventDraws:
    """What the metamodel states of an event, such as one requirement of a combination, at counted draws.

    Attributes:
        probability: mean P(event) over the pool, under the inputs' distribution.
        anticipated: variance of one draw that it anticipates.
        pool_variance: variance of the pool's mean.
        pi: of each draw, P(event).
        by_warm_up: see `CountedDraws`.
        failed_critical: the same with every failed run as the event; left out where no run had failed.
    """

    probability: float
    anticipated: float
    pool_variance: float
    pi: tuple[float, ...]
    by_warm_up: tuple[float, ...] | None = optional()
    failed_critical: EventDraws | None = optional()


@dataclass(frozen=True)
class CountedDraws:
    """Draws with known density, which the estimate counts.

    Attributes:
        pool_variance: variance of the pool's mean.
        coefficient: of each draw in the estimate: density ratio over the number of draws.
        control_variate: of each draw, P(critical) that the pool's mean accounts for.
        pi: of each draw, the metamodel's P(critical).
        parts: of a combination, what is stated of each requirement.
        failed_critical: what is stated of critical or failed runs; left out where no run had failed.
        weight: of the batch among others, in draws; None: their number.
        by_warm_up: what the pool's pairs of each warm-up add to its mean, less their part of it; None: the mean knows no seeds.
    """

    pool_variance: float
    coefficient: tuple[float, ...]
    control_variate: tuple[float, ...]
    pi: tuple[float, ...]
    parts: tuple[EventDraws, ...] | None = optional()
    failed_critical: EventDraws | None = optional()
    weight: float | None = optional()
    by_warm_up: tuple[float, ...] | None = optional()


@dataclass(frozen=True)
class NominalDraws:
    """Draws of a batch that were made in proportion to the inputs' distribution, whether the batch counts or only teaches.

    Attributes:
        pi: of each, the metamodel's P(critical); they are the first runs of the batch.
    """

    pi: tuple[float, ...]


@dataclass(frozen=True)
class CoarseDraws:
    """A pool of pairs of inputs and seed, and those of them that were run at the coarse level of fidelity.

    Attributes:
        pool: number of pairs.
        total, squares: sums over the pool of P(critical) as believed before any run, and of its square.
        before: of each coarse run, that belief.
        probability: of each, with which it was drawn.
        both: the first so many are run at both levels, whatever the coarse run gives.
        fine: number of further runs of the scenario to be drawn.
    """

    pool: int
    total: float
    squares: float
    before: tuple[float, ...]
    probability: tuple[float, ...]
    both: int
    fine: int


@dataclass(frozen=True)
class LevelsRecord:
    """What two levels of fidelity were worth when a batch was chosen, in variance times cost: smaller is better.

    Attributes:
        coarse: whether coarse runs were made for it.
        two_levels, one_level: with coarse runs, and without, over that of crude Monte Carlo; None: too little was known.
        pays: whether coarse runs clearly pay; None: too little was known.
    """

    coarse: bool
    two_levels: float | None = None
    one_level: float | None = None
    pays: bool | None = None


@dataclass(frozen=True)
class EstimationProposal:
    """How a batch of an estimation was chosen.

    Attributes:
        phase: initial, explore (search for modes), learn (draws that only teach, or bound), count or subset.
        method: sobol, explore, uncertainty, difference, meta, monte_carlo or subset.
        modes: failure modes that were known, in the phase of exploration.
        pool: what the draws came from.
        counted: the draws that count.
        nominal: the draws in proportion to the inputs' distribution.
        axes: of many inputs, those that the subspace of the draws holds beside its direction.
        drawn_coarse: with two levels of fidelity, the coarse runs of the batch.
        levels: and what they were worth.
        pairs: the batch has pairs of inputs and seed; so many came from the pool, the others were searched for.
        level: of subset simulation, points a level, where levels come from other repeats; None: from their own, as once.
        trial: of many inputs left to crude Monte Carlo, whether the first and the second half of the first draws count.
    """

    phase: str
    method: str
    modes: int | None = optional()
    pool: PoolSummary | None = optional()
    counted: CountedDraws | None = optional()
    nominal: NominalDraws | None = optional()
    axes: tuple[int, ...] | None = optional()
    drawn_coarse: CoarseDraws | None = optional()
    levels: LevelsRecord | None = optional()
    pairs: int | None = optional()
    level: int | None = optional()
    trial: tuple[bool, bool] | None = optional()

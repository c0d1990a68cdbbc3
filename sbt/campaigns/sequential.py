"""The sequential estimator as a stage: search, learn, then count, every batch a function of the log.

A batch of the estimation has draws from a fresh pool, with known density, and search picks without
one. Up to a stopping time the draws only teach; from then on they count, with weights fixed in advance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import gammaincinv
from threadpoolctl import threadpool_limits

from sbt.campaigns.counting import DRAWN, NOMINAL
from sbt.campaigns.crude import MonteCarloStage, took_monte_carlo
from sbt.campaigns.known import SURE_NOISE, Known, metamodel_of
from sbt.campaigns.pools import SKETCH, Frame, Proposal, draw_batch, draw_pool, fit_proposal, planned
from sbt.campaigns.records import COUNT, EXPLORE, LEARN, EstimationProposal
from sbt.campaigns.repeats import repeats_wanted, simulator_noise
from sbt.campaigns.settings import Settings
from sbt.campaigns.stopping import (
    count_begins,
    draws_that_count,
    is_precise,
    only_unseen,
    pools_of,
    relative_error,
    relative_error_of,
    spared,
    steadier,
    trusts_search,
)
from sbt.estimators.choices import ChoiceScore, choice_scores, from_cube, to_cube
from sbt.estimators.importance import SHARES
from sbt.estimators.mixture import wide_scales, within_reach
from sbt.estimators.surrogate import MOST_LEARNED, Coordinates, LogProbability, settled, sketch_of
from sbt.loop.stages import Batch, Log
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.cube import Cube
from sbt.samplers import portfolio
from sbt.samplers.search import Search
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream
from sbt.store.database import PlannedRun

__all__ = ["SEARCHED", "SequentialStage"]

SEARCHED = "hunt"
"""Stage of runs that search for modes."""

# When the search for modes ends.
_SEARCH_BUDGET = 0.25
"""Largest share of the budget that it takes. It leaves known regions alone, so that each of its hits seems to be a new mode while
the metamodel is coarse; later batches go on searching, and learn those regions too."""
_QUIET = 3
"""Batches without a new mode after which it ends."""
_COMMON = 0.02
"""P(critical) under the inputs' distribution above which draws from it meet every region that counts beside noise."""
_SMALL = 150
"""Budget below which the search ends there: what it takes is missing where draws count."""
_BLUR = 0.05
"""Standard deviation of noise over the median deviation of the metric, from which on a simulator is taken for noisy there."""
_EVEN_SHARE = 0.1
"""Of the search picks, those that are spread evenly: they do not depend on the metamodel."""
_BATCHES, _BATCH = 8, 15
"""Least number of batches that a budget is for, and runs that a batch may have anyway. With a single batch that counts a fifth of
the intervals missed where the metric jumps: it was drawn with what a search alone had learned, and no other one denies it."""
_EXPECTED = 2000
"""Draws of the inputs' distribution by which it is judged what the metamodel expects of it."""
_SEARCH_SHARE = (0.2, 0.1)
"""Of later batches, the share that still searches: before and after the count has begun."""
_SEARCH_BLIND = 0.4
"""The same while all runs are on one side of the boundary."""
_BLIND = (0.0, 0.75, 0.1, 0.15)
"""Shares of the draws (`SHARES`) until then; they only teach: what would count then is rarely met, and weighs much if it is."""

_NOMINAL = (0.0, 1.0, 0.0, 0.0)
"""Shares where a gate lacks nothing but a bound on what no run has met: draws from the inputs' distribution, which do not count,
as few of them would tell of the boundary."""
_AT_ONCE = 4
"""Batches that such draws are made in at once: where they lie does not depend on what was learned."""
_TRANSFERRED = (0.48, 0.35, 0.05, 0.12)
"""Shares of a campaign that knows another setup's: it is short, and its draws from the inputs' distribution alone meet what the
other one did not have."""

_GAIN = 4.0
_LEARNED = 0.125
"""Share of the budget before which that is not decided: nine of 50 campaigns with a gain of five were left to it at 30 of 500."""
_MANY_HITS, _ENOUGH = 5.0, 0.2  # expected of crude Monte Carlo; share of the budget before fewer leave the estimation to it
"""Variance of crude Monte Carlo over what the metamodel anticipates, below which a noisy simulator is left to the former: the
geometric mean of this and the last batch, as what few runs let expect varies by a factor of three, and there is no way back."""
_MET, _NO_GAIN = 2, 1.5
"""Critical runs with which it is whatever P the metamodel expects, where it gains next to nothing: it may deny what was met."""
_UNLIKELY = 0.05
"""Level of the largest noise that repeats let expect. Were the gain `_GAIN` with that noise and with means known, it is not left:
a process takes for noise what it has not learned yet, and learns it."""
_TOLD, _TOLD_RUNS, _MET_ANYWAY = 0.3, 60, 0.05
"""Share of the budget, and runs, from which on a metamodel that gains nothing is given up: of 53 testbeds, two seeds each, only
rastrigin_ak has one that does not gain by then. Where failures are so common any draws meet them, and it is learned later."""
_RETURN = 0.5
"""Share of the budget up to which draws that count end where values come that can be followed."""
_SEARCHED = 1000
"""Runs that searches learn from at most: they look for regions, not for their edges, and cost the square of them."""
_SURPRISE = 0.01
"""P of what a run since then was, by an earlier metamodel, below which it refutes that."""
_OFF = 8.0
"""Standard deviations by which its metric may be off: with heavy tails that is rarely so, and the newest metamodel draws."""


@dataclass(frozen=True)
class SequentialStage:
    """Searches for critical regions, learns them, then draws runs that count.

    Source:
        the difference form, its defence, weights and interval: `sbt.estimators`.
    """

    settings: Settings
    name: str = DRAWN

    @cached_property
    def _coordinates(self) -> Coordinates:
        return Coordinates(self.settings.scenario.space)

    @cached_property
    def _choices(self) -> tuple[ChoiceScore, ...]:
        return choice_scores(self.settings.scenario.space)

    @cached_property
    def _wide(self) -> Vector:
        return wide_scales(self._coordinates.bounded)

    @cached_property
    def _frame(self) -> Frame:
        return Frame(self._wide, self._choices)

    @cached_property
    def _admissible(self) -> Points:
        return self.settings.scenario.space.sample_scores(_EXPECTED, stream(self.settings.seed, "admissible"))

    @property
    def _spares_search(self) -> bool:
        """Whether another setup's campaign tells where to draw at once. A gate wants the search for what it did not have."""
        return self.settings.transfer is not None and self.settings.gate is None

    @property
    def ahead(self) -> int:
        """Number of batches in flight that a proposal does not wait for; weights are those of the proposal that drew."""
        return self.settings.ahead

    def stop(self, log: Log) -> str | None:
        """Return `budget` once it is used up, `cov` where the estimate is precise enough and a gate need not trust the search."""
        if took_monte_carlo(log):
            return MonteCarloStage(self.settings).stop(log)
        if log.iterations and len(log.planned) >= self.settings.budget:
            return "budget"
        precise = is_precise(log, self.settings, self.settings.stop.get("cov"))
        return "cov" if precise and not trusts_search(log, self.settings) else None

    def propose(self, log: Log) -> Batch:
        """Return the next batch; on one thread, so that the machine does not decide the last digit."""
        with threadpool_limits(1):
            if took_monte_carlo(log) and not self._tells_now(log):
                return MonteCarloStage(self.settings).propose(log)
            s, left = self.settings, self.settings.budget - len(log.planned)
            again = repeats_wanted(log.planned, s.scenario, left - 1)
            size = min(s.batch, max(s.budget // _BATCHES, _BATCH), left)
            batch = self._proposed(log, max(size - len(again), 1))
            return replace(batch, runs=(*batch.runs, *again))

    def _tells_now(self, log: Log) -> bool:
        """Return whether the draws that count have met the first values to follow: a slope, a cap.

        Those of critical runs among runs that are not do not tell, and whether there were some decides nothing: draws that are
        left out because they had met none would leave too many with those that had. Later there is no way back.
        """
        history = log.history
        drawn = history.stage == NOMINAL
        begun = int(history.iteration[drawn].min()) if drawn.any() else log.iteration
        if len(log.planned) > _RETURN * self.settings.budget or not drawn[history.iteration > begun].all():
            return False
        first, known = (Known.of(history.where(rows), self._coordinates, self.settings) for rows in (~drawn, drawn))
        side = bool(len(first.y)) and bool(first.critical[0])
        values = np.concatenate([first.y, known.y[known.critical == side]])
        return first.constant and bool((values != values[:1]).any())

    def _proposed(self, log: Log, size: int) -> Batch:
        s = self.settings
        if log.iteration == 0 and not self._spares_search and (s.prior_runs is None or len(s.prior_runs.training) < 2):
            return self._initial(min(s.initial, s.budget))
        known = Known.of(log.history, self._coordinates, s)
        if known.constant and s.transfer is None and len(log.planned) >= _ENOUGH * s.budget:
            return MonteCarloStage(s).propose(log)  # nothing tells where failures are: to know their share, draws must count
        log_probability = known.learn(stream(s.seed, "fit", log.iteration))
        if log_probability is not None and any(rule(log, log_probability) for rule in (self._noise_decides, self._gains_nothing)):
            return MonteCarloStage(s).propose(log)
        modes = self._modes_while_searching(log, known, log_probability)
        if modes is not None:
            rows = self._search_modes(known, log, size)
            return Batch(self._runs(rows, SEARCHED), EstimationProposal(EXPLORE, "explore", modes=modes))
        return self._drawn(log, known, log_probability, size)

    def _noise_decides(self, log: Log, log_probability: LogProbability) -> bool:
        """Return whether the simulator is so noisy that the metamodel hardly tells where critical runs are, before any count.

        Then crude Monte Carlo is as precise: no proposal gains what the runs cost that learn it.
        """
        s, noise = self.settings, simulator_noise(log.history, self.settings.scenario.requirement)
        if len(log.planned) < _LEARNED * s.budget or not noise.noisy:
            return False
        if any(batch.read(EstimationProposal).counted is not None for batch in log.iterations):
            return False
        z = self._nominal("noise", log.iteration)
        pi = np.exp(log_probability(z)[0])
        hits = float(pi.mean()) * (s.budget - len(log.planned))
        known, gain = hits >= _MANY_HITS or len(log.planned) >= _ENOUGH * s.budget, _gain(pi)
        met = int(s.scenario.requirement.critical_runs(log.history).sum())
        before = [(1.0 - pool.probability) / pool.probability / relative_error_of(pool) ** 2 for _, pool in pools_of(log)
                  if 0.0 < pool.probability < 1.0 and pool.anticipated > 0.0]  # fmt: skip
        mean = math.sqrt(gain * before[-1]) if before else gain
        if not (known and ((hits >= 1.0 and mean < _GAIN) or (met >= _MET and gain < _NO_GAIN))):
            return False
        chi2 = 2.0 * float(gammaincinv(0.5 * noise.repeats, _UNLIKELY))
        most = noise.repeats / (SURE_NOISE * chi2)
        return _gain(np.exp(settled(log_probability, most)(z)[0])) < _GAIN

    def _gains_nothing(self, log: Log, log_probability: LogProbability) -> bool:
        """Return whether this metamodel and that of the batch before tell less than nothing of where critical runs are.

        Short waves look so, and what no input explains: draws by such a metamodel are less precise than crude Monte Carlo.
        """
        s = self.settings
        few = len(log.planned) < max(_TOLD * s.budget, _TOLD_RUNS) or s.transfer is not None or s.prior_runs is not None
        if few or any(batch.read(EstimationProposal).counted is not None for batch in log.iterations):
            return False
        z = self._nominal("noise", log.iteration)
        pi = np.exp(log_probability(z)[0])
        if _gain(pi) >= 1.0 or float(pi.mean()) > _MET_ANYWAY:
            return False
        before = Known.of(log.history.where(log.history.iteration < log.iteration - 1), self._coordinates, s)
        earlier = before.learn(stream(s.seed, "fit", log.iteration - 1))
        return not before.one_sided and earlier is not None and _gain(np.exp(earlier(z)[0])) < 1.0

    def _initial(self, n: int) -> Batch:
        """Return an even design over the wide distribution."""
        sobol = SobolSequence(self.settings.scenario.space.dimension, self.settings.seed)
        z = self._scores(sobol.points(0, n))
        return Batch(self._runs(self._feasible(z, 0), "initial"), EstimationProposal("initial", "sobol"))

    def _feasible(self, z: Points, iteration: int) -> Points:
        """Return the points with those outside of the constraints replaced by draws of the inputs' distribution."""
        space = self.settings.scenario.space
        bad = ~space.feasible(space.from_normal(z))
        if bad.any():
            z = z.copy()
            z[bad] = space.to_normal(space.sample(int(bad.sum()), stream(self.settings.seed, "feasible", iteration)))
        return z

    def _runs(self, z: Points, stage: str) -> tuple[PlannedRun, ...]:
        return planned(self.settings.scenario.space, z, stage)

    def _modes_while_searching(self, log: Log, known: Known, log_probability: LogProbability | None) -> int | None:
        """Return the number of modes known so far while phase 0 goes on, None once it is over.

        It ends with a quarter of the budget, after three batches without a new mode, and where failures are common and the
        simulator is noisy, or the budget small: draws from the inputs' distribution meet what counts, as precisely as that lets
        it be known. Elsewhere they are too few: soon the metamodel is so precise that a region of a tenth of P decides the error.
        """
        if self._spares_search and not known.one_sided:
            return None
        proposals = [batch.read(EstimationProposal) for batch in log.iterations]
        if len(log.planned) >= _SEARCH_BUDGET * self.settings.budget or any(p.phase in (LEARN, COUNT) for p in proposals):
            return None
        modes = [p.modes or 0 for p in proposals if p.phase == EXPLORE] + [known.modes(log_probability)]
        if modes[-1] > 0 and len(modes) > _QUIET and modes[-1] <= modes[-1 - _QUIET]:
            return None
        spares = modes[-1] > 0 and (self.settings.budget < _SMALL or self._blurred(log))
        return None if spares and self._common(log_probability, log.iteration) else modes[-1]

    def _blurred(self, log: Log) -> bool:
        """Return whether noise, beside how the metric differs over the space, hides what is precise."""
        requirement = self.settings.scenario.requirement
        noise, y = simulator_noise(log.history, requirement).std or 0.0, requirement.told(log.history)
        y = y[np.isfinite(y)]
        return bool(len(y)) and noise > _BLUR * float(np.median(np.abs(y - np.median(y))))

    def _common(self, log_probability: LogProbability | None, iteration: int) -> bool:
        """Return whether the metamodel takes more than 1 in 50 draws from the inputs' distribution to be critical."""
        z = self._nominal("common", iteration)
        return log_probability is not None and float(np.exp(sketch_of(log_probability, SKETCH)(z)[0]).mean()) > _COMMON

    def _nominal(self, purpose: str, iteration: int) -> Points:
        """Return the scores of draws from the inputs' distribution; with constraints always the same, as they are dear."""
        if self.settings.scenario.space.constraints:
            return self._admissible
        return stream(self.settings.seed, purpose, iteration).standard_normal((_EXPECTED, len(self._wide)))

    def _search_modes(self, known: Known, log: Log, n: int) -> Points:
        """Return n search picks (n, d): the falsification portfolio in the cube of the wide distribution, some spread evenly."""
        s, space, rng = self.settings, self.settings.scenario.space, stream(self.settings.seed, "hunt", log.iteration)
        even = round(_EVEN_SHARE * n)
        spread = rng.random((even, space.dimension))

        def within(v: Points) -> Mask:
            z = self._scores(v)
            return space.feasible(space.from_normal(z)) & within_reach(z)

        if n > even:
            search = Search(
                s.scenario.requirement.critical, metamodel_of(s), lambda v: self._coordinates(self._scores(v)),
                within, cube=Cube(nominal=space.cube.nominal), most_rows=_SEARCHED,
            )  # fmt: skip
            z, y, batch = known.attempts()
            pending = None if log.pending is None else to_cube(space.to_normal(log.pending.x), self._wide, self._choices)
            at = to_cube(z, self._wide, self._choices)
            picks = portfolio.propose(search, at, y, n - even, rng, batch, pending=pending)
            spread = np.vstack([picks.u, spread])
        return self._feasible(self._scores(spread), log.iteration)

    def _scores(self, v: Points) -> Points:
        """Return normal scores of points of the cube in which the wide distribution is uniform."""
        return from_cube(v, self._wide, self._choices)

    def _drawn(self, log: Log, known: Known, log_probability: LogProbability | None, size: int) -> Batch:
        """Return draws from a fresh pool, and search picks."""
        s, rng = self.settings, stream(self.settings.seed, "draw", log.iteration)
        one_sided = known.one_sided
        shares: tuple[float, ...] = _BLIND if one_sided else SHARES if s.transfer is None else _TRANSFERRED
        proposal = self._proposal(log_probability, known, shares, rng)
        fallback = self._fallback(log, known, relative_error(proposal.pilot.anticipated, proposal.pilot.predicted))
        if fallback is not None:
            proposal = self._proposal(fallback, known, shares, rng)
        counts, unseen = count_begins(log, s, size, 1.0 - _SEARCH_SHARE[True]), only_unseen(log, s)
        if unseen:
            left = s.budget - len(log.planned)
            counts, shares, size = False, _NOMINAL, min(_AT_ONCE * size, left - min(s.batch, left) + size)
        elif counts and not one_sided and s.transfer is None:
            shares = spared(proposal.pilot, shares, draws_that_count(log, s, size, 1.0 - _SEARCH_SHARE[True]), s.stop.get("cov"))
        pool = draw_pool(s.scenario.space, self._frame, proposal, shares, rng, min(len(known.y), MOST_LEARNED), size)
        aimless = unseen or not len(known.y) or self._common(log_probability, log.iteration)
        searching = _SEARCH_BLIND if one_sided else _SEARCH_SHARE[counts]
        searched = 0 if aimless else min(round(searching * size), size - 1)
        noisy = simulator_noise(log.history, s.scenario.requirement).noisy is True
        runs, kept = draw_batch(
            s.scenario.space, pool, size - searched, rng, counts=counts, once=not noisy, fallback=fallback is not None,
            phase=EXPLORE if one_sided else LEARN,
            existing=None if unseen else np.vstack([known.z, s.scenario.space.to_normal(log.planned.x)]),
        )  # fmt: skip
        return Batch((*runs, *self._runs(self._search_modes(known, log, searched), SEARCHED)), kept)

    def _proposal(
        self, log_probability: LogProbability | None, known: Known, shares: tuple[float, ...], rng: np.random.Generator
    ) -> Proposal:
        """Return what a pool is drawn with, by this metamodel."""
        hits = known.starts if len(known.starts) else None
        return fit_proposal(self.settings.scenario.space, self._frame, log_probability, hits, shares, rng)

    def _fallback(self, log: Log, known: Known, error: float) -> LogProbability | None:
        """Return an earlier metamodel to draw with, where the newest one has lost its precision for no reason.

        It is used where no run since then denies that metamodel: critical, or not, where it was sure of the other, or with a
        metric that it did not expect. The estimate is unbiased with any metamodel that knows only earlier runs.
        """
        iteration = steadier(log, error)
        if iteration is None:
            return None
        before = Known.of(log.history.where(log.history.iteration < iteration), self._coordinates, self.settings)
        log_probability = before.learn(stream(self.settings.seed, "fit", iteration))
        since = known.batch >= iteration
        if log_probability is None or not since.any():
            return None
        p = np.exp(log_probability(known.z[since])[0])
        if (np.where(known.critical[since], p, 1.0 - p) < _SURPRISE).any():
            return None
        off = before.off(known.u[since], known.y[since], stream(self.settings.seed, "deny", iteration))
        return None if (off > _OFF).any() else log_probability


def _gain(pi: Vector) -> float:
    """Return the variance of crude Monte Carlo over that of the best draws with P(critical) pi (n,) at random inputs."""
    p, spread = float(pi.mean()), float(np.sqrt(pi * (1.0 - pi)).mean())
    return p * (1.0 - p) * SHARES[0] / spread**2 if spread > 1e-100 else math.inf

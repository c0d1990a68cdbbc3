"""Falsification: find critical concrete scenarios, distinct ones, and say what was not found."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.distance import cdist

from sbt.acquisitions import even, is_greedy, log_scores
from sbt.campaigns.beside import links_of, with_links
from sbt.campaigns.combinations import ALL_RUN, all_run, few, without_repetition
from sbt.campaigns.confirming import ConfirmStage
from sbt.campaigns.failures import FILLING, FailureSearch, FalsificationConclusion, search_runs
from sbt.campaigns.levels import coarse_runs, screening_told
from sbt.campaigns.likeness import TRANSFERRED, earlier_told
from sbt.campaigns.parts import held_out_runs, named_inputs
from sbt.campaigns.records import SearchProposal
from sbt.campaigns.repeats import REPEAT, repeats_wanted
from sbt.campaigns.screening import ScreenStage
from sbt.campaigns.settings import CampaignKind, Settings
from sbt.campaigns.unscored import UNSCORED, are_unscored
from sbt.errors import InputError
from sbt.loop.learner import FittedMetamodel
from sbt.loop.stages import Batch, Campaign, Log, Stage
from sbt.problem.arrays import Points, Vector
from sbt.problem.covariates import Covariates
from sbt.samplers import evolution, portfolio
from sbt.samplers.criteria import CRITERIA, propose_by
from sbt.samplers.greedy import influence_on_mean, propose_greedily
from sbt.samplers.pairs import propose_pairs
from sbt.samplers.roi import rejection
from sbt.samplers.room import fill_uniformly
from sbt.samplers.search import Picks
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream
from sbt.store.database import PlannedRun
from sbt.store.history import History

__all__ = ["FALSIFICATION", "METHODS", "recipe"]

METHODS = ("portfolio", *CRITERIA, "cma_es")
"""Ways to choose a batch, as in `acquisition.kind`; any acquisition function is one more."""

_INITIAL, _SEARCH, _EVEN = "initial", "search", "even"
_FILL_SHARE = 0.1  # of every batch that fills space, held-out runs included: what it finds is independent of the metamodel
_SCREENED = "screened"
"""Criterion of the runs that coarse runs chose."""
PAIR = "pair"
"""Criterion of the runs whose inputs and seed were chosen together."""


def recipe(settings: Settings) -> Campaign:
    """Return the campaign: an even start, batches from the chosen method, confirmation of the failure modes.

    Raises:
        InputError: no metamodel, or a library that the method needs is not installed.
    """
    learner = settings.learner
    if learner is None:
        raise InputError("campaign falsification needs a metamodel, but got none")
    if settings.method == "cma_es":
        evolution.require()
    failures = FailureSearch(settings)

    def conclude(log: Log) -> tuple[FalsificationConclusion, FittedMetamodel | None]:
        fitted = learner.telling(log.history).fit(log.history)
        found = failures.conclusion(log, None if fitted is None else fitted.record)
        return replace(found, fidelity=screening_told(log, settings), earlier=earlier_told(log, settings, learned=False)), fitted

    search: Stage = SearchStage(failures)
    if settings.coarse_cost is not None:
        if settings.method != "portfolio" or settings.scenario.pool is not None:
            got = "recorded rows" if settings.scenario.pool is not None else f"acquisition.kind {settings.method or 'of its own'}"
            raise InputError(f"fidelity goes with acquisition.kind portfolio and a scenario that can be run, but got {got}")
        search = ScreenStage(SearchStage(failures))
    return Campaign((search, ConfirmStage(failures, search)), conclude)


@dataclass(frozen=True)
class SearchStage:
    """Batches towards the next distinct failure; the first one is evenly distributed."""

    failure_search: FailureSearch
    name: str = _SEARCH

    @property
    def ahead(self) -> int:
        """Number of batches in flight that a proposal does not wait for; none for methods whose picks would be the same again."""
        s = self.failure_search.settings
        return s.ahead if s.method == "portfolio" or s.acquisition is not None else 0

    def stop(self, log: Log) -> str | None:
        """Return `failures` or `modes` once so many are found, as the conclusion tells them, `budget` once it is used up."""
        s, found, known = self.failure_search.settings, self.failure_search, with_links(log)
        failures, modes = s.stop.get("failures"), s.stop.get("modes")
        if failures is not None and found.critical_inputs(search_runs(log.history)) >= failures:
            return "failures"
        many = modes is not None and int((found.margin(known) <= 0).sum()) >= modes
        if modes is not None and many and len(found.modes(known, links=links_of(log))) >= modes:
            return "modes"
        asked = search_runs(log.planned)
        if log.iterations and s.budget - self.spent(log) < 1.0:
            return "budget"
        if s.scenario.pool is not None and len(asked) >= len(s.scenario.pool.x):
            return "no rows left"
        return ALL_RUN if log.iterations and all_run(s.scenario, asked) else None

    def spent(self, log: Log) -> float:
        """Return what the search has cost so far, in runs of the scenario."""
        s = self.failure_search.settings
        return max(len(search_runs(log.planned)) - s.reference, 0) + (s.coarse_cost or 0.0) * len(coarse_runs(log))

    def picked(self, log: Log, runs: History, n: int) -> list[PlannedRun]:
        """Return n runs by the configured method, as it learns from these runs."""
        picks, asked = self._guided(log, search_runs(runs), n), search_runs(log.planned)
        return [*self._seeded(picks), *self._snapped([(_SEARCH, picks.u[len(picks.seeds) :])], asked)]

    def propose(self, log: Log, screened: Callable[[int], list[PlannedRun]] | None = None) -> Batch:
        """Return the next batch, the run of largest P(critical) first; `screened` gives so many runs in place of the method."""
        s, first, runs = self.failure_search.settings, not log.iterations, search_runs(log.history)
        asked = search_runs(log.planned)
        spent, number = math.ceil(self.spent(log) - 1e-9), self._number(log)
        size = min(s.initial if first else s.batch, s.budget - spent)
        last = log.last(SearchProposal)
        start = 0 if last is None else last.next_position
        if first:
            known = self._known_elsewhere(size // 2)
            filled, at = self._even(size - len(known), start)
            chosen = self._snapped([(TRANSFERRED, known), (_INITIAL, filled)], runs)
            return Batch((*chosen, *held_out_runs(s, 0, s.reference)), SearchProposal("even", at))
        none = s.scenario.pool is not None or few(s.scenario, asked, s.budget)
        held_out = 0 if none else min(_share_of(s.holdout_fraction, spent, size), size - 1)
        filling = min(_share_of(max(_FILL_SHARE - s.holdout_fraction, 0.0), spent, size), size - 1 - held_out)
        again = repeats_wanted(asked, s.scenario, size - held_out - filling) if self._learns else ()
        n = size - held_out - filling - len(again)
        picks = self._guided(log, runs, n if screened is None else 0)
        found = [] if screened is None else screened(n)
        names, counts = np.unique(np.array(picks.why, dtype=np.str_), return_counts=True)
        criteria = {str(name): int(count) for name, count in zip(names, counts, strict=True)}
        criteria |= {_SCREENED: len(found)} if found else {}
        filled, at = self._even(filling, start)
        chosen = [*self._seeded(picks), *self._snapped([(_SEARCH, picks.u[len(picks.seeds) :]), (_EVEN, filled)], asked)]
        chosen, again = [*found, *chosen], (*again, *(PlannedRun(REPEAT, runs.inputs(row)) for row in picks.repeat))
        proposal = SearchProposal(s.method, at, criteria, filling, held_out, len(again) or None)
        return Batch((*chosen, *again, *held_out_runs(s, number, held_out)), proposal)

    @property
    def _learns(self) -> bool:
        """Whether a metamodel chooses: generations of CMA-ES are of one size, an even design asks for no results."""
        s = self.failure_search.settings
        return s.method != "cma_es" and s.acquisition is not even

    def _number(self, log: Log) -> int:
        """Return the number of the next batch of the search; confirmations in between do not count."""
        return sum(batch.stage == self.name for batch in log.iterations)

    def _known_elsewhere(self, n: int) -> Points:
        """Return up to n critical runs (k, d) of an earlier campaign of another setup, each far from those before it."""
        s = self.failure_search.settings
        space = s.scenario.space
        if s.transfer is None or n == 0:
            return np.empty((0, space.dimension))
        u = np.clip(space.to_unit(space.from_normal(s.transfer.hits)), 0.0, 1.0)
        u = u[self.failure_search.search.feasible(u)]  # rounding may cross the edge of a constraint
        if not len(u):
            return u
        chosen, distance = [0], cdist(u, u[:1])[:, 0]
        while len(chosen) < n and distance.max() > 0.0:
            chosen.append(int(distance.argmax()))
            distance = np.minimum(distance, cdist(u, u[chosen[-1:]])[:, 0])
        return u[chosen]

    def _even(self, n: int, start: int) -> tuple[Points, int]:
        """Return the next n points of the campaign's Sobol sequence, and the position after them."""
        s = self.failure_search.settings
        space = s.scenario.space
        sobol = SobolSequence(space.dimension, s.seed)
        feasible = self.failure_search.search.feasible
        draw = rejection(lambda u: np.zeros(len(u)), sobol, n, start=start, seed=s.seed, label="even", accept_filter=feasible)
        return draw.u, draw.next_position

    def _guided(self, log: Log, runs: History, n: int) -> Picks:
        """Return n points by the configured method; none by a criterion of its own where an acquisition function chooses."""
        s, search = self.failure_search.settings, self.failure_search.search
        space, requirement = s.scenario.space, s.scenario.requirement
        u, y = np.clip(space.to_unit(runs.x), 0.0, 1.0), requirement.values(runs)
        rng = stream(s.seed, "search", self._number(log))
        if n == 0:
            return Picks(np.empty((0, space.dimension)), ())
        if s.acquisition is not None:
            return self._scored(log, n)
        if s.method == "cma_es":
            return self._evolved(runs, u, n)
        if s.method == "portfolio" and s.covariates is not None and len(runs.training) > 1:
            return self._pairs(s.covariates, runs, u, y, n, rng)
        if s.method == "portfolio":
            filling = np.isin(runs.stage, FILLING)
            pending = None if log.pending is None else np.clip(space.to_unit(log.pending.x), 0.0, 1.0)
            repeats = s.scenario.pool is None
            return portfolio.propose(
                search, u, y, n, rng, runs.iteration, filling, repeats=repeats, pending=pending, around_floors=True
            )
        return propose_by(s.method, search, u, y, n, rng, runs.iteration)

    def _pairs(self, covariates: Covariates, runs: History, u: Points, y: Vector, n: int, rng: np.random.Generator) -> Picks:
        """Return n points with the seeds whose traffic promises most there."""
        found = propose_pairs(self.failure_search.search, covariates.of_points, u, runs.seed, y, n, rng)
        return Picks(found.u, (PAIR,) * len(found.u), seeds=found.seeds)

    def _seeded(self, picks: Picks) -> list[PlannedRun]:
        """Return the runs whose seed was chosen, too."""
        scenario = self.failure_search.settings.scenario
        rows = scenario.space.from_unit(picks.u[: len(picks.seeds)])
        return [PlannedRun(_SEARCH, named_inputs(scenario, x), seed=seed) for x, seed in zip(rows, picks.seeds, strict=True)]

    def _evolved(self, runs: History, u: Points, n: int) -> Picks:
        """Return the next generation of CMA-ES, which starts at the best run of the even start."""
        s, margin = self.failure_search.settings, self.failure_search.margin(runs)
        begin = np.where(np.isfinite(margin) & (runs.iteration == 0), margin, np.inf)
        generations = [
            margin[(runs.iteration == k) & (runs.stage == _SEARCH)] for k in np.unique(runs.iteration[runs.stage == _SEARCH])
        ]
        feasible = self.failure_search.search.feasible
        return evolution.propose(u[int(np.argmin(begin))], generations, n, s.seed, s.scenario.space.cube, feasible)

    def _scored(self, log: Log, n: int) -> Picks:
        """Return n points by an acquisition function: drawn in proportion to exp(score), or greedily."""
        s = self.failure_search.settings
        if s.learner is None or s.acquisition is None:
            raise InputError("an acquisition function needs a metamodel, but got none")
        space, score = s.scenario.space, s.acquisition
        fitted = s.learner.fit(log.history)

        def scored(u: Points) -> Vector:
            if fitted is None:
                return np.zeros(len(u))
            log_density = space.log_density_in_cube(u)
            found = log_scores(score, fitted.predict(u), s.scenario.requirement.critical, log_density)
            return found if fitted.log_success is None else found + fitted.log_success(u)  # a run that fails shows nothing

        feasible = self.failure_search.search.feasible
        if fitted is not None and is_greedy(score):
            u = self._greedily(scored, fitted, log, n)
        else:
            sobol = SobolSequence(space.dimension, s.seed + 1)  # not the one that fills space
            start = 2**20 * log.iteration
            u = rejection(scored, sobol, n, start=start, seed=s.seed, label=log.iteration, accept_filter=feasible).u
        return Picks(u, (UNSCORED,) * n if are_unscored(scored, u) else ())

    def _greedily(self, score: Callable[[Points], Vector], fitted: FittedMetamodel, log: Log, n: int) -> Points:
        """Return the n points of the highest scores that are far from each other and from earlier runs."""
        s, feasible = self.failure_search.settings, self.failure_search.search.feasible
        space = s.scenario.space
        rng, existing = stream(s.seed, "greedy", log.iteration), np.clip(space.to_unit(log.planned.x), 0.0, 1.0)
        scale = influence_on_mean(fitted.predict, space.dimension, rng)

        def snap(v: Points) -> Points:  # integers are what will be run
            return np.clip(space.to_unit(space.from_unit(v)), 0.0, 1.0)

        u, _ = propose_greedily(score, existing, n, scale, rng, snap=snap, admissible=feasible, cube=space.cube)
        return np.concatenate([u, fill_uniformly(feasible, n - len(u), space.dimension, rng)])

    def _without_repetition(self, rows: list[tuple[str, Vector]], runs: History) -> list[PlannedRun]:
        """Return the runs of points, each by its stage; of few combinations, each but once."""
        scenario = self.failure_search.settings.scenario
        x = scenario.space.from_unit(np.array([u for _, u in rows]).reshape(-1, scenario.space.dimension))
        x = without_repetition(scenario, runs, x, continuous=self._learns)
        return [PlannedRun(stage, named_inputs(scenario, row)) for (stage, _), row in zip(rows, x, strict=False)]

    def _snapped(self, parts: list[tuple[str, Points]], runs: History) -> list[PlannedRun]:
        """Return the runs of each part by its stage; where rows are recorded, the nearest one not taken yet."""
        scenario = self.failure_search.settings.scenario
        rows = [(stage, point) for stage, points in parts for point in points]
        if scenario.pool is None:
            return self._without_repetition(rows, runs)
        left = np.flatnonzero(~scenario.pool.taken(runs.x))
        at = scenario.space.cube.embedded
        recorded = at(np.clip(scenario.space.to_unit(scenario.pool.x), 0.0, 1.0))
        planned = []
        for stage, u in rows[: len(left)]:
            row = int(cdist(at(u[None]), recorded[left])[0].argmin())
            planned.append(PlannedRun(stage, named_inputs(scenario, scenario.pool.x[left[row]])))
            left = np.delete(left, row)
        return planned


def _share_of(share: float, spent: int, size: int) -> int:
    """Return how many of the next `size` runs after `spent` make up a share of all."""
    return math.floor(share * (spent + size) + 1e-9) - math.floor(share * spent + 1e-9)


FALSIFICATION = CampaignKind(
    "find critical concrete scenarios, and distinct failure modes", recipe, FalsificationConclusion, acquisition="portfolio",
    methods=METHODS, stop={"failures": None, "modes": None}, most_initial=10, batch=10, takes_transfer=True, takes_fidelity=True,
    metamodel={"kind": "gp", "nu": 2.5, "input_noise": False, "kernels": 1},
)  # fmt: skip

"""Falsification: find critical concrete scenarios, distinct ones, and say what was not found."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.distance import cdist

from sbt.acquisitions import is_greedy, log_scores
from sbt.campaigns.boundary import validation_of
from sbt.campaigns.modes import Mode, described, modes_of
from sbt.campaigns.parts import Settings, clopper_pearson, fit_of, held_out_runs, named_inputs
from sbt.errors import InputError
from sbt.loop.learner import FittedMetamodel
from sbt.loop.stages import Batch, Campaign, Fit, Log
from sbt.problem.arrays import Points, Vector
from sbt.samplers import evolution, portfolio
from sbt.samplers.criteria import CRITERIA, propose_by
from sbt.samplers.greedy import influence_on_mean, propose_greedily
from sbt.samplers.roi import rejection
from sbt.samplers.search import Picks, Search, fill_uniformly, fit_warped
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream
from sbt.store.database import PlannedRun
from sbt.store.history import VALIDATION, History

__all__ = ["CONFIRM", "METHODS", "recipe"]

METHODS = ("portfolio", *CRITERIA, "cma_es")
"""Ways to choose a batch, as in `acquisition.kind`; any acquisition function is one more."""
CONFIRM = "confirm"
"""Stage of the runs that repeat a failure mode's representative with fresh seeds; they come beside the budget."""

_INITIAL, _SEARCH, _EVEN = "initial", "search", "even"
_FILLING = (_INITIAL, _EVEN, VALIDATION)
_FILL_SHARE = 0.1  # of every batch that fills space, held-out runs included
_REPEATS = 3  # confirmation runs of a mode
_MOST_CONFIRMED = 10  # modes, the deepest first
_POSITION = "next_position"


def recipe(settings: Settings) -> Campaign:
    """Return the campaign: an even start, batches from the chosen method, confirmation of the failure modes.

    The conclusion holds `first_critical_run` (counted from 1; None where none was found),
    `critical_runs` (confirmation runs aside), `failure_modes` (deepest first), `bound` (only where
    nothing critical was found: what the space-filling runs say about the critical share of the box),
    `closest` (the uncritical run nearest to M_c, where nothing was found), `statement` and `validation`.

    Raises:
        InputError: no metamodel, or a library that the method needs is not installed.
    """
    if settings.learner is None:
        raise InputError("campaign falsification needs a metamodel, but got none")
    if settings.method == "cma_es":
        evolution.require()
    failures = FailureSearch(settings)

    def conclude(log: Log) -> tuple[dict[str, Any], Fit | None]:
        belief = settings.learner.fit(log.history) if settings.learner is not None else None
        conclusion = failures.conclusion(log.history)
        conclusion["validation"] = None if belief is None else validation_of(belief.scores)
        return conclusion, fit_of(belief)

    return Campaign((SearchStage(failures), ConfirmStage(failures)), conclude)


@dataclass(frozen=True)
class FailureSearch:
    """A search for failures as functions of its runs, shared by both stages and the conclusion.

    Args:
        settings: of the campaign.
        found: failure modes by the indices of the runs they were found in; stages ask again and again, and rows
            that are finished never change.
    """

    settings: Settings
    found: dict[tuple[int, ...], list[Mode]] = field(default_factory=dict, repr=False, compare=False)

    @cached_property
    def search(self) -> Search:
        """What is searched, with the campaign's metamodel."""
        scenario, learner = self.settings.scenario, self.settings.learner
        if learner is None:
            raise InputError("campaign falsification needs a metamodel, but got none")
        space = scenario.space
        return Search(
            scenario.requirement.critical, learner.metamodel, space.metamodel_inputs, lambda u: space.feasible(space.from_unit(u))
        )

    def margin(self, history: History) -> Vector:
        """Return (n,) distance to M_c in the metric's unit, NaN where a run failed."""
        requirement = self.settings.scenario.requirement
        return np.asarray(requirement.critical.margin(history.y(requirement.metric)))

    def modes(self, history: History) -> list[Mode]:
        """Return the failure modes among these runs."""
        runs = tuple(record.index for record in history.records)
        if runs not in self.found:
            self.found.clear()  # only the last answer is asked for again
            self.found[runs] = self._modes(history)
        return self.found[runs]

    def _modes(self, history: History) -> list[Mode]:
        scenario = self.settings.scenario
        ok = np.flatnonzero(history.ok)
        if not (self.margin(history) <= 0).any():
            return []
        if len(ok) < 2:
            only = int(ok[0])
            return [Mode((only,), only, only, None)]
        u, y = scenario.space.to_unit(history.x[ok]), history.y(scenario.requirement.metric)[ok]
        belief = fit_warped(self.search, u, y, stream(self.settings.seed, "modes", len(history)))
        return modes_of(belief, history, scenario)

    def conclusion(self, history: History) -> dict[str, Any]:
        """Return what was found; see `recipe`."""
        searched, metric = search_runs(history), self.settings.scenario.requirement.metric
        margin = self.margin(searched)
        hits = np.flatnonzero(margin <= 0)
        found = []
        for mode in self.modes(searched):
            again = confirmations(history, searched.records[mode.representative].inputs)
            found.append(described(mode, searched, self.settings.scenario, again.y(metric)))
        bound = None if len(hits) else _bound(searched)
        return {
            "first_critical_run": int(hits[0]) + 1 if len(hits) else None, "critical_runs": len(hits),
            "failure_modes": found, "bound": bound, "closest": None if len(hits) else _closest(searched, margin, metric),
            "statement": _statement(searched, len(hits), found, bound),
        }  # fmt: skip


def search_runs(history: History) -> History:
    """Return the runs of the search, without the confirmations."""
    return history.where(history.stage != CONFIRM)


def confirmations(history: History, inputs: Any) -> History:
    """Return the runs that repeated these inputs."""
    return history.where(np.array([r.stage == CONFIRM and r.inputs == inputs for r in history.records], dtype=bool))


@dataclass(frozen=True)
class SearchStage:
    """Batches towards the next distinct failure; the first one is evenly distributed."""

    failure_search: FailureSearch
    name: str = _SEARCH

    def stop(self, log: Log) -> str | None:
        """Return `failures` or `modes` once so many are found, `budget` once it is used up."""
        s, runs = self.failure_search.settings, search_runs(log.history)
        critical = int((self.failure_search.margin(runs) <= 0).sum())
        failures, modes = s.stop.get("failures"), s.stop.get("modes")
        if failures is not None and critical >= failures:
            return "failures"
        if modes is not None and critical >= modes and len(self.failure_search.modes(runs)) >= modes:
            return "modes"
        if log.iterations and len(runs) - s.reference >= s.budget:
            return "budget"
        if s.scenario.pool is not None and len(runs) >= len(s.scenario.pool.x):
            return "no rows left"
        return None

    def propose(self, log: Log) -> Batch:
        """Return the next batch, the run of largest P(critical) first."""
        s, first, runs = self.failure_search.settings, not log.iterations, search_runs(log.history)
        spent, number = len(runs) - (0 if first else s.reference), self._number(log)
        size = min(s.initial if first else s.batch, s.budget - spent)
        start = int(log.iterations[-1][_POSITION]) if log.iterations else 0
        if first:
            even, at = self._even(size, start)
            chosen = self._snapped([(_INITIAL, even)], runs)
            return Batch((*chosen, *held_out_runs(s, 0, s.reference)), {"method": "even", _POSITION: at})
        held_out = 0 if s.scenario.pool is not None else min(_share_of(s.share, spent, size), size - 1)
        filling = min(_share_of(max(_FILL_SHARE - s.share, 0.0), spent, size), size - 1 - held_out)
        picks, why = self._guided(log, runs, size - held_out - filling)
        even, at = self._even(filling, start)
        chosen = self._snapped([(_SEARCH, picks), (_EVEN, even)], runs)
        how = {"method": s.method, **why, "even": filling, "held_out": held_out, _POSITION: at}
        return Batch((*chosen, *held_out_runs(s, number, held_out)), how)

    def _number(self, log: Log) -> int:
        """Return the number of the next batch of the search; confirmations in between do not count."""
        return sum(batch["stage"] == self.name for batch in log.iterations)

    def _even(self, n: int, start: int) -> tuple[Points, int]:
        """Return the next n points of the campaign's Sobol sequence, and the position after them."""
        s = self.failure_search.settings
        space = s.scenario.space
        sobol = SobolSequence(space.dimension, s.seed)
        feasible = self.failure_search.search.feasible
        draw = rejection(lambda u: np.zeros(len(u)), sobol, n, start=start, seed=s.seed, label="even", accept_filter=feasible)
        return draw.u, draw.next_position

    def _guided(self, log: Log, runs: History, n: int) -> tuple[Points, dict[str, Any]]:
        """Return n points by the configured method, and what the log keeps of how."""
        s, search = self.failure_search.settings, self.failure_search.search
        space, requirement = s.scenario.space, s.scenario.requirement
        u, y = np.clip(space.to_unit(runs.x), 0.0, 1.0), runs.y(requirement.metric)
        rng = stream(s.seed, "search", self._number(log))
        if s.acquisition is not None:
            return self._scored(log, n), {}
        if s.method == "cma_es":
            picks = self._evolved(runs, u, n)
        elif s.method == "portfolio":
            picks = portfolio.propose(search, u, y, n, rng, runs.iteration)
        else:
            picks = propose_by(s.method, search, u, y, n, rng, runs.iteration)
        names, counts = np.unique(np.array(picks.why, dtype=np.str_), return_counts=True)
        return picks.u, {str(name): int(count) for name, count in zip(names, counts, strict=True)}

    def _evolved(self, runs: History, u: Points, n: int) -> Picks:
        """Return the next generation of CMA-ES, which starts at the best run of the even start."""
        s, margin = self.failure_search.settings, self.failure_search.margin(runs)
        begin = np.where(np.isfinite(margin) & (runs.iteration == 0), margin, np.inf)
        generations = [
            margin[(runs.iteration == k) & (runs.stage == _SEARCH)] for k in np.unique(runs.iteration[runs.stage == _SEARCH])
        ]
        return evolution.propose(u[int(np.argmin(begin))], generations, n, s.seed)

    def _scored(self, log: Log, n: int) -> Points:
        """Return n points by an acquisition function: drawn in proportion to exp(score), or greedily."""
        s = self.failure_search.settings
        if s.learner is None or s.acquisition is None:
            raise InputError("an acquisition function needs a metamodel, but got none")
        space, score = s.scenario.space, s.acquisition
        belief = s.learner.fit(log.history)

        def scored(u: Points) -> Vector:
            if belief is None:
                return np.zeros(len(u))
            log_density = space.log_density(space.from_unit(u))
            return log_scores(score, belief.predict(u), s.scenario.requirement.critical, log_density)

        feasible = self.failure_search.search.feasible
        if belief is not None and is_greedy(score):
            return self._greedily(scored, belief, log, n)
        sobol = SobolSequence(space.dimension, s.seed + 1)  # not the one that fills space
        start = 2**20 * log.iteration
        return rejection(scored, sobol, n, start=start, seed=s.seed, label=log.iteration, accept_filter=feasible).u

    def _greedily(self, score: Callable[[Points], Vector], fitted: FittedMetamodel, log: Log, n: int) -> Points:
        """Return the n points of the highest scores that are far from each other and from earlier runs."""
        s, feasible = self.failure_search.settings, self.failure_search.search.feasible
        space = s.scenario.space
        rng, existing = stream(s.seed, "greedy", log.iteration), np.clip(space.to_unit(log.history.x), 0.0, 1.0)
        scale = influence_on_mean(fitted.predict, space.dimension, rng)

        def snap(v: Points) -> Points:  # integers are what will be run
            return np.clip(space.to_unit(space.from_unit(v)), 0.0, 1.0)

        u, _ = propose_greedily(score, existing, n, scale, rng, snap=snap, admissible=feasible)
        return np.concatenate([u, fill_uniformly(feasible, n - len(u), space.dimension, rng)])

    def _snapped(self, parts: list[tuple[str, Points]], runs: History) -> list[PlannedRun]:
        """Return the runs of each part by its stage; where rows are recorded, the nearest one not taken yet."""
        scenario = self.failure_search.settings.scenario
        rows = [(stage, point) for stage, points in parts for point in points]
        if scenario.pool is None:
            return [PlannedRun(stage, named_inputs(scenario, scenario.space.from_unit(u[None])[0])) for stage, u in rows]
        left = np.flatnonzero(~scenario.pool.taken(runs.x))
        recorded = np.clip(scenario.space.to_unit(scenario.pool.x), 0.0, 1.0)
        planned = []
        for stage, u in rows[: len(left)]:
            at = int(cdist(u[None], recorded[left])[0].argmin())
            planned.append(PlannedRun(stage, named_inputs(scenario, scenario.pool.x[left[at]])))
            left = np.delete(left, at)
        return planned


@dataclass(frozen=True)
class ConfirmStage:
    """Repeats each mode's representative with fresh seeds: is the failure one of the scenario, or of a seed?"""

    failure_search: FailureSearch
    name: str = CONFIRM

    def _missing(self, log: Log) -> list[PlannedRun]:
        if self.failure_search.settings.scenario.pool is not None:
            return []  # a recorded row cannot be repeated
        runs, planned = search_runs(log.history), []
        for mode in self.failure_search.modes(runs)[:_MOST_CONFIRMED]:
            inputs = runs.records[mode.representative].inputs
            planned += [PlannedRun(CONFIRM, inputs)] * (_REPEATS - len(confirmations(log.history, inputs)))
        return planned

    def stop(self, log: Log) -> str | None:
        """Return why the search was over, once the ten deepest modes are repeated."""
        return None if self._missing(log) else SearchStage(self.failure_search).stop(log)

    def propose(self, log: Log) -> Batch:
        """Return three runs a mode, beside the budget."""
        last = log.iterations[-1]
        return Batch(tuple(self._missing(log)), {"method": "repeat", _POSITION: last[_POSITION]})


def _share_of(share: float, spent: int, size: int) -> int:
    """Return how many of the next `size` runs after `spent` make up a share of all."""
    return math.floor(share * (spent + size) + 1e-9) - math.floor(share * spent + 1e-9)


def _bound(runs: History) -> dict[str, Any]:
    """Return what the space-filling runs bound; the guided ones were chosen by results and bound nothing.

    A failed run may hide a critical one: `box_fraction_failed_as_critical` counts it as one.
    """
    filling = runs.where(np.isin(runs.stage, _FILLING))
    n, failed = len(filling), int((~filling.ok).sum())
    drawn = int((filling.stage == VALIDATION).sum())
    high = 1.0 - 0.05 ** (1.0 / n) if n else 1.0
    return {
        "box_fraction": high, "confidence": 0.95, "space_filling_runs": n, "random_runs": drawn,
        "box_fraction_random_runs": 1.0 - 0.05 ** (1.0 / drawn) if drawn else None, "failed_runs": failed,
        "box_fraction_failed_as_critical": high if failed == 0 else clopper_pearson(failed, n, 0.9)[1],
    }  # fmt: skip


def _closest(runs: History, margin: Vector, metric: str) -> dict[str, Any] | None:
    """Return the run that came nearest to M_c."""
    if not np.isfinite(margin).any():
        return None
    k = int(np.nanargmin(margin))
    record = runs.records[k]
    return {"run": record.index, "inputs": dict(record.inputs), "metric": record.metrics[metric], "margin": float(margin[k])}


def _statement(runs: History, hits: int, modes: list[dict[str, Any]], bound: dict[str, Any] | None) -> str:
    """Return what follows from the runs, and no more."""
    n, failed = len(runs), int((~runs.ok).sum())
    hidden = f" {failed} runs failed and say nothing about safety." if failed else ""
    if failed == n:
        return f"All {n} runs failed: nothing was tested."
    if bound is not None:
        sobol = bound["space_filling_runs"] - bound["random_runs"]
        how = f" ({sobol} of them scrambled Sobol points, for which this bound of random ones is approximate)" if sobol else ""
        share = bound["box_fraction_failed_as_critical"]
        return (
            f"No critical run in {n}. The guided runs bound nothing; from the {bound['space_filling_runs']} space-filling ones"
            f" alone{how}, at most {100 * share:.3g} % of the box is critical (95 %).{hidden}"
        )
    if hits == n - failed:
        return f"Every run that gave a metric was critical ({hits}): no boundary was met.{hidden}"
    plural = "s" if len(modes) != 1 else ""
    unsure = [m for m in modes if m["confirmed"] is not None and m["confirmed"] < 1.0]
    doubt = f" {len(unsure)} of them did not fail again with every fresh seed." if unsure else ""
    return f"{hits} of {n} runs of the search were critical, in {len(modes)} failure mode{plural}.{doubt}{hidden}"

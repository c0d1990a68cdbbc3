"""Repetitions of failure modes beside the budget: a race that orders them where runs are noisy, then those that are told."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from sbt.campaigns.beside import batches_by, confirmations, links_of, with_links
from sbt.campaigns.failures import FailureSearch
from sbt.campaigns.linking import Way
from sbt.campaigns.modes import Mode
from sbt.campaigns.parts import named_inputs
from sbt.campaigns.rates import next_repetitions
from sbt.campaigns.records import CONFIRM, LINK, RACE, SearchProposal
from sbt.loop.stages import BACK, Batch, Log, Stage
from sbt.store.database import PlannedRun
from sbt.store.history import History

__all__ = ["ROUNDS", "ConfirmStage", "shares"]

_REPEATS = 3  # confirmation runs of a mode: enough to tell a failure of the scenario from that of one seed
_MOST_REPEATS, _REPEATS_IN_ALL = 10, 30  # of a noisy simulator, whose modes have a failure rate
_MOST_CONFIRMED = 10  # modes, the first ones
_LINK_SHARE, _FEWEST_LINKS, _MOST_LINKS = 0.1, 5, 20  # of the search's runs, and runs: those between critical ones
_LINK_ROUNDS, _LINK_BATCH = 6, 4  # batches of these at most, and how many of them would ask all
_RACING = 0.3  # share of the repetitions that decide the order
ROUNDS = 3
"""Batches of repetitions that decide the order."""
_TOLD = "repeat"  # method of the batch whose repetitions are told


@dataclass(frozen=True)
class ConfirmStage:
    """Repeats each mode's representative with fresh seeds: is the failure one of the scenario, or of a seed?

    Where the simulator is noisy and there are several modes, some of the repetitions go first to candidates that may have the
    largest failure rate. They decide representatives and order, and count in no rate that is told.
    """

    failure_search: FailureSearch
    search: Stage
    name: str = CONFIRM

    def stop(self, log: Log) -> str | None:
        """Return why the search was over, once the first ten modes are repeated; `BACK` if runs between critical ones deny it."""
        over = self.search.stop(log)
        return BACK if over is None else None if self._links(log) or self._missing(log)[1] else over

    def propose(self, log: Log) -> Batch:
        """Return three runs a mode, of a noisy simulator up to ten, or a round of the race before these, beside the budget."""
        last, scenario = log.last(SearchProposal), self.failure_search.settings.scenario
        position = 0 if last is None else last.next_position
        if links := self._links(log):
            at = scenario.space.from_unit(np.array([way.at for way in links]))
            runs = tuple(PlannedRun(CONFIRM, named_inputs(scenario, row)) for row in at)
            return Batch(runs, SearchProposal(LINK, position, ends=tuple(way.ends for way in links)))
        method, planned = self._missing(log)
        return Batch(tuple(planned), SearchProposal(method, position))

    def _missing(self, log: Log) -> tuple[str, list[PlannedRun]]:
        """Return the repetitions of the next batch, and what they are for."""
        search, history = self.failure_search, log.history
        if search.settings.scenario.pool is not None:
            return _TOLD, []  # a recorded row cannot be repeated
        runs, aside, race = with_links(log), batches_by(log, RACE, LINK), batches_by(log, RACE)
        raced = np.isin(history.iteration, race)
        modes = search.modes(runs, history.where(raced), links_of(log))[:_MOST_CONFIRMED]
        wanted = [_REPEATS] * len(modes)
        if modes and search.noisy(runs):
            racing, wanted = shares(len(modes))
            left = racing - int((raced & (history.iteration > runs.iteration.max())).sum())
            if left > 0:
                rates = search.rates(runs, history.where(raced), links_of(log))
                rows = next_repetitions(rates, _distinct(runs, modes), -(-racing // ROUNDS))
                return RACE, [PlannedRun(CONFIRM, runs.inputs(row)) for row in rows[:left]]
        planned = []
        for mode, n in zip(modes, wanted, strict=True):
            done = int(confirmations(history, runs.x[mode.representative], aside).sum())
            planned += [PlannedRun(CONFIRM, runs.inputs(mode.representative))] * (n - done)
        return _TOLD, planned

    def _links(self, log: Log) -> list[Way]:
        """Return ways between critical runs on which a run tells whether they are of one mode; none after repetitions."""
        search, searched = self.failure_search, max(batch.number for batch in log.iterations if batch.stage != CONFIRM)
        scenario, runs = search.settings.scenario, with_links(log)
        rounds, repeated = ([n for n in batches_by(log, *methods) if n > searched] for methods in ((LINK,), (RACE, _TOLD)))
        if scenario.pool is not None or len(rounds) >= _LINK_ROUNDS or repeated:
            return []
        if scenario.requirement.critical_runs(runs)[runs.ok].all():  # nothing is known to be between modes
            return []
        asked = int((runs.stage == CONFIRM).sum())
        most = min(max(int(_LINK_SHARE * (len(runs) - asked)), _FEWEST_LINKS), _MOST_LINKS)
        known = {tuple(row) for row in runs.x}  # whole numbers: the way may lead through a run
        new: dict[tuple[float, ...], Way] = {}
        ways = search.ways_to_ask(log)
        for way in (way for both in itertools.zip_longest(ways.doubtful, ways.unasked) for way in both if way is not None):
            new.setdefault(tuple(scenario.space.from_unit(way.at[None])[0]), way)
        return [way for row, way in new.items() if row not in known][: min(most - asked, -(-most // _LINK_BATCH))]


def shares(modes: int) -> tuple[int, list[int]]:
    """Return how many repetitions order so many modes >= 1 of a noisy simulator, and how many each of them is told by.

    >>> shares(1), shares(3), shares(10)[1][:2]
    ((0, [10]), (9, [10, 6, 5]), [3, 3])
    """
    total = modes * min(max(_REPEATS_IN_ALL // modes, _REPEATS), _MOST_REPEATS)
    spare = total - _REPEATS * modes
    racing = min(int(_RACING * total), spare // 2) if modes > 1 else 0
    first = min(_REPEATS + spare - racing, _MOST_REPEATS)
    rest = total - racing - first
    return racing, [first, *(rest // (modes - 1) + (k < rest % (modes - 1)) for k in range(modes - 1))]


def _distinct(runs: History, modes: list[Mode]) -> list[list[int]]:
    """Return the rows of each mode, one of each inputs."""
    rows = [np.array(mode.rows) for mode in modes]
    return [mine[np.unique(runs.x[mine], axis=0, return_index=True)[1]].tolist() for mine in rows]

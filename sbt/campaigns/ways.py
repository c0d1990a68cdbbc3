"""Ways between critical runs of a campaign, on which a run would tell whether these are of one failure mode."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

import numpy as np

from sbt.campaigns.beside import Links, batches_by
from sbt.campaigns.between import RunsBetween
from sbt.campaigns.linking import (
    JoinedPart,
    LinksTold,
    Way,
    connected,
    doubtful,
    pairs_joined,
    unasked,
    ways_between,
    ways_in_noise,
)  # fmt: skip
from sbt.campaigns.modes import critical_groups
from sbt.campaigns.rates import LocalRates
from sbt.campaigns.records import CONFIRM, LINK
from sbt.loop.stages import Log
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.samplers.search import WarpedModel
from sbt.store.history import History

__all__ = ["OpenWays", "links_told", "open_ways", "runs_between"]

_SEVERAL = 3  # critical inputs of a part of a mode that is told beside its representative


@dataclass(frozen=True)
class OpenWays:
    """Ways between critical runs on which a run would tell something; their ends are indices of runs.

    Args:
        doubtful: those in doubt, the first one first.
        unasked: the shortest between modes on which no run was made; none with noise.
        dividing: how many ways in doubt are between two modes, so that these may be one.
    """

    doubtful: list[Way]
    unasked: list[Way]
    dividing: int = 0


def runs_between(fitted: WarpedModel, history: History, scenario: LogicalScenario, rates: LocalRates) -> RunsBetween:
    """Return what these runs of a noisy simulator tell of ways between the critical ones that are compared."""
    space, (chosen, kind) = scenario.space, critical_groups(history, scenario)
    counted = history.ok & history.drawn
    u, at = space.to_unit(history.x[counted]), space.cube.embedded
    return RunsBetween(
        at(u), scenario.requirement.critical_runs(history)[counted], fitted.probability(u),
        at(space.to_unit(history.x[chosen])), kind[chosen], LocalRates(rates.mean[chosen], rates.std[chosen]),
    )  # fmt: skip


def open_ways(
    fitted: WarpedModel | None, history: History, scenario: LogicalScenario, links: Links, between: RunsBetween | None
) -> OpenWays:
    """Return the ways between critical runs of a history on which a run would tell something.

    Args:
        fitted: of the metamodel; None: nothing was learned.
        history: runs of the search, and those between critical ones.
        scenario: of the campaign.
        links: those between critical ones.
        between: what runs tell of ways where the simulator is noisy; None: it is not.
    """
    if fitted is None:
        return OpenWays([], [])
    space, (chosen, kind) = scenario.space, critical_groups(history, scenario)
    runs, u, kind = history.index[chosen].tolist(), space.to_unit(history.x[chosen]), kind[chosen]

    def told(ways: list[Way]) -> list[Way]:
        feasible = [way for way in ways if space.feasible(space.from_unit(way.at[None]))[0]]
        sides = [tuple(tuple(runs[k] for k in side) for side in way.sides) for way in feasible]
        ends = [sorted(runs[k] for k in way.ends) for way in feasible]
        return [replace(way, ends=(i, j), sides=both) for way, (i, j), both in zip(feasible, ends, sides, strict=True)]

    if between is not None:
        place = {run: k for k, run in enumerate(runs)}
        made = Counter(frozenset(place[end] for end in link.ends) for link in links if set(link.ends) <= place.keys())
        ways, dividing = ways_in_noise(fitted, u, kind, between, made, space.cube)
        return OpenWays(told(ways), [], dividing)
    tested, sure = (pairs_joined(links, runs, nested=times) for times in (1, 2))
    ways = ways_between(fitted, u, kind, history.stage[chosen] == CONFIRM, tested, sure, space.cube)
    group = connected(fitted, u, kind, tested=tested, sure=sure, cube=space.cube)
    doubt = doubtful(ways)
    return OpenWays(told(doubt), unasked(told(ways), links), sum(group[way.ends[0]] != group[way.ends[1]] for way in doubt))


def links_told(log: Log, requirement: Requirement, ways: OpenWays, representatives: Collection[int] = ()) -> LinksTold | None:
    """Return what runs between critical ones told; None where there was none, and no way is in doubt on which count rests.

    Args:
        log: of the campaign.
        requirement: of its scenario.
        ways: what remains open.
        representatives: runs that stand for the modes.
    """
    asked = log.history.where(np.isin(log.history.iteration, batches_by(log, LINK)))
    joining = {way.ends: way.sides for way in ways.doubtful if way.sides}
    if not len(asked) and not ways.dividing and not joining:
        return None
    critical, open_ = int(requirement.critical_runs(asked).sum()), ways.unasked
    left = len({way.ends for way in ways.doubtful}) + sum(way.excluded for way in open_)
    return LinksTold(
        len(asked), critical, left, int((~asked.ok).sum()) or None, len(open_) or None, ways.dividing or None,
        len(joining) or None, _parts(joining.values(), representatives, log.history.where(log.history.stage != CONFIRM)) or None,
    )  # fmt: skip


def _parts(
    joined: Iterable[tuple[tuple[int, ...], ...]], representatives: Collection[int], searched: History
) -> tuple[JoinedPart, ...]:  # fmt: skip
    """Return what ways in doubt join, of several inputs of the search each, that no representative stands for."""
    found, row = list[JoinedPart](), {run: k for k, run in enumerate(searched.index.tolist())}
    for part in dict.fromkeys(part for sides in joined for part in sides):
        runs = [run for run in part if run in row]
        inputs = len(np.unique(searched.x[[row[run] for run in runs]], axis=0)) if runs else 0
        if inputs >= _SEVERAL and set(part).isdisjoint(representatives):
            found.append(JoinedPart(runs[0], inputs))
    return tuple(sorted(found, key=lambda part: -part.inputs))

"""A scenario at two levels of fidelity: what coarse runs cost, and how they go with those of the scenario, on a few pairs."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sbt.campaigns.levels import rank_correlation
from sbt.config.model import Configuration
from sbt.errors import InputError
from sbt.execution.spec import ScenarioSpec
from sbt.execution.tasks import elsewhere
from sbt.execution.worker import run_job
from sbt.problem.outcome import Job, Outcome, Status
from sbt.problem.plain import Values
from sbt.problem.scenario import LogicalScenario, Pool
from sbt.seeds import run_seed, stream
from sbt.workflows.findings import Finding

__all__ = ["COARSE_COST", "fidelity_findings", "stated_cost"]

COARSE_COST = "coarse_cost"
"""Key under which a store remembers what a coarse run costs, in runs."""

_PAIRS, _PAIRS_CHECKED = 12, 30
"""Pairs of inputs and seed, drawn from their distribution, of which the cost is measured, and which `check` compares."""
_FEW_FAILED = 0.2
"""Share of the pairs of which the coarse run alone may fail: beyond, its step or model is none of the scenario's."""
_COSTS = (0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 0.95)
"""Costs that are told apart, so that measuring again mostly gives the same plan."""
_DEADLINE = 900.0
"""Longest wait for the process that runs the pairs (s)."""


@dataclass(frozen=True)
class _Pair:
    """One pair of inputs and seed at both levels: its outcomes, and CPU seconds."""

    outcomes: tuple[Outcome, Outcome]
    seconds: tuple[float, float]

    @property
    def ok(self) -> tuple[bool, bool]:
        fine, coarse = (outcome.status is Status.OK for outcome in self.outcomes)
        return fine, coarse


def stated_cost(config: Configuration, spec: ScenarioSpec, scenario: LogicalScenario) -> float | None:
    """Return what a coarse run costs, in runs of the scenario: as configured, or the nearest of a few costs to the measured one.

    A few pairs are run at both levels in any case. None: there are no coarse runs.

    Args:
        config: of the campaign.
        spec: the scenario with its coarse level.
        scenario: as configured.

    Raises:
        InputError: coarse runs fail where those of the scenario do not.
    """
    if config.fidelity is None:
        return None
    jobs, apart = _jobs(scenario, config.seed, _PAIRS), config.executor.kind != "serial"
    pairs = elsewhere(_DEADLINE, _run_pairs, spec, jobs) if apart else _run_pairs(spec, jobs)
    if problem := _problem(pairs):
        raise InputError(f"fidelity needs coarse runs that the model takes, but {problem}")
    return _cost(pairs) if config.fidelity.cost == "auto" else config.fidelity.cost


def fidelity_findings(spec: ScenarioSpec, scenario: LogicalScenario, seed: int) -> Iterator[Finding]:
    """Yield whether the coarse level can be run, what it costs and how its metric goes with that of the scenario.

    Args:
        spec: the scenario, as workers get it; nothing is said of one without a coarse level.
        scenario: as configured.
        seed: of the pairs.
    """
    if spec.coarse is None:
        return
    pairs = _run_pairs(spec, _jobs(scenario, seed, _PAIRS_CHECKED))
    problem = _problem(pairs)
    yield Finding("coarse runs of the same inputs and seeds", not problem, problem or f"{len(pairs)} pairs run at both levels")
    both = [pair for pair in pairs if all(pair.ok)]
    if len(both) < 3:
        return
    names = [name for name in scenario.measured if all(name in pair.outcomes[1].metrics for pair in both)]
    values = [{name: np.array([p.outcomes[k].metrics[name] for p in both]) for name in names} for k in (0, 1)]
    fine, coarse = (scenario.requirement.margins(Pool(np.empty((len(both), 0)), each)) for each in values)
    correlation = rank_correlation(fine, coarse)
    same = int(((fine <= 0.0) == (coarse <= 0.0)).sum())
    said, alike = "the metric is the same in all of them", {}
    if correlation is not None:
        said, alike = f"ranks of the metric correlate by {correlation:.2f}", {"correlation": correlation}
    cost = f"a coarse run costs {_cost(pairs):.2f} of a run (CPU time, {len(pairs)} pairs)"
    numbers = {"cost": _cost(pairs), "pairs": len(both), "same_verdict": same} | alike
    detail = f"{cost}; {said}; {same} of {len(both)} have one verdict"
    yield Finding("for information: fidelity", ok=True, detail=detail, numbers=numbers)


def _jobs(scenario: LogicalScenario, seed: int, n: int) -> list[tuple[Values, int]]:
    """Return pairs of inputs, drawn from their distribution, and seed."""
    drawn = scenario.space.sample(n, stream(seed, "fidelity"))
    return [(scenario.space.named(x), run_seed(seed, k)) for k, x in enumerate(drawn)]


def _run_pairs(spec: ScenarioSpec, jobs: list[tuple[Values, int]]) -> list[_Pair]:
    """Return every pair at both levels, which take turns; the first is run once more before, to load what is slow to load."""
    levels = tuple(level.resolve() for level in spec.levels)
    found = []
    for k, (values, seed) in enumerate([jobs[0], *jobs]):
        outcomes, seconds = [], []
        for level, scenario in enumerate(levels):
            begun = _cpu()
            outcomes.append(run_job(scenario, Job(k, values, seed, level)))
            seconds.append(_cpu() - begun)
        found.append(_Pair((outcomes[0], outcomes[1]), (seconds[0], seconds[1])))
    return found[1:]


def _cpu() -> float:
    """Return the CPU seconds of this process and its ended children so far; `os.times` counts in hundredths of a second."""
    try:
        import resource
    except ImportError:  # not a Unix
        return time.process_time()
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def _cost(pairs: list[_Pair]) -> float:
    """Return the nearest of the costs that are told apart; what others do on the machine hardly disturbs a median."""
    measured = float(np.median([coarse / max(fine, 1e-9) for fine, coarse in (pair.seconds for pair in pairs)]))
    return min(_COSTS, key=lambda cost: abs(np.log(cost / max(measured, 1e-9))))


def _problem(pairs: list[_Pair]) -> str:
    """Return what is wrong with the coarse runs; "" for nothing."""
    lost = [pair.outcomes[1] for pair in pairs if pair.ok == (True, False)]
    if len(lost) <= _FEW_FAILED * len(pairs):
        return ""
    return f"{len(lost)} of {len(pairs)} coarse runs fail where those of the scenario do not: {lost[0].status}: {lost[0].reason}"

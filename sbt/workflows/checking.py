"""The contract of a scenario, tried out: what `sumo-sbt check` proves before a campaign relies on it."""

from __future__ import annotations

import hashlib
import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sbt import interruption
from sbt.errors import RunError, SbtError, described
from sbt.execution.spec import ScenarioSpec
from sbt.execution.tasks import DiedError, elsewhere
from sbt.execution.warming import keeping_states
from sbt.metrics.physics import Breach, breaches
from sbt.metrics.stl import FORMULA
from sbt.metrics.stl_grammar import horizon, parse
from sbt.problem.outcome import TELEPORTED, Status
from sbt.problem.plain import Value, Values, written
from sbt.problem.scenario import Batched, LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.problem.trace import Trace
from sbt.seeds import run_seed, stream
from sbt.sumo.files import SumoFiles
from sbt.sumo.messages import DROPPED, dropped
from sbt.sumo.suggesting import units_apart
from sbt.workflows.comparing import compared_times
from sbt.workflows.drawn import Told, covariates_first
from sbt.workflows.fidelity import fidelity_findings
from sbt.workflows.findings import Finding, net_findings, row_findings, some_rows
from sbt.workflows.rehearsal import rehearse
from sbt.workflows.snapshots import fresh_instead, snapshot_findings, which_isolation

__all__ = ["Finding", "check_scenario", "findings_of"]

_ALL_RUN = "centre and corners run"
_CORNERS_UP_TO = 4
"""With more inputs than this, every input goes to its ends alone instead of all 2^d corners."""
_FEW_INVALID = 0.25
"""Largest share of the centre and corners that may be invalid."""
_INSTANTLY = "; lane changes do that: SUMO changes lanes within a step unless its option lanechange.duration is set (such as 3 s)"
_PARKS = "; who stands there parks, or leaves its place, or changes lanes in a queue, which SUMO does within a step"
_STANDS = 0.1
"""Speed below which who jumps beside its lane may park (m/s)."""
_MOVED = "; SUMO moves walkers, and who parks or rides, from one place to another within a step"
_STEP = 1.0
"""How much shorter than a formula's horizon a run may be (s): a step of SUMO at most."""
_SLOW, _TIMES, _DRAWN = 1.0, 4, 20
"""A run from which on it is said how long checking takes (s); how often centre and corners are run, and further runs, about."""
_WARNINGS = 8
"""Most warnings of the simulator that are shown."""
_FEWEST_CHANGED, _MOST_CHANGED, _MOST_CORNERS = 3, 8, 17
"""Random runs, at most, that are made again with other values of an input, until one tells that it changes something."""
_RUN_DEADLINE = 60.0
"""Longest run (s), where the scenario looks at the clock."""
_WORKER_DEADLINE = 300.0
"""Longest wait (s) for the worker process."""


@dataclass(frozen=True)
class _Run:
    """One run as plain data: metrics, digest and length (s) of its trace, laws of motion it breaks, teleports; or a problem.

    Attributes:
        beside: why somebody jumps beside its lane, where it does so most.
    """

    metrics: tuple[tuple[str, float], ...] = ()
    digest: str = ""
    breaches: tuple[Breach, ...] = ()
    problem: str = ""
    length: float = math.inf
    teleports: tuple[str, ...] = ()
    beside: str = ""


@dataclass(frozen=True)
class _Lost:
    """Why a worker process gave no runs, and whether this process would hang or die of them, too."""

    why: str
    for_good: bool = False


def check_scenario(spec: ScenarioSpec, seed: int = 0, scenario: LogicalScenario | None = None) -> tuple[Finding, ...]:
    """Run a scenario at its centre and corners and compare repetitions, processes and isolation levels.

    Args:
        spec: the scenario, as workers get it.
        seed: of the runs.
        scenario: the configured scenario, where its ranges or requirement differ from those of `spec`.

    Returns:
        One finding a rule. What SUMO warned of, the share of invalid runs, where the time goes, which laws of motion
        (`sbt.metrics.physics`) are broken and, at last, whether both sides of the requirement were met are only information.

    Raises:
        InputError: the scenario cannot be loaded.
    """
    return tuple(findings_of(spec, seed, scenario))


def findings_of(
    spec: ScenarioSpec, seed: int = 0, scenario: LogicalScenario | None = None, told: Told | None = None
) -> Iterator[Finding]:
    """Yield the findings of `check_scenario`, each as soon as it is known; `told` gives the covariates of a campaign."""
    with keeping_states(spec) as kept:
        yield from _findings(kept, seed, scenario, told)


def _findings(spec: ScenarioSpec, seed: int, scenario: LogicalScenario | None, told: Told | None) -> Iterator[Finding]:
    asked = scenario if scenario is not None else spec.resolve()
    yield from which_isolation(spec)
    yield from row_findings(asked)
    points = some_rows(asked) or list(_points(asked.space))
    jobs = [(values, run_seed(seed, k)) for k, values in enumerate(points)]
    drawn = covariates_first(asked, jobs, told)
    other = _elsewhere(spec, jobs)
    if isinstance(other, _Lost) and other.for_good:
        yield Finding(_ALL_RUN, ok=False, detail=other.why)
        return
    begun = time.perf_counter()
    first = _runs(spec, jobs)
    yield from _slow(time.perf_counter() - begun, len(jobs))
    run = _all_ok(first, points)
    yield run
    yield _finite(first, asked)
    yield from _warned(spec)
    yield from net_findings(asked, jobs)
    yield from _units(spec, asked.space)
    yield from _looks_beyond(first, asked)
    yield from rehearse(spec, asked, seed)
    if not run.ok:
        return
    again = _runs(spec, jobs[::-1])[::-1]
    yield _equal("same seed, same trace", first, again, points)
    if asked.pool is None:
        yield from _idle(spec, asked.space, jobs, seed)
    yield from drawn()
    same = "same seed, same trace in a worker process"
    yield Finding(same, ok=False, detail=other.why) if isinstance(other, _Lost) else _equal(same, first, other, points)
    yield from _isolations(spec, jobs, points)
    yield from snapshot_findings(spec, points, seed, _digest)
    yield from fidelity_findings(spec, asked, seed)
    yield from _physics(first, points, spec)
    yield from _teleports(first)
    yield _sides([run for run in first if not run.problem], asked)
    for name, said in compared_times(asked, jobs):
        yield Finding(f"for information: {name}", ok=True, detail=said)


def _points(space: ParameterSpace) -> Iterator[dict[str, Value]]:
    """Yield the centre, the corners and, at the first of them that admits it, every other choice, all within the constraints."""
    centre = {p.name: p.centre for p in space.parameters}
    ranges = [p for p in space.parameters if not p.choices]
    if len(ranges) <= _CORNERS_UP_TO:
        ends = itertools.product(*(p.bounds for p in ranges)) if ranges else ()
        corners = [{**centre, **dict(zip((p.name for p in ranges), corner, strict=True))} for corner in ends]
    else:
        corners = [{**centre, p.name: end} for p in ranges for end in p.bounds]
    points = np.array([[numbers[name] for name in space.names] for numbers in (centre, *corners)])
    chosen = points[space.feasible(points)]
    for k, p in enumerate(space.parameters):
        for choice in range(len(p.choices)):
            at = points.copy()
            at[:, k] = choice
            if choice != p.centre:
                chosen = np.vstack([chosen, at[space.feasible(at)][:1]])
    yield from (space.named(point) for point in chosen)


def _idle(spec: ScenarioSpec, space: ParameterSpace, corners: Sequence[tuple[Values, int]], seed: int) -> list[Finding]:
    """Return which inputs change nothing of random runs and of the first ones, at the ends of their range; none where all do."""
    still, tried = [p.name for p in space.parameters], 0
    points = space.from_unit(stream(seed, "idle").random((_MOST_CHANGED, space.dimension)))
    random = [(values, run_seed(seed, k)) for k, values in enumerate(map(space.named, points[space.feasible(points)]))]
    for values, number in (*random, *corners[:_MOST_CORNERS]):
        left = [p for p in space.parameters if p.name in still]
        given = [(p.name, {**values, p.name: end}) for p in left for end in (p.choices or p.bounds)]
        inside = space.feasible(np.array([space.numbers(one) for _, one in given]))
        given = [one for one, possible in zip(given, inside, strict=True) if possible]
        run, *changed = _runs(spec, [(one, number) for one in (values, *(one for _, one in given))])
        moves = {name for (name, _), other in zip(given, changed, strict=True) if other != run}
        still, tried = [name for name in still if name not in moves], tried + 1
        if not still:
            return []
    if tried < _FEWEST_CHANGED:
        return []
    detail = f"{', '.join(still)}: {tried} runs (random ones, centre, corners) are bit by bit the same at the ends of the range"
    return [Finding("for information: inputs that change nothing", ok=True, detail=detail)]


def _runs(spec: ScenarioSpec, jobs: Sequence[tuple[Values, int]]) -> list[_Run]:
    """Return the runs of these values and seeds, in this order, in this process."""
    scenario = spec.resolve().limited(_RUN_DEADLINE)
    simulate = scenario.simulate
    if isinstance(simulate, Batched) and simulate.batched:
        return [_run(scenario, partial(_given, trace)) for trace in simulate.simulate_many(jobs)]
    if simulate is not None:
        return [_run(scenario, partial(simulate, values, seed)) for values, seed in jobs]
    return [_run(scenario, partial(scenario.run, values, seed)) for values, seed in jobs]


def _given(trace: Trace | BaseException) -> Trace:
    if isinstance(trace, BaseException):
        raise trace
    return trace


def _run(scenario: LogicalScenario, execute: Callable[[], Trace | dict[str, float]]) -> _Run:
    """Return one run; whatever the user's code raises is its problem, not ours."""
    try:
        result = execute()
        if not isinstance(result, Trace):
            return _Run(tuple(result.items()))
        broken = breaches(result, (scenario.roles.other or "",))
        beside = next((_why_beside(result, breach) for breach in broken if breach.law == "sideways"), "")
        length = float(result.time[-1] - result.time[0])
        moved = tuple(text.removeprefix(TELEPORTED) for text in result.unconfirmed if text.startswith(TELEPORTED))
        measured = tuple(scenario.measure(result).items())
        return _Run(measured, _digest(result), broken, length=length, teleports=moved, beside=beside)
    except RunError as error:
        return _Run(problem=f"{error.status}: {error.reason}")
    except BaseException as error:
        if interruption.is_interruption(error):
            raise
        return _Run(problem=f"failed: {described(error)}")


def _why_beside(trace: Trace, breach: Breach) -> str:
    """Return why somebody is moved across its heading: as it drives it changes lanes."""
    k = int(np.argmin(np.abs(trace.time - breach.time)))
    speed = np.abs(trace.actor(breach.actor).speed[max(k - 1, 0) : k + 1])
    return _PARKS if speed.min() < _STANDS else _INSTANTLY


def _digest(trace: Trace) -> str:
    """Return a digest of every number and name in a trace."""
    columns = (
        trace.time,
        trace.x,
        trace.y,
        trace.heading,
        trace.speed,
        trace.acceleration,
        trace.length,
        trace.width,
        *(getattr(part, name) for parts in trace.parts.values() for part in parts for name in ("x", "y", "heading")),
    )
    digest = hashlib.blake2b("/".join((*trace.actors, *trace.unconfirmed)).encode(), digest_size=16)
    for column in columns:
        digest.update(np.ascontiguousarray(column, dtype=np.float64).tobytes())
    return digest.hexdigest()


def _all_ok(runs: list[_Run], points: Sequence[Values]) -> Finding:
    """Return whether the runs give metrics; few may be invalid, where random traffic holds the ego back, but not the centre."""
    bad = [f"at {written(p)}: {r.problem}" for r, p in zip(runs, points, strict=True) if r.problem]
    invalid = [r for r in runs if r.problem.startswith(str(Status.INVALID))]
    fine = bool(runs) and not runs[0].problem and len(bad) == len(invalid) <= _FEW_INVALID * len(runs)
    how = "invalid" if len(bad) == len(invalid) else "gave no metric"
    return Finding(_ALL_RUN, fine, f"{len(bad)} of {len(runs)} {how}; {bad[0]}" if bad else f"{len(runs)} runs")


def _finite(runs: list[_Run], scenario: LogicalScenario) -> Finding:
    """Return whether every run gives every declared metric: a number, or an end of its scale."""
    if all(r.problem for r in runs):
        return Finding("metrics are finite", ok=False, detail="not checked: no run gave a metric")
    for run in (r for r in runs if not r.problem):
        metrics = dict(run.metrics)
        missing = [name for name in scenario.measured if math.isnan(metrics.get(name, math.nan))]
        if missing:
            return Finding("metrics are finite", ok=False, detail=f"no finite {', '.join(missing)}, but got {metrics}")
    return Finding("metrics are finite", ok=True, detail=", ".join(scenario.measured))


def _equal(rule: str, first: list[_Run], second: list[_Run], points: Sequence[Values]) -> Finding:
    """Return whether two series are bit-equal, and where they are not."""
    for a, b, values in zip(first, second, points, strict=True):
        if a != b:
            differ = [f"{n} {x!r} and {y!r}" for (n, x), (_, y) in zip(a.metrics, b.metrics, strict=False) if x != y]
            what = b.problem or a.problem or "; ".join(differ) or "the traces differ, their metrics do not"
            return Finding(rule, ok=False, detail=f"at {written(values)}: {what}")
    return Finding(rule, ok=True, detail=f"{len(first)} runs bit-equal")


def _elsewhere(spec: ScenarioSpec, jobs: Sequence[tuple[Values, int]]) -> list[_Run] | _Lost:
    """Return the runs of a spawned process, which gets plain data only; it is first, as one that hangs can be ended."""
    try:
        return elsewhere(_WORKER_DEADLINE, _runs, spec, jobs)
    except TimeoutError:
        why = f"the worker process gave no answer within {_WORKER_DEADLINE:g} s"
        return _Lost(f"{why}: a run must end, and a loop must step the simulation", for_good=True)
    except DiedError as error:
        return _Lost(f"{error} while it ran them", for_good=True)
    except (SbtError, OSError) as error:
        return _Lost(str(error))


def _isolations(spec: ScenarioSpec, jobs: Sequence[tuple[Values, int]], points: Sequence[Values]) -> list[Finding]:
    """Return, for every allowed isolation level but `fresh`, whether it is bit-equal to `fresh`, and where runs are that anyway.

    The kept simulation runs the jobs in another order, and twice, so that each follows different ones.
    """
    scenario = spec.resolve()
    levels = scenario.isolations
    if not set(levels) - {"fresh"}:
        return []
    fresh = _runs(replace(spec, isolation="fresh"), jobs)
    order = [*range(0, len(jobs), 2), *range(1, len(jobs), 2), *range(len(jobs))[::-1]]
    findings = fresh_instead(scenario.simulate, jobs)
    for level in levels:
        if level != "fresh":
            kept = _runs(replace(spec, isolation=level), [jobs[k] for k in order])
            expected, at = [fresh[k] for k in order], [points[k] for k in order]
            findings.append(_equal(f"isolation {level} = fresh", expected, kept, at))
    return findings


def _warned(spec: ScenarioSpec) -> list[Finding]:
    """Return what the simulator warned of in the last run, where the scenario passes it on (a user's own SUMO files)."""
    said = getattr(spec.resolve().simulate, "warnings", None)
    every = () if said is None else said()
    names = dropped(every)
    detail = f"SUMO leaves out {', '.join(names)}: a route file must be sorted by departure"
    complete = [Finding("all traffic of the files is there", ok=False, detail=detail)] if names else []
    return [*complete, *_warnings([line for line in every if DROPPED not in line])]


def _warnings(lines: Sequence[str]) -> list[Finding]:
    more = f" (and {len(lines) - _WARNINGS} more)" if len(lines) > _WARNINGS else ""
    detail = "; ".join(line.removeprefix("Warning: ") for line in lines[:_WARNINGS]) + more
    return [Finding("for information: SUMO warns", ok=True, detail=detail)] if lines else []


def _units(spec: ScenarioSpec, space: ParameterSpace) -> list[Finding]:
    """Return where inputs stand in attributes for which SUMO takes another unit, in a user's own SUMO files."""
    files = getattr(spec.resolve().simulate, "files", None)
    found = units_apart(files, {p.name: p.unit for p in space.parameters}) if isinstance(files, SumoFiles) else ()
    return [Finding("for information: units", ok=True, detail="; ".join(found))] if found else []


def _looks_beyond(runs: list[_Run], scenario: LogicalScenario) -> list[Finding]:
    """Return the formulas that look further ahead than the longest run lasts."""
    longest = max((run.length for run in runs if not run.problem), default=math.inf)
    texts = {m.name: m.description.removeprefix(FORMULA) for m in scenario.metrics if m.description.startswith(FORMULA)}
    far = {name: ahead for name, text in texts.items() if (ahead := horizon(parse(text))) > longest + _STEP}
    said = [f"{name} looks {ahead:g} s ahead, but the longest run lasts {longest:.4g} s" for name, ahead in far.items()]
    detail = "; ".join(said) + ": beyond its end the last values count"
    return [Finding("for information: formulas", ok=True, detail=detail)] if said else []


def _physics(runs: list[_Run], points: list[dict[str, Value]], spec: ScenarioSpec) -> list[Finding]:
    """Return which laws of motion are broken, and where first: a failure in such a run is hardly one of the AV."""
    broken = [(breach, values) for run, values in zip(runs, points, strict=True) for breach in run.breaches]
    if not broken:
        return []
    share = f"{sum(bool(run.breaches) for run in runs)} of {len(runs)} runs"
    first, roles = {breach.law: (breach, values) for breach, values in broken[::-1]}, spec.resolve().roles
    egos = roles.ego, *roles.also_tested
    detail = "; ".join(f"{breach.told(egos)} ({written(values)})" for breach, values in first.values())
    options = getattr(getattr(spec.resolve().simulate, "files", None), "options", {})
    causes = dict.fromkeys(run.beside for run in runs if run.beside)
    detail += "".join(cause for cause in causes if cause != _INSTANTLY or "lanechange.duration" not in options)
    if "walking" in first:
        detail += _MOVED
    return [Finding("for information: beyond the laws of motion", ok=True, detail=f"in {share}: {detail}")]


def _slow(seconds: float, runs: int) -> list[Finding]:
    """Return how long it takes to check this scenario, where so many runs took long."""
    if seconds < _SLOW * max(runs, 1):
        return []
    each, every = seconds / max(runs, 1), _TIMES * runs + _DRAWN
    detail = f"a run takes {each:.1f} s here, and all checks make about {every} of them: {each * every / 60.0:.0f} minutes"
    return [Finding("for information: the scenario is slow", ok=True, detail=detail)]


def _teleports(runs: list[_Run]) -> list[Finding]:
    """Return that SUMO teleported road users near the ego; none where it did not."""
    moved = [run.teleports[0] for run in runs if run.teleports]
    what = "metrics see who is teleported leave and come (option time-to-teleport)"
    detail = f"in {len(moved)} of {len(runs)} runs, such as {moved[0]}; {what}" if moved else ""
    return [Finding("for information: SUMO teleports road users near the ego", ok=True, detail=detail)] if moved else []


def _sides(runs: list[_Run], scenario: LogicalScenario) -> Finding:
    need, metrics = scenario.requirement, [dict(run.metrics) for run in runs]
    each = "; ".join(
        f"{sum(part.is_critical(found) for found in metrics)} of {len(runs)} critical by {part.metric} in"
        f" [{part.low:g}, {part.high:g}]" for part in need.parts
    )  # fmt: skip
    whole = f"{sum(need.is_critical(found) for found in metrics)} of {len(runs)} critical by {need.metric}: "
    detail = (whole if need.combined else "") + each
    return Finding("for information: both sides of the requirement", ok=True, detail=detail)

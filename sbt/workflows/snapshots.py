"""What `check` says of the isolation of runs, and proves of those that begin with warmed traffic."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

from sbt.errors import RunError, SbtError
from sbt.execution.spec import ScenarioSpec
from sbt.execution.tasks import elsewhere
from sbt.problem.isolation import Warmable
from sbt.problem.outcome import Status
from sbt.problem.plain import Values, written
from sbt.problem.trace import Trace
from sbt.seeds import run_seed
from sbt.workflows.findings import Finding

__all__ = ["fresh_instead", "snapshot_findings", "which_isolation"]

_POINTS = 3
"""Points that are compared."""
_DEADLINE = 900.0
"""Longest wait for the other process, which warms up anew (s)."""
_REFUSED = tuple(f"{status}: " for status in Status)
"""How what is told of a run without a trace begins."""

Digest = Callable[[Trace], str]
"""Of every number and name in a trace."""


def which_isolation(spec: ScenarioSpec) -> list[Finding]:
    """Return at which level the runs of a user's files run, and why not with warmed traffic; nothing for other scenarios."""
    simulate = spec.resolve().simulate
    if not isinstance(simulate, Warmable):
        return []
    isolation = simulate.isolation
    numbers: dict[str, float] = {}
    if isolation.warm:
        times = f"{isolation.seeds} time{'s' if isolation.seeds > 1 else ''}"
        said = f"snapshot: traffic is warmed up {times} until t = {isolation.until:g} s, where runs begin"
        said += "; a campaign without warm_up.seeds chooses the number by its budget"
        numbers = {"until": isolation.until, "seeds": isolation.seeds}
    else:
        said = f"fresh: every run simulates its traffic from the beginning: {isolation.why or 'so did the first run'}"
    return [Finding("for information: isolation", ok=True, detail=said, numbers=numbers)]


def fresh_instead(simulate: object, jobs: Sequence[tuple[Values, int]]) -> list[Finding]:
    """Return why SUMO is loaded for runs of a scene that allows less; nothing where it is not."""
    asked = getattr(simulate, "why_fresh", lambda *_: "")
    found: list[str] = []
    for values, seed in jobs:
        with suppress(RunError):  # a scene that cannot be built is an invalid run
            found += filter(None, [asked(values, seed)])
    if not found:
        return []
    runs = "every run" if len(found) == len(jobs) else f"{len(found)} of {len(jobs)} runs"
    said = f"fresh: SUMO is loaded for {runs}: {'; '.join(dict.fromkeys(found))}"
    return [Finding("for information: isolation", ok=True, detail=said, numbers={"fresh": len(found) / len(jobs)})]


def snapshot_findings(spec: ScenarioSpec, points: Sequence[Values], seed: int, digest: Digest) -> Iterator[Finding]:
    """Yield whether runs from warmed traffic are what they should be: the same in a process of their own, and drawn anew.

    Args:
        spec: the scenario, whose warmed states are kept in a folder.
        points: values of the inputs.
        seed: of the runs.
        digest: a function of a module, as another process imports it.
    """
    isolation = spec.isolated
    if isolation is None or not isolation.warm:
        return
    seeds = [run_seed(seed, k) for k in range(len(points[:_POINTS]) + 1)]
    *seeds, another = [each - each % isolation.seeds for each in seeds]  # all of the first warm-up, which is made twice
    jobs = list(zip(points, seeds, strict=False))
    forked = _digests(spec, jobs, digest)
    rule = f"snapshot: {len(jobs)} runs = the same, warm-up included, in a process that loads everything"
    alone = replace(spec, isolated=replace(isolation, forking=False, states=""))
    try:
        loaded = elsewhere(_DEADLINE, _digests, alone, jobs, digest)
    except (SbtError, OSError, TimeoutError) as error:
        yield Finding(rule, ok=False, detail=str(error) or f"the process gave no answer within {_DEADLINE:g} s")
        return
    differing = [written(values) for (values, _), a, b in zip(jobs, forked, loaded, strict=True) if a != b]
    why = "; known of persons beside an ego that is a <trip>, where ways are equally long: a <vehicle> with a <route> mends that"
    said = f"they differ at {'; '.join(differing)}{why}; isolation: fresh simulates all traffic" if differing else "bit-equal"
    yield Finding(rule, ok=not differing, detail=said)
    traced = [k for k, found in enumerate(forked) if not found.startswith(_REFUSED)]
    k = traced[0] if traced else 0
    differ = bool(traced) and _digests(spec, [(jobs[k][0], another)], digest)[0] != forked[k]
    said = "they differ" if differ else "they give one run: in this traffic nothing is drawn after the warm-up"
    if not traced:
        said = f"not known: no run gave a trace at {'; '.join(written(values) for values, _ in jobs)}"
    numbers = {"differ": float(differ)} if traced else {}
    yield Finding("for information: two seeds from one warm-up", ok=True, detail=said, numbers=numbers)


def _digests(spec: ScenarioSpec, jobs: Sequence[tuple[Values, int]], digest: Digest) -> list[str]:
    """Return a digest of the trace of each run, or why it has none."""
    simulate = spec.resolve().simulate
    found = []
    for values, seed in jobs:
        try:
            found.append("no trace" if simulate is None else digest(simulate(values, seed)))
        except RunError as error:
            found.append(f"{error.status}: {error.reason}")
    return found

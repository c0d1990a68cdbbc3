"""A sample of runs before a campaign: what share of them would be invalid, and where the time goes.

The inputs are drawn from their distribution, as nature would, each run with a seed of its own.
"""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import dataclass, field

from sbt import interruption
from sbt.errors import RunError, described
from sbt.estimators import binomial
from sbt.execution.spec import ScenarioSpec
from sbt.problem.outcome import Status
from sbt.problem.plain import Values
from sbt.problem.scenario import LogicalScenario, Simulate
from sbt.seeds import run_seed, stream
from sbt.workflows.findings import Finding

__all__ = ["rehearse"]

_RUNS = 20
"""Runs of the sample: none invalid among them means at most 17 % (95 %)."""
_BUDGET = 15.0
"""CPU time (s) after which no further run is begun; at least `_FEWEST` are."""
_FEWEST = 5
_RUN_DEADLINE = 60.0
"""Longest run (s), where the scenario looks at the clock."""
_CONFIDENCE = 0.95
_ALL = "run"
"""The phase of a simulation that does not tell its phases apart."""


@dataclass
class _Sample:
    """What the runs gave: reasons by status, and CPU seconds by phase."""

    runs: int = 0
    reasons: dict[str, list[str]] = field(default_factory=dict)
    seconds: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))


def rehearse(spec: ScenarioSpec, scenario: LogicalScenario, seed: int) -> list[Finding]:
    """Run a sample and return what it shows, for information; nothing for a scenario that does not simulate.

    Args:
        spec: the scenario, as workers get it.
        scenario: the configured one, whose distribution is drawn from.
        seed: of the sample.
    """
    measured = spec.resolve().limited(_RUN_DEADLINE)
    if measured.simulate is None:
        return []
    sample = _Sample()
    for k, x in enumerate(scenario.space.sample(_RUNS, stream(seed, "rehearsal"))):
        if sample.runs >= _FEWEST and sum(sample.seconds.values()) > _BUDGET:
            break
        _run(sample, measured, measured.simulate, scenario.space.named(x), run_seed(seed, k))
    return [_invalid(sample), _time(sample)]


def _run(sample: _Sample, scenario: LogicalScenario, simulate: Simulate, values: Values, seed: int) -> None:
    """Add one run to the sample; whatever the user's code raises is a failed run."""
    timed = getattr(simulate, "timed", None)
    begun = time.process_time()
    sample.runs += 1
    try:
        if timed is not None:
            result, seconds = timed(values, seed)
            for phase, spent in seconds.items():
                sample.seconds[phase] += spent
            if isinstance(result, RunError):
                raise result
        else:
            result = simulate(values, seed)
            sample.seconds[_ALL] += time.process_time() - begun
        begun = time.process_time()
        scenario.measure(result)
        sample.seconds["metrics"] += time.process_time() - begun
    except RunError as error:
        sample.reasons.setdefault(str(error.status), []).append(error.reason)
    except BaseException as error:
        if interruption.is_interruption(error):
            raise
        sample.reasons.setdefault(str(Status.FAILED), []).append(described(error))


def _invalid(sample: _Sample) -> Finding:
    """Return the share of invalid runs with its interval, and the most frequent reasons of runs that are not ok."""
    n, invalid = sample.runs, len(sample.reasons.get(str(Status.INVALID), []))
    untold = sum(len(reasons) for status, reasons in sample.reasons.items() if status != Status.INVALID)  # they might have been
    low, high = (float(binomial.interval(k, n, _CONFIDENCE)[end]) for end, k in enumerate((invalid, invalid + untold)))
    share = f"{invalid / n:.1%} ({low:.1%} to {high:.1%}, {_CONFIDENCE:.0%} interval)"
    detail = f"{share}: {invalid} of {n} runs drawn from the inputs' distribution"
    for status, reasons in sorted(sample.reasons.items()):
        if status != Status.INVALID:
            detail += f"; {len(reasons)} {status}"
    for status in sorted(sample.reasons, key=lambda s: s != Status.INVALID)[:1]:
        detail += f"; first {status}: {sample.reasons[status][0]}"
    numbers = {"runs": n, "invalid": invalid, "share": invalid / n, "low": low, "high": high, "confidence": _CONFIDENCE}
    others = {status: len(reasons) for status, reasons in sample.reasons.items() if status != Status.INVALID}
    return Finding("for information: share of invalid runs", ok=True, detail=detail, numbers={**numbers, **others})


def _time(sample: _Sample) -> Finding:
    """Return the CPU seconds of each phase a run and its share."""
    total = sum(sample.seconds.values())
    parts = [f"{name} {s / sample.runs:.3g} s ({s / max(total, 1e-12):.0%})" for name, s in sample.seconds.items()]
    numbers = {f"{name}_s": s / sample.runs for name, s in sample.seconds.items()}
    shares = {f"{name}_share": s / max(total, 1e-12) for name, s in sample.seconds.items()}
    detail = f"CPU time a run (mean of {sample.runs}): {', '.join(parts)}"
    return Finding("for information: where the time goes", ok=True, detail=detail, numbers={**numbers, **shares})

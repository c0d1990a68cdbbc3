"""Executors: the same rows whoever runs them, and one bad run never costs another."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from studies import by_index

from sbt.errors import InputError, PluginError
from sbt.execution.local import LocalExecutor
from sbt.execution.protocol import Executor, SerialExecutor
from sbt.execution.spec import ScenarioSpec
from sbt.execution.worker import run_job, run_traced
from sbt.problem.outcome import Job, Outcome, Status
from sbt.seeds import run_seed, stream


def jobs(n: int, kind: Callable[[int], float] = lambda k: 0.5) -> list[Job]:
    return [Job(k, {"a": kind(k), "b": k / n}, run_seed(0, k)) for k in range(n)]


def spec(file: Path, name: str = "AWKWARD") -> ScenarioSpec:
    return ScenarioSpec(f"{file.name}:{name}", str(file.parent))


def run(executor: Executor, work: list[Job]) -> dict[int, Outcome]:
    with executor:
        found = by_index(executor.run(work))
    assert sorted(found) == [job.index for job in work]
    return found


@pytest.mark.sumo
def test_serial_and_one_or_two_workers_give_the_same_bits():
    rng = stream(5)
    work = [Job(k, {"d_v": float(rng.uniform(0, 120)), "d_t": float(rng.uniform(0.1, 4))}, run_seed(5, k)) for k in range(60)]
    cut_in = ScenarioSpec("cut_in")
    expected = run(SerialExecutor(cut_in), work)
    assert {o.status for o in expected.values()} == {Status.OK}
    assert len({o.metrics["ttc_min"] for o in expected.values()}) > 20
    for workers, order in ((1, work), (2, work[::-1])):
        with LocalExecutor(cut_in, workers, 60.0) as executor:
            assert by_index(executor.run(order)) == expected


def test_what_goes_wrong_in_a_run_is_its_row_with_the_place(analytic: Path):
    work = [*jobs(3), Job(3, {"a": 0.03, "b": 0.5}, 1), Job(4, {"a": 0.04, "b": 0.5}, 1), Job(5, {"a": 0.5}, 1)]
    found = run(SerialExecutor(spec(analytic)), work)
    assert [found[k].status for k in range(6)] == ["ok", "ok", "ok", "failed", "failed", "failed"]
    line = 1 + next(k for k, text in enumerate(analytic.read_text().splitlines()) if "# marked" in text)
    assert found[3].reason == f"KeyError: 'no such thing' ({analytic}:{line})"
    assert found[4].reason == 'metric y must be finite, inf or -inf, but got nan; the run gave {"noise": 0.0}'
    assert found[5].reason.startswith("KeyError: 'b' (")
    assert all(o.metrics == {} for o in found.values() if o.status != Status.OK)
    with LocalExecutor(spec(analytic), 1) as local:
        assert by_index(local.run(work[::-1])) == found


RUDE = '''
"""What a user's code may do to whoever calls it; input a says which of them."""
import sys
import numpy as np
from sbt.errors import RunError
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import CriticalInterval, Requirement
from sbt.problem.metric import Metric
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.problem.trace import Trace

class Mute(Exception):
    def __str__(self):
        raise ValueError("no words")

def throw(error):
    raise error

def deeper():
    return deeper()

RUDE = [
    lambda: sys.exit(), lambda: sys.exit(3), lambda: throw(KeyboardInterrupt), lambda: throw(GeneratorExit("x")),
    lambda: throw(BaseException("x")), lambda: throw(Mute()), lambda: throw(MemoryError()), deeper,
    lambda: throw(RunError("no status", "x")), lambda: {}, lambda: None, lambda: {"y": "much"}, lambda: {"y": 1.0, "z": 2.0},
]
SPACE = ParameterSpace((Parameter("a", 0.0, 100.0), Parameter("b", 0.0, 1.0)))
NEED = Requirement("y", high=0.0)

def rude(values, seed):
    return RUDE[int(values["a"])]() if values["a"] < 99 else {"y": 1.0}

def still(values, seed):
    t = np.arange(3.0)
    rows = np.zeros((3, 1))
    trace = Trace(t, ("ego",), rows, rows, rows, rows, rows, np.ones(1), np.ones(1))
    return (values["a"] < 99 and RUDE[int(values["a"])]()) or trace

class Together:
    """Runs all at once, rudely."""
    batched = True

    def __call__(self, values, seed):
        return still(values, seed)

    def simulate_many(self, work, at_work=None):
        if any(values["a"] < 90 for values, _ in work):
            return [still(values, seed) for values, seed in work]
        return []

def measure(trace):
    return 1.0

def leave(trace):
    sys.exit("over")

SCENARIO = LogicalScenario("rude", SPACE, NEED, evaluate=rude, metric_names=("y",))
SIMULATED = LogicalScenario("simulated", SPACE, NEED, simulate=still, metrics=(Metric("y", measure),))
TOGETHER = LogicalScenario("together", SPACE, NEED, simulate=Together(), metrics=(Metric("y", measure),))
LEAVING = LogicalScenario("leaving", SPACE, NEED, simulate=still, metrics=(Metric("y", leave),))
'''
REASONS = [
    r"SystemExit \(\S+rude.py:\d+\)", r"SystemExit: 3 \(\S+rude.py:\d+\)", r"KeyboardInterrupt \(\S+rude.py:\d+\)",
    r"GeneratorExit: x \(.*", r"BaseException: x \(.*", r"Mute: \(its message cannot be read\) \(.*", r"MemoryError \(.*",
    r"RecursionError: maximum recursion depth exceeded.*", r"RunError: x \(.*",
]  # fmt: skip
WRONG = [
    "a run must give the metrics y, but gave none", "a run must return its metrics by name, but got .*",
    "metric y must be one number, but got .*", r"a run must give the metrics y, but gave y, z; declare all of them: metrics=.*",
]  # fmt: skip


@pytest.fixture
def rude_file(tmp_path: Path) -> Path:
    path = tmp_path / "rude.py"
    path.write_text(RUDE)
    return path


@pytest.mark.parametrize("name", ["SCENARIO", "SIMULATED", "TOGETHER"])
def test_a_run_may_raise_or_return_anything_and_is_a_row(rude_file: Path, name: str):
    reasons = [*REASONS, *WRONG] if name == "SCENARIO" else REASONS
    work = [Job(k, {"a": k / 1.0 if k < len(reasons) else 99.5, "b": 0.5}, k) for k in range(len(reasons) + 3)]
    found = run(SerialExecutor(spec(rude_file, name)), work)
    for k, reason in enumerate(reasons):
        assert (found[k].status, found[k].metrics) == (Status.FAILED, {})
        assert re.fullmatch(reason, found[k].reason, re.DOTALL), found[k].reason
    assert {found[k].status for k in range(len(reasons), len(work))} == {Status.OK}
    with LocalExecutor(spec(rude_file, name), 2) as local:
        pids = sorted(local._pool._processes)
        again = by_index(local.run(work))
        assert sorted(local._pool._processes) == pids, "no worker died of it"
    recursion = REASONS.index(REASONS[7])
    assert {k: o for k, o in again.items() if k != recursion} == {k: o for k, o in found.items() if k != recursion}
    assert again[recursion].status == Status.FAILED


def test_a_metric_may_raise_anything(rude_file: Path):
    work = [Job(0, {"a": 99.5, "b": 0.5}, 0)]
    found = run(SerialExecutor(spec(rude_file, "LEAVING")), work)
    assert re.fullmatch(r"SystemExit: over \(\S+rude.py:\d+\)", found[0].reason)
    with LocalExecutor(spec(rude_file, "LEAVING"), 1) as local:
        assert by_index(local.run(work)) == found


def test_code_may_raise_anything_outside_the_main_thread_and_is_interrupted_by_a_signal_only(rude_file: Path):
    found: dict[int, Outcome] = {}
    job = Job(0, {"a": 2.0, "b": 0.5}, 0)
    thread = threading.Thread(target=lambda: found.update(run(SerialExecutor(spec(rude_file, "SCENARIO")), [job])))
    thread.start()
    thread.join()
    assert found[0].reason.startswith("KeyboardInterrupt (")
    with pytest.raises(KeyboardInterrupt):  # without a handler of ours it may be anybody's
        run_job(spec(rude_file, "SCENARIO").resolve(), job)


def test_what_is_run_once_with_its_trace_is_what_is_run_without(rude_file: Path):
    for name, a in (("SCENARIO", 99.5), ("SCENARIO", 1.0), ("SIMULATED", 99.5), ("SIMULATED", 1.0), ("LEAVING", 99.5)):
        scenario, job = spec(rude_file, name).resolve(), Job(4, {"a": a, "b": 0.5}, 7)
        outcome, trace = run_traced(scenario, job)
        assert replace(outcome, seconds=0.0) == replace(run_job(scenario, job), seconds=0.0)
        assert (trace is not None) is (name != "SCENARIO" and a > 99)


@pytest.mark.sumo
def test_a_run_with_its_trace_is_the_run_of_a_campaign():
    scenario, job = ScenarioSpec("cut_in").resolve(), Job(0, {"d_v": 40.0, "d_t": 1.0}, 3)
    outcome, trace = run_traced(scenario, job)
    assert trace is not None
    assert replace(outcome, seconds=0.0) == replace(run_job(scenario, job), seconds=0.0)
    assert trace.identical(scenario.simulate(job.inputs, job.seed))


def test_a_run_that_kills_its_worker_costs_itself_only(analytic: Path):
    work = jobs(40, lambda k: 0.01 if k == 7 else 0.5)
    found = run(LocalExecutor(spec(analytic), 2), work)
    assert [k for k, o in found.items() if o.status == Status.CRASHED] == [7]
    assert found[7].reason == "the worker process died (exit code 7), also when this run was tried again alone"
    healthy = run(SerialExecutor(spec(analytic)), [job for job in work if job.index != 7])
    assert {k: o for k, o in found.items() if k != 7} == healthy


def test_the_signal_that_ended_a_worker_is_told(tmp_path: Path):
    file = tmp_path / "deadly.py"
    file.write_text(textwrap.dedent("""
        import os, signal
        from sbt import Parameter, Requirement, Scenario
        SIGNALS = [0, signal.SIGSEGV, signal.SIGABRT, signal.SIGRTMIN + 5]
        def evaluate(values, seed):
            if SIGNALS[seed]:
                os.kill(os.getpid(), SIGNALS[seed])
            return {"y": values["a"]}
        SCENARIO = Scenario("deadly", [Parameter("a", 0, 1)], Requirement("y", high=0.0), evaluate=evaluate)
    """))
    found = run(LocalExecutor(spec(file, "SCENARIO"), 2), [Job(k, {"a": 0.5}, k) for k in range(4)])
    told = [re.search(r"died \(signal (.*?)\)", found[k].reason) for k in range(1, 4)]
    assert [one and one[1] for one in told] == ["SIGSEGV", "SIGABRT", str(signal.SIGRTMIN + 5)]
    assert found[0].status == Status.OK


def test_a_run_that_hangs_is_stopped_and_the_others_go_on(analytic: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("sbt.execution.local._GRACE", 0.3)
    work = jobs(20, lambda k: 0.02 if k == 4 else 0.5)
    start = time.monotonic()
    found = run(LocalExecutor(spec(analytic), 2, timeout=2.0), work)
    assert [k for k, o in found.items() if o.status != Status.OK] == [4]
    assert (found[4].status, found[4].reason) == (
        Status.TIMEOUT, "a run must take at most 2 s: its process was stopped",
    )  # fmt: skip
    assert time.monotonic() - start < 60, "it would hang for ever"


def test_a_worker_killed_from_outside_costs_nothing(analytic: Path):
    """Twice during a batch some worker is killed, whatever it is at then."""
    work = jobs(30, lambda k: 0.05)
    with LocalExecutor(spec(analytic), 2) as executor:
        done: list[Outcome] = []
        over = threading.Event()

        def kill() -> None:
            for _ in range(2):
                if over.wait(0.4):
                    return
                with suppress_gone():
                    os.kill(sorted(executor._pool._processes)[0], signal.SIGKILL)

        killer = threading.Thread(target=kill)
        killer.start()
        for outcome in executor.run(work):
            done.append(outcome)
        over.set()
        killer.join()
    found = by_index(iter(done))
    assert sorted(found) == list(range(30))
    assert {o.status for o in found.values()} == {Status.OK}


class suppress_gone:
    """The pool may just be without workers."""

    def __enter__(self) -> None: ...

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> bool:
        return kind is not None and issubclass(kind, (ProcessLookupError, IndexError, AttributeError))


def test_an_abandoned_batch_does_not_disturb_the_next(analytic: Path):
    with LocalExecutor(spec(analytic), 2) as executor:
        outcomes = executor.run(jobs(30, lambda k: 0.05))
        next(outcomes)
        outcomes.close()
        assert sorted(by_index(executor.run(jobs(5)))) == list(range(5))
        assert list(executor.run([])) == []


DRIVER = """
import os, sys
from sbt.execution.local import LocalExecutor
from sbt.execution.spec import ScenarioSpec
from sbt.execution.worker import run_job, run_traced
from sbt.problem.outcome import Job

if __name__ == "__main__":
    with LocalExecutor(ScenarioSpec("analytic.py:AWKWARD", sys.argv[1]), 2) as executor:
        for outcome in executor.run([Job(k, {"a": 0.05, "b": 0.5}, k) for k in range(1000)]):
            print(outcome.index, flush=True)
"""


def children(pid: int) -> set[int]:
    found = set()
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid:
            found.add(int(path.parent.name))
    return found


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
def test_workers_end_with_their_driver(analytic: Path):
    script = analytic.parent / "driver.py"
    script.write_text(textwrap.dedent(DRIVER))
    driver = subprocess.Popen([sys.executable, str(script), str(analytic.parent)], stdout=subprocess.PIPE)
    assert driver.stdout is not None
    driver.stdout.readline()
    workers = children(driver.pid)
    assert len(workers) >= 2
    driver.kill()
    driver.wait()
    deadline = time.monotonic() + 60
    while any(alive(pid) for pid in workers) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not [pid for pid in workers if alive(pid)]
    driver.stdout.close()


def test_workers_outlive_the_thread_that_started_them(analytic: Path):
    executor = LocalExecutor(spec(analytic), 2)
    thread = threading.Thread(target=executor.__enter__)
    thread.start()
    thread.join()
    try:
        pids = sorted(executor._pool._processes)
        time.sleep(0.3)
        assert {o.status for o in executor.run(jobs(20))} == {Status.OK}
        assert sorted(executor._pool._processes) == pids
    finally:
        executor.__exit__()
    assert not [pid for pid in pids if alive(pid)]


@pytest.mark.parametrize("error", ["sys.exit()", "sys.exit(0)", "raise KeyboardInterrupt", "raise BaseException('x')"])
def test_a_file_that_ends_the_program_when_it_is_imported_is_told_with_its_line(tmp_path: Path, error: str):
    (tmp_path / "leaving.py").write_text(f"import sys\n\n{error}\nSCENARIO = None\n")
    with pytest.raises(PluginError, match=r"leaving.py:3 raised on import: (SystemExit|KeyboardInterrupt|BaseException)"):
        ScenarioSpec("leaving.py:SCENARIO", str(tmp_path)).resolve()


METRICS = """
import sys
from sbt.problem.metric import Metric

def farthest(trace):
    return float(trace.x.max())

SLOWEST = Metric("slowest", lambda trace: float(trace.speed.min()), "m/s")
D_MIN = Metric("d_min", lambda trace: -1.0)
NUMBER = 3

def rude(trace):
    sys.exit(3)
"""


@pytest.mark.sumo
def test_metrics_of_ones_own_are_measured_in_any_scenario(tmp_path: Path):
    (tmp_path / "mine.py").write_text(METRICS)
    names = ("mine.py:farthest", "mine.py:SLOWEST", "mine.py:D_MIN", "jerk_max", "ttc_2d_min")
    own = ScenarioSpec("cut_in", str(tmp_path), metrics=names)
    plain, job = ScenarioSpec("cut_in").resolve(), Job(0, {"d_v": 40.0, "d_t": 1.0}, 3)
    assert set(own.resolve().measured) == {*plain.measured, "farthest", "slowest", "jerk_max", "ttc_2d_min"}
    found = run(SerialExecutor(own), [job])
    trace = plain.simulate(job.inputs, job.seed)
    assert (found[0].metrics["d_min"], found[0].metrics["farthest"]) == (-1.0, float(trace.x.max()))
    assert found[0].metrics["ttc_min"] == run_job(plain, job).metrics["ttc_min"]
    with LocalExecutor(own, 1) as local:
        assert by_index(local.run([job])) == found
    rude = run(SerialExecutor(replace(own, metrics=("mine.py:rude",))), [job])
    assert rude[0].reason.startswith("SystemExit: 3 (")
    with pytest.raises(InputError, match=r"must be a Metric, or a function of the trace .* 'mine.py:NUMBER' is a int"):
        replace(own, metrics=("mine.py:NUMBER",)).resolve()
    with pytest.raises(PluginError, match="metrics must be one of"):
        replace(own, metrics=("ttc_minn",)).resolve()


def test_metrics_need_a_trace(analytic: Path):
    with pytest.raises(InputError, match="metric jerk_max needs the trace of a run, but scenario disc gives its metrics"):
        replace(spec(analytic, "SCENARIO"), metrics=("jerk_max",)).resolve()


def test_choices_that_do_not_exist_are_told_before_any_run(analytic: Path):
    with pytest.raises(PluginError, match=r"scenarios must be one of .*cut_in.* but got 'cut_inn'"):
        SerialExecutor(ScenarioSpec("cut_inn"))
    with pytest.raises(PluginError, match="must define NOTHING"):
        LocalExecutor(spec(analytic, "NOTHING"), 1).__enter__()
    with pytest.raises(PluginError, match=r"a scenario must be a LogicalScenario, but 'analytic.py:disc' is a function"):
        spec(analytic, "disc").resolve()
    with pytest.raises(InputError, match="offers no choice of ego"):
        replace(spec(analytic), ego={"kind": "acc_aeb"}).resolve()
    broken = analytic.parent / "broken.py"
    broken.write_text("x = 1\n\ny = x / 0\n")
    with pytest.raises(PluginError, match=r"broken.py:3 raised on import: ZeroDivisionError: division by zero"):
        ScenarioSpec("broken.py:SCENARIO", str(analytic.parent)).resolve()
    assert spec(analytic).resolve().run({"a": 0.5, "b": 0.5}, 0)["y"] == -0.3


LEAKING = """
import numpy as np
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
KEPT = []

def leak(values, seed):
    if values["a"] > 0.99:
        KEPT.append(np.ones(2 ** 40 if values["a"] > 0.999 else 75_000_000))
    KEPT.append(np.ones(2 ** 22))
    return {"y": values["a"]}

def count(values, seed):
    KEPT.append(1)
    return {"y": float(len(KEPT))}

SPACE = ParameterSpace((Parameter("a", 0.0, 1.0),))
LEAK, COUNT = (
    LogicalScenario(f.__name__, SPACE, Requirement("y", high=0.0), evaluate=f, metric_names=("y",)) for f in (leak, count)
)
"""


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="looks for memory in /proc")
def test_a_leak_costs_the_run_that_needs_too_much_and_no_other(tmp_path: Path):
    """Each run leaves 32 MiB behind, one needs 600 MB, one asks for 8 TiB at once."""
    (tmp_path / "leaking.py").write_text(LEAKING)
    leak = ScenarioSpec("leaking.py:LEAK", str(tmp_path))
    work = [Job(k, {"a": {4: 0.995, 9: 1.0}.get(k, k / 100)}, k) for k in range(16)]
    found = run(LocalExecutor(leak, 1, memory=400 * 2**20), work)
    assert [k for k, o in found.items() if o.status != Status.OK] == [4, 9]
    for k in (4, 9):
        assert found[k].status == Status.CRASHED
        assert found[k].reason.startswith("a worker may use 400 MiB of memory: its process was stopped, also when")
    assert all(found[k].metrics == {"y": k / 100} for k in found if k not in (4, 9))


def test_workers_are_replaced_after_so_many_runs(tmp_path: Path):
    (tmp_path / "leaking.py").write_text(LEAKING)
    work = [Job(k, {"a": k / 100}, k) for k in range(50)]
    found = run(LocalExecutor(ScenarioSpec("leaking.py:COUNT", str(tmp_path)), 1, recycle=20), work)
    assert len(found) == 50
    assert 20 <= max(o.metrics["y"] for o in found.values()) <= 20 + 64 / 2


BREAKING = """
import sys
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace

def breaks(values, seed):
    if seed == 3:
        sys.path.clear()
        del sys.modules["sbt"]
    return {"y": values["a"]}

SCENARIO = LogicalScenario(
    "breaking", ParameterSpace((Parameter("a", 0.0, 100.0),)), Requirement("y", high=0.0), evaluate=breaks, metric_names=("y",),
)
"""


def test_a_run_that_breaks_the_modules_of_its_worker_is_the_only_one_that_is_lost(tmp_path: Path):
    """Its worker cannot even say what the run gave."""
    (tmp_path / "breaking.py").write_text(BREAKING)
    work = [Job(k, {"a": float(k)}, seed=k) for k in range(8)]
    with LocalExecutor(ScenarioSpec("breaking.py:SCENARIO", str(tmp_path)), 2) as executor:
        found = {outcome.index: outcome for outcome in executor.run(work)}
    assert {k: found[k].metrics for k in range(8) if k != 3} == {k: {"y": float(k)} for k in range(8) if k != 3}
    assert (found[3].status, "could not hand over what it ran" in found[3].reason) == (Status.CRASHED, True)

"""Executors: the same rows whoever runs them, and one bad run never costs another."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from sbt.errors import InputError, PluginError
from sbt.execution.local import LocalExecutor
from sbt.execution.protocol import Executor, SerialExecutor
from sbt.execution.spec import ScenarioSpec
from sbt.problem.outcome import Job, Outcome, Status
from sbt.seeds import run_seed, stream


def jobs(n: int, kind: Callable[[int], float] = lambda k: 0.5) -> list[Job]:
    return [Job(k, {"a": kind(k), "b": k / n}, run_seed(0, k)) for k in range(n)]


def spec(analytic: Path, name: str = "AWKWARD") -> ScenarioSpec:
    return ScenarioSpec(f"analytic.py:{name}", str(analytic.parent))


def by_index(outcomes: Iterator[Outcome]) -> dict[int, Outcome]:
    found = list(outcomes)
    assert len({o.index for o in found}) == len(found), "a run was reported twice"
    return {o.index: replace(o, seconds=0.0) for o in found}


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
    assert found[4].reason == "metric y must be finite, but got nan"
    assert found[5].reason.startswith("KeyError: 'b' (")
    assert all(o.metrics == {} for o in found.values() if o.status != Status.OK)
    with LocalExecutor(spec(analytic), 1) as local:
        assert by_index(local.run(work[::-1])) == found


def test_a_run_that_kills_its_worker_costs_itself_only(analytic: Path):
    work = jobs(40, lambda k: 0.01 if k == 7 else 0.5)
    found = run(LocalExecutor(spec(analytic), 2), work)
    assert [k for k, o in found.items() if o.status == Status.CRASHED] == [7]
    assert found[7].reason == "the worker process died, also when this run was tried again alone"
    healthy = run(SerialExecutor(spec(analytic)), [job for job in work if job.index != 7])
    assert {k: o for k, o in found.items() if k != 7} == healthy


def test_a_run_that_hangs_is_stopped_and_the_others_go_on(analytic: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("sbt.execution.local._GRACE", 0.3)
    work = jobs(20, lambda k: 0.02 if k == 4 else 0.5)
    start = time.monotonic()
    found = run(LocalExecutor(spec(analytic), 2, timeout=0.7), work)
    assert [k for k, o in found.items() if o.status != Status.OK] == [4]
    assert (found[4].status, found[4].reason) == (
        Status.TIMEOUT, "a run must take at most 0.7 s: its process was stopped",
    )  # fmt: skip
    assert time.monotonic() - start < 15


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
    deadline = time.monotonic() + 6
    while any(alive(pid) for pid in workers) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not [pid for pid in workers if alive(pid)]
    driver.stdout.close()


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

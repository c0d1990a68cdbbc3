"""The executor of dask clusters: the same rows, the same fate of bad runs, and workers that come and go."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from studies import by_index

from sbt.errors import InputError
from sbt.execution.carrying import carry
from sbt.execution.protocol import SerialExecutor
from sbt.execution.spec import ScenarioSpec
from sbt.plugins import load
from sbt.problem.outcome import Job, Status
from sbt.seeds import run_seed

distributed = pytest.importorskip("distributed", reason="dask.distributed is not installed (pip install 'sumo-sbt[dask]')")
import psutil  # noqa: E402  dask brings it

from sbt.execution.dask import DaskExecutor  # noqa: E402

DEADLY = '''
import os, signal, time
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import CriticalInterval, Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace


def deadly(values, seed):
    """Where a < 0.1 the dask worker itself is killed, above the process of the run."""
    if values["a"] < 0.1:
        os.kill(os.getppid(), signal.SIGKILL)
        time.sleep(60)
    return {"y": values["a"]}


SPACE = ParameterSpace((Parameter("a", 0.0, 1.0),))
SCENARIO = LogicalScenario("deadly", SPACE, Requirement("y", high=0.0), evaluate=deadly, metric_names=("y",))
'''


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    import dask

    with dask.config.set({"distributed.scheduler.allowed-failures": 0}), distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, memory_limit=0, dashboard_address=None, silence_logs="CRITICAL"
    ) as started:  # fmt: skip
        yield started


def jobs(n: int, kind: Callable[[int], float]) -> list[Job]:
    return [Job(k, {"a": kind(k), "b": k / n}, run_seed(0, k)) for k in range(n)]


def test_rows_are_those_of_the_serial_executor_and_bad_runs_have_the_same_fate(cluster: Any, analytic: Path):
    spec = ScenarioSpec("analytic.py:AWKWARD", str(analytic.parent))
    work = jobs(60, lambda k: {7: 0.01, 11: 0.02, 12: 0.03, 13: 0.04}.get(k, 0.5))
    with DaskExecutor(spec, cluster.scheduler_address, 1, timeout=1.0) as executor:
        rows = by_index(executor.run(work))
        assert by_index(executor.run(jobs(5, lambda k: 0.5))).keys() == set(range(5))
    assert sorted(rows) == list(range(60))
    healthy = by_index(SerialExecutor(spec).run([job for job in work if job.index not in (7, 11)]))
    assert {k: o for k, o in rows.items() if k not in (7, 11)} == healthy
    assert (rows[7].status, rows[7].reason) == (
        Status.CRASHED, "the worker process died, also when this run was tried again alone",
    )  # fmt: skip
    assert (rows[11].status, rows[11].reason) == (
        Status.TIMEOUT, "a run must take at most 1 s: its process was stopped",
    )  # fmt: skip


RUDE = '''
import sys
from deadly import SPACE, CriticalInterval, LogicalScenario, Requirement

def rude(values, seed):
    if values["a"] < 0.1:
        sys.exit(3)
    if values["a"] < 0.2:
        raise KeyboardInterrupt
    return {"y": values["a"]}

SCENARIO = LogicalScenario("rude", SPACE, Requirement("y", high=0.0), evaluate=rude, metric_names=("y",))
'''


def test_a_run_may_raise_anything(cluster: Any, tmp_path: Path):
    (tmp_path / "rude.py").write_text(DEADLY.partition("SCENARIO =")[0] + RUDE.replace("from deadly import", "# of the above:"))
    spec = ScenarioSpec("rude.py:SCENARIO", str(tmp_path))
    work = [Job(k, {"a": k / 10 + 0.05}, k) for k in range(6)]
    with DaskExecutor(spec, cluster.scheduler_address, 1) as executor:
        rows = by_index(executor.run(work))
    assert rows == by_index(SerialExecutor(spec).run(work))
    assert [rows[k].status for k in range(3)] == ["failed", "failed", "ok"]


@pytest.mark.parametrize("size", [10, 1_000_000])
def test_a_scenario_is_carried_whatever_its_size(cluster: Any, tmp_path: Path, size: int):
    harmless = DEADLY.replace("os.kill(os.getppid(), signal.SIGKILL)", "pass")
    (tmp_path / "mine.py").write_text(harmless.replace("time.sleep(60)", f"return {{'y': len({'x' * size!r})}}"))
    data = carry(load("scenarios", f"{tmp_path}/mine.py:SCENARIO"))
    (tmp_path / "mine.py").unlink()
    spec = ScenarioSpec("deadly", carried=data)
    work = [Job(k, {"a": k / 10}, k) for k in range(10)]
    with DaskExecutor(spec, cluster.scheduler_address, 1) as executor:
        rows = by_index(executor.run(work))
    assert rows == by_index(SerialExecutor(spec).run(work))
    assert rows[0].metrics == {"y": float(size)}


def test_drivers_that_are_killed_leave_no_process_and_no_folder():
    """Neither dask's processes nor those below them."""
    script = Path(__file__).resolve().parents[1] / "benchmarks" / "faults.py"
    done = subprocess.run(
        [sys.executable, script, "--kills", "2", "--only", "dask", "--seed", "4"],
        capture_output=True, text=True, timeout=300, check=True,
    )  # fmt: skip
    names, _, row = ([cell.strip() for cell in line.strip("|").split("|")] for line in done.stdout.splitlines()[-3:])
    found = dict(zip(names, row, strict=True))
    assert (found["processes left"], found["files left"], found["wrong"]) == ("0", "0", "none"), row
    assert int(found["ended"]) == int(found["equal"]) > 0, row


def test_a_worker_that_is_killed_costs_nothing(cluster: Any, analytic: Path):
    spec = ScenarioSpec("analytic.py:AWKWARD", str(analytic.parent))
    with DaskExecutor(spec, cluster.scheduler_address, 1) as executor:
        outcomes = executor.run(jobs(40, lambda k: 0.05))
        first = next(outcomes)
        os.kill(next(iter(cluster.workers.values())).pid, signal.SIGKILL)
        rows = by_index(iter([first, *outcomes]))
    assert sorted(rows) == list(range(40))
    assert {o.status for o in rows.values()} == {Status.OK}


def test_a_run_that_kills_dask_workers_is_crashed_and_its_neighbours_are_not(cluster: Any, tmp_path: Path):
    (tmp_path / "deadly.py").write_text(DEADLY)
    with DaskExecutor(ScenarioSpec("deadly.py:SCENARIO", str(tmp_path)), cluster.scheduler_address, 1) as executor:
        rows = by_index(executor.run([Job(k, {"a": 0.05 if k == 3 else 0.5}, k) for k in range(16)]))
    assert [k for k, o in sorted(rows.items()) if o.status != Status.OK] == [3]
    assert (rows[3].status, rows[3].reason) == (Status.CRASHED, "the dask worker died, also when this run was tried again alone")
    assert len(rows) == 16


@pytest.mark.sumo
def test_a_campaign_on_dask_is_the_serial_one(cluster: Any, rows: Callable[..., Any], campaign: Callable[..., Any]):
    keys = {"budget": 12, "initial": 6, "batch": 6}
    one = campaign("one", **keys)
    many = campaign("many", **keys, executor={"kind": "dask", "address": cluster.scheduler_address})
    assert rows(many["store"]) == rows(one["store"])
    cut_in = ScenarioSpec("cut_in")
    work = [Job(k, {"d_v": 10.0 * k, "d_t": 1.0}, run_seed(1, k)) for k in range(8)]
    with DaskExecutor(cut_in, cluster.scheduler_address, 1) as executor:
        assert by_index(executor.run(work)) == by_index(SerialExecutor(cut_in).run(work))


def test_workers_with_threads_are_refused(analytic: Path):
    spec = ScenarioSpec("analytic.py:SCENARIO", str(analytic.parent))
    threads = {"n_workers": 1, "threads_per_worker": 2, "processes": False, "dashboard_address": None}
    with distributed.LocalCluster(**threads, host="tcp://127.0.0.1", silence_logs="CRITICAL") as wrong:  # noqa: SIM117
        with pytest.raises(InputError, match=r"one thread \(dask worker --nthreads 1\), but tcp://.* has 2"):
            DaskExecutor(spec, wrong.scheduler_address, 1).__enter__()


def test_a_scheduler_that_does_not_answer_is_told(analytic: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("sbt.execution.dask._PATIENCE", 1)
    with pytest.raises(InputError, match=r"a dask scheduler with workers must answer at tcp://127\.0\.0\.1:9 in 1 s"):
        DaskExecutor(ScenarioSpec("analytic.py:SCENARIO", str(analytic.parent)), "tcp://127.0.0.1:9", 1).__enter__()


SLOW_TO_START = '''
import os, time
from pathlib import Path
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario


def begins():
    """One of the workers, whoever comes first, is a while in starting, and says who it is."""
    if os.getpid() != int(Path(__file__).with_name("driver").read_text()):
        try:
            with open(Path(__file__).with_name("slow"), "x") as file:
                file.write(str(os.getpid()))
        except FileExistsError:
            return
        time.sleep(600)


begins()
SCENARIO = LogicalScenario("slow", [Parameter("a", 0.0, 1.0)], Requirement("y", high=0.0), evaluate=lambda v, seed: {"y": v["a"]})
'''


def test_a_worker_that_is_lost_while_it_starts_is_not_waited_for(tmp_path: Path):
    """The driver waited for ever, beside workers with nothing to do."""
    (tmp_path / "driver").write_text(str(os.getpid()))
    (tmp_path / "slow.py").write_text(SLOW_TO_START)
    spec, found = ScenarioSpec("slow.py:SCENARIO", str(tmp_path)), []

    def drive(address: str) -> None:
        with DaskExecutor(spec, address, 1) as executor:
            found.extend(executor.run([Job(k, {"a": 0.5}, k) for k in range(8)]))

    threads = {"n_workers": 0, "threads_per_worker": 1, "memory_limit": 0, "dashboard_address": None}
    with distributed.LocalCluster(**threads, host="tcp://127.0.0.1", silence_logs="CRITICAL") as started:
        address = started.scheduler_address
        options = ["--nthreads", "1", "--no-nanny", "--no-dashboard"]
        command = [sys.executable, "-m", "distributed.cli.dask_worker", address, *options]
        workers = [subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) for _ in range(2)]
        try:
            with distributed.Client(address, set_as_default=False) as client:
                client.wait_for_workers(2, timeout=60)
            driver = threading.Thread(target=drive, args=(address,), daemon=True)
            driver.start()
            while not (tmp_path / "slow").is_file() or not (slow := (tmp_path / "slow").read_text()):
                time.sleep(0.05)
            above = {int(slow), *(process.pid for process in psutil.Process(int(slow)).parents())}
            lost = next(w for w in workers if w.pid in above)
            lost.kill()
            driver.join(60)
            assert not driver.is_alive()
        finally:
            for worker in workers:
                worker.kill()
                worker.wait()
    assert len(found) == 8


def test_an_interruption_while_the_scheduler_is_looked_for_ends_at_once(tmp_path: Path):
    """It took two minutes more, and ended with a traceback of dask."""
    silent = socket.create_server(("127.0.0.1", 0))  # answers nothing, as a port that is forwarded to nowhere
    for port in (silent.getsockname()[1], 9):
        code = f"""
from sbt.execution.dask import DaskExecutor
from sbt.execution.spec import ScenarioSpec
print("looking", flush=True)
DaskExecutor(ScenarioSpec("cut_in"), "tcp://127.0.0.1:{port}", 1).__enter__()
"""
        with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as looking:
            assert looking.stdout is not None
            assert looking.stdout.readline() == "looking\n"
            time.sleep(4.0)
            looking.send_signal(signal.SIGINT)
            begun = time.monotonic()
            try:
                _, said = looking.communicate(timeout=30)
            finally:
                looking.kill()
        assert time.monotonic() - begun < 15
        assert said.strip().endswith("KeyboardInterrupt")
        assert "Exception ignored" not in said
    silent.close()

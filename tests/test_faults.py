"""Nothing outlives a campaign, whatever ends it; and nothing ends it but a signal."""

from __future__ import annotations

import io
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from sbt import interruption
from sbt.cli import app
from sbt.cli.console import resumable
from sbt.errors import StoreError
from sbt.execution.pool import close_pool, open_pool
from sbt.execution.streams import SteadyStream
from sbt.execution.tasks import each
from sbt.processes import ProcessId, remove_abandoned, scratch
from sbt.store.database import Store

ROOT = Path(__file__).resolve().parents[1]
SBT = [sys.executable, "-m", "sbt"]
pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
TAG = "SBT_TEST_FAULTS"


def tagged(tag: str) -> list[int]:
    """Return the living processes with this tag in their environment."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            wanted = f"{TAG}={tag}".encode() in (folder / "environ").read_bytes().split(b"\0")
            if wanted and (folder / "stat").read_text().rpartition(")")[2].split()[0] != "Z":
                found.append(int(folder.name))
        except OSError:
            continue
    return found


def until(condition: Callable[[], Any], seconds: float = 60.0) -> bool:
    """Wait for what takes a second on a machine of one's own, and a minute on a crowded one."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.01)
    return True


@pytest.fixture
def temporary(tmp_path: Path) -> Path:
    """A folder for temporary files that a campaign has to itself."""
    folder = tmp_path / "tmp"
    folder.mkdir()
    return folder


@pytest.fixture
def started(temporary: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start a process as a terminal does, in a group of its own; kill what is left of it in the end."""
    running: list[subprocess.Popen[str]] = []

    def start(*command: str, **more: Any) -> subprocess.Popen[str]:
        environment = {**os.environ, TAG: str(temporary), "TMPDIR": str(temporary)}
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | more
        running.append(subprocess.Popen(command, text=True, env=environment, start_new_session=True, **pipes))
        return running[-1]

    yield start
    for process in running:
        process.kill()
        process.communicate()
    for pid in tagged(str(temporary)):
        os.kill(pid, signal.SIGKILL)


def finished(store: Path) -> int:
    """Return how many runs are in a store, which may be about to begin."""
    try:
        with Store.read(store) as found:
            return len(found.history())
    except StoreError:
        return 0


def begun(store: Path) -> bool:
    return until(lambda: (store / "campaign.sqlite").is_file()) and until(lambda: finished(store) > 0)


@pytest.mark.parametrize(
    ("number", "executor"),
    [
        (signal.SIGINT, {"kind": "local", "workers": 2}),
        pytest.param(signal.SIGHUP, {"kind": "local", "workers": 2}, marks=pytest.mark.slow),
        pytest.param(signal.SIGQUIT, {"kind": "serial"}, marks=pytest.mark.slow),
        pytest.param(signal.SIGTERM, {"kind": "local", "workers": 1}, marks=pytest.mark.slow),
    ],
    ids=["INT", "HUP", "QUIT", "TERM"],
)
def test_a_signal_is_answered_at_once_and_leaves_nothing(
    number: int, executor: dict[str, Any], configured: Callable[..., Path], started: Any, temporary: Path,
    campaign: Callable[..., dict[str, Any]], rows: Any,
):  # fmt: skip
    config = configured("c", "SLOW", budget=40_000, batch=200, campaign="coverage", executor=executor)
    driver = started(*SBT, "run", str(config), "--quiet")
    store = config.parent / "c"
    assert begun(store)
    at = time.monotonic()
    os.killpg(driver.pid, number)  # as a terminal does: to the driver and its workers
    line = driver.stderr.readline()
    assert time.monotonic() - at < 15.0, "alone on a machine it takes some milliseconds (benchmarks/faults.py)"
    name = signal.Signals(number).name
    assert line == f"stopping ({name}): run again to resume; a second signal stops at once\n"
    _, rest = driver.communicate(timeout=90)
    assert (driver.returncode, rest) == (130, "interrupted, run again to resume\n")
    assert until(lambda: not tagged(str(temporary)))
    assert list(temporary.iterdir()) == []
    assert finished(store) < 40_000
    keys = {"budget": 200 * (finished(store) // 200 + 1), "batch": 200, "campaign": "coverage"}
    assert rows(campaign("c", "SLOW", **keys)["store"]) == rows(campaign("d", "SLOW", **keys)["store"])


RUDE = """
import os, time
from pathlib import Path
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import CriticalInterval, Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
MARK = Path(__file__).parent / "running"

def deaf(values, seed):
    try:
        MARK.write_text("")
        time.sleep(60.0)
    except BaseException:
        pass
    return {"y": 1.0}

def printing(values, seed):
    print("much " * 4000)
    os.write(1, b"noise of C")
    return {"y": 1.0}

SPACE = ParameterSpace((Parameter("a", 0.0, 1.0), Parameter("b", 0.0, 1.0)))
DEAF, PRINTING = (
    LogicalScenario(f.__name__, SPACE, Requirement("y", high=0.0), evaluate=f, metric_names=("y",))
    for f in (deaf, printing)
)
"""


@pytest.fixture
def rude(analytic: Path) -> Path:
    path = analytic.parent / "rude.py"
    path.write_text(RUDE)
    return path


def test_a_run_that_catches_everything_cannot_catch_ctrl_c(configured: Callable[..., Path], rude: Path, started: Any):
    config = configured("c", scenario="SCENARIO", campaign="coverage", budget=30, batch=30)
    driver = started(*SBT, "run", str(config), "--set", "scenario=rude.py:DEAF", "--quiet")
    assert until((rude.parent / "running").exists)
    os.kill(driver.pid, signal.SIGINT)
    at = time.monotonic()
    _, told = driver.communicate(timeout=90)
    assert time.monotonic() - at < 30.0, "half of what the run would take"
    assert (driver.returncode, told.splitlines()[-1]) == (130, "interrupted, run again to resume")
    assert finished(config.parent / "c") == 0, "the run that was interrupted is no row"


def test_before_there_is_a_store_an_interruption_says_so(configured: Callable[..., Path], rude: Path, started: Any):
    rude.write_text("import time\nfrom pathlib import Path\nPath(__file__).with_name('running').touch()\ntime.sleep(600)\n")
    config = configured("c")
    driver = started(*SBT, "run", str(config), "--set", "scenario=rude.py:DEAF")
    assert until((rude.parent / "running").exists)
    os.kill(driver.pid, signal.SIGINT)
    _, told = driver.communicate(timeout=90)
    assert driver.returncode == 130
    assert told.splitlines() == [
        "stopping (SIGINT): nothing was run yet; a second signal stops at once", "interrupted, nothing was run yet",
    ]  # fmt: skip


def test_a_store_is_seen_from_where_a_run_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Loops with SUMO files run in the folder of these, whatever folder the store was named from."""
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "campaign.sqlite").touch()
    monkeypatch.chdir(tmp_path)
    with resumable() as work:
        work.folder = Path("c")
        monkeypatch.chdir("/")
        assert work.consequence() == "run again to resume"


@pytest.mark.slow
def test_ignored_signals_stay_ignored(configured: Callable[..., Path], started: Any):
    """As under nohup."""
    config = configured("c", "SLOW", campaign="coverage", budget=300, batch=300)
    driver = started("bash", "-c", f"trap '' HUP; exec {' '.join(SBT)} run {config} --quiet --json")
    assert begun(config.parent / "c")
    os.kill(driver.pid, signal.SIGHUP)
    out, _ = driver.communicate(timeout=90)
    assert (driver.returncode, json.loads(out)["runs"]) == (0, 300)


NOTEBOOK = """
import os, signal, sys, threading, time
from sbt.execution.{module} import {executor}
from sbt.execution.spec import ScenarioSpec
from sbt.problem.outcome import Job

before = signal.getsignal(signal.SIGINT)
threading.Timer(3.0, os.kill, (os.getpid(), signal.SIGINT)).start()
try:
    with {executor}(ScenarioSpec("analytic.py:SLOW", {folder!r}){more}) as executor:
        for outcome in executor.run([Job(k, {{"a": 0.5, "b": 0.5}}, k) for k in range(100_000)]):
            assert outcome.status == "ok"
except KeyboardInterrupt:
    print("interrupted")
assert signal.getsignal(signal.SIGINT) is before
again = SerialExecutor(ScenarioSpec("analytic.py:SLOW", {folder!r}))
print(len(list(again.run([Job(0, {{"a": 0.5, "b": 0.5}}, 0)]))))
"""


@pytest.mark.parametrize(("module", "executor", "more"), [("protocol", "SerialExecutor", ""), ("local", "LocalExecutor", ", 1")])
def test_the_library_is_interrupted_as_a_notebook_expects(
    module: str, executor: str, more: str, analytic: Path, started: Any, temporary: Path
):
    text = NOTEBOOK.format(module=module, executor=executor, more=more, folder=str(analytic.parent))
    script = "from sbt.execution.protocol import SerialExecutor\n" + text
    done = started(sys.executable, "-c", script)
    out, err = done.communicate(timeout=90)
    assert (done.returncode, out, err) == (0, "interrupted\n1\n", "")
    assert list(temporary.iterdir()) == []


class Finalised:
    def __del__(self) -> None:
        signal.raise_signal(signal.SIGINT)


def test_an_interruption_that_python_drops_is_raised_again(capfd: pytest.CaptureFixture[str]):
    told: list[int] = []
    before = sys.unraisablehook
    with interruption.handled(notify=lambda number: not told.append(number)):
        Finalised()  # where Python drops the exception
        with pytest.raises(KeyboardInterrupt):
            time.sleep(3.0)
        assert told == [signal.SIGINT], "the user has interrupted once"
        time.sleep(0.1)  # it is not raised a second time
    assert sys.unraisablehook is before
    assert "Traceback" not in capfd.readouterr().err


def test_a_signal_is_told_from_what_code_raises():
    with interruption.handled():
        assert not interruption.is_interruption(KeyboardInterrupt())
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert interruption.requested()
        assert interruption.is_interruption(ValueError("what the code made of it"))
        with pytest.raises(KeyboardInterrupt):
            interruption.check()
        with interruption.handled():
            assert interruption.requested(), "an inner one forgets nothing"
        kept = signal.getsignal(signal.SIGINT)
    assert not interruption.requested()
    with pytest.raises(KeyboardInterrupt):
        kept(signal.SIGINT, None)  # by code that has found it and calls it later
    assert not interruption.requested()
    assert interruption.is_interruption(KeyboardInterrupt()), "nobody knows without a handler"
    interruption.check()
    found: list[bool] = []
    thread = threading.Thread(target=lambda: found.append(interruption.is_interruption(KeyboardInterrupt())))
    thread.start()
    thread.join()
    assert found == [False]


@pytest.mark.parametrize(
    "part", [pytest.param(part, marks=pytest.mark.slow) for part in ("coverage", "merge", "bundle", "doctor", "storm")]
)
def test_what_is_killed_leaves_nothing_and_goes_on_to_the_same_rows(part: str):
    """A few kills of those that `benchmarks/faults.py` makes: of a driver, and of a command that writes."""
    done = subprocess.run(
        [sys.executable, ROOT / "benchmarks" / "faults.py", "--kills", "2", "--only", part, "--seed", "2"],
        capture_output=True, text=True, timeout=600, check=True,
    )  # fmt: skip
    names, _, row = ([cell.strip() for cell in line.strip("|").split("|")] for line in done.stdout.splitlines()[-3:])
    found = dict(zip(names, row, strict=True))
    assert (found["processes left"], found["files left"], found["wrong"]) == ("0", "0", "none"), row
    assert int(found["ended"]) == int(found["equal"]) > 0, row


DRIVER = """
import sys
from sbt.execution.local import LocalExecutor
from sbt.execution.spec import ScenarioSpec
from sbt.problem.outcome import Job

with LocalExecutor(ScenarioSpec("analytic.py:AWKWARD", sys.argv[1]), 2) as executor:
    for outcome in executor.run([Job(k, {"a": 0.05, "b": 0.5}, k) for k in range(1000)]):
        print(outcome.index, flush=True)
"""


@pytest.mark.parametrize("moment", [0.0, 0.2])
def test_a_driver_that_dies_while_its_workers_start_leaves_none(moment: float, analytic: Path, started: Any, temporary: Path):
    driver = started(sys.executable, "-c", DRIVER, str(analytic.parent))

    def starting() -> bool:
        found = (Path(f"/proc/{pid}/cmdline") for pid in tagged(str(temporary)))
        return any("popen_loky_posix" in path.read_text(errors="replace") for path in found if path.exists())

    assert until(starting)
    time.sleep(moment)
    driver.kill()
    assert until(lambda: not tagged(str(temporary)))


def test_a_worker_that_lets_no_other_code_run_ends_with_its_driver(analytic: Path, started: Any, temporary: Path):
    """As a hanging step of SUMO: the interpreter's lock is held, so that no thread of the worker can look for the driver."""
    (analytic.parent / "holding.py").write_text(
        analytic.read_text() + "\n\ndef hold(values, seed):\n    import ctypes\n    print('holding\\n', end='', flush=True)\n"
        "    ctypes.PyDLL(None).sleep(600)\n\n\nAWKWARD = scenario(hold)\n"
    )
    driver = started(sys.executable, "-c", DRIVER.replace("analytic", "holding"), str(analytic.parent))
    assert driver.stdout.readline() == "holding\n"
    driver.kill()
    assert until(lambda: not tagged(str(temporary)))


STRAYING = """

def stray(values, seed):
    import os, sys, tempfile
    folder = tempfile.mkdtemp()
    os.chdir(folder)
    sys.setrecursionlimit(150)
    os.rmdir(folder)
    if os.fork() == 0 and values["a"] > 0.5:
        raise SystemExit(3)
    return {"y": values["a"], "noise": 0.0}

STRAY = scenario(stray)
"""


@pytest.mark.parametrize("kind", [pytest.param("serial", marks=pytest.mark.slow), "local"])
def test_a_run_that_forks_and_leaves_its_folder_changes_nothing(
    kind: str, analytic: Path, configured: Callable[..., Path], started: Any, temporary: Path
):
    """The child that it forked would otherwise go on as a second driver of the same store."""
    (analytic.parent / "straying.py").write_text(analytic.read_text() + STRAYING)
    executor = {"kind": kind} | ({"workers": 1} if kind == "local" else {})
    config = configured("c", campaign="coverage", budget=6, initial=3, batch=3, executor=executor)
    changes = ("--set", "scenario=straying.py:STRAY", "--set", "store=c", "--set", "metamodel=null")
    driver = started(*SBT, "run", config.name, "--json", *changes, cwd=config.parent)
    out, err = driver.communicate(timeout=120)
    assert out, err
    assert (driver.returncode, json.loads(out)["ok"], err) == (0, 6, ""), err
    assert (config.parent / "c" / "report.html").is_file()
    assert until(lambda: not tagged(str(temporary)))


def test_tasks_end_with_their_driver(analytic: Path, started: Any, temporary: Path):
    script = "import time\nfrom sbt.execution.tasks import each\nfor _ in each(time.sleep, [60.0, 60.0], 2): pass\n"
    driver = started(sys.executable, "-c", script)
    assert until(lambda: len(tagged(str(temporary))) >= 3)
    driver.kill()
    assert until(lambda: not tagged(str(temporary)))


def test_a_pool_is_closed_at_any_moment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """loky's thread must not meet tasks that were dropped when the workers were killed."""
    raised: list[Any] = []
    monkeypatch.setattr(threading, "excepthook", raised.append)
    for moment in (0, 3, 5, 20):
        pool = open_pool(1, str(tmp_path))
        tasks = [pool.submit(time.sleep, 0.0002) for _ in range(300)]
        tasks[moment].result()
        close_pool(pool)
    assert not raised


def raising(item: int) -> int:
    if item == 1:
        sys.exit("over")
    if item == 2:
        os._exit(3)
    return item


def test_a_task_may_raise_anything():
    assert [error and str(error).partition(" (")[0] for _, error in each(raising, [0, 1], 1)] == [None, "SystemExit: over"]


@pytest.mark.sumo
@pytest.mark.parametrize("kind", ["local", pytest.param("serial", marks=pytest.mark.slow)])
def test_a_campaign_leaves_no_temporary_folder(kind: str, started: Any, configured: Callable[..., Path], temporary: Path):
    executor = {"kind": kind} | ({"workers": 2} if kind == "local" else {})
    config = configured("c", campaign="coverage", budget=20, batch=20, executor=executor)
    driver = started(*SBT, "run", str(config), "--json", "--set", "scenario=cut_in")
    out, err = driver.communicate(timeout=90)
    assert (driver.returncode, json.loads(out)["ok"]) == (0, 20), err
    assert list(temporary.iterdir()) == []


def test_folders_of_processes_that_have_ended_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.delenv("SBT_SCRATCH", raising=False)
    with scratch("test") as own:
        name = Path(own).name
        own_id, dead = ProcessId.current(), subprocess.Popen(["true"])
        dead.wait()
        assert f"-{own_id.pid}-{own_id.start}-" in name
        of_dead = name.replace(f"-{own_id.pid}-", f"-{dead.pid}-")
        of_earlier = name.replace(f"-{own_id.start}-", f"-{own_id.start - 1}-")  # the identifier was used again
        elsewhere = re.sub(r"-\w{8}-", "-00000000-", of_dead, count=1)  # on another machine, in another container
        for folder in (of_dead, of_earlier, elsewhere, "sbt-notes", "other"):
            (tmp_path / folder / "sub").mkdir(parents=True)
        written = tmp_path / f".report.html{name.removeprefix('sbt-test')}.part"  # half a file, of a process that was killed
        for own_file in (written, Path(str(written).replace(f"-{own_id.pid}-", f"-{dead.pid}-"))):
            own_file.touch()
        remove_abandoned(tmp_path)
        assert {path.name for path in tmp_path.iterdir()} == {name, written.name, elsewhere, "sbt-notes", "other"}
        with scratch("merge", tmp_path) as hidden:
            assert Path(hidden).name.startswith(".merge-")
        monkeypatch.setenv("SBT_SCRATCH", own)
        with scratch("inner") as inner:
            assert Path(inner).parent == Path(own)
    assert not Path(own).exists()


def test_a_process_is_known_by_its_identifier_and_its_start():
    own = ProcessId.current()
    assert own.alive
    assert not ProcessId(own.pid, own.start - 1).alive
    zombie = subprocess.Popen(["true"])
    assert until(lambda: not ProcessId(zombie.pid, 0).alive or Path(f"/proc/{zombie.pid}/stat").read_text().split()[2] == "Z")
    fields = Path(f"/proc/{zombie.pid}/stat").read_text().rpartition(")")[2].split()
    assert not ProcessId(zombie.pid, int(fields[19])).alive
    zombie.wait()


@pytest.mark.parametrize(
    ("kind", "ending"),
    [
        pytest.param("serial", "2>&-", marks=pytest.mark.slow), pytest.param("serial", ">&-", marks=pytest.mark.slow),
        pytest.param("serial", "2>&1 >/dev/null | head -1", marks=pytest.mark.slow), ("serial", ">&- 2>&- <&-"),
        pytest.param("local", "2>&-", marks=pytest.mark.slow), ("local", "2>&1 | head -1"),
    ],
)  # fmt: skip
def test_closed_streams_end_nothing(
    kind: str, ending: str, configured: Callable[..., Path], rude: Path, started: Any, rows: Any
):
    """Although every run prints a lot."""
    executor = {"kind": kind} | ({"workers": 1} if kind == "local" else {})
    config = configured("c", campaign="coverage", budget=20, batch=10, executor=executor)
    command = f"set -o pipefail; {' '.join(SBT)} run {config} --set scenario=rude.py:PRINTING {ending}"
    done = started("bash", "-c", command)
    done.communicate(timeout=90)
    found = rows(config.parent / "c")["runs"]
    assert [row.status for row in found] == ["ok"] * 20
    assert done.returncode == 0
    assert (config.parent / "c" / "report.html").is_file()


def test_a_full_disk_is_an_error_for_results_and_none_for_progress():
    if not Path("/dev/full").exists():
        pytest.skip("needs /dev/full")
    with Path("/dev/full").open("w") as full:
        result = SteadyStream(full)
        result.write("x")
        with pytest.raises(OSError, match="No space"):
            result.flush()
        progress = SteadyStream(full, any_error=True)
        progress.flush()
        progress.write("y")
        progress.flush()
        assert progress.gone


@pytest.mark.parametrize(
    ("encoding", "errors", "name"),
    [("ascii", "strict", b"\\udcff"), ("ascii", "surrogateescape", b"\xff"), ("utf-8", "surrogateescape", b"\xff")],
)
def test_a_stream_of_fewer_characters_gets_escapes(encoding: str, errors: str, name: bytes):
    """A terminal in ASCII ended a finished campaign with an internal error; with errors as in the locale POSIX it still did."""
    inner = io.TextIOWrapper(io.BytesIO(), encoding=encoding, errors=errors)
    stream = SteadyStream(inner)
    stream.write("TTC \u2264 1 s \ud800 \udcff")
    stream.flush()
    at_most = "\u2264".encode(encoding, "backslashreplace")
    assert inner.buffer.getvalue() == b"TTC " + at_most + b" 1 s \\ud800 " + name


@pytest.mark.parametrize("ending", [[], ["--json"]])
def test_a_full_disk_behind_stdout_is_said_in_words(ending: list[str]):
    if not Path("/dev/full").exists():
        pytest.skip("needs /dev/full")
    with Path("/dev/full").open("w") as full:
        done = subprocess.run([*SBT, "list", *ending], stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr.strip()) == (1, "the output must be written, but it cannot be: No space left on device")


def test_check_tells_what_code_raises(rude: Path):
    text = rude.read_text().replace("    try:\n", "    import sys\n    sys.exit('no')\n    try:\n", 1)
    rude.write_text(text)
    done = CliRunner().invoke(app, ["check", f"{rude}:DEAF"])
    assert done.exit_code == 2
    assert "gave no metric; at a=0.5, b=0.5: failed: SystemExit: no (" in done.stdout
    done = CliRunner().invoke(app, ["simulate", f"{rude}:DEAF"])
    assert (done.exit_code, "failed: SystemExit: no (" in done.stdout) == (4, True)
    other = rude.with_name("exits.py")
    other.write_text("import sys\n\nsys.exit()\n")
    done = CliRunner().invoke(app, ["simulate", f"{other}:DEAF"])
    assert (done.exit_code, done.stdout) == (2, "")
    assert done.stderr == f"plug-in file {other}:3 raised on import: SystemExit\n"

"""Processes that are disturbed: started, killed at moments spread over their life, and looked for afterwards."""

from __future__ import annotations

import dataclasses
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import sbt
from sbt.seeds import stream
from sbt.store.database import Store
from sbt.store.history import PLANNED

TAG = "SBT_FAULTS_TAG"
WAIT = 5.0
"""Seconds after which nothing of a killed process may run."""
ANSWER = 20.0
"""Seconds within which a signal must have ended a driver; it answers at once, and a crowded machine takes its time."""
WAYS = ("KILL", "TERM", "HUP", "QUIT", "INT", "ALL", "PIPE")
"""Signals to the driver, `ALL`: SIGKILL to it and all its workers at once, `PIPE`: nobody reads its output any more."""
DISTURBING = '''
import os, signal, sys, time
from pathlib import Path
import sbt

STARTED = Path(__file__).with_name("started")
with STARTED.open("a") as file:
    file.write(f"{os.getpid()}\\n")

def slow(values, seed):
    """A run of 20 ms."""
    time.sleep(0.02)
    return {"y": values["a"] - values["b"]}

def branches(values, seed):
    """A run of 40 ms; the four branches of Schueremans and Van Gemert (2005), critical with probability 2e-3."""
    time.sleep(0.04)
    a, b, root = values["a"], values["b"], 2 ** 0.5
    bent = 3 + 0.1 * (a - b) ** 2
    return {"y": min(bent - (a + b) / root, bent + (a + b) / root, a - b + 7 / root, b - a + 7 / root)}

def deadly(values, seed):
    """Half of the runs kill their worker."""
    if values["a"] < 0.5:
        os.kill(os.getpid(), signal.SIGKILL)
    return slow(values, seed)

def scenario(name, evaluate):
    inputs = [sbt.Parameter("a", 0, 1), sbt.Parameter("b", 0, 1)]
    return sbt.Scenario(name, inputs, sbt.Requirement("y", high=-0.5), evaluate=evaluate, metric_names=("y",))

NORMAL = [sbt.Parameter(name, -8, 8, "", sbt.Normal(0, 1)) for name in "ab"]
BRANCHES = sbt.Scenario("branches", NORMAL, sbt.Requirement("y", high=0.0), evaluate=branches, metric_names=("y",))
SLOW, DEADLY = scenario("slow", slow), scenario("deadly", deadly)
'''
"""Runs that take time, and runs that kill; the file notes the processes that load it."""


@dataclass
class Found:
    """What disturbances were made, and what came of them.

    Attributes:
        kills: disturbances, by where the campaign was.
        wholes: times that the work was done to its end.
        equal: of these, with what there would have been without disturbance.
        processes, files: left over.
        wrong: what must not be, in words.
    """

    kills: dict[str, int] = field(default_factory=dict)
    wholes: int = 0
    equal: int = 0
    processes: int = 0
    files: int = 0
    wrong: list[str] = field(default_factory=list)

    def leftover(self, names: set[str]) -> None:
        """Count files that ought not to be there, and name a few."""
        self.files += len(names)
        self.wrong += [f"left: {', '.join(sorted(names)[:3])}"] if names else []

    def row(self, what: str, seed: int) -> dict[str, Any]:
        """Return a row of the table."""
        where, times = ", ".join(f"{n} {name}" for name, n in self.kills.items()), sum(self.kills.values())
        return {
            "disturbed": what, "seed": seed, "times": times, "of these": where, "ended": self.wholes, "equal": self.equal,
            "processes left": self.processes, "files left": self.files, "wrong": "; ".join(dict.fromkeys(self.wrong)) or "none",
        }  # fmt: skip


@dataclass(frozen=True)
class Place:
    """A folder for disturbed work: what is started here is known by a variable of its environment, and has its own TMPDIR."""

    folder: Path
    tag: str = field(default_factory=lambda: uuid.uuid4().hex)

    @property
    def temporary(self) -> Path:
        """Where temporary files go."""
        path = self.folder / "tmp"
        path.mkdir(exist_ok=True)
        return path

    def start(self, *words: object, **more: Any) -> subprocess.Popen[bytes]:
        """Start `sumo-sbt WORDS`; its output goes to a pipe."""
        environment = {**os.environ, TAG: self.tag, "TMPDIR": str(self.temporary), "PYTHONUNBUFFERED": "1"}
        command = [sys.executable, "-m", "sbt", *map(str, words)]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT} | more
        return subprocess.Popen(command, env=environment, cwd=self.folder, **pipes)

    def alone(self, *words: object) -> float:
        """Do work undisturbed, and return the seconds of it; it must succeed."""
        begin = time.monotonic()
        process = self.start(*words)
        output, _ = process.communicate()
        if process.returncode:
            raise RuntimeError(f"sumo-sbt {' '.join(map(str, words))} must succeed, but: {output.decode()}")
        return time.monotonic() - begin

    def living(self) -> list[int]:
        """Return the processes that were started here and what they started."""
        found = []
        for path in Path("/proc").glob("[0-9]*"):
            try:
                wanted = f"{TAG}={self.tag}".encode() in (path / "environ").read_bytes().split(b"\0")
                running = (path / "stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
            except OSError:
                continue
            if wanted and running:
                found.append(int(path.name))
        return found

    def workers(self) -> list[int]:
        """Return the worker processes, those that wait for runs or make them."""
        found = []
        for pid in self.living():
            try:
                command = Path(f"/proc/{pid}/cmdline").read_bytes()
            except OSError:
                continue
            if b"popen_loky_posix" in command:
                found.append(pid)
        return found

    def left(self) -> int:
        """Return how many processes still live some seconds later, after killing them."""
        deadline = time.monotonic() + WAIT
        while (found := self.living()) and time.monotonic() < deadline:
            time.sleep(0.02)
        for pid in found:
            os.kill(pid, signal.SIGKILL)
        return len(found)


@contextmanager
def place() -> Iterator[Place]:
    """Return a place for as long as it is needed."""
    with tempfile.TemporaryDirectory(prefix="faults-") as name:
        yield Place(Path(name))


def moments(n: int, life: float, seed: int, what: str) -> list[float]:
    """Return n moments (s), one in each n-th of a life, in random order."""
    rng = stream(seed, f"moments of {what}")
    return [float(t) for t in rng.permutation((np.arange(n) + rng.random(n)) / n * life)]


def disturb(there: Place, process: subprocess.Popen[bytes], moment: float, way: str) -> tuple[bool, str]:
    """Let a process run until the moment and disturb it; return whether it was still there, and what it printed.

    Where nobody reads its output any more, it is waited for: it must go on.
    """
    deadline, printed, pipe = time.monotonic() + moment, b"", process.stdout
    if pipe is None:
        raise ValueError("a process must have a pipe")
    while (left := deadline - time.monotonic()) > 0:
        ready, _, _ = select.select([pipe], [], [], left)
        if ready and not (part := os.read(pipe.fileno(), 1 << 16)):
            break
        printed += part if ready else b""
    if process.poll() is not None or left > 0:
        process.wait()
        return False, printed.decode(errors="replace")
    if way == "PIPE":
        pipe.close()
        process.wait()
        return True, printed.decode(errors="replace")
    if way == "ALL":
        for pid in (process.pid, *there.living()):
            _kill(pid, signal.SIGKILL)
    else:
        _kill(process.pid, signal.Signals[f"SIG{way}"])
    try:
        rest, _ = process.communicate(timeout=ANSWER)
    except subprocess.TimeoutExpired:
        process.kill()
        return True, f"{printed.decode(errors='replace')}Traceback: no answer to {way}"
    return True, (printed + rest).decode(errors="replace")


def _kill(pid: int, number: int) -> None:
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return


def stage_of(store: Path) -> str:
    """Return where a campaign was: before its first run, with runs planned, between batches, or after the last run."""
    try:
        if not Store.begun(store):
            return "start-up"
        with Store.read(store) as found:
            counts = found.counts
            if found.conclusion is not None:
                return "report"
            if not sum(counts.values()):
                return "start-up"
            return "runs" if counts.get(PLANNED, 0) else "choice"
    except sbt.SbtError as error:
        return f"unreadable ({error})"


def content(store: Path) -> Any:
    """Return what a store must hold, however it came about."""
    with Store.read(store) as found:
        rows = [dataclasses.replace(record, seconds=0.0) for record in found.history().records]
        conclusion = (found.conclusion or {}).get("conclusion")
        return rows, found.iterations(), conclusion


def names_in(folder: Path) -> set[str]:
    """Return what lies in a folder, all below it."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def configured(there: Place, name: str, executor: dict[str, Any], **keys: Any) -> Path:
    """Write a configuration whose store is beside it, and return its path."""
    path = there.folder / f"{name}.yaml"
    path.write_text(json.dumps({**keys, "executor": executor, "store": str(there.folder / name)}))
    return path


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return rows of equal keys as a table."""
    lines = [list(rows[0]), ["---"] * len(rows[0]), *([str(value) for value in row.values()] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)

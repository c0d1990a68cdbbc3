"""Worker processes on this machine: spawned by loky, kept alive, one libsumo each, one thread each.

When a worker dies, loky gives up its whole pool, so recovery is implemented here. Every worker records the
indices of its current runs in a file. After a death the pool is restarted and these runs are repeated alone; a
run that kills its worker again is `crashed`, all others are unaffected. A run that hangs inside SUMO cannot be
stopped from within (the step holds the interpreter's lock), so the driver kills that process. Runs that share a
simulation are suspects together and are repeated one by one. The scenario is sent to each worker once, through
a file; a task holds jobs only.
"""

from __future__ import annotations

import gc
import os
import pickle
import resource
import signal
import struct
import tempfile
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import suppress
from enum import Enum, auto
from functools import cache, partial
from pathlib import Path
from typing import Any, Self

from sbt.errors import InputError, SbtError
from sbt.execution.pool import broken, close_pool, how_ended, open_pool
from sbt.execution.protocol import chunk_of
from sbt.execution.spec import ScenarioSpec
from sbt.execution.starting import start_apart
from sbt.execution.streams import open_missing
from sbt.execution.worker import prepare, run_at_levels
from sbt.plugins import LoadedAnew, contents_read
from sbt.problem.outcome import Job, Outcome, Status
from sbt.problem.scenario import LogicalScenario
from sbt.processes import scratch

__all__ = ["LocalExecutor", "settle"]

_MARK = struct.Struct("<dq")
"""Header of a worker's record: time stamp, number of run indices that follow."""
_TARGET = 0.05
"""Target duration of a chunk of runs (s)."""
_TICK = 0.25
"""Interval at which overdue runs are looked for (s)."""
_TOO_LARGE = ("MemoryError", "bad_alloc", "std::bad_alloc")
"""How the reason of a run begins that was refused memory."""
_GRACE = 2.0
"""Time by which a run may exceed its limit before its worker is killed (s): most runs stop themselves."""
_MARKS = "marks"
_SCENARIO = "scenario.pickle"
_LIMIT, _LARGE = "memory", "large-"
"""Files of the driver's folder: the memory that a worker may use (bytes, 0: no limit), and which runs wanted more."""


class _Cause(Enum):
    """Why a run has no outcome."""

    DIED = auto()
    LATE = auto()
    LARGE = auto()
    UNREADABLE = auto()


class LocalExecutor:
    """Runs in `workers` processes.

    Args:
        spec: the scenario; workers resolve it themselves.
        workers: number of processes.
        timeout: wall-clock seconds a run may take; None: no limit.
        memory: bytes that a worker may use; None: no limit. A run that needs more, also alone in a fresh worker, is crashed.
        recycle: number of runs after which a worker is replaced by a fresh one; None: never.
    """

    apart = True

    def __init__(
        self, spec: ScenarioSpec, workers: int, timeout: float | None = None, memory: int | None = None,
        recycle: int | None = None,
    ):  # fmt: skip
        self._spec, self._workers, self._timeout = spec, workers, timeout
        self._memory, self._recycle = memory, recycle
        self._started = 0  # runs since the workers were
        self._pool: Any = None
        self._processes: Mapping[int, Any] = {}  # of the pool
        self._ended: Mapping[int, str] = {}  # how that of a run did which was at work when the last pool broke
        self._files: Mapping[str, str] = {}  # as the first workers read them
        self._scratch: tempfile.TemporaryDirectory[str] | None = None
        self._seconds = _TARGET

    def __enter__(self) -> Self:
        """Start the workers and let them load the scenario."""
        open_missing()
        self._scratch = scratch("pool")
        folder = Path(self._scratch.name)
        (folder / _SCENARIO).write_bytes(pickle.dumps((self._spec, self._timeout)))
        (folder / _LIMIT).write_text(str(self._memory or 0))
        (folder / _MARKS).mkdir()
        try:
            self._start()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the workers."""
        self._stop()
        if self._scratch is not None:
            self._scratch.cleanup()

    def _start(self) -> None:
        self._pool, self._started = open_pool(self._workers, self._folder), 0
        ready = start_apart(self._prepare_all)  # an interruption between start and entry would leave a process to itself
        self._processes = dict(self._pool._processes)
        wait(ready)
        for future in ready:
            if not isinstance(future.exception(), broken()):
                self._compare(future.result())

    def _compare(self, files: Mapping[str, str]) -> None:
        """Refuse a worker that has read other files than the first ones have."""
        self._files = self._files or files
        changed = ", ".join(sorted(path for path, was in self._files.items() if files.get(path, was) != was))
        if changed:
            rule = "new workers must load the code and files of the scenario that the campaign began with"
            raise InputError(f"{rule}, but changed: {changed}; put it back and run again, or choose another store")

    def _prepare_all(self) -> list[Future[Mapping[str, str]]]:
        return [self._pool.submit(_prepare, self._folder, self._workers) for _ in range(self._workers)]

    def _stop(self) -> None:
        if self._pool is not None:
            close_pool(self._pool)
            self._pool = None

    @property
    def _folder(self) -> str:
        if self._scratch is None:
            raise RuntimeError("an executor must be entered before it runs: with executor: ...")
        return self._scratch.name

    def run(self, jobs: Sequence[Job]) -> Iterator[Outcome]:
        """Yield one outcome a job as they finish."""
        for outcomes in self.groups(deque(jobs)):
            yield from outcomes

    def groups(self, queue: deque[Job]) -> Iterator[list[Outcome]]:
        """Yield the outcomes as they come, those of a task together; an empty list every quarter of a second without any."""
        suspects: deque[Job] = deque()
        while queue or suspects:
            alone = bool(suspects)
            missing, dead = yield from self._drain(deque([suspects.popleft()]) if alone else queue)
            if not alone:
                queue.clear()  # what was not started is among the missing
            for job in missing:
                if job.index in dead and (alone or dead[job.index] is _Cause.LATE):
                    yield [self._lost(job, dead[job.index])]
                elif job.index in dead or alone:
                    suspects.append(job)
                else:
                    queue.append(job)

    def _lost(self, job: Job, cause: _Cause) -> Outcome:
        if cause is _Cause.LATE:
            reason = f"a run must take at most {self._timeout:g} s: its process was stopped"
            return Outcome(job.index, Status.TIMEOUT, {}, reason, level=job.level)
        what = f"the worker process died{self._ended.get(job.index, '')}"
        if cause is _Cause.UNREADABLE:
            what = "the worker process could not hand over what it ran, as code of a run changed what it needs for that"
        if cause is _Cause.LARGE:
            what = f"a worker may use {(self._memory or 0) / 2**20:.0f} MiB of memory: its process was stopped"
        return Outcome(job.index, Status.CRASHED, {}, f"{what}, also when this run was tried again alone", level=job.level)

    def _drain(self, queue: deque[Job]) -> Any:
        """Run the queued jobs; return those without an outcome after a worker died, and the runs that were in progress."""
        submitted: dict[Future[Any], list[Job]] = {}
        stopped: dict[int, _Cause] = {}
        died, looked = False, time.monotonic()
        while (queue or submitted) and not died:
            if self._worn and not submitted:
                self._restart()
            while queue and len(submitted) < 2 * self._workers and not died and not self._worn:
                chunk = chunk_of(queue, _TARGET / max(self._seconds, 1e-4), self._workers)
                try:
                    submitted[self._pool.submit(_run_chunk, self._folder, chunk)] = chunk
                    self._started += len(chunk)
                except broken():
                    queue.extendleft(reversed(chunk))
                    died = True
            done, _ = wait(submitted, timeout=_TICK, return_when=FIRST_COMPLETED)
            for future in done:
                error = future.exception()
                if error is not None and not isinstance(error, SbtError):
                    died = True  # or a run broke its modules: the next ones need a process that is whole
                    unreadable = () if isinstance(error, broken()) else submitted[future]
                    stopped |= {job.index: _Cause.UNREADABLE for job in unreadable}
                    continue
                del submitted[future]
                yield self._measured(future.result())
            if not done:
                yield []
            if not done or time.monotonic() - looked > _TICK:
                looked = time.monotonic()
                stopped |= self._kill_overdue() | self._kill_large()
        if not died:
            return [], {}
        yield from self._rescued(submitted)
        missing = [job for chunk in submitted.values() for job in chunk] + list(queue)
        at = {index: self._processes.get(pid) for runs, pid, _ in self._at_work() for index in runs}
        dead = dict.fromkeys(at, _Cause.DIED) | stopped
        dead |= {index: _Cause.LARGE for index in dead if Path(self._folder, f"{_LARGE}{index}").exists()}
        self._restart()
        self._ended = {index: how_ended(process) for index, process in at.items()}
        return missing, dead

    def _rescued(self, submitted: dict[Future[Any], list[Job]]) -> Iterator[list[Outcome]]:
        """Yield the outcomes that had arrived before the pool broke."""
        wait(submitted, timeout=5.0)
        for future in [f for f in submitted if f.done() and not f.cancelled() and f.exception() is None]:
            del submitted[future]
            yield self._measured(future.result())

    def _measured(self, outcomes: list[Outcome]) -> list[Outcome]:
        """Update the mean duration of a run; return the outcomes."""
        mean = sum(o.seconds for o in outcomes) / len(outcomes)
        self._seconds += 0.3 * (mean - self._seconds)
        return outcomes

    def _at_work(self) -> list[tuple[tuple[int, ...], int, float]]:
        """Return (run indices, process, time stamp on the monotonic clock) of every worker with runs in progress."""
        found = []
        for path in Path(self._folder, _MARKS).iterdir():
            data = path.read_bytes()
            if len(data) >= _MARK.size:
                since, n = _MARK.unpack_from(data)
                if n and len(data) >= _MARK.size + 8 * n:
                    found.append((struct.unpack_from(f"<{n}q", data, _MARK.size), int(path.name), since))
        return found

    @property
    def _worn(self) -> bool:
        """Whether the workers have made so many runs that they are to be replaced."""
        return self._recycle is not None and self._started >= self._recycle * self._workers

    def _kill_large(self) -> dict[int, _Cause]:
        """Kill the workers that use more memory than they may; return the runs that they were at, which are tried again."""
        if self._memory is None:
            return {}
        large = [(runs, pid) for runs, pid, _ in self._at_work() if _resident(pid) > self._memory]
        for _, pid in large:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        return {run: _Cause.LARGE for runs, _ in large for run in runs}

    def _kill_overdue(self) -> dict[int, _Cause]:
        """Kill the workers whose record is older than a run may take; return the runs that timed out."""
        if self._timeout is None:
            return {}
        late = [(runs, pid) for runs, pid, since in self._at_work() if time.monotonic() - since > self._timeout + _GRACE]
        for _, pid in late:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        return {runs[0]: _Cause.LATE for runs, _ in late if len(runs) == 1}  # of several: repeated alone

    def _restart(self) -> None:
        self._stop()
        for path in Path(self._folder, _MARKS).iterdir():
            path.unlink()
        self._start()


@cache
def _mark_file(folder: str) -> int:
    """Open the record of this worker, once."""
    return os.open(Path(folder, _MARKS, str(os.getpid())), os.O_CREAT | os.O_WRONLY)


def _mark(folder: str, runs: Sequence[int]) -> None:
    """Record the current runs of this worker and the time."""
    os.pwrite(_mark_file(folder), _MARK.pack(time.monotonic(), len(runs)) + struct.pack(f"<{len(runs)}q", *runs), 0)


def settle() -> None:
    """Make garbage collection rare: what is loaded now is permanent, and runs create hardly any cycles."""
    gc.freeze()
    gc.set_threshold(20_000)


@cache
def _scenario(folder: str, level: int = 0) -> LogicalScenario:
    """Return the scenario that the driver wrote for its workers, at a level of fidelity."""
    spec, timeout = pickle.loads(Path(folder, _SCENARIO).read_bytes())
    with _loaded_anew(folder).collected():
        scenario: LogicalScenario = spec.at_level(level).resolve()
        prepare(scenario)
    return scenario.limited(timeout)


def _prepare(folder: str, workers: int) -> Mapping[str, str]:
    """Load the scenario in a worker, and wait until every worker does; return what is in the files that it read."""
    _scenario(folder)
    settle()
    _limit_memory(folder)
    _mark(folder, ())
    marks, deadline = Path(folder, _MARKS), time.monotonic() + 20.0
    while len(os.listdir(marks)) < workers and time.monotonic() < deadline:  # noqa: PTH208  (fast)
        time.sleep(0.005)
    return contents_read()


@cache
def _loaded_anew(folder: str) -> LoadedAnew:
    """Return the files that the runs of this worker load anew."""
    del folder
    return LoadedAnew()


def _run_chunk(folder: str, jobs: list[Job]) -> list[Outcome]:
    """Run jobs in a worker and record which are in progress."""
    outcomes = run_at_levels(partial(_scenario, folder), jobs, partial(_mark, folder))
    _loaded_anew(folder).check()
    for outcome in outcomes if _limit(folder) else ():
        if outcome.reason.startswith(_TOO_LARGE):  # what earlier runs left may be to blame: tried again alone, as after a death
            _mark(folder, (outcome.index,))
            Path(folder, f"{_LARGE}{outcome.index}").touch()
            os._exit(1)
    return outcomes


@cache
def _limit(folder: str) -> int:
    """Return the memory that a worker may use (bytes); 0: no limit."""
    return int(Path(folder, _LIMIT).read_text())


def _limit_memory(folder: str) -> None:
    """Let the kernel refuse a worker more than its memory beyond what it has loaded: one request may be for all there is."""
    if limit := _limit(folder):
        with suppress(OSError, ValueError):
            loaded = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_DATA, (loaded + limit, resource.getrlimit(resource.RLIMIT_DATA)[1]))


def _resident(pid: int) -> int:
    """Return the memory that a process has in use (bytes); 0 where it has ended or the system does not tell."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * resource.getpagesize()
    except (OSError, ValueError, IndexError):
        return 0

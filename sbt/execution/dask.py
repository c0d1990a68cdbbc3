"""Workers of a dask cluster, on this machine or elsewhere: each runs its jobs in a process of its own.

A dask worker hands its jobs to a `LocalExecutor` of one process, so that libsumo has a process to
itself, and a run that hangs or kills its process is treated as on one machine. dask only handles the loss
of a whole worker (a lost node, the end of its allocation): its jobs are run on another one, and are repeated alone
if several workers died while running them.
"""

from __future__ import annotations

import multiprocessing
import platform
import tempfile
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError, Future
from importlib.util import find_spec
from typing import Any, Self

from sbt.errors import InputError, SbtError
from sbt.execution.local import LocalExecutor
from sbt.execution.protocol import chunk_of
from sbt.execution.spec import ScenarioSpec
from sbt.execution.starting import start_apart
from sbt.execution.streams import open_missing
from sbt.execution.worker import versions
from sbt.problem.outcome import Job, Outcome, Status
from sbt.processes import SCRATCH, scratch

__all__ = ["DaskExecutor"]

_TARGET = 0.5
"""Target duration of a chunk of runs (s): a dask task costs milliseconds."""
_GRACE = 5
"""Longest wait for the client to close (s)."""
_LOOK = 1.0
"""Time after which it is looked whether a worker that starts is still there (s)."""
_PATIENCE = 60
"""Longest wait for the scheduler and its first worker (s)."""
_LARGE = 100_000
"""Size from which a carried scenario is sent to each worker once instead of with every chunk (bytes)."""

_Limits = tuple[float | None, int | None, int | None]
"""Of a worker: time of a run (s), memory (bytes), runs."""


class DaskExecutor:
    """Runs on the workers of a dask cluster; workers may come and go.

    Args:
        spec: the scenario; workers resolve it themselves, so its files must be where they are here.
        address: of the scheduler, `tcp://host:port`; None: a cluster on this machine for as long as it is needed.
        workers: number of workers where there is no address.
        timeout, memory, recycle: limits of every worker, as of `LocalExecutor`.

    Raises:
        InputError: dask.distributed is not installed, or (when entered) the scheduler does not answer, or a
            worker has several threads or other versions than this process.
        SbtError: the scheduler is gone; what is done is done, and the campaign can be resumed.
    """

    apart = True

    def __init__(
        self, spec: ScenarioSpec, address: str | None, workers: int, timeout: float | None = None, memory: int | None = None,
        recycle: int | None = None,
    ):  # fmt: skip
        if find_spec("distributed") is None:
            raise InputError("executor.kind dask needs dask.distributed: pip install 'sumo-sbt[dask]', or choose local")
        self._spec, self._address, self._count = spec, address, workers
        self._limits: _Limits = (timeout, memory, recycle)
        self._cluster: Any = None
        self._client: Any = None
        self._scratch: tempfile.TemporaryDirectory[str] | None = None
        self._sent: Any = spec
        self._seconds = _TARGET

    def __enter__(self) -> Self:
        """Connect, check the workers, and let them load the scenario."""
        open_missing()
        try:
            if self._address is None:
                self._scratch = scratch("dask")
                self._cluster = start_apart(self._own_cluster, abandon=lambda cluster: cluster.close())
            self._client = self._connected()
            self._client.wait_for_workers(1, timeout=_PATIENCE)
            self._prepare()
            if len(self._spec.carried) > _LARGE:
                self._sent = self._client.submit(_same, self._spec, pure=False)
        except (OSError, TimeoutError) as error:
            self.__exit__()
            raise InputError(f"a dask scheduler with workers must answer at {self._address} in {_PATIENCE} s: {error}") from None
        except BaseException:
            self.__exit__()
            raise
        return self

    def _connected(self) -> Any:
        """Return a client; connect in a thread, since one that is interrupted while it does takes minutes to close."""
        from distributed import Client

        found: Future[Any] = Future()

        def connect() -> None:
            try:
                found.set_result(Client(self._address or self._cluster, timeout=_PATIENCE, set_as_default=False))
            except BaseException as error:  # raised again where it is waited for
                found.set_exception(error)

        threading.Thread(target=connect, name="sbt-dask-connect", daemon=True).start()
        try:
            return found.result()
        except BaseException:
            found.add_done_callback(lambda late: late.exception() is not None or late.result().close(timeout=_GRACE))
            raise

    def _own_cluster(self) -> Any:
        """Start workers on this machine, whose temporary folders lie in ours."""
        import dask
        from distributed import LocalCluster

        folder = self._scratch.name if self._scratch is not None else None
        with dask.config.set({"temporary-directory": folder}):
            return LocalCluster(
                n_workers=self._count, threads_per_worker=1, processes=True, memory_limit=0, dashboard_address=None,
                silence_logs="CRITICAL", env={SCRATCH: folder, "PYTHONWARNINGS": "ignore:resource_tracker"},
            )  # fmt: skip

    def __exit__(self, *_: object) -> None:
        """Free the workers, and stop those that were started here."""
        if self._client is not None:
            if self._cluster is None and self._client.status == "running":
                self._free()
            self._client.close(timeout=_GRACE)
        if self._cluster is not None:
            self._cluster.close()
        self._client = self._cluster = None
        if self._scratch is not None:
            self._scratch.cleanup()

    def _free(self) -> None:
        """Stop the process below every worker, after its current task."""
        from distributed import fire_and_forget

        for worker in self._client.nthreads():
            fire_and_forget(self._client.submit(_end, self._spec, self._limits, workers=[worker], pure=False))

    def _prepare(self) -> None:
        """Start the processes below all workers at the same time; do not wait for one that leaves meanwhile."""
        own = _versions(self._spec)
        found = {w: self._client.submit(_begin, self._spec, self._limits, workers=[w], pure=False) for w in self._workers()}
        for worker, future in found.items():
            of_worker = self._begun(worker, future)
            if of_worker not in (None, own):
                raise InputError(f"every worker must have the versions of this process ({own}), but {worker} has {of_worker}")

    def _begun(self, worker: str, future: Any) -> str | None:
        """Return the versions of a worker whose process is started; None: it has left since."""
        from distributed import KilledWorker

        while True:
            try:
                return str(self._result(future, _LOOK))
            except KilledWorker:
                return None
            except TimeoutError:
                if future.done():
                    raise
            if worker not in self._workers():  # dask keeps what only this worker may do, until one comes at its address
                future.cancel()
                return None

    def _workers(self) -> list[str]:
        """Return the addresses of the present workers."""
        try:
            threads: dict[str, int] = self._client.nthreads()
        except OSError as error:  # the client has tried to connect again by now
            raise self._lost() from error
        for worker, n in threads.items():
            if n != 1:
                raise InputError(f"every worker must have one thread (dask worker --nthreads 1), but {worker} has {n}")
        return list(threads)

    def run(self, jobs: Sequence[Job]) -> Iterator[Outcome]:
        """Yield one outcome a job as they finish."""
        for outcomes in self.groups(deque(jobs)):
            yield from outcomes

    def groups(self, queue: deque[Job]) -> Iterator[list[Outcome]]:
        """Yield the outcomes as they come, those of a task together."""
        while queue:
            suspects = yield from self._drain(queue)
            for job in suspects:
                if (yield from self._drain(deque([job]))):
                    reason = "the dask worker died, also when this run was tried again alone"
                    yield [Outcome(job.index, Status.CRASHED, {}, reason, level=job.level)]

    def _drain(self, queue: deque[Job]) -> Any:
        """Run the queued jobs; return those whose workers died."""
        from distributed import KilledWorker, as_completed

        submitted: dict[Any, list[Job]] = {}
        finished = as_completed(loop=self._client.loop)
        suspects: list[Job] = []
        while queue or submitted:
            workers = max(len(self._workers()), 1)
            while queue and len(submitted) < 2 * workers:
                chunk = chunk_of(queue, _TARGET / self._seconds, workers)
                future = self._client.submit(_run, self._sent, chunk, self._limits, pure=False)
                submitted[future] = chunk
                finished.add(future)
            future = next(finished)
            chunk = submitted.pop(future)
            try:
                outcomes = self._result(future)
            except KilledWorker:
                suspects += chunk
                continue
            for outcome in outcomes:
                self._seconds += 0.1 * (max(outcome.seconds, 1e-4) - self._seconds)
            yield outcomes
        return suspects

    def _result(self, future: Any, patience: float | None = None) -> Any:
        try:
            return future.result(patience)
        except CancelledError as error:
            raise self._lost() from error

    def _lost(self) -> SbtError:
        where = self._address or "the one on this machine"
        return SbtError(f"the dask scheduler must stay until the end, but {where} is gone; run again to resume")


_held: list[tuple[ScenarioSpec, _Limits, LocalExecutor]] = []
"""In a worker: its executor, at most one."""


def _executor_of(spec: ScenarioSpec, limits: _Limits) -> LocalExecutor:
    """Return this worker's executor; that of another campaign is stopped first."""
    if not (_held and _held[0][:2] == (spec, limits)):
        _drop()
        multiprocessing.current_process().daemon = False  # dask's workers are daemons, which may have no children
        executor = LocalExecutor(spec, 1, *limits)
        executor.__enter__()
        _held.append((spec, limits, executor))
    return _held[0][2]


def _drop() -> None:
    while _held:
        _held.pop()[2].__exit__()


def _begin(spec: ScenarioSpec, limits: _Limits) -> str:
    """Start a worker's process, and return the versions that it has."""
    _executor_of(spec, limits)
    return _versions(spec)


def _versions(spec: ScenarioSpec) -> str:
    """Return what must be the same in all processes; code that is carried depends on Python's version too."""
    python = ".".join(platform.python_version_tuple()[:2])
    return f"{versions()}, Python {python}" if spec.carried else versions()


def _same(spec: ScenarioSpec) -> ScenarioSpec:
    """Be the task whose result is the scenario: dask makes it again where a worker with it is lost."""
    return spec


def _run(spec: ScenarioSpec, jobs: list[Job], limits: _Limits) -> list[Outcome]:
    """Run jobs in a worker."""
    return list(_executor_of(spec, limits).run(jobs))


def _end(spec: ScenarioSpec, limits: _Limits) -> None:
    """End a worker's process, unless another campaign has taken the worker over."""
    if _held and _held[0][:2] == (spec, limits):
        _drop()

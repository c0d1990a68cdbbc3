"""loky's processes, started by the one thread that lives as long as this process (`sbt.execution.starting`)."""

from __future__ import annotations

import os
import signal
from typing import Any

from joblib.externals.loky.backend.context import LokyContext
from joblib.externals.loky.backend.popen_loky_posix import Popen
from joblib.externals.loky.backend.process import LokyProcess

from sbt.execution.starting import start_apart

__all__ = ["Context", "WorkerProcess"]


class WorkerProcess(LokyProcess):  # type: ignore[misc]  # loky has no types
    """A process that loky starts, but from another thread."""

    @staticmethod
    def _Popen(process_obj: Any) -> Any:  # noqa: N802  (the name in multiprocessing)
        return start_apart(lambda: Popen(process_obj), abandon=lambda started: os.kill(started.pid, signal.SIGKILL))


class Context(LokyContext):  # type: ignore[misc]
    """loky's way to make processes and queues."""

    Process = WorkerProcess

"""Which process this is, whether another one still lives, and temporary folders that say whose they are.

A process identifier is used again after its process has ended; with the time at which the process was
started it is unique. Temporary folders carry both in their names, so that what a killed process could not
remove is removed by the next one.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import shutil
import signal
import socket
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

__all__ = ["SCRATCH", "ProcessId", "exit_words", "machine", "own_name", "remove_abandoned", "scratch"]

SCRATCH = "SBT_SCRATCH"
"""Variable of the environment: the folder in which a worker makes its temporary folders; its driver removes it."""


@dataclass(frozen=True)
class ProcessId:
    """A process of this machine.

    Args:
        pid: the identifier.
        start: when it was started, in clock ticks since the machine was; 0 where the system does not tell.
    """

    pid: int
    start: int

    @classmethod
    def current(cls) -> ProcessId:
        """Return this process."""
        return cls(os.getpid(), _start(os.getpid()) or 0)

    @property
    def alive(self) -> bool:
        """Whether it still runs; one that has ended and only waits for its parent does not."""
        if self.start:
            return _start(self.pid) == self.start
        try:
            os.kill(self.pid, 0)
        except ProcessLookupError:
            return False
        except PermissionError:
            pass
        return True


def exit_words(code: int) -> str:
    """Return how a process ended, by its exit code; a negative one is that of a signal.

    >>> exit_words(-11), exit_words(3)
    ('signal SIGSEGV', 'exit code 3')
    """
    if code >= 0:
        return f"exit code {code}"
    known = {int(one): one.name for one in signal.Signals}
    return f"signal {known.get(-code, -code)}"


def _start(pid: int) -> int | None:
    """Return when a process was started (clock ticks), None where it has ended or the system does not tell."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] in "ZX" else int(fields[19])


@cache
def machine() -> str:
    """Return a name of the space in which process identifiers count: machine, its last start, container."""
    parts = [socket.gethostname()]
    with suppress(OSError):
        parts.append(Path("/proc/sys/kernel/random/boot_id").read_text())
    with suppress(OSError):
        parts.append(str(Path("/proc/self/ns/pid").readlink()))
    return hashlib.blake2b("\n".join(parts).encode(), digest_size=4).hexdigest()


def own_name(beginning: str) -> str:
    """Return a name for a temporary file or folder that says whose it is: `BEGINNING-MACHINE-PID-START-...`."""
    own = ProcessId.current()
    return f"{beginning}-{machine()}-{own.pid}-{own.start}-{secrets.token_hex(4)}"


def scratch(kind: str, folder: Path | None = None) -> tempfile.TemporaryDirectory[str]:
    """Make a temporary folder of this process: `sbt-KIND-MACHINE-PID-START-...`, or inside that of a worker's driver.

    The first call in a process removes the folders of processes that have ended.

    Args:
        kind: what it is for, small letters.
        folder: where it shall be, then hidden, after what ended processes left there is removed; None: that of the system
            for temporary files.
    """
    if folder is not None:
        remove_abandoned(folder)
        prefix = f"{own_name(f'.{kind}')}-"
        return tempfile.TemporaryDirectory(prefix=prefix, dir=folder, ignore_cleanup_errors=True)
    outer = os.environ.get(SCRATCH)
    if outer is not None and Path(outer).is_dir():
        return tempfile.TemporaryDirectory(prefix=f"{kind}-", dir=outer, ignore_cleanup_errors=True)
    _remove_once(os.getpid(), tempfile.gettempdir())
    return tempfile.TemporaryDirectory(prefix=f"{own_name(f'sbt-{kind}')}-", ignore_cleanup_errors=True)


@cache
def _remove_once(pid: int, folder: str) -> None:
    remove_abandoned(Path(folder))


def remove_abandoned(folder: Path) -> None:
    """Remove the temporary files and folders of this user's processes on this machine that have ended."""
    pattern = re.compile(rf"(?:sbt-[a-z]+|\..+)-{machine()}-(\d+)-(\d+)-[-\w]+(?:\.part)?")
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            match = pattern.fullmatch(entry.name)
            with suppress(OSError):
                if match is None or entry.stat(follow_symlinks=False).st_uid != os.getuid():
                    continue
                if ProcessId(int(match[1]), int(match[2])).alive:
                    continue
                if entry.is_dir(follow_symlinks=False):
                    shutil.rmtree(entry.path, ignore_errors=True)
                else:
                    Path(entry.path).unlink()

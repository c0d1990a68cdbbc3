"""The campaigns below some folders: which there are, how far they are, and the processes that work for them."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from sbt.errors import InputError, SbtError
from sbt.problem.plain import Json
from sbt.workflows.live import LiveCampaign, first_look
from sbt.workflows.status import read_status, writer_of

__all__ = ["Campaigns", "key_of"]

_DEPTH = 4
"""Folders are searched so deep below those that were named."""
_FOUND_AGAIN = 5.0
"""Seconds for which a search is good."""
_FILM_SECONDS = 120.0
_PATIENCE = 0.5
"""Seconds that a list waits for the count of a large store."""


def key_of(folder: Path) -> str:
    """Return the name of a campaign in addresses: it tells nothing of the machine's folders, and is the same every time."""
    return hashlib.blake2b(str(folder.resolve()).encode(), digest_size=6).hexdigest()


def _stores_below(folder: Path, depth: int) -> Iterator[Path]:
    """Yield the folders with a campaign, in the order of their names; hidden ones and links are left out."""
    if (folder / "campaign.sqlite").is_file():
        yield folder
    if depth == 0:
        return
    try:
        inner = sorted(entry.path for entry in os.scandir(folder) if entry.is_dir(follow_symlinks=False))
    except OSError:
        return
    for path in inner:
        if not Path(path).name.startswith("."):
            yield from _stores_below(Path(path), depth - 1)


@dataclass
class _Watched:
    """A campaign with its own thread for reading, as a connection belongs to one; and how many runs it had when."""

    folder: Path
    reader: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(1))
    live: LiveCampaign | None = None
    counted: tuple[int, int | None] = (-1, None)  # of so many runs so many are critical
    seen: tuple[float, int, float | None] = (0.0, -1, None)  # when, runs then, runs a second before

    def opened(self) -> LiveCampaign:
        """Return the store, opened by the thread that reads."""
        if self.live is None:
            self.live = LiveCampaign(self.folder)
        return self.live


class Campaigns:
    """All campaigns below some folders.

    Args:
        folders: searched a few levels deep; new campaigns appear by themselves.
        trusted: the user approves the code that the stores name: films and resuming run it.

    Raises:
        InputError: a folder is not there.
    """

    def __init__(self, folders: Sequence[Path], *, trusted: bool = False):
        """Search the folders."""
        for folder in folders:
            if not folder.is_dir():
                raise InputError(f"serve shows the campaigns below folders, but there is none at '{folder}'")
        self.folders, self._trusted = tuple(folders), trusted
        self._watched: dict[str, _Watched] = {}
        self._searched, self._lock = -_FOUND_AGAIN, threading.Lock()
        self._filming, self._ready = threading.Semaphore(2), False
        self._resumed: dict[str, subprocess.Popen[bytes]] = {}

    def close(self) -> None:
        """Let go of all stores; campaigns go on."""
        for watched in self._watched.values():
            watched.reader.shutdown(wait=False, cancel_futures=True)

    def _known(self) -> dict[str, _Watched]:
        with self._lock:
            if time.monotonic() - self._searched > _FOUND_AGAIN:
                found = {key_of(store): store for folder in self.folders for store in _stores_below(folder, _DEPTH)}
                self._watched = {key: self._watched.get(key) or _Watched(store) for key, store in found.items()}
                self._searched = time.monotonic()
            return dict(self._watched)

    def __getitem__(self, key: str) -> _Watched:
        """Return a campaign.

        Raises:
            InputError: there is none with this key.
        """
        known = self._known()
        if key not in known:
            raise InputError(f"no campaign is shown under '{key[:40]}'")
        return known[key]

    def listed(self) -> list[Json]:
        """Return the campaigns, running ones first, then the newest."""
        rows = []
        for key in self._known():
            with suppress(InputError):  # its folder has gone meanwhile
                rows.append(self.status(key))
        rows.sort(key=lambda row: (row["state"] != "running", -row["changed"]))
        if rows and not self._ready:
            self._ready = True  # what a first look imports is there when one is asked for
            threading.Thread(target=_look, args=(self[rows[0]["key"]].folder,), daemon=True).start()
        return rows

    def status(self, key: str) -> Json:
        """Return how far a campaign is, as `status --json` prints it, with `key`, `name` and `changed`; or its `error`."""
        watched = self[key]
        folder = watched.folder
        plain = {"key": key, "name": self._name(folder), "changed": _changed(folder)}
        try:
            found = {**read_status(folder), "error": ""}
        except SbtError as error:
            return {**plain, "state": "damaged", "error": str(error), "runs": {}, "done": 0, "budget": None, "conclusion": None}
        found.pop("store")
        told = {"critical": self._critical(watched, found), "report": (folder / "report.html").is_file()}
        return {**found, **told, **plain, **_pace(watched, found)}

    def _name(self, folder: Path) -> str:
        """Return where a campaign lies, from the folder that was named."""
        for root in self.folders:
            if folder == root or root in folder.parents:
                return str(folder.relative_to(root.parent)) if folder != root else (folder.name or str(folder.resolve().name))
        return folder.name

    def explorer(self, key: str, *, first: bool = False) -> Json:
        """Return what the explorer shows: of all runs, or first of some of them, which takes no time however many there are.

        Raises:
            StoreError: the store is damaged.
        """
        watched = self[key]
        if first:
            return first_look(watched.folder)
        return watched.reader.submit(lambda: watched.opened().explorer()).result()

    def _critical(self, watched: _Watched, found: Json) -> int | None:
        """Return how many runs are critical: as concluded, or counted anew where there are more."""
        if found["state"] == "finished":
            return int(found["conclusion"]["critical"])
        if watched.counted[0] != found["done"]:
            try:
                watched.counted = int(found["done"]), watched.reader.submit(lambda: watched.opened().critical()).result(_PATIENCE)
            except TimeoutError:
                return None  # a large store is still being read; the next look will know
            except SbtError:
                return None
        return watched.counted[1]

    def page(self, key: str) -> Path | None:
        """Return the report of a campaign, None where there is none yet; a link leads out of its folder, and is none."""
        path = self[key].folder / "report.html"
        return path if path.is_file() and not path.is_symlink() else None

    def film(self, key: str, run: int) -> Json:
        """Execute a run in a process of its own and return its film, or why there is none."""
        with self._filming:
            try:
                done = subprocess.run(
                    [sys.executable, "-m", "sbt.serve.task", "film", str(self[key].folder), str(run)],
                    env=self._environment(), capture_output=True, timeout=_FILM_SECONDS, check=False,
                )  # fmt: skip
            except subprocess.TimeoutExpired:
                return {"film": None, "lanes": [], "note": f"The film was not ready within {_FILM_SECONDS:.0f} s."}
        if done.returncode != 0:
            lines = done.stderr.decode(errors="replace").strip().splitlines() or [f"it ended with {done.returncode}"]
            return {"film": None, "lanes": [], "note": f"No film: {lines[-1][:500]}"}
        return dict(json.loads(done.stdout))

    def stop(self, key: str) -> str:
        """Ask the process of a campaign to end in order, as Ctrl-C does; return what was done.

        Raises:
            InputError: no process of this machine works for it, or it heeds no signal.
        """
        writer = writer_of(self[key].folder)
        if writer is None or not writer.alive:
            raise InputError("only a campaign that runs on this machine can be stopped")
        os.kill(writer.pid, _heeded(writer.pid))
        return "stopping after the runs that are under way; resume goes on from there"

    def resume(self, key: str) -> str:
        """Let a campaign go on in a process of its own, which outlives the server; return what was done.

        Raises:
            InputError: it runs already, or was resumed and is about to.
        """
        folder = self[key].folder
        writer = writer_of(folder)
        if writer is not None and writer.alive is not False:
            raise InputError("only a campaign that does not run can be resumed")
        with self._lock, (folder / "serve.log").open("ab") as log:
            self._resumed = {known: process for known, process in self._resumed.items() if process.poll() is None}
            if key in self._resumed:
                raise InputError("only a campaign that does not run can be resumed, but this one was, and is about to begin")
            self._resumed[key] = subprocess.Popen(
                [sys.executable, "-m", "sbt.serve.task", "resume", str(folder)],
                env=self._environment(), stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True,
            )  # fmt: skip
        return f"resumed; what it says is in {folder / 'serve.log'}"

    def _environment(self) -> dict[str, str]:
        own = {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "1")}
        return {**os.environ, **own, **({"SBT_TRUST": "1"} if self._trusted else {})}


def _heeded(pid: int) -> signal.Signals:
    """Return the signal that ends the campaign of a process in order: Ctrl-C's is ignored by what a script began with `&`.

    Raises:
        InputError: it heeds neither.
    """
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:  # not Linux
        return signal.SIGINT
    mask = {name: int(bits, 16) for name, _, bits in (line.partition(":\t") for line in lines) if name in ("SigIgn", "SigCgt")}
    if not mask["SigIgn"] >> (signal.SIGINT - 1) & 1:
        return signal.SIGINT
    if mask["SigCgt"] >> (signal.SIGTERM - 1) & 1:
        return signal.SIGTERM
    raise InputError(f"a campaign that is stopped must heed a signal, but its process {pid} ignores Ctrl-C and SIGTERM")


def _look(folder: Path) -> None:
    with suppress(SbtError, OSError):
        first_look(folder)


def _changed(folder: Path) -> float:
    """Return when a store was written last (s, of the epoch); who reads it leaves an empty file beside it."""
    times = [0.0]
    for name in ("campaign.sqlite", "campaign.sqlite-wal"):
        with suppress(OSError):
            found = (folder / name).stat()
            times += [found.st_mtime] if found.st_size else []
    return max(times)


def _pace(watched: _Watched, found: Json) -> Json:
    """Return the rate of a running campaign between the last two looks, and the time that remains; else what is known."""
    now, done = time.monotonic(), int(found["done"])
    when, before, rate = watched.seen
    if found["state"] != "running":
        watched.seen = (now, done, None)
        return {}
    if before >= 0 and now - when >= 1.0 and done > before:
        rate = (done - before) / (now - when)
        watched.seen = (now, done, rate)
    elif before < 0:
        watched.seen = (now, done, found["rate"])
        rate = found["rate"]
    if not rate:
        return {}
    budget = found["budget"]
    return {"rate": rate, "remaining": None if budget is None else max(budget - done, 0) / rate}

"""Warmed traffic as files: the state at the end of a warm-up, and what a run loads to go on from it.

A run loads the network, the traffic that departs later, and its own; then the state. The state has the random numbers of the
run in place of those of the warm-up: all of SUMO's generators are given states of their own, in full, as a count of draws
alone would go on from whatever a generator has drawn before. What was warmed up is the same for all runs of one warm-up.
"""

from __future__ import annotations

import contextlib
import gzip
import hashlib
import os
import re
import shutil
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path

import numpy as np

from sbt.errors import RunError
from sbt.problem.outcome import Status
from sbt.problem.plain import Values
from sbt.seeds import SEED_END, stream
from sbt.sumo.demand import excerpts, pieces_of, without_pieces
from sbt.sumo.files import Launch, SumoFiles
from sbt.sumo.forking import in_fork
from sbt.sumo.session import libsumo, scratch_folder, session
from sbt.sumo.snapshot import CAN_FORK, Snapshot, reads_whole
from sbt.sumo.template import Template, template

__all__ = ["State", "WarmedFiles", "shortened", "warmed_files"]

_SAVING = {"save-state.rng": "true", "save-state.transportables": "true", "save-state.precision": "17"}
"""Options under which a state holds all that SUMO can save; 17 digits are a double."""
_READ_UNTIL = re.compile(r'(<delay\b[^>]*\btime=")[^"]*(")')
"""Up to when SUMO has read the route files; a run drops what departs before."""
_LONG = re.compile(r"\d+\.\d{17,}(?![\deE])")
"""Numbers as SUMO saves them, with 17 decimals and some with more; the shortest text of the same number is read twice as
fast, and edges have 180 past speeds each."""
_LAST_ACTION = re.compile(r'(<vehicle\b[^>]*? state="(?:\S+ ){6})\d+')
_STOPPED = re.compile(r'(<stop\b[^>]*\bstarted="[^"/>]*"[^/>]*)/>')
_LASTS = re.compile(r"\b(duration|until|triggered|containerTriggered)=")
_WORDS = 624
"""Words of the state of a Mersenne Twister (std::mt19937)."""
_FULL = 1_000_000
"""From this number of draws on SUMO saves, and reads, a generator's whole state."""
_KEPT = 8
"""States that a process keeps as text, some MB each."""
LATER = "after.rou.xml", "run.rou.xml"
"""Route files of a run: traffic that no input changes, and its own; empty while a simulation is loaded."""
_AFTER = "after.all.xml"
_LONGEST = 3600.0
"""Wall-clock limit of a warm-up (s)."""

_SCRIPT = """# Drives the run in sumo-gui, or another program: python run.py [PROGRAM [OPTION ...]]
import os
import shutil
import sys
import tempfile

import traci

os.chdir(os.path.dirname(os.path.abspath(__file__)))
program, *options = sys.argv[1:] or ["sumo-gui"]
arguments = [{arguments}]
with tempfile.TemporaryDirectory() as folder:
    routes = [os.path.join(folder, name) for name in {later!r}]
    for route in routes:  # traffic that SUMO reads before the state makes it keep the travel times of then
        with open(route, "w") as file:
            file.write("<routes/>")
    arguments[arguments.index("--route-files") + 1] = ",".join(routes)
    traci.start([program, *arguments, *options])
    for route in routes:
        shutil.copy(os.path.basename(route), route)
    traci.simulation.loadState({state!r})
    while traci.simulation.getTime() <= {end!r}:
        traci.simulationStep()
    traci.close()
"""


_ADVICE = re.compile(r'(\blcStateBase="[^" ]*) [^"]*"')
"""In a vehicle's state, what the lane changes of others ask of its speed. In the sublane model SUMO reads with it what it has
never set (myDontBrake): the first step of a run would depend on what the process had in its memory before."""


@dataclass(frozen=True)
class State:
    """A warmed state as text, without its random numbers."""

    before: str
    generators: tuple[str, ...]
    after: str

    def write(self, seed: int, path: Path) -> Path:
        """Write the state with the random numbers of a run, and return its path."""
        draws = stream(seed, "sumo").integers(0, 2**32, size=(len(self.generators) - 1, _WORDS), dtype=np.uint32).tolist()
        words = [f'"{_FULL} {" ".join(map(str, row))} {_WORDS}"' for row in draws]
        parts = [text for pair in zip(self.generators, words, strict=False) for text in pair]
        path.write_text("".join([self.before, *parts, self.generators[-1], self.after]))
        return path


@dataclass(frozen=True)
class WarmedFiles:
    """The files of warm-ups and runs.

    Args:
        folder: where they are written.
        key: a digest of all that decides the states.
        snapshot: how the traffic is divided.
        launch: the command line of every run.
        warming: that of the warm-ups.
    """

    folder: Path
    key: str
    snapshot: Snapshot
    launch: Launch
    warming: Launch

    def blank(self) -> None:
        """Empty the route files, for a simulation to be loaded; the state of a run is loaded with those of `begin`.

        Had SUMO read a vehicle that has a device for rerouting before the state, travel times would never change again.
        """
        for name in LATER:
            _write(self.folder / name, [])

    def begin(self, values: Values, extra: tuple[Path, ...], state: Path) -> Path:
        """Write the traffic of a run, and return the state that it begins with.

        Args:
            values: of the inputs.
            extra: additional files of that run alone, with types.
            state: of the run.

        Raises:
            RunError: something departs before the warm-up is over, or a placeholder has no value.
        """
        own = [_inside(path.read_bytes()) for path in extra]
        traffic = excerpts(self.snapshot.departing(values), values, self.folder)
        after, run = (self.folder / name for name in LATER)
        after.unlink(missing_ok=True)
        try:
            after.symlink_to(_AFTER)
        except OSError:  # no right to, or a file system without links
            shutil.copyfile(self.folder / _AFTER, after)
        _write(run, [*own, *traffic])
        return state

    def begin_child(self) -> None:
        """In a child of the process that loaded the files: write nothing into its outputs."""
        for number in os.listdir("/proc/self/fd"):  # noqa: PTH208  (fast)
            with contextlib.suppress(OSError):
                if Path(f"/proc/self/fd/{number}").readlink().is_relative_to(self.folder / "outputs"):
                    nowhere = os.open(os.devnull, os.O_WRONLY)
                    os.dup2(nowhere, int(number))
                    os.close(nowhere)

    def write(self, state: Path, folder: Path, end: float) -> None:
        """Write what the run that has begun is loaded from into a folder, with a `run.py` that drives it by traci.

        A `run.sumocfg` is there too, but SUMO, given a state as an option, draws types and speeds of later traffic anew.

        Args:
            state: of the run.
            folder: to write to.
            end: simulated time at which `run.py` ends (s).
        """
        folder.mkdir(parents=True, exist_ok=True)
        for place in (self.folder / "outputs").rglob("*"):
            if place.is_dir():
                (folder / place.relative_to(self.folder)).mkdir(parents=True, exist_ok=True)
        here, there = str(self.folder), str(folder)
        words = self.launch.arguments
        for path in {Path(part) for word in words for part in word.split(",") if part.startswith(here)} | {state}:
            if path.is_file():
                (folder / path.name).write_bytes(path.read_bytes().replace(here.encode(), there.encode()))
        written = [word.replace(here, there) for word in words]
        arguments = ", ".join(repr(word.replace(f"{there}{os.sep}", "")) for word in Launch(tuple(written)).command(0))
        script = _SCRIPT.format(arguments=arguments, state=state.name, end=end, later=LATER)
        (folder / "run.py").write_text(script, encoding="utf-8")
        time = re.search(rb'<snapshot\b[^>]*? time="([^"]+)"', state.read_bytes())  # without it SUMO warns that it begins at 0
        if time is not None:
            at = written.index("--begin") if "--begin" in written else len(written)  # the user's is that of the warm-up
            written = [*written[:at], *written[at + 2 :], "--begin", time[1].decode()]
        Launch((*written, "--load-state", str(folder / state.name))).write(0, folder / "run.sumocfg")

    def state(self, number: int, states: str) -> State:
        """Return the state of a warm-up, which is made where it is not there yet.

        Args:
            number: of the warm-up, from 0 on.
            states: folder in which states are kept; "": a temporary one of this process.

        Raises:
            RunError: SUMO fails in the warm-up.
        """
        path = self.path_of(number, states)
        if not path.is_file():
            with contextlib.suppress(OSError):
                path.parent.mkdir(parents=True, exist_ok=True)
            if not os.access(path.parent, os.W_OK):  # a store that is only read
                path = self.path_of(number, "")
            self._make(number, path)
        sublane = "--lateral-resolution" in self.launch.arguments
        with contextlib.suppress(OSError, EOFError, zlib.error, UnicodeDecodeError):
            return _read(path, sublane=sublane)
        if not os.access(path.parent, os.W_OK):
            path = self.path_of(number, "")
        path.unlink(missing_ok=True)  # damaged: a warm-up is the same whenever it is made
        self._make(number, path)
        return _read(path, sublane=sublane)

    def _make(self, number: int, path: Path) -> None:
        """Make a state where no other process has made it meanwhile."""
        with _locked(path.with_suffix(".lock")):
            if not path.is_file():
                self._warm_up_apart(number, path)

    def path_of(self, number: int, states: str) -> Path:
        """Return the file of a state."""
        return (Path(states) if states else self.folder) / f"{self.key}-{number}.state.xml.gz"

    def _warm_up_apart(self, number: int, path: Path) -> None:
        """Make a state in a child of this process, where it can have one."""
        if not CAN_FORK:
            self._warm_up(number, path)
            return
        libsumo()

        def work() -> None:
            session().begin_child()
            self._warm_up(number, path)

        in_fork(work, _LONGEST, "the warm-up")

    def _warm_up(self, number: int, path: Path) -> None:
        """Simulate the traffic up to the end of the warm-up, and save its state."""
        seed = int(stream(number, "warm-up").integers(0, SEED_END))
        saved = self.folder / f"warm-{number}.xml"
        with session().run(self.warming, seed, "fresh") as sumo:
            sumo.simulationStep(self.snapshot.until)
            now = float(sumo.simulation.getTime())
            if abs(now - self.snapshot.until) > 1e-6:
                raise RunError(Status.FAILED, f"a warm-up must end at t = {self.snapshot.until:g} s, but SUMO was at {now:g} s")
            sumo.simulation.saveState(str(saved))
        text = saved.read_text(encoding="utf-8")
        saved.unlink()
        if not text.rstrip().endswith("</snapshot>"):
            raise RunError(Status.FAILED, "a warm-up must be saved whole, but its state ends before its end: is the disk full?")
        text = text[text.index("<snapshot") :]  # before it stands the time of day
        text = mended(shortened(text), self.snapshot.until, rarely="--default.action-step-length" in self.warming.arguments)
        text = _READ_UNTIL.sub(rf"\g<1>{self.snapshot.until:.3f}\g<2>", text, count=1)
        part = path.with_suffix(f".{os.getpid()}")
        try:
            part.write_bytes(gzip.compress(text.encode(), 1, mtime=0))
            part.replace(path)
        except OSError:
            part.unlink(missing_ok=True)  # half of it, as the disk is full
            raise


def mended(text: str, until: float, *, rarely: bool = False) -> str:
    """Return the text of a state with which traffic goes on as it did.

    Where vehicles act more rarely than every step (`actionStepLength`, or `rarely`: all by an option), each acts when the state
    is loaded: SUMO saves no plan, and without one a vehicle stops at the end of its lane until it acts again. A stop that is
    over, of who waits for a gap to leave its parking place, has a duration of 0: without one it waits for a person.

    Args:
        text: of a state.
        until: its time (s).
        rarely: see above.

    >>> mended('<stop parkingArea="p" started="14.0"/>', 42.0)
    '<stop parkingArea="p" started="14.0" duration="0"/>'
    """
    if rarely or "actionStepLength=" in text:
        text = _LAST_ACTION.sub(rf"\g<1>{round(1000.0 * until)}", text)
    return _STOPPED.sub(lambda stop: stop[0] if _LASTS.search(stop[0]) else f'{stop[1]} duration="0"/>', text)


def shortened(text: str) -> str:
    """Return the text of a state in which numbers of 17 or more decimals are the shortest texts of the same ones.

    >>> shortened('period="exp(0.10000000000000000555)" speed="13.88888888888888929"')
    'period="exp(0.1)" speed="13.88888888888889"'
    """
    return _LONG.sub(lambda number: repr(float(number.group())), text)


def warmed_files(files: SumoFiles, snapshot: Snapshot, step: float | None) -> WarmedFiles:
    """Write the files of warm-ups and runs to a temporary folder of this process, and return them."""
    digest = _digest(files, snapshot, step)
    folder = scratch_folder() / f"warm-{digest}"
    folder.mkdir(exist_ok=True)
    options = {**files.options, **_SAVING}
    if reads_whole(options):  # a run's files are read after its state
        del options["route-steps"]
    equipped = replace(files, options=options, routes=(), additional=())
    base = equipped.launch({}, folder, step).arguments  # begins the folder's outputs, which the files below name
    standing = []
    for k, one in enumerate(_standing(files)):
        standing.append(folder / f"{k}-{one.path.name.removesuffix('.gz')}")
        standing[-1].write_bytes(without_pieces(one, folder))
    if standing:
        base = (*base, "--additional-files", ",".join(map(str, standing)))
    known = list(excerpts(snapshot.definitions, {}, folder))
    for name, pieces in (("before.rou.xml", snapshot.before), (_AFTER, snapshot.after)):
        _write(folder / name, [*known, *excerpts(pieces, {}, folder)])
    later = ",".join(str(folder / name) for name in LATER)
    runs, warming = (Launch((*base, "--route-files", names)) for names in (later, str(folder / "before.rou.xml")))
    return WarmedFiles(folder, digest, snapshot, runs, warming)


def _digest(files: SumoFiles, snapshot: Snapshot, step: float | None) -> str:
    """Return a digest of all that decides the states: files, options, step, how traffic is divided, and version of SUMO.

    The same files are divided otherwise for another vehicle under test: what it departs with is no traffic of every run.
    """
    standing = [t for path in (*files.routes, *files.additional) for t in template(path).tree()]
    order = {one.path: k for k, one in enumerate(standing)}
    divided = [
        [(order[piece.file.path], piece.start) for piece in pieces]
        for pieces in (snapshot.definitions, snapshot.before, snapshot.after)
    ]
    told = repr((sorted(files.options.items()), step, snapshot.until, divided, version("libsumo")))
    digest = hashlib.blake2b(told.encode(), digest_size=10)
    for one in (template(files.net), *standing):
        with one.opened() as stream_of_file:
            digest.update(hashlib.blake2b(stream_of_file.read()).digest())
    return digest.hexdigest()


def _standing(files: SumoFiles) -> Iterator[Template]:
    """Yield the files with anything but traffic and what it names: stops, detectors, programs of lights."""
    for path in (*files.additional, *files.routes):
        yield from (one for one in template(path).tree() if pieces_of(one)[1])


def _inside(text: bytes) -> bytes:
    """Return what is in the root of an additional file of ours."""
    return text.removeprefix(b"<additional>").removesuffix(b"</additional>")


def _write(path: Path, elements: Iterable[bytes]) -> None:
    """Write a route file; the simulation before may still have the old one open."""
    path.unlink(missing_ok=True)
    path.write_bytes(b"<routes>\n" + b"\n".join(elements) + b"\n</routes>\n")


@lru_cache(maxsize=_KEPT)
def _read(path: Path, *, sublane: bool) -> State:
    """Read a state; kept in this process, as most runs of a worker need one of few."""
    text = gzip.decompress(path.read_bytes()).decode()
    text = _ADVICE.sub(r'\1"', text) if sublane else text
    if not text.rstrip().endswith("</snapshot>"):
        raise EOFError(f"{path} ends before its end")
    found = re.search(r"<rngState\b.*?</rngState>", text, re.DOTALL)
    if found is None:
        raise RunError(Status.FAILED, f"a warmed state must hold SUMO's generators, but {path} does not")
    tag, inner = re.split("(?<=>)", found.group(), maxsplit=1)
    pieces = [*re.split(r'(?<==)"[^"]*"', tag)]
    lanes = re.split(r'(?<=\bstate=)"[^"]*"', inner)
    generators = (*pieces[:-1], pieces[-1] + lanes[0], *lanes[1:])
    return State(text[: found.start()], generators, text[found.end() :])


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Let one process at a time make what belongs to a file; where files cannot be locked, several make the same."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        try:
            yield
        finally:
            path.unlink(missing_ok=True)

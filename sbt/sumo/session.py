"""The SUMO simulation of this process; every error of SUMO is raised as a plain `RunError`.

libsumo has one simulation per process, its exceptions cannot be pickled, and the cause of an error is
often written to file descriptor 2 only. This module handles all three. There are four isolation levels:

- `fresh`: SUMO is loaded again for every run; always valid.
- `reuse`: one simulation keeps running, actors are removed and inserted again. Bit-identical to `fresh`
  where SUMO draws no random numbers and nothing else has a state to reset (`sbt.sumo.resetting`). A run that changes more
  than its actors by calls of libsumo is the last one of its simulation.
- `replicas`: like `reuse`, in a simulation with several copies of the network and one run in each.
- `snapshot`: the simulation is loaded once, and every run is a child of this process that begins with a saved state;
  or it is loaded for every run, and the state then. Both give the same run (`sbt.sumo.warming`).
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import io
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import starmap
from pathlib import Path
from typing import Any, Protocol
from xml.sax.saxutils import quoteattr

from sbt.errors import RunError
from sbt.plugins import kept
from sbt.problem.outcome import Status
from sbt.processes import scratch
from sbt.sumo.actors import VehicleType
from sbt.sumo.formatting import format_number
from sbt.sumo.places import makes_in
from sbt.sumo.replicas import replicated_net
from sbt.sumo.resetting import changes_of

__all__ = [
    "INVALID_DOUBLE", "Loadable", "Session", "Setup", "check_options", "is_ballistic", "libsumo", "scratch_folder", "session",
    "unwrapped",
]  # fmt: skip

INVALID_DOUBLE = -1073741824.0
"""SUMO's INVALID_DOUBLE_VALUE: what its getters return for an actor that is not on the road."""

_XML_BEGIN = "_ZN11xercesc_3_216XMLPlatformUtils10InitializeEPKcS2_PNS_12PanicHandlerEPNS_13MemoryManagerE"
"""xercesc::XMLPlatformUtils::Initialize of Xerces 3.2, the locale its default."""
_DEFAULTS = {"minGap": "0", "maxSpeed": "100", "speedFactor": "1", "speedDev": "0", "sigma": "0",
             "accel": "10", "decel": "10", "emergencyDecel": "10"}  # fmt: skip
_OPTIONS = (
    "--no-step-log", "true", "--no-warnings", "true", "--xml-validation", "never",
    "--insertion-checks", "none", "--time-to-teleport", "-1", "--step-method.ballistic", "true",
    "--collision.action", "warn", "--collision.mingap-factor", "0", "--collision.check-junctions", "true",
)  # fmt: skip


@cache
def libsumo() -> Any:
    """Import libsumo once (0.8 s), without its message on standard output."""
    with contextlib.redirect_stdout(io.StringIO()):
        import libsumo as module
    return module


@cache
def _keep_xml() -> None:
    """Keep the tables of SUMO's XML reader, which it would make again in every load: half the time of a small one.

    The reader (Xerces) counts who has begun to use it, and drops them with the last; this is one that never ends. Where its
    function has another name nothing is kept.
    """
    with contextlib.suppress(OSError, AttributeError):
        begin = getattr(ctypes.CDLL(libsumo().libsumo._libsumo.__file__), _XML_BEGIN)
        begin.argtypes, begin.restype = [ctypes.c_char_p, ctypes.c_char_p, ctypes.c_void_p, ctypes.c_void_p], None
        begin(b"en_US", None, None, None)


def unwrapped(sumo: Any, domain: str, name: str) -> Any:
    """Return a function of libsumo without its Python wrapper, which takes a third of the time of a short call.

    Of any other module, such as traci, the public function is returned.
    """
    return _compiled(domain, name) if sumo is libsumo() else getattr(getattr(sumo, domain), name)


@cache
def _compiled(domain: str, name: str) -> Any:
    module = libsumo()
    return getattr(module.libsumo._libsumo, f"{domain}_{name}", None) or getattr(getattr(module, domain), name)


def is_ballistic(sumo: Any) -> bool:
    """Return whether speeds change evenly within the steps of the running simulation, and not at their begins (Euler)."""
    return bool(sumo.simulation.getOption("step-method.ballistic") == "true")


class Loadable(Protocol):
    """What a simulation is loaded from."""

    def command(self, seed: int) -> list[str]:
        """Return SUMO's arguments without the program's name."""
        ...


@dataclass(frozen=True)
class Setup:
    """What a simulation is loaded from; runs with equal setups can share a simulation.

    Args:
        net: network file.
        types: vehicle types by id.
        step_length: SUMO's step (s).
        lane_change_duration: of continuous lane changes (s); 0: instantaneous.
        options: further SUMO options, as on its command line.
        replicas: number of copies of the network, each with its own ids; 1: the network itself.
    """

    net: str
    types: tuple[tuple[str, VehicleType], ...]
    step_length: float
    lane_change_duration: float = 0.0
    options: tuple[str, ...] = ()
    replicas: int = 1

    def command(self, seed: int) -> list[str]:
        """Return SUMO's arguments without the program's name."""
        net = self.net if self.replicas == 1 else _replicas_file(self.net, self.replicas)
        return [
            "--net-file", net, "--additional-files", _types_file(self.types),
            "--step-length", format_number(self.step_length), "--lanechange.duration", format_number(self.lane_change_duration),
            "--seed", str(seed), *_OPTIONS, *self.options,
        ]  # fmt: skip


@cache
def _scratch() -> tempfile.TemporaryDirectory[str]:
    folder = scratch("sumo")
    makes_in(Path(folder.name))
    return folder


def scratch_folder() -> Path:
    """Return a temporary folder of this process, which is removed when the process ends."""
    return Path(_scratch().name)


def _types_file(types: tuple[tuple[str, VehicleType], ...]) -> str:
    """Write the vehicle types of the next load and return the file; SUMO reads it only while it loads."""
    lines = []
    for name, kind in types:
        size = {"length": format_number(kind.length), "width": format_number(kind.width)}
        attributes = {**_DEFAULTS, **size, **dict(kind.attributes)}
        lines.append(f"<vType id={quoteattr(name)} " + " ".join(starmap(_attribute, attributes.items())) + "/>")
    path = scratch_folder() / "types.add.xml"
    path.unlink(missing_ok=True)  # to truncate it would wait for the disk
    path.write_text("<additional>\n" + "\n".join(lines) + "\n</additional>\n")
    return str(path)


@lru_cache(maxsize=4096)
def _attribute(name: str, value: str) -> str:
    return f"{name}={quoteattr(value)}"


@kept
def _replicas_file(net: str, replicas: int) -> str:
    """Write the replicated network once per process and return the file."""
    path = scratch_folder() / f"{replicas}-{hashlib.blake2b(net.encode(), digest_size=8).hexdigest()}.net.xml"
    path.write_text(replicated_net(Path(net), replicas))
    return str(path)


class Session:
    """The simulation of this process; use the instance that `session()` returns."""

    def __init__(self) -> None:
        self._sumo = libsumo()
        self._changes = changes_of(self._sumo)
        self._setup: Loadable | None = None
        self._routes: set[tuple[str, ...]] = set()
        self._inserted: list[tuple[str, str]] = []
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115  (lives as long as the process)

    @contextlib.contextmanager
    def run(
        self, setup: Loadable, seed: int, isolation: str, state: Callable[[], Path] | None = None, *, reference: bool = False
    ) -> Iterator[Any]:
        """Provide libsumo with an empty simulation of this setup, for one run or for one run per replica.

        Args:
            setup: what is loaded.
            seed: of the run.
            isolation: level; all but `fresh` go on with the simulation that is there, if it is of this setup.
            state: writes what a run is loaded from, and returns what SUMO has saved; called when the setup is loaded.
            reference: keep nothing at all from one load to the next that is not there already.

        Raises:
            RunError: SUMO raised an error; the reason includes what it wrote to file descriptor 2.
        """
        if not reference:
            _keep_xml()
        loaded = False
        with self._captured():
            try:
                self._load(setup, seed, isolation)
                if state is not None:
                    self._sumo.simulation.loadState(str(state()))
                loaded = True
                self._changes.clear()
                yield self._sumo
                if self._changes:
                    self._setup = None
                if self._setup is not None:
                    self.remove()
            except BaseException as error:
                self._setup = None
                told = isinstance(error, (self._sumo.TraCIException, self._sumo.FatalTraCIError))
                reason = self._reason(error) if told else ""
                if loaded and not isinstance(error, self._sumo.FatalTraCIError):
                    self._flush()
                if told:
                    raise RunError(Status.FAILED, reason) from None
                raise

    def hold(self, setup: Loadable) -> None:
        """Load a simulation for children of this process to go on with, where it is not there yet.

        Raises:
            RunError: SUMO raised an error.
        """
        with self.run(setup, 0, "snapshot"):
            pass

    def begin_child(self) -> None:
        """In a child of this process: keep apart what SUMO writes there."""
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115  (lives as long as the process)

    def close(self) -> None:
        """End the simulation that is still loaded: only then the files that SUMO writes are complete."""
        self._setup = None
        if self._sumo.isLoaded():
            with self._captured():
                self._sumo.close()

    @contextlib.contextmanager
    def using(self, client: Any) -> Iterator[None]:
        """Use another client than libsumo for the runs in this context: traci, or an object with its interface."""
        previous, self._sumo, self._setup = self._sumo, client, None
        try:
            yield
        finally:
            self._sumo, self._setup = previous, None

    def route(self, edges: tuple[str, ...]) -> str:
        """Return the id of the route over these edges, which is added to SUMO on first use."""
        name = "route:" + ">".join(edges)
        if edges not in self._routes:
            unwrapped(self._sumo, "route", "add")(name, list(edges))
            self._routes.add(edges)
        return name

    def inserted(self, name: str, domain: str = "vehicle") -> None:
        """Register a vehicle, person or polygon that is to be removed at the end of the run."""
        self._inserted.append((domain, name))

    def remove(self, prefix: str = "") -> None:
        """Remove what was inserted; with a prefix, only objects whose names start with it."""
        for domain, name in [entry for entry in self._inserted if entry[1].startswith(prefix)]:
            unwrapped(self._sumo, domain, "remove")(name)
        self._inserted = [entry for entry in self._inserted if not entry[1].startswith(prefix)]

    def _load(self, setup: Loadable, seed: int, isolation: str) -> None:
        persistent = isolation != "fresh"
        if persistent and setup == self._setup:
            return
        command = setup.command(0 if persistent else seed)
        self._routes.clear()
        self._inserted.clear()
        if self._sumo.isLoaded():
            self._sumo.load(command)
        else:
            self._sumo.start(["sumo", *command])
        self._setup = setup if persistent else None

    def _flush(self) -> None:
        """Step once: SUMO holds pointers to actors moved since the last step, and the next load would free them."""
        with contextlib.suppress(self._sumo.TraCIException, self._sumo.FatalTraCIError):
            self._sumo.simulationStep()

    @contextlib.contextmanager
    def _captured(self) -> Iterator[None]:
        """Redirect file descriptor 2 to a temporary file while SUMO runs."""
        sys.stderr.flush()
        self._stderr.seek(0)
        self._stderr.truncate()
        saved = os.dup(2)
        os.dup2(self._stderr.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(saved, 2)
            os.close(saved)

    def ask(self, question: Callable[[Any], str]) -> str:
        """Return the answer to a question about the network that is loaded; "" while none is."""
        return question(self._sumo) if self._sumo.isLoaded() else ""

    def messages(self) -> tuple[str, ...]:
        """Return the lines that SUMO wrote to file descriptor 2 during the last run."""
        self._stderr.seek(0)
        return tuple(line.strip() for line in self._stderr.read().decode(errors="replace").splitlines() if line.strip())

    def _reason(self, error: BaseException) -> str:
        return "SUMO: " + "; ".join(dict.fromkeys([str(error).strip(), *self.messages()[-5:]]))


@kept
def session() -> Session:
    """Return the simulation of this process."""
    return Session()


def check_options(options: Sequence[str]) -> None:
    """Refuse options that this package sets itself (SUMO accepts each only once).

    Raises:
        ValueError: one of them is given.
    """
    reserved = {o for o in _OPTIONS if o.startswith("--")} | {"--net-file", "--seed", "--step-length", "--lanechange.duration"}
    for option in options:
        if option in reserved:
            raise ValueError(f"SUMO takes each option once, but {option} is set by sbt already")
        if option == "--mesosim":
            raise ValueError("SUMO's mesoscopic simulation has no positions of vehicles to measure: leave --mesosim out")

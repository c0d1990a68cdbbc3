"""The one SUMO simulation of this process, guarded: every error leaves as a plain `RunError`.

libsumo holds one simulation a process, its exceptions cannot be pickled, and the reason of an error
is often only on file descriptor 2. All of that stays in here. Three isolation levels:

- `fresh`: SUMO is loaded anew for every run; always right.
- `reuse`: one simulation lives on, actors are removed and inserted again; bit-identical to `fresh`
  where SUMO draws no random numbers and nothing else needs a reset.
- `replicas`: as `reuse`, of a simulation with several copies of the network, a run in each.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Protocol
from xml.sax.saxutils import quoteattr

from sbt.errors import RunError
from sbt.problem.outcome import Status
from sbt.processes import scratch
from sbt.sumo.actors import VehicleType
from sbt.sumo.copies import copied
from sbt.sumo.formatting import format_number

__all__ = ["ABSENT", "Loadable", "Session", "Setup", "check_options", "direct", "libsumo", "session"]

ABSENT = -1073741824.0
"""What SUMO answers for an actor that is not on the road (it does not raise)."""

_DEFAULTS = {"minGap": "0", "maxSpeed": "100", "speedFactor": "1", "speedDev": "0", "sigma": "0",
             "accel": "10", "decel": "10", "emergencyDecel": "10"}  # fmt: skip
_OPTIONS = (
    "--no-step-log", "true", "--no-warnings", "true", "--xml-validation", "never",
    "--insertion-checks", "none", "--time-to-teleport", "-1", "--step-method.ballistic", "true",
    "--collision.action", "warn", "--collision.mingap-factor", "0", "--collision.check-junctions", "true",
)  # fmt: skip


@cache
def libsumo() -> Any:
    """Import libsumo once, keeping what it prints off standard output (0.8 s)."""
    with contextlib.redirect_stdout(io.StringIO()):
        import libsumo as module
    return module


def direct(sumo: Any, domain: str, name: str) -> Any:
    """Return a libsumo function without its Python wrapper, which costs a third of a short call.

    Of a module that has no such function (traci), the public one.
    """
    return _binary(domain, name) if sumo is libsumo() else getattr(getattr(sumo, domain), name)


@cache
def _binary(domain: str, name: str) -> Any:
    module = libsumo()
    return getattr(module.libsumo._libsumo, f"{domain}_{name}", None) or getattr(getattr(module, domain), name)


class Loadable(Protocol):
    """What a simulation is loaded with."""

    def command(self, seed: int) -> list[str]:
        """Return SUMO's arguments without the program's name."""
        ...


@dataclass(frozen=True)
class Setup:
    """What a simulation is loaded with; equal setups can share one simulation.

    Args:
        net: network file.
        types: vehicle types by id.
        step_length: of SUMO (s).
        lane_change_duration: time of a continuous lane change (s), 0: at once.
        options: further SUMO options, as on its command line.
        copies: of the network, each with ids of its own; 1: the network as it is.
    """

    net: str
    types: tuple[tuple[str, VehicleType], ...]
    step_length: float
    lane_change_duration: float = 0.0
    options: tuple[str, ...] = ()
    copies: int = 1

    def command(self, seed: int) -> list[str]:
        """Return SUMO's arguments without the program's name."""
        net = self.net if self.copies == 1 else _copies_file(self.net, self.copies)
        return [
            "--net-file", net, "--additional-files", _types_file(self.types),
            "--step-length", format_number(self.step_length), "--lanechange.duration", format_number(self.lane_change_duration),
            "--seed", str(seed), *_OPTIONS, *self.options,
        ]  # fmt: skip


@cache
def _scratch() -> tempfile.TemporaryDirectory[str]:
    """Return a folder of this process that goes away with it."""
    return scratch("sumo")


def _types_file(types: tuple[tuple[str, VehicleType], ...]) -> str:
    """Write the vehicle types of the next load and return the file's name; SUMO reads it while it loads, never again."""
    lines = []
    for name, kind in types:
        size = {"length": format_number(kind.length), "width": format_number(kind.width)}
        attributes = {**_DEFAULTS, **size, **dict(kind.attributes)}
        lines.append(f"<vType id={quoteattr(name)} " + " ".join(f"{k}={quoteattr(v)}" for k, v in attributes.items()) + "/>")
    path = Path(_scratch().name) / "types.add.xml"
    path.write_text("<additional>\n" + "\n".join(lines) + "\n</additional>\n")
    return str(path)


@cache
def _copies_file(net: str, copies: int) -> str:
    """Write the copies of a network once a process and return the file's name."""
    path = Path(_scratch().name) / f"{copies}-{hashlib.blake2b(net.encode(), digest_size=8).hexdigest()}.net.xml"
    path.write_text(copied(Path(net), copies))
    return str(path)


class Session:
    """The process's simulation; use the one that `session()` returns."""

    def __init__(self) -> None:
        self._sumo = libsumo()
        self._setup: Loadable | None = None
        self._routes: set[tuple[str, ...]] = set()
        self._inside: list[tuple[str, str]] = []
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115  (lives as long as the process)

    @contextlib.contextmanager
    def run(self, setup: Loadable, seed: int, isolation: str) -> Iterator[Any]:
        """Give libsumo with an empty simulation of this setup at hand, for one run, or for one in each copy.

        Raises:
            RunError: SUMO raised; the reason carries what it wrote to file descriptor 2.
        """
        with self._captured():
            try:
                self._load(setup, seed, isolation)
                yield self._sumo
                if self._setup is not None:
                    self.remove()
            except BaseException as error:
                self._setup = None
                if isinstance(error, (self._sumo.TraCIException, self._sumo.FatalTraCIError)):
                    raise RunError(Status.FAILED, self._reason(error)) from None
                self._flush()
                raise

    @contextlib.contextmanager
    def through(self, client: Any) -> Iterator[None]:
        """Let runs go through another client than libsumo for a while: traci, or what looks like it."""
        own, self._sumo, self._setup = self._sumo, client, None
        try:
            yield
        finally:
            self._sumo, self._setup = own, None

    def route(self, edges: tuple[str, ...]) -> str:
        """Return the id of the route over these edges, known to SUMO from now on."""
        name = "route:" + ">".join(edges)
        if edges not in self._routes:
            self._sumo.route.add(name, list(edges))
            self._routes.add(edges)
        return name

    def inserted(self, name: str, domain: str = "vehicle") -> None:
        """Remember a vehicle, person or polygon that the end of the run has to remove."""
        self._inside.append((domain, name))

    def remove(self, prefix: str = "") -> None:
        """Take out what was inserted, all of it or what has names with this prefix."""
        for domain, name in [entry for entry in self._inside if entry[1].startswith(prefix)]:
            getattr(self._sumo, domain).remove(name)
        self._inside = [entry for entry in self._inside if not entry[1].startswith(prefix)]

    def _load(self, setup: Loadable, seed: int, isolation: str) -> None:
        kept = isolation != "fresh"
        if kept and setup == self._setup:
            return
        command = setup.command(0 if kept else seed)
        self._routes.clear()
        self._inside.clear()
        if self._sumo.isLoaded():
            self._sumo.load(command)
        else:
            self._sumo.start(["sumo", *command])
        self._setup = setup if kept else None

    def _flush(self) -> None:
        """Step once: SUMO keeps pointers to actors that were moved since the last step, which the next load deletes."""
        with contextlib.suppress(self._sumo.TraCIException, self._sumo.FatalTraCIError):
            self._sumo.simulationStep()

    @contextlib.contextmanager
    def _captured(self) -> Iterator[None]:
        """Send file descriptor 2 to a temporary file while SUMO runs."""
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

    def said(self) -> tuple[str, ...]:
        """Return the lines that SUMO wrote to file descriptor 2 in the last run."""
        self._stderr.seek(0)
        return tuple(line.strip() for line in self._stderr.read().decode(errors="replace").splitlines() if line.strip())

    def _reason(self, error: Exception) -> str:
        return "SUMO: " + "; ".join(dict.fromkeys([str(error).strip(), *self.said()[-5:]]))


@cache
def session() -> Session:
    """Return the simulation of this process."""
    return Session()


def check_options(options: Sequence[str]) -> None:
    """Refuse options that this package sets itself (SUMO takes each only once).

    Raises:
        ValueError: one of them is given.
    """
    own = {o for o in _OPTIONS if o.startswith("--")} | {"--net-file", "--seed", "--step-length", "--lanechange.duration"}
    for option in options:
        if option in own:
            raise ValueError(f"SUMO takes each option once, but {option} is set by sbt already")

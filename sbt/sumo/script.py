"""Runs the user's own simulation: the files as they are (door 1), or under the user's own TraCI loop (door 2).

    def simulate(sumo, values, rng):
        sumo.start(["sumo", "-c", "my.sumocfg"])
        while sumo.simulation.getMinExpectedNumber() > 0:
            sumo.simulationStep()
            ...

`sumo` is libsumo in campaigns and traci with sumo-gui to look at a run: the same code. Every
`simulationStep` is watched (`sbt.sumo.watch`), so that recording is automatic, and ends the loop when the
run is over. SUMO's seed is the run's. Where files are given, `sumo.start` has been called already.
"""

from __future__ import annotations

import contextlib
import math
import tempfile
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from sbt import interruption
from sbt.errors import InputError, RunError
from sbt.problem.outcome import Status
from sbt.problem.trace import Trace
from sbt.processes import scratch
from sbt.seeds import stream
from sbt.sumo.asked import Asked, asked_of, number_or_none
from sbt.sumo.ego import Ego
from sbt.sumo.files import Launch, SumoFiles, options_of_command
from sbt.sumo.formatting import plain, plain_values
from sbt.sumo.session import session
from sbt.sumo.watch import Over, Watch, Watching

__all__ = ["Loop", "OwnSimulation"]

Loop = Callable[[Any, Mapping[str, float], np.random.Generator], object]
"""The user's `simulate(sumo, values, rng)`."""
Opened = Callable[[Launch], AbstractContextManager[Any]]


@cache
def _scratch() -> tempfile.TemporaryDirectory[str]:
    """Return the folder of this process for filled copies; it goes away with it."""
    return scratch("own")


def just_step(sumo: Any, values: Mapping[str, float], rng: np.random.Generator) -> None:
    """Step until the run is over: the loop where the user has none."""
    while True:
        sumo.simulationStep()


@dataclass(frozen=True)
class OwnSimulation:
    """Values and seed to a `Trace`, by the user's own files and loop.

    Args:
        watching: the ego, who else is recorded, and how long.
        files: started before the loop; None: the loop calls `sumo.start` itself.
        loop: the user's; by default it only steps.
        folder: relative names in the loop start here; the loop runs in it.
        step: SUMO's step (s); None: what the files say, or 0.1.
        timeout: wall-clock seconds after which a run ends as `timeout`; None: never.

    Raises:
        InputError: a step that SUMO cannot count, or nothing to run.
    """

    watching: Watching
    files: SumoFiles | None = None
    loop: Loop = just_step
    folder: Path = Path()
    step: float | None = None
    timeout: float | None = None
    isolations: tuple[str, ...] = ("fresh",)

    def __post_init__(self) -> None:
        if self.files is None and self.loop is just_step:
            raise InputError("a simulation must have files or a loop, but has neither")
        if self.step is not None and not (self.step > 0 and round(self.step * 1000) / 1000 == self.step):
            raise InputError(f"SUMO counts time in whole milliseconds, but got step_length {self.step} s")

    @property
    def step_length(self) -> float:
        """The step that is known before a run (s), NaN where the loop decides it."""
        own = self.files.step_length() if self.files is not None else math.nan
        return self.step if self.step is not None else 0.1 if own is None else own

    def configured(
        self, ego: Mapping[str, Any] | None = None, isolation: str | None = None, step_length: float | None = None
    ) -> OwnSimulation:
        """Return a copy with another driver of the ego or step length."""
        if isolation not in (None, "auto", "fresh"):
            raise InputError(f"executor.isolation must be auto or fresh here, but got '{isolation}'")
        watching = self.watching
        if ego is not None:
            watching = replace(watching, ego=watching.ego.driven_by(Ego.of(**ego)))
        return replace(self, watching=watching, step=self.step if step_length is None else step_length)

    def prepare(self) -> None:
        """Import libsumo and read the files.

        Raises:
            InputError: a file is not what it should be.
        """
        if self.files is not None:
            self.files.templates  # noqa: B018  (reads and checks them)
        session()

    def limited(self, timeout: float | None) -> OwnSimulation:
        """Return a copy whose runs end as `timeout` after so many wall-clock seconds."""
        return replace(self, timeout=timeout)

    def __call__(self, values: Mapping[str, float], seed: int) -> Trace:
        """Run one concrete scenario in libsumo.

        Raises:
            RunError: SUMO or the loop fails, the start is not the one asked for, the ego is not there or
                leaves, or it takes too long.
        """
        return self._run(values, seed, lambda launch: session().run(launch, seed, "fresh"))

    def said(self) -> tuple[str, ...]:
        """Return what SUMO warned of in the last run of this process, each once: about the files, not about the traffic."""
        lines = (line for line in session().said() if line.startswith(("Warning:", "Error:")) and "time=" not in line)
        return tuple(dict.fromkeys(lines))

    def shown(self, values: Mapping[str, float], seed: int, traci: Any, program: Sequence[str] = ("sumo-gui",)) -> Trace:
        """Run one concrete scenario under a SUMO program of its own, such as sumo-gui, through traci.

        Args:
            values: of the inputs.
            seed: of the run.
            traci: the module.
            program: of SUMO and options of it that the run does not set, such as `("sumo-gui", "--delay", "100")`.

        Returns:
            The trace, the same as of a call.
        """
        return self._run(values, seed, lambda launch: _over_socket(traci, [*program, *launch.command(seed)]))

    def _run(self, values: Mapping[str, float], seed: int, opened: Opened) -> Trace:
        handed: Handed | None = None
        values = plain_values(values)
        try:
            with ExitStack() as stack:
                stack.enter_context(contextlib.chdir(self.folder))
                handed = Handed(self, values, seed, lambda launch: stack.enter_context(opened(launch)))
                if self.files is not None:
                    handed.begin(self.files)
                ended = handed.drive()
                return handed.watch.trace(ended)
        except RunError as error:
            raise RunError(error.status, f"{error.reason}{handed.line if handed is not None else ''}") from None


class Handed:
    """What the user's loop gets as `sumo`: SUMO's module, but for starting, stepping and closing."""

    def __init__(self, simulation: OwnSimulation, values: Mapping[str, float], seed: int, opened: Callable[[Launch], Any]):
        self._own, self._values, self._seed, self._opened = simulation, values, seed, opened
        self._module: Any = None
        self._watch: Watch | None = None
        self.simulation = _Simulation(self)
        self.vehicle, self.person = _Commanded(self, "vehicle"), _Commanded(self, "person")
        self.line = ""

    def __getattr__(self, name: str) -> Any:
        """Return what SUMO's module has of this name."""
        if self._module is None:
            raise RunError(Status.FAILED, f"sumo.start([...]) must be called before sumo.{name}, but was not")
        return getattr(self._module, name)

    @property
    def watch(self) -> Watch:
        """Who records the run."""
        if self._watch is None:
            raise RunError(Status.FAILED, "a loop must call sumo.start([...]), but it did not")
        return self._watch

    def start(self, command: Sequence[str], *_: Any, **__: Any) -> tuple[int, str]:
        """Start SUMO as `traci.start` does; the program's name, ports and labels do not matter."""
        if self._module is not None:
            raise RunError(
                Status.FAILED, "sumo.start must be called once, by the loop or (files) by the scenario, but was called again"
            )
        options = options_of_command(list(command)[1:], self._own.folder)
        self.begin(SumoFiles.of(options, self._own.folder, "sumo.start"))
        version: tuple[int, str] = self.__getattr__("getVersion")()
        return version

    def begin(self, files: SumoFiles) -> None:
        """Start SUMO with files, filled, and begin to watch."""
        own = self._own
        folder = Path(_scratch().name)
        kind = own.watching.ego.vehicle_type()
        if kind is not None:
            path = folder / "ego.add.xml"
            path.write_text(f"<additional>{kind}</additional>")
            files = replace(files, additional=(*files.additional, path))
        asked = asked_of(files, self._values, own.watching.ego.id)
        self._module = self._opened(files.launch(self._values, folder, own.step))
        self._watch = Watch(self._module, own.watching, stream(self._seed, "ego"), asked, own.timeout)

    def simulationStep(self, until: float = 0.0) -> None:  # noqa: N802  (SUMO's name)
        """Step once, or until a time (s), one step after the other."""
        while True:
            self.watch.before_step()
            self._module.simulationStep()
            self.watch.after_step()
            if self._module.simulation.getTime() >= until - 1e-9:
                return

    def close(self, *_: Any) -> None:
        """Do nothing: the run ends with the loop."""

    def drive(self) -> str:
        """Run the loop and return why it ended.

        Raises:
            RunError: the loop raised; what SUMO raises goes on as it is, to whoever started it.
        """
        try:
            self._own.loop(self, dict(self._values), stream(self._seed, "loop"))
        except Over as over:
            return over.ended
        except BaseException as error:  # SystemExit too
            self.line = _line_of(error, self._own.loop)
            if isinstance(error, RunError) or "TraCI" in type(error).__name__ or interruption.is_interruption(error):
                raise
            message = f"{type(error).__name__}: {' '.join(str(error).split())}".removesuffix(": ")
            raise RunError(Status.FAILED, message) from error
        if self._watch is not None and self._watch.over:  # the loop held it with a bare `except`
            return self._watch.over
        if self._module is not None:
            self._module.simulationStep()  # SUMO keeps pointers to what was moved since the last step, which a load deletes
        return "loop"


def _line_of(error: BaseException, loop: Loop) -> str:
    """Return the last line of the user's own file that an error came through, as ` (file:line)`."""
    file = getattr(getattr(loop, "__code__", None), "co_filename", "")
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
    return f" ({file}:{lines[-1]})" if lines and loop is not just_step else ""


class _Simulation:
    """The module's `simulation`, with a `step` that is watched."""

    def __init__(self, handed: Handed):
        self._handed = handed

    def step(self, until: float = 0.0) -> None:
        """Step once, or until a time (s)."""
        self._handed.simulationStep(until)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._handed.__getattr__("simulation"), name)


class _Commanded:
    """The module's `vehicle` or `person`: commands must be finite, and what is added starts as asked or not at all."""

    def __init__(self, handed: Handed, domain: str):
        self._handed, self._domain = handed, domain

    def __getattr__(self, name: str) -> Any:
        function = getattr(self._handed.__getattr__(self._domain), name)
        if name.startswith("get"):
            return function
        return partial(self._command, name, function)

    def _command(self, name: str, function: Any, *args: Any, **more: Any) -> Any:
        args, more = tuple(map(plain, args)), {key: plain(value) for key, value in more.items()}
        for value in (*args, *more.values()):
            if isinstance(value, float) and not math.isfinite(value):  # SUMO takes it and says nothing
                shown = ", ".join(map(repr, (*args, *more.values())))
                raise RunError(Status.FAILED, f"a loop must give finite numbers, but called sumo.{self._domain}.{name}({shown})")
        done = function(*args, **more)
        if self._domain == "vehicle" and name == "add":
            self._expect(*args, **more)
        elif self._domain == "vehicle" and name.startswith(("moveTo", "remove")) and args:
            self._handed.watch.forget(str(args[0]))
        return done

    def _expect(
        self, vehID: str, routeID: str = "", typeID: str = "", depart: Any = None, departLane: Any = "first",  # noqa: N803
        departPos: Any = "base", departSpeed: Any = "0", *_: Any, **__: Any,  # noqa: N803
    ) -> None:  # fmt: skip
        """Note what `vehicle.add` asks for; the names are SUMO's."""
        when = self._handed.simulation.getTime() if depart in (None, "now") else number_or_none(depart)
        asked = Asked("", when, *map(number_or_none, (departPos, departSpeed, departLane)))
        self._handed.watch.expect(vehID, asked)


@contextlib.contextmanager
def _over_socket(traci: Any, command: list[str]) -> Iterator[Any]:
    """Start a SUMO program, give traci connected to it, and close it."""
    try:
        traci.start(command)
        yield traci
    except (traci.exceptions.TraCIException, traci.exceptions.FatalTraCIError) as error:
        raise RunError(Status.FAILED, f"SUMO: {error}") from None
    finally:
        with contextlib.suppress(traci.exceptions.FatalTraCIError, traci.exceptions.TraCIException, KeyError):
            traci.close()

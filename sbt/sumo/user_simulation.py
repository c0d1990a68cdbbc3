"""Runs a user's own simulation: their SUMO files as they are, or their TraCI loop.

    def simulate(sumo, values, rng):
        sumo.start(["sumo", "-c", "my.sumocfg"])
        while sumo.simulation.getMinExpectedNumber() > 0:
            sumo.simulationStep()
            ...

`sumo` is a proxy of libsumo in campaigns and of traci with sumo-gui in replays; the loop is the same. Every
`simulationStep` is recorded (`sbt.sumo.recorder`) and leaves the loop when the run is over. SUMO's seed is
that of the run. Where the scenario names files, `sumo.start` has already been called.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from sbt.errors import InputError, RunError
from sbt.problem.isolation import SNAPSHOT, Isolation
from sbt.problem.outcome import Status
from sbt.problem.parameter import Parameter
from sbt.problem.plain import Values
from sbt.problem.profile import Profile
from sbt.problem.space import ParameterSpace
from sbt.problem.trace import Trace
from sbt.seeds import stream
from sbt.sumo.acting import Period, periods_of
from sbt.sumo.connecting import traci_connection
from sbt.sumo.ego import Ego
from sbt.sumo.files import SumoFiles
from sbt.sumo.forking import in_fork
from sbt.sumo.formatting import plain_values
from sbt.sumo.friction import Friction
from sbt.sumo.guided import GuidedVehicle, Participant
from sbt.sumo.junctions import told_of_junctions
from sbt.sumo.lane_lengths import told_of_lengths
from sbt.sumo.levels import levels_of
from sbt.sumo.messages import explained, refuse_dropped
from sbt.sumo.phases import Stopwatch
from sbt.sumo.recorder import RecordingSettings, RunEnded
from sbt.sumo.repeating import unrepeatable
from sbt.sumo.session import scratch_folder, session
from sbt.sumo.snapshot import CAN_FORK, NoSnapshot, Snapshot, WarmUp, snapshot_of
from sbt.sumo.traci_proxy import Loop, TraciProxy, step_until_over
from sbt.sumo.warming import WarmedFiles, warmed_files

__all__ = ["Covariates", "Loop", "TraciProxy", "UserSimulation", "step_until_over"]

WARM_UPS = 8
"""Warm-ups of a scenario that states no number, outside campaigns."""
_LONGEST_STEP, _GRACE = 1000.0, 1.0
"""Longest step, and time by which a run may exceed its limit before its process is ended (s): most runs stop themselves."""
Connect = Callable[[SumoFiles, Values], AbstractContextManager[Any]]
"""Starts SUMO with the files of a run and provides its client module: libsumo or traci."""

Covariates = Callable[[Mapping[str, Any], np.random.Generator], Mapping[str, float]]
"""Values of the inputs and the generator of the loop to named numbers, which are known before the run."""


@dataclass(frozen=True)
class UserSimulation:
    """Simulates concrete scenarios with a user's own files or loop.

    Args:
        recording: the ego, which other road users are recorded, and how long.
        files: started before the loop; None: the loop calls `sumo.start` itself.
        loop: the user's; the default only steps.
        folder: working directory of the loop, to which relative file names refer.
        step: SUMO's step (s); None: that of the files, or 0.1.
        timeout: wall-clock limit of a run (s); None: none.
        profiles: curves that inputs shape; the loop finds them among its values by name, as functions of time (s).
        participants: road users that this package moves.
        level: the isolation level that is asked for; None: snapshot where its conditions hold, else fresh.
        warm: the warm-up that is asked for; None: none.
        space: of the inputs, for the conditions of a snapshot; None: not known, and every run begins afresh.
        decided: the isolation of a campaign; None: as the conditions are.
        covariates: what a run's seed draws, before the run; it gets the generator that the loop gets. None: nothing is told.

    Raises:
        InputError: a step is not a whole number of milliseconds, or neither files nor a loop are given.
    """

    recording: RecordingSettings
    files: SumoFiles | None = None
    loop: Loop = step_until_over
    folder: Path = Path()
    step: float | None = None
    timeout: float | None = None
    isolations: tuple[str, ...] = ("fresh",)
    profiles: tuple[Profile, ...] = ()
    participants: tuple[Participant, ...] = ()
    level: str | None = None
    warm: WarmUp | None = None
    space: ParameterSpace | None = None
    decided: Isolation | None = None
    covariates: Covariates | None = None

    def __post_init__(self) -> None:
        if self.files is None and self.loop is step_until_over:
            raise InputError("a simulation must have files or a loop, but has neither")
        if self.step is not None and not (0 < self.step <= _LONGEST_STEP and round(self.step * 1000) / 1000 == self.step):
            rule = f"SUMO counts time in whole milliseconds, and a step is at most {_LONGEST_STEP:g} s"
            raise InputError(f"{rule}, but got step_length {self.step} s")

    @property
    def step_length(self) -> float:
        """The step as far as it is known before a run (s); NaN where the loop decides it."""
        of_files = self.files.step_length() if self.files is not None else math.nan
        return self.step if self.step is not None else 0.1 if of_files is None else of_files

    @property
    def periods(self) -> tuple[Period, ...]:
        """In which times drivers act, where that is not every step."""
        found = periods_of([one.driver for one in (self.recording.ego, *self.recording.further)], self.files)
        return (*found, ("the warm-up", self._divided(self.space, self.isolation.until).lasts)) if self.isolation.warm else found

    @property
    def inputs(self) -> tuple[Parameter, ...]:
        """The settings of drivers that are inputs of the scenario."""
        return self.recording.inputs

    def configured(
        self, ego: Mapping[str, Any] | None = None, isolation: str | None = None, step_length: float | None = None
    ) -> UserSimulation:
        """Return a copy with another driver of the ego or another step length."""
        if isolation not in (None, "auto", "fresh", SNAPSHOT):
            raise InputError(f"executor.isolation must be auto, fresh or snapshot here, but got '{isolation}'")
        level = self.level if isolation is None else None if isolation == "auto" else isolation
        recording = self.recording if ego is None else self.recording.with_driver(Ego.of(**ego))
        made = replace(self, recording=recording, step=self.step if step_length is None else step_length, level=level)
        if isolation == SNAPSHOT:
            made.isolation_in(made.space, WARM_UPS)  # refuses what cannot be
        return made

    def isolation_in(self, space: ParameterSpace | None, seeds: int) -> Isolation:
        """Return the isolation level for the inputs of a space; see `sbt.problem.isolation.Warmable`."""
        if self.level == "fresh":
            return Isolation(why="it is asked for")
        try:
            divided = self._divided(space)
        except NoSnapshot as error:
            if self.level == SNAPSHOT or self.warm is not None:
                asked = "warm_up" if self.warm is not None else "executor.isolation snapshot"
                raise InputError(f"{asked} needs traffic that can be warmed up apart from the inputs, but {error}") from None
            return Isolation(why=str(error))
        stated = None if self.warm is None else self.warm.seeds
        return Isolation(SNAPSHOT, divided.until, seeds if stated is None else stated)

    def isolated(self, isolation: Isolation) -> UserSimulation:
        """Return a copy that runs at this level."""
        return replace(self, decided=isolation)

    @cached_property
    def isolation(self) -> Isolation:
        """The isolation level of the runs."""
        return self.isolation_in(self.space, WARM_UPS) if self.decided is None else self.decided

    def _divided(self, space: ParameterSpace | None, until: float | None = None) -> Snapshot:
        """Return how traffic is divided between warm-ups and runs.

        Raises:
            NoSnapshot: it cannot be.
        """
        if self.files is None:
            raise NoSnapshot("a loop that calls sumo.start drives from the beginning: let the scenario name its files (sumo)")
        own_loop, asked = self.loop is not step_until_over, self.warm
        if own_loop and (asked is None or asked.until is None):
            raise NoSnapshot("a loop of one's own drives from the beginning of the simulation, unless warm_up.until says when")
        if space is None:
            raise NoSnapshot("the inputs are not known")
        guided = tuple(one.id for one in self.participants if isinstance(one, GuidedVehicle))
        if len(guided) < len(self.participants):
            raise NoSnapshot("recorded road users and friction act from the beginning of the simulation")
        if math.isnan(self.step_length):
            raise NoSnapshot("the step depends on an input")
        moved = (*(one.id for one in (self.recording.ego, *self.recording.further)), *guided)
        asked = WarmUp() if asked is None and self.level == SNAPSHOT else asked
        return snapshot_of(self.files, moved, space, self.step_length, asked, until, adding=own_loop)

    @cached_property
    def _warmed(self) -> WarmedFiles:
        """The files of warm-ups and runs.

        Raises:
            InputError: the files no longer allow the warm-up that was decided.
        """
        try:
            divided = self._divided(self.space, self.isolation.until)
        except NoSnapshot as error:
            raise InputError(f"runs must begin at t = {self.isolation.until:g} s with warmed traffic, but {error}") from None
        if self.files is None:
            raise InputError("a simulation must have files to be warmed up, but has none")
        return warmed_files(self.files, divided, self.step)

    def warmed_up(self, snapshot: int) -> bool:
        """Return whether the state of a warm-up is there."""
        return self.isolation.warm and self._warmed.path_of(snapshot, self.isolation.states).is_file()

    def warm_up(self, snapshot: int) -> None:
        """Make the state of one warm-up where it is not there yet.

        Raises:
            InputError: SUMO does not simulate the traffic; with the place in the files, where that is known.
        """
        if self.isolation.warm and self.files is not None:
            try:
                self._warmed.state(snapshot, self.isolation.states)
            except RunError as error:
                raise InputError(explained(error.reason, self.files)) from None

    def known_before(self, values: Values, seed: int) -> Mapping[str, float] | None:
        """Return what a seed draws by the user's function, at no simulation; None where there is none."""
        if self.covariates is None:
            return None
        given = plain_values(values)
        with contextlib.chdir(self.folder):
            return self.covariates({**given, **{p.name: p.curve(given) for p in self.profiles}}, stream(seed, "loop"))

    def with_friction(self, low: float, high: float) -> UserSimulation:
        """Return a copy on roads of this friction.

        Raises:
            InputError: it is a range, which is an input of the scenario file.
        """
        if low != high:
            rule = 'a range of friction must be an input of scenario.yaml (friction: "${mu}")'
            raise InputError(f"{rule}, but got simulation.friction from {low:g} to {high:g}")
        return replace(self, participants=(Friction(str(low)), *(p for p in self.participants if not isinstance(p, Friction))))

    def prepare(self) -> None:
        """Import libsumo, and read and check the files.

        Raises:
            InputError: a file is not as required.
        """
        if self.files is not None:
            self.files.templates  # noqa: B018  (reads and checks them)
        session()

    def limited(self, timeout: float | None) -> UserSimulation:
        """Return a copy with a wall-clock limit of its runs (s)."""
        return replace(self, timeout=timeout)

    def __call__(self, values: Values, seed: int) -> Trace:
        """Run one concrete scenario in libsumo.

        Raises:
            RunError: SUMO or the loop fails, traffic departs differently than requested, the ego is absent, or time is over.
        """
        return self._simulated(values, seed)[0]

    def timed(self, values: Values, seed: int) -> tuple[Trace | RunError, dict[str, float]]:
        """Return what a call gives, its error too, and the CPU seconds of each phase (`sbt.sumo.phases`)."""
        watch = Stopwatch()
        try:
            return self._simulated(values, seed)
        except RunError as error:
            watch.enter(watch.phase)
            return error, watch.seconds

    def _simulated(self, values: Values, seed: int) -> tuple[Trace, dict[str, float]]:
        """Return the trace of a run, and its CPU seconds by phase."""
        connect: Connect = partial(self._loaded, seed=seed)
        if self.isolation.warm:
            warmed, forking = self._warmed, CAN_FORK and self.isolation.forking
            start = partial(session().run, warmed.launch, 0, SNAPSHOT if forking else "fresh")
            state = self._state(seed)
            connect = lambda files, values: start(lambda: self._begun(files, values, state))  # noqa: E731
            warmed.blank()
            if forking:
                session().hold(warmed.launch)
                session().ask(lambda sumo: levels_of(sumo).warning)  # found once a network, here and not in every child
                limit = None if self.timeout is None else self.timeout + _GRACE
                return in_fork(partial(self._in_child, values, seed, connect), limit, "a run")
        return self._complete(values, seed, connect)

    def _in_child(self, values: Values, seed: int, connect: Connect) -> tuple[Trace, dict[str, float]]:
        """Run in a child of the process that holds the simulation."""
        session().begin_child()
        self._warmed.begin_child()
        return self._complete(values, seed, connect)

    def _complete(self, values: Values, seed: int, connect: Connect) -> tuple[Trace, dict[str, float]]:
        """Run with libsumo, and refuse a run of which SUMO left out traffic."""
        watch = Stopwatch()
        trace = self._run(values, seed, connect, watch)
        refuse_dropped(session().messages())
        watch.enter(watch.phase)
        return trace, watch.seconds

    def _state(self, seed: int) -> Path:
        """Write the state that a run begins with, and return its path."""
        state = self._warmed.state(seed % self.isolation.seeds, self.isolation.states)
        return state.write(seed, self._warmed.folder / "run.state.xml")

    def _loaded(self, files: SumoFiles, values: Values, *, seed: int) -> AbstractContextManager[Any]:
        """Load the files of a run."""
        return session().run(files.launch(values, scratch_folder(), self.step), seed, "fresh")

    def _begun(self, files: SumoFiles, values: Values, state: Path) -> Path:
        """Write the traffic of a run, and return its state."""
        return self._warmed.begin(values, files.additional[len(self.files.additional) if self.files is not None else 0 :], state)

    def warnings(self) -> tuple[str, ...]:
        """Return SUMO's warnings about the files in the last run of this process, each once, and what is known beside them."""
        lines = (line for line in session().messages() if line.startswith(("Warning:", "Error:")))
        found = dict.fromkeys(line for line in lines if "time=" not in line)  # with a time it is about the traffic
        levels, moved = (lambda sumo: levels_of(sumo).warning), (one.told for one in self.participants if hasattr(one, "told"))
        of_net = (session().ask(each) for each in (levels, told_of_junctions, told_of_lengths, *moved))
        return (*filter(None, [unrepeatable(self.files), *of_net]), *found)

    def run_with_traci(self, values: Values, seed: int, traci: Any, program: Sequence[str] = ("sumo-gui",)) -> Trace:
        """Run one concrete scenario in a separate SUMO process, such as sumo-gui, through traci.

        Args:
            values: of the inputs.
            seed: of the run.
            traci: the module.
            program: the SUMO program and options that the run does not set, such as `("sumo-gui", "--delay", "100")`.

        Returns:
            The trace, identical to that of a call.
        """
        if not self.isolation.warm:

            def load(files: SumoFiles, given: Values) -> AbstractContextManager[Any]:
                return traci_connection(traci, [*program, *files.launch(given, scratch_folder(), self.step).command(seed)])

            return self._run(values, seed, load, Stopwatch())
        state, warmed = self._state(seed), self._warmed
        warmed.blank()
        start = partial(traci_connection, traci, [*program, *warmed.launch.command(0)])
        return self._run(values, seed, lambda files, given: start(lambda: self._begun(files, given, state)), Stopwatch())

    @property
    def outputs(self) -> Path:
        """Where the last run in this process wrote."""
        return self._warmed.folder if self.isolation.warm else scratch_folder()

    def write_files(self, values: Values, seed: int, folder: Path) -> None:
        """Write the SUMO files of a run, placeholders filled, and a `run.sumocfg` that any SUMO reads.

        With warmed traffic a `run.py` drives it as it was. Controllers and loops are not in them; files without placeholders
        are named where they are.
        """
        files, values = self.files_of_run(values, seed), plain_values(values)
        if not self.isolation.warm:
            files.launch(values, folder, self.step).write(seed, folder / "run.sumocfg")
            return
        warmed, state = self._warmed, self._begun(files, values, self._state(seed))
        latest = warmed.snapshot.last_departure(values) + (self.recording.ego.delay or 0.0)
        warmed.write(state, folder, latest + self.recording.duration)

    def files_of_run(self, values: Values, seed: int) -> SumoFiles:
        """Return the files that SUMO is started with in a run, without starting it; a loop runs until it calls `sumo.start`.

        Raises:
            RunError: the loop fails before.
        """
        found: list[SumoFiles] = []

        def stop(files: SumoFiles) -> Any:
            found.append(files)
            raise RunEnded("start")

        proxy = TraciProxy(self, plain_values(values), seed, stop, Stopwatch())
        with contextlib.chdir(self.folder), contextlib.suppress(RunEnded):
            if self.files is not None:
                proxy.start_files(self.files)
            proxy.run_loop()
        if not found:
            raise RunError(Status.FAILED, "a loop must call sumo.start([...]), but it did not")
        return found[0]

    def _run(self, values: Values, seed: int, connect: Connect, watch: Stopwatch) -> Trace:
        proxy: TraciProxy | None = None
        given = plain_values(values)
        try:
            with ExitStack() as stack:
                stack.enter_context(contextlib.chdir(self.folder))

                def start(files: SumoFiles) -> Any:
                    return stack.enter_context(connect(files, given))

                proxy = TraciProxy(self, given, seed, start, watch)
                if self.files is not None:
                    proxy.start_files(self.files)
                ended = proxy.run_loop()
                return proxy.recorder.trace(ended)
        except RunError as error:
            raise RunError(error.status, error.reason if proxy is None else proxy.explained(error.reason)) from None

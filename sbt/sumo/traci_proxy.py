"""SUMO's client module as a user's loop sees it; starting, stepping and closing are intercepted, and every step is recorded."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from sbt import interruption
from sbt.errors import RunError
from sbt.problem.outcome import Status
from sbt.problem.plain import Values
from sbt.problem.profile import Profile
from sbt.seeds import stream
from sbt.sumo.departures import DepartureMonitor, RequestedDeparture, WaitingEgo, number_or_none, requested_departures
from sbt.sumo.files import SumoFiles, options_of_command
from sbt.sumo.foreign import check_not_stepped, error_in_loop, place_in_loop, started_another
from sbt.sumo.formatting import plain
from sbt.sumo.guided import Motion, Participant
from sbt.sumo.messages import explained
from sbt.sumo.phases import PHASES, Stopwatch
from sbt.sumo.recorder import Recorder, RecordingSettings, RunEnded
from sbt.sumo.session import scratch_folder
from sbt.sumo.several import Recorders, further_recorders

__all__ = ["Loop", "TraciProxy", "step_until_over"]

_FILTERED, _PARAMETERS = (0xA4, 0xAE), ("objectID", "domain", "dist", "varIDs")
"""Domains of subscriptions that SUMO filters, vehicles and persons, and what the calls take first."""
Loop = Callable[[Any, Values, np.random.Generator], object]
"""The user's `simulate(sumo, values, rng)`."""


def step_until_over(sumo: Any, values: Values, rng: np.random.Generator) -> None:
    """Step until the run is over: the loop of a scenario without one."""
    while True:
        sumo.simulationStep()


class _Simulation(Protocol):
    """What is read of a `UserSimulation`."""

    @property
    def recording(self) -> RecordingSettings: ...
    @property
    def folder(self) -> Path: ...
    @property
    def loop(self) -> Loop: ...
    @property
    def timeout(self) -> float | None: ...
    @property
    def profiles(self) -> tuple[Profile, ...]: ...
    @property
    def participants(self) -> tuple[Participant, ...]: ...


class TraciProxy:
    """SUMO's client module as the user's loop sees it; starting, stepping and closing are intercepted.

    Args:
        simulation: what runs.
        values: inputs of the run.
        seed: of the run.
        connect: starts SUMO with files and returns its client module.
        watch: of the phases of the run.
    """

    def __init__(
        self, simulation: _Simulation, values: Values, seed: int, connect: Callable[[SumoFiles], Any],
        watch: Stopwatch,
    ):  # fmt: skip
        self._user_simulation, self._values, self._seed, self._connect = simulation, values, seed, connect
        self._watch = watch
        self._files: SumoFiles | None = None
        self._time = 0.0
        self._module: Any = None
        self._recorder: Recorder | Recorders | None = None
        self._motions: tuple[Motion, ...] = ()
        self.simulation = _SimulationProxy(self)
        self.vehicle, self.person = _CommandProxy(self, "vehicle"), _CommandProxy(self, "person")
        self._error_place = ""

    def explained(self, reason: str) -> str:
        """Return the reason of an error with its place in the files and in the loop, and what to change."""
        return f"{reason if self._files is None else explained(reason, self._files)}{self._error_place}"

    def __getattr__(self, name: str) -> Any:
        """Return the attribute of SUMO's client module."""
        if self._module is None:
            raise RunError(Status.FAILED, f"sumo.start([...]) must be called before sumo.{name}, but was not")
        return getattr(self._module, name)

    @property
    def recorder(self) -> Recorder | Recorders:
        """The recorder of the run."""
        if self._recorder is None:
            why = started_another(self._user_simulation.loop)
            raise RunError(Status.FAILED, f"a loop must call sumo.start([...]), but it did not{why}")
        return self._recorder

    def start(self, command: Sequence[str], *_: Any, **__: Any) -> tuple[int, str]:
        """Start SUMO as `traci.start` does; the program's name, ports and labels are ignored."""
        if self._module is not None:
            raise RunError(
                Status.FAILED, "sumo.start must be called once, by the loop or (files) by the scenario, but was called again"
            )
        folder = self._user_simulation.folder
        self.start_files(SumoFiles.of(options_of_command(list(command)[1:], folder), folder, "sumo.start"))
        version: tuple[int, str] = self.__getattr__("getVersion")()
        return version

    def start_files(self, files: SumoFiles) -> None:
        """Fill the placeholders of the files, start SUMO with them, and begin to record."""
        simulation = self._user_simulation
        recording = simulation.recording.bound(self._values)
        ego = recording.ego
        vehicle_types = "".join(one.vehicle_type(files, self._values) or "" for one in (ego, *recording.further))
        if vehicle_types:
            path = scratch_folder() / "ego.add.xml"
            path.write_text(f"<additional>{vehicle_types}</additional>")
            files = replace(files, additional=(*files.additional, path))
        requested = requested_departures(files, self._values, ego.id)
        self._files = files
        self._module = self._connect(files)
        self._time = float(self._module.simulation.getTime())
        waiting = WaitingEgo(ego.id, ego.delay, recording.wait)
        departures = DepartureMonitor(self._module, waiting, requested, files, self._values)
        rng = stream(self._seed, "ego")
        first = Recorder(self._module, recording, rng, departures, simulation.timeout)
        further = further_recorders(self._module, recording, files, self._values, self._seed)
        self._recorder = Recorders(first, further) if further else first
        self._motions = tuple(p.begin(self._module, self._values) for p in simulation.participants)
        self._watch.enter(PHASES[1])

    def simulationStep(self, until: float = 0.0) -> None:  # noqa: N802  (SUMO's name)
        """Make one step, or all steps until a time (s), and record each."""
        while True:
            recorder = self.recorder
            recorder.before_step()
            check_not_stepped(self._module, self._time, self._user_simulation.loop)
            for motion in self._motions:
                motion.before_step(recorder.scenario_time)
            self._module.simulationStep()
            self._time = float(self._module.simulation.getTime())
            if self._motions:
                recorder.place({name: state for motion in self._motions for name, state in motion.after_step().items()})
            recorder.after_step()
            if self._watch.phase != PHASES[2] and recorder.scenario_time is not None:
                self._watch.enter(PHASES[2])
            if self._time >= until - 1e-9:
                return

    def close(self, *_: Any) -> None:
        """Do nothing: SUMO is closed at the end of the run."""

    def run_loop(self) -> str:
        """Run the loop and return why it ended.

        Raises:
            RunError: the loop raised an error. SUMO's own errors are passed on to the context that started SUMO.
        """
        loop = self._user_simulation.loop
        try:
            curves = {p.name: p.curve(self._values) for p in self._user_simulation.profiles}
            loop(self, {**self._values, **curves}, stream(self._seed, "loop"))
        except RunEnded as end:
            return end.reason
        except BaseException as error:  # SystemExit too
            self._error_place = "" if loop is step_until_over else place_in_loop(error, loop)
            if isinstance(error, RunError) or interruption.is_interruption(error):
                raise
            translated = error_in_loop(error, self._module)
            if translated is error:
                raise
            raise translated from error
        if self._recorder is not None and self._recorder.ended:  # a bare `except` in the loop has caught the end
            return self._recorder.ended
        if self._module is not None:
            check_not_stepped(self._module, self._time, loop)
            self._module.simulationStep()  # SUMO holds pointers to actors moved since the last step, which a load would free
        return "loop"


class _SimulationProxy:
    """The `simulation` domain, with a recorded `step`."""

    def __init__(self, proxy: TraciProxy):
        self._proxy = proxy

    def step(self, until: float = 0.0) -> None:
        """Make one step, or all steps until a time (s)."""
        self._proxy.simulationStep(until)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._proxy.__getattr__("simulation"), name)


class _CommandProxy:
    """The `vehicle` or `person` domain; arguments of commands must be finite, and departures of added vehicles are compared."""

    def __init__(self, proxy: TraciProxy, domain: str):
        self._proxy, self._domain = proxy, domain
        self._subscribed: tuple[tuple[Any, Any], Callable[[], Any]] | None = None

    def __getattr__(self, name: str) -> Any:
        function = getattr(self._proxy.__getattr__(self._domain), name)
        if name.startswith("get"):
            return function
        return partial(self._command, name, function)

    def _command(self, name: str, function: Any, *args: Any, **kwargs: Any) -> Any:
        args, kwargs = tuple(map(plain, args)), {key: plain(value) for key, value in kwargs.items()}
        for value in (*args, *kwargs.values()):
            if isinstance(value, float) and not math.isfinite(value):  # SUMO accepts it silently
                shown = ", ".join(map(repr, (*args, *kwargs.values())))
                raise RunError(Status.FAILED, f"a loop must give finite numbers, but called sumo.{self._domain}.{name}({shown})")
        if name.startswith("addSubscriptionFilter"):
            self._filter_own(name)
        result = function(*args, **kwargs)
        if name in ("subscribeContext", "unsubscribeContext"):
            self._note_subscription(partial(function, *args, **kwargs), ends=name.startswith("un"))
        if self._domain == "vehicle" and name == "add":
            self._expect(*args, **kwargs)
        elif name.startswith(("moveTo", "remove")):
            who = str(args[0] if args else kwargs.get("vehID", kwargs.get("personID", "")))
            if self._domain == "vehicle":
                self._proxy.recorder.ignore_departure(who)
            if name == "moveToXY":
                self._proxy.recorder.take_as_rigid(who)
            elif name == "moveTo":
                self._proxy.recorder.take_as_put(who)
        return result

    def _filter_own(self, name: str) -> None:
        """Make the loop's subscription of surroundings the last one again: SUMO filters that, which may be the recorder's."""
        if self._subscribed is None:
            call = f"sumo.{self._domain}.{name}"
            rule = f"a loop must subscribe to the vehicles or persons around one (subscribeContext) before {call}"
            raise RunError(Status.FAILED, f"{rule}, but it did not")
        self._subscribed[1]()

    def _note_subscription(self, call: partial[Any], *, ends: bool) -> None:
        """Note that the loop subscribes to surroundings, or no longer, which ends all of a road user, the recorder's too."""
        given = dict(zip(_PARAMETERS, call.args, strict=False)) | call.keywords
        whose = given["objectID"], given["domain"]
        variables = given.get("varIDs")
        if ends or (variables is not None and not len(variables)):
            if self._subscribed is not None and self._subscribed[0] == whose:
                self._subscribed = None
            self._proxy.recorder.subscribe_again(str(whose[0]))
        elif self._domain == "vehicle" and whose[1] in _FILTERED:
            self._subscribed = whose, call

    def _expect(
        self, vehID: str, routeID: str = "", typeID: str = "", depart: Any = None, departLane: Any = "first",  # noqa: N803
        departPos: Any = "base", departSpeed: Any = "0", *_: Any, **__: Any,  # noqa: N803
    ) -> None:  # fmt: skip
        """Register the departure that `vehicle.add` requests; the parameters have SUMO's names."""
        when = self._proxy.simulation.getTime() if depart in (None, "now") else number_or_none(depart)
        position, speed, lane = map(number_or_none, (departPos, departSpeed, departLane))
        requested = RequestedDeparture("", when, position, speed, lane)
        self._proxy.recorder.expect_departure(vehID, requested)

"""Runs a scene in SUMO step by step: insert, verify, control, record, stop."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sbt.errors import InputError, RunError
from sbt.problem.outcome import Status
from sbt.problem.parameter import Parameter
from sbt.problem.trace import Trace
from sbt.seeds import stream
from sbt.sumo.actors import Scene
from sbt.sumo.batch import simulate_many
from sbt.sumo.driving import Drive
from sbt.sumo.ego import Ego
from sbt.sumo.formatting import plain_values
from sbt.sumo.models import SUBLANE
from sbt.sumo.nets import net_file
from sbt.sumo.placing import insert, type_name, verify
from sbt.sumo.session import Setup, check_options, direct, session

__all__ = ["DEADLINE_STEPS", "SumoSimulation"]

SceneBuilder = Callable[[Mapping[str, float], Ego, np.random.Generator], Scene]

DEADLINE_STEPS = 256
"""The wall clock is looked at once in so many steps."""


@dataclass(frozen=True)
class SumoSimulation:
    """How one concrete scenario runs in SUMO: callable from values and seed to a `Trace`.

    Args:
        net: name of a built-in network or path of a `.net.xml`.
        scene: values, ego and the run's generator to the actors.
        duration: longest simulated time (s).
        step_length: SUMO's step (s); positions follow by the trapezoidal rule.
        ego: the AV under test.
        lane_change_duration: of SUMO's continuous lane change (s).
        isolations: allowed levels, the fastest last. `reuse` only where SUMO draws no random numbers;
            `replicas` (several runs at once in copies of the network) only where nobody moves by pose either.
        isolation: the level of this simulation; None: the fastest.
        options: further SUMO options.
        timeout: wall-clock seconds after which a run ends as `timeout`; None: never.
    """

    net: str
    scene: SceneBuilder
    duration: float
    step_length: float = 0.05
    ego: Ego = field(default_factory=Ego)
    lane_change_duration: float = 0.0
    isolations: tuple[str, ...] = ("fresh", "reuse")
    isolation: str | None = None
    options: tuple[str, ...] = ()
    timeout: float | None = None

    def __post_init__(self) -> None:
        if not (self.duration > 0 and 0 < self.step_length <= self.duration):
            raise InputError(
                f"0 < step_length <= duration must hold, but got step {self.step_length} s, duration {self.duration} s"
            )
        if round(self.step_length * 1000) / 1000 != self.step_length:
            raise InputError(f"SUMO counts time in whole milliseconds, but got step_length {self.step_length} s")
        if self.isolation is not None and self.isolation not in self.isolations:
            raise InputError(f"executor.isolation must be auto or {', '.join(self.isolations)} here, but got '{self.isolation}'")
        check_options(self.options)

    def configured(
        self, ego: Mapping[str, Any] | None = None, isolation: str | None = None, step_length: float | None = None
    ) -> SumoSimulation:
        """Return a copy with another ego, isolation level or step length."""
        chosen = self.ego if ego is None else Ego.of(**ego)
        if chosen.lane_change == SUBLANE and "--lateral-resolution" not in self.options:
            raise InputError(f"ego.lane_change {SUBLANE} needs SUMO's option --lateral-resolution, which this scenario has not")
        levels = self.isolations if chosen.deterministic else ("fresh",)
        level = self.isolation if isolation is None and self.isolation in levels else isolation
        return replace(
            self, ego=chosen, isolations=levels, isolation=None if level == "auto" else level,
            step_length=self.step_length if step_length is None else step_length,
        )  # fmt: skip

    @property
    def inputs(self) -> tuple[Parameter, ...]:
        """Inputs that come with the AV under test; the scenario's space has them beside its own."""
        return self.ego.inputs

    def prepare(self) -> None:
        """Import libsumo and find the network.

        Raises:
            InputError: there is no such network.
        """
        net_file(self.net)
        session()

    def limited(self, timeout: float | None) -> SumoSimulation:
        """Return a copy whose runs end as `timeout` after so many wall-clock seconds."""
        return replace(self, timeout=timeout)

    def __call__(self, values: Mapping[str, float], seed: int) -> Trace:
        """Run one concrete scenario.

        Raises:
            RunError: SUMO fails, an actor vanishes, a controller asks for the impossible, the start is
                not the one asked for, or it takes too long.
        """
        scene = self.built(values, seed)
        limit = math.inf if self.timeout is None else self.timeout
        with session().run(self.setup(scene), seed, self.level) as sumo:
            insert(sumo, scene)
            sumo.simulationStep()
            verify(sumo, scene)
            drive = Drive(sumo, scene, self.step_length, self.duration)
            step, colliding = direct(sumo, "simulation", "step"), direct(sumo, "simulation", "getCollidingVehiclesNumber")
            deadline = time.monotonic() + limit
            over, steps = False, 0
            while not over:
                if steps % DEADLINE_STEPS == 1 and time.monotonic() > deadline:
                    at = steps * self.step_length
                    raise RunError(Status.TIMEOUT, f"a run must take at most {limit:g} s, but it was at t = {at:g} s")
                if steps:
                    step()
                if colliding():
                    for c in sumo.simulation.getCollisions():
                        drive.heard_of(c.collider, c.victim)
                over = drive.advance()
                steps += 1
            return drive.trace()

    def simulate_many(
        self, work: Sequence[tuple[Mapping[str, float], int]], at_work: Callable[[Sequence[int]], None] = lambda _: None
    ) -> list[Trace | BaseException]:
        """Run several concrete scenarios, each of values and seed, at once where the isolation level allows.

        Args:
            work: values and seed of each run.
            at_work: told now and then which of them are being run.

        Returns:
            What calling one by one would: the traces, or the errors, in the order given.
        """
        return simulate_many(self, work, at_work)

    @property
    def level(self) -> str:
        """The isolation level it runs with."""
        return self.isolation or self.isolations[-1]

    @property
    def batched(self) -> bool:
        """Whether several runs share one simulation."""
        return self.level == "replicas"

    def built(self, values: Mapping[str, float], seed: int) -> Scene:
        """Return the scene of one concrete scenario, with new controllers."""
        values = plain_values(values)
        return self.scene(values, self.ego.bound(values), stream(seed, "scene"))

    def setup(self, scene: Scene, copies: int = 1) -> Setup:
        """Return what SUMO is loaded with for a scene."""
        types = tuple(sorted({type_name(a): a.type for a in scene.actors}.items()))
        return Setup(str(net_file(self.net)), types, self.step_length, self.lane_change_duration, self.options, copies)

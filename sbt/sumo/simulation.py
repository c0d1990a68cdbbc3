"""Runs a scene in SUMO step by step: insert and verify the actors, control, record, and detect the end."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np

from sbt.errors import InputError, RunError
from sbt.problem.outcome import Status
from sbt.problem.parameter import Parameter
from sbt.problem.plain import Values
from sbt.problem.trace import Trace
from sbt.seeds import stream
from sbt.sumo.acting import Period, periods_of
from sbt.sumo.actors import Scene
from sbt.sumo.batch import simulate_many
from sbt.sumo.ego import Ego
from sbt.sumo.formatting import plain_values
from sbt.sumo.insertion import insert, type_name, verify
from sbt.sumo.levels import Levels, levels_of
from sbt.sumo.models import SUBLANE
from sbt.sumo.nets import net_file
from sbt.sumo.resetting import why_fresh
from sbt.sumo.session import Setup, check_options, session, unwrapped
from sbt.sumo.sumo_run import SumoRun

__all__ = ["CLOCK_STEPS", "SumoSimulation"]

Covariates = Callable[[Values, Scene], Mapping[str, float]]
"""Values of the inputs and the drawn scene to named numbers, which are known before the run."""
SceneBuilder = Callable[[Values, Ego, np.random.Generator], Scene]
"""Values of the inputs, the ego, and the random generator of the run to the scene."""

_LEVELS = ("fresh", "reuse", "replicas")
CLOCK_STEPS = 256
"""Steps between two looks at the wall clock."""


@dataclass(frozen=True)
class SumoSimulation:
    """Simulates concrete scenarios in SUMO: a function of values and seed that returns a `Trace`.

    Args:
        net: name of a built-in network, or path of a `.net.xml`.
        scene: builds the scene of a run.
        duration: longest simulated time (s).
        step_length: SUMO's step (s); positions are integrated by the trapezoidal rule.
        ego: the AV under test.
        lane_change_duration: of continuous lane changes (s).
        isolations: allowed isolation levels, the fastest last. `replicas` (several runs in one simulation) is valid only
            where no actor is moved by pose. A run is `fresh` whatever is allowed where SUMO draws random numbers for it,
            or the network or an option has a state that goes on from run to run, such as traffic lights (see `why_fresh`).
        isolation: the level of this simulation; None: the fastest.
        options: further SUMO options.
        timeout: wall-clock limit of a run (s); None: none.
        friction: of the road, which bounds accelerations of vehicles on lanes by mu g, also as an input; None: no bound.
        covariates: what is known of a drawn scene before the run; None: nothing is told.

    Raises:
        InputError: step and duration do not fit, or the isolation level is not allowed.
        ValueError: an option is one that this package sets.
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
    friction: Parameter | float | None = None
    covariates: Covariates | None = None

    def __post_init__(self) -> None:
        if not (self.duration > 0 and 0 < self.step_length <= self.duration):
            raise InputError(
                f"0 < step_length <= duration must hold, but got step {self.step_length} s, duration {self.duration} s"
            )
        if round(self.step_length * 1000) / 1000 != self.step_length:
            raise InputError(f"SUMO counts time in whole milliseconds, but got step_length {self.step_length} s")
        if not self.isolations or not set(self.isolations) <= {*_LEVELS}:
            raise InputError(f"isolations must be some of {', '.join(_LEVELS)}, but got {', '.join(self.isolations) or 'none'}")
        if self.isolation is not None and self.isolation not in self.isolations:
            raise InputError(f"executor.isolation must be auto or {', '.join(self.isolations)} here, but got '{self.isolation}'")
        check_options(self.options)

    def configured(
        self, ego: Mapping[str, Any] | None = None, isolation: str | None = None, step_length: float | None = None
    ) -> SumoSimulation:
        """Return a copy with another ego, isolation level or step length.

        Raises:
            InputError: the ego or the isolation level is not possible here.
        """
        chosen = self.ego if ego is None else Ego.of(**ego)
        if chosen.lane_change == SUBLANE and "--lateral-resolution" not in self.options:
            raise InputError(f"ego.lane_change {SUBLANE} needs SUMO's option --lateral-resolution, which this scenario has not")
        levels = self.isolations if chosen.deterministic else ("fresh",)
        level = self.isolation if isolation is None and self.isolation in levels else isolation
        return replace(
            self, ego=chosen, isolations=levels, isolation=None if level == "auto" else level,
            step_length=self.step_length if step_length is None else step_length,
        )  # fmt: skip

    def with_friction(self, low: float, high: float) -> SumoSimulation:
        """Return a copy on roads of this friction; an input, where it is a range."""
        mu = low if low == high else Parameter("friction", low, high, description="coefficient of friction of the road")
        return replace(self, friction=mu)

    @property
    def inputs(self) -> tuple[Parameter, ...]:
        """Inputs that belong to the AV under test and the road; part of the parameter space of the scenario."""
        return (*self.ego.inputs, *((self.friction,) if isinstance(self.friction, Parameter) else ()))

    def prepare(self) -> None:
        """Import libsumo and check the network.

        Raises:
            InputError: there is no such network.
        """
        net_file(self.net)
        session()

    def limited(self, timeout: float | None) -> SumoSimulation:
        """Return a copy with a wall-clock limit of its runs (s)."""
        return replace(self, timeout=timeout)

    def __call__(self, values: Values, seed: int) -> Trace:
        """Run one concrete scenario.

        Raises:
            RunError: SUMO fails, an actor leaves the road, a controller returns an impossible action, the initial
                state differs from the specified one, or the run takes too long.
        """
        scene = self.build_scene(values, seed)
        limit = math.inf if self.timeout is None else self.timeout
        reference = self.isolation == "fresh" != self.isolations[-1]  # asked for although less would do
        setup = self.setup(scene)
        level = "fresh" if self._why_fresh(setup, scene) else self.isolation_level
        with session().run(setup, seed, level, reference=reference) as sumo:
            insert(sumo, scene)
            sumo.simulationStep()
            verify(sumo, scene)
            run = SumoRun(sumo, scene, self.step_length, self.duration)
            step, colliding = unwrapped(sumo, "simulation", "step"), unwrapped(sumo, "simulation", "getCollidingVehiclesNumber")
            deadline = time.monotonic() + limit
            over, steps = False, 0
            while not over:
                if steps % CLOCK_STEPS == 1 and time.monotonic() > deadline:
                    at = steps * self.step_length
                    raise RunError(Status.TIMEOUT, f"a run must take at most {limit:g} s, but it was at t = {at:g} s")
                if steps:
                    step()
                if colliding():
                    for c in sumo.simulation.getCollisions():
                        run.record_collision(c.collider, c.victim)
                over = run.advance()
                steps += 1
            return run.trace()

    def simulate_many(
        self, work: Sequence[tuple[Values, int]], at_work: Callable[[Sequence[int]], None] = lambda _: None
    ) -> list[Trace | BaseException]:
        """Run several concrete scenarios, in one simulation where the isolation level allows it.

        Args:
            work: values and seed of each run.
            at_work: called now and then with the indices of the runs in progress.

        Returns:
            Traces or errors in the given order, the same as from single calls.
        """
        return simulate_many(self, work, at_work)

    @property
    def isolation_level(self) -> str:
        """The isolation level of the runs that need not be `fresh`."""
        return self.isolation or self.isolations[-1]

    @property
    def periods(self) -> tuple[Period, ...]:
        """In which times drivers act, where that is not every step."""
        return periods_of([self.ego])

    @property
    def batched(self) -> bool:
        """Whether several runs share one simulation."""
        return self.isolation_level == "replicas"

    @property
    def one_level(self) -> bool:
        """Whether no road of the network is on another level than another one, such as a bridge."""
        return not _levels(str(net_file(self.net))).several

    def warnings(self) -> tuple[str, ...]:
        """Return what is to be known of the network, such as that roads are taken for bridges; none where it cannot be loaded."""
        try:
            return tuple(filter(None, [_levels(str(net_file(self.net))).warning]))
        except RunError:
            return ()

    def why_fresh(self, values: Values, seed: int) -> str:
        """Return why SUMO is loaded for a run although less is allowed; "" where it is not, or nothing else is allowed."""
        scene = self.build_scene(values, seed)
        return self._why_fresh(self.setup(scene), scene)

    def _why_fresh(self, setup: Setup, scene: Scene) -> str:
        return "" if self.isolation_level == "fresh" else why_fresh(setup.net, setup.options, scene.actors)

    def build_scene(self, values: Values, seed: int) -> Scene:
        """Return the scene of one concrete scenario, with new controllers."""
        values = plain_values(values)
        ego = self.ego.bind(values)
        scene = self.scene(values, ego, stream(seed, "scene"))
        ego.check_driven(scene.actors[0])
        if self.friction is None:
            return scene
        mu = self.friction
        return replace(scene, friction=float(values[mu.name]) if isinstance(mu, Parameter) else mu)

    def known_before(self, values: Values, seed: int) -> Mapping[str, float] | None:
        """Return the covariates of a concrete scenario, at no simulation; None where the scenario has none."""
        values = plain_values(values)
        return None if self.covariates is None else self.covariates(values, self.build_scene(values, seed))

    def telling_all(self) -> SumoSimulation:
        """Return a copy that tells the general covariates, or its own where it has some."""
        from sbt.sumo.general_covariates import general

        return self if self.covariates is not None else replace(self, covariates=general(self.net))

    def setup(self, scene: Scene, replicas: int = 1) -> Setup:
        """Return what SUMO is loaded from for a scene."""
        types = tuple(sorted({type_name(a): a.type for a in scene.actors}.items()))
        return Setup(str(net_file(self.net)), types, self.step_length, self.lane_change_duration, self.options, replicas)


@cache
def _levels(net: str) -> Levels:
    """Return the levels of a network file; SUMO loads it alone, once per process."""
    with session().run(Setup(net, (), 1.0), 0, "fresh") as sumo:
        return levels_of(sumo)

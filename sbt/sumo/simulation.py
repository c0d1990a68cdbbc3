"""Runs a scene in SUMO step by step: insert, verify, control, record, stop."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sbt.errors import InputError, RunError
from sbt.metrics.geometry import contact_index
from sbt.problem.outcome import Status
from sbt.problem.parameter import Parameter
from sbt.problem.trace import ActorTrace, Trace
from sbt.seeds import stream
from sbt.sumo.actors import KEEP, Action, Actor, Scene, State
from sbt.sumo.ego import Ego
from sbt.sumo.models import SUBLANE
from sbt.sumo.nets import net_file
from sbt.sumo.placing import insert, mover, type_name, verify
from sbt.sumo.session import ABSENT, Setup, check_options, direct, session

__all__ = ["DEADLINE_STEPS", "SumoSimulation"]

SceneBuilder = Callable[[Mapping[str, float], Ego, np.random.Generator], Scene]

DEADLINE_STEPS = 256
"""The wall clock is looked at once in so many steps."""
_FASTEST = 1e4


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
        isolations: allowed levels, the fastest last. `reuse` only where SUMO draws no random numbers.
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
        scene = self.scene(values, self.ego.bound(values), stream(seed, "scene"))
        types = tuple(sorted({type_name(a): a.type for a in scene.actors}.items()))
        setup = Setup(str(net_file(self.net)), types, self.step_length, self.lane_change_duration, self.options)
        level = self.isolation or self.isolations[-1]
        with session().run(setup, seed, level) as sumo:
            insert(sumo, scene)
            sumo.simulationStep()
            verify(sumo, scene)
            return _drive(sumo, scene, self)


def _drive(sumo: Any, scene: Scene, simulation: SumoSimulation) -> Trace:
    """Step until something ends the run, recording every state."""
    actors, dt = scene.actors, simulation.step_length
    step, collisions = direct(sumo, "simulation", "step"), direct(sumo, "simulation", "getCollidingVehiclesNumber")
    states = [State(a.name, a.type.length, a.type.width, dt) for a in actors]
    for actor, state in zip(actors, states, strict=True):
        state.steered = None if actor.pose is None else actor.speed
    by_name = {s.name: s for s in states}
    control = _controls(sumo, actors, states, dt)
    observe = _observer(sumo, actors, states, dt)
    solid = [k for k, a in enumerate(actors) if not a.person][1:]
    probes = tuple(scene.signals.values())
    heard: list[tuple[float, ...]] = []
    near = max(s.length for s in states) * 2
    steps = round(simulation.duration / dt)
    deadline = math.inf if simulation.timeout is None else time.monotonic() + simulation.timeout
    rows: list[tuple[float, ...]] = []
    reported: list[str] = []
    for k in range(steps + 1):
        t = k * dt
        observe(rows)
        if collisions():
            reported += [f"{c.collider}>{c.victim}@{t:.3f}" for c in sumo.simulation.getCollisions()]
        if _touching(states, solid, rows, near, dt):
            ended = "collision"
            break
        ended = (scene.until(t, by_name) or "") if scene.until is not None else ""
        if ended:
            break
        if k % DEADLINE_STEPS == 0 and time.monotonic() > deadline:
            raise RunError(Status.TIMEOUT, f"a run must take at most {simulation.timeout:g} s, but it was at t = {t:g} s")
        if k < steps:
            control(t)
            if probes:
                heard.append(tuple([float(probe()) for probe in probes]))
            step()
    else:
        ended = "duration"
    if probes:
        heard.append(tuple([float(probe()) for probe in probes]))
    return _trace(scene, rows, heard, dt, ended, reported)


def _controls(sumo: Any, actors: tuple[Actor, ...], states: list[State], dt: float) -> Callable[[float], None]:
    """Return what asks every controller and passes its action on to SUMO."""
    set_speed = direct(sumo, "vehicle", "setSpeed")
    driven = [
        (a, s, a.driver.act, tuple(o for o in states if o is not s), mover(sumo, a))
        for a, s in zip(actors, states, strict=True)
        if a.driver is not None
    ]

    def control(t: float) -> None:
        for actor, own, act, others, place in driven:
            action = act(t, own, others)
            if action is not KEEP:
                speed = _speed(actor, own, action, dt)
                if speed is not None and not actor.person:
                    set_speed(actor.name, speed)
                if action.lane is not None:
                    sumo.vehicle.changeLane(actor.name, action.lane, 3600.0)
                if action.pose is not None:
                    own.steered = own.speed if speed is None else speed
                    place(action.pose)
                elif own.steered is not None:
                    raise RunError(Status.FAILED, f"{actor.name} moves by pose, but its controller gave {action}")

    return control


def _observer(sumo: Any, actors: tuple[Actor, ...], states: list[State], dt: float) -> Callable[[list[tuple[float, ...]]], None]:
    """Return what reads every actor from SUMO and records it, a row an actor.

    This runs at every step of every run, so that everything it needs is bound beforehand. SUMO's
    position is a vehicle's front bumper and a person's centre.
    """
    getters = {
        person: tuple(direct(sumo, "person" if person else "vehicle", name) for name in ("getPosition", "getAngle", "getSpeed"))
        for person in {a.person for a in actors}
    }
    watched = [(s, s.name, 0.0 if a.person else 0.5 * s.length, *getters[a.person]) for a, s in zip(actors, states, strict=True)]
    rate = 1.0 / dt

    def observe(rows: list[tuple[float, ...]]) -> None:
        first = not rows
        for state, name, half, position, angle_of, speed_of in watched:
            x, y = position(name)
            if x == ABSENT:
                t = len(rows) // len(states) * dt
                raise RunError(Status.FAILED, f"{name} must stay on the road, but it was gone at t = {t:g} s")
            angle = angle_of(name)
            if angle != state.angle:
                state.turn(angle)
            speed = speed_of(name) if state.steered is None else state.steered
            state.x = x = x - half * state.cos
            state.y = y = y - half * state.sin
            state.acceleration = acceleration = 0.0 if first else (speed - state.speed) * rate
            state.speed = speed
            rows.append((x, y, state.heading, speed, acceleration))

    return observe


def _speed(actor: Actor, own: State, action: Action, dt: float) -> float | None:
    """Return the speed at the end of the step that an action means; None where it means none."""
    acceleration, speed, _, _ = action
    if acceleration is not None:
        aim, speed = speed, own.speed + acceleration * dt
        if aim is not None:
            speed = max(speed, aim) if acceleration < 0 else min(speed, aim)
        if speed < 0.0:
            speed = 0.0
    if speed is not None and not -_FASTEST < speed < _FASTEST:
        raise RunError(Status.FAILED, f"the controller of {actor.name} must give finite numbers, but gave {action}")
    return speed


def _touching(states: list[State], solid: list[int], rows: list[tuple[float, ...]], near: float, dt: float) -> bool:
    """Return whether the first actor, the ego, touched another rectangle since the last step (exact test only when near)."""
    ego = states[0]
    x, y, speed = ego.x, ego.y, ego.speed
    for j in solid:
        other = states[j]
        dx, dy, reach = other.x - x, other.y - y, near + (speed + other.speed) * dt
        if -reach < dx < reach and -reach < dy < reach:
            last = np.array(rows[-2 * len(states) :]).reshape(-1, len(states), 5)
            if contact_index(_columns(last, 0, ego), _columns(last, j, other)) is not None:
                return True
    return False


def _columns(rows: np.ndarray, k: int, state: State) -> ActorTrace:
    """Return one actor's (t,) columns of (t, m, 5) rows."""
    x, y, heading, speed, acceleration = rows[:, k].T
    return ActorTrace(x, y, heading, speed, acceleration, state.length, state.width)


def _trace(
    scene: Scene, rows: list[tuple[float, ...]], heard: list[tuple[float, ...]], dt: float, ended: str, reported: list[str]
) -> Trace:
    """Return the recorded rows as a trace, obstacles as actors that stand."""
    table = np.array(rows, dtype=np.float64).reshape(-1, len(scene.actors), 5)
    sizes = [(a.type.length, a.type.width) for a in scene.actors]
    names = [a.name for a in scene.actors]
    if scene.obstacles:
        standing = np.array([(*o.pose, 0.0, 0.0) for o in scene.obstacles])
        table = np.concatenate([table, np.broadcast_to(standing, (len(table), *standing.shape))], axis=1)
        sizes += [(o.length, o.width) for o in scene.obstacles]
        names += [o.name for o in scene.obstacles]
    x, y, heading, speed, acceleration = np.moveaxis(table, 2, 0)
    length, width = np.array([a for a, _ in sizes]), np.array([b for _, b in sizes])
    signals = {name: np.array([row[k] for row in heard]) for k, name in enumerate(scene.signals)}
    return Trace(
        np.arange(len(table), dtype=np.float64) * dt,
        tuple(names),
        x,
        y,
        heading,
        speed,
        acceleration,
        length,
        width,
        ended,
        tuple(reported),
        signals,
    )

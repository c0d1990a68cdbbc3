"""Several runs in one simulation: isolation level `replicas`.

The simulation holds independent copies of the network; each takes a run, and the next one as soon as its run
is over, so that every step of SUMO advances many runs. The result of a run is bit-identical to that of the run
alone. An error ends the whole batch, and all runs that were not over are repeated one by one: this attributes
the error to its run, and costs the others nothing but time.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from sbt import interruption
from sbt.errors import RunError
from sbt.problem.outcome import Status
from sbt.problem.plain import Values
from sbt.problem.trace import Trace
from sbt.sumo.actors import Scene
from sbt.sumo.insertion import insert, verify
from sbt.sumo.replicas import id_prefix
from sbt.sumo.resetting import why_fresh
from sbt.sumo.session import Setup, session, unwrapped
from sbt.sumo.sumo_run import SumoRun

__all__ = ["REPLICAS", "simulate_many"]

REPLICAS = 16
"""Number of copies of the network; between about 10 and 100 the throughput hardly changes."""
_REPORT_STEPS = 64
"""Steps between two looks at the wall clock and two reports of what is running."""

Report = Callable[[Sequence[int]], None]


class _Simulation(Protocol):
    """What a batch needs of a `SumoSimulation`."""

    @property
    def step_length(self) -> float: ...
    @property
    def duration(self) -> float: ...
    @property
    def timeout(self) -> float | None: ...
    @property
    def batched(self) -> bool: ...
    @property
    def one_level(self) -> bool: ...

    def __call__(self, values: Values, seed: int) -> Trace: ...
    def build_scene(self, values: Values, seed: int) -> Scene: ...
    def setup(self, scene: Scene, replicas: int = 1) -> Setup: ...


@dataclass
class _ReplicaRun:
    """A run in one replica."""

    prefix: str
    index: int
    scene: Scene
    start: float
    run: SumoRun
    advance: Callable[[], bool]


def simulate_many(simulation: _Simulation, work: Sequence[tuple[Values, int]], at_work: Report) -> list[Trace | BaseException]:
    """Run concrete scenarios, in replicas of the network where allowed; see `SumoSimulation.simulate_many`."""
    results: dict[int, Trace | BaseException] = {}
    if simulation.batched and len(work) > 1:
        try:
            _simulate_in_replicas(simulation, work, results, at_work)
        except BaseException as error:  # the missing runs are repeated below, where the error is attributed to its run
            if interruption.is_interruption(error):
                raise
    for index, (values, seed) in enumerate(work):
        if index not in results:
            at_work((index,))
            try:
                results[index] = simulation(values, seed)
            except BaseException as error:  # a user's scenario may raise anything
                if interruption.is_interruption(error):
                    raise
                results[index] = error
    return [results[index] for index in range(len(work))]


def _simulate_in_replicas(
    simulation: _Simulation,
    work: Sequence[tuple[Values, int]],
    results: dict[int, Trace | BaseException],
    at_work: Report,
) -> None:
    """Add to `results` the traces of the runs that can share a simulation: none where roads are on different levels.

    Runs that need a load of their own (`sbt.sumo.resetting`) are left out. Which roads pass over each other cannot be seen where
    copies of the network lie on it.
    """
    if not simulation.one_level:
        return
    scenes: dict[int, Scene] = {}
    for index, (values, seed) in enumerate(work):
        at_work((index,))
        scenes[index] = simulation.build_scene(values, seed)
    setup = simulation.setup(scenes[0], REPLICAS)
    shared = {
        index: scene
        for index, scene in scenes.items()
        if simulation.setup(scene, REPLICAS) == setup
        and all(actor.pose is None for actor in scene.actors)
        and not why_fresh(setup.net, setup.options, scene.actors)
    }
    if not shared:
        return
    with session().run(setup, 0, "replicas") as sumo:
        _step_until_done(sumo, simulation, shared, results, at_work)


def _step_until_done(
    sumo: Any, simulation: _Simulation, scenes: dict[int, Scene], results: dict[int, Trace | BaseException], at_work: Report
) -> None:
    """Step, and start the next run in every replica that becomes free, until all scenes have been run."""
    step, colliding = unwrapped(sumo, "simulation", "step"), unwrapped(sumo, "simulation", "getCollidingVehiclesNumber")
    free, queue = [id_prefix(replica) for replica in range(REPLICAS)], deque(scenes)
    running: list[_ReplicaRun] = []
    steps = 0
    while queue or running:
        new: list[_ReplicaRun] = []
        while queue and free:
            new.append(_start(sumo, simulation, free.pop(), queue[0], scenes[queue.popleft()]))
        running += new
        if new or steps % _REPORT_STEPS == 0:
            at_work([entry.index for entry in running])
            _check_clock(running, simulation.timeout)
        step()
        steps += 1
        for entry in new:
            verify(sumo, entry.scene, entry.prefix)
        if colliding():
            _record_collisions(sumo, running)
        for entry in [entry for entry in running if entry.advance()]:
            results[entry.index] = entry.run.trace()
            session().remove(entry.prefix)
            running.remove(entry)
            free.append(entry.prefix)


def _start(sumo: Any, simulation: _Simulation, prefix: str, index: int, scene: Scene) -> _ReplicaRun:
    """Insert the actors of a run into a replica."""
    insert(sumo, scene, prefix)
    run = SumoRun(sumo, scene, simulation.step_length, simulation.duration, prefix, one_level=True)
    return _ReplicaRun(prefix, index, scene, time.monotonic(), run, run.advance)


def _check_clock(running: list[_ReplicaRun], timeout: float | None) -> None:
    """Raise an error where a run exceeds its limit; the time is shared by all runs."""
    if timeout is not None and time.monotonic() - min(entry.start for entry in running) > timeout * len(running):
        raise RunError(Status.TIMEOUT, f"a run must take at most {timeout:g} s")


def _record_collisions(sumo: Any, running: list[_ReplicaRun]) -> None:
    """Record SUMO's collisions in the runs in which one began in this step, as in a simulation of that run alone."""
    begun = {name.partition(".")[0] + "." for name in sumo.simulation.getCollidingVehiclesIDList()}
    runs = {entry.prefix: entry.run for entry in running if entry.prefix in begun}
    for collision in sumo.simulation.getCollisions():
        prefix = collision.collider.partition(".")[0] + "."
        if prefix in runs:
            runs[prefix].record_collision(collision.collider.removeprefix(prefix), collision.victim.removeprefix(prefix))

"""Several runs at once in one simulation: isolation level `replicas`.

The simulation holds copies of the network that know nothing of each other; each takes a run, and the next
one as soon as its run is over, so that one step of SUMO serves many runs. What a run gives is what it gives
alone, to the last bit. Whatever goes wrong ends the whole batch, and every run that was not over is run
alone instead: that decides what its error is, and costs no other run more than time.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from sbt import interruption
from sbt.errors import RunError
from sbt.problem.outcome import Status
from sbt.problem.trace import Trace
from sbt.sumo.actors import Scene
from sbt.sumo.copies import prefix
from sbt.sumo.driving import Drive
from sbt.sumo.placing import insert, verify
from sbt.sumo.session import Setup, direct, session

__all__ = ["COPIES", "simulate_many"]

COPIES = 16
"""Of the network in one simulation: from about 10 to 100 the rate hardly changes."""
_LOOK = 64
"""The wall clock is looked at, and life is shown, once in so many steps."""

AtWork = Callable[[Sequence[int]], None]
_Found = dict[int, Trace | BaseException]


class _Simulation(Protocol):
    """What a batch needs to know of a `SumoSimulation`."""

    @property
    def step_length(self) -> float: ...
    @property
    def duration(self) -> float: ...
    @property
    def timeout(self) -> float | None: ...
    @property
    def batched(self) -> bool: ...

    def __call__(self, values: Mapping[str, float], seed: int) -> Trace: ...
    def built(self, values: Mapping[str, float], seed: int) -> Scene: ...
    def setup(self, scene: Scene, copies: int = 1) -> Setup: ...


@dataclass
class _Slot:
    """A run in one copy of the network."""

    prefix: str
    index: int
    scene: Scene
    start: float
    drive: Drive
    advance: Callable[[], bool]


def simulate_many(
    simulation: _Simulation, work: Sequence[tuple[Mapping[str, float], int]], at_work: AtWork
) -> list[Trace | BaseException]:
    """Run concrete scenarios, in copies of the network where allowed; see `SumoSimulation.simulate_many`."""
    found: _Found = {}
    if simulation.batched and len(work) > 1:
        try:
            _together(simulation, work, found, at_work)
        except BaseException as error:  # whose it is and what it says, the runs that are missing show alone
            if interruption.is_interruption(error):
                raise
    for index, (values, seed) in enumerate(work):
        if index not in found:
            at_work((index,))
            try:
                found[index] = simulation(values, seed)
            except BaseException as error:  # a user's scenario may raise anything
                if interruption.is_interruption(error):
                    raise
                found[index] = error
    return [found[index] for index in range(len(work))]


def _together(
    simulation: _Simulation, work: Sequence[tuple[Mapping[str, float], int]], found: _Found, at_work: AtWork
) -> None:
    """Fill `found` with the traces of the runs that can share a simulation."""
    scenes: dict[int, Scene] = {}
    for index, (values, seed) in enumerate(work):
        at_work((index,))
        scenes[index] = simulation.built(values, seed)
    setup = simulation.setup(scenes[0], COPIES)
    waiting = [k for k, s in scenes.items() if simulation.setup(s, COPIES) == setup and all(a.pose is None for a in s.actors)]
    with session().run(setup, 0, "replicas") as sumo:
        _roll(sumo, simulation, {index: scenes[index] for index in waiting}, found, at_work)


def _roll(
    sumo: Any, simulation: _Simulation, waiting: dict[int, Scene], found: _Found, at_work: AtWork
) -> None:
    """Keep every copy busy until no run is left."""
    step, colliding = direct(sumo, "simulation", "step"), direct(sumo, "simulation", "getCollidingVehiclesNumber")
    free, queue = [prefix(copy) for copy in range(COPIES)], deque(waiting)
    busy: list[_Slot] = []
    steps = 0
    while queue or busy:
        new: list[_Slot] = []
        while queue and free:
            new.append(_begin(sumo, simulation, free.pop(), queue[0], waiting[queue.popleft()]))
        busy += new
        if new or steps % _LOOK == 0:
            at_work([slot.index for slot in busy])
            _check_time(busy, simulation.timeout)
        step()
        steps += 1
        for slot in new:
            verify(sumo, slot.scene, slot.prefix)
        if colliding():
            _tell(sumo, busy)
        over = [slot for slot in busy if slot.advance()]
        for slot in over:
            found[slot.index] = slot.drive.trace()
            session().remove(slot.prefix)
            busy.remove(slot)
            free.append(slot.prefix)


def _begin(sumo: Any, simulation: _Simulation, prefix: str, index: int, scene: Scene) -> _Slot:
    """Insert the actors of a run into a copy."""
    insert(sumo, scene, prefix)
    drive = Drive(sumo, scene, simulation.step_length, simulation.duration, prefix)
    return _Slot(prefix, index, scene, time.monotonic(), drive, drive.advance)


def _check_time(busy: list[_Slot], timeout: float | None) -> None:
    """Give up where a run has had its time, of which the others took their shares."""
    if timeout is not None and time.monotonic() - min(slot.start for slot in busy) > timeout * len(busy):
        raise RunError(Status.TIMEOUT, f"a run must take at most {timeout:g} s")


def _tell(sumo: Any, busy: list[_Slot]) -> None:
    """Pass SUMO's collisions on to the runs in which one began in this step, as a simulation of that run alone tells them."""
    begun = {name.partition(".")[0] + "." for name in sumo.simulation.getCollidingVehiclesIDList()}
    drives = {slot.prefix: slot.drive for slot in busy if slot.prefix in begun}
    for found in sumo.simulation.getCollisions():
        copy = found.collider.partition(".")[0] + "."
        if copy in drives:
            drives[copy].heard_of(found.collider.removeprefix(copy), found.victim.removeprefix(copy))

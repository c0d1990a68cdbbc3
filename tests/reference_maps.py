"""The maps of the reference implementation ec-jrc/JRC-FSM: its cases, and our drivers in the worlds that it describes.

Its worlds are one-dimensional scripts at 10 Hz, in which a step moves a vehicle by its new speed. What happens in them is
stated here in our own words; `tests/data/reference_maps.npz` holds which of the cases ended in a crash there.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sbt.sumo.actors import State
from sbt.sumo.others_ahead import OthersAhead
from sbt.sumo.reference_drivers import FuzzySafety, HumanDriver, MinimumRequirement, ReferenceDriver, ResponsibilitySensitive

DATA = Path(__file__).parent / "data" / "reference_maps.npz"
DT, LENGTH, WIDTH, STEPS = 0.1, 4.3, 1.9, 350
BESIDE = 1.6
"""Lateral clearance of the car that cuts in, when it has reached its lateral speed (m)."""
MODELS: dict[str, Callable[[], object]] = {
    "cc_human": lambda: HumanDriver(wandering=None), "reg157": MinimumRequirement, "rss": ResponsibilitySensitive,
    "fsm": FuzzySafety,
}  # fmt: skip
"""With the criterion of its maps for the human driver: a cut-in is recognised when the cars overlap laterally."""


class CutIn(NamedTuple):
    """Speeds in km/h, gap in m, lateral speed in m/s."""

    ego: float
    other: float
    gap: float
    sideways: float


class CutOut(NamedTuple):
    """Speed in km/h, gap of the car ahead to the standing one in m, lateral speed in m/s."""

    speed: float
    gap: float
    sideways: float


class Following(NamedTuple):
    """Deceleration of the car ahead in g, speed in km/h."""

    braking: float
    speed: float


def _cut_ins(egos: range | tuple[int, ...], step: int, gaps: range) -> Iterator[CutIn]:
    for ego in egos:
        for other, gap, k in itertools.product(range(10, ego, step), gaps, range(18)):
            yield CutIn(ego, other, gap, 0.1 * k)


def cases(manoeuvre: str) -> list[CutIn] | list[CutOut] | list[Following]:
    """Return the cases of a map, in the order of the recorded outcomes."""
    if manoeuvre == "cut_in_high_speed":
        return list(_cut_ins((70, 90, 110, 130), 30, range(1, 120, 2)))
    if manoeuvre == "cut_in_low_speed":
        return list(_cut_ins((10, 20, 30, 40, 50, 60), 10, range(1, 60)))
    if manoeuvre == "cut_out":
        grid = itertools.product(range(10, 132, 10), range(2, 152, 5), range(15))
        return [CutOut(speed, gap, 0.1 + 0.2 * k) for speed, gap, k in grid]
    return [Following(0.05 * k, speed) for k, speed in itertools.product(range(1, 20), range(12, 130, 2))]


def expected(manoeuvre: str, model: str) -> np.ndarray | None:
    """Return whether each case ended in a crash there, (n,) booleans; None where there is no such map."""
    with np.load(DATA) as stored:
        name = f"{manoeuvre}.{model}"
        return None if name not in stored else np.unpackbits(stored[name])[: len(cases(manoeuvre))].astype(bool)


class Car:
    """A car in these worlds."""

    def __init__(self, name: str, x: float, y: float, speed: float, length: float = LENGTH):
        self.state = State(name, length, WIDTH, DT)
        self.state.x, self.state.y, self.state.speed = x, y, speed

    def touches(self, other: Car) -> bool:
        a, b = self.state, other.state
        return abs(a.y - b.y) < WIDTH and abs(a.x - b.x) < 0.5 * (a.length + b.length)

    def drive(self, driver: ReferenceDriver, t: float, *others: Car) -> None:
        """One step: the new speed, and the way at the new speed."""
        own = self.state
        action = driver.act(t, own, tuple(o.state for o in others))
        speed = max(own.speed + action.acceleration * DT, 0.0)
        own.acceleration, own.speed = (speed - own.speed) / DT, speed
        own.x += speed * DT


def crashes(case: CutIn | CutOut | Following, model: str, *, informed: bool = False) -> bool:
    """Return whether our driver has a crash in a case.

    Args:
        case: of one of the maps.
        model: of `MODELS`.
        informed: it knows the lateral speed of a car that cuts in, as there; otherwise from its last two positions.
    """
    if isinstance(case, CutIn):
        return _cut_in(case, MODELS[model](), informed=informed)
    return (_cut_out if isinstance(case, CutOut) else _following)(case, MODELS[model]())


class Informed(OthersAhead):
    """Knows the lateral speed of the other car."""

    sideways = 0.0

    def _follow(self, *args):
        return super()._follow(*args)[0], self.sideways


def _cut_in(case: CutIn, model: object, *, informed: bool) -> bool:
    """The other car accelerates sideways by 1.5 m/s^2 to its lateral speed, and keeps it until it has crossed ego's line."""
    v_ego, v = case.ego / 3.6, case.other / 3.6
    ramp = np.arange(0.0, -case.sideways, -0.15) if case.sideways > 0 else np.empty(0)
    n, start = len(ramp), BESIDE + WIDTH
    before = start - np.cumsum(ramp[::-1] * DT)[::-1]
    moving = int(start / DT // case.sideways + 1) if case.sideways > 0 else 0
    driver = ReferenceDriver(model, v_ego)
    if informed:
        driver._others = Informed()
    ego = Car("ego", -n * v_ego * DT, 0.0, v_ego)
    other = Car("co", 0.0, 0.0, v)
    human = isinstance(model, HumanDriver)
    for i in range(STEPS + n):
        other.state.x = case.gap + LENGTH + (i - n) * v * DT
        other.state.y = before[i] if i < n else start - case.sideways * DT * min(i - n, moving)
        if ego.touches(other):
            return True
        dx, closing = other.state.x - ego.state.x, ego.state.speed - v
        if dx < -LENGTH - 1.0 or (i > n + moving and closing <= 0.0 and case.sideways > 0):
            return False
        if human and dx >= 0 and abs(other.state.y) <= WIDTH and abs(dx - LENGTH) > 2.0 * abs(closing):
            return False  # there the case is not critical for the human driver, and ends
        if informed:
            driver._others.sideways = -ramp[i] if i < n else case.sideways if i - n <= moving else 0.0
        ego.drive(driver, i * DT, other)
    return False


def _cut_out(case: CutOut, model: object) -> bool:
    """The car ahead leaves the lane before a standing one, which is seen when the first has moved sideways by 0.375 m.

    The standing car is 5 m long there, although its place is reckoned with 4.3 m.
    """
    v = case.speed / 3.6
    ego = Car("ego", v * DT, 0.0, v)
    first = model.distance(v) + LENGTH
    ahead, standing = Car("co", 0.0, 0.0, v), Car("standing", first + case.gap + LENGTH, 0.0, 0.0, length=5.0)
    moving = int(40.0 // case.sideways + 1)
    driver = ReferenceDriver(model, v)
    crashed = False
    for i in range(STEPS - 1):
        if not crashed:
            ahead.state.x, ahead.state.y = first + (i + 1) * v * DT, -case.sideways * DT * min(i + 1, moving)
            if ahead.touches(standing):
                crashed, ahead.state.speed = True, 0.0
        target = ahead if crashed else standing if ahead.state.y < -0.375 else None
        if target is not None and ego.touches(target):
            return True
        if ego.state.speed == 0.0:
            return False
        ego.drive(driver, i * DT, *(() if target is None else (target,)))
    return False


def _following(case: Following, model: object) -> bool:
    """The car ahead brakes at once and constantly to a standstill."""
    v, braking = case.speed / 3.6, case.braking * 9.81
    ego = Car("ego", v * DT, 0.0, v)
    ahead = Car("co", model.distance(v) + LENGTH, 0.0, v)
    driver = ReferenceDriver(model, v)
    for i in range(STEPS - 1):
        ahead.state.speed = max(v - i * braking * DT, 0.0)
        ahead.state.acceleration = -braking if ahead.state.speed > 0.0 else 0.0
        ahead.state.x += ahead.state.speed * DT
        if ego.touches(ahead):
            return True
        if ego.state.speed == 0.0:
            return False
        ego.drive(driver, i * DT, ahead)
    return False


def agreement(manoeuvre: str, model: str, every: int = 1, *, informed: bool = False) -> tuple[np.ndarray, np.ndarray, list]:
    """Return their outcomes, ours, and the cases; every so many cases."""
    some = cases(manoeuvre)[::every]
    return expected(manoeuvre, model)[::every], np.array([crashes(case, model, informed=informed) for case in some]), some


if __name__ == "__main__":
    for manoeuvre, model in itertools.product(("cut_in_high_speed", "cut_in_low_speed", "cut_out", "following"), MODELS):
        if expected(manoeuvre, model) is None:
            continue
        for informed in (False, True)[: 2 if manoeuvre.startswith("cut_in") else 1]:
            theirs, ours, _ = agreement(manoeuvre, model, informed=informed)
            print(
                f"{manoeuvre:18}{' informed' if informed else '':10} {model:9} {len(theirs):6}, crashes {theirs.sum():5} there "
                f"{ours.sum():5} here, agreement {100 * (theirs == ours).mean():.2f} %, theirs only "
                f"{int((theirs & ~ours).sum())}, ours only {int((ours & ~theirs).sum())}"
            )

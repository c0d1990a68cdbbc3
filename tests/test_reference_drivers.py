"""The reference drivers: laws, and agreement with the maps of the reference implementation case by case."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from reference_maps import DT, LENGTH, MODELS, Car, CutIn, agreement, crashes, expected

from sbt.errors import InputError
from sbt.plugins import load
from sbt.sumo import reference_drivers
from sbt.sumo.actors import State
from sbt.sumo.ego import Ego
from sbt.sumo.others_ahead import OthersAhead

KINDS = ("cc_human", "reg157", "rss", "fsm")
MANOEUVRES = ("cut_in_high_speed", "cut_in_low_speed", "cut_out", "following")
MAPS = [pair for pair in itertools.product(MANOEUVRES, MODELS) if expected(*pair) is not None]


def driver(kind: str, set_speed: float, **settings):
    return load("controllers", kind)(np.random.default_rng(0), set_speed, **settings)


def state(name: str, x: float, speed: float = 0.0, y: float = 0.0, dt: float = DT) -> State:
    found = State(name, LENGTH, 1.9, dt)
    found.x, found.y, found.speed = x, y, speed
    return found


@pytest.mark.parametrize(("manoeuvre", "model"), MAPS, ids=lambda value: value)
def test_maps_of_the_reference_implementation(manoeuvre, model):
    """Every n-th case of each map; all of them in `docs/reference_drivers.md`, at least 99.6 %."""
    theirs, ours, _ = agreement(manoeuvre, model, every=61 if manoeuvre != "following" else 5, informed=True)
    assert (theirs == ours).mean() >= 0.98
    assert 0 < theirs.sum() < len(theirs) or manoeuvre == "following"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dt", [0.02, 0.05, 0.1])
def test_reaction_time_to_a_step_limit_and_jerk(kind, dt):
    """A standing car turns up 30 m ahead at t = 1 s."""
    made = driver(kind, 20.0)
    model = made._model
    own, braking = state("ego", 0.0, 20.0, dt=dt), []
    for k in range(round(6.0 / dt)):
        seen = (state("co", own.x + 30.0, dt=dt),) if k * dt >= 1.0 - 1e-9 else ()
        action = made.act(k * dt, own, seen)
        braking.append(-action.acceleration)
        own.acceleration, own.speed = action.acceleration, max(own.speed + action.acceleration * dt, 0.0)
    braking = np.array(braking)
    assert not braking[: round(1.0 / dt)].any()
    begun = np.flatnonzero(braking > model.release)[0] * dt - 1.0
    assert model.reaction_time - 1e-6 <= begun <= model.reaction_time + dt
    assert braking.max() <= getattr(model, "braking", math.inf) + 1e-9
    assert np.diff(braking[braking > 0]).max() <= model.jerk * dt + 1e-9


@pytest.mark.parametrize("kind", KINDS)
def test_the_limits_hold_in_all_situations(kind):
    """Random scripts of two others: braking within limit and jerk, and no acceleration in danger."""
    rng = np.random.default_rng(7)
    for _ in range(60):
        made = driver(kind, 30.0)
        ego = Car("ego", 0.0, 0.0, float(rng.uniform(5, 35)))
        others = [Car(f"co_{k}", float(rng.uniform(6, 90)), float(rng.choice([-3.5, 0, 3.5])), float(rng.uniform(0, 30)))
                  for k in range(2)]  # fmt: skip
        sideways, pushes = rng.uniform(-1.5, 1.5, 2), rng.uniform(-8, 3, 2)
        before = 0.0
        for k in range(80):
            for other, side, push in zip(others, sideways, pushes, strict=True):
                s = other.state
                s.acceleration = push if s.speed > 0 else 0.0
                s.speed = max(s.speed + s.acceleration * DT, 0.0)
                s.x, s.y = s.x + s.speed * DT, s.y + side * DT
            ego.drive(made, k * DT, *others)
            braking = made._braking
            assert 0.0 <= braking <= made._model.braking + 1e-9
            assert braking - before <= made._model.jerk * DT + 1e-9
            before = braking


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("speed", [8.0, 20.0, 36.0])
def test_more_distance_never_makes_a_crash(kind, speed):
    """A standing car in the lane that turns up at a distance: from some distance on there is no crash any more."""

    def crash(gap: float) -> bool:
        made, ego, standing = driver(kind, speed), Car("ego", 0.0, 0.0, speed), Car("co", gap + LENGTH, 0.0, 0.0)
        for k in range(200):
            if ego.touches(standing):
                return True
            ego.drive(made, k * DT, standing)
        return False

    found = [crash(gap) for gap in np.arange(1.0, 200.0, 2.0)]
    assert found[0]
    assert not found[-1]
    assert found == sorted(found, reverse=True)


@pytest.mark.parametrize("model", MODELS)
def test_crashes_of_a_cut_in_are_one_interval_of_the_gap(model):
    """Nearer than it the ego has passed, farther it brakes in time; up to the step of the grid at its ends."""
    for ego, other, sideways in [(110, 40, 0.9), (130, 70, 1.4), (60, 10, 0.5), (40, 20, 1.7)]:
        found = np.array([crashes(CutIn(ego, other, gap, sideways), model, informed=True) for gap in range(1, 90, 2)])
        edges = int(np.count_nonzero(np.diff(found.astype(int))))
        assert edges <= 2, (ego, other, sideways, found)


def test_a_car_ahead_hides_what_is_before_it_until_it_leaves():
    view = OthersAhead()
    own, near, far = state("ego", 0.0, 20.0), state("near", 20.0, 20.0), state("far", 60.0)
    assert [each.gap for each in view.look(0.0, own, (far, near))] == [pytest.approx(20.0 - LENGTH)]
    near.y = 0.5
    assert len(view.look(0.1, own, (far, near))) == 2
    assert view.look(0.2, own, (state("behind", -5.0), state("beside", 0.0, 20.0, y=3.0))) == []


def test_the_human_driver_perceives_a_cut_in_after_wandering_and_evaluation():
    """0.375 m at 1 m/s, and 0.4 s; the critical TTC is 2 s."""
    for gap, expects in ((18.0, True), (60.0, False)):
        made, onset = driver("cc_human", 20.0), None
        for k in range(160):
            other = state("co", gap + LENGTH, 10.0, y=3.5 - 0.01 * k, dt=0.01)  # keeps its gap as the script says so
            if made.act(0.01 * k, state("ego", 0.0, 20.0, dt=0.01), (other,)).acceleration < 0 and onset is None:
                onset = 0.01 * k
        assert (onset is not None) == expects
        if expects:
            assert onset == pytest.approx(0.375 + 0.4, abs=0.03)


@pytest.mark.parametrize("kind", KINDS)
def test_wrong_settings_say_so(kind):
    with pytest.raises(InputError, match="must be a number >= 0"):
        Ego.of(kind, reaction_time=-1)
    with pytest.raises(InputError, match="must be ones that"):
        Ego.of(kind, nonsense=1)


def test_drives_on_after_danger_and_reacts_anew():
    made, own = driver("cc_human", 20.0), state("ego", 0.0, 20.0)
    for k in range(30):
        own.speed = max(own.speed + made.act(DT * k, own, (state("co", own.x + 12.0),)).acceleration * DT, 0.0)
    assert own.speed < 12.0
    for k in range(30, 60):
        own.speed += made.act(DT * k, own, ()).acceleration * DT
    assert made.act(6.0, own, ()).acceleration > 0.0
    assert made.act(6.1, own, (state("co", own.x + 12.0),)).acceleration == -reference_drivers.HumanDriver().release


@pytest.mark.sumo
@pytest.mark.parametrize("kind", KINDS)
def test_as_ego_of_scenarios(kind):
    """The same concrete scenario: the others start alike; more time gap never makes a failure."""
    for name, inputs in (
        ("emergency_braking", {"a_co": -9.0, "v_co_min_frac": 0.1, "v_co": 120.0, "v_ego": 120.0}), ("cut_in", {"d_v": 60.0}),
    ):  # fmt: skip
        own, judged = load("scenarios", name), load("scenarios", name).configured(ego={"kind": kind})
        critical = []
        for gap in np.linspace(0.6, 3.0, 7):
            trace, own_trace = (s.simulate({**inputs, "d_t": float(gap)}, 3) for s in (judged, own))
            assert np.array_equal(trace.x[0], own_trace.x[0])
            critical.append(bool(judged.requirement.is_critical(judged.measure(trace))))
            assert trace.actor("ego").acceleration.min() >= -reference_drivers.FULL_BRAKING - 1e-6
        assert critical == sorted(critical, reverse=True), (name, critical)
    following = load("scenarios", "following").configured(ego={"kind": kind})
    values = {p.name: p.centre for p in following.space.parameters}
    trace = following.simulate(values, 0)
    assert trace.ended in ("resolved", "duration")
    assert trace.actor("ego").speed.max() > 4.0

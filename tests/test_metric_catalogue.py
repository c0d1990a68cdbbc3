"""The metric catalogue: closed forms, oracles (shapely, SUMO's SSM device), symmetry, and finite always."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sbt import plugins
from sbt.errors import InputError
from sbt.metrics.braking import btn, btn_max, drac, mdrac, mdrac_max, mttc_min
from sbt.metrics.comfort import deceleration_max, jerk, jerk_max
from sbt.metrics.exposure import tet, tit
from sbt.metrics.geometry import corners, time_to_contact
from sbt.metrics.longitudinal import HORIZON, drac_max, impact_speed, ttc_min
from sbt.metrics.planar import distance_min, pet, severity, ttc_2d, ttc_2d_min
from sbt.metrics.reference_line import Curve, deviation, heading_error_max, lateral_error_max
from sbt.metrics.rss import Rss, rss_lateral_min, rss_longitudinal_min, rss_violation
from sbt.metrics.signals import signal
from sbt.problem.metric import Metric
from sbt.problem.trace import ActorTrace, Trace

L, W = 5.0, 1.8


def record(*paths: np.ndarray, dt: float = 0.05, length: float = L, width: float = W) -> Trace:
    """A trace of ego, co, ... from (t, 5) arrays of x, y, heading, speed, acceleration."""
    x, y, heading, speed, acceleration = np.moveaxis(np.stack(paths, axis=1), 2, 0)
    m = len(paths)
    names = ("ego", "co", *(f"co{k}" for k in range(2, m)))
    return Trace(np.arange(len(x)) * dt, names, x, y, heading, speed, acceleration, np.full(m, length), np.full(m, width))


def path(x=0.0, y=0.0, heading=0.0, speed=0.0, acceleration=0.0, *, duration=4.0, dt=0.05) -> np.ndarray:
    """Straight on at a constant acceleration, from x, y."""
    t = np.arange(round(duration / dt) + 1) * dt
    s, v = speed * t + acceleration * t**2 / 2, speed + acceleration * t
    one = np.ones_like(t)
    return np.stack([x + s * np.cos(heading), y + s * np.sin(heading), heading * one, v, acceleration * one], axis=1)


def following(gap: float, v_ego: float, v_co: float, a_ego=0.0, a_co=0.0, **more: float) -> Trace:
    ego, co = path(0.0, 0.0, 0.0, v_ego, a_ego, **more), path(gap + L, 0.0, 0.0, v_co, a_co, **more)
    return record(ego, co, dt=more.get("dt", 0.05))


# --- along the path ----------------------------------------------------------------------------------------------


def test_mttc_is_the_root_of_the_motion():
    """20 m at 5 m/s, ego speeding up by 2 m/s^2: 20 = 5 t + t^2."""
    trace = following(20.0, 15.0, 10.0, a_ego=2.0, duration=0.0)
    assert mttc_min()(trace) == pytest.approx((-5 + math.sqrt(105)) / 2)
    assert mttc_min()(following(20.0, 15.0, 10.0, duration=0.0)) == ttc_min()(following(20.0, 15.0, 10.0, duration=0.0))
    assert mttc_min()(following(20.0, 15.0, 10.0, a_ego=-1.0, duration=0.0)) == HORIZON  # 25 / 2 m are enough
    assert mttc_min()(following(20.0, 10.0, 15.0, a_co=-9.0, duration=0.0)) == pytest.approx((5 + math.sqrt(385)) / 9)
    assert mttc_min()(following(2.0, 15.0, 10.0)) == 0.0


def test_drac_and_its_kin():
    """The SSM device's example: 42 m at 10 m/s need 100 / 84, after 1 s 100 / 64."""
    trace = following(42.0, 20.0, 10.0, duration=0.0)
    assert drac_max()(trace) == pytest.approx(100 / 84)
    assert mdrac_max()(trace) == pytest.approx(100 / 64)
    assert mdrac_max(reaction=0.0)(trace) == drac_max()(trace)
    assert mdrac_max()(following(9.0, 20.0, 10.0, duration=0.0)) == 100.0
    assert btn_max(capability=5.0)(trace) == pytest.approx(20 / 84)
    assert mdrac_max()(following(42.0, 10.0, 20.0)) == btn_max()(following(42.0, 10.0, 20.0)) == 0.0
    for name in ("drac", "mdrac", "btn"):
        assert (np.diff(signal(following(42.0, 20.0, 10.0, duration=3.0), name)) > 0).all()
    np.testing.assert_array_equal(drac(trace, "ego", "co", 0.0), mdrac(trace, "ego", "co", 0.0, reaction=0.0))


@given(st.floats(1, 60), st.floats(1, 40), st.floats(0, 40), st.floats(-9, 0))
@settings(max_examples=60, deadline=None)
def test_btn_is_the_braking_that_just_suffices(gap, v_ego, v_co, a_co):
    """Simulated: a little more braking keeps clear of the other, which brakes to a standstill; a little less does not."""
    needed = float(btn(following(gap, v_ego, v_co, a_co=a_co, duration=0.0), "ego", "co", 0.0, capability=1.0)[0])
    if not 0.05 < needed < 60:
        return
    stop_co = v_co / -a_co if a_co < 0 else math.inf
    for factor, touches in ((1.02, False), (0.98, True)):
        t = np.linspace(0.0, v_ego / (factor * needed), 4001)
        ego = v_ego * t - factor * needed * t**2 / 2
        held = np.minimum(t, stop_co)
        assert bool((gap + v_co * held + a_co * held**2 / 2 - ego < 0).any()) == touches


def test_exposure_by_hand():
    """10 m/s of closing from 40 m: TTC falls from 4 s to 1 s in 3 s, below 3 s for 2 s, area 2."""
    trace = following(40.0, 20.0, 10.0, duration=3.0, dt=0.01)
    assert tet()(trace) == pytest.approx(2.0, abs=0.011)
    assert tit()(trace) == pytest.approx(2.0, abs=1e-3)
    assert tit(threshold=2.0)(trace) == pytest.approx(0.5, abs=1e-3)
    assert (tet()(following(40.0, 10.0, 20.0)), tit()(following(40.0, 10.0, 20.0))) == (0.0, 0.0)
    beyond, until = (following(9.8, 20.0, 10.0, duration=d) for d in (3.0, 1.0))
    for metric in (tet(), tit(), rss_violation()):
        assert metric(beyond) == metric(until)  # what follows a collision does not count


# --- in the plane ------------------------------------------------------------------------------------------------


def random_pairs(n: int, seed: int) -> tuple[ActorTrace, ActorTrace]:
    rng = np.random.default_rng(seed)

    def one(length: float, width: float) -> ActorTrace:
        x, y = rng.uniform(-20, 20, (2, n))
        return ActorTrace(x, y, rng.uniform(-4, 4, n), rng.uniform(0, 12, n), np.zeros(n), length, width)

    return one(5.0, 1.8), one(8.0, 2.5)


def moved(actor: ActorTrace, t: np.ndarray) -> ActorTrace:
    x, y = actor.x + actor.speed * np.cos(actor.heading) * t, actor.y + actor.speed * np.sin(actor.heading) * t
    return ActorTrace(x, y, actor.heading, actor.speed, actor.acceleration, actor.length, actor.width)


def boxes(shapely, actor: ActorTrace):
    return shapely.polygons(corners(actor))


def test_2d_ttc_is_where_shapely_sees_the_contact():
    shapely = pytest.importorskip("shapely")
    a, b = random_pairs(2000, 1)
    ttc = time_to_contact(a, b)
    hit = np.isfinite(ttc)
    assert 100 < hit.sum() < 1900
    at = np.where(hit, ttc, 0.0)
    apart = shapely.distance(boxes(shapely, moved(a, at)), boxes(shapely, moved(b, at)))
    assert apart[hit].max() < 1e-9
    later = hit & (ttc > 1e-3)
    before = shapely.distance(boxes(shapely, moved(a, at - 1e-3)), boxes(shapely, moved(b, at - 1e-3)))
    assert (before[later] > 0).all()
    for t in np.linspace(0, 20, 81):
        far = shapely.distance(boxes(shapely, moved(a, np.full(2000, t))), boxes(shapely, moved(b, np.full(2000, t))))
        assert (far[~hit] > 0).all()


def crossing(delay: float, v_ego=10.0, v_co=8.0, dt=0.05) -> Trace:
    """Ego along x reaches the conflict area at 2 s; co along y comes `delay` after ego has left it."""
    leaves = 2.0 + (L + W) / v_ego
    ego = path(-W / 2 - L / 2 - 2.0 * v_ego, 0.0, 0.0, v_ego, duration=8.0, dt=dt)
    co = path(0.0, -W / 2 - L / 2 - (leaves + delay) * v_co, math.pi / 2, v_co, duration=8.0, dt=dt)
    return record(ego, co, dt=dt)


@pytest.mark.parametrize("dt", [0.05, 0.2, 0.5])
@pytest.mark.parametrize("delay", [0.03, 0.51, 2.0])
def test_pet_at_a_right_angle_is_that_of_the_conflict_area(delay, dt):
    trace = crossing(delay, dt=dt)
    assert pet()(trace) == pytest.approx(delay, abs=dt / 500)
    assert pet(ego="co", other="ego")(trace) == pytest.approx(pet()(trace), abs=dt / 500)


def test_pet_of_others():
    assert pet()(crossing(-0.2)) == 0.0  # both are in the conflict area: a collision here
    assert pet()(following(20.0, 10.0, 10.0, duration=6.0)) == pytest.approx(2.0, abs=1e-3)  # the time gap
    assert pet()(record(path(speed=10.0), path(y=5.0, speed=10.0))) == HORIZON  # side by side
    assert pet()(following(20.0, 10.0, 10.0, duration=0.0)) == HORIZON
    assert pet()(following(300.0, 10.0, 10.0)) == HORIZON


def test_severity_goes_on_past_the_crash():
    """Braking from 20 m/s for a standing car: metres to spare, then minus the speed at impact."""
    gaps = np.linspace(15.0, 30.0, 16)
    values = []
    for gap in gaps:
        t = np.arange(0, 2.5, 0.01)
        v = 20.0 - 8.0 * t
        ego = np.stack([20 * t - 4 * t**2, 0 * t, 0 * t, v, 0 * t - 8], axis=1)
        trace = record(ego, path(gap + L, duration=2.49, dt=0.01), dt=0.01)
        values.append(severity()(trace))
        left = gap - 25.0
        assert values[-1] == pytest.approx(left if left > 0 else -math.sqrt(max(-left, 0) * 16), abs=0.15)
        assert distance_min()(trace) == pytest.approx(max(left, 0.0), abs=0.01)
        assert impact_speed()(trace) == max(-values[-1], 0.0) or left > 0
    assert (np.diff(values) > 0).all()


def test_2d_ttc_of_a_crossing_is_when_both_are_there():
    trace = crossing(-0.3)
    k = trace.time < 1.5
    np.testing.assert_allclose((ttc_2d(trace) + trace.time)[k], (ttc_2d(trace) + trace.time)[0], atol=1e-9)
    assert ttc_2d_min()(trace) == 0.0
    assert ttc_2d_min()(crossing(0.5)) == HORIZON


# --- RSS, comfort, course ----------------------------------------------------------------------------------------


def test_rss_by_hand():
    """Both at 20 m/s: 20 + 1.75 + 23.5^2 / 8 - 400 / 16 = 65.78125 m."""
    trace = following(50.0, 20.0, 20.0)
    assert rss_longitudinal_min()(trace) == pytest.approx(50 - 65.78125)
    assert rss_violation()(trace) == pytest.approx(4.0)
    assert rss_violation()(following(66.0, 20.0, 20.0)) == 0.0
    assert rss_longitudinal_min(ego="co", other="ego")(trace) == 1000.0  # the duty is that of the one behind
    oncoming = record(path(speed=20.0, duration=0.0), path(200.0, 0.0, math.pi, 10.0, duration=0.0))
    one, two = 20 + 1.75 + 23.5**2 / 6, 10 + 1.75 + 13.5**2 / 8
    assert rss_longitudinal_min()(oncoming) == pytest.approx(195.0 - one - two)
    assert rss_longitudinal_min(rules=Rss(response=0.0))(trace) == pytest.approx(50 - 400 / 8 + 400 / 16)
    beside = record(path(speed=20.0), path(y=2.0, speed=20.0))
    assert rss_lateral_min()(beside) == pytest.approx(2.0 - W - (0.1 + 0.1 + 2 * 0.04 / 1.6))
    assert rss_violation()(beside) == pytest.approx(4.0)
    assert rss_violation(rules=Rss(response=0.1))(beside) == 0.0
    assert rss_violation()(record(path(speed=20.0), path(30.0, -20.0, math.pi / 2, 10.0))) == 0.0  # crossing: not judged
    with pytest.raises(InputError, match=r"rss\.braking must be > 0"):
        Rss(braking=0.0)


@given(st.floats(0, 40), st.floats(0, 40), st.floats(0, 10), st.floats(0, 3))
def test_rss_keeps_two_apart_whatever_they_do(v_rear, v_front, a, response):
    """The worst case of the definition, simulated: speed up while reacting, then brake weakly; the front one hard."""
    rules = Rss(response=response, acceleration=a)
    safe = float(rules.same_direction(np.array(v_rear), np.array(v_front)))
    fastest = v_rear + a * response
    t = np.linspace(0, response + fastest / rules.braking + 1e-9, 500)
    late = np.maximum(t - response, 0.0)
    early = np.minimum(t, response)
    rear = v_rear * early + a * early**2 / 2 + fastest * late - rules.braking * late**2 / 2
    held = np.minimum(t, v_front / rules.hard_braking)
    front = v_front * held - rules.hard_braking * held**2 / 2
    stopped = rear[-1] <= front[-1] + safe + 1e-6
    assert stopped
    assert safe >= 0


def test_comfort_by_hand():
    t = np.arange(0, 3, 0.1)
    ego = np.stack([t, 0 * t, 0 * t, 10 - t**3 / 6, -(t**2) / 2], axis=1)
    trace = record(ego, path(50.0, duration=2.9, dt=0.1), dt=0.1)
    assert jerk_max()(trace) == pytest.approx(2.85)
    assert deceleration_max()(trace) == pytest.approx(2.9**2 / 2)
    assert (jerk_max()(following(9, 10, 9, duration=0.05)), deceleration_max()(following(9, 5, 5, a_ego=1.0))) == (0, 0)


def test_course_against_a_circle():
    angle = np.linspace(0, math.pi / 2, 2001)
    line = 50 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    at = np.linspace(0.1, 1.4, 60)
    one = np.ones(60)
    ego = np.stack([51.5 * np.cos(at), 51.5 * np.sin(at), at + math.pi / 2 + 0.1, one, 0 * one], axis=1)
    trace = record(ego, ego)
    offset, turn = deviation(trace.actor("ego"), line)
    np.testing.assert_allclose(offset, -1.5, atol=1e-4)  # right of the line
    np.testing.assert_allclose(turn, 0.1, atol=1e-3)
    assert lateral_error_max(line)(trace) == pytest.approx(1.5, abs=1e-4)
    assert heading_error_max(line)(trace) == pytest.approx(0.1, abs=1e-3)
    circuit = np.array([[0.0, 0.0], [20.0, 0.0], [20.0, 20.0], [-20.0, 20.0], [-20.0, -40.0]])
    down = deviation(record(path(-19.5, 0.0, -math.pi / 2), path()).actor("ego"), circuit)  # where the first segment would lead
    assert (down[0][0], down[1][0]) == pytest.approx((0.5, 0.0))
    beyond = deviation(record(path(-7.0, 2.0, math.pi), path()).actor("ego"), np.array([[0.0, 0.0], [10.0, 0.0]]))
    assert (beyond[0][0], beyond[1][0]) == (2.0, math.pi)
    with pytest.raises(ValueError, match="at least two points"):
        deviation(trace.actor("ego"), np.zeros((2, 2)))


@pytest.mark.parametrize("known", [lambda k: (k <= 20) | (k >= 30), lambda k: k % 5 != 3, lambda k: (k <= 25) | (k % 5 == 0)])
def test_the_jerk_at_uneven_steps_is_that_between_the_middles_of_the_steps(known):
    """Accelerations are differences of speeds: a constant jerk of 2 m/s^3 was one of 11 after a hole of .9 s."""
    k = np.flatnonzero(known(np.arange(51)))
    time = 0.1 * k
    speed = time**2
    acceleration = np.concatenate([[0.0], np.diff(speed) / np.diff(time)])
    ego = ActorTrace(time**3 / 3.0, 0.0 * time, 0.0 * time, speed, acceleration, 5.0, 1.8)
    np.testing.assert_allclose(jerk(ego, time), [0.0, 0.0, *np.full(len(k) - 2, 2.0)], rtol=1e-9)


def test_metrics_of_an_ego_that_is_absent_for_a_moment_are_those_of_when_it_is_there():
    """Its braking of 6 m/s^2 was 0, and its jerk and its offset were NaN."""
    time = np.arange(0.0, 5.01, 0.1)
    braking = np.where(time > 2.05, -6.0, np.where(time > 1.05, -2.0, 0.0))
    gone = (time > 3.02) & (time < 3.48)
    a = np.where(gone, np.nan, np.where(time > 3.48, -1.0, braking))
    there = np.where(gone, np.nan, 0.0)
    x, y = np.where(gone, np.nan, 20.0 * time), there + 0.3
    trace = Trace(time, ("ego",), *(v[:, None] for v in (x, y, there + 0.1, there + 20.0, a)), np.array([5.0]), np.array([1.8]))
    assert deceleration_max()(trace) == 6.0
    assert jerk_max()(trace) == pytest.approx(40.0)
    assert lateral_error_max([(0.0, 0.0), (1.0, 0.0)])(trace) == pytest.approx(0.3)
    assert heading_error_max([(0.0, 0.0), (1.0, 0.0)])(trace) == pytest.approx(0.1)
    rate = jerk(trace.actor("ego"), time)
    assert (np.isnan(rate) == gone).all()
    after = np.flatnonzero(time > 3.48)
    assert (rate[after] == 0.0).all(), "across the absence nothing is measured"


def test_curve_projects_back_what_is_beside_it():
    curve = Curve((3.0, -2.0, 0.4), ((10.0, 0.0), (10.0, 1 / 30), (20.0, 1 / 30), (15.0, -1 / 40)))
    s = np.linspace(0.5, curve.length - 0.5, 40)
    for left in (-3.0, 0.0, 2.0):
        found = np.array([curve.project(x, y) for x, y in curve.offset_points(s, left)])
        assert np.abs(found[:, 0] - s).max() < 5e-3
        assert np.abs(found[:, 1] - left).max() < 2e-3


# --- all of them -------------------------------------------------------------------------------------------------

CATALOGUE: list[Metric] = [plugins.load("metrics", name) for name in plugins.names("metrics")]
SYMMETRIC = {"ttc_2d_min", "distance_min", "pet", "severity", "impact_speed", "collision"}

places = st.tuples(st.floats(-40, 40), st.floats(-10, 10), st.floats(-4, 4), st.floats(0, 30), st.floats(-3, 3))


@given(places, places, st.integers(0, 20))
@settings(max_examples=60, deadline=None)
def test_every_metric_is_finite_and_symmetric_ones_do_not_care_who_is_ego(one, two, n):
    trace = record(*(path(*p, duration=n * 0.1, dt=0.1) for p in (one, two)), dt=0.1)
    swapped = record(*(path(*p, duration=n * 0.1, dt=0.1) for p in (two, one)), dt=0.1)
    for metric in CATALOGUE:
        value = metric(trace)  # raises where it is not finite
        if metric.name in SYMMETRIC:
            assert metric(swapped) == pytest.approx(value, abs=1e-6), metric.name


def test_every_metric_is_described():
    far = record(path(speed=10.0), path(3000.0, 3000.0, 0.0, 10.0))
    for metric in CATALOGUE:
        assert metric.description
        assert metric.direction in ("low", "high")
        assert metric(far) == metric.without, metric.name
    page = (Path(__file__).parent.parent / "docs" / "metrics.md").read_text()
    missing = [metric.name for metric in CATALOGUE if f"`{metric.name}`" not in page]
    assert not missing


# --- SUMO's own measurements ---------------------------------------------------------------------------------------

SSM_RUN = """
import json, sys
import libsumo
net, ssm, out = sys.argv[1:]
libsumo.start(["sumo", "-n", net, "--step-length", "0.1", "--step-method.ballistic", "true", "--no-step-log", "true",
    "--device.ssm.explicit", "ego", "--device.ssm.measures", "TTC DRAC", "--device.ssm.thresholds", "50 0.1",
    "--device.ssm.range", "300", "--device.ssm.trajectories", "true", "--device.ssm.file", ssm, "--precision", "9",
    "--insertion-checks", "none", "--collision.action", "warn", "--collision.mingap-factor", "0"])
libsumo.route.add("r", ["road"])
for name, position, speed in (("ego", 100.0, 25.0), ("co", 150.0, 15.0)):
    libsumo.vehicle.add(name, "r", depart="0", departPos=str(position), departSpeed=str(speed), departLane="1")
    libsumo.vehicle.setLength(name, 4.7)
    libsumo.vehicle.setLaneChangeMode(name, 0)
rows = []
for k in range(40):
    libsumo.simulationStep()
    state = []
    for name, acceleration in (("ego", -1.2), ("co", -0.8)):
        libsumo.vehicle.setSpeedMode(name, 32)
        x, y = libsumo.vehicle.getPosition(name)
        v = libsumo.vehicle.getSpeed(name)
        libsumo.vehicle.setSpeed(name, v + acceleration * 0.1)
        state.append((x - 4.7 / 2, y, 0.0, v, 0.0))
    rows.append((libsumo.simulation.getTime(), state))
libsumo.close()
json.dump(rows, open(out, "w"))
"""


@pytest.mark.sumo
def test_ttc_and_drac_are_those_of_sumos_ssm_device(tmp_path):
    net = Path(__file__).parent.parent / "sumo_nets" / "straight" / "straight.net.xml"
    ssm, out = tmp_path / "ssm.xml", tmp_path / "rows.json"
    subprocess.run([sys.executable, "-c", SSM_RUN, str(net), str(ssm), str(out)], check=True, capture_output=True)
    rows = json.loads(out.read_text())
    trace = record(*np.moveaxis(np.array([state for _, state in rows]), 1, 0), dt=0.1, length=4.7)
    # SUMO's time is that of the end of the step; the device writes that of its beginning
    begin = [round(t - 0.1, 3) for t, _ in rows]
    ours = {name: dict(zip(begin, signal(trace, name).tolist(), strict=True)) for name in ("ttc", "drac")}
    conflict = ET.parse(ssm).getroot().find("conflict")
    assert conflict is not None
    times = [round(float(t), 3) for t in conflict.find("timeSpan").get("values").split()]
    compared = 0
    for name in ("ttc", "drac"):
        values = conflict.find(f"{name.upper()}Span").get("values").split()
        for t, value in zip(times, values, strict=True):
            if value != "NA" and t in ours[name] and float(value) < HORIZON:
                assert ours[name][t] == pytest.approx(float(value), rel=1e-6), (name, t)
                compared += 1
    assert compared > 50
    assert ttc_min()(trace) == pytest.approx(float(conflict.find("minTTC").get("value")), rel=1e-6)
    assert drac_max()(trace) == pytest.approx(float(conflict.find("maxDRAC").get("value")), rel=1e-6)

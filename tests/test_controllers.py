"""Sensors, vehicle dynamics, controllers, traffic streams and their settings: everything of a simulation but SUMO."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sbt.errors import InputError
from sbt.execution.spec import ScenarioSpec
from sbt.metrics.reference_line import Curve
from sbt.plugins import load
from sbt.seeds import stream
from sbt.sumo.actors import Actor, Obstacle, Scene, State, VehicleType
from sbt.sumo.drivers import ArcExit, SpeedProfile, Stationary
from sbt.sumo.dynamics import Gust, JerkLimitedStop, SingleTrack
from sbt.sumo.ego import Ego
from sbt.sumo.lane_keeping import MarkingSensor
from sbt.sumo.models import vtype_attributes
from sbt.sumo.occlusion import Occluders, outline
from sbt.sumo.sensors import Track
from sbt.sumo.simulation import SumoSimulation
from sbt.sumo.traffic import MIN_HEADWAY, TrafficStream, ego_type

# Settings


def simulation(**settings: Any) -> SumoSimulation:
    return SumoSimulation(scene=lambda values, ego, rng: Scene(()), **{"net": "straight", "duration": 1.0, **settings})


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: simulation(step_length=0.0125), "whole milliseconds, but got step_length 0.0125 s"),
        (lambda: simulation(step_length=2.0), "0 < step_length <= duration must hold"),
        (lambda: simulation(duration=-1.0), "0 < step_length <= duration must hold"),
        (lambda: simulation(isolation="replicas"), "auto or fresh, reuse here, but got 'replicas'"),
        (lambda: simulation(options=("--seed", "3")), "--seed is set by sbt already"),
        (lambda: VehicleType(length=0.0), "length > 0 and width > 0, but got 0.0 m"),
        (lambda: Actor("a", ("road",), 0, math.nan, 1.0), "position must be finite"),
        (lambda: Actor("a", ("road",), 0, 1.0, -1.0), "speed >= 0, but got"),
        (lambda: Ego.of("acc_aab"), "did you mean 'acc_aeb'"),
        (lambda: Ego.of("acc_aeb", reaction_tme=0.2), "ego settings must be ones that 'acc_aeb' takes, but got"),
        (lambda: Ego.of("acc_aeb", aeb_braking=-3.0), "ego.aeb_braking must be a number >= 0, but got -3.0"),
        (lambda: Ego.of("acc_aeb", aeb_braking="hard"), "ego.aeb_braking must be a number >= 0, but got 'hard'"),
        (lambda: Ego.of("sumo", tau=[1]), r"ego.tau must be a finite number, but got \[1\]"),
        (lambda: ScenarioSpec("cut_in", ego={"kind": "sumo", "model": "IDM"}, isolation="reuse").resolve(), "auto or fresh here"),
        (lambda: ScenarioSpec("cut_in", step_length=0.0333).resolve(), "whole milliseconds"),
        (lambda: Ego.of("sumo", model="idm"), r"but got 'idm' \(did you mean 'IDM'\?\)"),
        (lambda: Ego.of("sumo", model="IDM", taw=1.0), r"attributes of IDM or LC2013, but got 'taw' \(did you mean 'tau'\?\)"),
        (lambda: Ego.of("sumo", model="IDM", cc1=1.0), "but got 'cc1'; it belongs to W99"),
        (lambda: Ego.of("sumo", lane_change="LC2014"), "one of SUMO's LC2013, SL2015, DK2008, but got 'LC2014'"),
        (lambda: Ego.of("sumo", tau="near"), "ego.tau must be a finite number, but got 'near'"),
        (lambda: Ego.of("sumo", tau={"low": 1.0}), "a value, a range such as {min: 0.5, max: 2.0}, or"),
        (lambda: Ego.of("sumo", tau={"min": 2.0, "max": 1.0}), "ego_tau"),
        (lambda: load("scenarios", "highway_merge").configured(ego={"kind": "sumo", "lane_change": "SL2015"}), "lateral-resol"),
        (lambda: TrafficStream("a", ("r",), 0, 10.0).draw(stream(1), 9000.0, 10.0, 90.0, 0.0), "carries"),
    ],
)  # fmt: skip
def test_wrong_settings_are_an_input_error_with_rule_and_value(build: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build()


@pytest.mark.parametrize("text", ["<net></net>", "<net version='1.20'><edge", "no xml", "<routes version='1'/>"])
def test_a_file_that_is_no_network_is_refused_before_sumo_sees_it(tmp_path: Path, text: str) -> None:
    (tmp_path / "bad.net.xml").write_text(text)
    with pytest.raises(InputError, match="a network must"):
        simulation(net=str(tmp_path / "bad.net.xml")).prepare()


def test_numpy_scalars_are_settings_of_an_ego() -> None:
    plain = Ego.of("sumo", tau=float(np.float32(1.2)), accel={"min": 1.0, "max": 3.0})
    assert Ego.of("sumo", tau=np.float32(1.2), accel={"min": np.float64(1.0), "max": np.int64(3)}) == plain
    assert Ego.of("acc_aeb", reaction_time=np.float32(0.5)) == Ego.of("acc_aeb", reaction_time=0.5)
    with pytest.raises(InputError, match="finite number"):
        Ego.of("sumo", tau=np.bool_(True))


def test_actors_by_pose_need_a_controller() -> None:
    with pytest.raises(InputError, match="needs a controller"):
        Actor("a", ("road",), 0, 0.0, 0.0, None, pose=(0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="must have a pose"):
        Actor("a", ("road",), 0, 0.0, 0.0, Stationary(), person=True)


def test_the_type_of_an_automated_ego_is_the_models() -> None:
    kind = ego_type(Ego.of("sumo", model="IDM", tau=1.4, length=4.2), 10.0, 20.0)
    attributes = dict(kind.attributes)
    assert (kind.length, attributes["carFollowModel"], attributes["tau"], attributes["sigma"]) == (4.2, "IDM", "1.4", "0")
    assert float(attributes["speedFactor"]) == pytest.approx(0.5)
    assert vtype_attributes({}) == {"carFollowModel": "Krauss", "laneChangeModel": "LC2013"}


# Vehicle dynamics and scripted controllers


def test_profiles_integrate_their_speed() -> None:
    t = np.linspace(0.0, 20.0, 200001)
    stop = JerkLimitedStop(5.0, 2.0, 8.0, 6.0)
    soft = JerkLimitedStop(0.5, 0.0, 5.0, 9.0)
    profile = SpeedProfile(1.5, 6.0, 2.0, 4.0)
    for moving, offset in ((stop, -10.0), (soft, 0.0), (profile, 0.0)):
        speed = np.array([moving.at(v) for v in t[::20]])
        covered = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))]) * (t[20] - t[0]) + offset
        assert np.abs(covered - [moving.distance(v) for v in t[::20]]).max() < 1e-4
        assert speed[-1] == 0.0
    late = JerkLimitedStop(0.0, 1.0, 5.0, 9.0)
    assert (late.at(3.0), late.distance(3.0)) == (0.0, 0.0)


def test_gusts_do_not_depend_on_the_step_and_have_their_deviation() -> None:
    gusts = [Gust(np.random.Generator(np.random.PCG64(k)), 0.2) for k in range(200)]
    speeds = np.array([[g.speed(t) for t in np.arange(0, 20, 0.5)] for g in gusts])
    assert speeds.std() == pytest.approx(0.2, rel=0.05)
    t = np.linspace(0.0, 5.0, 5001)
    covered = np.trapezoid([gusts[0].speed(v) for v in t], t)
    assert gusts[0].distance(5.0) == pytest.approx(covered, abs=1e-6)


def test_single_track_drives_a_circle() -> None:
    model = SingleTrack(2.8)
    x, y, heading = 0.0, 0.0, 0.0
    steering = model.steering(1 / 20)
    radius = 2.8 / (math.tan(steering) * math.cos(model.slip(steering)))
    for _ in range(1000):
        x, y, heading = model.move(x, y, heading, steering, 2 * math.pi * radius / 1000)
    assert (x, y) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert heading == pytest.approx(2 * math.pi)
    assert model.move(0.0, 0.0, 0.5, 0.0, 2.0) == pytest.approx((2 * math.cos(0.5), 2 * math.sin(0.5), 0.5))


def test_arc_exit_turns_on_its_radius() -> None:
    leaving = ArcExit((0.0, 0.0, math.pi / 2), 10.0, 2.0, 2.0, 1.0, 4.0)
    own = State("co_1", 5.0, 1.8)
    poses = []
    for k in range(60):
        action = leaving.act(0.05 * k, own, ())
        assert action.pose is not None
        poses.append(action.pose)
    x, y, _ = np.array(poses).T
    assert np.allclose(np.hypot(x + 10.0, y), 10.0)


# Sensors


def test_a_track_follows_hard_braking_without_a_lag_and_smooths_the_noise() -> None:
    t = np.arange(60) * 0.05
    gap, speed = 60.0 - 20.0 * t + 4.0 * t**2, 15.0 + 8.0 * t  # ego at 35 m/s, the target's speed grows by 8 m/s^2
    noise = stream(1, "track").standard_normal((60, 2)) * (0.25, 0.15)
    exact, noisy = Track(0.3), Track(0.3)
    ego, co = [35.0] * 60, ["co"] * 60
    still = np.array([exact(*row) for row in zip(t, co, ego, gap, speed, strict=True)])
    assert np.abs(still[-20:] - np.stack([gap, 35.0 - speed], axis=1)[-20:]).max() < 0.02
    rough = np.array([noisy(*row) for row in zip(t, co, ego, gap + noise[:, 0], speed + noise[:, 1], strict=True)])
    assert (np.diff(rough[-30:] - still[-30:], axis=0).std(axis=0) < 0.5 * np.diff(noise[-30:], axis=0).std(axis=0)).all()
    assert noisy(3.0, "another", 35.0, 7.0, 30.0) == (7.0, 5.0)  # a new track begins with what is measured


def test_occluders_hide_what_shapely_says() -> None:
    shapely = pytest.importorskip("shapely")
    rng = np.random.Generator(np.random.PCG64(4))
    eye = np.zeros(2)
    for _ in range(30):
        boxes = [(*rng.uniform(-10, 10, 2), rng.uniform(-4, 4), *rng.uniform(0.5, 8, 2)) for _ in range(3)]
        points = rng.uniform(-15, 15, (40, 2))
        corners = [Obstacle("o", b[:3], *b[3:]).corners for b in boxes]
        union = shapely.union_all([shapely.Polygon(c) for c in corners])
        expected = [shapely.LineString([eye, p]).intersection(union).length > 0 for p in points]
        assert Occluders(boxes).occlude(eye, points).tolist() == expected
        lengths = [sum(shapely.LineString([eye, p]).intersection(shapely.Polygon(c)).length for c in corners) for p in points]
        assert np.abs(Occluders(boxes).blocked_length(eye, points) - lengths).max() < 1e-9
    assert Occluders([]).blocked_length(eye, points).tolist() == [0.0] * 40


def test_outline_lies_on_the_sides() -> None:
    state = State("a", 5.0, 1.8)
    state.x, state.y = 1.0, 2.0
    points = outline(state)
    assert len(points) == 20
    assert np.allclose(np.maximum(np.abs(points[:, 0] - 1.0) / 2.5, np.abs(points[:, 1] - 2.0) / 0.9), 1.0)


def test_marking_sensor_finds_the_lane() -> None:
    s = np.arange(0.0, 60.0, 1.0)
    curve = Curve((0.0, 0.0, 0.0), ((1e-6, 1 / 40), (70.0, 1 / 40)))
    left, right = curve.offset_points(s, 1.75), curve.offset_points(s, -1.75)
    sensor = MarkingSensor(np.random.Generator(np.random.PCG64(0)), left, right, lane=3.5)
    own = State("ego", 5.0, 1.8)
    fits = np.array([sensor(own) for _ in range(200)])[100:]
    assert np.abs(fits[:, 0].mean()) < 0.05
    assert 2 * fits[:, 2].mean() == pytest.approx(1 / 40, rel=0.2)


def test_what_the_marking_sensor_sees_changes_continuously() -> None:
    """Points come into sight one by one: each fades in, or the metric would jump as an input moves a little."""
    bar = Obstacle("bar", (14.0, 1.0, 0.3), 10.0, 3.0)
    s = np.arange(0.0, 60.0, 1.0)
    left, right = np.stack([s, 0 * s + 1.75], 1), np.stack([s, 0 * s - 1.75], 1)
    own, found = State("ego", 5.0, 1.8), []
    for own.x in np.arange(5.0, 22.0, 0.004):  # past the bar, and through its edge
        sensor = MarkingSensor(np.random.Generator(np.random.PCG64(3)), left, right, lane=3.5, obstacles=(bar,), noise=0.2)
        found.append([*sensor(own), *sensor.seen])
    table = np.array(found)
    assert np.ptp(table[:, 4]) > 5.0, "the bar hides much of the left marking for a while"
    assert np.all(np.abs(np.diff(table, axis=0)).max(axis=0) < 0.02 * np.ptp(table, axis=0))


# Background traffic


def test_a_stream_has_its_flow_and_its_shortest_headway() -> None:
    traffic, speed, flow = TrafficStream("co", ("r",), 0, 20.0, spread=0.1).with_driver(tau=0.7), 15.0, 900.0
    cars = [traffic.draw(np.random.Generator(np.random.PCG64(k)), flow, speed, 900.0, 0.0) for k in range(200)]
    gaps = np.concatenate([-np.diff([c.position for c in row]) for row in cars])
    assert gaps.min() >= MIN_HEADWAY * speed + 5.0 - 1e-9
    expected = 900.0 / (speed * 3600.0 / flow)
    assert np.mean([len(row) for row in cars]) == pytest.approx(expected, rel=0.03)
    factors = np.array([float(dict(c.type.attributes)["speedFactor"]) for row in cars for c in row])
    assert factors.mean() == pytest.approx(speed / 20.0, rel=0.01)
    assert np.abs(factors / (speed / 20.0) - 1.0).max() <= 0.2 + 1e-12
    assert {dict(c.type.attributes)["tau"] for row in cars for c in row} == {"0.7"}

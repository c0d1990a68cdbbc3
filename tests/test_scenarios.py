"""The benchmark scenarios: determinism, both sides of the requirement, and the laws of their physics."""

from __future__ import annotations

import math
import shutil
import subprocess
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from sbt.errors import InputError, RunError
from sbt.metrics.reference_line import Curve
from sbt.plugins import load, names
from sbt.problem.parameter import Parameter
from sbt.problem.scenario import LogicalScenario
from sbt.samplers.sobol import SobolSequence
from sbt.scenarios import jaywalking, lane_keeping
from sbt.sumo.actors import Action, Actor, Obstacle, State
from sbt.sumo.drivers import ArcExit, SpeedProfile, Stationary
from sbt.sumo.dynamics import Gust, JerkLimitedStop, SingleTrack
from sbt.sumo.lane_keeping import MarkingSensor
from sbt.sumo.occlusion import Occluders, outline

NAMES = ("following", "jaywalking", "lane_keeping", "parking")
BUILT_IN = names("scenarios")
NETS = Path(__file__).resolve().parent.parent / "sumo_nets"
DIMENSIONS = {"following": 13, "jaywalking": 7, "lane_keeping": 15, "parking": 20}
CRITICAL = {
    "following": {
        "v_co_max": 55.0,
        "a_co_2": -9.0,
        "f_safetyDistanceTimeGap": 0.6,
        "f_acc_min": -2.0,
        "f_safetyDistanceMin": 1.5,
    },
    "jaywalking": {"v_av": 7.0, "v_ped": 1.9, "d_0": 7.0, "rain_rel": 0.9},
    "parking": {"x_ego": 9.0, "y_ego": 1.2, "v_ego": 19.0, "a_1_co_1": 3.0, "v_max_co_1": 9.0, "t_delay_ego": 0.9},
}
CRITICAL_LANE = {
    "x_ego": -38.393,
    "y_ego": 120.64,
    "theta_ego": 3.905,
    "v_ego": 36.518,
    "theta_obs_1": -103.45,
    "theta_obs_2": -98.291,
    "theta_obs_3": 100.123,
    "theta_obs_4": 103.156,
    "f_t": 0.238,
    "f_p": 0.208,
    "f_i": 0.005,
    "f_d": 0.949,
    "v_t_1": 0.172,
    "v_t_2": 0.011,
    "v_delay": 0.089,
}
CRITICAL_LANE_SEED = 0
UNCRITICAL = {
    "following": {"v_co_max": 20.0, "a_co_2": -2.0, "f_safetyDistanceTimeGap": 2.0},
    "jaywalking": {"v_av": 5.0, "v_ped": 1.5, "d_0": 40.0},
    "parking": {"x_ego": 40.0},
}


def centre(scenario: LogicalScenario, **changes: float) -> dict[str, float]:
    return {p.name: p.centre for p in scenario.space.parameters} | changes


def sobol(scenario: LogicalScenario, n: int) -> list[dict[str, float]]:
    points = scenario.space.from_unit(SobolSequence(scenario.space.dimension, 11).points(0, n))
    return [dict(zip(scenario.space.names, map(float, row), strict=True)) for row in points]


@pytest.mark.parametrize("name", NAMES)
def test_inputs_and_names_are_the_data_sets(name: str) -> None:
    scenario = load("scenarios", name)
    assert scenario.name == name
    assert scenario.space.dimension == DIMENSIONS[name]
    by_lane = name == "following"  # nobody is moved by pose
    assert scenario.isolations == (("fresh", "reuse", "replicas") if by_lane else ("fresh", "reuse"))


@pytest.mark.sumo
@pytest.mark.parametrize("name", NAMES)
def test_same_seed_same_bits_fresh_and_reused(name: str) -> None:
    scenario = load("scenarios", name)
    reused, fresh = scenario.configured(isolation="reuse"), scenario.configured(isolation="fresh")
    jobs = list(enumerate(sobol(scenario, 2 if name == "lane_keeping" else 5)))
    first = {k: reused.simulate(values, k) for k, values in jobs}
    for k, values in reversed(jobs):
        assert first[k].identical(reused.simulate(values, k))
        assert first[k].identical(fresh.simulate(values, k))
    other = reused.simulate(jobs[0][1], 99)
    assert name == "parking" or not first[0].identical(other), "sensors are noisy: another seed, another run"


def whole(parameter: Parameter) -> np.integer | np.bool_ | np.float32:
    """A whole number in the range of a parameter, as NumPy has it: a boolean where 1 is one of them, a float where none is."""
    if parameter.low <= 1 <= parameter.high:
        return np.bool_(True)
    inside = math.ceil(parameter.low)
    return np.int64(inside) if inside <= parameter.high else np.float32(parameter.centre)


@pytest.mark.sumo
@pytest.mark.parametrize("name", BUILT_IN)
def test_numpy_scalars_and_plain_numbers_give_the_identical_trace(name: str) -> None:
    scenario = load("scenarios", name)
    [point] = sobol(scenario, 1)
    for typed in (
        {name: np.float64(value) for name, value in point.items()},
        {name: np.float32(value) for name, value in point.items()},
        {p.name: whole(p) for p in scenario.space.parameters},
    ):
        plain = {name: float(value) for name, value in typed.items()}
        assert scenario.simulate(typed, np.int64(5)).identical(scenario.simulate(plain, 5))


@pytest.mark.sumo
@pytest.mark.parametrize("name", CRITICAL)
def test_both_sides_of_the_requirement(name: str) -> None:
    scenario = load("scenarios", name)
    need = scenario.requirement
    for changes, expected in ((CRITICAL[name], True), (UNCRITICAL[name], False)):
        metrics = scenario.run(centre(scenario, **changes), 1)
        inside = need.critical.low <= metrics[need.metric] <= need.critical.high
        assert inside == expected, (changes, metrics)
        assert (metrics["collision"] == 1.0) == expected


@pytest.mark.sumo
def test_following_obeys_its_limits() -> None:
    scenario = load("scenarios", "following")
    for k, values in enumerate(sobol(scenario, 6)):
        trace = scenario.simulate(values, k)
        ego, co = trace.actor("ego"), trace.actor("co")
        assert co.x[0] - ego.x[0] - 5.0 == pytest.approx(values["d_0"], abs=1e-9)
        assert ego.acceleration.min() >= values["f_aEgo_min"] - 1e-9
        assert ego.acceleration.max() <= values["f_aEgo_max"] + 1e-9
        assert co.speed.max() <= values["v_co_max"] / 3.6 + 1e-9
        assert ego.speed.min() >= 0.0


@pytest.mark.sumo
def test_following_is_no_safer_with_a_longer_dead_time() -> None:
    scenario = load("scenarios", "following")
    changes = {"v_co_max": 50.0, "a_co_2": -8.0, "f_safetyDistanceTimeGap": 1.0, "f_acc_min": -3.0}
    quick, slow = (
        np.mean([scenario.run(centre(scenario, **changes, v_delay=delay), s)["impact_speed"] for s in range(4)])
        for delay in (0.02, 0.3)
    )
    assert quick <= slow


@pytest.mark.sumo
def test_jaywalking_keeps_to_friction_and_geometry() -> None:
    scenario = load("scenarios", "jaywalking")
    for k, values in enumerate(sobol(scenario, 8)):
        trace = scenario.simulate(values, k)
        ego, child = trace.actor("ego"), trace.actor("child")
        assert ego.acceleration.min() >= -9.81 * jaywalking.friction(values["rain_rel"]) - 1e-6
        assert child.x[0] - ego.x[0] - 2.5 == pytest.approx(values["d_0"], abs=1e-9)
        assert ego.y[0] - child.y[0] == pytest.approx(4.0)
        assert np.all(np.diff(child.y) > -0.05)
    beside = scenario.run(centre(scenario, d_0=0.0, v_ped=0.4, wind_rel=0.0), 0)["min_dist"]
    assert 2.2 < beside < 4.0 - 0.9 - 0.25


@pytest.mark.sumo
def test_jaywalking_is_no_safer_in_rain_or_with_a_later_reaction() -> None:
    scenario = load("scenarios", "jaywalking")
    changes = {"v_av": 7.0, "v_ped": 1.8, "wind_rel": 0.0, "fog_rel": 0.0, "time_of_day": 12.0}
    distances = np.arange(6.0, 13.0, 1.0)

    def mean(scenario: LogicalScenario, rain: float) -> float:
        runs = [scenario.run(centre(scenario, **changes, d_0=float(d), rain_rel=rain), 3)["min_dist"] for d in distances]
        return float(np.mean(runs))

    late = scenario.configured(ego={"kind": "pedestrian_braking", "reaction_time": 0.5})
    assert mean(scenario, 1.0) < mean(scenario, 0.0)
    assert mean(late, 0.0) < mean(scenario, 0.0)


@pytest.mark.sumo
def test_sumos_own_models_are_refused_where_they_see_nothing() -> None:
    for name in ("following", "jaywalking", "lane_keeping", "parking"):
        scenario = load("scenarios", name).configured(ego={"kind": "sumo", "model": "IDM"})
        with pytest.raises((InputError, RunError), match=r"ego\.kind"):
            scenario.run(centre(scenario), 0)


def test_sight_falls_with_rain_fog_and_darkness() -> None:
    sights = [jaywalking.sight(0.5, fog, 12.0) for fog in np.linspace(0, 1, 11)]
    assert np.all(np.diff(sights) <= 0)
    assert jaywalking.sight(0.5, 0.9, 12.0) > jaywalking.sight(0.5, 0.9, 23.0) > jaywalking.sight(1.0, 0.9, 23.0)
    assert jaywalking.daylight(12.0) == 1.0
    assert jaywalking.daylight(0.0) == jaywalking.daylight(24.0) == 0.0


@pytest.mark.sumo
def test_parking_brakes_as_its_inputs_say() -> None:
    scenario = load("scenarios", "parking")
    values = centre(scenario, x_ego=25.0)
    trace = scenario.simulate(values, 0)
    ego = trace.actor("ego")
    assert (ego.x[0], ego.y[0]) == pytest.approx((25.0, 3.0))
    braking = ego.acceleration[:-3] if ego.speed[-1] == 0.0 else ego.acceleration
    assert ego.acceleration.min() >= values["a_ego"] - 1e-6
    moving = ego.speed[: len(braking)] > 0.5
    assert np.diff(braking[moving]).min() >= -values["j_ego"] * 0.05 - 1e-6
    co = trace.actor("co_1")
    onset = trace.time[np.flatnonzero(ego.acceleration < -1e-6)[0]]
    moved = (co.y - co.y[0])[np.searchsorted(trace.time, onset - values["t_delay_ego"])]
    assert moved == pytest.approx(values["d_detect_min"], abs=0.15)


@pytest.mark.sumo
def test_parking_is_no_safer_later_weaker_or_hidden() -> None:
    scenario = load("scenarios", "parking")
    base = {"x_ego": 11.0, "y_ego": 1.5, "v_ego": 18.0, "a_1_co_1": 2.5, "v_max_co_1": 8.0, "t_v_max_co_1": 2.0}

    def row(name: str, values: list[float], **more: float) -> list[float]:
        return [scenario.run(centre(scenario, **{**base, **more, name: v}), 2)["criterion"] for v in values]

    assert np.all(np.diff(row("t_delay_ego", [0.1, 0.3, 0.5, 0.7, 0.9])) <= 1e-9)
    assert np.all(np.diff(row("a_ego", [-9.0, -7.0, -5.0, -3.0], t_delay_ego=0.2)) <= 1e-9)
    assert np.all(np.diff(row("d_detect_min", [0.1, 0.3, 0.5, 0.8], t_delay_ego=0.2)) <= 1e-9)

    def stop(co_3: float) -> float:
        values = centre(scenario, x_ego=40.0, y_ego=1.5, y_offset_co_1=-0.5, y_offset_co_3=co_3)
        trace = scenario.simulate(values, 2)
        return float(trace.time[np.flatnonzero(trace.actor("ego").acceleration < -1e-6)[0]])

    assert stop(0.5) > stop(-0.5) + 0.1, "a car that stands out hides the one that leaves"


@pytest.mark.sumo
def test_hidden_markings_degrade_lane_keeping(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = load("scenarios", "lane_keeping")
    points = [v | {"v_ego": 38.0} for v in sobol(scenario, 12)]
    hidden = [scenario.run(values, 1) for values in points]
    monkeypatch.setattr(lane_keeping, "bars", lambda values: ())
    free = [scenario.run(values, 1) for values in points]
    error = [np.mean([m["pos_lat_abs_err_max"] for m in metrics]) for metrics in (free, hidden)]
    assert error[0] < 1.5, "with all markings in sight ego keeps its lane"
    assert error[1] > 1.1 * error[0]
    assert not any(m["lane_lost"] for m in free)


@pytest.mark.sumo
def test_lane_keeping_can_be_critical() -> None:
    scenario = load("scenarios", "lane_keeping")
    values = centre(scenario, **CRITICAL_LANE)
    assert scenario.run(values, CRITICAL_LANE_SEED)["pos_lat_abs_err_max"] > 3.0
    assert scenario.run(centre(scenario, v_ego=20.0), 0)["pos_lat_abs_err_max"] < 3.0


def test_the_winding_network_is_the_road() -> None:
    net = ET.parse(NETS / "winding" / "winding.net.xml")
    lane = net.find(".//lane[@id='road_0']")
    assert lane is not None
    shape = [tuple(map(float, pair.split(","))) for pair in lane.attrib["shape"].split()]
    assert max(abs(lane_keeping.ROAD.project(x, y)[1]) for x, y in shape) < 0.01
    s, left, heading = lane_keeping.ROAD.project(-38.0, 121.0)
    assert (s, left, math.degrees(heading)) == pytest.approx((lane_keeping.BEFORE, 0.0, 3.9), abs=1e-6)


@pytest.mark.skipif(shutil.which("netconvert") is None, reason="needs netconvert (extra `tools`)")
def test_networks_come_from_their_sources(tmp_path: Path) -> None:
    subprocess.run([str(NETS.parent / "scripts" / "build-nets"), str(tmp_path)], check=True, capture_output=True)
    for source in sorted(NETS.glob("*/*.net.xml")):
        assert (tmp_path / source.parent.name / source.name).read_text() == source.read_text()


def test_curve_projects_back_what_is_beside_it() -> None:
    curve = Curve((3.0, -2.0, 0.4), ((10.0, 0.0), (10.0, 1 / 30), (20.0, 1 / 30), (15.0, -1 / 40)))
    s = np.linspace(0.5, curve.length - 0.5, 40)
    for left in (-3.0, 0.0, 2.0):
        found = np.array([curve.project(x, y) for x, y in curve.offset_points(s, left)])
        assert np.abs(found[:, 0] - s).max() < 5e-3
        assert np.abs(found[:, 1] - left).max() < 2e-3


def test_boxes_hide_what_shapely_says() -> None:
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


def test_actors_by_pose_need_a_controller() -> None:
    with pytest.raises(InputError, match="needs a controller"):
        Actor("a", ("road",), 0, 0.0, 0.0, None, pose=(0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="must have a pose"):
        Actor("a", ("road",), 0, 0.0, 0.0, Stationary(), person=True)


@pytest.mark.sumo
def test_an_actor_by_pose_must_go_on_by_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = load("scenarios", "parking")
    monkeypatch.setattr("sbt.sumo.drivers.Stationary.act", lambda self, t, own, others: Action(speed=0.0))
    with pytest.raises(RunError, match="moves by pose"):
        scenario.run(centre(scenario), 0)

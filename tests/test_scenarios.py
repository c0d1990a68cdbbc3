"""The built-in scenarios: determinism, both sides of the requirement, and the laws of their physics."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from scenario_points import centre, sobol

from sbt.errors import InputError, RunError
from sbt.plugins import load, names
from sbt.problem.parameter import Parameter
from sbt.problem.scenario import LogicalScenario
from sbt.scenarios import jaywalking, lane_keeping
from sbt.sumo.actors import Action

NETS = Path(__file__).resolve().parent.parent / "sumo_nets"
BUILT_IN = names("scenarios")
BY_POSE = ("jaywalking", "lane_keeping", "parking")
"""Actors that are moved by pose cannot share a simulation."""
IN_TRAFFIC = ("crossing_pedestrian", "highway_merge", "roundabout_entry", "unprotected_left_turn")
"""SUMO draws random numbers: every run needs a fresh simulation."""
DIMENSIONS = {"cut_in": 2, "emergency_braking": 5, "following": 13, "jaywalking": 7, "lane_keeping": 15, "parking": 20}
"""Numbers of inputs in the data set."""

CRITICAL = [
    ("cut_in", {"d_v": 110.0, "d_t": 0.5}, 1),
    ("cut_in", {"d_v": 60.0, "d_t": 0.3}, 1),
    ("emergency_braking", {"a_co": -9.0, "v_co_min_frac": 0.1, "d_t": 0.6, "v_co": 110.0, "v_ego": 130.0}, 1),
    ("following",
     {"v_co_max": 55.0, "a_co_2": -9.0, "f_safetyDistanceTimeGap": 0.6, "f_acc_min": -2.0, "f_safetyDistanceMin": 1.5}, 1),
    ("jaywalking", {"v_av": 7.0, "v_ped": 1.9, "d_0": 7.0, "rain_rel": 0.9}, 1),
    ("lane_keeping",
     {"x_ego": -38.393, "y_ego": 120.64, "theta_ego": 3.905, "v_ego": 36.518, "theta_obs_1": -103.45, "theta_obs_2": -98.291,
      "theta_obs_3": 100.123, "theta_obs_4": 103.156, "f_t": 0.238, "f_p": 0.208, "f_i": 0.005, "f_d": 0.949, "v_t_1": 0.172,
      "v_t_2": 0.011, "v_delay": 0.089}, 0),
    ("parking", {"x_ego": 9.0, "y_ego": 1.2, "v_ego": 19.0, "a_1_co_1": 3.0, "v_max_co_1": 9.0, "t_delay_ego": 0.9}, 1),
    ("crossing_pedestrian",
     {"v_ego": 40.5531, "v_ped": 2.815, "t_ped": -0.4638, "flow_co": 505.9498, "ego_decel": 3.3308, "ego_jmCrossingGap": 5.4642},
     434),
    ("highway_merge",
     {"flow_co": 1830.2365, "v_co": 61.0581, "v_ego": 45.6616, "ego_accel": 2.3064, "ego_lcAssertive": 4.6295, "ego_tau": 0.4417},
     303),
    ("roundabout_entry",
     {"flow_co": 863.8357, "v_co": 37.4814, "p_leave": 0.435, "tau_co": 1.0036, "v_ego": 34.1606, "ego_accel": 2.4024,
      "ego_impatience": 0.9201, "ego_jmTimegapMinor": 1.1938}, 235),
    ("unprotected_left_turn",
     {"flow_co": 516.6531, "v_co": 76.3094, "v_ego": 43.8985, "ego_accel": 2.0616, "ego_impatience": 0.8624,
      "ego_jmTimegapMinor": 1.2061}, 42),
]  # fmt: skip
"""Inputs (others at their centre) and seed; those in traffic are runs of coverage campaigns, rounded."""
UNCRITICAL = [
    ("cut_in", {"d_v": 10.0, "d_t": 9.0}, 1),
    ("cut_in", {"d_v": 0.0, "d_t": 2.0}, 1),
    ("emergency_braking", {"a_co": -2.0, "d_t": 2.5}, 1),
    ("following", {"v_co_max": 20.0, "a_co_2": -2.0, "f_safetyDistanceTimeGap": 2.0}, 1),
    ("jaywalking", {"v_av": 5.0, "v_ped": 1.5, "d_0": 40.0}, 1),
    ("lane_keeping", {"v_ego": 20.0}, 0),
    ("parking", {"x_ego": 40.0}, 1),
    *((name, {}, 0) for name in IN_TRAFFIC),
]


# Laws of all of them


@pytest.mark.parametrize("name", BUILT_IN)
def test_names_inputs_and_isolation_levels(name: str) -> None:
    scenario = load("scenarios", name)
    assert scenario.name == name
    assert scenario.space.dimension == DIMENSIONS.get(name, scenario.space.dimension)
    levels = ("fresh",) if name in IN_TRAFFIC else ("fresh", "reuse") if name in BY_POSE else ("fresh", "reuse", "replicas")
    assert scenario.isolations == levels


@pytest.mark.sumo
@pytest.mark.parametrize("name", BUILT_IN)
def test_the_seed_decides_every_bit_at_every_isolation_level(name: str) -> None:
    scenario = load("scenarios", name)
    jobs = list(enumerate(sobol(scenario, 2 if name == "lane_keeping" else 4, close=True)))
    fresh = scenario.configured(isolation="fresh")
    expected = [fresh.simulate(values, k) for k, values in jobs]
    for level in scenario.isolations:
        configured = scenario.configured(isolation=level)
        for k, values in reversed(jobs):
            trace = configured.simulate(values, k)
            assert trace.identical(expected[k])
            assert not np.shares_memory(trace.x, expected[k].x)
    others = [fresh.simulate(values, 99 + k) for k, values in jobs]
    differ = [not other.identical(trace) for other, trace in zip(others, expected, strict=True)]
    assert name == "parking" or 2 * sum(differ) >= len(differ), "sensors and traffic are random: another seed, another run"


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
@pytest.mark.parametrize(
    ("name", "changes", "seed", "expected"), [*((*c, True) for c in CRITICAL), *((*u, False) for u in UNCRITICAL)]
)
def test_both_sides_of_the_requirement(name: str, changes: dict[str, float], seed: int, expected: bool) -> None:
    scenario = load("scenarios", name)
    need = scenario.requirement
    metrics = scenario.run(centre(scenario, **changes), seed)
    assert need.critical.contains(metrics[need.metric]) == expected, metrics
    if not expected and "collision" in metrics:
        assert metrics["collision"] == 0.0
    if expected and name in ("following", "jaywalking", "parking"):
        assert metrics["collision"] == 1.0


@pytest.mark.sumo
def test_sumos_own_models_are_refused_where_they_see_nothing() -> None:
    for name in ("following", *BY_POSE):
        scenario = load("scenarios", name).configured(ego={"kind": "sumo", "model": "IDM"})
        with pytest.raises((InputError, RunError), match=r"ego\.kind"):
            scenario.run(centre(scenario), 0)


# Laws of each


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


@pytest.mark.slow
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


def test_the_winding_network_is_the_road() -> None:
    net = ET.parse(NETS / "winding" / "winding.net.xml")
    lane = net.find(".//lane[@id='road_0']")
    assert lane is not None
    shape = [tuple(map(float, pair.split(","))) for pair in lane.attrib["shape"].split()]
    assert max(abs(lane_keeping.ROAD.project(x, y)[1]) for x, y in shape) < 0.01
    s, left, heading = lane_keeping.ROAD.project(-38.0, 121.0)
    assert (s, left, math.degrees(heading)) == pytest.approx((lane_keeping.BEFORE, 0.0, 3.9), abs=1e-6)


@pytest.mark.sumo
def test_an_actor_by_pose_must_go_on_by_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = load("scenarios", "parking")
    monkeypatch.setattr("sbt.sumo.drivers.Stationary.act", lambda self, t, own, others: Action(speed=0.0))
    with pytest.raises(RunError, match="moves by pose"):
        scenario.run(centre(scenario), 0)

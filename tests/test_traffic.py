"""Scenarios of SUMO's own traffic: determinism, both sides, what the AV's settings do, and the metrics among many."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sbt.config.assemble import assemble
from sbt.config.load import parse
from sbt.errors import InputError
from sbt.execution.spec import ScenarioSpec
from sbt.metrics.paths import ttc_on_paths
from sbt.metrics.planar import post_encroachment_time, time_behind, ttc_2d
from sbt.metrics.traffic import any_collision, any_impact_speed, nearest_distance, others_braking_max, pet_ego_first, ttc_path_min
from sbt.plugins import load
from sbt.problem.scenario import LogicalScenario
from sbt.problem.trace import Trace
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream
from sbt.sumo.ego import Ego
from sbt.sumo.models import CAR_FOLLOWING, vtype_attributes
from sbt.sumo.session import scratch_folder
from sbt.sumo.traffic import MIN_HEADWAY, TrafficStream, ego_type
from sbt.workflows.checking import check_scenario

NETS = Path(__file__).resolve().parent.parent / "sumo_nets"
NAMES = ("crossing_pedestrian", "highway_merge", "roundabout_entry", "unprotected_left_turn")
CRITICAL = [
    (
        "crossing_pedestrian",
        {"v_ego": 57.5, "v_ped": 2.86, "t_ped": 0.57, "flow_co": 257.76, "ego_decel": 3.95, "ego_jmCrossingGap": 8.48},
        628138296,
    ),
    (
        "highway_merge",
        {"flow_co": 1135.702, "v_co": 80.5498, "v_ego": 76.8172, "ego_accel": 2.7407, "ego_lcAssertive": 1.7904,
         "ego_tau": 0.4916},
        401733047,
    ),
    (
        "roundabout_entry",
        {"flow_co": 981.6321, "v_co": 33.2299, "p_leave": 0.4287, "tau_co": 0.6421, "v_ego": 29.3729, "ego_accel": 2.9647,
         "ego_impatience": 0.5595, "ego_jmTimegapMinor": 0.3225},
        1242574842,
    ),
    (
        "unprotected_left_turn",
        {"flow_co": 917.87, "v_co": 43.99, "v_ego": 48.67, "ego_accel": 2.36, "ego_impatience": 0.79, "ego_jmTimegapMinor": 0.9},
        89714519,
    ),
]  # fmt: skip
"""Critical runs of the coverage campaigns, rounded."""


def centre(scenario: LogicalScenario, **changes: float) -> dict[str, float]:
    return {p.name: p.centre for p in scenario.space.parameters} | changes


def sobol(scenario: LogicalScenario, n: int) -> list[dict[str, float]]:
    points = scenario.space.from_unit(SobolSequence(scenario.space.dimension, 11).points(0, n))
    return [dict(zip(scenario.space.names, map(float, row), strict=True)) for row in points]


def trace(*tracks: tuple[np.ndarray, np.ndarray], dt: float = 0.1) -> Trace:
    """A trace of cars of 4 m x 2 m along (t,) x and y; speeds and headings follow from them."""
    x, y = np.stack([t[0] for t in tracks], axis=1), np.stack([t[1] for t in tracks], axis=1)
    dx, dy = np.gradient(x, dt, axis=0), np.gradient(y, dt, axis=0)
    n, m = x.shape
    names = ("ego", *(f"co_{k}" for k in range(m - 1)))
    speed = np.hypot(dx, dy)
    acceleration = np.gradient(speed, dt, axis=0)
    size = np.full(m, 4.0), np.full(m, 2.0)
    return Trace(np.arange(n) * dt, names, x, y, np.arctan2(dy, dx), speed, acceleration, *size)


@pytest.mark.sumo
@pytest.mark.parametrize("name", NAMES)
def test_same_seed_same_bits_and_another_seed_another_traffic(name: str) -> None:
    scenario = load("scenarios", name)
    assert (scenario.name, scenario.isolations) == (name, ("fresh",))
    jobs = list(enumerate(sobol(scenario, 2)))
    first = [scenario.simulate(values, k) for k, values in jobs]
    again = [scenario.simulate(values, k) for k, values in reversed(jobs)][::-1]
    assert all(a.identical(b) for a, b in zip(first, again, strict=True))
    assert not first[0].identical(scenario.simulate(jobs[0][1], 77))
    for run in first:
        away = np.hypot(run.x[-1] - run.x[0], run.y[-1] - run.y[0])
        assert away[0] > 20.0, "ego gets on"
        assert (away > 1.0).mean() > 0.5
        measured = scenario.measure(run)
        assert all(math.isfinite(v) for v in measured.values())
        assert measured["distance_min"] >= 0.0


@pytest.mark.sumo
def test_the_contract_holds_in_a_worker_too() -> None:
    findings = check_scenario(ScenarioSpec("crossing_pedestrian"))
    assert [f for f in findings if not f.ok] == []
    assert any("worker" in f.rule for f in findings)


@pytest.mark.sumo
@pytest.mark.parametrize(("name", "where", "seed"), CRITICAL)
def test_both_sides_of_the_requirement(name: str, where: dict[str, float], seed: int) -> None:
    scenario = load("scenarios", name)
    need = scenario.requirement
    for values, at, expected in ((where, seed, True), ({}, 0, False)):
        metrics = scenario.run(centre(scenario, **values), at)
        assert (need.critical.low <= metrics[need.metric] <= need.critical.high) == expected, metrics


@pytest.mark.sumo
def test_an_impatient_ego_leaves_less_time() -> None:
    scenario = load("scenarios", "unprotected_left_turn")

    def runs(impatience: float) -> list[dict[str, float]]:
        values = centre(scenario, flow_co=900.0, ego_impatience=impatience)
        return [scenario.run(values, seed) for seed in range(6)]

    patient, impatient = runs(0.0), runs(1.0)
    for metric, sign in (("pet_ego_first", 1), ("others_braking_max", -1)):
        assert sign * np.mean([m[metric] for m in impatient]) < sign * np.mean([m[metric] for m in patient])


@pytest.mark.sumo
def test_walkers_have_right_of_way_on_the_crossing_and_ego_stops() -> None:
    scenario = load("scenarios", "crossing_pedestrian")
    run = scenario.simulate(centre(scenario, t_ped=-2.0, v_ped=1.4, v_ego=40.0), 1)
    assert run.actor("ego").speed.min() < 1.0
    ped = run.actor("ped")
    across = (ped.x[-1] - ped.x[0]) * 0.747 + (ped.y[-1] - ped.y[0]) * 0.664  # normal to the street
    assert across > 6.0, "it has crossed before ego is past"
    net = ET.parse(NETS / "town" / "town.net.xml")
    junction = net.find(".//junction[@id='29']")
    assert junction is not None
    assert [r.attrib["response"] for r in junction.iter("request")] == ["100", "100", "000"], "cars yield, walkers do not"
    assert "Open Database License" in (NETS / "town" / "town.osm.xml").read_text()


@pytest.mark.sumo
@pytest.mark.parametrize("model", CAR_FOLLOWING)
def test_every_car_following_model_drives(model: str) -> None:
    scenario = load("scenarios", "highway_merge").configured(ego={"kind": "sumo", "model": model})
    assert scenario.space.names == ("flow_co", "v_co", "v_ego")
    ego = scenario.simulate(centre(scenario, flow_co=1000.0), 2).actor("ego")
    assert ego.x[-1] - ego.x[0] > 100.0


@pytest.mark.sumo
def test_a_setting_that_is_a_range_is_an_input(tmp_path: Path) -> None:
    text = "campaign: coverage\nscenario: {}\nego: {}\ninputs: {{ego_tau: {{max: 2.0}}}}\n"
    parts = assemble(parse(text.format("highway_merge", "{kind: sumo, model: IDM, tau: {min: 0.5, max: 3.0}}"), folder=tmp_path))
    assert parts.scenario.space.names == ("flow_co", "v_co", "v_ego", "ego_tau")
    tau = parts.scenario.space.parameters[-1]
    assert (tau.low, tau.high, tau.unit) == (0.5, 2.0, "s")
    worker = parts.spec.resolve()
    near, far = (worker.run(centre(worker, ego_tau=v), 1) for v in (0.5, 3.0))
    assert near != far
    fixed = load("scenarios", "highway_merge").configured(ego={"kind": "sumo", "model": "IDM", "tau": 0.5})
    assert near == fixed.run(centre(fixed), 1), "an input with a value is that setting"
    controller = load("scenarios", "cut_in").configured(ego={"kind": "acc_aeb", "reaction_time": {"min": 0.1, "max": 0.9}})
    assert controller.space.names == ("d_v", "d_t", "ego_reaction_time")
    quick, slow = (controller.run(centre(controller, d_t=1.0, ego_reaction_time=t), 1)["d_min"] for t in (0.1, 0.9))
    assert slow < quick


@pytest.mark.sumo
def test_a_python_controller_drives_along_the_route(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(
        "from sbt.sumo.actors import Action\n\n\nclass Waits:\n    def __init__(self, rng, set_speed, *, until=0.0):\n"
        "        self.until = until\n\n    def act(self, t, own, others):\n"
        "        return Action(acceleration=2.0, speed=8.0) if t >= self.until else Action(acceleration=-4.0, speed=0.0)\n"
    )
    for name in NAMES:
        ego = {"kind": f"{tmp_path}/own.py:Waits", "until": 4.0}
        scenario = load("scenarios", name).configured(ego=ego)
        assert not any(n.startswith("ego_") for n in scenario.space.names)
        whole = scenario.simulate(centre(scenario), 1)
        run, at, dt = whole.actor("ego"), whole.time > 4.5, float(whole.time[1])
        assert run.speed[whole.time < 4.0].min() < 6.0
        assert np.diff(run.speed[at])[:5] == pytest.approx(np.minimum(2.0 * dt, 8.0 - run.speed[at][:5]), abs=1e-9)


@pytest.mark.sumo
@pytest.mark.parametrize("name", NAMES)
def test_controllers_start_at_every_corner(name: str) -> None:
    scenario = load("scenarios", name).configured(ego={"kind": "acc_aeb"})
    for values in ({p.name: p.low for p in scenario.space.parameters}, {p.name: p.high for p in scenario.space.parameters}):
        ego = scenario.simulate(values, 3).actor("ego")
        assert ego.speed[0] == pytest.approx(values["v_ego"] / 3.6)


@pytest.mark.sumo
def test_types_of_many_runs_leave_one_file() -> None:
    scenario = load("scenarios", "unprotected_left_turn")
    for seed in range(3):
        scenario.simulate(centre(scenario), seed)
    assert [p.name for p in scratch_folder().glob("types*")] == ["types.add.xml"]


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Ego.of("sumo", model="idm"), r"but got 'idm' \(did you mean 'IDM'\?\)"),
        (lambda: Ego.of("sumo", model="IDM", taw=1.0), r"attributes of IDM or LC2013, but got 'taw' \(did you mean 'tau'\?\)"),
        (lambda: Ego.of("sumo", model="IDM", cc1=1.0), "but got 'cc1'; it belongs to W99"),
        (lambda: Ego.of("sumo", lane_change="LC2014"), "one of SUMO's LC2013, SL2015, DK2008, but got 'LC2014'"),
        (lambda: Ego.of("sumo", tau="near"), "ego.tau must be a finite number, but got 'near'"),
        (lambda: Ego.of("sumo", tau={"low": 1.0}), "a value or a range such as {min: 0.5, max: 2.0}, but got"),
        (lambda: Ego.of("sumo", tau={"min": 2.0, "max": 1.0}), "ego_tau"),
        (lambda: load("scenarios", "highway_merge").configured(ego={"kind": "sumo", "lane_change": "SL2015"}), "lateral-resol"),
        (lambda: TrafficStream("a", ("r",), 0, 10.0).draw(stream(1), 9000.0, 10.0, 90.0, 0.0), "carries"),
    ],
)  # fmt: skip
def test_wrong_settings_are_told_with_rule_and_value(build: Callable[[], Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        build()


def test_the_type_of_an_automated_ego_is_the_models() -> None:
    kind = ego_type(Ego.of("sumo", model="IDM", tau=1.4, length=4.2), 10.0, 20.0)
    attributes = dict(kind.attributes)
    assert (kind.length, attributes["carFollowModel"], attributes["tau"], attributes["sigma"]) == (4.2, "IDM", "1.4", "0")
    assert float(attributes["speedFactor"]) == pytest.approx(0.5)
    assert vtype_attributes({}) == {"carFollowModel": "Krauss", "laneChangeModel": "LC2013"}


def test_a_column_has_its_flow_and_its_shortest_headway() -> None:
    column, speed, flow = TrafficStream("co", ("r",), 0, 20.0, spread=0.1).with_driver(tau=0.7), 15.0, 900.0
    cars = [column.draw(np.random.Generator(np.random.PCG64(k)), flow, speed, 900.0, 0.0) for k in range(200)]
    gaps = np.concatenate([-np.diff([c.position for c in row]) for row in cars])
    assert gaps.min() >= MIN_HEADWAY * speed + 5.0 - 1e-9
    expected = 900.0 / (speed * 3600.0 / flow)
    assert np.mean([len(row) for row in cars]) == pytest.approx(expected, rel=0.03)
    factors = np.array([float(dict(c.type.attributes)["speedFactor"]) for row in cars for c in row])
    assert factors.mean() == pytest.approx(speed / 20.0, rel=0.01)
    assert np.abs(factors / (speed / 20.0) - 1.0).max() <= 0.2 + 1e-12
    assert {dict(c.type.attributes)["tau"] for row in cars for c in row} == {"0.7"}


def test_time_behind_counts_only_who_comes_after_ego() -> None:
    t = np.arange(0.0, 12.0, 0.1)
    ego, co = (10.0 * t - 50.0, 0.0 * t), (0.0 * t, 10.0 * t - 80.0)
    first, second = trace(ego, co), trace(co, ego)
    expected = 3.0 - 0.6  # centres come 3 s apart; half a length and half a width off, of both
    assert time_behind(first, "ego", "co_0") == pytest.approx(expected, abs=0.01)
    assert time_behind(first, "ego", "co_0") == pytest.approx(post_encroachment_time(first, "ego", "co_0"), abs=0.01)
    assert time_behind(second, "ego", "co_0") == 10.0
    assert pet_ego_first(horizon=5.0)(second) == 5.0
    assert time_behind(first, "ego", "co_0", zone=(0.0, 0.0, 8.0)) == pytest.approx(expected, abs=0.01)
    assert time_behind(first, "ego", "co_0", 4.0, zone=(40.0, 0.0, 8.0)) == 4.0


def test_ttc_on_paths_is_gap_by_closing_speed_and_knows_bends() -> None:
    t = np.arange(0.0, 3.0, 0.1)
    follow = trace((12.0 * t, 0.0 * t), (24.0 + 6.0 * t, 0.0 * t))
    found = ttc_on_paths(follow, "ego", "co_0")
    assert found[:20] == pytest.approx((20.0 - 6.0 * t[:20]) / 6.0, abs=1e-6)
    assert ttc_path_min()(follow) == pytest.approx(found.min())
    angle = np.arange(0.0, 6.0, 0.1) * 0.5
    ring = trace(*((18.0 * np.cos(angle + p), 18.0 * np.sin(angle + p)) for p in (0.0, 1.2)))
    inner = slice(1, len(angle) - 40)
    assert ttc_2d(ring, "ego", "co_0").min() > 0
    assert ttc_on_paths(ring, "ego", "co_0")[inner].min() == 5.0, "equal speeds on one ring never meet"
    head_on = trace((10.0 * t, 0.0 * t), (100.0 - 10.0 * t, 3.0 + 0.0 * t))
    assert ttc_path_min()(head_on) == 5.0


def test_metrics_among_many_take_the_worst_of_all() -> None:
    t = np.arange(0.0, 4.0, 0.1)
    ego, far = (10.0 * t, 0.0 * t), (10.0 * t, 40.0 + 0.0 * t)
    braking = (60.0 + 10.0 * t - 2.0 * t**2, 0.0 * t)
    struck_one = (9.0 + 6.0 * t, 0.0 * t)
    calm, worse, crash = trace(ego, far), trace(ego, far, braking), trace(ego, far, struck_one)
    assert (nearest_distance()(calm), any_collision()(calm), any_impact_speed()(calm)) == (38.0, 0.0, 0.0)
    assert others_braking_max()(calm) == pytest.approx(0.0, abs=1e-9)
    assert others_braking_max()(worse) == pytest.approx(4.0)
    worst = [metric(crash) for metric in (any_collision(), nearest_distance(), ttc_path_min(), pet_ego_first())]
    assert worst == [1.0, 0.0, 0.0, 0.0]
    assert any_impact_speed()(crash) == pytest.approx(4.0)
    assert any_collision()(trace(far)) == 0.0


@pytest.mark.sumo
@pytest.mark.parametrize("name", NAMES)
def test_nobody_leaves_the_road_while_ego_waits_for_ever(name: str, tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(
        "from sbt.sumo.actors import Action\n\n\nclass Stands:\n    def __init__(self, rng, set_speed):\n        pass\n\n"
        "    def act(self, t, own, others):\n        return Action(acceleration=-9.0, speed=0.0)\n"
    )
    scenario = load("scenarios", name).configured(ego={"kind": f"{tmp_path}/own.py:Stands"})
    fastest = {p.name: p.high for p in scenario.space.parameters} | {"flow_co": scenario.space.parameters[0].low}
    if name == "crossing_pedestrian":
        fastest["flow_co"] = 600.0
    for seed in range(3):
        trace_of_run = scenario.simulate(fastest, seed)
        assert trace_of_run.ended == "duration"

"""Scenarios in background traffic: what the settings of the AV do, and that traffic flows."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from scenario_points import centre, sobol

from sbt.config.assemble import assemble
from sbt.config.load import parse
from sbt.config.scenario_file import from_file
from sbt.execution.spec import ScenarioSpec
from sbt.plugins import load
from sbt.sumo.models import CAR_FOLLOWING
from sbt.sumo.nets import net_file
from sbt.sumo.session import scratch_folder
from sbt.workflows.checking import check_scenario

NETS = Path(__file__).resolve().parent.parent / "sumo_nets"
NAMES = ("crossing_pedestrian", "highway_merge", "roundabout_entry", "unprotected_left_turn")


@pytest.mark.sumo
@pytest.mark.parametrize("name", NAMES)
def test_traffic_flows_and_everything_is_measured(name: str) -> None:
    scenario = load("scenarios", name)
    for k, values in enumerate(sobol(scenario, 2)):
        run = scenario.simulate(values, k)
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
def test_who_brakes_with_its_set_speed_ahead_of_it_brakes_in_every_door(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(
        "from sbt.sumo.actors import Action\n\n\nclass Planner:\n    def __init__(self, rng, set_speed):\n        pass\n\n"
        "    def act(self, t, own, others):\n        return Action(acceleration=-3.0, speed=40.0)\n"
    )
    (tmp_path / "r.rou.xml").write_text(
        '<routes><vType id="t"/><vehicle id="ego" type="t" depart="0" departSpeed="${a}"><route edges="road"/></vehicle></routes>'
    )
    (tmp_path / "s.sumocfg").write_text(
        f'<configuration><input><net-file value="{net_file("straight")}"/><route-files value="r.rou.xml"/></input>'
        "<time><step-length value='0.1'/></time></configuration>"
    )
    (tmp_path / "scenario.yaml").write_text(
        "sumo: s.sumocfg\nego: {id: ego, kind: own.py:Planner}\ninputs: {a: {min: 8, max: 12}}\nduration: 2\n"
        "metrics: [deceleration_max]\nrequirement: {metric: deceleration_max, critical: [4, .inf]}\n"
    )
    own = load("scenarios", "emergency_braking").configured(ego={"kind": f"{tmp_path}/own.py:Planner"})
    for run in (own.simulate(centre(own), 1), from_file(str(tmp_path / "scenario.yaml"), tmp_path).simulate({"a": 10.0}, 1)):
        speed, dt = run.actor("ego").speed, float(run.time[1])
        assert np.diff(speed)[:10] == pytest.approx(np.full(10, -3.0 * dt), abs=1e-9)


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

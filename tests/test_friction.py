"""Friction bounds accelerations: of controllers and of SUMO's drivers, on user's own roads and in built-in scenarios."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scenario_points import sobol
from test_doors import files_of

from sbt.errors import InputError
from sbt.execution.spec import ScenarioSpec

G = 9.81
ROUTES = """<routes>
<vType id="car" length="5" width="1.8" sigma="0" maxSpeed="60" decel="4.5" emergencyDecel="9" carFollowModel="MODEL"/>
<route id="ahead" edges="EDGES"/>
<vehicle id="ego" type="car" route="ahead" depart="0" departPos="100" departSpeed="${v}" departLane="LANE"
    insertionChecks="none"/>
<vehicle id="wall" type="car" route="ahead" depart="0" departPos="WALL" departSpeed="0" departLane="LANE" insertionChecks="none">
    <stop lane="road_LANE" endPos="WALL" duration="1000"/></vehicle>
</routes>"""
SCENARIO = """
sumo: {net: road.net.xml, routes: friction.rou.xml, options: {step-method.ballistic: BALLISTIC}}
inputs: {v: {min: 10, max: 40}, mu: {min: 0.05, max: 1.2}}
friction: "${mu}"
ego: {id: ego, kind: "full.py:Full"}
duration: 30
metrics: [ttc_min]
requirement: {metric: ttc_min, critical: [-.inf, 1.0]}
"""
FULL = """
from sbt.sumo.actors import Action


class Full:
    def __init__(self, rng, set_speed, demand=-20.0):
        self._demand = demand

    def act(self, t, own, others):
        return Action(acceleration=self._demand)
"""

ICE = """<net version="1.20" junctionCornerDetail="5" limitTurnSpeed="5.50">
    <location netOffset="0,0" convBoundary="0,0,2000,0" origBoundary="0,0,2000,0" projParameter="!"/>
    <edge id="road" from="west" to="mid" priority="1">
        <lane id="road_0" index="0" friction="0.1" speed="50" length="150" shape="0,-1.6 150,-1.6"/></edge>
    <edge id="dry" from="mid" to="east" priority="1">
        <lane id="dry_0" index="0" speed="50" length="1850" shape="150,-1.6 2000,-1.6"/></edge>
    <junction id="west" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,0 0,-3.2"/>
    <junction id="mid" type="priority" x="150" y="0" incLanes="road_0" intLanes="" shape="150,0 150,-3.2">
        <request index="0" response="0" foes="0" cont="0"/></junction>
    <junction id="east" type="dead_end" x="2000" y="0" incLanes="dry_0" intLanes="" shape="2000,-3.2 2000,0"/>
    <connection from="road" to="dry" fromLane="0" toLane="0" dir="s" state="M"/>
</net>"""


def ran(
    folder: Path,
    changes: dict[str, str] | None = None,
    *,
    wall: float = 1900,
    lane: int = 0,
    model: str = "Krauss",
    edges: str = "road",
    **values,
):
    files_of("own_files", folder)
    (folder / "full.py").write_text(FULL)
    routes = ROUTES.replace("WALL", str(wall)).replace("LANE", str(lane)).replace("MODEL", model)
    routes = routes.replace("EDGES", edges)
    (folder / "friction.rou.xml").write_text(routes)
    text = SCENARIO.replace("BALLISTIC", "true")
    for old, new in (changes or {}).items():
        assert old in text
        text = text.replace(old, new)
    (folder / "friction.yaml").write_text(text)
    scenario = ScenarioSpec(str(folder / "friction.yaml")).resolve()
    return scenario.simulate(scenario.space.values(values), 0).actor("ego")


@pytest.mark.sumo
@pytest.mark.parametrize(("v", "mu"), [(13.9, 0.2), (25.0, 0.5), (36.0, 0.8)])
def test_the_stopping_distance_of_a_controller_is_that_of_physics(tmp_path, v, mu):
    ego = ran(tmp_path, v=v, mu=mu)
    assert ego.speed[-1] == 0.0
    assert ego.x[-1] - ego.x[0] == pytest.approx(v**2 / (2 * mu * G), abs=0.05)
    assert ego.acceleration.min() == pytest.approx(-mu * G, abs=1e-6)


@pytest.mark.sumo
def test_a_controller_accelerates_no_faster_than_friction_lets_it(tmp_path):
    ego = ran(tmp_path, {'"full.py:Full"': '"full.py:Full", demand: 20', "duration: 30": "duration: 5"}, v=10, mu=0.3)
    assert ego.acceleration[1:].max() == pytest.approx(0.3 * G, abs=1e-6)


@pytest.mark.sumo
@pytest.mark.parametrize("model", ["Krauss", "IDM"])
def test_drivers_of_sumo_brake_no_harder_and_hit_what_they_cannot_avoid(tmp_path, model):
    driven = {', kind: "full.py:Full"': "", "duration: 30": "duration: 8", "net: road": "net: one"}
    for name in ("wet", "dry"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "one.net.xml").write_text(ICE.replace('friction="0.1" ', ""))
    wet = ran(tmp_path / "wet", driven, wall=148, model=model, v=20, mu=0.2)  # 43 m to its rear, 102 m to stop
    dry = ran(tmp_path / "dry", driven, wall=148, model=model, v=20, mu=1.0)
    assert wet.acceleration.min() == pytest.approx(-0.2 * G, abs=1e-6)
    assert wet.speed[-1] ** 2 == pytest.approx(20**2 - 2 * 0.2 * G * 43, rel=0.05)  # of the impact
    assert dry.speed[-1] < 0.1
    assert dry.acceleration.min() < -0.2 * G


@pytest.mark.sumo
def test_lanes_have_a_friction_of_their_own(tmp_path):
    files_of("own_files", tmp_path)
    for lane, mu in ((0, 0.3), (1, None)):
        folder = tmp_path / str(lane)
        folder.mkdir()
        files_of("own_files", folder)
        net = (tmp_path / "road.net.xml").read_text().replace('id="road_0"', 'id="road_0" friction="${mu}"')
        (folder / "own.net.xml").write_text(net)
        ego = ran(folder, {'friction: "${mu}"\n': "", "net: road": "net: own"}, lane=lane, v=25, mu=0.3)
        assert ego.acceleration.min() == pytest.approx(-20.0 if mu is None else -mu * G, abs=1e-6)


@pytest.mark.sumo
def test_a_vehicle_gets_its_limits_back_where_the_ice_ends(tmp_path):
    (tmp_path / "ice.net.xml").write_text(ICE)
    changes = {'friction: "${mu}"\n': "", "net: road": "net: ice", ", mu: {min: 0.05, max: 1.2}": ""}
    ego = ran(tmp_path, changes, edges="road dry", wall=10, v=20)
    front = ego.x + 2.5
    on, off = (front > 101) & (front < 148), (front > 155) & (ego.speed > 2.1)
    assert ego.acceleration[on] == pytest.approx(-0.1 * G, abs=1e-6)
    assert ego.acceleration[off] == pytest.approx(-20.0, abs=1e-6)


@pytest.mark.sumo
@pytest.mark.parametrize("name", ["emergency_braking", "following", "unprotected_left_turn"])
def test_built_in_scenarios_stay_within_friction(name):
    scenario = ScenarioSpec(name, friction=(0.1, 0.9)).resolve()
    assert scenario.space.names[-1] == "friction"
    binding = 0
    for k, values in enumerate(sobol(scenario, 12)):
        trace = scenario.simulate(values, k)
        hardest = np.nanmax(np.abs(trace.acceleration))
        assert hardest <= values["friction"] * G + 1e-6
        binding += hardest > 0.98 * values["friction"] * G
        if k < 2:
            assert trace.identical(scenario.configured(isolation="fresh").simulate(values, k))
    assert binding >= 2


@pytest.mark.sumo
def test_replicas_have_a_friction_each():
    scenario = ScenarioSpec("emergency_braking", friction=(0.1, 0.9), isolation="replicas").resolve()
    work = [(values, 3) for values in sobol(scenario, 8)]
    alone = ScenarioSpec("emergency_braking", friction=(0.1, 0.9), isolation="fresh").resolve()
    for (values, seed), trace in zip(work, scenario.simulate.simulate_many(work), strict=True):
        assert trace.identical(alone.simulate(values, seed))


def test_a_range_of_friction_belongs_to_the_scenario_file(tmp_path):
    files_of("own_files", tmp_path)
    spec = ScenarioSpec(str(tmp_path / "profile.yaml"), friction=(0.2, 0.4))
    with pytest.raises(InputError, match=r"must be an input of scenario\.yaml"):
        spec.resolve()
    with pytest.raises(InputError, match="0 < min <= max"):
        ScenarioSpec("cut_in", friction=(0.4, 0.2)).resolve()
    with pytest.raises(InputError, match="offers no choice of friction"):
        ScenarioSpec("testbed:four_branch_7", friction=(0.2, 0.2)).resolve()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [('"${mu}"', "wet", r'friction must be a number, or a placeholder such as "\$\{mu\}", but got \'wet\''),
     ('"${mu}"', "-0.1", "friction must be > 0, but got -0.1"), ('"${mu}"', '"${nu}"', "must be one of v, mu, but got 'nu'"),
     ('"${mu}"', "0.3", "an input must stand as a placeholder")],
)  # fmt: skip
def test_mistakes_are_named(tmp_path, old, new, words):
    with pytest.raises(InputError, match=words):
        ran(tmp_path, {old: new})

"""A road user has an id and a size of its own, and drives where it goes; or the user is told."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from own_networks import run_program

from sbt.errors import InputError, RunError
from sbt.execution.spec import ScenarioSpec
from sbt.sumo.ego import Ego
from sbt.sumo.ego_vehicle import EgoVehicle

pytestmark = pytest.mark.sumo

_YAML = """sumo: {{net: net.net.xml, routes: r.rou.xml, options: {{step-length: {step}}}}}
{loop}inputs: {{v: {{min: 5, max: 20, unit: m/s}}}}
ego: ego
duration: 6
metrics: [ttc_min, distance_min, collision]
requirement: {{metric: ttc_min, critical: [-.inf, 1.0]}}
"""
_TRAFFIC = """<routes><vType id="car" length="5" width="1.8" sigma="0" maxSpeed="20"/>
<vType id="bus" length="18" width="2.5"/>
<vehicle id="ego" type="car" depart="0" departPos="50" departSpeed="${{v}}" insertionChecks="none"><route edges="ab"/></vehicle>
<vehicle id="lead" type="car" depart="0" departPos="90" departSpeed="5" insertionChecks="none"><route edges="ab"/></vehicle>
{more}</routes>"""


def _scenario(
    folder: Path, *, loop: str = "", more: str = "", step: float = 0.1, length: str = "", net: tuple[str, ...] = ()
) -> Path:  # fmt: skip
    (folder / "n.nod.xml").write_text('<nodes><node id="a" x="0" y="0"/><node id="b" x="400" y="0"/></nodes>')
    (folder / "n.edg.xml").write_text(f'<edges><edge id="ab" from="a" to="b" numLanes="1" speed="20" {length}/></edges>')
    run_program(folder, "netconvert", "-n", "n.nod.xml", "-e", "n.edg.xml", "-o", "net.net.xml", *net)
    (folder / "r.rou.xml").write_text(_TRAFFIC.format(more=more))
    named = ""
    if loop:
        head = "def simulate(sumo, values, rng):\n    k = 0\n    while True:\n        k += 1\n"
        (folder / "mine.py").write_text(f"{head}{loop}        sumo.simulationStep()\n")
        named = "simulate: mine.py:simulate\n"
    (folder / "scenario.yaml").write_text(_YAML.format(step=step, loop=named))
    return folder / "scenario.yaml"


_PERSON = '<person id="lead" depart="0"><walk from="ab" to="ab" departPos="200" arrivalPos="300"/></person>'


def test_no_person_has_the_id_of_a_vehicle(tmp_path: Path):
    """`randomTrips.py` numbers both from 0: of two near the ego with one id SUMO's subscription tells of one."""
    path = _scenario(tmp_path, more=_PERSON, net=("--sidewalks.guess", "--crossings.guess"))
    said = r"r.rou.xml:5:1: no person may have the id of a vehicle, .* vehicle 'lead' too \(.*r.rou.xml:4:1\)"
    with pytest.raises(InputError, match=said):
        ScenarioSpec(str(path)).resolve()


def test_nor_one_that_a_loop_adds(tmp_path: Path):
    add = 'sumo.person.add("lead", "ab", 100.0); sumo.person.appendWalkingStage("lead", ["ab"], 200.0)'
    walks = ("--sidewalks.guess", "--sidewalks.guess.max-speed", "30")
    path = _scenario(tmp_path, loop=f"        if k == 5:\n            {add}\n", net=walks)
    with pytest.raises(RunError, match="no person may have the id of a vehicle, but there are both of 'lead'"):
        ScenarioSpec(str(path)).resolve().simulate({"v": 10.0}, 1)


@pytest.mark.parametrize(
    "change",
    [
        'sumo.vehicle.setType("lead", "bus")',
        'sumo.vehicle.setLength("lead", 12.0)',
        'sumo.vehicle.remove("lead"); sumo.route.add("r", ["ab"]); sumo.vehicle.add("lead", "r", "bus", departPos="120")',
    ],
)
def test_a_road_user_has_one_size(tmp_path: Path, change: str):
    """A car that becomes a bus of 18 m was hit without a word."""
    path = _scenario(tmp_path, loop=f"        if k == 5:\n            {change}\n")
    with pytest.raises(RunError, match=r"'lead' must keep its size while it is recorded, but was 5 m by 1\.8 m and is 1"):
        ScenarioSpec(str(path)).resolve().simulate({"v": 10.0}, 1)


def test_who_is_put_to_another_place_does_not_drive_there(tmp_path: Path):
    """At 150 m/s half a second allows 75 m: a leader that is put 60 m back was taken to have driven through the ego."""
    put = '        if k == 4:\n            sumo.vehicle.moveTo("lead", "ab_0", 35.0)\n'
    trace = ScenarioSpec(str(_scenario(tmp_path, loop=put, step=0.5))).resolve().simulate({"v": 10.0}, 1)
    assert np.flatnonzero(~trace.present[:, trace.actors.index("lead")]).tolist() == [3]
    assert any(said.startswith("teleported: 'lead' at 1.500 s") for said in trace.unconfirmed)


def test_a_leader_that_is_put_along_its_way_step_by_step_drives(tmp_path: Path):
    put = '        if k > 1:\n            sumo.vehicle.moveTo("lead", "ab_0", 90.0 + 1.0 * k)\n'
    trace = ScenarioSpec(str(_scenario(tmp_path, loop=put))).resolve().simulate({"v": 10.0}, 1)
    assert trace.present[:, trace.actors.index("lead")].all()


def test_lengths_that_are_not_those_of_shapes_are_told(tmp_path: Path):
    simulation = ScenarioSpec(str(_scenario(tmp_path, length='length="800"'))).resolve().simulate
    simulation({"v": 10.0}, 1)
    assert any("edges have another length than their shape ('ab' 800 m for 400 m)" in said for said in simulation.warnings())


def test_an_ego_with_another_model_keeps_the_other_properties_of_its_type(tmp_path: Path):
    """What it does at junctions, when it acts and how it changes lanes was that of SUMO's default type."""
    own = 'actionStepLength="1" jmIgnoreFoeProb="1" jmDriveAfterRedTime="9" lcStrategic="3" impatience="0.7" sigma="0.2"'
    path = _scenario(tmp_path)
    routes = tmp_path / "r.rou.xml"
    traffic = routes.read_text().replace('<vehicle id="ego" type="car"', '<vehicle id="ego" type="mine"')
    routes.write_text(traffic.replace('<vType id="car"', f'<vType id="mine" {own} accel="${{v / 10}}"/>\n<vType id="car"'))
    files = ScenarioSpec(str(path)).resolve().simulate.files
    ego = EgoVehicle("ego", Ego.of(kind="sumo", model="IDM", tau=0.8))
    made = ET.fromstring(ego.vehicle_type(files, {"v": 20.0})).attrib
    assert made == {
        "id": "sbt_ego", "actionStepLength": "1", "jmIgnoreFoeProb": "1", "jmDriveAfterRedTime": "9", "lcStrategic": "3",
        "impatience": "0.7", "accel": "2", "carFollowModel": "IDM", "laneChangeModel": "LC2013", "tau": "0.8",
    }  # fmt: skip


def test_a_network_without_lanes_inside_junctions_is_named_where_the_ego_jumps_over_one(tmp_path: Path):
    path = _scenario(tmp_path)
    nodes = (f'<node id="{name}" x="{x}" y="{y}"/>' for name, x, y in (("a", 0, 0), ("b", 90, 0), ("c", 90, 300)))
    (tmp_path / "n.nod.xml").write_text(f"<nodes>{''.join(nodes)}</nodes>")
    edges = (f'<edge id="{a}{b}" from="{a}" to="{b}" numLanes="2" speed="20"/>' for a, b in ("ab", "bc", "cb"))
    (tmp_path / "n.edg.xml").write_text(f"<edges>{''.join(edges)}</edges>")
    run_program(tmp_path, "netconvert", "-n", "n.nod.xml", "-e", "n.edg.xml", "-o", "net.net.xml", "--no-internal-links",
                "--default.junctions.radius", "20")  # fmt: skip
    routes = tmp_path / "r.rou.xml"
    alone = [line for line in routes.read_text().splitlines() if 'id="lead"' not in line]
    routes.write_text("\n".join(alone).replace('edges="ab"', 'edges="ab bc"'))
    said = "as the network has no lanes inside junctions: make it, and run SUMO, without no-internal-links"
    with pytest.raises(RunError, match=said):
        ScenarioSpec(str(path)).resolve().simulate({"v": 10.0}, 1)


def test_an_error_has_the_place_of_what_it_is_about_and_not_of_a_warning(tmp_path: Path):
    again = '<vehicle id="ego" type="car" depart="1"><route edges="ab"/></vehicle>'
    path = _scenario(tmp_path, more=f'<vType id="wild" tau="0.01"/>{again}')
    with pytest.raises(RunError, match=r"r.rou.xml:3:1: SUMO: .*'ego' already exists") as raised:
        ScenarioSpec(str(path)).resolve().simulate({"v": 10.0}, 1)
    assert "Warning" in str(raised.value)

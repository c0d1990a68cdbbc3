"""Where vehicles go on beyond their record, on whichever lane they are; and what makes a departure other than asked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from own_networks import run_program

from sbt.errors import InputError
from sbt.execution.spec import ScenarioSpec
from sbt.sumo.trailing import TrailingBody

pytestmark = pytest.mark.sumo

_ROAD = {
    "n.nod.xml": '<nodes><node id="a" x="0" y="0"/><node id="b" x="1500" y="0"/><node id="c" x="2000" y="300"/></nodes>',
    "n.edg.xml": "<edges>" + "".join(
        f'<edge id="{a}{b}" from="{a}" to="{b}" numLanes="1" speed="25" width="{{width}}"/>' for a, b in ("ab", "ba", "bc", "cb")
    ) + "</edges>",
}  # fmt: skip
_YAML = """sumo: {{net: net.net.xml, routes: r.rou.xml, options: {{{options}}}}}
inputs: {{v: {{min: 1, max: 12, unit: m/s}}}}
ego: ego
duration: {duration}
others: {{within: {within}}}
metrics: [ttc_path_min, ttc_min, ttc_2d_min, distance_min]
requirement: {{metric: ttc_path_min, critical: [-.inf, 1.0]}}
"""
_OVERTAKING = """<routes>
<vType id="car" length="5" width="1.8" sigma="0" lcOpposite="1" lcAssertive="1"/>
<vType id="truck" vClass="truck" length="12" width="2.5" sigma="0" maxSpeed="${v}" lcOpposite="0"/>
<vType id="semi" vClass="trailer" length="16" width="2.5" sigma="0" maxSpeed="20" lcOpposite="1" lcSpeedGain="10"/>
<vehicle id="truck" type="truck" depart="0" departPos="150" departSpeed="5"><route edges="ab bc"/></vehicle>
<vehicle id="ego" type="semi" depart="0" departPos="100" departSpeed="10"><route edges="ab bc"/></vehicle>
<vehicle id="on" type="car" depart="0" departPos="1022.51" departSpeed="20"><route edges="ba"/></vehicle>
</routes>"""


def _scenario(
    folder: Path, routes: str, *net: str, width: float = 3.2, duration: float = 40, within: float = 300, options: str = ""
) -> Path:  # fmt: skip
    for name, text in _ROAD.items():
        (folder / name).write_text(text.replace("{width}", f"{width}"))
    run_program(folder, "netconvert", "-n", "n.nod.xml", "-e", "n.edg.xml", "-o", "net.net.xml", *net)
    (folder / "r.rou.xml").write_text(routes)
    (folder / "scenario.yaml").write_text(_YAML.format(options=options, duration=duration, within=within))
    return folder / "scenario.yaml"


def _metrics(path: Path, v: float = 6.377492, seed: int = 9100524) -> dict[str, float]:
    scenario = ScenarioSpec(str(path)).resolve()
    return dict(scenario.measure(scenario.simulate({"v": v}, seed)))


def test_a_long_vehicle_returns_from_the_lane_of_oncoming_traffic_whatever_turns_there_are_at_its_end(tmp_path: Path):
    """The lane that it leaves leads to its own by the turnaround at the end of the road, hundreds of metres away."""
    found = []
    for name, net in (("turns", ()), ("none", ("--no-turnarounds",))):
        (tmp_path / name).mkdir()
        found.append(_metrics(_scenario(tmp_path / name, _OVERTAKING, "--opposites.guess", *net)))
    assert found[0] == pytest.approx(found[1])
    assert found[0]["ttc_path_min"] == pytest.approx(found[0]["ttc_min"]) == pytest.approx(found[0]["ttc_2d_min"])
    assert found[0]["ttc_min"] < 2.0


def test_who_overtakes_on_the_lane_of_oncoming_traffic_goes_on_in_its_own_direction(tmp_path: Path):
    """The run ends while the ego is there: the way ahead is along its route, towards who comes, and not back."""
    path = _scenario(tmp_path, _OVERTAKING, "--opposites.guess", duration=6)
    found = _metrics(path)
    assert found["ttc_path_min"] == pytest.approx(found["ttc_min"], abs=0.01)
    assert 3.5 < found["ttc_min"] < 4.5
    way = ScenarioSpec(str(path)).resolve().simulate({"v": 6.377492}, 9100524).ways["ego"]
    assert abs(way[:, 2]).max() < 0.05
    assert way[-1, 0] > way[0, 0] + 150.0


def test_who_leaves_the_radius_on_the_lane_of_oncoming_traffic_does_not_come_back(tmp_path: Path):
    """Two overtake one behind the other, the first is faster: ttc_path_min was .7 s where it leaves the radius."""
    routes = """<routes><vType id="ov" length="5" width="1.8" sigma="0" lcOpposite="5" lcAssertive="5" lcSpeedGain="10"/>
<vType id="truck" vClass="truck" length="12" width="2.5" sigma="0" maxSpeed="${v}" lcOpposite="0"/>
<vehicle id="truck" type="truck" depart="0" departPos="190" departSpeed="5"><route edges="ab bc"/></vehicle>
<vehicle id="truck2" type="truck" depart="0" departPos="215" departSpeed="5"><route edges="ab bc"/></vehicle>
<vehicle id="first" type="ov" depart="0" departPos="130" departSpeed="10.5" insertionChecks="none">
<route edges="ab bc"/></vehicle>
<vehicle id="ego" type="ov" depart="0" departPos="100" departSpeed="10" insertionChecks="none">
<route edges="ab bc"/></vehicle></routes>"""
    assert _metrics(_scenario(tmp_path, routes, "--opposites.guess", duration=12, within=32), 6.4, 0)["ttc_path_min"] == 5.0


@pytest.mark.parametrize("side", [(), ("--lefthand",)])
def test_a_way_keeps_its_place_in_the_lane_on_either_side_of_the_road(tmp_path: Path, side: tuple[str, ...]):
    """Two motorcycles are 2 m apart sideways at all times; the way of one led to the middle of the lane, where the other was."""
    routes = """<routes><vType id="c" latAlignment="right" sigma="0" width="1" length="2.2" vClass="motorcycle" maxSpeed="15"/>
<vType id="d" latAlignment="left" sigma="0"  width="1" vClass="motorcycle" length="2.2" maxSpeed="${v}"/>
<vehicle id="b" type="d" depart="0" departPos="1470" departPosLat="left" departSpeed="5" insertionChecks="none">
<route edges="ab bc"/></vehicle>
<vehicle id="ego" type="c" depart="0" departPos="1430" departSpeed="13" departPosLat="right" insertionChecks="none">
<route edges="ab bc"/></vehicle></routes>"""
    path = _scenario(tmp_path, routes, *side, width=4, duration=2, options="lateral-resolution: 0.5")
    assert _metrics(path, 5.0)["ttc_path_min"] == 5.0
    trace = ScenarioSpec(str(path)).resolve().simulate({"v": 5.0}, 0)
    way, own = trace.ways["ego"], trace.actor("ego")
    before = way[way[:, 0] < 1490.0]
    assert abs(before[:, 1] - own.y[-1]).max() < 0.01


_ALONE = """<routes><vType id="own" sigma="0"/><vehicle id="ego" type="own" depart="0" departPos="100" departSpeed="${v}">
<route edges="ab bc"/></vehicle></routes>"""


def test_a_mesoscopic_simulation_is_refused(tmp_path: Path):
    path = _scenario(tmp_path, _ALONE, options="mesosim: true")
    with pytest.raises(InputError, match="mesosim must be false, as vehicles of a mesoscopic simulation have no positions"):
        ScenarioSpec(str(path)).resolve()
    _scenario(tmp_path, _ALONE, options="mesosim: false")
    ScenarioSpec(str(path)).resolve()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ("scale: 2", 'there is \'ego.1\' too, as the option scale: 2 .* give its vType \'own\' scale="0.5"'),
        ("random-depart-offset: 20", "the option random-depart-offset: 20 lets it depart later: set it to 0"),
    ],
)
def test_an_ego_that_an_option_copies_or_moves_is_told_with_that_option(tmp_path: Path, options: str, says: str):
    scenario = ScenarioSpec(str(_scenario(tmp_path, _ALONE, options=options))).resolve()
    with pytest.raises(Exception, match=says):
        scenario.simulate({"v": 8.0}, 1)


def test_a_long_vehicle_that_comes_back_elsewhere_is_behind_its_front():
    """Teleported, or out of the radius meanwhile: it lay across the road, shifted beside its old path."""
    body = TrailingBody(16.0, leads_to=lambda *_: False)
    body.move((0.0, 0.0), 1.0, 0.0, "a_0", 1.0)
    back = body.move((40.0, 30.0), 0.0, 1.0, "b_0", 1.0)
    beside = body.move((36.8, 31.0), 0.0, 1.0, "b_1", 1.0)
    for front, poses in zip(((40.0, 30.0), (36.8, 31.0)), body.poses([back, beside]), strict=True):
        assert poses[:, 0] == pytest.approx(front[0])
        assert poses[:, 1] == pytest.approx(front[1] - 2.0 - 4.0 * np.arange(4))
        assert poses[:, 2] == pytest.approx(np.pi / 2)

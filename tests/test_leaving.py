"""An ego that SUMO takes off the road has not arrived."""

# ruff: noqa: E501  (XML)

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from own_networks import run_program
from test_evidence import deaf, net, simulation, vehicle

from sbt.execution.spec import ScenarioSpec
from sbt.execution.worker import run_job
from sbt.metrics.traffic import any_collision, any_impact_speed
from sbt.problem.outcome import Job, Outcome
from sbt.sumo.leaving import Leaving

NODES = '<nodes><node id="a" x="0" y="0"/><node id="b" x="200" y="0"/><node id="c" x="212" y="0"/><node id="d" x="212" y="190"/></nodes>'
EDGES = '<edges><edge id="ab" from="a" to="b" numLanes="1"/><edge id="bc" from="b" to="c" numLanes="1"/><edge id="cd" from="c" to="d" numLanes="1"/></edges>'
YAML = """sumo: my.sumocfg
inputs: {{v: {{min: 5, max: 10}}}}
ego: {{id: ego, may_leave: {may}}}
duration: 60
metrics: [ttc_path_min]
requirement: {{metric: ttc_path_min, critical: [-.inf, 1.0]}}
"""
STOPS = {"route": 'ab bc cd"/><stop lane="cd_0" endPos="180" duration="9"/><param key="x" value="'}
EGO = '<vehicle id="ego" depart="0" departPos="{at}" departSpeed="${{v}}" {attributes}><route edges="{route}"/></vehicle>'
JAM = '<vehicle id="b" depart="0" departPos="{at}" departSpeed="0"><route edges="{edge}"/><stop lane="{edge}_0" endPos="{end}" duration="500"/></vehicle>'
REMOVE = "<time-to-teleport value='5'/><time-to-teleport.remove value='true'/>"
CALIBRATOR = '<calibrator id="c" edge="cd" pos="50" freq="5"><flow begin="0" end="1000" vehsPerHour="0" speed="13"/></calibrator>'
TERMINATE = '<rerouter id="r" edges="{edge}"><interval begin="0" end="1000"><destProbReroute id="terminateRoute" probability="1"/></interval></rerouter>'


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("net")
    (folder / "n.nod.xml").write_text(NODES)
    (folder / "e.edg.xml").write_text(EDGES)
    run_program(folder, "netconvert", "-n", "n.nod.xml", "-e", "e.edg.xml", "-o", "net.net.xml")
    return folder / "net.net.xml"


def _run(
    folder: Path, network: Path, ego: dict[str, str], *, traffic: str = "", options: str = "", more: str = "", step: float = 0.1,
    may: bool = True,
) -> Outcome:  # fmt: skip
    given = {"at": "100", "route": "ab bc cd", "attributes": ""} | ego
    (folder / "my.rou.xml").write_text(f"<routes>{EGO.format(**given)}{traffic}</routes>")
    (folder / "a.add.xml").write_text(f"<additional>{more}</additional>")
    (folder / "my.sumocfg").write_text(
        f'<configuration><net-file value="{network}"/><route-files value="my.rou.xml"/><additional-files value="a.add.xml"/>'
        f'<step-length value="{step}"/>{options}</configuration>'
    )
    (folder / "s.yaml").write_text(YAML.format(may=str(may).lower()))
    return run_job(ScenarioSpec(str(folder / "s.yaml")).resolve(), Job(0, {"v": 8.0}, 1))


@pytest.mark.parametrize("may", [True, False])
@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"traffic": JAM.format(at=150, edge="ab", end=160), "options": REMOVE}, "SUMO removed it from a jam, 1.. m along 'ab'"),
        ({"ego": {"at": "20", "route": "cd"}, "traffic": JAM.format(at=150, edge="cd", end=160), "options": REMOVE},
         "SUMO removed it from a jam, 1.. m along 'cd'"),
        ({"more": CALIBRATOR}, "gone at .* calibrators do: the files have 'c'"),
        ({"more": TERMINATE.format(edge="ab")}, "its route was cut to end 100 m along 'ab'"),
        ({"more": TERMINATE.format(edge="cd")}, "its route was cut to end .* m along 'cd'|removed .* before the end of its route"),
    ],
    ids=["jam", "jam on the last edge", "calibrator", "cut at once", "cut at the last edge"],
)  # fmt: skip
def test_an_ego_that_is_removed_has_not_arrived(tmp_path: Path, network: Path, given, said: str, may: bool):
    """With `may_leave`, which the message advised, such a run was uncritical: nothing can happen to who is gone."""
    outcome = _run(tmp_path, network, **({"ego": {}} | given), may=may)
    assert outcome.status == "invalid", outcome.reason
    assert "may_leave" not in outcome.reason
    assert re.search(said, outcome.reason), outcome.reason


@pytest.mark.parametrize("step", [0.1, 1.0])
@pytest.mark.parametrize(
    "ego",
    [
        {}, STOPS, {"at": "195", "route": "ab bc"}, {"attributes": 'arrivalPos="50"'}, {"attributes": 'arrivalPos="1"'}, {"attributes": 'arrivalPos="-100"'}, {"attributes": 'arrivalPos="random"'},
        {"attributes": 'arrivalSpeed="0"'}, {"attributes": 'arrivalEdge="0"'}, {"at": "20", "route": "cd", "attributes": 'arrivalPos="20"'},
    ],
    ids=["end", "after a stop there", "short edge", "position", "behind a bend", "from the end", "random", "slow", "edge", "at once"],
)  # fmt: skip
def test_an_ego_at_the_end_of_its_route_has_arrived(tmp_path: Path, network: Path, ego, step: float):
    """Also where that is not the end of an edge, or of an edge that is shorter than a step."""
    outcome = _run(tmp_path, network, ego, step=step, options=REMOVE)
    assert outcome.status == "ok", outcome.reason
    (tmp_path / "must").mkdir()
    assert "make the route longer" in _run(tmp_path / "must", network, ego, step=step, may=False).reason


@pytest.mark.parametrize(
    ("road", "lane", "position", "waited", "removes", "said"),
    [
        ("cd", "cd_0", 99.9, 9.0, "true", ""),  # it stood there, but not until SUMO removes it
        ("cd", "cd_0", 99.9, 20.0, "true", "from a jam, 100 m along 'cd'"),
        ("dc", "dc_0", 0.5, 0.0, "false", ""),  # on the opposite lane, along which its position is
        ("cd", "cd_0", 0.5, 0.0, "false", "cut to end 0 m along 'cd'"),
        (":c", ":c_0", 1.0, 0.0, "false", "removed in the junction behind 'cd', before the end of its route on 'ef'"),
    ],
)
def test_who_stood_or_overtook_at_its_end_has_arrived(road: str, lane: str, position: float, waited: float, removes: str, said: str):
    options = {"time-to-teleport": "20", "time-to-teleport.highways": "0", "time-to-teleport.disconnected": "-1"}
    route = ("ab", "cd", "ef") if road == ":c" else ("ab", "cd")
    vehicle = SimpleNamespace(
        getRouteID=lambda ego: "r", getRoute=lambda ego: route, getWaitingTime=lambda ego: waited, getRouteIndex=lambda ego: 1,
        getLanePosition=lambda ego: position, getRoadID=lambda ego: road, getLaneID=lambda ego: lane,
    )  # fmt: skip
    sumo = SimpleNamespace(
        vehicle=vehicle, lane=SimpleNamespace(getLength=lambda lane: 100.0),
        simulation=SimpleNamespace(getOption=lambda name: options.get(name, removes)),
    )  # fmt: skip
    leaving = Leaving(sumo, "ego", ("max", None))
    leaving.look()
    found = leaving.why_removed(0.0, 0.1)
    assert said in found
    assert bool(found) == bool(said)


def arriving(folder: Path, step: str, kind: str, *, rear: float = 395.0, speed: float = 0.0, **of_ego: float):
    """Return the trace of an ego that looks at nobody and arrives at 400 m, where another one is, of so long a body."""
    kinds = f'<vType id="other" length="{kind}" width="1.8"/><vType id="own" length="4.5" width="1.8"/>'
    given = {"departPos": 333.0, "departSpeed": 20.0, "arrivalPos": 400.0} | of_ego
    other = vehicle("o", "road", "other", departPos=rear + float(kind), departSpeed=speed)
    road = net({"road": [(0.0, 0.0), (600.0, 0.0)]})
    return simulation(folder, road, kinds + vehicle("ego", "road", "own", **given) + other, deaf("ego", "o"), 20.0, step_length=step)({}, 1)


@pytest.mark.sumo
@pytest.mark.parametrize("kind", ["4.5", "16.5"])
@pytest.mark.parametrize("step", ["0.1", "0.5", "1"])
def test_an_ego_arrives_only_where_nobody_is(tmp_path: Path, kind: str, step: str):
    """In the step in which SUMO took it off the road it drove through whoever stood there."""
    for rear in (388.0, 391.0, 394.0, 399.0):
        trace = arriving(tmp_path, step, kind, rear=rear)
        assert (trace.ended, any_collision()(trace)) == ("collision", 1.0), rear
        assert trace.time[-1] == pytest.approx(np.ceil((rear - 333.0) / 20.0 / float(step)) * float(step), abs=1.01 * float(step))
        at_its_end = trace.x[-1, 0] + 2.25 > 400.0
        assert any("the ego arrives within this step" in text for text in trace.unconfirmed) == at_its_end


@pytest.mark.sumo
@pytest.mark.parametrize("step", ["0.1", "1"])
def test_an_ego_touches_nobody_after_it_has_arrived(tmp_path: Path, step: str):
    """Nor whom it would not have met if it had braked within that step."""
    alone = arriving(tmp_path, step, "4.5", rear=500.0)
    braking = [(349.5, 15.0)] if step == "1" else []  # its rear is at 399.75 m when the ego, 1.5 m behind before, is there at 20 m/s
    for rear, speed in ((400.5, 0.0), (410.0, 0.0), (395.0, 18.0), (390.0, 20.0), *braking):
        trace = arriving(tmp_path, step, "4.5", rear=rear, speed=speed)
        assert (trace.ended, any_collision()(trace)) == ("left", 0.0)
        assert np.array_equal(trace.x[:, 0], alone.x[:, 0])


@pytest.mark.sumo
@pytest.mark.parametrize("step", ["0.01", "0.1"])
def test_who_meets_somebody_at_its_end_meets_at_its_speed(tmp_path: Path, step: str):
    """SUMO lets it arrive a tenth of a metre before; driving the rest in the same step looked like 600 m/s^2."""
    for k in range(8):
        folder = tmp_path / str(k)
        folder.mkdir()
        trace = arriving(folder, step, "4.5", rear=399.95, departPos=390.0 + 0.13 * k * float(step), departSpeed=10.0, maxSpeed=10.0)
        assert any_impact_speed()(trace) == pytest.approx(10.0)
        assert float(np.abs(trace.acceleration[:, 0]).max()) < 1e-6

"""An ego that SUMO takes off the road has not arrived."""

# ruff: noqa: E501  (XML)

from __future__ import annotations

import re
from pathlib import Path

import pytest
from own_networks import run_program

from sbt.execution.spec import ScenarioSpec
from sbt.execution.worker import run_job
from sbt.problem.outcome import Job, Outcome

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

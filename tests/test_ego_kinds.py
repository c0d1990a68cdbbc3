"""A person or a bicycle as the ego of one's own files: recorded, compared with what was asked, hit by geometry, replayed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from test_doors import check, files_of
from typer.testing import CliRunner

from sbt.cli import app
from sbt.errors import InputError, RunError
from sbt.execution.spec import ScenarioSpec
from sbt.problem.outcome import Status

ROUTES = """<routes>
<vType id="truck" length="8" width="WIDTH" sigma="0" maxSpeed="20"/>
<vType id="bike" vClass="bicycle" length="1.6" width="0.65" sigma="0" maxSpeed="7"/>
<vehicle id="truck" type="truck" depart="0" departPos="20" departSpeed="10" departLane="0"><route edges="road"/></vehicle>
EGO
</routes>"""
PERSON = '<person id="ego" depart="1" departPos="${at}"><walk edges="road" arrivalPos="190" speed="1.4"/></person>'
BIKE = """<vehicle id="ego" type="bike" depart="1" departPos="${at}" departSpeed="5" departLane="0" insertionChecks="none">
<route edges="road"/></vehicle>"""
SCENARIO = """
sumo: {net: road.net.xml, routes: kinds.rou.xml}
inputs: {at: {min: 60, max: 120}}
ego: EGO
duration: 8
metrics: [ttc_2d_min, collision, impact_speed]
requirement: {metric: ttc_2d_min, critical: [-.inf, 1.0]}
"""


def written(folder: Path, who: str, *, width: float = 2.6, ego: str = "ego") -> Path:
    files_of("own_files", folder)
    (folder / "kinds.rou.xml").write_text(ROUTES.replace("EGO", who).replace("WIDTH", str(width)))
    (folder / "kinds.yaml").write_text(SCENARIO.replace("EGO", ego))
    return folder / "kinds.yaml"


def traced(path: Path, at: float):
    scenario = ScenarioSpec(str(path)).resolve()
    return scenario.simulate(scenario.space.values({"at": at}), 0)


@pytest.mark.sumo
def test_a_person_is_recorded_from_where_it_should_be(tmp_path):
    trace = traced(written(tmp_path, PERSON, width=1.8), 70)
    ego = trace.actor("ego")
    assert (trace.actors[0], trace.ended, float(ego.x[0])) == ("ego", "duration", 70.0)
    assert (ego.length, ego.width) == pytest.approx((0.215, 0.478))
    assert np.hypot(np.diff(ego.x), np.diff(ego.y)).sum() / 8 == pytest.approx(1.4, rel=0.25)
    assert "truck" in trace.actors


@pytest.mark.sumo
def test_a_person_is_hit_by_a_wide_truck_and_the_run_replays(tmp_path):
    path = written(tmp_path, PERSON, width=3.6)
    push = "a: {profile: {knots: [0, 1]}, min: 1, max: 2}}\nactors: {truck: {acceleration: a}}"  # SUMO's driver would wait behind
    path.write_text(path.read_text().replace("max: 120}}", "max: 120}, " + push))
    trace = traced(path, 70)
    assert trace.ended == "collision"
    assert "contact with 'truck'" in trace.unconfirmed[0]
    assert trace.identical(traced(path, 70))
    code, output = check(path)
    assert code == 0, output
    campaign = {"campaign": "coverage", "scenario": str(path), "budget": 3, "initial": 3, "executor": {"kind": "serial"},
                "store": str(tmp_path / "runs")}  # fmt: skip
    (tmp_path / "campaign.yaml").write_text(json.dumps(campaign))
    for words in (["run", str(tmp_path / "campaign.yaml"), "--quiet"], ["replay", str(tmp_path / "runs"), "0"]):
        done = CliRunner().invoke(app, words)
        assert done.exit_code == 0, done.output


@pytest.mark.sumo
@pytest.mark.parametrize(
    ("old", "new", "words"),
    [('departPos="${at}"', 'departPos="${at * 100}"', r"kinds\.rou\.xml:5:\d+: 'ego' must depart with departPos"),
     ('depart="1"', 'depart="${at}"', "")],
)  # fmt: skip
def test_the_departure_of_a_person_is_the_requested_one(tmp_path, old, new, words):
    path = written(tmp_path, PERSON.replace(old, new), width=1.8)
    if not words:
        assert traced(path, 60).time[-1] == pytest.approx(8)
        return
    with pytest.raises(RunError) as failed:
        traced(path, 70)
    assert failed.value.status in (Status.INVALID, Status.FAILED)


FLOW = PERSON.replace("person", "personFlow").replace('id="ego" depart="1"', 'id="f" begin="1" number="3" period="3"')


@pytest.mark.sumo
def test_a_person_of_a_flow_departs_when_the_flow_lets_it(tmp_path):
    trace = traced(written(tmp_path, FLOW, ego="f.1", width=1.8), 70)
    assert (trace.actors[0], trace.ended, float(trace.actor("f.1").x[0])) == ("f.1", "duration", 70.0)
    assert float(trace.actor("f.0").x[0]) == pytest.approx(70 + 3 * 1.4, rel=0.1), "3 s ahead"
    (tmp_path / "late").mkdir()
    with pytest.raises(RunError, match=r"xml:5:1: 'f\.3' must depart.*number=\"3\" persons, and the last one is 'f\.2'"):
        traced(written(tmp_path / "late", FLOW, ego="f.3", width=1.8), 70)


@pytest.mark.sumo
def test_a_person_has_no_controller(tmp_path):
    with pytest.raises(InputError, match=r"ego\.kind: a person as the ego is moved by SUMO and has no kind, but got 'acc_aeb'"):
        traced(written(tmp_path, PERSON, ego="{id: ego, kind: acc_aeb}"), 70)


@pytest.mark.sumo
@pytest.mark.parametrize("driver", ["ego", "{id: ego, kind: acc_aeb, set_speed: 6}"])
def test_a_bicycle_is_a_vehicle_like_any_other(tmp_path, driver):
    trace = traced(written(tmp_path, BIKE, ego=driver), 70)
    ego = trace.actor("ego")
    assert (ego.length, ego.width, float(ego.speed[0])) == (1.6, 0.65, 5.0)
    assert float(ego.x[0]) == pytest.approx(70 - 0.8)
    assert np.nanmax(ego.speed) <= 7.0 + 1e-9

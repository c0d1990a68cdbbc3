"""Road users that SUMO teleports leave and come: nothing takes the jump for motion."""

# ruff: noqa: E501  (XML)

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from own_networks import run_program

import sbt
from sbt.execution.spec import ScenarioSpec
from sbt.execution.worker import run_job
from sbt.problem.outcome import Doubt, Job, doubts

NODES = '<nodes><node id="a" x="0" y="0"/><node id="b" x="200" y="0"/><node id="c" x="212" y="0"/><node id="d" x="600" y="0"/></nodes>'
EDGES = '<edges><edge id="ab" from="a" to="b" numLanes="1"/><edge id="bc" from="b" to="c" numLanes="1"/><edge id="cd" from="c" to="d" numLanes="1"/></edges>'
ROUTES = """<routes><vType id="{kind}" length="{length}" tau="${{tau}}"/><route id="r" edges="ab bc cd"/>
<vehicle id="ego" route="r" depart="0" departPos="190" departSpeed="0"><stop lane="bc_0" endPos="11" duration="100"/></vehicle>
<vehicle id="g" type="{kind}" route="r" depart="1" departPos="150" departSpeed="0"/></routes>
"""
YAML = """sumo: my.sumocfg
inputs: {tau: {min: 0.5, max: 1.5}}
ego: {id: ego}
duration: 25
metrics: [ttc_path_min, ttc_min, distance_min, collision, impact_speed, jerk_max]
requirement: {metric: collision, critical: [0.5, .inf]}
"""


@pytest.fixture(scope="module", params=[4.5, 16.0], ids=["a car", "a truck in parts"])
def jammed(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> sbt.Scenario:
    """A vehicle waits behind the ego, which stands on a short edge, until it is teleported past it."""
    folder = tmp_path_factory.mktemp("jam")
    (folder / "n.nod.xml").write_text(NODES)
    (folder / "e.edg.xml").write_text(EDGES)
    run_program(folder, "netconvert", "-n", "n.nod.xml", "-e", "e.edg.xml", "-o", "net.net.xml")
    (folder / "my.rou.xml").write_text(ROUTES.format(kind="t", length=request.param))
    options = '<time-to-teleport value="5"/><step-length value="0.1"/>'
    (folder / "my.sumocfg").write_text(
        f'<configuration><net-file value="net.net.xml"/><route-files value="my.rou.xml"/>{options}</configuration>'
    )
    (folder / "scenario.yaml").write_text(YAML)
    return ScenarioSpec(str(folder / "scenario.yaml")).resolve()


def test_who_is_teleported_past_the_ego_has_not_touched_it(jammed: sbt.Scenario):
    trace = jammed.simulate({"tau": 1.0}, 1)
    x = trace.actor("g").x
    jump = np.flatnonzero(np.isnan(x[1:]) & ~np.isnan(x[:-1])) + 1
    # it leaves behind the ego and comes ahead of it, an instant later
    before, after, ego = x[jump[0] - 1], x[jump[0] + 1], trace.actor("ego").x[jump[0]]
    assert before < ego < after
    outcome = run_job(jammed, Job(0, {"tau": 1.0}, 1))
    assert outcome.status == "ok"
    assert outcome.metrics["collision"] == outcome.metrics["impact_speed"] == 0.0
    assert outcome.metrics["distance_min"] > 0.5
    assert outcome.metrics["ttc_path_min"] > 0.5
    assert doubts(outcome.unconfirmed) == (Doubt.TELEPORTED,)
    assert "'g' at " in outcome.unconfirmed


def test_a_conclusion_tells_of_teleports(jammed: sbt.Scenario, tmp_path: Path):
    result = sbt.run(campaign="coverage", scenario=jammed, budget=2, store=tmp_path / "s", executor="serial", report=False)
    assert any("In 2 of 2 runs a road user near the ego was teleported" in said for said in result.sentences())


LANES = """<routes><route id="r" edges="cd"/><vehicle id="ego" route="r" depart="0" departSpeed="10" departLane="0"/>
<vehicle id="g" route="r" depart="0" departPos="60" departSpeed="2" departLane="0"><param key="tau" value="${tau}"/></vehicle></routes>
"""
LOOP = """
def simulate(sumo, values, rng):
    while True:
        sumo.simulationStep()
        if abs(sumo.simulation.getTime() - 1.0) < 1e-6:
            sumo.vehicle.changeLane("ego", 1, 5.0)
"""


def test_a_change_of_lanes_within_the_shortest_step_is_no_teleport(tmp_path: Path):
    (tmp_path / "n.nod.xml").write_text(NODES)
    (tmp_path / "e.edg.xml").write_text('<edges><edge id="cd" from="c" to="d" numLanes="2"/></edges>')
    run_program(tmp_path, "netconvert", "-n", "n.nod.xml", "-e", "e.edg.xml", "-o", "net.net.xml")
    (tmp_path / "my.rou.xml").write_text(LANES)
    (tmp_path / "my.sumocfg").write_text(
        '<configuration><net-file value="net.net.xml"/><route-files value="my.rou.xml"/><step-length value="0.01"/></configuration>'
    )
    (tmp_path / "mine.py").write_text(LOOP)
    (tmp_path / "scenario.yaml").write_text(YAML.replace("sumo: my.sumocfg", "sumo: my.sumocfg\nsimulate: mine.py:simulate").replace("25", "3"))
    trace = ScenarioSpec(str(tmp_path / "scenario.yaml")).resolve().simulate({"tau": 1.0}, 1)
    y = trace.actor("ego").y
    assert np.abs(np.diff(y)).max() > 3.0
    assert not np.isnan(y).any()
    assert not trace.unconfirmed

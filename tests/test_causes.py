"""What is wrong with a user's files or loop is named with its cause, its place and what to change; the change then helps."""

# ruff: noqa: E501  (one case per line)

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import libsumo
import pytest
from departing import car, flow, run, stopped
from own_networks import run_program

from sbt.execution.spec import ScenarioSpec
from sbt.sumo import phases
from sbt.sumo.nets import unregulated
from sbt.workflows.checking import check_scenario
from sbt.workflows.findings import net_findings

EGO = car("ego", "${p}", depart="3", speed="5")
LATER = car("later", "20", depart="50", lane="1", speed="5")
START = 'sumo.start(["sumo", "-n", "net.net.xml"])\n'
ADD = '    {m}.route.add("all", ["road", "next"])\n    {m}.vehicle.add("ego", "all", departPos=str(values["p"]))\n'


@dataclass(frozen=True)
class Cause:
    """A mistake: the message must name its place, the cause and the change; with the `mended` arguments the run is ok."""

    given: dict[str, Any]
    place: str
    cause: str
    change: str
    mended: dict[str, Any]
    status: str = "invalid"
    options: dict[str, str] = field(default_factory=dict)


def files(vehicles: str, **more: Any) -> dict[str, Any]:
    return {"vehicles": vehicles, **more}


def loop(text: str) -> dict[str, Any]:
    return {"vehicles": "", "loop": text}


STEPS = "    while True:\n        {m}.simulationStep()\n"
SCRIPT = "import traci\n\n\ndef step():\n    traci.simulationStep()\n\n\ndef simulate(sumo, values, rng):\n{begin}    traci.start(['sumo', '-n', 'net.net.xml'])\n" + ADD.format(m="traci") + "    while True:\n        step()\n"
CAUSES = {
    "routes that are not sorted": Cause(files(LATER + EGO), "cars.rou.xml:3:1: ", "it stands behind 'later' .*cars.rou.xml:2:1.*, which departs at 50 s, and SUMO drops what comes late", "sort the file by depart, or set the option route-steps: 0", files(LATER + EGO, route_steps="0")),
    "routes that are not sorted, by a flow": Cause(files(flow("20", begin="50", name="late") + EGO), "cars.rou.xml:3:1: ", "it stands behind 'late'", "sort the file by depart", files(EGO + flow("20", begin="50", name="late"))),
    "an ego that departs before the beginning": Cause(files(EGO, begin="5"), "cars.rou.xml:2:1: ", "the simulation begins later, at t = 5 s, and SUMO drops what departs before", r"depart at 5 s or later, or set the option begin \(sumo\) to 3 or less", files(EGO, begin="3")),
    "traffic that is thinned out": Cause(files(LATER.replace('"50"', '"0"') + EGO, scale="0.4"), "cars.rou.xml:3:1: ", r"the option scale: 0.4 \(sumo\) has dropped it", 'vType of its own with scale="2.5"', files('<vType id="own" scale="2.5"/>\n' + LATER.replace('"50"', '"0"') + EGO.replace('"car"', '"own"'), scale="0.4")),
    "a vehicle that its flow does not have": Cause(files(flow("20").replace(' end="100" ', ' number="3" '), ego="f.7"), "cars.rou.xml:2:1: ", "the flow has number=\"3\" vehicles, and the last one is 'f.2'", "raise its number", files(flow("20").replace(' end="100" ', ' number="9" '), ego="f.7")),
    "one that waits for passengers": Cause(files(EGO.replace('depart="3"', 'depart="triggered"'), keys="wait: 4\n"), "cars.rou.xml:2:1: ", 'its depart="triggered" waits for somebody who rides in it', "give it a depart in seconds", files(EGO)),
    "one that SUMO gives up": Cause(files(car("other", "102", inner=stopped("road_0", 102)) + EGO.replace(' insertionChecks="none"', ""), more=", delay: 4", max_depart_delay="1"), "cars.rou.xml:3:1: ", r"it found no gap within the option max-depart-delay: 1 \(sumo\), and SUMO dropped it", "raise or remove the option", files(car("other", "102", speed="20") + EGO.replace(' insertionChecks="none"', ""), more=", delay: 4")),
    "a place beyond the end of the lane": Cause(files(car("ego", "${p + 300}")), "cars.rou.xml:2:1: ", "must depart with departPos 400 m, but SUMO inserted it with 300 m", "lane road_0 is 300 m long", files(EGO)),
    "a route that is not connected": Cause(files('<route id="back" edges="next road"/>\n' + EGO.replace('"all"', '"back"')), "cars.rou.xml:2:1: ", "SUMO: .*No connection between edge 'next' and edge 'road'", "name the edges that lie between 'next' and 'road', or only the first and the last, as a <trip", files(EGO), "failed"),
    "a route in the vehicle that is not connected": Cause(files(EGO.replace('route="all"', "").replace("></vehicle>", '><route edges="next road"/></vehicle>')), "cars.rou.xml:2:1: ", "No connection between edge 'next' and edge 'road'", "name the edges that lie between", files(EGO), "failed"),
    "a trip without a way": Cause(files('<trip id="ego" depart="0" from="next" to="road"/>\n'), "cars.rou.xml:2:1: ", "has no valid route", "no way leads from its first to its last edge for its vehicle class: choose other edges", files('<trip id="ego" depart="0" from="road" to="next" departPos="20"/>\n'), "failed"),
    "an edge that is not there": Cause(files('<route id="back" edges="road nxt"/>\n' + EGO.replace('"all"', '"back"')), "cars.rou.xml:2:1: ", "edge 'nxt' .* is not known", r"name an edge of net.net.xml \(did you mean 'next'", files(EGO), "failed"),
    "a route that is not there": Cause(files(EGO.replace('"all"', '"al"')), "cars.rou.xml:2:1: ", "route 'al' .* is not known", r"define <route id=\"al\"> before it, or name one that is there \(did you mean 'all'", files(EGO), "failed"),
    "a type that is not there": Cause(files(EGO.replace('"car"', '"cra"')), "cars.rou.xml:2:1: ", "vehicle type 'cra' .* is not known", "define <vType id=\"cra\"> before it", files(EGO), "failed"),
    "a type that stands below": Cause(files(EGO.replace('"car"', '"late"') + '\n<vType id="late"/>'), "cars.rou.xml:4:1: ", "vehicle type 'late' .* is not known", "it stands there, below what uses it: move it up", files('<vType id="late"/>' + EGO.replace('"car"', '"late"')), "failed"),
    "a number that is none in a type": Cause(files('<vType id="fine" accel="2"/><vType id="odd" accel="fast"/>' + EGO), "cars.rou.xml:2:29: ", "Attribute accel. Cannot be parsed", "", files('<vType id="odd" accel="2"/>' + EGO), "failed"),
    "an id that is there twice": Cause(files(car("other", "10") + car("other", "50") + EGO), "cars.rou.xml:3:1: ", "Another vehicle with the id 'other' exists", "give one of them another id", files(car("other", "10") + EGO), "failed"),
    "a lane that is not there": Cause(files(EGO.replace('departLane="0"', 'departLane="3"')), "cars.rou.xml:2:1: ", "Invalid departLane", "its first edge must have that lane", files(EGO), "failed"),
    "a lane that is no whole number": Cause(files(EGO.replace('departLane="0"', 'departLane="0.5"')), "cars.rou.xml:2:1: ", "Invalid departLane", "name one of these, or a whole number: of an input, `kind: integer`", files(EGO), "failed"),
    "a loop that calls the module traci": Cause(loop(f"import traci\n\n\ndef simulate(sumo, values, rng):\n    {START}" + ADD.format(m="sumo") + STEPS.format(m="traci")), r"\(.*loop.py:9\)$", "calls the module traci, which has no connection", "`global traci` and `traci = sumo`", loop(SCRIPT.format(begin="    global traci\n    traci = sumo\n")), "failed"),
    "a loop that starts the module traci": Cause(loop(SCRIPT.format(begin="").replace("    while True:\n        step()\n", "    step()\n")), r"loop.py:5", "must call sumo.start.*, but it did not; it has started the module traci instead", "`global traci` and `traci = sumo`", loop(SCRIPT.format(begin="    global traci\n    traci = sumo\n")), "failed"),
    "a loop that steps the module libsumo": Cause(loop(f"import libsumo as traci\n\n\ndef simulate(sumo, values, rng):\n    {START}" + ADD.format(m="sumo") + STEPS.format(m="traci").replace("()\n", "()\n        sumo.simulationStep()\n")), r"loop.py:9", "another module .* has stepped from t = 0 s to 0.1 s, which is not recorded", "`global traci` and `traci = sumo`", loop(f"def simulate(sumo, values, rng):\n    {START}" + ADD.format(m="sumo") + STEPS.format(m="sumo")), "failed"),
}  # fmt: skip


@pytest.mark.sumo
@pytest.mark.parametrize("name", CAUSES)
def test_a_message_names_the_cause_its_place_and_what_to_change(tmp_path: Path, name: str):
    cause = CAUSES[name]
    status, reason = run(tmp_path, **cause.given)
    assert status == cause.status, reason
    for what in (cause.place, cause.cause, cause.change):
        assert re.search(what, reason), f"{what!r} must stand in: {reason}"
    assert run(tmp_path, **cause.mended)[0] == "ok", run(tmp_path, **cause.mended)


class SimulatedClock:
    """A clock that goes on by a millisecond for each second that SUMO simulates, for laws about times that hold on whatever machine."""

    def __init__(self) -> None:
        self.past = self.present = 0.0

    def __call__(self) -> float:
        now = libsumo.simulation.getTime() if libsumo.isLoaded() else 0.0
        self.past += self.present if now < self.present else 0.0
        self.present = now
        return (self.past + self.present) / 1000.0


@pytest.mark.sumo
def test_check_says_what_share_of_runs_is_invalid_and_where_the_time_goes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A third of the range is inside another car; the ego departs after 100 s of warming up, and drives for 5 s."""
    vehicles = car("other", "100", inner=stopped("road_0", 100)) + car("ego", "${p}", depart="100", speed="1")
    run(tmp_path, vehicles, p=300.0)
    monkeypatch.setattr(phases, "time", SimpleNamespace(process_time=SimulatedClock()))
    text = (tmp_path / "0" / "scenario.yaml").read_text().replace("{min: 0, max: 500}", "{min: 80, max: 116}")
    (tmp_path / "0" / "scenario.yaml").write_text(text)
    findings = {finding.rule: finding for finding in check_scenario(ScenarioSpec(str(tmp_path / "0" / ".." / "0" / "scenario.yaml")))}
    invalid, spent = (findings[f"for information: {what}"].numbers for what in ("share of invalid runs", "where the time goes"))
    assert invalid["runs"] == 20
    assert invalid["low"] <= invalid["share"] == invalid["invalid"] / 20 <= invalid["high"]
    assert 0.05 < invalid["share"] < 0.6
    assert "first invalid: " in findings["for information: share of invalid runs"].detail
    assert sum(spent[f"{phase}_share"] for phase in (*phases.PHASES, "metrics")) == pytest.approx(1.0)
    ok = 1.0 - invalid["share"]
    assert spent["warm-up_s"] == pytest.approx(0.1 * ok, rel=0.01)
    assert spent["run_s"] == pytest.approx(0.005 * ok, rel=0.05)
    assert spent["load_s"] == pytest.approx(0.1 * invalid["share"], rel=0.01), "invalid runs never reach the warm-up's end"


def test_junctions_without_right_of_way_are_named(tmp_path: Path):
    """At the hub of a spider net crossing streams drive through each other: most of what is critical there is the network's."""
    run_program(tmp_path, "netgenerate", "--spider", "--spider.arm-number", "5", "--spider.circle-number", "2", "-o", "net.net.xml")
    run_program(tmp_path, "netgenerate", "--grid", "--grid.number", "3", "-o", "grid.net.xml")
    assert [unregulated(tmp_path / f"{name}.net.xml") for name in ("net", "grid")] == [("A1",), ()]
    (tmp_path / "my.rou.xml").write_text('<routes><trip id="ego" depart="0" departSpeed="${speed}" from="A2A1" to="A1B1"/></routes>')
    (tmp_path / "my.sumocfg").write_text(
        '<configuration><input><net-file value="net.net.xml"/><route-files value="my.rou.xml"/></input></configuration>'
    )
    (tmp_path / "scenario.yaml").write_text(
        "sumo: my.sumocfg\ninputs: {speed: {min: 2, max: 9, unit: m/s}}\nego: {id: ego, may_leave: true}\nduration: 2\n"
        "metrics: [distance_min]\nrequirement: {metric: distance_min, critical: [-.inf, 0.5]}\n"
    )
    found = net_findings(ScenarioSpec(str(tmp_path / "scenario.yaml")).resolve(), [({"speed": 5.0}, 1)])
    assert [finding.detail.partition(":")[0] for finding in found] == ["'A1' is unregulated"]


def test_a_net_of_a_simulation_of_ones_own_may_be_anything():
    assert net_findings(SimpleNamespace(simulate=SimpleNamespace(net={"layers": 3})), [({}, 0)]) == []

"""A user's own SUMO files and loops: the run is the requested one, and mistakes are reported with their place."""

# ruff: noqa: E501  (one mistake per line, with its message)

from __future__ import annotations

import gzip
import json
import os
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from sbt.cli import app
from sbt.errors import InputError, RunError
from sbt.execution.spec import ScenarioSpec
from sbt.metrics.geometry import rectangle_distance, select_instants
from sbt.problem.outcome import Status
from sbt.store.database import Store
from sbt.sumo.files import options_of_command
from sbt.sumo.template import template
from sbt.workflows.running import Summary, run_study
from sbt.workflows.study import Study

TUTORIALS = Path(__file__).resolve().parent.parent / "docs" / "tutorials"
Changed = Callable[..., Path]


def files_of(page: str, folder: Path) -> None:
    text = (TUTORIALS / f"{page}.md").read_text()
    for name, content in re.findall(r"^```\w+ (\S+)\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        if not name.startswith("+"):
            (folder / name).write_text(content)


@pytest.fixture
def study(tmp_path: Path) -> Changed:
    """The tutorial's files with texts replaced: `study({"cars.rou.xml": [(old, new), ...]})`; returns scenario.yaml."""

    def write(changes: dict[str, list[tuple[str, str]]] | None = None, page: str = "own_files") -> Path:
        files_of(page, tmp_path)
        for name, pairs in (changes or {}).items():
            path = tmp_path / name
            text = path.read_text() if path.exists() else ""
            for old, new in pairs:
                assert old in text, f"{name} must hold {old!r}"
                text = text.replace(old, new, 1) if old else new
            path.write_text(text)
        return tmp_path / "scenario.yaml"

    return write


def simulated(path: Path, seed: int = 0, **values: float) -> Any:
    scenario = ScenarioSpec(str(path)).resolve()
    return scenario, scenario.simulate(scenario.space.values(values), seed)


def check(path: Path, seconds: str = "") -> tuple[int, str]:
    done = CliRunner().invoke(app, ["check", str(path)])
    return done.exit_code, " ".join(done.output.split())


def campaign_of(config: Path) -> Summary:
    return run_study(Study.from_file(config), report=False)


def rows_of(path: Path) -> list[tuple[str, str]]:
    """Status and reason of the rows of a small campaign."""
    store = path.parent / "runs"
    config = path.parent / "small.yaml"
    settings = {"campaign": "coverage", "scenario": str(path), "budget": 3, "initial": 3, "executor": {"kind": "serial"},
                "store": str(store)}  # fmt: skip
    config.write_text(json.dumps(settings))
    campaign_of(config)
    with Store.read(store) as found:
        return [(record.status, record.reason) for record in found.history().records]


CARS, ROAD, YAML = "cars.rou.xml", "road.net.xml", "scenario.yaml"
EGO = 'departPos="100" departSpeed="30" insertionChecks="none"'


@pytest.mark.sumo
def test_placeholders_become_numbers_and_the_initial_state_is_the_requested_one(study):
    path = study()
    _, trace = simulated(path, gap=20.0, v_lead=12.5)
    lead, ego = trace.actor("lead"), trace.actor("ego")
    assert trace.actors[0] == "ego"
    assert set(trace.actors) == {"ego", "lead", "beside"}
    assert lead.x[0] - ego.x[0] - 5.0 == pytest.approx(20.0, abs=1e-9)
    assert (ego.speed[0], lead.speed[0], trace.time[0]) == (30.0, 12.5, 0.0)
    assert "${" in (path.parent / CARS).read_text(), "the user's files stay as they are"


@pytest.mark.sumo
@pytest.mark.parametrize("version", ["0.13", "0.27"])
def test_networks_of_old_versions_are_read(study, version):
    path = study({ROAD: [('<net version="1.20" junctionCornerDetail="5" limitTurnSpeed="5.50">', f'<net version="{version}">')]})
    _, trace = simulated(path, gap=20.0, v_lead=10.0)
    assert set(trace.actors) == {"ego", "lead", "beside"}


@pytest.mark.sumo
@pytest.mark.parametrize("name", ["0", "007", "1e3", "0x10", "no", "ä/b", "12:30"])
def test_an_id_is_read_as_it_is_written(study, name):
    """Numbers, among others: randomTrips counts its vehicles."""
    changes = {
        CARS: [('id="ego"', f'id="{name}"')],
        YAML: [("ego: ego\n", f"ego: {name}\nothers: {{named: [{name}, lead]}}\n")],
    }
    _, trace = simulated(study(changes), gap=20.0, v_lead=10.0)
    assert trace.actors[0] == name


@pytest.mark.sumo
def test_numpy_scalars_are_numbers_in_files_and_loops(study):
    loop = "import numpy as np\ndef simulate(sumo, values, rng):\n    assert {type(v) for v in values.values()} == {float}\n"
    loop += "    while True:\n        sumo.simulation.step()\n        sumo.vehicle.setSpeed('lead', np.float32(3.5))\n"
    path = study({YAML: [("sumo: my.sumocfg", "sumo: my.sumocfg\nsimulate: mine.py:simulate")], "mine.py": [("", loop)]})
    scenario, trace = simulated(path, gap=60.0, v_lead=12.0)
    assert trace.actor("lead").speed[-1] == 3.5
    for number in (np.float64, np.float32, np.int64):
        assert trace.identical(scenario.simulate({"gap": number(60), "v_lead": number(12)}, np.int64(0)))


@pytest.mark.sumo
def test_the_recorded_states_are_consistent(study):
    _, trace = simulated(study(), gap=60.0, v_lead=10.0)
    for name in trace.actors:
        actor = select_instants(trace.actor(name), slice(int(trace.present[:, trace.actors.index(name)].sum())))  # who leaves stays away
        moved = np.hypot(np.diff(actor.x), np.diff(actor.y))
        forward = np.abs(np.diff(actor.y)) < 0.1  # SUMO changes lanes in a jump
        assert moved[forward] == pytest.approx(actor.speed[1:][forward] * 0.1, abs=1e-6)
        assert actor.acceleration[1:] == pytest.approx(np.diff(actor.speed) / 0.1)


@pytest.mark.sumo
def test_seed_is_the_runs_and_repeats(study):
    path = study()
    scenario, first = simulated(path, seed=3)
    again, other = (scenario.simulate(scenario.space.values({}), seed) for seed in (3, 4))
    assert first.identical(again)
    assert not first.identical(other), "sigma 0.5 must see the seed"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({CARS: [("${105 + gap}", "${105 + gapp}")]}, r"cars.rou.xml:5:5: .*a placeholder must be one of gap, v_lead, but got 'gapp' \(did you mean 'gap'"),
        ({CARS: [("${105 + gap}", "150")]}, r"scenario.yaml:3:3: inputs.gap: an input must stand as a placeholder \$\{gap\}"),
        ({CARS: [("${105 + gap}", "${__import__('os')}")]}, r"cars.rou.xml:5:5: .*must be a formula over inputs"),
        ({CARS: [("<routes>", '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]><routes>')]}, r"cars.rou.xml:1:\d+: .*must not declare a document type or entities"),
        ({CARS: [("<routes>", '<routes><include href="more.rou.xml"/>')]}, r"cars.rou.xml:1:9: an included file must exist, but got 'more.rou.xml'"),
        ({CARS: [("</routes>", "")]}, r"cars.rou.xml:\d+:\d+: a SUMO file must be well-formed XML"),
        ({ROAD: [('version="1.20"', 'version="1.99"')]}, r"road.net.xml: a network must be of a version up to 1.20, but is of '1.99', made by another SUMO"),
        ({ROAD: [('<net version="1.20" junctionCornerDetail="5" limitTurnSpeed="5.50">', "<OpenDRIVE>"), ("</net>", "</OpenDRIVE>")]}, r"has <OpenDRIVE>; make it with netconvert --opendrive road.net.xml -o road.net.xml"),
        ({"my.sumocfg": [("road.net.xml", "rode.net.xml")]}, r"net-file must name a file that exists"),
        ({YAML: [("ego: ego", "ego: egon")]}, r"scenario.yaml:5:6: ego: the ego must be a vehicle, trip, flow or person of the files \(lead, beside, ego\), but got 'egon' \(did you mean 'ego'"),
        ({YAML: [("- ttc_min", "- ttc_mim")]}, r"scenario.yaml:8:5: metrics.0: metrics must be one of .*did you mean 'ttc_min'"),
        ({YAML: [("- collision", "- {kind: tet, treshold: 2}")]}, r"metrics.1: settings of tet must be among .*threshold"),
        ({YAML: [("G[0,10](gap > 2", "G[0,10](gap > > 2")]}, r"scenario.yaml:11:5: metrics.3: stl, column 15"),
        ({YAML: [("ego: ego", "ego: {id: ego, kind: acc_aeb, reaction_tiem: 1}")]}, r"scenario.yaml:5:6: ego: ego settings must be ones that 'acc_aeb' takes"),
        ({YAML: [("duration: 10", "duratoin: 10")]}, r"scenario.yaml:6:1: duratoin: unknown key \(did you mean 'duration'"),
        ({YAML: [("sumo: my.sumocfg\n", "")]}, r"needs files \(sumo\) or a loop \(simulate\)"),
        ({YAML: [("metric: ttc_min", "metric: pet")]}, r"requirement.metric: a metric must be one of ttc_min, .*; pet is measured where it is among metrics"),
    ],
)  # fmt: skip
def test_mistakes_in_the_files_are_reported_before_any_run(study, changes, message):
    path = study(changes)
    code, output = check(path)
    assert (code, bool(re.search(message, output))) == (2, True), output
    done = CliRunner().invoke(app, ["run", str(path.parent / "campaign.yaml")])
    assert done.exit_code == 2
    assert not (path.parent / "results").exists()


@pytest.mark.parametrize("need", ["metric: ttc_min, critical: [0, 1]", "any: [{metric: ttc_min, critical: [0, 1]}]"])
def test_a_scenario_without_metrics_is_told_so_once(study, need):
    path = study()
    text = re.sub(r"(?ms)^metrics:.*?^(?=\w)|^requirement:.*", "", path.read_text())
    path.write_text(f"{text}\nrequirement: {{{need}}}\n")
    code, output = check(path)
    assert (code, output.count("scenario.yaml:"), "needs at least one metric" in output) == (2, 1, True), output
    assert ("metrics: [ttc_min]" in output) == need.startswith("metric")


def test_a_scenario_is_no_campaign(study):
    done = CliRunner().invoke(app, ["run", str(study())])
    assert (done.exit_code, "this is a scenario" in done.output) == (2, True)
    schema = json.loads(CliRunner().invoke(app, ["schema", "scenario"]).stdout)
    assert {"sumo", "inputs", "ego", "duration", "requirement"} <= set(schema["properties"])


@pytest.mark.sumo
def test_check_reports_warnings_of_sumo_and_units_that_it_does_not_take(study):
    person = '    <person id="p" depart="0"><walk edges="road" departPos="300" arrivalPos="400"/></person>\n</routes>'
    code, output = check(study({CARS: [("</routes>", person)], YAML: [("max: 30, unit: m/s", "max: 30, unit: km/h")]}))
    assert (code, "SUMO warns: The attribute departPos is no longer supported for walks" in output) == (0, True), output
    assert re.search(r"rou\.xml:5:5: SUMO takes departSpeed in m/s, but the input v_lead has the unit km/h: \$\{v_lead / 3\.6\}", output)


@pytest.mark.sumo
def test_check_fails_where_sumo_leaves_out_traffic_that_is_not_sorted(study):
    behind = '    <person id="late" depart="9"><walk edges="road" arrivalPos="400"/></person>\n'
    behind += '    <person id="early" depart="2"><walk edges="road" arrivalPos="400"/></person>\n</routes>'
    code, output = check(study({CARS: [("</routes>", behind)]}))
    assert code != 0
    assert "SUMO leaves out 'early': a route file must be sorted by departure" in re.sub(r"\s+", " ", output)


@pytest.mark.sumo
def test_a_run_of_which_sumo_leaves_out_traffic_is_invalid(study):
    """A file that is sorted for some values of an input, and for others not: no run is silently one without that traffic."""
    behind = '    <person id="first" depart="${gap / 10}"><walk edges="road" arrivalPos="400"/></person>\n'
    behind += '    <person id="late" depart="4"><walk edges="road" arrivalPos="400"/></person>\n</routes>'
    scenario = ScenarioSpec(str(study({CARS: [("</routes>", behind)]}))).resolve()
    assert scenario.simulate(scenario.space.values({"gap": 30.0}), 1).ended
    with pytest.raises(RunError, match="a route file must be sorted by departure, whatever the inputs are, but SUMO leaves out 'late'") as raised:
        scenario.simulate(scenario.space.values({"gap": 50.0}), 1)
    assert raised.value.status == Status.INVALID


def test_all_mistakes_are_reported_at_once(study):
    path = study({YAML: [("ego: ego", "ego: egon"), ("- ttc_min", "- ttc_mim")], CARS: [("${105 + gap}", "150")]})
    with pytest.raises(InputError) as raised:
        ScenarioSpec(str(path)).resolve()
    assert len(raised.value.errors) == 3


def test_an_input_outside_its_range_is_refused(study):
    done = CliRunner().invoke(app, ["simulate", str(study()), "gap=500"])
    assert (done.exit_code, "input gap must be in [5, 80] m, but got 500" in done.output) == (2, True)


NAN = """
from sbt.sumo.actors import Action
class Mad:
    def __init__(self, rng, set_speed): pass
    def act(self, t, own, others): return Action(acceleration=float("nan"))
"""


@pytest.mark.sumo
@pytest.mark.parametrize(
    ("changes", "status", "message"),
    [
        ({CARS: [(EGO, EGO.replace(' insertionChecks="none"', ""))], YAML: [("max: 80", "max: 40")]}, "invalid",
         r"cars.rou.xml:7:5: 'ego' must depart at t = 0 s, [\d.]+ m behind 'lead', but SUMO holds it back, as its insertion checks find that "
         r'unsafe: set insertionChecks="none" on the vehicle, or let it wait: ego: {delay: SECONDS}'),
        ({CARS: [('<vehicle id="ego" type="car" route="ahead" depart="0"', '<flow id="e" type="car" route="ahead" begin="0" period="100"')],
          YAML: [("duration: 10", "duration: 10\nwait: 5"), ("ego: ego", "ego: e.3")]}, "invalid", "'e.3' must depart within 5 s"),
        ({CARS: [('id="ego" type="car" route="ahead" depart="0"', 'id="ego" type="car" route="ahead" depart="-5"')]}, "failed",
         "SUMO: Negative departure time in the definition of vehicle 'ego'"),
        ({CARS: [(EGO, 'departPos="1950" departSpeed="30" insertionChecks="none"')]}, "failed",
         "the ego 'ego' must stay for the duration of 10 s, but it left after .* end of its route"),
        ({YAML: [("other: lead", "other: truck")]}, "failed", "no actor 'truck' in the trace, there are: ego, "),
        ({CARS: [('<route id="ahead" edges="road"/>', '<route id="ahead" edges="road lane"/>')]}, "failed", "SUMO: .*lane.* is not known"),
        ({YAML: [("ego: ego", "ego: {id: ego, kind: mad.py:Mad}")], "mad.py": [("", NAN)]}, "failed", "controller of 'ego' must give finite numbers"),
        ({CARS: [(EGO, 'departPos="100" departSpeed="${v_lead - v_lead + 80}" insertionChecks="none"')]}, "failed|invalid", "departSpeed|Departure speed|depart speed"),
    ],
    ids=["held back", "too late", "before the beginning", "leaves", "no such actor", "no such edge", "NaN", "too fast"],
)  # fmt: skip
def test_errors_of_a_run_are_reported_by_check_and_stored_as_a_row(study, changes, status, message):
    path = study(changes)
    code, output = check(path)
    assert (code, bool(re.search(message, output))) == (2, True), output
    rows = rows_of(path)
    assert all(re.fullmatch(status, found) and re.search(message, reason) for found, reason in rows), rows


@pytest.mark.sumo
def test_a_route_that_is_not_connected(study):
    two = """<edge id="lane" from="south" to="north" priority="-1">
        <lane id="lane_0" index="0" speed="50.00" length="100.00" shape="0.00,100.00 100.00,100.00"/></edge>
    <junction id="east" """
    more = """<junction id="south" type="dead_end" x="0.00" y="100.00" incLanes="" intLanes="" shape="0.00,100.00 0.00,98.00"/>
    <junction id="north" type="dead_end" x="100.00" y="100.00" incLanes="lane_0" intLanes="" shape="100.00,98.00 100.00,100.00"/></net>"""
    path = study({ROAD: [('<junction id="east" ', two), ("</net>", more)], CARS: [('edges="road"', 'edges="road lane"')]})
    code, output = check(path)
    assert (code, bool(re.search(r"SUMO: .*(no valid route|not connected|No connection)", output))) == (2, True), output
    assert {status for status, _ in rows_of(path)} == {"failed"}


@pytest.mark.sumo
def test_a_gzipped_net_relative_includes_and_placeholders_everywhere(study, tmp_path):
    """In a configuration's value, in a file that an additional file includes, in the routes and in the network itself."""
    path = study({
        CARS: [('<vType id="slow" length="5.0" width="1.8" sigma="0.5" maxSpeed="${v_lead}"/>', "")],
        "my.sumocfg": [('<step-length value="0.1"/>', '<step-length value="${step}"/>'),
                       ("</input>", '<additional-files value="parts/slow.add.xml"/></input>')],
        ROAD: [('speed="50.00"', 'speed="${limit}"')],
        YAML: [("ego: ego", "  step: {min: 0.05, max: 0.2}\n  limit: {min: 20, max: 50, unit: m/s}\nego: ego")],
    })  # fmt: skip
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "slow.add.xml").write_text('<additional><include href="../deeper.add.xml"/></additional>')
    (tmp_path / "deeper.add.xml").write_text('<additional><vType id="slow" sigma="0" maxSpeed="${v_lead}"/></additional>')
    net = tmp_path / ROAD
    (tmp_path / "road.net.xml.gz").write_bytes(gzip.compress(net.read_bytes()))
    net.unlink()
    (tmp_path / "my.sumocfg").write_text((tmp_path / "my.sumocfg").read_text().replace(ROAD, "road.net.xml.gz"))
    scenario, trace = simulated(path, gap=80.0, v_lead=20.0, step=0.2, limit=30.0)
    assert np.diff(trace.time) == pytest.approx(0.2)
    assert trace.actor("lead").speed.max() <= 20.0
    _, slow = simulated(path, gap=80.0, v_lead=20.0, step=0.1, limit=30.0)
    assert np.diff(slow.time) == pytest.approx(0.1)
    assert (
        scenario.simulate.files.launch({"gap": 1, "v_lead": 2, "step": 0.1, "limit": 3}, tmp_path).arguments.count("--net-file")
        == 1
    )


@pytest.mark.sumo
def test_a_loop_over_files_only_steps(study):
    """With files in the scenario SUMO is started already; what the loop does shows, and starting again is refused."""
    loop = "def simulate(sumo, values, rng):\n    while True:\n"
    loop += "        sumo.simulation.step()\n        sumo.vehicle.setSpeed('lead', 3.0)\n"
    path = study({YAML: [("sumo: my.sumocfg", "sumo: my.sumocfg\nsimulate: mine.py:simulate")], "mine.py": [("", loop)]})
    _, trace = simulated(path, gap=80.0, v_lead=20.0)
    assert trace.actor("lead").speed[[0, 60]] == pytest.approx([20.0, 3.0])
    (path.parent / "again.py").write_text("def simulate(sumo, values, rng):\n    sumo.start(['sumo', '-c', 'my.sumocfg'])\n")
    other = path.parent / "again.yaml"
    other.write_text(path.read_text().replace("mine.py", "again.py"))
    with pytest.raises(RunError, match=r"sumo.start must be called once.*again.py:2"):
        simulated(other)


def test_files_that_include_each_other_are_refused(tmp_path):
    for one, two in (("a", "b"), ("b", "a")):
        (tmp_path / f"{one}.xml").write_text(f'<routes><include href="{two}.xml"/></routes>')
    with pytest.raises(InputError, match="must not include itself"):
        list(template(tmp_path / "a.xml").tree())


def test_commands_of_a_loop_are_understood(tmp_path):
    files_of("own_files", tmp_path)
    found = options_of_command(
        ["-c", "my.sumocfg", "--step-length=0.5", "--start", "--fcd-output", "x.xml", "-e", "100"], tmp_path
    )
    assert found == {
        "net-file": str(tmp_path / ROAD), "route-files": str(tmp_path / CARS), "step-length": "0.5", "end": "100",
    }  # fmt: skip
    with pytest.raises(InputError, match="takes SUMO's options"):
        options_of_command(["my.sumocfg"], tmp_path)


@pytest.mark.sumo
def test_the_driver_of_the_ego_makes_the_difference(study):
    """By the files, by another of SUMO's models, by a controller: three different drives, the same start."""
    path = study()
    scenario = ScenarioSpec(str(path)).resolve()
    traces = [
        (scenario if ego is None else scenario.configured(ego)).simulate({"gap": 60.0, "v_lead": 10.0}, 1)
        for ego in (None, {"kind": "sumo", "model": "IDM", "tau": 0.8}, {"kind": "acc_aeb", "reaction_time": 0.1})
    ]
    starts = [(t.actor("ego").x[0], t.actor("ego").speed[0], float(t.length[0])) for t in traces]
    assert starts == [starts[0]] * 3
    ends = [float(t.actor("ego").x[50]) for t in traces]
    assert len(set(ends)) == 3
    with pytest.raises(InputError, match="auto, fresh or snapshot"):
        scenario.configured(isolation="reuse")


LOOP = "loop.py"


@pytest.mark.sumo
def test_a_loop_runs_the_same_under_sumo_itself(study):
    """What `replay --gui` does, with the program that has no window."""
    program = shutil.which("sumo")
    if program is None:
        pytest.skip("the sumo program is not installed (pip install 'sumo-sbt[tools]')")
    import traci

    path = study(page="traci_loop")
    scenario, trace = simulated(path, seed=5, time_gap=0.6, braking=6.0)
    other = scenario.simulate.run_with_traci({"time_gap": 0.6, "braking": 6.0}, 5, traci, (program,))
    assert trace.ended == other.ended
    assert trace.identical(other)


@pytest.mark.sumo
@pytest.mark.parametrize(
    ("changes", "status", "message"),
    [
        ([("sumo.close()", "pass"), ('brake(sumo, "lead"', 'brake(sumo, "leed"')], "failed", r"SUMO: Vehicle 'leed' is not known.* \(.*loop.py:\d+\)"),
        ([("        sumo.simulationStep()\n", "        sumo.simulationStep()\n        1 / 0\n")], "failed", r"ZeroDivisionError: .* \(.*loop.py:15\)"),
        ([('sumo.start(["sumo", "-n", "road.net.xml"', 'sumo.start(["sumo", "-n", "rode.net.xml"')], "failed", "net-file must name a file that exists"),
        ([(', "--insertion-checks", "none"', ""), ("values[\"time_gap\"] * 25.0", "1.0")], "invalid",
         r"'ego' must depart at t = 0 s, 1 m behind 'lead', but SUMO holds it back, .* option insertion-checks: none.* \(.*loop.py:14\)"),
        ([("while sumo.simulation.getMinExpectedNumber() > 0:", "for _ in range(0):")], "invalid", "must depart, but had not when the loop ended"),
        ([("    sumo.start([", "    return\n    sumo.start([")], "failed", r"a loop must call sumo.start"),
        ([("rng.lognormal(-0.3, 0.3)", "0.1"), ("max(speed - deceleration * sumo.simulation.getDeltaT(), 0.0)", "float('nan')")], "failed",
         r"must give finite numbers, but called sumo.vehicle.setSpeed\('lead', nan\)"),
    ],
    ids=["unknown vehicle", "raises", "no file", "held back", "no step", "no start", "NaN"],
)  # fmt: skip
def test_errors_of_a_loop_are_stored_as_rows(study, changes, status, message):
    path = study({LOOP: changes, YAML: [("duration: 8", "duration: 8\nwait: 20")]}, page="traci_loop")
    rows = rows_of(path)
    assert all(found == status and re.search(message, reason) for found, reason in rows), rows


@pytest.mark.sumo
def test_a_loop_cannot_prevent_the_end_of_a_run(study):
    """Neither `except Exception` nor a bare one, nor going on stepping."""
    path = study({LOOP: [("        sumo.simulationStep()\n", "        try:\n            sumo.simulationStep()\n        except:\n            continue\n")]},
                 page="traci_loop")  # fmt: skip
    text = (
        (path.parent / LOOP)
        .read_text()
        .replace("    while sumo", "    for _ in range(10_000):\n        if not sumo")
        .replace("> 0:", "> 0: break", 1)
    )
    (path.parent / LOOP).write_text(text)
    _, trace = simulated(path, time_gap=2.5, braking=2.0)
    assert (trace.ended, len(trace.time)) == ("duration", 81)


@pytest.mark.sumo
def test_a_formula_is_a_metric_here_and_the_requirement_of_a_campaign(study, tmp_path):
    path = study()
    scenario, trace = simulated(path, gap=40.0, v_lead=10.0)
    measured = scenario.measure(trace)
    lead, ego = trace.actor("lead"), trace.actor("ego")
    own = ScenarioSpec(str(path), formula="G[0,10](lead.distance > 2)").resolve()
    assert (own.requirement.metric, own.requirement.critical.high) == ("stl", 0.0)
    beside = np.abs(lead.y - ego.y) < 1.8
    if beside.all():
        nearest = (lead.x - ego.x).min() - 5.0
        assert own.measure(own.simulate({"gap": 40.0, "v_lead": 10.0}, 0))["stl"] == pytest.approx(max(nearest, 0.0) - 2.0)
    assert measured["keeps_clear"] <= measured["ttc_min"] - 1.5 + 1e-9
    config = tmp_path / "formula.yaml"
    config.write_text("campaign: coverage\nscenario: cut_in\nbudget: 12\ninitial: 12\nexecutor: {kind: serial}\n"
                      f"store: {tmp_path / 'f'}\nrequirement: {{stl: 'G(gap > 2)'}}\n")  # fmt: skip
    assert campaign_of(config).ok == 12
    config.write_text(config.read_text().replace("gap > 2", "gab > 2"))
    with pytest.raises(InputError, match=r"formula.yaml:7:20: requirement.stl: stl, column 3: a signal must be one of"):
        campaign_of(config)
    config.write_text(config.read_text().replace("cut_in", "testbed:four_branch_7"))
    with pytest.raises(InputError, match="needs the trace of a run"):
        campaign_of(config)


@pytest.mark.sumo
def test_a_stored_run_replays_bit_by_bit(study):
    path = study()
    rows_of(path)
    done = CliRunner().invoke(app, ["replay", str(path.parent / "runs"), "1", "--json"])
    assert (done.exit_code, json.loads(done.stdout)["identical"]) == (0, True), done.output


@pytest.mark.sumo
def test_a_run_ends_at_its_deadline(study):
    scenario = ScenarioSpec(str(study({YAML: [("duration: 10", "duration: 10000"), ("ego: ego", "ego: {id: ego, may_leave: true}")]}))).resolve()
    with pytest.raises(RunError, match="must take at most 1e-06 s"):
        scenario.limited(1e-6).simulate({"gap": 80.0, "v_lead": 30.0}, 0)


@pytest.mark.sumo
def test_an_ego_that_may_leave_ends_the_run(study):
    path = study({CARS: [(EGO, EGO.replace('"100"', '"1900"'))], YAML: [("ego: ego", "ego: {id: ego, may_leave: true}")]})
    _, trace = simulated(path)
    assert (trace.ended, 0 < trace.time[-1] < 9.0) == ("left", True)


@pytest.mark.sumo
def test_new_writes_a_scenario_that_runs(study, tmp_path):
    path = study({CARS: [("${105 + gap}", "150"), ('maxSpeed="${v_lead}"', 'maxSpeed="20"'), ('departSpeed="${v_lead}"', 'departSpeed="20"'),
                         ('departSpeed="${v_lead}"', 'departSpeed="20"')]})  # fmt: skip
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    done = CliRunner().invoke(app, ["new", str(tmp_path / "s"), "--from", str(path.parent / "my.sumocfg"), "--ego", "ego"])
    assert done.exit_code == 0, done.output
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir() if p.is_file()} == before, "the user's files stay as they are"
    scenario, trace = simulated(tmp_path / "s" / "scenario.yaml", depart_speed=20.0, speed_factor=0.9, tau=1.0, decel=4.0)
    assert scenario.space.names == ("depart_speed", "speed_factor", "tau", "decel")
    assert (trace.actors[0], trace.actor("ego").speed[0]) == ("ego", 20.0)
    again = CliRunner().invoke(app, ["new", str(tmp_path / "s"), "--from", str(path.parent / "my.sumocfg")])
    assert (again.exit_code, "must not have a scenario.yaml yet" in again.output) == (2, True)


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A generated grid of 1,104 streets with traffic lights, gzipped, with traffic and people."""
    program = shutil.which("netgenerate")
    if program is None:
        pytest.skip("netgenerate is not installed (pip install 'sumo-sbt[tools]')")
    folder = tmp_path_factory.mktemp("city")
    environment = {k: v for k, v in os.environ.items() if k != "SUMO_HOME"}
    command = [program, "--grid", "--grid.number", "24", "--tls.guess", "-L", "2", "-o", "city.net.xml.gz"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True, env=environment)
    (folder / "city.rou.xml").write_text("""<routes>
        <flow id="a" begin="0" end="100" vehsPerHour="${flow}" from="C1C2" to="F8F7" departSpeed="max" departLane="best"/>
        <flow id="b" begin="0" end="100" vehsPerHour="${flow}" from="C5C4" to="C2C1" departSpeed="max"/>
        <personFlow id="p" begin="0" end="30" number="10"><walk edges="C1C2 C2C3"/></personFlow>
        <trip id="ego" depart="30" from="C1C2" to="C9C10" departSpeed="max"/>
    </routes>""")
    (folder / "scenario.yaml").write_text("""
sumo: {net: city.net.xml.gz, routes: city.rou.xml, options: {lateral-resolution: 0.8}}
inputs: {flow: {min: 100, max: 1200, unit: 1/h, kind: integer}}
ego: ego
duration: 30
step_length: 0.2
metrics: [ttc_min, ttc_2d_min, collision, {stl: "G(distance > 0)", name: apart}]
requirement: {metric: ttc_2d_min, critical: [-.inf, 1.0]}
""")
    return folder / "scenario.yaml"


@pytest.mark.sumo
def test_a_city_with_traffic_lights(city):
    """Thousands of edges and signals; only who is near the ego is recorded, and exactly those."""
    scenario, trace = simulated(city, seed=2, flow=900)
    assert scenario.simulate.prepare() is None
    ego = trace.actor("ego")
    present = trace.present
    assert present[:, 0].all()
    assert not present.all(), "people and cars come and go"
    assert any(name.startswith("p.") for name in trace.actors)
    assert any(name.startswith("a.") for name in trace.actors)
    apart = {name: np.nanmax(rectangle_distance(ego, trace.actor(name))) for name in trace.actors[1:]}
    assert max(apart.values()) <= 100.0 + 2.0, "between bodies, whose widths are taken in full"
    assert ego.speed.min() < 0.5, "a red light or its queue stops the ego"
    metrics = scenario.measure(trace)
    assert all(np.isfinite(list(metrics.values())))
    assert trace.identical(scenario.simulate({"flow": 900.0}, 2))


@pytest.mark.sumo
def test_a_controller_sees_red_lights(tmp_path):
    """It comes to the stop line only once the light is green; without eyes for lights it drives on."""
    program = shutil.which("netgenerate")
    if program is None:
        pytest.skip("netgenerate is not installed (pip install 'sumo-sbt[tools]')")
    environment = {k: v for k, v in os.environ.items() if k != "SUMO_HOME"}
    command = [program, "--grid", "--grid.number", "5", "--grid.length", "200", "--tls.guess", "-L", "2", "-o", "grid.net.xml"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, env=environment)
    (tmp_path / "one.rou.xml").write_text('<routes><trip id="ego" depart="${depart}" from="A2B2" to="D2E2" departSpeed="max"/></routes>')

    def slowest(ego: str, depart: float) -> tuple[float, float]:
        path = tmp_path / f"scenario{len(list(tmp_path.iterdir()))}.yaml"  # a scenario is loaded once a process
        path.write_text(
            "sumo: {net: grid.net.xml, routes: one.rou.xml}\ninputs: {depart: {min: 0, max: 90, unit: s}}\n"
            f"ego: {{id: ego, may_leave: true{ego}}}\nduration: 40\nmetrics: [deceleration_max]\n"
            "requirement: {metric: deceleration_max, critical: [9, .inf]}\n"
        )
        _, trace = simulated(path, depart=depart)
        return float(trace.actor("ego").speed.min()), float(-trace.actor("ego").acceleration.min())

    departs = (0.0, 20.0, 40.0, 60.0)
    by_sumo = [slowest("", depart)[0] < 5.0 for depart in departs]
    assert set(by_sumo) == {True, False}, "red for some, green for others"
    for ego, expected in ((", kind: acc_aeb", by_sumo), (", kind: acc_aeb, lights: false", [False] * 4)):
        found = []
        for depart in departs:
            speed, braking = slowest(ego, depart)
            found.append(speed < 5.0)
            assert braking < 4.0
        assert found == expected

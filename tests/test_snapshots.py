"""Traffic that is warmed up once: a run from a snapshot is the run of a process of its own, or there is no snapshot."""

from __future__ import annotations

import gzip
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sbt
from sbt.config.scenario_file import from_file
from sbt.errors import InputError, RunError
from sbt.execution.spec import ScenarioSpec
from sbt.execution.tasks import elsewhere
from sbt.problem.outcome import Status
from sbt.problem.trace import Trace
from sbt.store.database import Store
from sbt.sumo import snapshot, warming
from sbt.sumo.demand import excerpts, pieces_of, seconds_of
from sbt.sumo.departures import requested_departures
from sbt.sumo.session import session
from sbt.sumo.template import template
from sbt.sumo.user_simulation import UserSimulation
from sbt.sumo.warming import _read
from sbt.workflows.pinning import pin_runs
from tests.own_networks import program, run_program
from tests.warm_networks import T0, town

CENTRE = {"accel": 2.0, "tau": 1.25}


def simulation(path: Path, isolation: str = "auto") -> UserSimulation:
    found = ScenarioSpec(str(path), isolation=isolation).resolve().simulate
    assert isinstance(found, UserSimulation)
    return found


def alone(path: str, values: dict[str, float], seed: int) -> Trace:
    """Run in a process that loads everything and warms up itself."""
    found = simulation(Path(path))
    return found.isolated(replace(found.isolation, forking=False))(values, seed)


@pytest.mark.sumo
def test_a_forked_run_is_that_of_a_process_of_its_own(tmp_path):
    path = town(tmp_path)
    found = simulation(path)
    assert (found.isolation.level, found.isolation.until, found.isolation.seeds) == ("snapshot", T0, 2)
    assert ("the warm-up", T0) in found.periods, "a coarse step has to divide it"
    forked = [found(CENTRE, seed) for seed in (4, 6, 5)]
    assert forked[0].identical(found(CENTRE, 4))  # also after others
    loaded = found.isolated(replace(found.isolation, forking=False))
    assert all(loaded(CENTRE, seed).identical(trace) for seed, trace in zip((4, 6, 5), forked, strict=True))
    assert elsewhere(300, alone, str(path), CENTRE, 4).identical(forked[0])
    assert not forked[0].identical(forked[1])  # the warm-up is the same, what is drawn later is not
    assert not found({**CENTRE, "accel": 1.0}, 4).identical(forked[0])
    assert not any(tmp_path.glob("loop.xml"))


def forked(path: str, values: dict[str, float], seed: int) -> Trace:
    """Run in the child of a process that has loaded nothing before."""
    return simulation(Path(path))(values, seed)


@pytest.mark.sumo
def test_travel_times_change_on_after_the_warm_up_and_routes_are_found_by_those_of_the_state(tmp_path):
    """SUMO stopped to adapt them where it had read a vehicle with a device before the state; a route was that of empty roads."""
    path = town(tmp_path, warm_up="warm_up: {until: 42}")
    assert elsewhere(300, forked, str(path), CENTRE, 4).identical(elsewhere(300, alone, str(path), CENTRE, 4))
    found = simulation(path)
    warmed, state = found._warmed, found._state(4)
    warmed.blank()
    with session().run(warmed.launch, 0, "fresh", lambda: warmed.begin(CENTRE, (), state)) as sumo:
        sumo.simulationStep(43.0)
        equipped = [n for n in sumo.vehicle.getIDList() if sumo.vehicle.getParameter(n, "has.rerouting.device") == "true"]
        name = max(equipped, key=sumo.vehicle.getSpeedFactor)
        ways = [f"device.rerouting.edge:{edge}" for edge in sumo.edge.getIDList() if not edge.startswith(":")]
        times = [sumo.vehicle.getParameter(name, way) for way in ways]
        sumo.simulationStep(46.0)
        assert times != [sumo.vehicle.getParameter(name, way) for way in ways]


@pytest.mark.slow
@pytest.mark.sumo
def test_children_do_not_read_on_where_others_stopped_in_large_files(tmp_path):
    """SUMO reads route files 1 MiB at a time, and forked processes share how far a file is read."""
    path = town(tmp_path)
    cars = (tmp_path / "cars.rou.xml").read_text().removesuffix("</routes>")
    later = (f'<trip id="l{k}" type="mixed" depart="{60 + k / 100:.2f}" from="A1B1" to="C3D3"/>\n' for k in range(40_000))
    (tmp_path / "cars.rou.xml").write_text(f"{cars}{''.join(later)}</routes>")
    found = simulation(path)
    forked = [found(CENTRE, seed) for seed in (4, 6, 4)]
    loaded = found.isolated(replace(found.isolation, forking=False))
    assert forked[0].identical(forked[2])
    assert [loaded(CENTRE, seed).identical(trace) for seed, trace in zip((4, 6), forked, strict=False)] == [True, True]


@pytest.mark.sumo
def test_a_run_that_dies_or_hangs_costs_itself_alone(tmp_path):
    code = "import os, signal, time\nclass Dies:\n    def __init__(self, rng, set_speed, how): self.how = how\n"
    code += "    def act(self, t, own, others):\n        os.kill(os.getpid(), 11) if self.how == 0 else time.sleep(99)\n"
    (tmp_path / "av.py").write_text(code)
    ok, limit = simulation(town(tmp_path)), 3.0
    before = ok(CENTRE, 1)
    for how, status in ((0, Status.CRASHED), (1, Status.TIMEOUT)):
        driven = ok.configured(ego={"kind": f"{tmp_path / 'av.py'}:Dies", "how": how}).limited(limit)
        with pytest.raises(RunError) as error:
            driven(CENTRE, 1)
        assert error.value.status == status
    assert ok(CENTRE, 1).identical(before)


@pytest.mark.sumo
def test_rows_replays_and_resumption_keep_the_isolation_of_the_store(tmp_path, rows):
    common = {"campaign": "coverage", "scenario": str(town(tmp_path)), "seed": 3, "initial": 2, "batch": 2}
    sbt.run(**common, budget=4, store=tmp_path / "one", executor={"kind": "serial"})
    sbt.run(**common, budget=2, store=tmp_path / "two", workers=2)
    sbt.run(**common, budget=4, store=tmp_path / "two", workers=1)  # resumed
    one, two = (rows(tmp_path / name)["runs"] for name in ("one", "two"))
    assert [run.metrics for run in one] == [run.metrics for run in two]
    assert [run.warm_up for run in one] == [run.seed % 2 for run in two]
    assert sbt.open(tmp_path / "two").trace(1) is not None  # verified against the store
    with pytest.raises(InputError, match="isolation"):
        sbt.run(**common, budget=5, store=tmp_path / "two", executor={"isolation": "fresh"})
    write_without_isolation(tmp_path / "one")
    with pytest.raises(InputError, match="must give the runs"):  # fresh, as a store that says nothing was made; and they differ
        sbt.run(**common, budget=5, store=tmp_path / "one", executor={"kind": "serial"})


def write_without_isolation(folder: Path) -> None:
    """Make a store one of a version that knew no warm-ups."""
    with Store.open(folder) as store:
        store.update_configuration({k: v for k, v in store.configuration.items() if k != "isolation"})


@pytest.mark.slow
@pytest.mark.sumo
def test_check_proves_it(tmp_path):
    findings = {finding.rule: finding for finding in sbt.check(str(town(tmp_path))).findings}
    proof = next(finding for name, finding in findings.items() if name.startswith("snapshot: "))
    assert proof.ok
    assert findings["for information: isolation"].numbers == {"until": T0, "seeds": 2}
    assert findings["for information: two seeds from one warm-up"].numbers == {"differ": 1.0}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"depart": "30"}, r"ego.rou.xml:2:\d+: 'ego' departs at 30 s, before the warm-up ends \(42 s\)"),
        ({"depart": "${tau * 30}"}, r"'ego' departs at 15 to [0-9.]+ s, as the inputs have it, before"),
        ({"depart": "triggered"}, r'departs at "triggered", which is no time'),
        ({"options": "time-to-teleport: '${tau}'"}, "the option time-to-teleport depends on an input"),
        ({"options": "threads: 2"}, "the option threads 2"),
        ({"options": "end: 40"}, "go on after the warm-up, which ends at 42 s, but the option end is 40 s"),
        ({"more": '<poi id="x" x="${tau}" y="1"/>'}, r"stops.add.xml:3:\d+: <poi> depends on an input"),
        ({"more": '<rerouter id="r" edges="A1B1"/>'}, r"stops.add.xml:3:\d+: a saved state does not hold"),
        ({"more": '<route id="r" edges="A1B1"/><flow id="f" begin="2" period="${tau}" route="r"/>'}, "'f' departs at 2 s"),
    ],
)
def test_a_snapshot_that_cannot_be_says_why_and_where(tmp_path, change, reason):
    path = town(tmp_path, warm_up="warm_up: {until: 42}", **change)
    with pytest.raises(InputError, match=reason):
        simulation(path).isolation.warm  # noqa: B018
    without = simulation(town(tmp_path / "without", warm_up="", **change)).isolation
    assert without.level == "fresh"
    assert without.why


def test_a_route_file_that_is_not_sorted_is_refused_as_sumo_leaves_out_a_part_of_it(tmp_path):
    path = town(tmp_path, warm_up="warm_up: {until: 42}")
    buses = tmp_path / "buses.rou.xml"
    text, behind = buses.read_text(), '<trip id="behind" depart="30" from="A1B1" to="C1D1"/></routes>'
    buses.write_text(text.replace("</routes>", behind))
    with pytest.raises(InputError, match=r"buses.rou.xml:\d+:\d+: .*'behind' \(30 s\) stands behind 'late' \(45 s\)"):
        simulation(path).isolation.warm  # noqa: B018
    path = town(tmp_path / "whole", warm_up="warm_up: {until: 42}", options="route-steps: 0")  # then SUMO reads files whole
    (tmp_path / "whole" / "buses.rou.xml").write_text(text.replace("</routes>", behind))
    assert simulation(path).isolation.level == "snapshot"
    if shutil.which("netgenerate"):
        assert simulation(path)(CENTRE, 4).identical(alone(str(path), CENTRE, 4))


def test_what_names_something_that_varies_varies(tmp_path):
    more = '<vTypeDistribution id="both" vTypes="av car"/><route id="r" edges="A1B1"/>'
    more += '<vehicle id="x" type="both" route="r" depart="9"/>'
    with pytest.raises(InputError, match=r"'x' departs at 9 s, .*: it depends on an input by 'both' \(.*stops.add.xml:3"):
        simulation(town(tmp_path, warm_up="warm_up: {until: 42}", more=more)).isolation.warm  # noqa: B018


@pytest.mark.parametrize(
    ("default", "traffic"),
    [
        ("DEFAULT_VEHTYPE", '<trip id="x" from="A1B1" to="C1D1" depart="9"/>'),
        ("DEFAULT_PEDTYPE", '<person id="x" depart="9"><walk edges="A1B1"/></person>'),
    ],
)
def test_traffic_without_a_type_has_the_default_one_which_may_vary(tmp_path, default, traffic):
    more = f'<vType id="{default}" maxSpeed="${{tau * 5}}"/>{traffic}'
    with pytest.raises(InputError, match=r"departs at [0-9]+ s, before the warm-up ends"):
        simulation(town(tmp_path, warm_up="warm_up: {until: 42}", more=more)).isolation.warm  # noqa: B018


def test_a_libsumo_that_was_not_tested_loads_every_run(tmp_path, monkeypatch):
    monkeypatch.setattr(snapshot, "version", lambda _: "9.9.9")
    with pytest.raises(InputError, match=r"tested with libsumo 1.28.0, but this is 9.9.9"):
        simulation(town(tmp_path)).isolation.warm  # noqa: B018


def test_short_warm_ups_that_nobody_asked_for_are_none(tmp_path):
    assert "are no warm-up" in simulation(town(tmp_path / "short", warm_up="")).isolation.why
    longer = town(tmp_path / "long", depart="130", warm_up="")
    assert simulation(longer).isolation.until == 128.0
    assert simulation(longer, "fresh").isolation.level == "fresh"


@pytest.mark.sumo
def test_a_departure_before_the_end_of_the_warm_up_is_no_row(tmp_path):
    path = town(tmp_path, depart="${t}", warm_up="warm_up: {until: 42}", inputs=", t: {min: 43, max: 46}")
    found = simulation(path)
    assert found.isolation.until == T0
    with pytest.raises(RunError, match=r"'ego' must depart when the warm-up is over, at t = 42 s or later, but departs at 40 s"):
        found({**CENTRE, "t": 40.0}, 1)


INSERTING = """sumo: {net: town.net.xml, routes: [cars.rou.xml, buses.rou.xml], additional: [stops.add.xml]}
inputs: {v: {min: 5, max: 12}, gap: {min: 15, max: 45}}
warm_up: WARM
insert:
  ego: {edge: A2B2, lane: 1, position: "${gap}", speed: "${v}", to: C3D3, type: car}
  other: {edge: A1B1, lane: 1, position: 25, speed: 5, route: [A1B1, B1C1]MORE}
ego: ego
duration: 1
metrics: [distance_min]
requirement: {metric: distance_min, critical: [-.inf, 1.0]}
"""


def inserting(folder: Path, *, warm: str = "{until: 42, seeds: 1}", more: str = "") -> Path:
    town(folder)
    (folder / "scenario.yaml").write_text(INSERTING.replace("WARM", warm).replace("MORE", more))
    return folder / "scenario.yaml"


@pytest.mark.sumo
def test_vehicles_are_inserted_beside_warmed_traffic(tmp_path):
    found = simulation(inserting(tmp_path))
    assert found.isolation.until == T0
    trace = found({"v": 8.0, "gap": 40.0}, 5)
    assert trace.actor("ego").speed[0] == pytest.approx(8.0)
    assert found.files is not None
    assert requested_departures(found.files, {"v": 8.0, "gap": 40.0}, "ego").keys() == {"ego", "other"}
    fast = inserting(tmp_path / "fast")
    fast.write_text(fast.read_text().replace("speed: 5,", "speed: 99,"))
    with pytest.raises(RunError, match=r"scenario\.yaml:6:10: insert\.other: .*Departure speed for vehicle 'other' is too high"):
        simulation(fast)({"v": 8.0, "gap": 40.0}, 5)
    taken = inserting(tmp_path / "taken")
    beside = "edge: A1B1, lane: 1, position: 25, speed: 5, route: [A1B1, B1C1]"
    taken.write_text(taken.read_text().replace(beside, "edge: A2B2, lane: 1, position: 39, speed: 5"))
    with pytest.raises(RunError, match=r"insert\.ego: 'ego' must start clear .* 'other' .*: change its position or at"):
        simulation(taken)({"v": 8.0, "gap": 40.0}, 5)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"warm": "{until: auto}"}, "insert.ego: a vehicle must have a time"),
        ({"warm": "{until: 42.05}"}, r"warm_up.until must be whole steps of 0\.\d+ s after 0 s, but is 42.05 s"),
        ({"more": ", to: C3D3"}, "insert.other: a vehicle must have to or route, but got both"),
        (
            {"more": ", at: '${v}'"},
            r"scenario\.yaml:6:10: insert\.other: 'other' departs at 5 to [0-9.]+ s, as the inputs have it, before",
        ),
    ],
)
def test_an_insertion_that_cannot_be_is_said(tmp_path, change, reason):
    with pytest.raises(InputError, match=reason):
        simulation(inserting(tmp_path, **change)).isolation.warm  # noqa: B018


WRONG_NAMES = {  # what is written, what is written instead, where and what is said
    "edge": ("edge: A2B2", "edge: A2B9", r"5:\d+: insert.ego.edge: an edge must be one of the network .*did you mean 'A2B2'"),
    "to": ("to: C3D3", "to: C3D9", r"5:\d+: insert.ego.to: an edge must be one of the network .*did you mean 'C3D3'"),
    "route": ("[A1B1, B1C1]", "[A1B1, C3D3]", r"6:\d+: insert.other.route.1: .*no lane of 'A1B1' leads to 'C3D3'"),
    "type": ("type: car", "type: cars", r"5:\d+: insert.ego.type: a vehicle type must be .*did you mean 'car'"),
    "lane": ("lane: 1, position: 25", "lane: 7, position: 25", r"insert.other.lane: a lane of 'A1B1' must be 0 to 2, but got 7"),
    "position": ("position: 25", "position: 2500", r"6:\d+: insert.other.position: a position .* must be at most 79.2 m"),
    "id": ("  other:", "  t56:", r"6:3: insert.t56: an inserted vehicle must have an id of its own, but 't56' is in cars.rou"),
    "time": ("until: 42", "until: auto", r"5:8: insert.ego: a vehicle must have a time"),  # and the ego is there all the same
    "until": ("until: 42", "until: soon", r"3:18: warm_up.until: must be a number or 'auto', but got 'soon'"),
    "at": ("to: C3D3", "to: C3D3, at: 44.05", r"5:\d+: insert.ego.at: a start must be whole steps of 0.1 s after 0 s, .* 44.05"),
    "input": ("gap: {min", "gab: {min", r"insert.ego: \${gap}: a placeholder must be one of v, gab, but got 'gap'"),
}


@pytest.mark.parametrize("wrong", WRONG_NAMES)
def test_a_wrong_name_of_an_insertion_is_told_at_its_key_and_alone(tmp_path, wrong):
    path, (old, new, said) = inserting(tmp_path), WRONG_NAMES[wrong]
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError, match=said) as caught:
        from_file(str(path), tmp_path)
    assert len(str(caught.value).splitlines()) == (2 if wrong == "time" else 1)  # both vehicles lack the time


@pytest.mark.parametrize(("step", "begin", "at"), [(0.2, 0, 43.5), (0.2, 0.2, 43.5), (0.05, 0, 43.51), (1.0, 0, 43.5)])
def test_an_insertion_starts_at_a_step(tmp_path, step, begin, at):
    """SUMO inserted it in the next step, at the place that was meant for half a step earlier."""
    path = inserting(tmp_path, warm="{until: auto}", more=f", at: {at}")
    options = f"options: {{step-length: {step}, begin: {begin}}}"
    text = path.read_text().replace("[stops.add.xml]}", f"[stops.add.xml], {options}}}")
    path.write_text(text.replace("to: C3D3", f"at: {44 - begin}, to: C3D3"))
    with pytest.raises(InputError, match=rf"6:\d+: insert.other.at: a start must be whole steps of {step:g} s after") as caught:
        from_file(str(path), tmp_path)
    assert len(str(caught.value).splitlines()) == 1
    path.write_text(path.read_text().replace(f"at: {at}", f"at: {begin + round((at - begin) / step) * step:.10g}"))
    assert from_file(str(path), tmp_path).simulate is not None


LOOP = """
def simulate(sumo, values, rng):
    assert sumo.simulation.getTime() == 42.0
    sumo.vehicle.add("ego", "way", "car", departSpeed="5", departLane="1")
    while True:
        sumo.simulationStep()
        if "ego" in sumo.vehicle.getIDList():
            sumo.vehicle.setSpeed("ego", values["v"] * rng.uniform(0.9, 1.1))
"""


def looping(folder: Path, *, warm: str = "warm_up: {until: 42, seeds: 1}") -> Path:
    """Write a scenario whose loop adds the ego to warmed traffic and drives it."""
    town(folder)
    (folder / "loop.py").write_text(LOOP)
    (folder / "way.rou.xml").write_text('<routes><route id="way" edges="A0B0 B0C0"/></routes>')
    sumo = "sumo: {net: town.net.xml, routes: [cars.rou.xml, buses.rou.xml, way.rou.xml], additional: [stops.add.xml]}"
    (folder / "scenario.yaml").write_text(f"""{sumo}
simulate: loop.py:simulate
inputs: {{v: {{min: 5, max: 12}}}}
{warm}
ego: ego
duration: 1
metrics: [distance_min]
requirement: {{metric: distance_min, critical: [-.inf, 1.0]}}
""")
    return folder / "scenario.yaml"


@pytest.mark.sumo
def test_who_acts_rarely_drives_on(tmp_path):
    """SUMO saves no plans: until its next action a vehicle stopped dead at the end of its lane (139 m/s^2)."""
    found = simulation(town(tmp_path, warm_up="warm_up: {until: 42, seeds: 8}", options="default.action-step-length: 1"))
    warmed, hardest = found._warmed, 0.0
    for number in range(8):
        state = found._state(number)
        warmed.blank()
        with session().run(warmed.launch, 0, "fresh", lambda state=state: warmed.begin(CENTRE, (), state)) as sumo:
            vehicle, speeds = sumo.vehicle, {}
            for _ in range(12):
                before, speeds = speeds, {name: sumo.vehicle.getSpeed(name) for name in vehicle.getIDList()}
                hardest = max([hardest, *(10.0 * (before[name] - speed) for name, speed in speeds.items() if name in before)])
                sumo.simulationStep()
    assert hardest < 10.0


@pytest.mark.parametrize("kind", ["NEMA", "delay_based"])
@pytest.mark.sumo
def test_lights_of_which_states_do_not_hold_the_past_are_not_warmed_up(tmp_path, kind):
    path = town(tmp_path, warm_up="")
    net = tmp_path / "town.net.xml"
    net.write_text(net.read_text().replace('type="actuated"', f'type="{kind}"'))
    assert "a saved state does not hold wh" in simulation(path, "auto").isolation.why
    assert kind in simulation(path, "auto").isolation.why


@pytest.mark.sumo
def test_flows_go_on_at_the_rate_of_their_file(tmp_path):
    """SUMO saves some numbers with more than 17 decimals: those beyond were appended to a shorter text (.1555 for .1)."""
    path = town(tmp_path, warm_up="warm_up: {seeds: 1}")
    rates = {"f1": 'period="exp(0.1)"', "f2": 'probability="0.2"', "f3": 'probability="0.3"', "f4": 'period="exp(0.037)"'}
    flow = '<flow id="{}" begin="0" end="600" {} from="A1B1" to="C3D3"/>'
    flows = "".join(flow.format(*each) for each in rates.items())
    cars = (tmp_path / "cars.rou.xml").read_text()
    (tmp_path / "cars.rou.xml").write_text(cars.replace("<trip ", f"{flows}<trip ", 1))
    found = simulation(path)
    found.isolated(replace(found.isolation, states=str(tmp_path / "states"), forking=False))(CENTRE, 4)
    (state,) = (tmp_path / "states").glob("*.gz")
    root = ET.fromstring(gzip.decompress(state.read_bytes()))
    saved = {flow.get("id"): flow.attrib for flow in root.iter("flowState")}
    for name, rate in rates.items():
        key, value = rate.replace('"', "").split("=")
        assert saved[name][key] == value, saved[name]


def flipped(data: bytes) -> bytes:
    """Return the bytes with a bit of one in the middle changed."""
    return data[: len(data) // 2] + bytes([data[len(data) // 2] ^ 8]) + data[len(data) // 2 + 1 :]


def cut(data: bytes) -> bytes:
    """Return a state without its end, as SUMO leaves it on a full disk: every run of that warm-up failed from then on."""
    return gzip.compress(gzip.decompress(data)[:-200])


def test_the_warm_up_ends_before_the_earliest_departure_wherever_in_the_space_that_is(tmp_path):
    """Six inputs of which the first counts most; a formula that is least between all levels of a grid; a choice."""
    many = "".join(f", {name}: {{min: 0, max: 1}}" for name in "fabcde")
    where = {
        "60+a+b+c+d+e-12*f": many, "46+20*abs(a-0.37)+9*(b-0.81)**2": ", a: {min: 0, max: 1}, b: {min: 0, max: 1}",
        "70-2*(a+b+c+d+e+f+g+h+i+j+k+l)": "".join(f", {name}: {{min: 0, max: 1}}" for name in "abcdefghijkl"),
        "46+sqrt(abs(a-0.4)-0.05)": ", a: {min: 0, max: 1}",
        "46+9*(kind=='car')": ", kind: {choices: [car, truck]}", "46+max(0, a-b)": ", a: {min: 0, max: 9}, b: {min: 3, max: 4}",
    }  # fmt: skip
    least = {"60+a+b+c+d+e-12*f": 48.0}
    for k, (formula, inputs) in enumerate(where.items()):
        found = simulation(town(tmp_path / str(k), depart=f"${{{formula}}}", inputs=inputs)).isolation
        assert found.until == pytest.approx(least.get(formula, 46.0) - 2.0, abs=0.11), formula


def test_nothing_that_departs_before_is_no_warm_up(tmp_path):
    """As many empty warm-ups were a sample of traffic, and widened intervals."""
    path = town(tmp_path, warm_up="warm_up: {seeds: 2}")
    (tmp_path / "cars.rou.xml").write_text('<routes><trip id="t" depart="43" from="A1B1" to="C1D1"/></routes>')
    path.write_text(path.read_text().replace(", buses.rou.xml", ""))
    with pytest.raises(InputError, match="nothing departs before t = 42 s: there is no traffic to warm up"):
        simulation(path).isolation.warm  # noqa: B018


@pytest.mark.sumo
def test_scenarios_of_the_same_files_and_other_egos_keep_their_traffic(tmp_path):
    """Runs of the first one lacked what departs later once the second one had run in the same process."""
    path = town(tmp_path, warm_up="warm_up: {seeds: 1}")
    other = path.with_name("other.yaml")
    other.write_text(path.read_text().replace("ego: {id: ego", "ego: {id: second"))
    ego = tmp_path / "ego.rou.xml"
    second = '<trip id="second" type="car" depart="44" from="A3B3" to="C2D2"/></routes>'
    ego.write_text(ego.read_text().replace("</routes>", second))
    first, its = simulation(path), simulation(other)
    before = first(CENTRE, 4)
    its(CENTRE, 4)
    assert "second" in before.actors
    assert first(CENTRE, 4).identical(before)


@pytest.mark.parametrize(("damaged", "writable"), [(flipped, True), (cut, True), (cut, False)])
@pytest.mark.sumo
def test_a_damaged_state_is_made_again(tmp_path, damaged, writable, monkeypatch):
    found = simulation(town(tmp_path, warm_up="warm_up: {seeds: 1}"))
    kept = found.isolated(replace(found.isolation, states=str(tmp_path / "states"), forking=False))
    whole = kept(CENTRE, 4)
    (state,) = (tmp_path / "states").glob("*.gz")
    harmed = damaged(state.read_bytes())
    state.write_bytes(harmed)
    _read.cache_clear()
    monkeypatch.setattr(warming.os, "access", lambda *_: writable)
    assert kept(CENTRE, 4).identical(whole)
    monkeypatch.undo()
    assert (state.read_bytes() != harmed) == writable  # a store that is only read stays as it is


FLOW = '<flow id="f" begin="0" end="99" period="6" from="A1B1" to="C1D1"'
LOST = {
    "via": f'{FLOW} via="B2C2"/>',
    "via of": '<trip id="f" depart="0" from="A1B1" to="C1D1" via="B2C2"/>',
    "parameters": f'{FLOW}><param key="has.rerouting.device" value="true"/></flow>',
    "speed or duration of walks": f'{FLOW.replace("flow", "personFlow")}><walk from="A1B1" to="B1C1" speed="2.2"/></personFlow>',
}


def with_more(folder: Path, traffic: str) -> Path:
    """Return the scenario of the town with a further element before its trips."""
    path = town(folder, warm_up="warm_up: {seeds: 1}")
    cars = folder / "cars.rou.xml"
    cars.write_text(cars.read_text().replace("<trip ", f"{traffic}<trip ", 1))
    return path


@pytest.mark.parametrize("lost", LOST)
@pytest.mark.sumo
def test_traffic_of_which_states_lose_a_part_is_not_warmed_up(tmp_path, lost):
    """None of the vehicles of a flow that departed after t0 drove over its via, and none had its devices."""
    said = rf"cars.rou.xml:\d+:\d+: a saved state does not hold the {lost}.*'f', which begins before t0"
    with pytest.raises(InputError, match=said):
        simulation(with_more(tmp_path, LOST[lost])).isolation.warm  # noqa: B018


@pytest.mark.sumo
def test_what_departs_later_has_its_via(tmp_path):
    later = LOST["via"].replace('begin="0"', 'begin="43"')
    path = town(tmp_path, warm_up="warm_up: {seeds: 1}")
    buses = tmp_path / "buses.rou.xml"
    buses.write_text(buses.read_text().replace('<flow id="late"', f'{later}<flow id="late"'))
    assert simulation(path).isolation.level == "snapshot"


@pytest.mark.sumo
def test_manoeuvres_that_states_do_not_hold_are_not_warmed_up(tmp_path):
    """Half-done changes of lanes jumped sideways at t0; SUMO crashed where somebody overtook on the opposite lane."""
    slow = simulation(town(tmp_path / "slow", warm_up="", options="lanechange.duration: 3")).isolation
    assert "does not hold lane changes that take time (lanechange.duration 3)" in slow.why
    at_once = simulation(town(tmp_path / "at_once", warm_up="warm_up: {seeds: 1}", options="lanechange.duration: 0.0")).isolation
    assert at_once.level == "snapshot"
    path = town(tmp_path / "opposite", warm_up="")
    net = tmp_path / "opposite" / "town.net.xml"
    net.write_text(net.read_text().replace("</net>", "<!-- <neigh lane='B1A1_1'/> --></net>"))
    assert "overtakes on an opposite lane" in simulation(path).isolation.why


NINE = 'depart="9" from="A1B1" to="C1D1"'
UNSAVED = {  # traffic of the warm-up, or options; what is said
    "glosa of a type": (
        f'<vType id="g"><param key="has.glosa.device" value="true"/></vType><trip id="x" type="g" {NINE}/>',
        r"stops.add.xml:3:\d+: .* \(glosa\)",
    ),
    "glosa of a vehicle": (
        f'<trip id="x" {NINE}><param key="device.glosa.probability" value=".5"/></trip>',
        r"stops.add.xml:3:\d+: .* \(glosa\)",
    ),
    "glosa of all": ("device.glosa.probability: 0.3", r"device for green lights .* option device\.glosa\.probability"),
    "glosa of one": ("device.glosa.explicit: t1", r"device for green lights .* option device\.glosa\.explicit"),
    "blue light in a distribution": (
        '<vTypeDistribution id="d"><vType id="a"><param key="has.bluelight.device" value="true"/></vType></vTypeDistribution>'
        '<flow id="x" type="d" begin="9" number="2" period="9" from="A1B1" to="C1D1"/>',
        r"stops.add.xml:3:\d+: .* who makes way for a blue light",
    ),
    "errors of drivers": ("device.driverstate.probability: 1", "errors of drivers"),
    "bluetooth": ("device.btreceiver.probability: 0.1", "cannot load a state of vehicles that have a device for Bluetooth"),
    "red": (f'<vType id="c" jmDriveAfterRedTime="2"/><trip id="x" type="c" {NINE}/>', "would at once"),
    "start": (f'<vType id="c" startupDelay="1.5"/><trip id="x" type="c" {NINE}/>', "would start at once"),
}


@pytest.mark.parametrize("what", UNSAVED)
def test_memories_that_states_do_not_hold_are_not_warmed_up(tmp_path, what):
    """SUMO: whom GLOSA had slowed down crept for ever; rescue lanes stayed; four cars of a queue ran the red at t0."""
    given, said = UNSAVED[what]
    change = {"more": given} if given.startswith("<") else {"options": given}
    with pytest.raises(InputError, match=said):
        simulation(town(tmp_path, warm_up="warm_up: {until: 42}", **change)).isolation.warm  # noqa: B018
    found = simulation(town(tmp_path / "auto", depart="130", warm_up="", **change)).isolation
    assert (found.level, bool(re.search(said, found.why))) == ("fresh", True)


def test_devices_that_nobody_has_are_no_reason_to_load(tmp_path):
    """Options that only say how such a device works, as templates of SUMO's options have them, and devices that are off."""
    options = "device.glosa.range: 50, device.driverstate.errorTimeScaleCoefficient: 50, device.toc.probability: '-1'"
    off = "".join(
        f'<param key="{key}" value="{value}"/>'
        for key, value in (("has.glosa.device", "false"), ("device.bluelight.probability", "0.0"), ("has.btsender.device", "0"))
    )
    more = f'<vType id="g">{off}</vType><trip id="x" type="g" {NINE}/>'
    assert simulation(town(tmp_path, depart="130", warm_up="", options=options, more=more)).isolation.level == "snapshot"


def test_trains_and_level_crossings_are_not_warmed_up_together(tmp_path):
    """SUMO: a closed crossing was yellow for 5 s more at t0, with the train on it."""
    train = f'<vType id="r" vClass="rail_urban"/><trip id="x" type="r" {NINE}/>'
    assert simulation(town(tmp_path / "none", warm_up="", depart="130", more=train)).isolation.level == "snapshot"
    path, net = town(tmp_path, warm_up="", depart="130", more=train), tmp_path / "town.net.xml"
    net.write_text(net.read_text().replace("</net>", '<!-- <junction type="rail_crossing"/> --></net>'))
    assert "level crossings" in simulation(path).isolation.why
    more = f'<trip id="x" type="DEFAULT_RAILTYPE" {NINE}/>'
    path, net = town(tmp_path / "default", warm_up="", depart="130", more=more), tmp_path / "default" / "town.net.xml"
    net.write_text(net.read_text().replace("</net>", '<!-- <junction type="rail_crossing"/> --></net>'))
    assert "level crossings" in simulation(path).isolation.why


@pytest.mark.sumo
def test_files_in_the_encoding_that_they_declare_give_the_runs_of_utf8(tmp_path):
    """Their elements stood as they were in files of UTF-8: SUMO failed in every run with warmed traffic."""
    traces = []
    for encoding in ("UTF-8", "ISO-8859-1", "windows-1252"):
        path = town(tmp_path / encoding, warm_up="warm_up: {seeds: 1}")
        for name in ("buses.rou.xml", "stops.add.xml"):
            text = (path.parent / name).read_text().replace('"late"', '"später"').replace('"bs0"', '"ß 0"')
            head = f'<?xml version="1.0" encoding="{encoding}"?>\n'
            (path.parent / name).write_bytes((head + text).encode(encoding))
        traces.append(simulation(path)(CENTRE, 4))
    assert any(name.startswith("später") for name in traces[0].actors)
    assert all(trace.identical(traces[0]) for trace in traces)


@pytest.mark.parametrize(("encoding", "why"), [("x-none", "unknown encoding"), ("ascii", "ordinal not in range"), ("UTF-16", "")])
def test_a_file_in_another_encoding_than_it_declares_is_told(tmp_path, encoding, why):
    path = tmp_path / "a.rou.xml"
    path.write_text(f'<?xml version="1.0" encoding="{encoding}"?><routes><route id="ü" edges="a"/></routes>', encoding="utf-8")
    with pytest.raises(InputError, match=rf"a.rou.xml:1:1: .* encoding that it declares, {encoding}, but: .*{why}"):
        template(path)


def test_memories_of_who_departs_later_are_no_obstacle(tmp_path):
    """The ego alone is an ambulance; types that nobody has, and values that mean nothing, are none either."""
    unused = '<vType id="u" startupDelay="1"/><vType id="v" startupDelay="0" jmDriveAfterRedTime="-1"/>'
    path = town(tmp_path, more=f'{unused}<trip id="x" type="v" depart="9" from="A1B1" to="C1D1"/>')
    ego = tmp_path / "ego.rou.xml"
    blue = '<param key="has.bluelight.device" value="true"/>'
    ego.write_text(ego.read_text().replace('accel="${accel}"/>', f'accel="${{accel}}">{blue}</vType>'))
    assert simulation(path).isolation.level == "snapshot"
    if shutil.which("netgenerate"):
        assert simulation(path)(CENTRE, 4).identical(alone(str(path), CENTRE, 4))


@pytest.mark.sumo
def test_a_loop_begins_where_warm_up_says(tmp_path):
    found = simulation(looping(tmp_path))
    assert (found.isolation.level, found.isolation.until) == ("snapshot", T0)
    forked = found({"v": 8.0}, 5)
    assert forked.identical(found.isolated(replace(found.isolation, forking=False))({"v": 8.0}, 5))
    assert not forked.identical(found({"v": 8.0}, 6))
    assert "unless warm_up.until says when" in simulation(looping(tmp_path / "without", warm="")).isolation.why


@pytest.mark.slow
@pytest.mark.sumo
def test_a_run_that_leaks_costs_itself(tmp_path):
    path = looping(tmp_path / "town")
    loop = tmp_path / "town" / "loop.py"
    leak = "    held = []\n    while values['v'] > 10:\n        held.append(b'x' * 200_000_000)\n        sumo.simulationStep()\n"
    loop.write_text(loop.read_text().replace("    while True", f"{leak}    while True"))
    executor = {"kind": "local", "workers": 1, "memory": "1.5 GiB"}
    rows = sbt.run(campaign="coverage", scenario=str(path), budget=8, seed=1, store=tmp_path / "store", executor=executor).frame
    leaking = rows["x.v"] > 10
    assert 0 < leaking.sum() < 8
    assert (rows["status"][leaking] == "crashed").all()
    assert (rows["status"][~leaking] == "ok").all()


@pytest.mark.sumo
@pytest.mark.parametrize("options", ["", "begin: 0"])
def test_plain_sumo_drives_an_export_as_the_run(tmp_path, options):
    found = simulation(town(tmp_path / "town", warm_up="warm_up: {seeds: 1}", options=options))
    trace = found(CENTRE, 4).actor("ego")
    found.write_files(CENTRE, 4, tmp_path / "export")
    end = str(T0 + 10)
    assert f'<begin value="{T0:.3f}"' in (tmp_path / "export" / "run.sumocfg").read_text()  # SUMO warns where it is missing
    run_program(tmp_path / "export", "sumo", "-c", "run.sumocfg", "--fcd-output", "fcd.xml", "--precision", "9", "--end", end)
    seen = [v for v in ET.parse(tmp_path / "export" / "fcd.xml").getroot().iter("vehicle") if v.get("id") == "ego"]
    speeds = [float(v.get("speed", "nan")) for v in seen[: len(trace.speed)]]
    assert speeds == pytest.approx(list(trace.speed), abs=1e-9)


@pytest.mark.sumo
def test_the_script_of_an_export_drives_all_traffic_as_the_run(tmp_path):
    path = town(tmp_path / "town", warm_up="warm_up: {seeds: 1}")
    path.write_text(path.read_text().replace("duration: 3", "duration: 15"))
    found = simulation(path)
    trace = found(CENTRE, 4)
    found.write_files(CENTRE, 4, tmp_path / "export")
    words = [sys.executable, "run.py", program("sumo"), "--fcd-output", "fcd.xml", "--precision", "9"]
    subprocess.run(words, cwd=tmp_path / "export", check=True, capture_output=True)
    seen: dict[str, dict[float, float]] = {}
    for step in ET.parse(tmp_path / "export" / "fcd.xml").getroot().iter("timestep"):
        for one in step:
            seen.setdefault(one.get("id", ""), {})[float(step.get("time", "nan"))] = float(one.get("speed", "nan"))
    begin = min(seen["ego"])
    late = 0
    for name in trace.actors:
        actor = trace.actor(name)
        here = np.flatnonzero(np.isfinite(actor.speed))
        late += begin + trace.time[here[0]] == min(seen[name])
        for k in here:
            assert seen[name][round(begin + trace.time[k], 3)] == pytest.approx(actor.speed[k], abs=1e-6), name
    assert late > 1, "the ego, and others that departed after the warm-up"


def guiding(folder: Path, departs: float) -> Path:
    """Write a scenario that guides another vehicle, which departs at some time (s)."""
    inputs = ", a: {profile: {knots: [0, 2]}, min: -2, max: 2}"
    path = town(folder, warm_up="warm_up: {until: 42, seeds: 1}\nactors: {lead: {acceleration: a}}", inputs=inputs)
    routes, lead = folder / "ego.rou.xml", f'<trip id="lead" type="car" depart="{departs}" from="A0B0" to="C0D0"/></routes>'
    routes.write_text(routes.read_text().replace("</routes>", lead))
    return path


@pytest.mark.sumo
def test_an_ego_departs_where_only_a_waiting_person_is_left_of_the_warm_up(tmp_path):
    path = town(tmp_path, warm_up="warm_up: {until: 42, seeds: 1}")
    waiting = '<person id="p" depart="20"><ride from="A1B1" to="C1D1" lines="taken"/></person>'
    taken = '<vehicle id="taken" depart="${43 + tau}"><route edges="A1B1 B1C1 C1D1"/></vehicle>'
    for name, text in {"cars": '<vType id="car"/>', "buses": waiting + taken}.items():
        (tmp_path / f"{name}.rou.xml").write_text(f"<routes>{text}</routes>")
    routes = tmp_path / "ego.rou.xml"
    routes.write_text(routes.read_text().replace('depart="44"', 'depart="47"'))
    assert simulation(path)(CENTRE, 1).ended == "duration"


@pytest.mark.sumo
def test_a_guided_vehicle_departs_after_the_warm_up(tmp_path):
    found, values = simulation(guiding(tmp_path / "after", 43)), {**CENTRE, "a_0": 1.0, "a_1": 2.0}
    forked = found(values, 3)
    assert forked.identical(found.isolated(replace(found.isolation, forking=False))(values, 3))
    with pytest.raises(InputError, match="'lead' departs at 20 s, before the warm-up ends"):
        simulation(guiding(tmp_path / "before", 20)).isolation.warm  # noqa: B018


def test_an_element_ends_before_the_end_of_a_file_of_almost_its_name(tmp_path):
    (tmp_path / "one.rou.xml").write_text('<routes><vType id="a" ></vType ><route id="r" edges="x"/></routes>')
    pieces, _ = pieces_of(template(tmp_path / "one.rou.xml"))
    assert [*excerpts(pieces, {}, tmp_path)] == [b'<vType id="a" ></vType >', b'<route id="r" edges="x"/>']


def test_times_are_read_as_sumo_reads_them():
    assert [seconds_of(text) for text in ("12.5", "1:00:02", "1:0:0:1", "triggered")] == [12.5, 3602.0, 86401.0, None]


@pytest.mark.sumo
def test_a_pin_begins_with_the_warm_up_of_the_campaign(tmp_path, monkeypatch):
    """Their number follows from the budget: eight runs share one, five hundred eight."""
    monkeypatch.chdir(tmp_path)
    scenario = inserting(tmp_path / "town", warm="{until: 42}")
    result = sbt.run(campaign="coverage", scenario=str(scenario), budget=8, seed=1, executor="serial", store="s", report=False)
    assert set(result.frame["warm_up"]) == {0}
    runs = result.frame[(result.frame["status"] == "ok") & (result.frame["seed"] % 8 != 0)]
    path = pin_runs(tmp_path / "s", [str(runs["index"].iloc[0])], tmp_path / "pins")
    assert "warm_ups=1" in path.read_text()

"""`sumo-sbt new` on what people have: what it writes runs at once, and leaves their files and their traffic alone."""

# ruff: noqa: E501  (XML)

from __future__ import annotations

import gzip
import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from own_scenarios import CASES, make, program, tools
from typer.testing import CliRunner

from sbt.cli import app
from sbt.errors import InputError
from sbt.execution.spec import ScenarioSpec
from sbt.sumo.editing import Changes, changed_copy
from sbt.sumo.template import template

QUICK = ("numeric", "flows")
"""Cases that are tried in every test run; the others are slow."""

needs_tools = pytest.mark.skipif(program("netgenerate") is None or tools() is None, reason="pip install 'sumo-sbt[tools]'")


def called(*words: object) -> Any:
    done = CliRunner().invoke(app, [str(word) for word in words])
    assert done.exit_code == 0, f"{words}: {done.output}"
    return json.loads(done.stdout) if "--json" in words else done.stdout


def files_in(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def ids_in(folder: Path) -> Iterator[str]:
    for path in folder.rglob("*.xml*"):
        if ".net." not in path.name:
            text = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
            yield from (e.get("id", "") for e in ET.fromstring(text).iter() if e.tag in ("vehicle", "trip", "flow"))


def new(name: str, tmp_path: Path) -> tuple[Path, str]:
    """Make a case and its scenario; the folder of the scenario, and what was printed."""
    config = make(name, tmp_path / name)
    before = files_in(tmp_path / name)
    said = called("new", tmp_path / "study", "--from", config)
    assert files_in(tmp_path / name) == before, "the user's files stay as they are"
    assert not re.search("^at ", said, re.MULTILINE), said
    return tmp_path / "study", said


def check_ego(folder: Path, case: Path) -> None:
    """The ego is one vehicle more or one of the user's, with a type that nobody else has."""
    written = ET.fromstring((folder / "ego.rou.xml").read_text())
    kind, ego = written
    assert ego.get("type") == kind.get("id")
    assert all(f'type="{kind.get("id")}"' not in path.read_text(errors="ignore") for path in case.rglob("*.xml"))
    own = [name for name in ids_in(folder) if name == ego.get("id")]
    assert len(own) == 1, "the copy of the traffic is without the ego"
    theirs = sorted(set(ids_in(case)))
    copied = sorted({*ids_in(folder), *theirs}) if ego.get("id") in theirs else theirs
    assert copied == theirs, "nobody else is missing or new"


@needs_tools
@pytest.mark.sumo
def test_a_vehicle_called_ego_is_the_one_under_test(tmp_path):
    config = make("numeric", tmp_path / "case")
    trips = tmp_path / "case" / "t.trips.xml"
    trips.write_text(trips.read_text().replace('id="40"', 'id="Ego"'))
    called("new", tmp_path / "study", "--from", config)
    assert ET.fromstring((tmp_path / "study" / "ego.rou.xml").read_text())[1].get("id") == "Ego"
    check_ego(tmp_path / "study", tmp_path / "case")


@needs_tools
@pytest.mark.sumo
def test_why_nothing_departs_is_told_by_sumo(tmp_path):
    config = make("numeric", tmp_path / "case")
    trips = tmp_path / "case" / "t.trips.xml"
    text = trips.read_text()
    first = re.search('<trip id="0"[^>]*>', text)[0]
    trips.write_text(text.replace(first, "").replace("</routes>", f"{first}</routes>"))
    done = CliRunner().invoke(app, ["new", str(tmp_path / "study"), "--from", str(config), "--ego", "0"])
    assert done.exit_code == 2
    assert "should be sorted by departure time" in done.output


@needs_tools
@pytest.mark.sumo
def test_a_bicycle_under_test_departs_no_faster_than_it_rides(tmp_path):
    """It was to depart with up to .8 of the lane's limit, which SUMO refuses: all corners of the inputs were invalid."""
    config = make("numeric", tmp_path / "case")
    trips = tmp_path / "case" / "t.trips.xml"
    bike = '<vType id="bike" vClass="bicycle"/>'
    text = re.sub("(<routes[^>]*>)", rf"\1{bike}", trips.read_text(), count=1)
    trips.write_text(text.replace('id="40"', 'id="40" type="bike"'))
    called("new", tmp_path / "study", "--from", config, "--ego", "40")
    scenario = ScenarioSpec(str(tmp_path / "study" / "scenario.yaml")).resolve()
    (speed,) = (p for p in scenario.space.parameters if p.name == "depart_speed")
    assert speed.high == pytest.approx(0.8 * 20.0 / 3.6, abs=0.05)
    values = {p.name: p.centre for p in scenario.space.parameters} | {"depart_speed": speed.high}
    assert scenario.simulate(values, 3).speed[0, 0] == pytest.approx(speed.high, abs=1e-3)


@needs_tools
@pytest.mark.sumo
@pytest.mark.parametrize("name", QUICK)
def test_what_new_writes_runs(name, tmp_path):
    folder, _ = new(name, tmp_path)
    check_ego(folder, tmp_path / name)
    scenario = ScenarioSpec(str(folder / "scenario.yaml")).resolve()
    values = {p.name: p.centre for p in scenario.space.parameters}
    trace = scenario.simulate(values, 3)
    assert len(trace.actors) > 1, "the ego meets somebody"
    moved = {v: 0.25 * p.low + 0.75 * p.high for v, p in zip(values, scenario.space.parameters, strict=True)}
    assert trace.speed[0, 0] == pytest.approx(values["depart_speed"], abs=1e-3)
    assert scenario.simulate(moved, 3).speed[0, 0] == pytest.approx(moved["depart_speed"], abs=1e-3)
    if name == "flows":
        assert sum(n.startswith("flow_") for n in values) == 2, "the two busiest flows across the ego's way are inputs"


@needs_tools
@pytest.mark.slow
@pytest.mark.sumo
@pytest.mark.parametrize("name", CASES)
def test_new_check_and_run_succeed_without_an_edit(name, tmp_path, monkeypatch):
    folder, _ = new(name, tmp_path)
    check_ego(folder, tmp_path / name)
    assert called("check", folder / "scenario.yaml", "--json")["ok"]
    monkeypatch.chdir(tmp_path)
    result = called("run", folder / "campaign.yaml", "--set", "executor.kind=serial", "--json")
    assert result["ok"] >= 0.95 * result["runs"] > 11, result


@pytest.mark.parametrize("packed", [False, True])
def test_a_copy_differs_in_nothing_else(tmp_path, packed):
    """One vehicle is left out, one flow changed; comments, references and order stay; what is named relatively is still found."""
    text = (
        '<routes>\n  <!-- a & b --><include href="sub/types.xml"/>\n  <vehicle id="ä&amp;" depart="1"><route edges="e"/><stop lane="e_0"/></vehicle>\n'
        "  <trip id='x' depart=\"2\"/><flow id=\"f\" begin='0' period = '5'/><flow id=\"g\" period=\"5\"/>\n</routes>"
    )
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "types.xml").write_text("<routes/>")
    path = tmp_path / ("a.rou.xml.gz" if packed else "a.rou.xml")
    path.write_bytes(gzip.compress(text.encode()) if packed else text.encode())
    changes = Changes("ä&", {"f": {"period": "${p}"}})
    copied = changed_copy(template(path), changes, tmp_path / "new")
    copied = gzip.decompress(copied) if packed else copied
    expected = re.sub("<vehicle.*</vehicle>", "", text).replace("period = '5'", 'period = "${p}"')
    assert copied.decode() == expected.replace("sub/types.xml", "../sub/types.xml")
    with pytest.raises(InputError, match="must have the vehicles and flows y, but has not"):
        changed_copy(template(path), Changes("y"), tmp_path)


@pytest.mark.sumo
def test_placeholders_that_are_there_are_the_inputs(tmp_path):
    (tmp_path / "r.net.xml").write_text(
        '<net version="1.20"><edge id="e" from="a" to="b"><lane id="e_0" index="0" speed="30" length="900" shape="0,0 900,0"/></edge>'
        '<junction id="a" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape=""/>'
        '<junction id="b" type="dead_end" x="900" y="0" incLanes="e_0" intLanes="" shape=""/></net>'
    )
    (tmp_path / "r.rou.xml").write_text(
        '<routes><vehicle id="0" depart="0" departPos="${30 + gap}"><route edges="e"/></vehicle>'
        '<vehicle id="av" depart="0" departSpeed="${v}"><route edges="e"/></vehicle></routes>'
    )
    (tmp_path / "my.sumocfg").write_text(
        '<configuration><net-file value="r.net.xml"/><route-files value="r.rou.xml"/></configuration>'
    )
    called("new", tmp_path / "s", "--from", tmp_path / "my.sumocfg", "--ego", "av")
    assert {path.name for path in (tmp_path / "s").iterdir()} == {"scenario.yaml", "campaign.yaml"}
    scenario = ScenarioSpec(str(tmp_path / "s" / "scenario.yaml")).resolve()
    ranges = {p.name: (p.low, p.high, p.unit) for p in scenario.space.parameters}
    assert ranges == {"gap": (0.0, 1.0, ""), "v": (0.0, 15.0, "m/s")}
    again = CliRunner().invoke(app, ["new", str(tmp_path / "t"), "--from", str(tmp_path / "s" / "scenario.yaml")])
    assert (again.exit_code, "--from must be a SUMO configuration (.sumocfg)" in again.output) == (2, True)


@pytest.mark.sumo
@pytest.mark.parametrize("busy", [True, False])
def test_an_ego_with_placeholders_of_its_own_waits_for_a_gap_where_runs_are_only_right_so(tmp_path, busy):
    (tmp_path / "r.net.xml").write_text(
        '<net version="1.20"><edge id="e" from="a" to="b"><lane id="e_0" index="0" speed="30" length="900" shape="0,0 900,0"/></edge>'
        '<junction id="a" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape=""/>'
        '<junction id="b" type="dead_end" x="900" y="0" incLanes="e_0" intLanes="" shape=""/></net>'
    )
    (tmp_path / "r.rou.xml").write_text(
        f'<routes><vehicle id="0" depart="0" departPos="{12 if busy else 300}"><route edges="e"/><stop lane="e_0" endPos="{20 if busy else 400}" duration="4"/></vehicle>'
        '<vehicle id="av" depart="1" departSpeed="${v}"><route edges="e"/></vehicle></routes>'
    )
    (tmp_path / "my.sumocfg").write_text(
        '<configuration><net-file value="r.net.xml"/><route-files value="r.rou.xml"/></configuration>'
    )
    said = called("new", tmp_path / "s", "--from", tmp_path / "my.sumocfg", "--ego", "av")
    assert "3 of 3 runs are right" in said
    assert ("\n  delay: 10  " in (tmp_path / "s" / "scenario.yaml").read_text()) == busy
    assert {path.name for path in (tmp_path / "s").iterdir()} == {"scenario.yaml", "campaign.yaml"}

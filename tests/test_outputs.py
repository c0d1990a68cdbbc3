"""What SUMO writes because the user's files say so goes to a folder of the run, never beside the user's files."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from typer.testing import CliRunner

from sbt.cli import app
from sbt.config.load import parse
from sbt.errors import InputError
from sbt.sumo.files import SumoFiles, options_of_command
from sbt.sumo.outputs import run_file
from sbt.workflows.running import run_study
from sbt.workflows.study import Study

PAGE = Path(__file__).resolve().parent.parent / "docs" / "tutorials" / "own_files.md"
DETECTORS = """<additional>
  <inductionLoop id="e1" lane="road_0" pos="150" period="2" file="${gap + 0.5}/e1_${gap}.xml"/>
  <instantInductionLoop id="i" lane="road_0" pos="150" file='i &amp; i.xml'/>
  <laneAreaDetector id="e2" lane="road_0" pos="100" length="50" period="2" file="stdout"/>
  <entryExitDetector id="e3" period="2" file="../e3.xml">
    <detEntry lane="road_0" pos="110"/><detExit lane="road_0" pos="400"/></entryExitDetector>
  <edgeData id="m" file="same.xml"/>
  <laneData id="l" file="NUL"/>
  <vTypeProbe id="v" period="1" file="v.xml"/>
  <routeProbe id="r" edge="road" period="1" file="r.xml"/>
  <include href="deeper/more.add.xml"/>
</additional>"""  # fmt: skip
MORE = '<additional><laneData id="l2" file="same.xml"/></additional>'
WRITTEN = {
    *(f"parts/{name}" for name in ("#/e1_#.xml", "i & i.xml", "stdout", "same.xml", "deeper/same.xml", "v.xml", "r.xml")),
    "e3.xml", "ssm.xml",
}  # fmt: skip


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """The tutorial's scenario with every kind of detector, in a folder below the configuration's; returns scenario.yaml."""
    for name, content in re.findall(r"^```\w+ (\S+)\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL):
        if not name.startswith("+"):
            (tmp_path / name).write_text(content)
    (tmp_path / "parts" / "deeper").mkdir(parents=True)
    (tmp_path / "parts" / "all.add.xml").write_text(DETECTORS)
    (tmp_path / "parts" / "deeper" / "more.add.xml").write_text(MORE)
    config = tmp_path / "my.sumocfg"
    text = config.read_text().replace("</input>", '<additional-files value="parts/all.add.xml"/></input>')
    more = '<output><fcd-output value="f.xml"/><netstate-dump value="n.xml"/><vehroutes value="v.xml"/></output>'
    more += '<ssm_device><device.ssm.probability value="1"/></ssm_device>'
    config.write_text(text.replace("</configuration>", f"{more}</configuration>"))
    path = tmp_path / "scenario.yaml"
    path.write_text(path.read_text().replace("sumo: my.sumocfg", "sumo: {config: my.sumocfg, options: {tripinfo: t.xml}}"))
    return path


@pytest.mark.sumo
def test_detectors_write_into_the_folder_of_the_run_and_are_exported(study: Path, tmp_path_factory: pytest.TempPathFactory):
    before = {p: p.read_bytes() for p in study.parent.rglob("*") if p.is_file()}
    out = tmp_path_factory.mktemp("out")
    text = f"campaign: coverage\nscenario: {study}\nbudget: 3\nexecutor: {{kind: serial}}\nstore: {out}/s\n"
    assert run_study(Study(parse(text)), report=False).ok == 3
    done = CliRunner().invoke(app, ["replay", str(out / "s"), "1", "--export", str(out / "x")])
    assert done.exit_code == 0, done.output
    assert {p: p.read_bytes() for p in study.parent.rglob("*") if p.is_file()} == before, "the user's folder stays as it is"
    assert not list(Path.cwd().glob("*ssm*.xml"))
    found = {str(p.relative_to(out / "x" / "outputs")): p for p in (out / "x" / "outputs").rglob("*") if p.is_file()}
    numbered = {re.sub(r"\d+\.\d+", "#", name): path for name, path in found.items()}
    assert set(numbered) == WRITTEN, "a number in a name is that of the run"
    for path in found.values():
        ET.parse(path)  # complete
    detected = ET.parse(numbered["parts/#/e1_#.xml"]).getroot()
    assert sum(float(interval.attrib["nVehEntered"]) for interval in detected) >= 1, "the ego, at least"


def test_outputs_of_the_same_name_stay_apart_and_inside(tmp_path: Path):
    of_user = [(folder, name) for folder in ("/x", "/y", "/x/y") for name in ("o.xml", "../o.xml", "/z/o.xml")]
    names = [run_file(tmp_path, Path(folder) / "a.xml", name) for folder, name in of_user]
    assert len(set(names)) == 5
    assert all(name.is_relative_to(tmp_path.resolve()) for name in names)


INPUTS = {
    "net-file", "route-files", "additional-files", "weight-files", "load-state", "device.ssm.filter-edges.input-file",
    "astar.all-distances", "astar.landmark-distances", "phemlight-path", "device.fcd-replay.files", "configuration-file",
    "edgedata-files", "alternative-net-file", "selection-file", "gui-settings-file", "fcd-output.filter-edges.input-file",
}  # fmt: skip
"""Options of SUMO whose files are read; those of every other one are written. A new option of SUMO belongs to one of the two."""


@pytest.fixture(scope="module")
def file_options(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Every option of SUMO that takes a file, by each of its names, as SUMO's own table says."""
    path = tmp_path_factory.mktemp("options") / "options.xml"
    script = "import sys, libsumo; libsumo.start(['sumo', '--save-template', sys.argv[1]])"
    subprocess.run([sys.executable, "-c", script, str(path)], check=True, capture_output=True)
    entry = re.compile(r'<([\w.-]+) value="[^"]*"(?: synonymes="([^"]*)")?[^>]*? type="FILE"')
    return {name: long for long, more in entry.findall(path.read_text()) for name in (long, *more.split())}


@pytest.mark.sumo
def test_no_option_of_sumo_writes_outside_of_the_run(
    study: Path, file_options: dict[str, str], tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
):
    written = {name: long for name, long in file_options.items() if long not in INPUTS}
    assert len(written) > 50
    assert set(file_options.values()) > INPUTS
    outside, here = tmp_path_factory.mktemp("outside"), tmp_path_factory.mktemp("here")
    more = "".join(f'<{name} value="{outside}/{name}.c"/>' for name in written)
    more += f'<save-state.times value="1"/><output-prefix value="{outside}/p"/><remote-port value="9"/>'
    more += f'<configuration-file value="{outside}/nested.sumocfg"/>'
    config = study.parent / "my.sumocfg"
    config.write_text(config.read_text().replace("</configuration>", f"<output>{more}</output></configuration>"))
    options = {name: f"{outside}/{name}.o" for name in written} | {"save-state.period": 1, "netstate-dump.precision": 3}
    study.write_text(
        re.sub(r"(?m)^sumo: .*$", f"sumo: {json.dumps({'config': 'my.sumocfg', 'options': options})}", study.read_text())
    )
    before = sorted(study.parent.rglob("*"))
    monkeypatch.chdir(here)
    store = tmp_path_factory.mktemp("store")
    text = f"campaign: coverage\nscenario: {study}\nbudget: 2\nexecutor: {{kind: serial}}\nstore: {store}\n"
    assert run_study(Study(parse(text)), report=False).ok == 2
    assert (list(outside.iterdir()), list(here.iterdir()), sorted(study.parent.rglob("*"))) == ([], [], before)
    command = [word for name in written for word in (f"-{'-' * (len(name) > 1)}{name}", f"{outside}/x")]
    assert options_of_command(command, study.parent) == {}, "in a loop of one's own"


@pytest.mark.parametrize(
    ("option", "value", "rule"),
    [
        ("eager-insert", "--fcd-output={}", "the value of eager-insert must not look like an option"),
        ("eager-insert", "-l={}", "must not look like an option"),
        ("fcd-output={}", "true", "the name of an option must be one of SUMO's"),
        ("--fcd-output", "{}", "the name of an option must be one of SUMO's"),
        ("c", "{}", "a configuration is named by config"),
        ("configuration", "{}", "a configuration is named by config"),
        ("a", "{}", "additional-files must name a file that exists"),
    ],
)
def test_no_option_hides_another(study: Path, option: str, value: str, rule: str):
    entry = json.dumps({"config": "my.sumocfg", "options": {option.format("/x"): value.format("/x")}})
    study.write_text(re.sub(r"(?m)^sumo: .*$", f"sumo: {entry}", study.read_text()))
    with pytest.raises(InputError, match=re.escape(rule)):
        _ = Study(parse(f"campaign: coverage\nscenario: {study}\n")).settings


def test_a_choice_cannot_become_an_option(tmp_path: Path):
    (tmp_path / "n.net.xml").write_text('<net version="1.20"/>')
    files = SumoFiles.of({"net-file": "n.net.xml", "eager-insert": "${kind}"}, tmp_path, "sumo")
    assert "true" in files.launch({"kind": "true"}, tmp_path).arguments
    with pytest.raises(InputError, match="must not look like an option"):
        files.launch({"kind": "--fcd-output=x"}, tmp_path)


NAMED = """<add>
<calibrator id="c" lane="e_0" pos="0" output="/out/c.xml"/>
<timedEvent type="SaveTLSStates" source="t" dest="/out/tls.xml"/>
<tlLogic id="t" type="actuated" programID="1"><param key="show-detectors" value="true"/><param key="file" value="/out/e1.xml"/>
  <phase duration="5" state="G"><param key='f&#105;le' value="/out/e1b.xml"/></phase>
  <param key="SWARMLOG" value="/out/swarm.txt"/></tlLogic>
<vType id="v"><param key="device.s&#115;m.file" value="/out/ssm.xml"/><param value='/out/toc.xml' key='device.toc.file'/>
  <param key="file" value="/mine"/></vType>
<vehicle id="a"><param key="device.ssm.file" value="/out/a.xml"/></vehicle>
</add>"""


@pytest.mark.parametrize("option", ["additional-files", "route-files", "load-state"])
def test_parameters_that_name_outputs_are_redirected(option: str, tmp_path: Path):
    (tmp_path / "n.net.xml").write_text('<net version="1.20"/>')
    (tmp_path / "x.xml").write_text(NAMED)
    run = tmp_path / "run"
    arguments = SumoFiles.of({"net-file": "n.net.xml", option: "x.xml"}, tmp_path, "sumo").launch({}, run).arguments
    copy = Path(arguments[arguments.index(f"--{option}") + 1]).read_text()
    assert copy.count(f"{run}/outputs/out/") == 8
    assert '"/out' not in copy
    assert "'/out" not in copy
    assert 'value="/mine"' in copy, "a parameter of the user's own"

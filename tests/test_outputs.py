"""What SUMO writes because the user's files say so goes to a folder of the run, never beside the user's files."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from typer.testing import CliRunner

from sbt.cli import app
from sbt.config.load import parse
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

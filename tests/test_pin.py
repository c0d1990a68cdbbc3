"""Pins: a found failure as a pytest file that passes while the scenario is what it was, and fails when it is not."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

import sbt
from sbt.cli import app
from sbt.errors import InputError
from sbt.testing import Pinned
from sbt.workflows.pinning import pin_runs

ROOT = Path(__file__).resolve().parent.parent
OWN = """
from sbt import Parameter, Requirement, Scenario

SCENARIO = Scenario(
    "plane", inputs=[Parameter("gap", 0, 10, "m"), Parameter("kind", choices=("car", "bus"))],
    evaluate=lambda values, seed: {"room": values["gap"] - 4.0 - (values["kind"] == "bus")},
    requirement=Requirement("room", high=0.0),
)
"""


def tutorial(folder: Path) -> Path:
    """Write the files of a scenario of one's own; return its scenario.yaml, in which about half of the runs are critical."""
    folder.mkdir()
    page = (ROOT / "docs" / "tutorials" / "own_files.md").read_text(encoding="utf-8")
    for name, content in re.findall(r"^```\w+ (road\S+|cars\S+|my\S+|scenario\S+)\n(.*?)^```", page, re.MULTILINE | re.DOTALL):
        (folder / name).write_text(content)
    return folder / "scenario.yaml"


def pinned(name: str, store: Path, into: Path, runs: list[str]) -> Path:
    result = sbt.run(
        campaign="coverage", scenario=name, budget=8, batch=8, initial=8, seed=2, store=store, executor="serial", report=False
    )
    critical = result.frame["critical"]
    assert 0 < critical.sum() < 8, "the test needs runs of both kinds"
    wanted = [str(int(critical.to_numpy().argmax())), str(int((~critical).to_numpy().argmax())), *runs]
    return pin_runs(store, wanted, into)


def pytest_of(folder: Path) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:warnings", "-rf", str(folder)],
        env={**os.environ}, cwd=folder, capture_output=True, text=True, check=False,
    )  # fmt: skip
    return done.stdout


@pytest.mark.sumo
def test_a_pin_passes_as_long_as_the_scenario_is_what_it_was(tmp_path: Path):
    scenario, tests = tutorial(tmp_path / "study"), tmp_path / "tests"
    (tmp_path / "study" / "plane.py").write_text(OWN)
    pinned(str(scenario), tmp_path / "s", tests, [])
    pinned(str(tmp_path / "study" / "plane.py") + ":SCENARIO", tmp_path / "p", tests, [])
    assert len(list(tests.glob("test_pinned_*.py"))) == 2
    said = pytest_of(tests)
    assert "10 passed, 2 xfailed" in said, said  # of each: starts, metrics, the run that is not critical; and the one that is
    net = scenario.parent / "road.net.xml"
    net.write_text(net.read_text().replace("-4.80", "-4.90"))
    own = tmp_path / "study" / "plane.py"
    own.write_text(OWN.replace("- 4.0", "- 0.5"))
    said = pytest_of(tests)
    failed = re.findall(r"FAILED \S*test_pinned_([a-z]+)\S*::(\w+)", said)
    assert failed.count(("study", "test_starts_as_recorded")) == 2, said
    assert failed.count(("plane", "test_measures_what_was_recorded")) == 2, said
    assert ("plane", "test_meets_the_requirement") in failed, "a failure that is gone must be seen: its mark is strict"


def test_another_ego_must_meet_the_requirement(tmp_path: Path):
    text = "campaign: coverage\nscenario: emergency_braking\nego: {kind: acc_aeb}\n"
    inputs, seed = {"a_co": -9.0, "v_co_min_frac": 0.1, "d_t": 1.2, "v_co": 95.0, "v_ego": 120.0}, 1
    recorded = Pinned(text, tmp_path).run(inputs, seed)
    other = Pinned(text, tmp_path, "{kind: acc_aeb, reaction_time: 1.0}").run(inputs, seed)
    assert recorded.start == other.start
    assert recorded.metrics != other.metrics
    assert len(recorded.start["ego"]) == 4


def test_runs_are_named_by_index_or_mode_and_must_be_there(tmp_path: Path):
    result = sbt.run(
        campaign="falsification", scenario="testbed:hartmann6_1e-3", budget=30, seed=1, store=tmp_path / "s", executor="serial",
        requirement={"critical": [-5.0, -0.5]}, report=False,
    )  # fmt: skip
    representative = result.conclusion.failure_modes[0].representative
    done = CliRunner().invoke(app, ["pin", str(tmp_path / "s"), "mode:1", str(representative), "--into", str(tmp_path / "t")])
    assert done.exit_code == 0, done.output
    text = Path(done.stdout.strip()).read_text(encoding="utf-8")
    assert done.stderr == ""
    harmless = int(result.frame.index[~result.frame["critical"].astype(bool)][0])
    told = CliRunner().invoke(app, ["pin", str(tmp_path / "s"), str(harmless), "--into", str(tmp_path / "h")])
    assert told.stderr == f"no failures: runs {harmless} violate nothing; the test guards that they do not begin to\n"
    assert text.count("'seed'") == 1, "one run, named twice, is pinned once"
    assert f"'run': {representative}," in text
    assert json.loads(json.dumps(text.split("FOLDER = ")[1].splitlines()[0])).endswith("/ '.'")
    for run, message in (("mode:99", "needs a failure mode"), ("-1", "RUN must be"), ("500", "finished one")):
        with pytest.raises(InputError, match=message):
            pin_runs(tmp_path / "s", [run], tmp_path / "t")


def test_a_run_without_a_trace_is_pinned_where_a_run_approved_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    (tmp_path / "own.py").write_text(
        "import sbt\n"
        "A = sbt.Scenario('own', inputs=[sbt.Parameter('u', 0, 1)], requirement=sbt.Requirement('y', high=0.5),\n"
        "                 evaluate=lambda values, seed: {'y': values['u']})\n"
    )
    (tmp_path / "c.yaml").write_text("campaign: coverage\nscenario: own.py:A\nbudget: 4\nstore: s\nexecutor: {kind: serial}\n")
    assert CliRunner().invoke(app, ["run", str(tmp_path / "c.yaml"), "--store", str(tmp_path / "s")]).exit_code == 0
    pinned = CliRunner().invoke(app, ["pin", str(tmp_path / "s"), "0", "--into", str(tmp_path / "tests")])
    assert pinned.exit_code == 0, pinned.output

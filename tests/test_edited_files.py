"""Files that a user edits within a Python session, and configurations that are run from elsewhere, are those that are meant."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from test_doors import files_of

import sbt
from sbt.errors import InputError
from sbt.execution.code_print import code_print
from sbt.store.database import Store
from sbt.sumo.nets import nets_folder
from sbt.testbeds.problem import _Pointwise
from sbt.workflows.changes import package_print

FUNCTION = """import sbt
SCENARIO = sbt.Scenario('s', [sbt.Parameter('a', 0, 1, 'm')], sbt.Requirement('gap', high=0.0),
    evaluate=lambda values, seed: {{'gap': {0}}})
"""


def test_an_edited_python_file_is_run_as_it_stands(tmp_path):
    file = tmp_path / "mine.py"
    for value in (1.0, 2.0):
        file.write_text(FUNCTION.format(value))
        os.utime(file, (value, value))  # a clock of a file system may be coarse
        assert sbt.simulate(f"{file}:SCENARIO").metrics == {"gap": value}


@pytest.mark.sumo
@pytest.mark.parametrize(("name", "old", "new"), [
    ("cars.rou.xml", 'departSpeed="30"', 'departSpeed="29"'), ("scenario.yaml", "duration: 10", "duration: 02"),
    ("road.net.xml", "length=\"2000.00\" shape=\"0.00,-4.80", "length=\"2100.00\" shape=\"0.00,-4.80"),
])  # fmt: skip
def test_edited_sumo_files_are_run_as_they_stand(tmp_path, name, old, new):
    files_of("own_files", tmp_path)
    before = sbt.simulate(tmp_path / "scenario.yaml").trace
    text = (tmp_path / name).read_text()
    (tmp_path / name).write_text(text.replace(old, new, 1))
    after = sbt.simulate(tmp_path / "scenario.yaml").trace
    assert text != (tmp_path / name).read_text()
    assert not before.equals(after)
    (tmp_path / name).write_text(text)
    assert sbt.simulate(tmp_path / "scenario.yaml").trace.equals(before)


@pytest.mark.parametrize("place", ["", "elsewhere"])
def test_a_resolved_configuration_goes_on_from_any_folder(tmp_path, monkeypatch, place):
    (tmp_path / "mine.py").write_text(FUNCTION.format("values['a']"))
    monkeypatch.chdir(tmp_path)
    first = sbt.run(campaign="coverage", scenario="mine.py:SCENARIO", budget=4, store=tmp_path / "store", executor="serial")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / place)
    again = sbt.run(tmp_path / "store" / "config.resolved.yaml", budget=6)
    assert len(again.history) == 6
    assert (again.history.x[:4] == first.history.x[:4]).all()


def test_a_change_that_only_some_runs_show_is_refused_every_time(tmp_path):
    """The first and the last run do not depend on it; of files that were changed since, more runs are tried."""
    file = tmp_path / "mine.py"
    file.write_text(FUNCTION.format("values['a']"))
    study = {"campaign": "coverage", "scenario": f"{file}:SCENARIO", "store": tmp_path / "store", "executor": "serial"}
    x = sbt.run(budget=12, **study).history.x[:, 0].tolist()
    file.write_text(FUNCTION.format(f"values['a'] + (values['a'] not in ({x[0]!r}, {x[-1]!r}))"))
    later = (tmp_path / "store" / "config.resolved.yaml").stat().st_mtime + 10.0
    os.utime(file, (later, later))
    for _ in range(2):
        with pytest.raises(InputError, match=r"code and files must give the runs of .* again .*changed since: .*mine\.py"):
            sbt.run(budget=14, **study)
    file.write_text(FUNCTION.format("values['a'] * 1.0"))
    os.utime(file, (later, later))
    assert len(sbt.run(budget=14, **study).history) == 14


def _scenario(function):
    inputs = [sbt.Parameter(name, 0, 1) for name in "ab"]
    return sbt.Scenario("cell", inputs, sbt.Requirement("y", high=0.2), evaluate=function)


CELL = """
def helper(x):
    return {0}
def evaluate(values, seed):
    return {{"y": helper(values["a"]) + values["b"] in {{1.0, 2.0}} or helper(values["a"])}}
"""


def _cell(text: str):
    """Return the function that a cell of a notebook defines."""
    names: dict = {"__name__": "__main__"}
    exec(compile(CELL.format(text), "<cell>", "exec"), names)
    return names["evaluate"]


def test_a_changed_function_of_a_notebook_is_tried_at_more_runs(tmp_path):
    """The first and the last run do not depend on what it calls; a cell that is run again as it was changes nothing."""
    keys = {"campaign": "coverage", "seed": 3, "store": tmp_path / "s", "executor": "serial", "report": False}
    first = sbt.run(**keys, scenario=_scenario(_cell("x")), budget=40)
    a = first.frame["x.a"]
    assert not a.iloc[[0, -1]].between(0.3, 0.6).any()
    assert len(sbt.run(**keys, scenario=_scenario(_cell("x")), budget=44).history) == 44
    with pytest.raises(InputError, match=r"must give the runs of .* again to go on"):
        sbt.run(**keys, scenario=_scenario(_cell("x if not 0.3 < x < 0.6 else -1.0")), budget=50)
    assert len(sbt.open(tmp_path / "s", scenario=_scenario(_cell("x"))).history) == 44


@pytest.mark.parametrize("kind", ["resumed", "warm start", "unsure"])
def test_runs_that_another_state_of_the_package_would_not_give_are_refused(tmp_path, monkeypatch, kind):
    def campaign(budget: int, **options: object) -> sbt.Result:
        name = "second" if "warm_start" in options else "first"
        settings = {"campaign": "coverage", "scenario": "testbed:four_branch_7", "executor": "serial", "report": False} | options
        return sbt.run(budget=budget, store=tmp_path / name, **settings)

    def again() -> sbt.Result:
        options = {} if kind == "resumed" else {"campaign": "boundary", "warm_start": {"store": str(tmp_path / "first")}}
        return campaign(8, **options)

    for place in ("running", "changes"):
        monkeypatch.setattr(f"sbt.workflows.{place}.package_print", lambda: "earlier")
    campaign(6)
    monkeypatch.undo()
    if kind == "unsure":  # SUMO does not repeat every run of such files: of six all differ
        monkeypatch.setattr("sbt.workflows.rechecking.not_repeated", lambda _: "; it may")
    before = _Pointwise.__call__
    with monkeypatch.context() as patch:
        patch.setattr(_Pointwise, "__call__", lambda self, values, seed: {"y": before(self, values, seed)["y"] + 1e-9})
        for _ in range(2):
            with pytest.raises(InputError, match="this package or SUMO was another one then"):
                again()
    assert len(again().history) >= 8  # the same runs: it goes on
    with Store.read(tmp_path / "first") as store:
        assert (store.configuration["package"] == "earlier") == (kind != "resumed")


def test_a_print_of_code_is_that_of_any_process():
    text = "import sbt, sys; sys.path.insert(0, 'tests'); from test_edited_files import _cell, _scenario; "
    text += "from sbt.execution.code_print import code_print; print(code_print(_scenario(_cell('x'))))"
    prints = {
        subprocess.run(
            [sys.executable, "-c", text], env={**os.environ, "PYTHONHASHSEED": seed}, capture_output=True, text=True, check=True,
            cwd=Path(__file__).parents[1],
        ).stdout
        for seed in "12"
    }  # fmt: skip
    assert prints == {f"{code_print(_scenario(_cell('x')))}\n"}
    assert code_print(_scenario(_cell("x"))) != code_print(_scenario(_cell("x + 0.0")))


def test_a_store_that_spread_an_input_evenly_does_not_go_on_in_its_logarithm(tmp_path, monkeypatch):
    def run(budget: int) -> None:
        law = sbt.Distribution.of(kind="scipy", name="loguniform", a=1e-3, b=10.0)
        scenario = sbt.Scenario(
            "s", [sbt.Parameter("a", 1e-3, 10.0, distribution=law)], sbt.Requirement("y", high=0.0),
            evaluate=lambda values, seed: {"y": values["a"]},
        )  # fmt: skip
        sbt.run(campaign="coverage", scenario=scenario, budget=budget, store=tmp_path / "s", executor="serial", report=False)

    with monkeypatch.context() as patch:
        patch.setattr("sbt.problem.parameter._DECADES", float("inf"))  # as stores of before
        run(6)
    with pytest.raises(InputError, match=r"logarithmic: None there, \['a'\] now"):
        run(8)


def test_a_print_of_the_package_is_that_of_what_simulates(tmp_path, monkeypatch):
    plain = package_print.__wrapped__
    now = plain()
    assert now == package_print()
    monkeypatch.setattr("sbt.workflows.changes.versions", lambda: "another SUMO")
    other = plain()
    monkeypatch.undo()
    shutil.copytree(nets_folder(), tmp_path / "nets")
    monkeypatch.setattr("sbt.sumo.nets.nets_folder", lambda: tmp_path / "nets")
    assert plain() == now  # wherever they lie
    net = next((tmp_path / "nets").rglob("*.net.xml"))
    net.write_text(net.read_text() + "<!-- edited -->")
    assert len({now, other, plain()}) == 3

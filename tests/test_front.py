"""Laws of `import sbt`: light, typed, the same as the command line, and clear about what is wrong."""

from __future__ import annotations

import html
import importlib.util
import json
import math
import re
import shutil
import statistics
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import sbt
from sbt import plugins
from sbt.campaigns.settings import PlainConclusion
from sbt.cli import app
from sbt.problem.expression import Expression
from sbt.problem.space import ParameterSpace

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("agg")
ROOT = Path(__file__).resolve().parent.parent
INPUTS = [sbt.Parameter("a", -1, 1, "m"), sbt.Parameter("b", 0, 1, "m")]
NEED = sbt.Requirement("gap", high=0.0)
TINY: dict[str, Any] = {"budget": 24, "initial": 12, "batch": 12, "seed": 1, "executor": "serial", "report": False}


def gap(values, seed):
    return {"gap": values["a"] ** 2 + values["b"] - 0.6}


def scenario_of(evaluate: Any = gap, name: str = "disc", inputs: Any = INPUTS) -> sbt.Scenario:
    return sbt.Scenario(name, inputs, NEED, evaluate=evaluate)


SCRIPT = """
import sbt
import numpy as np
OFFSET = 0.6
def f(values, seed):
    return {"gap": values["a"] ** 2 + values["b"] - OFFSET}
def closure(offset):
    return lambda values, seed: {"gap": float(np.square(values["a"])) + values["b"] - offset}
def main(executor, store):
    inputs = [sbt.Parameter("a", -1, 1, "m"), sbt.Parameter("b", 0, 1, "m")]
    frames = []
    for k, evaluate in enumerate((f, closure(0.6))):
        scenario = sbt.Scenario("disc", inputs=inputs, evaluate=evaluate, requirement=sbt.Requirement("gap", high=0.0))
        result = sbt.run(campaign="boundary", scenario=scenario, budget=40, initial=20, batch=20, seed=1, metamodel="gp",
                         executor=executor, store=f"{store}{k}", report=False)
        frame = result.frame
        y = frame["x.a"] ** 2 + frame["x.b"] - 0.6
        assert len(frame) == 40 and np.allclose(y, frame["y.gap"]) and (frame["critical"].astype(bool) == (y <= 0)).all()
        p = result.predict(frame)
        assert ((p["p_critical"].to_numpy() > 0.5) == (y <= 0).to_numpy()).mean() > 0.8
        assert result.conclusion.to_dict()["critical_fraction"] == result.conclusion.critical_fraction
        frames.append(frame[["x.a", "x.b", "y.gap"]].to_numpy().tolist())
    return frames
"""
EXECUTORS = [
    {"kind": "serial"}, {"kind": "local", "workers": 2},
    pytest.param({"kind": "dask", "workers": 2}, marks=[
        pytest.mark.slow, pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="needs distributed"),
    ]),
]  # fmt: skip


@pytest.mark.parametrize("executor", EXECUTORS, ids=lambda choice: choice["kind"])
def test_the_notebook_as_a_script(executor, tmp_path):
    call = f"if __name__ == '__main__':\n    import json\n    print(json.dumps(main({executor!r}, 's')))\n"
    (tmp_path / "script.py").write_text(SCRIPT + call)
    done = subprocess.run([sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    one, other = json.loads(done.stdout.splitlines()[-1])
    assert one[:20] == other[:20], "a function of the script and a closure measure the same"


@pytest.mark.slow
def test_the_notebook_in_a_kernel(tmp_path):
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    cells = [SCRIPT, "main({'kind': 'local', 'workers': 2}, 's');", "result = sbt.open('s0')\nresult", "result.plot.boundary();"]
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in cells])
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    assert "critical share" in notebook.cells[2].outputs[-1]["data"]["text/html"].lower()
    assert "image/png" in notebook.cells[3].outputs[-1]["data"]


@pytest.mark.slow
def test_types_of_a_users_script(tmp_path):
    pytest.importorskip("mypy")
    command = [sys.executable, "-m", "mypy", "--strict", "--config-file", str(ROOT / "pyproject.toml"), "tests/typed_script.py"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert [line for line in done.stdout.splitlines() if line.startswith("tests/")] == []


def test_importing_weighs_nothing():
    code = "import time; t = time.process_time(); import sbt, sys; print(time.process_time() - t, *sys.modules)"
    seconds = []
    for _ in range(3):
        spent, *loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
        seconds.append(float(spent))
        assert {"torch", "libsumo", "pandas", "numpy", "matplotlib", "pydantic"} & set(loaded) == set()
    assert statistics.median(seconds) < 0.1


def test_names_are_listed_and_there():
    assert set(dir(sbt)) == set(sbt.__all__)
    for name in dir(sbt):
        assert getattr(sbt, name) is not None
    with pytest.raises(AttributeError, match=r"has no attribute 'simulat' \(did you mean 'simulate'\?\)"):
        _ = sbt.simulat
    for name in sbt.campaigns.__all__:
        assert getattr(sbt.campaigns, name) is not None


def test_no_module_hides_a_name():
    """`import sbt.run` somewhere must not turn the function into a module."""
    taken = {(ROOT / "sbt" / part).stem for part in [p.name for p in (ROOT / "sbt").iterdir()]}
    assert taken & {"run", "open", "simulate", "list", "check"} == set()
    for kind in ("metrics", "metamodels"):
        modules = {path.stem for path in (ROOT / "sbt" / kind).iterdir()}
        assert modules & set(sbt.list(kind)) == set()
        part = getattr(sbt, kind)
        assert dir(part) == sorted(sbt.list(kind))
        for name in sbt.list(kind):
            assert getattr(part, name) is plugins.load(kind, name)


@pytest.mark.sumo
@pytest.mark.parametrize("name", sorted(plugins.names("scenarios")))
def test_every_built_in_scenario_runs(name):
    run = sbt.simulate(name, seed=1)
    assert run.status == "ok", run.reason
    assert run.critical is (run.margin <= 0)
    assert {"time", "actor", "x", "y", "speed"} <= set(run.trace.columns)


def printed(*args: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(CliRunner().invoke(app, [*args, "--json"]).stdout)
    return found


def test_the_command_line_prints_what_the_functions_return():
    name = "testbed:four_branch_7"
    one, other = printed("simulate", name, "x1=1.5", "--seed", "3"), sbt.simulate(name, {"x1": 1.5}, seed=3).to_dict()
    assert {**one, "seconds": 0} == {**other, "seconds": 0}
    assert printed("list") == {k: [{"name": n, "summary": s} for n, s in sbt.list(k).items()] for k in plugins.KINDS}
    assert printed("check", name) == {"target": name, **sbt.check(name).to_dict()}


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    """A store that was made with an object."""
    folder: Path = tmp_path_factory.mktemp("front") / "s"
    sbt.run(campaign="boundary", scenario=scenario_of(), metamodel="gp", validation={"share": 0.2}, store=folder, **TINY)
    return folder


def unable(scenario: Any, folder: Path) -> Any:
    return sbt.run(campaign="coverage", scenario=scenario, budget=4, workers=2, store=folder)


def guarded() -> Any:
    lock = threading.Lock()

    def locked(values, seed):
        with lock:
            return gap(values, seed)

    return locked


STRETCHED = [sbt.Parameter("a", -1, 2, "m"), INPUTS[1]]
MISSPELT = pd.DataFrame({"x.aa": [0.1], "b": [0.2]})
WRONG = {
    "keyword": (lambda s: sbt.run(campaign="boundary", scenario=scenario_of(), bugdet=3), r"'bugdet' \(did you mean 'budget'"),
    "campaign": (lambda s: sbt.run(campaign="boundry", scenario=scenario_of()), r"did you mean 'boundary'"),
    "no scenario at all": (lambda s: unable(None, s.parent / "none"), r"a Scenario or the name of one, but got None"),
    "lock": (lambda s: unable(scenario_of(guarded()), s.parent / "lock"), r"variable 'lock' of guarded"),
    "other scenario": (lambda s: sbt.open(s, scenario=scenario_of(name="disk")), r"with scenario disc, but got disk"),
    "other inputs": (lambda s: sbt.open(s, scenario=scenario_of(inputs=STRETCHED)), r"of input a: .* there"),
    "other run": (
        lambda s: sbt.run(campaign="boundary", scenario=scenario_of(name="disk"), metamodel="gp", store=s, **TINY),
        r"belongs to one configuration",
    ),
    "a name for an object": (lambda s: sbt.open(s, metamodel="gp"), r"metamodel must be the object"),
    "missing column": (lambda s: sbt.open(s).predict({"a": 0.1}), r"b is missing"),
    "misspelt column": (lambda s: sbt.open(s).predict(MISSPELT), r"a is missing \(did you mean 'aa'"),
    "out of range": (lambda s: sbt.open(s).predict({"a": 7.0, "b": 0.5}), r"\[-1, 1\]"),
    "not a number": (lambda s: sbt.open(s).predict({"a": "x", "b": 0.5}), r"must hold numbers"),
    "lengths": (lambda s: sbt.open(s).predict({"a": [0.1, 0.2], "b": [0.1, 0.2, 0.3]}), r"must have one length"),
    "number as text": (lambda s: sbt.open(s).predict({"a": "0.5", "b": 0.5}), r"a must hold numbers, .* got '0.5'"),
    "two columns": (lambda s: sbt.open(s).predict({"a": 0.1, "x.a": 0.2, "b": 0.5}), r"must be one column, but a is more"),
    "no table": (lambda s: sbt.open(s).predict([[0.1, 0.2], [0.3]]), r"inputs must be a table of numbers"),
    "no axes": (lambda s: sbt.open(s).plot.runs(5), r"ax must be matplotlib's axes"),
    "no index": (lambda s: sbt.open(s).plot.slices(at=[1, 2]), r"at must be the index of a run, or values"),
    "no form": (lambda s: sbt.open(s).export(5), r"but got"),
    "value": (lambda s: sbt.simulate(scenario_of(), {"a": 3}), r"input a must be in \[-1, 1\] m, but got 3"),
    "input": (lambda s: sbt.simulate(scenario_of(), {"aa": 0}), r"did you mean 'a'"),
    "seed": (lambda s: sbt.simulate(scenario_of(), seed=-1), r"seed must be a whole number >= 0"),
    "plot of an input": (lambda s: sbt.open(s).plot.runs(x="c"), r"must be one of a, b, but got 'c'"),
    "run": (lambda s: sbt.open(s, scenario=scenario_of()).replay(99), r"must be a finished one .*\(0 to 23\), but got 99"),
    "no trace": (lambda s: sbt.open(s, scenario=scenario_of()).trace(0), r"gives its metrics directly"),
    "no scenario": (lambda s: sbt.open(s).trace(0), r"must be given again: scenario=disc"),
    "kind": (lambda s: sbt.list("metamodel"), r"did you mean 'metamodels'"),
    "folder": (lambda s: sbt.open(s.parent / "nothing"), r"none in .*nothing"),
    "run as text": (lambda s: sbt.open(s, scenario=scenario_of()).replay("0"), r"a run must be its index, but got '0'"),
    "forms": (lambda s: sbt.open(s).export(["csv"]), r"the format must be text, but got \['csv'\]"),
    "uneven rows": (lambda s: sbt.open(s).predict([{"a": 0.1, "b": 0.5}, {"a": 0.1}]), r"row 0 has a, b, row 1 a$"),
    "rows of numbers": (lambda s: sbt.open(s).predict([{1: 0.1, 2: 0.2}, {1: 0.1}]), r"row 0 has 1, 2, row 1 1$"),
    "form": (lambda s: sbt.open(s).export("cvs"), r"did you mean 'csv'"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_is_said(case, store):
    call, message = WRONG[case]
    with pytest.raises((sbt.InputError, sbt.StoreError), match=message):
        call(store)


def test_a_store_made_with_an_object_opens_without_it(store):
    result = sbt.open(store)
    frame = result.frame
    assert str(frame["critical"].dtype) == "boolean"
    assert (frame["critical"] == (frame["margin"] <= 0)).all()
    assert len(result.predict(frame)) == 24
    assert result.predict([{"a": 0.1, "b": 0.5}, {"b": 0.2, "a": 0.3}]).equals(result.predict([[0.1, 0.5], [0.3, 0.2]]))
    assert result.predict([frame.iloc[3], frame.iloc[0]])["mean"].tolist() == result.predict(frame.iloc[[3, 0]])["mean"].tolist()
    assert result.predict(frame.iloc[3])["p_critical"].tolist() == result.predict(frame.iloc[[3]])["p_critical"].tolist()
    assert "disc" in repr(result)
    assert "object:" not in repr(result) + result._repr_html_()
    for name in ("runs", "boundary", "slices", "convergence", "reliability", "influence"):
        ax = getattr(result.plot, name)()
        assert ax.get_xlabel(), name
        matplotlib.pyplot.close(ax.figure)
    assert re.search(r"sbt\.open\(.*, scenario=disc\)\.replay\(\d+\)", html.unescape(result.report().read_text()))
    again = sbt.open(store, scenario=scenario_of())
    assert again.replay(3).identical
    assert again.frame.equals(frame)


def test_exports_carry_the_verdict(store):
    result = sbt.open(store)
    csv, parquet = pd.read_csv(result.export("csv")), pd.read_parquet(result.export("parquet"))
    for table in (csv, parquet):
        assert (table["critical"].astype("boolean") == result.frame["critical"]).all()
        assert np.array_equal(table["margin"], result.frame["margin"])


def test_prediction_takes_tables_mappings_and_arrays(store):
    result = sbt.open(store)
    one = result.predict(pd.DataFrame({"x.a": [0.1, 0.1], "b": [0.2, 0.4]}, index=[7, 9]))
    assert list(one.index) == [7, 9]
    assert list(one.columns) == ["mean", "std", "epistemic", "noise", "p_critical"]
    for given in ({"a": 0.1, "b": [0.2, 0.4]}, np.array([[0.1, 0.2], [0.1, 0.4]])):
        assert np.allclose(result.predict(given), one)


def awkward(values, seed):
    """Wrong in another way in every tenth of b."""
    kind = int(values["b"] * 10)
    if kind == 1:
        return {}
    if kind == 2:
        return {**gap(values, seed), "more": 1.0}
    if kind == 3:
        raise SystemExit(3)
    if kind == 4:
        return {"gap": math.nan}
    return gap(values, seed)


def test_what_cannot_travel_runs_in_this_process(tmp_path):
    result = sbt.run(campaign="coverage", scenario=scenario_of(guarded()), store=tmp_path / "s", **TINY)
    assert result.frame["status"].eq("ok").all()
    assert result.replay(0).identical


def test_code_that_has_changed_does_not_go_on_with_a_store(tmp_path):
    def run(evaluate, budget):
        return sbt.run(campaign="coverage", scenario=scenario_of(evaluate), store=tmp_path / "s", **{**TINY, "budget": budget})

    def shifted(values, seed):
        return {"gap": gap(values, seed)["gap"] + 0.1}

    before = run(gap, 12).frame
    with pytest.raises(sbt.InputError, match=r"run 0 now gives .*choose another store for what has changed"):
        run(shifted, 24)
    after = run(gap, 24).frame
    assert len(after) == 24
    assert after.iloc[:12]["y.gap"].equals(before["y.gap"])


def test_runs_that_go_wrong_are_rows_with_reasons(tmp_path):
    keys = {**TINY, "budget": 40, "initial": 40, "report": True}
    result = sbt.run(campaign="coverage", scenario=scenario_of(awkward), store=tmp_path / "s", **keys)
    frame = result.frame
    wrong = frame[frame["status"] != "ok"]
    assert len(wrong) > 4
    assert (wrong["reason"] != "").all()
    assert wrong["critical"].isna().all()
    assert wrong["margin"].isna().all()
    reasons = " ".join(wrong["reason"])
    for part in ("but gave none", "declare all of them", "SystemExit", "must be finite"):
        assert part in reasons
    assert frame.loc[frame["status"] == "ok", "critical"].notna().all()
    assert result.finished
    assert (tmp_path / "s" / "report.html").is_file()


OWN = '''
import numpy as np
import sbt
from sbt.campaigns import PlainConclusion, Settings, evenly, BatchStage

def search(settings: Settings):
    """A search of one's own."""
    return sbt.Campaign((BatchStage("mine", settings, evenly),), lambda log: (PlainConclusion({"found": len(log.history)}), None))

KIND = sbt.CampaignKind("a search of one's own", search, adaptive=False)

class Flat:
    def fit(self, u, y, rng):
        return lambda v: sbt.Prediction.gaussian(np.full(len(v), y.mean()), np.full(len(v), y.std() + 1e-3))
'''


def test_a_campaign_of_ones_own_in_three_ways(tmp_path, monkeypatch):
    (tmp_path / "own_search.py").write_text(OWN)
    info = tmp_path / "own_search-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: own_search\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[sbt.campaigns]\nown_search = own_search:KIND\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    plugins._entries.cache_clear()
    try:
        kind = plugins.load("campaigns", "own_search.py:KIND")
        ways = {"object": kind, "recipe": kind.recipe, "file": "own_search.py:KIND", "entry": "own_search"}
        found = {way: sbt.run(campaign=each, scenario=scenario_of(), store=way, **TINY) for way, each in ways.items()}
        assert sbt.list("campaigns")["own_search"] == "a search of one's own"
    finally:
        plugins._entries.cache_clear()
    assert {result.conclusion.values["found"] for result in found.values()} == {24}
    for way in ("file", "entry"):
        assert found[way].frame["x.a"].equals(found["object"].frame["x.a"])
    (tmp_path / "own_search.py").unlink()
    for way in ("object", "file", "entry"):
        result = sbt.open(way)
        assert isinstance(result.conclusion, PlainConclusion)
        assert result.sentences() == ["found: 24."]
        assert result.report().is_file()


def test_a_result_stays_where_it_is_and_home_is_home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    made = sbt.run(campaign="coverage", scenario=scenario_of(), store="runs/a", **TINY)
    opened = sbt.open("runs/a")
    (tmp_path / "sub").mkdir()
    monkeypatch.chdir(tmp_path / "sub")
    assert len(made.frame) == len(opened.frame) == 24
    there = sbt.run(campaign="coverage", scenario=scenario_of(), store="~/b", **TINY)
    assert there.store == tmp_path / "home" / "b"


def test_a_campaign_that_is_run_again_keeps_what_it_took(tmp_path):
    first, again = (sbt.run(campaign="coverage", scenario=scenario_of(), store=tmp_path / "s", **TINY).summary for _ in range(2))
    assert first["seconds"]["simulate"] > 0
    assert again["seconds"] == first["seconds"]


def test_a_store_opens_without_its_metamodel(tmp_path):
    (tmp_path / "flat.py").write_text(OWN)
    flat = plugins.load("metamodels", str(tmp_path / "flat.py:Flat"))
    sbt.run(campaign="boundary", scenario=scenario_of(), metamodel=flat, store=tmp_path / "s", **TINY)
    result = sbt.open(tmp_path / "s")
    assert result.conclusion.critical_fraction is not None
    result.plot.runs()
    assert result.report().is_file()
    with pytest.raises(sbt.InputError, match="was defined in Python and must be given again: metamodel=Flat"):
        result.predict({"a": 0.1, "b": 0.2})
    assert len(sbt.open(tmp_path / "s", metamodel=flat).predict({"a": 0.1, "b": 0.2})) == 1
    assert sbt.open(tmp_path / "s", scenario=scenario_of()).replay(3).identical


@pytest.mark.parametrize("name", ["coverage", pytest.param("boundary", marks=pytest.mark.slow),
                                  pytest.param("falsification", marks=pytest.mark.slow),
                                  pytest.param("estimation", marks=pytest.mark.slow)])  # fmt: skip
def test_built_in_campaigns_pass_the_check(name):
    sbt.testing.check_campaign(plugins.load("campaigns", name))


def test_the_check_finds_campaigns_that_remember_or_say_nothing():
    calls = []

    class Remembering(sbt.campaigns.BatchStage):
        def propose(self, log):
            calls.append(log)
            rng = np.random.Generator(np.random.PCG64(len(calls)))
            space = self.settings.scenario.space
            rows = space.from_unit(rng.random((12, space.dimension)))
            return sbt.Batch(tuple(sbt.PlannedRun("mine", sbt.campaigns.named_inputs(self.settings.scenario, x)) for x in rows))

    def remembering(settings):
        stage = Remembering("mine", settings, sbt.campaigns.evenly)
        return sbt.Campaign((stage,), lambda log: (PlainConclusion({}), None))

    with pytest.raises(sbt.testing.ContractError, match="the same seed must give the same runs"):
        sbt.testing.check_campaign(sbt.CampaignKind("", remembering, adaptive=False))

    def silent(settings):
        stage = sbt.campaigns.BatchStage("mine", settings, sbt.campaigns.evenly)
        return sbt.Campaign((stage,), lambda log: (object(), None))

    told = "a campaign must run to its end, but raised InputError: conclude must return a conclusion"
    with pytest.raises(sbt.testing.ContractError, match=told):
        sbt.testing.check_campaign(sbt.CampaignKind("", silent, adaptive=False))


def test_what_is_done_to_a_frame_stays_in_it(store):
    result = sbt.open(store)
    frame = result.frame
    frame["own"], frame["margin"] = 1, 0.0
    frame["critical"].array[:] = True
    assert result.frame.equals(sbt.open(store).frame)


def test_a_result_of_another_folder_is_the_same(store, tmp_path):
    shutil.copytree(store, tmp_path / "moved")
    assert sbt.open(tmp_path / "moved").frame.equals(sbt.open(store).frame)


def test_a_scenario_whose_constraints_leave_no_corner_is_checked():
    rules = tuple((text, Expression(text)) for text in ("a > 0.7", "a < 0.8"))
    space = ParameterSpace((sbt.Parameter("a", 0, 1),), constraints=rules)
    scenario = sbt.Scenario("cut", space, sbt.Requirement("y", high=0.2), evaluate=lambda values, seed: {"y": values["a"]})
    found = sbt.check(scenario)
    assert not found.ok
    assert [finding.detail for finding in found.findings][:1] == ["0 runs"]

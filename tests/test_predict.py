"""`predict`: the campaign's own belief, kept under a key of its rows; a wrong table is refused with its line."""

from __future__ import annotations

import csv
import json
import re

import numpy as np
import pytest
import torch
from pretended_cuda import pretended_cuda
from typer.testing import CliRunner

import sbt
from sbt.cli import app
from sbt.errors import InputError
from sbt.problem.parameter import Parameter
from sbt.problem.space import ParameterSpace
from sbt.store.database import Store
from sbt.workflows.prediction import MODEL, inputs_from, read_inputs
from sbt.workflows.study import Study

ROWS = "b,note,x.a\n0.5,middle,0.5\n0.1,corner,0.9\n"


def invoke(*args: object):
    return CliRunner().invoke(app, [str(a) for a in args])


@pytest.fixture
def store(campaign, tmp_path):
    campaign(campaign="coverage", budget=40, metamodel={"kind": "gp"}, store=str(tmp_path / "s"))
    (tmp_path / "rows.csv").write_text(ROWS)
    return tmp_path / "s"


def predicted(store) -> dict:
    done = invoke("predict", store, "--inputs", store.parent / "rows.csv", "--json")
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def test_it_is_the_belief_of_the_campaign(store):
    found = predicted(store)
    with Store.read(store) as opened:
        settings, history = Study.from_store(opened).settings, opened.history()
    belief = settings.learner.train(history.finished)(np.array([[0.5, 0.5], [0.9, 0.1]]))  # held-out runs, too
    assert [(row["a"], row["b"]) for row in found["rows"]] == [(0.5, 0.5), (0.9, 0.1)]
    for name, values in {
        "mu": belief.mu, "sigma": belief.sigma, "epistemic": belief.epistemic, "noise": belief.noise,
        "p_critical": belief.probability(settings.scenario.requirement.critical),
    }.items():  # fmt: skip
        assert [row[name] for row in found["rows"]] == values.tolist(), name
    assert found["rows"][0]["p_critical"] > 0.9 > 0.1 > found["rows"][1]["p_critical"]


def test_it_says_how_likely_a_run_gives_no_metric_where_some_gave_none(tmp_path):
    def simulate(values, seed):
        if values["a"] > 0.6:
            raise sbt.RunError("failed", "it does not start")
        return {"g": values["b"] - 0.5}

    inputs = [sbt.Parameter("a", 0, 1), sbt.Parameter("b", 0, 1)]
    scenario = sbt.Scenario("fails", inputs, sbt.Requirement("g", high=0.0), evaluate=simulate, metric_names=("g",))
    found = sbt.run(
        campaign="coverage", scenario=scenario, budget=60, metamodel="gp", store=tmp_path / "s", executor="serial", report=False
    )
    told = found.predict({"a": [0.1, 0.5, 0.7, 0.95], "b": [0.9, 0.1, 0.1, 0.9]})
    assert ((told["p_fails"] > 0.5) == [False, False, True, True]).all()
    assert told["p_fails"].between(0.0, 1.0).all()


def test_it_is_fitted_once_for_the_same_rows(store, campaign):
    first, second = predicted(store), predicted(store)
    assert (first["source"], second["source"]) == ("fitted", "loaded")
    assert first["rows"] == second["rows"]
    campaign(campaign="coverage", budget=60, metamodel={"kind": "gp"}, store=str(store))
    third = predicted(store)
    assert third["source"] == "fitted"
    assert third["learned"] > first["learned"]
    (store / MODEL).write_bytes(b"damaged")
    again = predicted(store)
    assert (again["source"], again["rows"]) == ("fitted", third["rows"])


def test_it_predicts_on_the_device_that_is_asked_for(store, monkeypatch):
    here = predicted(store)["rows"]
    with pretended_cuda(monkeypatch) as marks:
        done = invoke("predict", store, "--inputs", store.parent / "rows.csv", "--json", "--device", "cuda")
    assert marks.marked > 0
    assert json.loads(done.stdout)["source"] == "loaded"
    for a, b in zip(here, json.loads(done.stdout)["rows"], strict=True):
        assert a == pytest.approx(b, rel=1e-6, abs=1e-9)
    if not torch.cuda.is_available():
        refused = invoke("predict", store, "--inputs", store.parent / "rows.csv", "--device", "cuda")
        assert refused.exit_code == 2
        assert "cuda" in refused.output


def test_text_goes_to_stdout_or_to_a_file(store, tmp_path):
    done = invoke("predict", store, "--inputs", tmp_path / "rows.csv")
    lines = list(csv.reader(done.stdout.splitlines()))
    assert lines[0] == ["a", "b", "mu", "sigma", "epistemic", "noise", "p_critical"]
    assert len(lines) == 3
    assert "ignored: note" in done.stderr
    assert invoke("predict", store, "--inputs", tmp_path / "rows.csv", "--output", tmp_path / "out.csv").stdout == ""
    assert (tmp_path / "out.csv").read_text() == done.stdout


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,B\n1,1\n", r"rows.csv:1: every input must be a column, but missing: b"),
        ("a,bb\n1,1\n", r"missing: b (did you mean 'bb'?)"),
        ("a,b\n0.1,0.2\n0.1,x\n", r"rows.csv:3: b must be a number, but got 'x'"),
        ("a,b\n0.1\n", r"rows.csv:2: b must be a number, but got ''"),
        ("a,b\n1.5,0\n", r"rows.csv:2: a must be in [0, 1], but got 1.5"),
        ("a,b\nnan,0\n", r"rows.csv:2: a must be in [0, 1], but got nan"),
        ("a,b,x.a\n0,0,0\n", r"rows.csv:1: a column must stand once, but 'a' stands 2 times"),
        ("", r"rows.csv:1: the first line must name the columns"),
    ],
)
def test_a_wrong_table_is_refused(tmp_path, text, message):
    (tmp_path / "rows.csv").write_text(text)
    space = ParameterSpace((Parameter("a", 0.0, 1.0), Parameter("b", 0.0, 1.0)))
    with pytest.raises(InputError, match=re.escape(message)):
        read_inputs(tmp_path / "rows.csv", space)


def test_all_wrong_cells_are_told_and_what_breaks_constraints(tmp_path):
    rule = ("a < b", lambda v: v["a"] < v["b"])
    space = ParameterSpace((Parameter("a", 0.0, 1.0), Parameter("b", 0.0, 1.0)), constraints=(rule,))
    rows, x = tmp_path / "rows.csv", np.array([[0.1, 7.0], [9.0, 0.5], *[[2.0, 2.0]] * 4])
    rows.write_text("a,b\n0.1,x\n" + "9,9\n" * 4)
    asked = (lambda: read_inputs(rows, space), "rows.csv:2: b must be a number"), (lambda: inputs_from(x, space), "row 0: b")
    for ask, first in asked:
        with pytest.raises(InputError, match=first) as caught:
            ask()
        lines = str(caught.value).splitlines()
        assert (len(lines), lines[-1]) == (6, f"and {4 if first.startswith('rows') else 5} more")
    rows.write_text("a,b\n0.1,0.2\n0.5,0.4\n")
    with pytest.raises(InputError, match=r"rows.csv:3: inputs must satisfy 'a < b', but got a=0.5, b=0.4"):
        read_inputs(rows, space)
    with pytest.raises(InputError, match=r"row 1: inputs must satisfy 'a < b', but got a=0.5, b=0.4"):
        inputs_from({"a": [0.1, 0.5], "b": [0.2, 0.4]}, space)


def test_a_row_of_too_many_fields_is_told(tmp_path):
    space, rows = ParameterSpace((Parameter("a", 0.0, 1.0), Parameter("b", 0.0, 1.0))), tmp_path / "rows.csv"
    rows.write_text("a,b\n0.1,0.2\n0,1,0,8\n")
    with pytest.raises(InputError, match=r"rows.csv:3: a row must have 2 fields, as the first line has, but has 4"):
        read_inputs(rows, space)
    rows.write_text("a;b\n0.1;0.2\n")
    with pytest.raises(InputError, match="missing: a, b; commas separate columns"):
        read_inputs(rows, space)


def test_a_campaign_without_metamodel_says_so(campaign, tmp_path):
    campaign(campaign="coverage", budget=20, metamodel=None, store=str(tmp_path / "s"))
    (tmp_path / "rows.csv").write_text(ROWS)
    done = invoke("predict", tmp_path / "s", "--inputs", tmp_path / "rows.csv")
    assert done.exit_code == 2
    assert "predict needs a campaign with a metamodel" in done.stderr
    keys = {"budget": 20, "metamodel": {"kind": "gp"}, "acquisition": {"kind": "monte_carlo"}}
    campaign(campaign="estimation", store=str(tmp_path / "mc"), **keys)
    done = invoke("predict", tmp_path / "mc", "--inputs", tmp_path / "rows.csv")
    assert "acquisition monte_carlo learns none" in done.stderr


def test_no_cell_of_the_written_table_is_a_formula(tmp_path):
    inputs = [sbt.Parameter("kind", choices=["=1+1", "car"]), sbt.Parameter("a", 0, 1)]
    need, names = sbt.Requirement("y", high=0.2), ("y",)
    scenario = sbt.Scenario("said", inputs, need, evaluate=lambda v, seed: {"y": v["a"]}, metric_names=names)
    keys = {"budget": 20, "metamodel": {"kind": "et", "trees": 5}, "executor": {"kind": "serial"}}
    sbt.run(campaign="coverage", scenario=scenario, store=tmp_path / "s", report=False, **keys)
    (tmp_path / "rows.csv").write_text("kind,a\n=1+1,0.5\n")
    done = invoke("predict", tmp_path / "s", "--inputs", tmp_path / "rows.csv", "--output", tmp_path / "out.csv")
    assert done.exit_code == 0, done.output
    (row,) = csv.DictReader((tmp_path / "out.csv").read_text().splitlines())
    assert (row["kind"], float(row["a"])) == ("'=1+1", 0.5)
    done = invoke("predict", tmp_path / "s", "--inputs", tmp_path / "out.csv", "--output", tmp_path / "again.csv")
    assert done.exit_code == 0, done.output
    assert (tmp_path / "again.csv").read_text().splitlines()[1] == (tmp_path / "out.csv").read_text().splitlines()[1]

"""Inputs may be named as a column of the table of runs."""

from __future__ import annotations

import csv
import io
import json
import re

import numpy as np
import pytest
from typer.testing import CliRunner

import sbt
from sbt.cli import app
from sbt.workflows.prediction import read_inputs


def test_inputs_with_names_of_columns_are_predicted_from_the_table_of_runs(tmp_path):
    """`margin` is the margin of a run there, and `x.margin` the input."""
    names = ("margin", "seed", "status")
    scenario = sbt.Scenario(
        "s", [sbt.Parameter(name, 0, 1) for name in names], sbt.Requirement("y", high=0.5),
        evaluate=lambda x, seed: {"y": x["margin"] + x["seed"]},
    )  # fmt: skip
    found = sbt.run(
        campaign="boundary", scenario=scenario, budget=20, initial=10, batch=10, metamodel={"kind": "gp"}, executor="serial",
        store=tmp_path / "s", report=False,
    )  # fmt: skip
    rows = found.frame
    told = found.predict(rows)
    assert (told["p_critical"] == found.predict({name: rows[f"x.{name}"] for name in names})["p_critical"]).all()
    assert len(found.predict({name: [0.5] for name in names})) == 1
    (tmp_path / "runs.csv").write_text(rows.to_csv(index=False))
    x, others = read_inputs(tmp_path / "runs.csv", scenario.space)
    assert np.allclose(x, rows[[f"x.{name}" for name in names]])
    assert set(names) <= set(others)


@pytest.mark.parametrize("name", ["mu", "sigma", "epistemic", "noise", "p_critical", "p_fails"])
def test_no_prediction_is_written_over_an_input_of_its_name(tmp_path, name):
    """Both columns `mu` held the metamodel's mean; what was written is read back, and inputs of other names keep theirs."""
    scenario = sbt.Scenario(
        "s", [sbt.Parameter("gap", 0, 1), sbt.Parameter(name, 2, 3)], sbt.Requirement("y", high=2.9),
        evaluate=lambda x, seed: {"y": x["gap"] + x[name]},
    )  # fmt: skip
    sbt.run(
        campaign="boundary", scenario=scenario, budget=12, initial=12, metamodel={"kind": "et"}, executor="serial",
        store=tmp_path / "s", report=False,
    )  # fmt: skip
    asked, out, said = tmp_path / "asked.csv", tmp_path / "out.csv", []
    asked.write_text(f"gap,{name}\n0.25,2.5\n0.75,2.125\n")
    for _ in range(2):
        done = CliRunner().invoke(app, ["predict", str(tmp_path / "s"), "--inputs", str(asked), "--output", str(out)])
        assert done.exit_code == 0, done.output
        said.append(out.read_text())
        asked.write_text(said[-1])
    assert said[0] == said[1]
    head, *rows = csv.reader(io.StringIO(said[0]))
    assert head[:3] == ["x.gap", f"x.{name}", "mu"]
    assert len(set(head)) == len(head)
    assert [row[:2] for row in rows] == [["0.25", "2.5"], ["0.75", "2.125"]]
    done = CliRunner().invoke(app, ["predict", str(tmp_path / "s"), "--inputs", str(asked), "--json"])
    (first, _) = json.loads(done.stdout)["rows"]
    assert list(first) == head
    assert (first["x.gap"], first[f"x.{name}"]) == (0.25, 2.5)


def test_an_input_and_a_metric_of_one_name_keep_their_units(tmp_path):
    """Inputs called `speed`, in km/h, were told in the m/s of the metric `speed`."""
    scenario = sbt.Scenario(
        "s", [sbt.Parameter("speed", 0, 100, "km/h")], sbt.Requirement("speed", low=20.0),
        evaluate=lambda x, seed: {"speed": x["speed"] / 3.6}, metrics={"speed": "m/s"},
    )  # fmt: skip
    found = sbt.run(
        campaign="boundary", scenario=scenario, budget=30, initial=30, metamodel={"kind": "gp"}, executor="serial",
        store=tmp_path / "s", report=False,
    )  # fmt: skip
    said = found.sentences()[0]
    assert "speed ≥ 20 m/s" in said
    assert re.search(r"above 7\d\.?\d* km/h", said), said

"""Inputs may be named as a column of the table of runs."""

from __future__ import annotations

import numpy as np

import sbt
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

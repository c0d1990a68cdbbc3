"""What is told where no input is continuous, and of link runs that fail."""

from __future__ import annotations

from pathlib import Path

import sbt
from sbt.campaigns.linking import LinksTold


def test_a_boundary_of_whole_numbers_says_which_are_critical(tmp_path: Path):
    inputs = [sbt.Parameter("k", 0, 9, kind="integer"), sbt.Parameter("where", choices=["left", "right"])]
    scenario = sbt.Scenario(
        "few", inputs, sbt.Requirement("y", high=0.0),
        evaluate=lambda v, _: {"y": abs(v["k"] - 6.0) - 1.5 + 9.0 * (v["where"] == "left")},
    )  # fmt: skip
    result = sbt.run(
        campaign="boundary", scenario=scenario, budget=16, initial=8, seed=1, executor="serial", store=tmp_path / "s",
        report=False, metamodel={"kind": "gp"},
    )  # fmt: skip
    found = result.conclusion.critical_combinations
    assert (found.count, found.combinations) == (3, 20)
    assert dict(found.values) == {"k": (5.0, 6.0, 7.0), "where": ("right",)}
    assert sbt.open(result.store).conclusion.critical_combinations == found
    assert any(told.startswith("By the metamodel 3 of 20 combinations are critical: k ") for told in result.sentences())


def test_link_runs_that_fail_refute_nothing():
    assert LinksTold(2, 0, 0, 2).sentence().endswith(": 0 were critical, 2 gave no metric and tell nothing.")
    assert "no metric" not in LinksTold(2, 0, 0).sentence()

"""Runs again: none where equal inputs give equal metrics but to test for noise, and some before a store goes on."""

from __future__ import annotations

import pytest

import sbt


def _square(values, seed):
    return {"m": 1 + values["a"] + values["b"]}


def _discrete(values, seed):
    return {"m": values["n"] + values["k"] - 4 + {"a": 0, "b": 3}[values["c"]]}


@pytest.mark.parametrize("campaign", ["falsification", "boundary", "estimation"])
def test_a_deterministic_simulator_runs_no_inputs_twice_but_to_test_for_noise(tmp_path, campaign):
    """All of the search is drawn to one corner of the box."""
    inputs = [sbt.Parameter("a", 0, 1), sbt.Parameter("b", 0, 1)]
    scenario = sbt.Scenario("corner", inputs, sbt.Requirement("m", high=0.0), evaluate=_square)
    executor = {"kind": "serial"}
    frame = sbt.run(campaign=campaign, scenario=scenario, budget=60, seed=1, executor=executor, store=tmp_path / "s").frame
    again = frame[frame.duplicated(["x.a", "x.b"])]
    assert set(again["stage"]) <= {"repeat"}
    assert len(again) <= 2


def test_a_boundary_of_all_combinations_is_a_count(tmp_path):
    whole = [sbt.Parameter(name, 1, most, kind="integer") for name, most in (("n", 6), ("k", 4))]
    inputs = [*whole, sbt.Parameter("c", choices=["a", "b"])]
    scenario = sbt.Scenario("disc", inputs, sbt.Requirement("m", high=0.0), evaluate=_discrete)
    executor = {"kind": "serial"}
    result = sbt.run(campaign="boundary", scenario=scenario, budget=60, seed=1, executor=executor, store=tmp_path / "s")
    assert result.conclusion.critical_fraction == pytest.approx(6 / 48)
    assert result.sentences()[0].startswith("6 of all 48 combinations of the inputs of disc are critical (m ≤ 0), 12.5\xa0%")


STUDY = """
import sbt

def _gap(values, seed):
    if values["a"] > LIMIT:
        raise sbt.RunError("invalid", "no place to start")
    return {"gap": values["a"]}

SCENARIO = sbt.Scenario("study", [sbt.Parameter("a", 0, 1)], sbt.Requirement("gap", high=0.1), evaluate=_gap)
"""


def test_a_store_does_not_go_on_where_code_changes_what_is_invalid(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    study = tmp_path / "study.py"
    study.write_text(STUDY.replace("LIMIT", "0.6"))
    common = {"campaign": "coverage", "scenario": f"{study}:SCENARIO", "executor": {"kind": "serial"}, "store": tmp_path / "s"}
    sbt.run(budget=10, **common)
    sbt.run(budget=12, **common)
    study.write_text(STUDY.replace("LIMIT", "2.0"))
    with pytest.raises(sbt.InputError, match=r"must give the runs .* not no place to start"):
        sbt.run(budget=14, **common)

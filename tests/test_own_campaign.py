"""What a campaign of somebody's own proposes, returns and raises is checked, and told as its own."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

import sbt

SCENARIO = sbt.Scenario(
    "gap", [sbt.Parameter("gap", 5, 60, "m"), sbt.Parameter("kind", choices=["car", "truck"])],
    sbt.Requirement("m", high=10.0), evaluate=lambda values, seed: {"m": values["gap"]},
)  # fmt: skip
GOOD = {"gap": 30, "kind": "car"}


@dataclass(frozen=True)
class Found:
    runs: int

    def to_dict(self):
        return {"runs": self.runs}

    def sentences(self, facts):
        return [f"{self.runs} runs."]


class Mine:
    name = "mine"

    def __init__(self, inputs, reason="enough"):
        self.inputs, self.reason = inputs, reason

    def stop(self, log):
        return self.reason if log.iterations else None

    def propose(self, log):
        return sbt.Batch(tuple(sbt.PlannedRun("mine", each) for each in self.inputs))


def run(tmp_path, stage, conclude=lambda log: (Found(len(log.history)), None)):
    def recipe(settings):
        return stage if conclude is None else sbt.Campaign((stage,), conclude)

    return sbt.run(campaign=recipe, scenario=SCENARIO, budget=6, store=tmp_path / "s", executor="serial", report=False)


def broken(log):
    return log.nothing


def test_what_it_proposes_is_run(tmp_path):
    result = run(tmp_path, Mine([GOOD, {"gap": np.int64(5), "kind": "truck"}]))
    assert result.frame["x.gap"].tolist() == [30.0, 5.0]
    assert result.conclusion.to_dict() == {"runs": 2}


@pytest.mark.parametrize(("inputs", "said"), [
    ({"gap": 1000, "kind": "car"}, r"gap in \[5, 60\] m, but proposed 1000"),
    ({"gap": float("nan"), "kind": "car"}, "but proposed nan"),
    ({"gap": "30", "kind": "car"}, "input gap must be a number, but got '30'"),
    ({"gap": 30, "kind": "bus"}, "input kind must be one of car, truck, but got 'bus'"),
    ({"gap": 30}, r"the scenario's inputs \(gap, kind\), but proposed gap"),
    ({**GOOD, "z": 1}, "but proposed gap, kind, z"),
    ([30, "car"], "but proposed PlannedRun"),
])  # fmt: skip
def test_runs_that_are_none_of_the_scenario_are_refused(inputs, said, tmp_path):
    with pytest.raises(sbt.InputError, match=f"stage mine must propose runs of .*{said}|{said}"):
        run(tmp_path, Mine([inputs]))


@pytest.mark.parametrize(("conclude", "said"), [
    (lambda log: None, "conclude must return a conclusion .* but returned None"),
    (lambda log: ({"runs": 1}, None), r"but returned the conclusion \{'runs': 1\}"),
    (broken, "conclude must return a conclusion .* but raised AttributeError.*nothing.*test_own_campaign.py"),
    (None, "a campaign's recipe must return a Campaign, but returned"),
])  # fmt: skip
def test_what_is_no_conclusion_is_refused(conclude, said, tmp_path):
    with pytest.raises(sbt.SbtError, match=said):
        run(tmp_path, Mine([GOOD]), conclude)


@pytest.mark.parametrize(("value", "said"), [
    (np.int64(3), r"found.n is np.int64\(3\) \(int64\)"), ([1, math.nan], r"found.n\[1\] is nan \(float\)"),
    ({1: 2}, r"a key of found.n is 1 \(int\)"),
])  # fmt: skip
def test_what_a_store_cannot_hold_of_a_conclusion_is_told_with_its_place(value, said, tmp_path):
    class Found:
        def to_dict(self):
            return {"found": {"n": value}}

        def sentences(self, facts):
            return []

    with pytest.raises(sbt.InputError, match=rf"to_dict\(\) of a conclusion must return .* but {said}"):
        run(tmp_path, Mine([GOOD]), lambda log: (Found(), None))


def test_a_recipe_that_raises_is_named(tmp_path):
    def mine(settings):
        return 1 / 0

    with pytest.raises(sbt.SbtError, match=r"a campaign's recipe must return a Campaign, but raised ZeroDivisionError.*test_own"):
        sbt.run(campaign=mine, scenario=SCENARIO, budget=6, store=tmp_path / "s", executor="serial", report=False)


def test_a_reason_to_stop_is_text(tmp_path):
    with pytest.raises(sbt.InputError, match="stop must return why it is over, as text, or None, but got 5"):
        run(tmp_path, Mine([GOOD], reason=5))


class Endless(Mine):
    def stop(self, log):
        return None


@pytest.mark.parametrize(("size", "before"), [(3, 6), (4, 4), (7, 0)])
def test_a_stage_that_goes_beyond_the_budget_is_named(size, before, tmp_path):
    said = f"stage mine must stop within the budget of 6 runs, but proposed {size} after {before}$"
    with pytest.raises(sbt.InputError, match=said):
        run(tmp_path, Endless([GOOD] * size))
    if before:
        assert len(sbt.open(tmp_path / "s").frame) == before


def test_confirmations_come_beside_the_budget(tmp_path):
    class Confirming(Mine):
        name = "confirm"

        def stop(self, log):
            return "confirmed" if len(log.history) >= 10 else None

        def propose(self, log):
            return sbt.Batch((sbt.PlannedRun("confirm", GOOD),) * 4)

    def recipe(settings):
        return sbt.Campaign((Mine([GOOD] * 6), Confirming([])), lambda log: (Found(len(log.history)), None))

    result = sbt.run(campaign=recipe, scenario=SCENARIO, budget=6, store=tmp_path / "s", executor="serial", report=False)
    assert result.conclusion.to_dict() == {"runs": 10}

"""Where runs fail, and how much of the rest is critical: small places, chance, and what no run has met."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sbt
from sbt.campaigns.boundary import BoundaryConclusion
from sbt.loop.stages import Facts
from sbt.metamodels.classifier import classifier
from sbt.problem.requirement import Requirement
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream
from tests.sided_runs import sided_runs


def boundary(fails: Callable[[dict[str, float], int], bool], folder: Path, initial: int = 90) -> sbt.Result:
    """Return a boundary, of even runs alone by default: critical within .2 of (.7, .3), share .1257."""

    def run(values: dict[str, float], seed: int) -> dict[str, float]:
        if fails(values, seed):
            raise sbt.RunError("failed", "as told")
        return {"y": math.hypot(values["a"] - 0.7, values["b"] - 0.3) - 0.2}

    inputs = [sbt.Parameter(name, 0.0, 1.0) for name in "ab"]
    return sbt.run(
        campaign="boundary", scenario=sbt.Scenario("disc", inputs, sbt.Requirement("y", high=0.0), evaluate=run), budget=90,
        initial=initial, seed=1, executor="serial", store=folder / "s", report=False, metamodel={"kind": "gp"},
    )  # fmt: skip


def test_a_small_place_where_all_runs_fail_is_no_chance(tmp_path: Path):
    """Runs fail in .0804 of the space, all of it critical; of what gives a metric .0492 is."""
    found = boundary(lambda v, _: math.hypot(v["a"] - 0.7, v["b"] - 0.3) < 0.16, tmp_path)
    assert found.conclusion.failing_fraction == pytest.approx(0.0804, abs=0.03)
    least, most = found.conclusion.critical_range or (0.0, 0.0)
    assert least < 0.0492 < most
    low, high = found.conclusion.failing_range or (0.0, 0.0)
    assert low < 0.0804 < high
    assert any("of the parameter space gives no metric: runs there fail." in told for told in found.sentences())


def test_runs_that_fail_by_chance_fail_nowhere_in_particular(tmp_path: Path):
    found = boundary(lambda _, seed: stream(seed, "unlucky").random() < 0.3, tmp_path)
    told = " ".join(found.sentences())
    assert "of the parameter space gives no metric" not in told
    assert "of all runs give no metric, and nothing shows that the inputs decide which" in told
    assert found.conclusion.critical_range is None


def test_inputs_that_decide_which_runs_fail_are_never_told_to_be_chance(tmp_path: Path):
    """Runs fail by P = 1.2 - 3 r; of 76 near runs 30 failed and of 24 far ones none, and nothing was said to show it."""

    def run(values: dict[str, float], seed: int) -> dict[str, float]:
        far = math.hypot(values["a"] - 0.4, values["b"] - 0.6)
        if stream(seed, "unlucky").random() < 1.2 - 3.0 * far:
            raise sbt.RunError("failed", "as told")
        return {"y": far - 0.3}

    inputs = [sbt.Parameter(name, 0.0, 1.0) for name in "ab"]
    scenario = sbt.Scenario("disc", inputs, sbt.Requirement("y", high=0.0), evaluate=run)
    found = sbt.run(
        campaign="boundary", scenario=scenario, budget=100, seed=2, executor="serial", store=tmp_path / "s", report=False
    )  # fmt: skip
    told = " ".join(found.sentences())
    assert "nothing shows" not in told
    assert "suggest, but do not show" in told or "of the parameter space gives no metric" in told


def test_runs_are_not_lost_where_all_fails_that_would_be_critical(tmp_path: Path):
    found = boundary(lambda v, _: math.hypot(v["a"] - 0.7, v["b"] - 0.3) < 0.2, tmp_path, 20)
    chosen = found.frame[found.frame.stage == "boundary"]
    assert (chosen.status != "ok").mean() < 0.45


def test_where_nothing_critical_was_met_no_least_share_is_told():
    told_range = {"critical_range": (9.54e-89, 0.0176), "fails_by_chance": False}
    found = BoundaryConclusion(1e-90, 0.01, 0.1, None, failing_fraction=0.07, **told_range)
    facts = [Facts(sided_runs(critical, 20), Requirement("y", high=0.0), "m", "s") for critical in (0, 3)]
    none, some = ([told for told in found.sentences(each) if "failing begins" in told] for each in facts)
    (told,) = none
    assert "none was met: of what gives a metric at most 1.76" in told
    assert "between" not in told
    (told,) = some
    chance = " ".join(replace(found, fails_by_chance=True).sentences(facts[1]))
    assert "Should inputs decide it after all: of what gives a metric between" in chance
    assert "Where failing begins" not in chance
    assert "between 0\N{NO-BREAK SPACE}% and 1.76" in told


@pytest.mark.parametrize("d", [1, 3])
def test_a_classifier_tells_places_from_chance(d: int):
    u, rng = SobolSequence(d, 1).points(0, 90), stream(2, "labels")
    new = rng.random((2000, d))
    place = classifier(u, u[:, 0] > 0.08, rng)
    assert 1.0 - place(new).mean() == pytest.approx(0.08, abs=0.02)
    assert place.gain > 8.0
    chance = classifier(u, rng.random(90) > 0.3, rng)
    assert chance.gain < 4.0
    low, high = chance.ends(new)
    assert np.mean((low < 0.7) & (high > 0.7)) > 0.9


def test_the_range_of_what_fails_holds_the_share(tmp_path: Path):
    """A sharp edge between two runs: "24.4 % (24.3 % to 24.3 %)" was told of a quarter."""
    found = boundary(lambda v, _: v["a"] < 0.25, tmp_path).conclusion
    low, high = found.failing_range or (0.0, 0.0)
    assert found.failing_fraction is not None
    assert low <= found.failing_fraction <= high
    assert low < 0.25 < high
    assert high - low >= 2.0 / 90.0

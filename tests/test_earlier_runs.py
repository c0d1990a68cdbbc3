"""A boundary that learns from an earlier campaign beside its own runs, and leaves it out where it misleads."""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sbt
from sbt.errors import StoreError
from sbt.loop.earlier import EarlierRuns
from sbt.problem.combination import CombinedInterval
from sbt.problem.requirement import CriticalInterval
from sbt.store.database import Store
from sbt.workflows.front import findings_in

BELOW = CriticalInterval(high=0.0)


def waves(x: Any) -> Any:
    return np.sin(6 * x[:, 0]) + np.cos(5 * x[:, 1]) * x[:, 2] + 0.8 * x[:, 0] - 0.3


def later(x: Any) -> Any:
    return 0.7 * waves(x) + 0.2 * x[:, 0] ** 2


def scenario(name: str, function: Any, inputs: str = "abc") -> sbt.Scenario:
    def evaluate(values: Any, seed: int) -> dict[str, float]:
        y = float(function(np.array([[values[k] for k in "abc"]]))[0])
        return {"y": y + 0.1 * values.get("d", 0.0)}

    space = [sbt.Parameter(k, 0.0, 1.0) for k in inputs]
    return sbt.Scenario(name, inputs=space, evaluate=evaluate, requirement=sbt.Requirement("y", high=0.0))


def boundary(folder: Path, which: sbt.Scenario | str, **keys: Any) -> sbt.Result:
    given: dict[str, Any] = {"campaign": "boundary", "budget": 20, "seed": 0, "metamodel": "gp", **keys}
    return sbt.run(scenario=which, store=folder, executor="serial", report=False, **given)


def misjudged(result: sbt.Result, function: Any) -> float:
    """Return the share of random points on the wrong side."""
    u = np.random.default_rng(0).random((2000, 3))
    p = result.predict({k: u[:, i] for i, k in enumerate("abc")})["p_critical"].to_numpy()
    return float(((p > 0.5) != (function(u) <= 0.0)).mean())


@pytest.fixture(scope="module")
def old(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("old") / "store"
    boundary(folder, scenario("before", waves), budget=80)
    return folder


def test_another_setup_teaches_a_boundary_of_few_runs(old, tmp_path):
    alone = boundary(tmp_path / "alone", scenario("after", later))
    warm = boundary(tmp_path / "warm", scenario("after", later), warm_start={"store": str(old), "transfer": True})
    assert misjudged(warm, later) < 0.03 < misjudged(alone, later)
    assert len(warm.history) == 20  # old runs are nobody's
    told = " ".join(warm.sentences())
    assert "learned that from 18 runs and 72 earlier" in told
    assert "also learned from 72 runs of the earlier campaign" in told


def test_the_store_remembers_the_earlier_runs(old, tmp_path):
    copy = shutil.copytree(old, tmp_path / "copy")
    warm = {"store": str(copy), "transfer": True}
    whole = boundary(tmp_path / "whole", scenario("after", later), budget=30, warm_start=warm)
    with pytest.raises(StoreError, match=r"warm_start\.store.*nowhere"):
        boundary(tmp_path / "part", scenario("after", later), budget=30, warm_start=warm | {"store": "nowhere"})
    boundary(tmp_path / "part", scenario("after", later), budget=20, initial=10, warm_start=warm)
    shutil.rmtree(copy)
    part = boundary(tmp_path / "part", scenario("after", later), budget=30, initial=10, warm_start=warm)
    assert np.array_equal(part.history.x, whole.history.x)
    assert misjudged(part, later) == misjudged(whole, later)


def test_runs_of_the_same_scenario_are_runs_more(old, tmp_path):
    more = boundary(tmp_path / "more", scenario("before", waves), warm_start={"store": str(old)})
    assert misjudged(more, waves) < 0.01
    before = {row.tobytes() for row in sbt.open(old).history.training.x}
    assert not before & {row.tobytes() for row in more.history.x}  # though it has the same seed
    with Store.read(tmp_path / "more") as store:
        assert store.configuration["earlier"]["other"] is False


@pytest.mark.parametrize("campaign", ["boundary", "estimation"])
def test_runs_of_other_code_are_none_of_the_same_scenario(old, tmp_path, campaign):
    """They would be learned as this scenario's: an estimation had an error of .58 with 500 runs for .003 with 165."""
    with pytest.raises(sbt.InputError, match=r"of what is run now, but its run \d+ now gives .*transfer: true"):
        boundary(tmp_path / "new", scenario("before", later), campaign=campaign, warm_start={"store": str(old)})
    assert not (tmp_path / "new").exists()


def test_an_input_of_the_earlier_campaign_alone_is_integrated_or_fixed(tmp_path):
    boundary(tmp_path / "old", scenario("wet", waves, "abcd"), budget=80)
    for fixed in ({}, {"d": 0.0}):
        warm = {"store": str(tmp_path / "old"), "transfer": True, "fixed": fixed}
        result = boundary(tmp_path / f"new{len(fixed)}", scenario("after", later), warm_start=warm)
        assert misjudged(result, later) < 0.05
    for value in (7.0, math.nan, math.inf):
        warm = {"store": str(tmp_path / "old"), "transfer": True, "fixed": {"d": value}}
        with pytest.raises(sbt.InputError, match=r"a value that the earlier campaign had: d in .* but got"):
            boundary(tmp_path / "beyond", scenario("after", later), warm_start=warm)


def test_a_new_input_is_learned_beside_the_earlier_runs(old, tmp_path):
    warm = {"store": str(old), "transfer": True}
    result = boundary(tmp_path / "new", scenario("wet", later, "abcd"), budget=40, warm_start=warm)
    assert result.conclusion.earlier == 72
    assert np.isfinite(result.predict({k: [0.5] for k in "abcd"})["p_critical"]).all()


def test_what_cannot_teach_is_refused(old, tmp_path):
    elsewhere = sbt.Scenario(
        "elsewhere", inputs=[sbt.Parameter(k, 2.0, 3.0) for k in "abc"], evaluate=lambda values, seed: {"y": values["a"]},
        requirement=sbt.Requirement("y", high=0.0),
    )  # fmt: skip
    cases = [
        (scenario("after", later), {"store": str(old)}, "must have the same scenario, ego and step.*transfer: true"),
        (elsewhere, {"store": str(old), "transfer": True}, "two runs with a metric inside of the ranges"),
        (scenario("after", later), {"store": str(old), "transfer": True, "fixed": {"a": 0.5}}, "only the earlier campaign has"),
    ]
    for k, (which, warm, message) in enumerate(cases):
        with pytest.raises(sbt.InputError, match=message):
            boundary(tmp_path / str(k), which, warm_start=warm)
    with pytest.raises(sbt.InputError, match="warm_start learns from a coarse campaign"):
        boundary(tmp_path / "fidelity", "cut_in", fidelity={"step_length": [0.05, 0.5]})


def test_check_says_whether_the_earlier_campaign_can_teach(tmp_path):
    config = "campaign: boundary\nscenario: following\nwarm_start: {store: %s}\n"
    boundary(tmp_path / "before", "following", budget=10, initial=10)
    for store, ok in (("before", True), ("nowhere", False)):
        (tmp_path / "config.yaml").write_text(config % (tmp_path / store))
        first = next(findings_in(tmp_path / "config.yaml", seed=0, isolation="auto"))
        assert ("earlier campaign can teach" in first.rule, first.ok) == (True, ok)


def test_earlier_runs_that_mislead_are_left_out():
    rng = np.random.default_rng(0)
    u, v = rng.random((60, 3)), rng.random((300, 3))
    ring = np.abs(np.linalg.norm(u - 0.5, axis=1) - 0.35) - 0.06
    for other, y, helps in ((True, ring, False), (False, ring, True), (True, later(u), True)):
        earlier = EarlierRuns(v, waves(v), other)
        assert earlier.helps(earlier.own(u), y, BELOW, np.random.default_rng(1)) is helps


def test_a_combination_learns_each_metric_from_the_earlier_runs_that_have_it():
    rng, both = np.random.default_rng(0), CombinedInterval(how="any", parts=(BELOW, BELOW))
    u, v = rng.random((20, 3)), rng.random((100, 3))
    y = np.column_stack([waves(v), np.where(v[:, 0] > 0.5, np.nan, waves(v) + 0.1)])
    earlier = EarlierRuns.from_json(EarlierRuns(v, y, other=True).to_json())
    assert np.array_equal(earlier.y, y, equal_nan=True)
    assert earlier.helps(earlier.own(u), np.column_stack([later(u), later(u)]), both, rng)


@pytest.mark.parametrize("campaign", ["boundary", "estimation", "falsification"])
def test_an_earlier_campaign_in_other_units_is_refused(campaign: str, tmp_path: Path):
    """Speeds in km/h were taken for m/s, and distances in m for cm."""

    def driving(speed: str, gap: str, folder: str, **keys: Any) -> sbt.Result:
        asked = sbt.Scenario(
            folder, [sbt.Parameter("v", 0.0, 1.0, speed)], sbt.Requirement("gap", high=0.5), metrics={"gap": gap},
            evaluate=lambda values, seed: {"gap": values["v"]},
        )  # fmt: skip
        return sbt.run(
            campaign=campaign, scenario=asked, budget=10, seed=0, store=tmp_path / folder, executor="serial", report=False, **keys
        )

    driving("km/h", "m", "old")
    warm = {"store": str(tmp_path / "old"), "transfer": True}
    driving("km/h", "m", "same", warm_start=warm)
    with pytest.raises(sbt.InputError, match=r"must have the same units, but .*old has v in km/h there, in m/s here$"):
        driving("m/s", "m", "other", warm_start=warm)
    with pytest.raises(sbt.InputError, match=r"must have the same units, but .*old has gap in m there, in cm here$"):
        driving("km/h", "cm", "another", warm_start=warm)

"""A warm start from another setup: the old metric is a trend, dropped where it misleads, and old runs never count."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

import sbt
from sbt.campaigns.transferring import transfer_of
from sbt.config.load import ConfigError
from sbt.estimators.transfer import Trend, trended
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.warp import Warp

BETA, LATER = 3.0, 3.2


def scenario(name: str, beta: float, *, sign: float = 1.0, extra: tuple[sbt.Parameter, ...] = ()) -> sbt.Scenario:
    """Return a straight edge at a distance beta, beside which the metric bends."""

    def evaluate(values: Any, seed: int) -> dict[str, float]:
        along = sign * (values["a"] + values["b"]) / np.sqrt(2.0)
        return {"y": float((beta - along) * (1.0 + 0.1 * values["a"] ** 2)) + 0.3 * values.get("wet", 0.0)}

    inputs = [sbt.Parameter(name, -8, 8, "", sbt.Normal(0.0, 1.0)) for name in ("a", "b")]
    return sbt.Scenario(name, inputs=[*inputs, *extra], evaluate=evaluate, requirement=sbt.Requirement("y", high=0.0))


def run(folder: Path, which: sbt.Scenario, **keys: Any) -> sbt.Result:
    given: dict[str, Any] = {"campaign": "estimation", "budget": 200, "seed": 3, **keys}
    return sbt.run(scenario=which, store=folder, executor="serial", report=False, **given)


@pytest.fixture(scope="module")
def old(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("old") / "store"
    run(folder, scenario("before", BETA), campaign="coverage", budget=100)
    return folder


@pytest.mark.slow
def test_another_version_needs_few_runs_and_none_of_the_old_ones(old, tmp_path):
    warm = run(tmp_path / "warm", scenario("after", LATER), warm_start={"store": str(old), "transfer": True})
    assert warm.conclusion.low <= norm.sf(LATER) <= warm.conclusion.high
    assert (warm.summary["stopped"], warm.summary["runs"] <= 80) == ("cov", True)  # from scratch 104 at least; three repeats
    assert set(warm.frame["stage"]) <= {"learn", "estimation", "hunt", "repeat"}  # no even start
    assert warm.conclusion.earlier.correlations["y"] > 0.95
    from_old = {"store": str(old), "transfer": True}
    mirrored = run(tmp_path / "m", scenario("mirrored", LATER, sign=-1.0), warm_start=from_old, budget=60)
    assert mirrored.conclusion.earlier.correlations["y"] < 0.0
    assert any("rank correlation of -" in said for said in mirrored.sentences())
    assert warm.conclusion.undetected_mass_bound <= 0.19  # 15 draws from the inputs' distribution before it may end


def test_a_critical_interval_with_two_ends_may_be_transferred(old, tmp_path):
    """Before the first run there is no value that could stand for none."""
    which = scenario("after", LATER)
    need = sbt.Requirement("y", low=-50.0, high=0.0)
    which = sbt.Scenario("after", inputs=which.space.parameters, evaluate=which.evaluate, requirement=need)
    found = run(tmp_path / "two", which, warm_start={"store": str(old), "transfer": True}, budget=30)
    assert found.history.ok.all()


def test_a_gate_searches_for_what_the_earlier_setup_did_not_have(old, tmp_path):
    warm = {"store": str(old), "transfer": True}
    asked = run(tmp_path / "gate", scenario("after", LATER), warm_start=warm, budget=30, gate={"probability": 0.01})
    assert asked.frame.stage.iloc[0] == "initial"


def test_a_trend_that_misleads_is_dropped():
    rng = np.random.default_rng(1)
    z = rng.standard_normal((30, 2))
    useless = Trend(Warp(0.0, 1.0), lambda points: np.sin(9.0 * points[:, 0]))
    useful = Trend(Warp(0.0, 1.0), lambda points: np.sin(9.0 * points[:, 0]) + points[:, 1])
    t = np.sin(9.0 * z[:, 0]) + 0.9 * z[:, 1]
    assert trended(GaussianProcess(), useless, z / 10 + 0.5, z, z[:, 1], rng) is None
    belief = trended(GaussianProcess(), useful, z / 10 + 0.5, z, t, rng)
    assert belief is not None
    new = rng.standard_normal((200, 2))
    off = belief(new / 10 + 0.5, new).mu - np.sin(9.0 * new[:, 0]) - 0.9 * new[:, 1]
    assert np.sqrt((off**2).mean()) < 0.1


def test_an_input_that_is_gone_is_integrated_or_fixed(tmp_path):
    wet, kind = sbt.Parameter("wet", 0, 1, ""), sbt.Parameter("kind", choices=("car", "truck"))
    before = scenario("before", BETA, extra=(wet,))
    runs = run(tmp_path / "old", before, campaign="coverage", budget=150).history
    after = scenario("after", BETA, extra=(kind,))  # and one that is new
    z = np.array([[1.5, 1.5, 0.5], [0.0, 2.0, -0.5], [-1.0, 1.0, 0.0]])
    truth = (BETA - (z[:, 0] + z[:, 1]) / np.sqrt(2.0)) * (1.0 + 0.1 * z[:, 0] ** 2)
    for fixed, more in (({}, 0.15), ({"wet": 1.0}, 0.3)):
        (trend,) = transfer_of(before, runs, after, GaussianProcess(), 1, fixed).trends
        assert trend.mean(z) == pytest.approx(trend.warp.values(truth + more), abs=0.03)
    with pytest.raises(sbt.InputError, match=r"only the earlier campaign has \(wet\), but got 'wett'.*did you mean 'wet'"):
        transfer_of(before, runs, after, GaussianProcess(), 1, {"wett": 0.0})


@pytest.mark.parametrize("kind", ["distance", pytest.param("count", marks=pytest.mark.slow)])
def test_metrics_that_end_or_come_in_steps_are_learned_as_ever(tmp_path, kind):
    """As a trend, a distance of 0 in every collision made half of all that is critical uncritical: 3 of 7 intervals missed."""
    told = {"distance": lambda y: max(y, 0.0), "count": lambda y: np.clip(np.ceil(3.0 * y), 0, 9)}

    def ending(name: str, beta: float) -> sbt.Scenario:
        plain = scenario(name, beta)
        return sbt.Scenario(
            name, inputs=plain.space.parameters, requirement=sbt.Requirement("y", high=0.0),
            evaluate=lambda values, seed: {"y": float(told[kind](plain.evaluate(values, seed)["y"]))},
        )  # fmt: skip

    run(tmp_path / "old", ending("before", 2.0), stop={"cov": None}, budget=120)
    warm = {"store": str(tmp_path / "old"), "transfer": True}
    found = run(tmp_path / "new", ending("after", 2.2), warm_start=warm, stop={"cov": None}, budget=70).conclusion
    assert found.low <= norm.sf(2.2) <= found.high
    assert found.probability == pytest.approx(norm.sf(2.2), rel=0.1 if kind == "distance" else 0.3)
    assert found.high - found.low < (0.5 if kind == "distance" else 1.2) * norm.sf(2.2)


def test_what_cannot_be_transferred_is_refused(old, tmp_path):
    with pytest.raises(sbt.InputError, match="an input in common"):
        run(tmp_path / "a", "testbed:linear_d2", warm_start={"store": str(old), "transfer": True})
    with pytest.raises(sbt.InputError, match=r"same scenario.*transfer: true"):
        run(tmp_path / "b", scenario("after", LATER), warm_start={"store": str(old)})
    with pytest.raises(ConfigError, match=r"fixed: inputs are fixed with transfer: true only"):
        run(tmp_path / "c", scenario("after", LATER), warm_start={"store": str(old), "fixed": {"wet": 0.0}})
    measured = sbt.Scenario(
        "other", inputs=list(scenario("x", 1.0).space.parameters), evaluate=lambda values, seed: {"z": 0.0},
        requirement=sbt.Requirement("z", high=0.0),
    )  # fmt: skip
    with pytest.raises(sbt.InputError, match="must have measured z, but only measured y"):
        run(tmp_path / "d", measured, warm_start={"store": str(old), "transfer": True})


def test_a_falsification_begins_with_the_old_failures(old, tmp_path):
    warm = {"store": str(old), "transfer": True}
    found = run(tmp_path / "f", scenario("after", LATER), campaign="falsification", budget=10, warm_start=warm)
    first = found.frame[found.frame["stage"] == "transfer"]
    assert len(first) == 5
    assert first["critical"].mean() > 0.5  # old failures with a distance above 3, an edge at 3.2 now
    assert (found.conclusion.earlier.again, found.conclusion.earlier.critical) == (5, first["critical"].sum())
    assert sbt.open(tmp_path / "f", scenario=scenario("after", LATER)).conclusion.earlier == found.conclusion.earlier
    with pytest.raises(ConfigError, match="a campaign falsification does not take it without transfer"):
        run(tmp_path / "g", scenario("after", LATER), campaign="falsification", warm_start={"store": str(old)})

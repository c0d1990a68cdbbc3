"""Metrics of two values, as a collision has: P(critical) by labels, honest where few runs are critical."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import sbt
from sbt.metamodels.automatic import Auto
from sbt.metamodels.base import sample_paths
from sbt.metamodels.expectation_propagation import Hyper, believe, latent
from sbt.metamodels.flags import flag_process
from sbt.metamodels.joint import metamodel_for
from sbt.metamodels.persistence import load, save
from sbt.metamodels.prediction import Prediction
from sbt.problem.arrays import Mask, Points
from sbt.problem.requirement import CriticalInterval
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream

QUICK = Auto(**Auto.PRESETS["quick"])
COLLISION = CriticalInterval(low=1.0)


def corner(u: Points) -> Mask:
    """6 % of the box, by two of its inputs."""
    return (u[:, 0] > 0.7) & (u[:, 2] > 0.8)


def sampled(seed: int, hits: int, n: int = 90) -> Points:
    """Return n random points of which so many lie in the corner."""
    rng = stream(seed, "flag")
    u = rng.random((4000, 3))
    inside = corner(u)
    return np.concatenate([u[inside][:hits], u[~inside][: n - hits]])


def learned(u: Points, y: np.ndarray, critical: CriticalInterval, at: Points, seed: int = 0) -> Prediction:
    return metamodel_for(QUICK, critical).fit(u, y, stream(seed, "fit"))(at)


@pytest.mark.parametrize("hits", [1, 2, 5])
def test_few_critical_runs_leave_it_open_what_lies_between_them(hits: int):
    """By a process of the values P was below .001 on half of what is critical, and 8 to 75 times less wrong than it was."""
    at = stream(0, "at").random((5000, 3))
    true, stated, wrong, loss, base = corner(at), [], [], [], []
    for seed in range(5):
        u = sampled(seed, hits)
        found = learned(u, corner(u).astype(float), COLLISION, at, seed)
        p, (log_p, log_not) = found.probability(COLLISION), found.log_probability(COLLISION)
        stated.append(np.minimum(p, 1.0 - p).mean())
        wrong.append(((p > 0.5) != true).mean())
        loss.append(-np.where(true, log_p, log_not).mean())
        share = (hits + 0.5) / (len(u) + 1.0)
        base.append(-np.where(true, np.log(share), np.log1p(-share)).mean())
    assert np.mean(stated) > 0.25 * np.mean(wrong), "hits are fewer here than 6 % let expect"
    assert np.mean(loss) < np.mean(base)


def test_it_does_not_matter_what_the_two_values_are():
    u, at = sampled(1, 6), stream(1, "at").random((200, 3))
    hit = corner(u)
    expected = learned(u, hit.astype(float), COLLISION, at).probability(COLLISION)
    for low, high, critical in (
        (0.0, 1.0, CriticalInterval(low=0.5)),
        (0.0, 1.0, CriticalInterval(low=1.0, high=1.0)),
        (-3.0, 250.0, CriticalInterval(low=250.0)),
        (1.0, -1.0, CriticalInterval(high=-1.0)),
    ):
        found = learned(u, np.where(hit, high, low), critical, at)
        np.testing.assert_allclose(found.probability(critical), expected, rtol=1e-9, err_msg=str(critical))


@pytest.mark.parametrize("noisy", [False, True])
def test_drawn_sides_are_as_frequent_as_told_and_files_keep_it(tmp_path: Path, noisy: bool):
    u = np.concatenate([sampled(2, 8), sampled(2, 8)[:20]])
    y = corner(u).astype(float)
    y[-1] = 1.0 - y[-1] if noisy else y[-1]
    predict, score = flag_process(COLLISION, u, y, stream(2, "fit"))
    assert (score < 0.0).all()
    at = stream(2, "at").random((50, 3))
    p, paths = predict(at).probability(COLLISION), sample_paths(predict, at, 4000, stream(3, "paths"))
    if noisy:  # paths are of the rate
        sides = CriticalInterval(low=COLLISION.edge).contains(paths)
        assert np.mean(sides != (p > 0.5)) < 0.2
        assert (predict(at).noise > 0.0).all()
    else:
        np.testing.assert_allclose(COLLISION.contains(paths).mean(axis=0), p, atol=0.05)
    save(predict, tmp_path / "flag.sbtmodel")
    np.testing.assert_array_equal(load(tmp_path / "flag.sbtmodel")(at).probability(COLLISION), p)


def test_a_belief_whose_sweeps_end_is_that_of_its_rows():
    """Factor and Gaussians of different sweeps gave variances of 0, and 1e-30 for what nobody knew."""
    u, at = sampled(0, 1), stream(0, "at").random((6, 3))
    hyper, hit = Hyper(np.array([1.77, 4.09, 1.29]), 6.48, -6.01), corner(u)
    covariance = hyper.covariance(u)[0]
    belief = believe(hyper, covariance, np.where(hit, 0.0, -np.inf), np.where(hit, np.inf, 0.0))
    root = np.sqrt(belief.precision)
    np.testing.assert_allclose(belief.lower @ belief.lower.T, np.eye(len(u)) + root[:, None] * covariance * root, atol=1e-9)
    assert latent(at, u, hyper, belief)[1].min() > 1.0


def disc(values: dict[str, float], seed: int) -> dict[str, float]:
    """Return a flag that is 1 in a disc, one that never is, and how far right a run is."""
    at = np.array([values["a"], values["b"]])
    return {"hit": float(np.sum((at - [0.3, 0.6]) ** 2) < 0.03), "never": 0.0, "right": values["a"]}


def run_of_flags(folder: Path, **given: Any) -> sbt.Result:
    """Run a campaign on the disc."""
    inputs = [sbt.Parameter("a", 0.0, 1.0), sbt.Parameter("b", 0.0, 1.0)]
    scenario = sbt.Scenario("disc", inputs, sbt.Requirement("hit", low=0.5), evaluate=disc, metrics=["hit", "never", "right"])
    return sbt.run(**given, scenario=scenario, store=folder, executor="serial", report=False)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_search_that_follows_values_of_a_flag_tells_its_sides(tmp_path: Path, seed: int):
    found = run_of_flags(tmp_path / "s", campaign="falsification", budget=80, seed=seed)
    at = SobolSequence(2, 7).points(0, 1024)
    told = found.predict(at)["p_critical"].clip(1e-12, 1.0 - 1e-12)
    hit = np.array([disc({"a": a, "b": b}, 0)["hit"] for a, b in at])
    share = hit.mean()
    guess = -share * np.log(share) - (1.0 - share) * np.log1p(-share)
    assert -np.mean(hit * np.log(told) + (1.0 - hit) * np.log1p(-told)) < 0.6 * guess  # else two to four times as large


@pytest.mark.parametrize("campaign", ["falsification", "boundary"])
def test_what_no_run_was_may_be_all_the_same(tmp_path: Path, campaign: str):
    single = sbt.Requirement("never", low=0.5)
    found = run_of_flags(tmp_path / "single", campaign=campaign, budget=30, requirement=single)
    inputs = len(np.unique(found.history.finished.x, axis=0))
    at = {"a": [0.1, 0.9], "b": 0.5}
    assert found.predict(at)["p_critical"].tolist() == pytest.approx([1.0 / (inputs + 2.0)] * 2)
    either = {"any": [{"metric": "never", "critical": [0.5, None]}, {"metric": "right", "critical": [0.8, None]}]}
    found = run_of_flags(tmp_path / "any", campaign=campaign, budget=30, requirement=either)
    doubt = 1.0 / (len(np.unique(found.history.finished.x, axis=0)) + 2.0)
    told = found.predict(at)
    assert told["p_critical.never"].tolist() == pytest.approx([doubt] * 2)
    assert told["p_critical"].tolist() == pytest.approx([doubt, 1.0], abs=1e-3)
    drawn = found.fitted.predict(np.array([[0.1, 0.5]]))  # by figures and reports, without held-out runs
    doubt = 1.0 / (len(np.unique(found.history.training.x, axis=0)) + 2.0)
    assert drawn.probability(found.scenario.requirement.critical) == pytest.approx(doubt, abs=1e-3)


def test_exported_points_of_a_flag_are_where_it_is_told_to_be_as_likely_as_not(tmp_path: Path):
    found = run_of_flags(tmp_path / "s", campaign="falsification", budget=80, seed=1)
    points = pd.read_csv(found.export("boundary"))
    told = found.predict(points[[f"x.{name}" if f"x.{name}" in points else name for name in "ab"]])["p_critical"]
    assert len(told) > 10
    assert told.tolist() == pytest.approx([0.5] * len(told), abs=0.01)


def test_what_earlier_runs_taught_is_told_where_own_ones_have_one_value(tmp_path: Path):
    run_of_flags(tmp_path / "before", campaign="boundary", budget=60, seed=1)
    few = {"campaign": "boundary", "budget": 8, "initial": 8, "validation": {"share": 0.0}}
    found = run_of_flags(tmp_path / "s", seed=5, warm_start={"store": str(tmp_path / "before")}, **few)
    assert not found.frame["critical"].any()
    p = found.predict({"a": [0.3, 0.9], "b": [0.6, 0.1]})["p_critical"]
    assert p[0] > 0.9
    assert p[1] < 0.05  # and not 1 / 10 at both


def test_of_combinations_that_all_were_run_repeats_count(tmp_path: Path):
    inputs = [sbt.Parameter("k", 0, 2, kind="integer"), sbt.Parameter("kind", choices=["car", "truck"])]
    scenario = sbt.Scenario("none", inputs, sbt.Requirement("hit", low=0.5), evaluate=lambda values, seed: {"hit": 0.0})
    given: dict[str, Any] = {"metamodel": {"kind": "gp"}, "executor": "serial", "report": False}
    found = sbt.run(campaign="coverage", scenario=scenario, budget=30, store=tmp_path / "s", **given)
    runs = found.history.finished
    assert len(np.unique(runs.x, axis=0)) == 6
    assert found.predict({"k": 1, "kind": "car"})["p_critical"].tolist() == pytest.approx([1.0 / (len(runs) + 2.0)])

"""Estimations where constraints leave little of the box: pools hold what is admissible, and weigh it by what they hold of it."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import norm

import sbt
from sbt.campaigns import pools
from sbt.campaigns.pools import Frame, draw_batch, draw_pool, fit_proposal
from sbt.campaigns.records import EstimationProposal
from sbt.estimators.importance import SHARES
from sbt.estimators.intervals import CountedBatch
from sbt.estimators.mixture import wide_scales
from sbt.estimators.subspace import Subspace
from sbt.seeds import stream
from sbt.store.database import Store

LARGEST, EDGE = 0.2, 0.11
TRUTH = ((LARGEST - EDGE) / LARGEST) ** 3
"""P(c >= EDGE) of three uniform inputs of which the sum is at most LARGEST: a corner of a simplex that is like the whole."""


def simplex(largest: float = LARGEST) -> sbt.ParameterSpace:
    """Return three uniform inputs, of which largest^3 / 6 are admissible."""
    rule = (f"a + b + c <= {largest}", lambda v: v["a"] + v["b"] + v["c"] <= largest)
    return sbt.ParameterSpace(tuple(sbt.Parameter(name, 0.0, 1.0) for name in "abc"), constraints=(rule,))


def sharp(z):
    """Nearly certain of what is critical."""
    beyond = (ndtr(z[:, 2]) - EDGE) / 1e-3
    return norm.logcdf(beyond), norm.logcdf(-beyond)


def wrong(z):
    """Takes the other side for critical."""
    pi = np.clip(0.9 * (ndtr(z[:, 0]) > 0.02) + 0.02, 0.0, 1.0)
    return np.log(pi), np.log1p(-pi)


def critical_scores(space: sbt.ParameterSpace, n: int) -> np.ndarray:
    x = space.sample(n, stream(1, "hits"))
    return space.to_normal(x[x[:, 2] >= EDGE])


def test_a_pool_within_constraints_is_as_precise_as_one_without():
    """Of 10,000 points next to none were admissible: the prediction of a perfect metamodel had an error of a quarter."""
    space, frame, plans = simplex(), Frame(np.ones(3)), []
    for k, hits in enumerate((critical_scores(space, 300), None)):
        rng = stream(2, "pool", k)
        proposal = fit_proposal(space, frame, sharp, hits, SHARES, rng)
        plans.append(draw_pool(space, frame, proposal, SHARES, rng).plan)
    assert plans[0].prior == pytest.approx(TRUTH, rel=0.05)
    for plan in plans:
        assert plan.weight.sum() == pytest.approx(1.0, abs=0.08), "the density is normalised within the constraints"
        nominal = plan.nominal_probability
        assert 1.0 / (nominal**2).sum() > 300, "independent draws from it are of different points"


def test_estimates_within_constraints_are_unbiased_whatever_the_metamodel_predicts():
    space, frame, rng = simplex(), Frame(np.ones(3)), stream(3, "unbiased")
    proposal = fit_proposal(space, frame, wrong, critical_scores(space, 200), SHARES, rng)
    values = []
    for _ in range(120):
        pool = draw_pool(space, frame, proposal, SHARES, rng, learned=10_000, draws=3)
        runs, kept = draw_batch(space, pool, 10, rng, counts=True)
        drawn, c = kept.counted, np.array([run.inputs["c"] >= EDGE for run in runs], dtype=float)
        assert drawn is not None
        assert all(sum(run.inputs.values()) <= LARGEST for run in runs)
        coefficient, control = np.array(drawn.coefficient), np.array(drawn.control_variate)
        values.append(CountedBatch(pool.plan.prior, 0.0, 0.0, coefficient, control, c).value)
    assert np.mean(values) == pytest.approx(TRUTH, abs=4.0 * np.std(values) / math.sqrt(len(values)) + 0.005 * TRUTH)
    assert np.std(values) < 3.0 * math.sqrt(TRUTH * (1.0 - TRUTH) / 10.0), "no worse than three times crude Monte Carlo"


def test_in_a_subspace_the_other_coordinates_say_what_is_admissible():
    inputs = tuple(sbt.Parameter(f"x{k}", -8.0, 8.0, "", sbt.Normal(0, 1)) for k in range(5))
    rule = ("x0 + x1 >= 3", lambda v: v["x0"] + v["x1"] >= 3.0)
    space = sbt.ParameterSpace(inputs, constraints=(rule,))
    subspace = Subspace(np.eye(5)[[1, 2]])
    frame = Frame(wide_scales(np.zeros(2)), lift=subspace.lift, reduce=subspace.reduce)

    def belief(v):
        return norm.logcdf((v[:, 1] - 1.0) / 0.1), norm.logcdf((1.0 - v[:, 1]) / 0.1)

    hits = stream(4, "hits").standard_normal((100, 2)) + np.array([1.7, 1.5])
    plans = []
    for k in range(3):
        rng = stream(4, "subspace", k)
        plans.append(draw_pool(space, frame, fit_proposal(space, frame, belief, hits, SHARES, rng), SHARES, rng).plan)
    truth = norm.sf(1.0 / math.sqrt(1.01))  # x2 is independent of the constraint
    assert np.mean([plan.weight.sum() for plan in plans]) == pytest.approx(1.0, abs=0.05)
    assert np.mean([plan.prior for plan in plans]) == pytest.approx(truth, rel=0.06)
    assert all(1.0 / (plan.nominal_probability**2).sum() > 500 for plan in plans)


def test_scores_within_constraints_follow_the_inputs_distribution():
    space = simplex()
    x = space.from_normal(space.sample_scores(2000, stream(5, "scores")))
    assert x.shape == (2000, 3)
    assert space.feasible(x).all()
    assert x.mean(axis=0) == pytest.approx(np.full(3, LARGEST / 4.0), rel=0.06)
    free = sbt.ParameterSpace(space.parameters)
    same = free.sample_scores(5, stream(6, "scores")), stream(6, "scores").standard_normal((5, 3))
    assert np.array_equal(*same)


def scenario() -> sbt.Scenario:
    return sbt.Scenario(
        "corner", simplex(0.3), sbt.Requirement("y", high=0.0), metrics=["y"], evaluate=lambda v, seed: {"y": 0.165 - v["c"]}
    )


def test_what_no_run_has_met_is_bounded_by_different_draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A point of a pool that was drawn four times is one draw: the bound of 59 draws was stated of 34."""
    monkeypatch.setattr(pools, "_TRIES", 1e-2, raising=False)  # few admissible points in a pool
    result = sbt.run(
        campaign="estimation", scenario=scenario(), budget=60, seed=1, executor="serial", store=tmp_path / "s", report=False,
        stop={"cov": None},
    )  # fmt: skip
    assert result.conclusion.low <= 0.45**3 <= result.conclusion.high
    runs, different, every = result.history, 0, 0
    with Store.read(tmp_path / "s") as store:
        for batch in store.iterations():
            nominal = batch.read(EstimationProposal).nominal
            if nominal is not None:
                drawn = np.isin(runs.stage, ("estimation", "learn")) & (runs.iteration == batch.number)
                x = runs.x[drawn][: len(nominal.pi)]
                different, every = different + len(np.unique(x, axis=0)), every + len(x)
    assert result.conclusion.undetected_mass_bound == pytest.approx(1.0 - 0.05 ** (1.0 / different))
    assert different < every, "else it tells nothing"

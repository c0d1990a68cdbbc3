"""What is known of runs with a value that the metric ends with: the rest of a smooth function lies beyond it."""

from __future__ import annotations

import numpy as np
import pytest

from sbt.metamodels.automatic import Auto
from sbt.metamodels.base import sketched
from sbt.metamodels.censored import Limit, beyond
from sbt.metamodels.extra_trees import ExtraTrees
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.gp_algebra import Hyperparameters, cholesky, solve_right
from sbt.metamodels.gp_predictor import GaussianProcessPredictor
from sbt.metamodels.saturation import Opened
from sbt.problem.requirement import CriticalInterval

CRITICAL = CriticalInterval(high=0.0)


def process(u, y, noise=1e-6):
    """A process of known hyperparameters."""
    hyper = Hyperparameters(2.5, np.full((1, u.shape[1]), 0.5), np.ones(1), noise)
    factor = cholesky(hyper.covariance(u, u), np.full(len(u), noise))
    alpha = solve_right(factor, (np.asarray(y) / 2.0)[:, None])[:, 0]
    return GaussianProcessPredictor(hyper, u, factor, alpha, 0.0, None, 0.0, 2.0, np.ones(1))


@pytest.mark.parametrize("at_most", [True, False])
@pytest.mark.parametrize("noise", [1e-6, 0.05])
def test_a_process_that_knows_a_limit_is_what_is_left_of_its_draws(at_most: bool, noise: float):
    """Of functions drawn from the process of the other runs, those that keep the limit."""
    sign = 1.0 if at_most else -1.0
    u, asked = np.array([[0.0], [0.2], [0.55], [0.7], [1.0]]), np.array([[0.4], [0.62], [0.85]])
    tied, y = np.array([False, False, True, True, True]), sign * np.array([1.5, 0.8, -1.0, -1.0, -1.0])
    found = beyond(process(u, y, noise), Limit(u[tied], y[tied], np.zeros(3), np.full(3, at_most)))(asked)
    others = process(u[~tied], y[~tied], noise)
    rng = np.random.default_rng(0)
    drawn = others.sample_paths(np.vstack([u[tied], asked]), 400_000, rng)
    measured = drawn[:, :3] + 2.0 * np.sqrt(noise) * rng.standard_normal((len(drawn), 3))
    kept = drawn[(sign * measured <= 0.0).all(axis=1), 3:]
    assert len(kept) > 2000
    assert found.mean[0] == pytest.approx(kept.mean(axis=0), abs=0.06)
    assert np.sqrt(found.std[0] ** 2 - found.noise**2) == pytest.approx(kept.std(axis=0), rel=0.1)


def test_it_says_how_sure_it_is():
    """Four inputs, 0 below a bent plane: as many points are on the wrong side as it expects; before, three times as many."""
    wrong, expected, loss = [], [], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        u, at = rng.random((60, 4)), rng.random((4000, 4))

        def height(x):
            return x @ np.array([1.0, 0.7, -0.5, 0.3]) + 0.4 * np.sin(3.0 * x[:, 1]) - 0.8

        p = Opened(Auto(), CRITICAL).fit(u, np.maximum(height(u), 0.0), rng)(at).probability(CRITICAL)
        inside = height(at) <= 0.0
        wrong.append(((p > 0.5) != inside).mean())
        expected.append(np.minimum(p, 1.0 - p).mean())
        loss.append(-np.log(np.where(inside, p, 1.0 - p)).mean())
    assert np.mean(wrong) < 0.03
    assert np.mean(wrong) == pytest.approx(np.mean(expected), rel=0.4)
    assert np.mean(loss) < 0.06


def test_quick_bounds_sketches_and_left_out_rows_know_it_as_well():
    rng = np.random.default_rng(0)
    u, at = rng.random((80, 3)), rng.random((500, 3))
    y = np.maximum(np.linalg.norm(u - 0.5, axis=1) - 0.45, 0.0)
    predictor = Opened(GaussianProcess(nu=2.5, input_noise=False), CRITICAL).fit(u, y, rng)
    p, (low, high) = predictor(at).probability(CRITICAL), predictor.probability_bounds(at, CRITICAL)
    assert (low <= p).all()
    assert (p <= high).all()
    assert high.mean() < 0.9, "it excludes something"
    rough = sketched(predictor, 30)
    assert len(rough.u) < 50
    assert np.abs(rough(at).probability(CRITICAL) - p).mean() < 0.1
    left_out, tied = predictor.leave_one_out(u, y), y == 0.0
    assert (left_out.probability(CRITICAL)[tied] > 0.5).mean() > 0.8
    assert (left_out.probability(CRITICAL)[~tied] < 0.5).mean() > 0.8
    assert (left_out.std > 0.0).all()


def test_what_cannot_know_a_limit_is_left_as_it_is():
    rng = np.random.default_rng(0)
    u, y = rng.random((20, 2)), rng.random(20)
    limit = Limit(u[:3], y[:3], y[:3], np.full(3, True))
    trees = ExtraTrees().fit(u, y, rng)
    assert beyond(trees, limit) is trees
    known = process(u, y)
    assert beyond(known, None) is known
    assert beyond(known, Limit(u[:1] + 2.0, y[:1], y[:1], np.full(1, True))) is known, "of other rows"
    assert beyond(known, Limit(u[:1], y[:1] + 0.1, y[:1], np.full(1, True))) is known, "another run at the same inputs"


def test_repetitions_that_end_beside_the_limit_keep_their_values():
    """Of a noisy simulator one seed in two collides at .5: the other half was .4 away."""
    u = np.repeat(np.linspace(0.0, 1.0, 11), 4)[:, None]
    y = np.tile([0.0, 0.4, 0.0, 0.4], 11) * (u[:, 0] >= 0.3) + 1e-3 * np.arange(44) * (np.arange(44) % 2)
    predictor = Opened(GaussianProcess(nu=2.5, input_noise=False), CRITICAL).fit(u, y, np.random.default_rng(0))
    assert predictor.row_noise is not None
    assert ((predictor.row_noise > predictor.row_noise.min()) == (y == 0.0)).all()

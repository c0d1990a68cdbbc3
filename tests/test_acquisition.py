"""Acquisitions: the paper's formulas, exact in logs; the public check accepts ours and refuses wrong ones."""

from __future__ import annotations

import numpy as np
import pytest

from sbt.acquisitions import boundary, even, expected_feasibility, importance, is_greedy, straddle, u
from sbt.metamodels.prediction import Prediction
from sbt.problem.requirement import CriticalInterval
from sbt.testing import ContractError, check_acquisition

PREDICTION = Prediction.gaussian(np.linspace(-3, 3, 13), np.ones(13))
CRITICAL = CriticalInterval(-10.0, 0.0)


def test_boundary_is_equation_3():
    expected = 1 - 2 * np.abs(PREDICTION.probability(CRITICAL) - 0.5)
    score = boundary(PREDICTION, CRITICAL, np.zeros(13))
    np.testing.assert_allclose(np.exp(score), expected)
    assert score.argmax() == 6
    assert (score <= 0).all()


def test_boundary_is_finite_where_the_formula_rounds_to_zero():
    score = boundary(Prediction.gaussian([-50.0, 50.0], [1.0, 1.0]), CriticalInterval(high=0.0), np.zeros(2))
    np.testing.assert_allclose(score, score[::-1])
    assert -1300 < score[0] < -1200


def test_importance_is_equation_4():
    log_density = np.linspace(-4, 0, 13)
    expected = PREDICTION.probability(CRITICAL) * np.exp(log_density)
    np.testing.assert_allclose(np.exp(importance(PREDICTION, CRITICAL, log_density)), expected)
    assert importance(PREDICTION, CRITICAL, np.full(13, -np.inf)).max() == -np.inf


def test_u_ranks_as_echards_learning_function():
    """Of Gaussian predictions and one edge the least |mu - z| / sigma comes first."""
    rng = np.random.default_rng(0)
    prediction = Prediction.gaussian(rng.normal(0.0, 3.0, 200), rng.uniform(0.2, 2.0, 200))
    learning = np.abs(prediction.mu - 0.7) / prediction.sigma
    score = u(prediction, CriticalInterval(high=0.7), np.zeros(200))
    np.testing.assert_array_equal(np.argsort(-score), np.argsort(learning))


def test_greedy_ones_say_so():
    found = {f.__name__: is_greedy(f) for f in (even, boundary, importance, u, straddle, expected_feasibility)}
    assert found == {
        "even": False, "boundary": False, "importance": False, "u": True, "straddle": True, "expected_feasibility": True,
    }  # fmt: skip


def test_even_ignores_the_prediction():
    np.testing.assert_array_equal(even(PREDICTION, CRITICAL, np.zeros(13)), np.zeros(13))


@pytest.mark.parametrize(
    ("wrong", "rule"),
    [
        (lambda p, c, d: np.zeros((len(p), 1)), "shape"),
        (lambda p, c, d: np.full(len(p), np.nan), "NaN"),
        (lambda p, c, d: np.full(len(p), np.inf), "< inf"),
        (lambda p, c, d: p.mu - p.mu.mean(), "other points"),
        (lambda p, c, d: p.mu + np.arange(len(p)), "order"),
    ],
)
def test_wrong_acquisitions_are_refused(wrong, rule):
    with pytest.raises(ContractError, match=rule):
        check_acquisition(wrong)

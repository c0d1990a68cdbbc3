"""The yardsticks against scikit-learn, SciPy and values known by hand."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy import integrate, stats
from sklearn import metrics

from sbt.errors import InputError
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.scores import precision_recall, reliability, scores
from sbt.problem.requirement import CriticalInterval

CRITICAL = CriticalInterval(high=0.0)
rng = np.random.default_rng(0)
MU, SIGMA = rng.normal(1.0, 1.5, 500), rng.uniform(0.3, 1.5, 500)
Y = rng.normal(MU, SIGMA)
PREDICTION = Prediction.gaussian(MU, SIGMA)
RESULT = scores(PREDICTION, Y, CRITICAL)


def test_likelihood_and_rmse_are_the_papers():
    density = stats.norm.pdf(Y, MU, SIGMA)
    assert RESULT["likelihood"] == pytest.approx(stats.gmean(density))
    assert RESULT["log_likelihood"] == pytest.approx(np.log(density).mean())
    assert RESULT["log_likelihood_mixture"] == pytest.approx(RESULT["log_likelihood"])
    assert RESULT["log_likelihood_critical"] == pytest.approx(np.log(density)[Y <= 0].mean())
    assert RESULT["rmse"] == pytest.approx(metrics.root_mean_squared_error(Y, MU))
    assert RESULT["rmse_critical"] == pytest.approx(metrics.root_mean_squared_error(Y[Y <= 0], MU[Y <= 0]))


def test_ranking_and_classification_agree_with_scikit_learn():
    p, mask = PREDICTION.probability(CRITICAL), Y <= 0
    assert RESULT["average_precision"] == pytest.approx(metrics.average_precision_score(mask, p))
    assert RESULT["f1"] == pytest.approx(metrics.f1_score(mask, p >= 0.5))
    precision, recall, _ = metrics.precision_recall_curve(mask, p)
    assert RESULT["precision_at_recall_90"] == pytest.approx(precision[recall >= 0.9].max())


def test_ties_are_one_threshold():
    p = np.round(PREDICTION.probability(CRITICAL), 1)
    mask = Y <= 0
    precision, recall, threshold = precision_recall(p, mask)
    assert (np.diff(threshold) < 0).all()
    expected = metrics.average_precision_score(mask, p)
    assert np.diff(recall, prepend=0.0) @ precision == pytest.approx(expected)
    constant = scores(Prediction.gaussian(np.zeros(500), np.ones(500)), Y, CRITICAL)
    assert constant["average_precision"] == pytest.approx(constant["base_rate"])
    assert constant["precision_at_recall_90"] == pytest.approx(constant["base_rate"])


def test_crps_is_the_integral_of_the_squared_difference():
    one = Prediction.gaussian([1.0], [0.7])

    def squared(t: float) -> float:
        return float((stats.norm.cdf(t, 1.0, 0.7) - (t >= 2.0)) ** 2)

    expected = integrate.quad(squared, -10, 2)[0] + integrate.quad(squared, 2, 12)[0]
    assert scores(one, np.array([2.0]), CRITICAL)["crps"] == pytest.approx(expected)


def test_an_honest_belief_is_calibrated():
    assert RESULT["coverage_95"] == pytest.approx(0.95, abs=0.03)
    assert RESULT["calibration_error"] < 0.05
    bold = scores(Prediction.gaussian(MU, SIGMA / 10), Y, CRITICAL)
    assert bold["coverage_95"] < 0.5
    assert bold["calibration_error"] > 2 * RESULT["calibration_error"]
    assert bold["log_likelihood"] < RESULT["log_likelihood"]


def test_reliability_of_a_certain_prediction():
    mean_p, frequency, count = reliability(np.array([0.0, 1.0, 1.0]), np.array([False, True, False]), 15)
    assert count.tolist() == [1, *[0] * 13, 2]
    assert (mean_p[-1], frequency[-1]) == (1.0, 0.5)
    assert np.isnan(mean_p[1])


def test_without_a_critical_run_its_scores_are_none():
    result = scores(PREDICTION, np.abs(Y) + 1.0, CRITICAL)
    keys = ("average_precision", "precision_at_recall_90", "f1", "rmse_critical", "log_likelihood_critical")
    assert all(result[key] is None for key in keys)
    assert (result["n_critical"], result["base_rate"]) == (0, 0.0)
    assert result["calibration_error"] is not None


def test_one_run_and_no_run_are_answered():
    one = scores(PREDICTION.take(slice(0, 1)), Y[:1], CRITICAL)
    none = scores(PREDICTION.take(slice(0, 0)), Y[:0], CRITICAL)
    assert one["n"] == 1
    assert none["n"] == 0
    assert all(value is None for key, value in none.items() if not key.startswith("n"))


def test_every_value_is_json_even_far_off():
    far = scores(Prediction.gaussian(np.zeros(3), np.full(3, 1e-300)), np.array([1e200, 0.0, 1.0]), CRITICAL)
    for result in (RESULT, far):
        json.dumps(result, allow_nan=False)


def test_wrong_input_is_refused():
    with pytest.raises(InputError, match="finite"):
        scores(PREDICTION, np.full(500, np.nan), CRITICAL)
    with pytest.raises(InputError, match="one value a point"):
        scores(PREDICTION, Y[:3], CRITICAL)
    with pytest.raises(InputError, match="bins"):
        reliability(Y, Y > 0, 0)
    with pytest.raises(InputError, match=r"\(n,\)"):
        precision_recall(Y, Y[:3] > 0)

"""Laws of the prediction: densities, probabilities and quantiles against SciPy, far into the tails."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, stats

from sbt.errors import InputError
from sbt.metamodels.prediction import Prediction
from sbt.problem.requirement import CriticalInterval

rng = np.random.default_rng(0)
WEIGHT = rng.dirichlet(np.ones(5))
MIXTURE = Prediction(rng.normal(size=(5, 40)), rng.uniform(0.1, 2.0, (5, 40)), WEIGHT, np.full(40, 0.05))
GAUSSIAN = Prediction.gaussian(rng.normal(size=40), rng.uniform(0.1, 2.0, 40))
INTERVALS = [
    CriticalInterval(high=0.5),
    CriticalInterval(low=-0.2),
    CriticalInterval(-5.0, 0.5),
    CriticalInterval(0.0, 1e-9),
    CriticalInterval(-30.0, -29.0),
    CriticalInterval(30.0, 31.0),
]


def test_moments_match_a_large_sample():
    component = np.random.default_rng(1).choice(5, size=200_000, p=WEIGHT)
    draws = np.random.default_rng(2).normal(MIXTURE.mean[component, 0], MIXTURE.std[component, 0])
    assert MIXTURE.mu[0] == pytest.approx(draws.mean(), abs=0.02)
    assert MIXTURE.sigma[0] == pytest.approx(draws.std(), abs=0.02)


def test_sigma_splits_into_epistemic_and_noise():
    np.testing.assert_allclose(MIXTURE.epistemic**2 + MIXTURE.noise**2, MIXTURE.sigma**2)
    more_noise_than_sigma = Prediction.gaussian([0.0], [1.0], [2.0])
    assert more_noise_than_sigma.epistemic[0] == 0.0


def test_density_integrates_to_one_and_matches_scipy():
    def density(y: float) -> float:
        return float(np.exp(MIXTURE.log_density(np.full(40, y)))[3])

    assert integrate.quad(density, -30, 30, limit=500)[0] == pytest.approx(1.0, abs=1e-7)
    y = np.linspace(-3, 3, 40)
    expected = stats.norm.logpdf(y, GAUSSIAN.mu, GAUSSIAN.sigma)
    np.testing.assert_allclose(GAUSSIAN.log_density(y), expected)
    np.testing.assert_allclose(GAUSSIAN.log_density_gaussian(y), expected)


@pytest.mark.parametrize("prediction", [GAUSSIAN, MIXTURE], ids=["gaussian", "mixture"])
@pytest.mark.parametrize("critical", INTERVALS, ids=str)
def test_inside_and_outside_sum_to_one(prediction, critical):
    inside, outside = prediction.log_probability(critical)
    np.testing.assert_allclose(np.exp(inside) + np.exp(outside), 1.0, atol=1e-14)
    assert (inside <= 0).all()
    assert (outside <= 0).all()
    p = prediction.probability(critical)
    assert ((p >= 0) & (p <= 1)).all()


@pytest.mark.parametrize("prediction", [GAUSSIAN, MIXTURE], ids=["gaussian", "mixture"])
def test_probability_is_the_difference_of_the_cdf(prediction):
    expected = prediction.cdf(np.full(40, 0.5)) - prediction.cdf(np.full(40, -0.7))
    np.testing.assert_allclose(prediction.probability(CriticalInterval(-0.7, 0.5)), expected, atol=1e-14)


def test_probability_grows_with_the_interval():
    ends = np.linspace(-20, 20, 200)
    one_sided = np.stack([MIXTURE.log_probability(CriticalInterval(high=e))[0] for e in ends])
    two_sided = np.stack([MIXTURE.log_probability(CriticalInterval(-21.0, e))[0] for e in ends])
    assert (np.diff(one_sided, axis=0) >= -1e-12).all()
    assert (np.diff(two_sided, axis=0) >= -1e-12).all()


@pytest.mark.parametrize("z", [1.0, 5.0, 8.0, 37.0, 100.0, 1e3])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_far_tails_agree_with_scipy(z, side):
    prediction = Prediction.gaussian([side * z], [1.0])
    tail = CriticalInterval(high=0.0) if side > 0 else CriticalInterval(low=0.0)
    inside, outside = prediction.log_probability(tail)
    assert inside[0] == pytest.approx(stats.norm.logsf(z), rel=1e-12)
    assert outside[0] == pytest.approx(stats.norm.logcdf(z), rel=1e-9, abs=1e-300)
    inside, outside = prediction.log_probability(CriticalInterval(-0.01, 0.01))
    near, far = stats.norm.logsf(z - 0.01), stats.norm.logsf(z + 0.01)
    assert inside[0] == pytest.approx(near + np.log(-np.expm1(far - near)), rel=1e-9)
    assert np.isfinite(outside[0])


def test_narrow_interval_is_density_times_width():
    for centre in (0.0, 3.0, 50.0, -400.0):
        prediction, width = Prediction.gaussian([0.0], [1.0]), max(abs(centre), 1.0) * 1e-9
        critical = CriticalInterval(centre - width / 2, centre + width / 2)
        real = critical.high - critical.low  # as rounded
        expected = stats.norm.logpdf(centre) + np.log(real)
        assert prediction.log_probability(critical)[0][0] == pytest.approx(expected, rel=1e-6)
    point = Prediction.gaussian([0.0], [1.0]).log_probability(CriticalInterval(1.0, 1.0))
    assert point[0][0] == -np.inf
    assert point[1][0] == 0.0


def test_mixture_of_far_components_stays_finite():
    prediction = Prediction(np.array([[1e3], [2e3]]), np.ones((2, 1)), np.array([0.5, 0.5]), np.zeros(1))
    for critical in (CriticalInterval(high=0.0), CriticalInterval(-1.0, 0.0)):
        log_p, log_not = prediction.log_probability(critical)
        assert np.isfinite(log_p[0])
        assert log_not[0] == 0.0
    assert np.isfinite(prediction.log_density(np.array([-1e6]))[0])


def test_a_zero_weight_and_a_tiny_sigma_do_no_harm():
    prediction = Prediction(np.array([[0.0], [5.0]]), np.array([[1e-12], [1.0]]), np.array([0.0, 1.0]), np.zeros(1))
    assert prediction.mu[0] == 5.0
    log_p, log_not = prediction.log_probability(CriticalInterval(high=0.0))
    assert log_p[0] == pytest.approx(stats.norm.logcdf(-5.0))
    assert np.isfinite(log_not[0])


@pytest.mark.parametrize("q", [1e-12, 1e-3, 0.025, 0.5, 0.9, 0.975, 1 - 1e-9])
def test_quantile_inverts_the_cdf(q):
    wide = Prediction(MIXTURE.mean * 50.0, MIXTURE.std, MIXTURE.weight, MIXTURE.noise)
    for prediction in (GAUSSIAN, MIXTURE, wide):
        y = prediction.quantile(q)
        np.testing.assert_allclose(prediction.cdf(y), q, rtol=1e-8 if q > 1e-6 else 1e-6)


def test_mixture_of_predictions_is_the_weighted_law():
    critical, shares = CriticalInterval(-1.0, 0.5), [0.3, 0.7]
    both = Prediction.mixture_of([GAUSSIAN, MIXTURE], shares)
    expected = 0.3 * GAUSSIAN.probability(critical) + 0.7 * MIXTURE.probability(critical)
    np.testing.assert_allclose(both.probability(critical), expected)
    np.testing.assert_allclose(both.noise**2, 0.7 * 0.05**2)


def test_take_is_pointwise():
    index = np.array([3, 1, 3])
    critical = CriticalInterval(high=0.0)
    np.testing.assert_array_equal(MIXTURE.take(index).probability(critical), MIXTURE.probability(critical)[index])
    assert len(MIXTURE.take(slice(0, 0))) == 0


def test_no_points_is_an_empty_answer():
    empty = Prediction.gaussian(np.zeros(0), np.zeros(0))
    assert empty.probability(CriticalInterval(0.0, 1.0)).shape == (0,)
    assert empty.quantile(0.5).shape == (0,)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mean": np.zeros(3)}, r"mean must have shape \(k, n\) with k >= 1, but got \(3,\)"),
        ({"std": np.ones((1, 2))}, r"std must have shape \(1, 3\), but got \(1, 2\)"),
        ({"weight": np.ones(2) / 2}, r"weight must have shape \(1,\), but got \(2,\)"),
        ({"noise": np.zeros(2)}, r"noise must have shape \(3,\), but got \(2,\)"),
        ({"mean": np.full((1, 3), np.nan)}, "mean must be finite"),
        ({"std": np.zeros((1, 3))}, "std must be finite and > 0, but got 0"),
        ({"std": np.full((1, 3), np.nan)}, "std must be finite and > 0, but got nan"),
        ({"weight": np.full(1, 2.0)}, "sum to 1, but got the sum 2"),
        ({"noise": -np.ones(3)}, "noise must be finite and >= 0"),
    ],
)
def test_wrong_predictions_are_refused(change, message):
    right = {"mean": np.zeros((1, 3)), "std": np.ones((1, 3)), "weight": np.ones(1), "noise": np.zeros(3)}
    with pytest.raises(InputError, match=message):
        Prediction(**right | change)


def test_wrong_arguments_are_refused():
    with pytest.raises(InputError, match="0 < q < 1"):
        GAUSSIAN.quantile(1.0)
    with pytest.raises(InputError, match="one value a point"):
        GAUSSIAN.log_density(np.zeros(3))

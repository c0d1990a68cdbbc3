"""Every built-in metamodel obeys the public contract, in its defaults and in the paper's settings."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import gpytorch
import numpy as np
import pytest
import torch
from scipy.optimize import approx_fprime

from sbt.errors import InputError
from sbt.metamodels.base import build, split_validation, standardise
from sbt.metamodels.extra_trees import ExtraTrees
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.gp_algebra import Hyperparameters
from sbt.metamodels.gp_fit import Objective
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.scores import scores
from sbt.problem.requirement import CriticalInterval
from sbt.seeds import stream
from sbt.testing import ContractError, check_metamodel

JAYWALKING = Path(__file__).resolve().parents[2] / "shared" / "data" / "dsiod_jaywalking"
BUILT_IN = {
    "et": ExtraTrees(),
    "et paper": build(ExtraTrees, "paper"),
    "gp": GaussianProcess(),
    "gp homoscedastic": GaussianProcess(nu=2.5, input_noise=False),
    "gp paper, cut short": build(GaussianProcess, "paper", settings={"max_epochs": 40}),
}


def rows(n: int, d: int = 3, seed: int = 0, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    u = rng.random((n, d))
    return u, np.sin(5 * u[:, 0]) + u[:, 1] ** 2 + noise * rng.normal(size=n)


@pytest.mark.parametrize("name", BUILT_IN)
def test_metamodels_obey_their_contract(name):
    check_metamodel(BUILT_IN[name], dimensions=(1, 7))


@pytest.mark.slow
@pytest.mark.parametrize("name", [*BUILT_IN, "gp paper"])
def test_metamodels_obey_their_contract_in_other_dimensions(name):
    metamodel = BUILT_IN[name] if name in BUILT_IN else build(GaussianProcess, "paper")
    check_metamodel(metamodel, dimensions=(2, 20) if name in BUILT_IN else (1, 2, 7, 20))


@dataclasses.dataclass(frozen=True)
class WrongPredictor:
    """A predictor with one flaw."""

    right: Callable[[np.ndarray], Prediction]
    flaw: str

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state | ({"flaw": "mean"} if state["flaw"] == "pickle" else {}))

    def __call__(self, u: np.ndarray) -> Prediction | None:
        right = self.right(u)
        mu, sigma, noise = right.mu, right.sigma, right.noise
        if self.flaw == "type":
            return None
        if self.flaw == "number":
            return Prediction.gaussian(mu[:-1], sigma[:-1], noise[:-1])
        if self.flaw == "noise":
            return Prediction.gaussian(mu, sigma, 2 * sigma)
        if self.flaw == "batch":
            return Prediction.gaussian(mu + len(u), sigma, noise)
        if self.flaw == "mean":
            return Prediction.gaussian(np.full(len(u), 0.7), sigma, noise)
        if self.flaw == "empty" and len(u) == 0:
            raise IndexError("no points")
        return right


@dataclasses.dataclass(frozen=True)
class Wrong:
    """Extra-trees with one flaw."""

    flaw: str

    def fit(self, u: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> Callable[[np.ndarray], Prediction]:
        if self.flaw == "few" and len(y) < 5:
            raise ValueError("too few")
        if self.flaw == "scale":
            y = np.clip(y, -100.0, 100.0)
        right = ExtraTrees().fit(u, y, np.random.default_rng() if self.flaw == "bits" else rng)
        return WrongPredictor(right, self.flaw)


@pytest.mark.parametrize(
    ("flaw", "rule"),
    [
        ("type", "must return a Prediction"),
        ("number", "one value a point"),
        ("noise", "noise is a part of sigma"),
        ("batch", "other points"),
        ("mean", "smooth function"),
        ("few", "learn from n = d"),
        ("scale", "scaling and shifting"),
        ("bits", "bit by bit"),
        ("pickle", "a pickled predictor must predict the same"),
        ("empty", "must take n = 0 points, but raised IndexError"),
    ],
)
def test_wrong_metamodels_are_refused(flaw, rule):
    with pytest.raises(ContractError, match=rule):
        check_metamodel(Wrong(flaw), dimensions=(2,))
    assert issubclass(ContractError, AssertionError)


@pytest.mark.parametrize("name", BUILT_IN)
def test_rows_that_cannot_be_learned_from_are_refused(name):
    u, y = rows(5)
    for bad_u, bad_y, message in (
        (u[:1], y[:1], "n >= 2 rows, but got 1"), (u, y[:3], r"but got \(5, 3\) and \(3,\)"), (u, y * np.nan, "finite u and y"),
        (u * np.inf, y, "finite u and y"), (u[:, :0], y, r"but got \(5, 0\) and \(5,\)"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            BUILT_IN[name].fit(bad_u, bad_y, np.random.default_rng(0))


@pytest.mark.parametrize("name", ["et", "gp"])
def test_global_random_states_are_neither_used_nor_changed(name):
    u, y = rows(40)
    torch.manual_seed(1)
    np.random.seed(1)  # noqa: NPY002
    before = torch.get_rng_state(), np.random.get_state()[1].copy(), torch.get_num_threads()  # noqa: NPY002
    first = BUILT_IN[name].fit(u, y, np.random.default_rng(0))(u)
    assert torch.equal(before[0], torch.get_rng_state())
    np.testing.assert_array_equal(before[1], np.random.get_state()[1])  # noqa: NPY002
    assert torch.get_num_threads() == before[2]
    torch.manual_seed(2)
    second = BUILT_IN[name].fit(u, y, np.random.default_rng(0))(u)
    np.testing.assert_array_equal(first.mean, second.mean)


def test_forest_agrees_with_scikit_learn():
    from sklearn.ensemble import ExtraTreesRegressor

    u, y = rows(200, noise=0.1)
    predictor = ExtraTrees(trees=7).fit(u, y, np.random.default_rng(3))
    seed = int(np.random.default_rng(3).integers(2**31))
    z, shift, scale = standardise(y)
    forest = ExtraTreesRegressor(7, min_samples_split=4, random_state=seed).fit(u.astype(np.float32), z)
    asked = rows(50, seed=9)[0]
    np.testing.assert_allclose(predictor(asked).mu, shift + scale * forest.predict(asked))
    np.testing.assert_allclose(predictor.mu(asked), predictor(asked).mu)


def test_total_variance_is_kept_by_the_papers_single_gaussian():
    u, y = rows(100, noise=0.2)
    mixture = ExtraTrees().fit(u, y, np.random.default_rng(0))(u)
    single = ExtraTrees(mixture=False).fit(u, y, np.random.default_rng(0))(u)
    assert single.mean.shape == (1, 100)
    np.testing.assert_allclose(single.sigma, mixture.sigma)
    assert mixture.sigma.min() >= 0.01 * y.std()


@pytest.mark.parametrize("nu", [0.5, 1.5, 2.5])
def test_kernel_is_gpytorchs(nu):
    a, b = rows(20)[0], rows(15, seed=1)[0]
    kernel = gpytorch.kernels.MaternKernel(nu).double()
    kernel.lengthscale = 0.4
    expected = kernel(torch.from_numpy(a), torch.from_numpy(b)).to_dense().detach().numpy()
    found = Hyperparameters(nu, np.full((1, a.shape[1]), 0.4), np.array([2.0]), 0.1).covariance(a, b)
    np.testing.assert_allclose(found, 2.0 * expected, rtol=1e-6)


def objective(nu: float, noise_mode: float | None = None, kernels: int = 1) -> Objective:
    u, y = rows(150, noise=0.1)
    return Objective(nu, u, standardise(y)[0], np.linspace(0.5, 2.0, 150), torch.device("cpu"), noise_mode, kernels)


def hyper(nu: float, kernels: int = 1) -> Hyperparameters:
    lengths, scales = np.array([[0.3, 0.7, 2.0], [1.5, 0.2, 0.4]]), np.array([1.0, 0.3])
    return Hyperparameters(nu, lengths[:kernels], scales[:kernels], 0.05)


@pytest.mark.parametrize("kernels", [1, 2])
@pytest.mark.parametrize("nu", [0.5, 1.5, 2.5])
def test_gradient_is_that_of_the_objective(nu, kernels):
    for mode in (None, -0.7):
        value = objective(nu, mode, kernels)
        at = value.vector(hyper(nu, kernels))
        assert value.hyperparameters(at).noise == pytest.approx(0.05)
        np.testing.assert_allclose(value(at)[1], approx_fprime(at, lambda v, f=value: f(v)[0], 1e-6), atol=1e-5)


def test_two_kernels_are_taken_where_one_length_scale_an_input_is_too_few():
    """A broad bowl with a ripple along one input; a product of two inputs beside a wave along a third; a rough surface."""
    rng = np.random.default_rng(0)
    u, at = rng.random((120, 5)), rng.random((2000, 5))
    for function, better in (
        (lambda v: 4.0 * ((v - 0.5) ** 2).sum(axis=1) + 0.3 * np.sin(25.0 * v[:, 0]), 10.0),
        (lambda v: np.sin(3.0 * v[:, 0]) + v[:, 1] * v[:, 2], 2.0),
        (lambda v: np.abs(np.sin(9.0 * v)).sum(axis=1), 1.0),
    ):
        y = function(u)
        two, one = (GaussianProcess(nu=2.5, input_noise=False, kernels=q).fit(u, y, np.random.default_rng(1)) for q in (2, 1))
        errors = [float(np.sqrt(np.mean((fitted.mu(at) - function(at)) ** 2))) for fitted in (two, one)]
        assert errors[1] >= better * errors[0]
        if better == 1.0:
            np.testing.assert_array_equal(two.mu(at), one.mu(at)), "what one kernel says is not changed"


@pytest.mark.parametrize("nu", [0.5, 1.5, 2.5])
def test_likelihood_and_priors_are_those_of_gpytorch_and_torch(nu):
    found = objective(nu, -5.0)
    at = found.vector(hyper(nu))
    kernel = gpytorch.kernels.MaternKernel(nu, ard_num_dims=3).double()
    kernel.lengthscale = torch.tensor([0.3, 0.7, 2.0])
    noise, z = torch.from_numpy(0.05 * found.spread), torch.from_numpy(found.z)
    covariance = kernel(torch.from_numpy(found.u)).to_dense().detach() + torch.diag(noise)
    inverse = torch.linalg.inv(covariance)
    law = torch.distributions.MultivariateNormal((inverse.sum(0) @ z / inverse.sum()).expand(150), covariance)
    of_length = torch.distributions.LogNormal(np.sqrt(2.0) + 0.5 * np.log(3.0), np.sqrt(3.0))
    of_noise = torch.distributions.Normal(-5.0, 1.0).log_prob(torch.tensor(0.05).log())
    log_prior = of_length.log_prob(torch.tensor([0.3, 0.7, 2.0])).sum() + of_noise
    assert found(at)[0] == pytest.approx(-(law.log_prob(z) + log_prior).item() / 150, rel=1e-6)


def test_process_interpolates_a_smooth_function():
    u, y = rows(120)
    asked, truth = rows(200, seed=5)
    prediction = GaussianProcess().fit(u, y, np.random.default_rng(0))(asked)
    assert np.sqrt(np.mean((prediction.mu - truth) ** 2)) < 0.05
    assert np.mean(np.abs(truth - prediction.mu) < 1.96 * prediction.sigma) > 0.9


def test_noise_is_found_where_it_is():
    rng = np.random.default_rng(2)
    u = rng.random((400, 2))
    y = np.sin(4 * u[:, 1]) + np.where(u[:, 0] > 0.5, 0.5, 0.02) * rng.normal(size=400)
    prediction = GaussianProcess().fit(u, y, rng)(np.array([[0.25, 0.5], [0.75, 0.5]]))
    assert prediction.noise[0] < 0.1
    assert 0.3 < prediction.noise[1] < 0.8


def test_a_deterministic_metric_is_learned_without_noise_and_a_noisy_one_with_its_own():
    smooth, noisy = rows(150), rows(150, noise=0.3)
    exact = GaussianProcess(nu=2.5, input_noise=False).fit(*smooth, np.random.default_rng(0))
    assert exact.hyper.noise < 1e-6
    new, y = rows(400, seed=1)
    assert np.sqrt(np.mean((exact(new).mu - y) ** 2)) < 0.005
    wide = GaussianProcess(nu=2.5, input_noise=False).fit(*noisy, np.random.default_rng(0))
    assert wide.scale * np.sqrt(wide.hyper.noise) == pytest.approx(0.3, rel=0.2)


@pytest.mark.parametrize("seed", [2, 5, 6])
def test_what_bends_between_few_rows_is_not_taken_for_noise(seed):
    """Whole numbers in no order: L-BFGS from long length scales ended with noise of a third of the variance."""
    rng = stream(seed, "permuted")
    a, b, c, x = rng.integers(0, 13, 120), rng.integers(0, 10, 120), rng.integers(0, 2, 120), rng.random(120)
    u, y = np.column_stack([a / 12, b / 9, c, x]), np.arcsinh((7 * a) % 13 + 0.6 * b + 2 * c + x - 3.0)
    predictor = GaussianProcess(nu=2.5, input_noise=False).fit(u, y, rng)
    assert predictor.hyper.noise < 1e-4
    assert np.abs(predictor(u).mu - y).max() < 1e-2


def test_repetitions_of_a_deterministic_run_teach_nothing():
    u, y = rows(40)
    y = np.where(u[:, 2] > 0.5, y + 1.0, y)  # a step: what a smooth process does not explain is noise to it
    once = GaussianProcess(input_noise=False).fit(u, y, np.random.default_rng(0))
    again = np.repeat(np.arange(40), 3)
    more = GaussianProcess(input_noise=False).fit(u[again], y[again], np.random.default_rng(0))
    assert more(u).mu == pytest.approx(once(u).mu, rel=1e-9)
    assert more.hyper.noise > 1e-3


@pytest.mark.parametrize("nu", [0.5, 2.5])
def test_bounds_hold_where_weights_are_large(nu):
    u, y = rows(300)
    predict, interval = GaussianProcess(nu=nu, input_noise=False).fit(u, y, np.random.default_rng(0)), CriticalInterval(0.5, 0.52)
    new, _ = rows(3000, seed=1)
    low, high = predict.probability_bounds(new, interval)
    p = predict(new).probability(interval)
    assert ((low <= p) & (p <= high)).all()
    assert (high < 0.01).mean() > 0.5 * (p < 0.01).mean()


def test_process_learns_from_more_rows_than_it_is_tuned_on():
    u, y = rows(300, noise=0.05)
    asked, truth = rows(200, seed=5)
    few = GaussianProcess().fit(u[:60], y[:60], np.random.default_rng(0))(asked)
    more = GaussianProcess(fit_rows=60).fit(u, y, np.random.default_rng(0))(asked)
    assert np.mean((more.mu - truth) ** 2) < np.mean((few.mu - truth) ** 2)


def test_split_is_the_papers():
    assert split_validation(10) == (slice(0, 2), slice(2, 10))
    assert split_validation(2) == (slice(0, 1), slice(1, 2))
    with pytest.raises(InputError, match="n >= 2"):
        split_validation(1)


def test_constant_y_keeps_a_scale():
    for value in (0.0, 10.0, -1e8, 1e-9):
        z, shift, scale = standardise(np.full(7, value))
        assert (z == 0).all()
        assert shift == pytest.approx(value)
        assert scale > 0


def test_settings_are_checked_by_name():
    assert build(GaussianProcess, "paper").nu == 0.5
    assert build(GaussianProcess, "paper", {"nu": 2.5}).nu == 2.5
    assert build(ExtraTrees) == ExtraTrees()
    with pytest.raises(InputError, match=r"preset of paper, but got 'papper' \(did you mean 'paper'\?\)"):
        build(ExtraTrees, "papper")
    with pytest.raises(InputError, match=r"fit_rows.*got 'fitrows' \(did you mean 'fit_rows'\?\)"):
        build(GaussianProcess, settings={"fitrows": 100})
    with pytest.raises(InputError, match="trees must be a whole number of at most 10000, but got 'many'"):
        build(ExtraTrees, settings={"trees": "many"})


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        (ExtraTrees, {"trees": 0}),
        (ExtraTrees, {"min_samples_split": 1}),
        (ExtraTrees, {"max_features": 0.0}),
        (ExtraTrees, {"sigma_floor": 0.0}),
        (GaussianProcess, {"nu": 1.0}),
        (GaussianProcess, {"fit_rows": 1}),
        (GaussianProcess, {"learning_rate": 0.0}),
        (GaussianProcess, {"patience": 0}),
    ],
)
def test_impossible_settings_are_refused(kind, settings):
    with pytest.raises(InputError, match=next(iter(settings))):
        build(kind, settings=settings)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "least"), [(GaussianProcess, -1.36), (ExtraTrees, -1.45)])
def test_recorded_jaywalking_runs(kind, least):
    pytest.importorskip("pyarrow", reason="reading the recorded runs needs pyarrow")
    import pandas as pd

    path = JAYWALKING / "quasi_random.parquet"
    if not path.exists():
        pytest.skip(f"the recorded runs are not at {path}")
    table = pd.read_parquet(path)
    names = ["v_av", "v_ped", "d_0", "rain_rel", "fog_rel", "wind_rel", "time_of_day"]
    low, high = np.array([4.5, 0.4, 0, 0, 0, 0, 0]), np.array([7.5, 2.0, 50, 1, 1, 1, 24])
    u, y = (table[names].to_numpy() - low) / (high - low), table["min_dist*"].to_numpy()
    results = []
    for seed in range(4):
        order = np.random.default_rng(seed).permutation(len(y))
        train, test = order[:500], order[500:]
        prediction = kind().fit(u[train], y[train], np.random.default_rng(seed))(u[test])
        results.append(scores(prediction, y[test], CriticalInterval(high=0.0)))
    assert np.mean([r["log_likelihood"] for r in results]) >= least
    assert np.mean([r["average_precision"] for r in results]) >= 0.38

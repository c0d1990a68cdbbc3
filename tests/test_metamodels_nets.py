"""Networks, sparse Gaussian processes and `auto` obey the contract; their parts agree with the originals."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import time
from pathlib import Path

import gpytorch
import numpy as np
import pytest
import torch
from pretended_cuda import pretended_cuda
from scipy.stats import norm
from scipy.stats import t as student_t

from sbt.errors import InputError
from sbt.metamodels.automatic import Auto
from sbt.metamodels.base import build, with_target
from sbt.metamodels.bayesian_network import BayesianNetwork, _mask
from sbt.metamodels.deep_ensemble import Ensemble
from sbt.metamodels.deep_gp import DeepGaussianProcess
from sbt.metamodels.extra_trees import ExtraTrees
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.recalibrated import Recalibrated
from sbt.metamodels.scores import scores
from sbt.metamodels.sigma_point import DeepSigmaPointProcess
from sbt.metamodels.sparse_gp import SparseGaussianProcess
from sbt.metamodels.stacking import Bins, stacking_weights
from sbt.metamodels.tails import student_mixture, student_widths
from sbt.metamodels.torch_tools import device_of, minibatches
from sbt.plugins import load, names
from sbt.problem.requirement import CriticalInterval
from sbt.testing import check_metamodel

JAYWALKING = Path(__file__).resolve().parents[2] / "shared" / "data" / "dsiod_jaywalking"
QUICK = {
    "ensemble": Ensemble(members=3, layers=2, width=24, steps=80, learning_rate=0.02, decay=20.0),
    "bnn": BayesianNetwork(widths=(32, 32), max_steps=80, samples=10, learning_rate=0.02),
    "dgp": DeepGaussianProcess(members=1, inducing=15, samples=5, max_epochs=12, learning_rate=0.1),
    "dspp": DeepSigmaPointProcess(members=1, inducing=15, max_epochs=25, learning_rate=0.1),
    "svgp": SparseGaussianProcess(inducing=30, steps=30, learning_rate=0.1),
    "gp student": GaussianProcess(student_t=True),
}
DEFAULTS = {
    "auto": Auto(),
    "bnn": BayesianNetwork(),
    "dgp": DeepGaussianProcess(),
    "dspp": DeepSigmaPointProcess(),
    "ensemble": Ensemble(),
    "et": ExtraTrees(),
    "gp": GaussianProcess(),
    "svgp": SparseGaussianProcess(),
}


def rows(n: int, d: int = 3, seed: int = 0, noise: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    u = rng.random((n, d))
    return u, np.sin(5 * u[:, 0]) + u[:, 1] ** 2 + noise * rng.normal(size=n)


@pytest.mark.parametrize("name", QUICK)
def test_metamodels_obey_their_contract(name):
    check_metamodel(QUICK[name], dimensions=(1, 6))


@pytest.mark.slow
@pytest.mark.parametrize("name", QUICK)
def test_metamodels_obey_their_contract_with_many_inputs(name):
    check_metamodel(QUICK[name], dimensions=(20,))


def test_auto_obeys_its_contract():
    check_metamodel(Auto(folds=2, ensemble_rows=10**6), dimensions=(3,))  # 1, 2 and 7: see the slow ones


@pytest.mark.slow
@pytest.mark.parametrize("name", DEFAULTS)
def test_defaults_obey_their_contract(name):
    check_metamodel(DEFAULTS[name], dimensions=(1, 2, 7) if name in ("auto", "ensemble", "bnn", "svgp") else (2,))


@pytest.mark.slow
@pytest.mark.parametrize("kind", [DeepGaussianProcess, DeepSigmaPointProcess, BayesianNetwork])
def test_papers_settings_learn(kind):
    u, y = rows(60, d=2)
    asked, truth = rows(200, d=2, seed=3, noise=0.0)
    prediction = build(kind, "paper").fit(u, y, np.random.default_rng(0))(asked)
    assert np.sqrt(np.mean((prediction.mu - truth) ** 2)) < 0.5 * truth.std()


def test_all_built_in_metamodels_are_found():
    assert set(DEFAULTS) <= set(names("metamodels"))
    for name, metamodel in DEFAULTS.items():
        assert load("metamodels", name) is type(metamodel)
        for preset in getattr(type(metamodel), "PRESETS", {}):
            build(type(metamodel), preset)


def test_papers_settings_are_those_of_its_table():
    bnn = build(BayesianNetwork, "paper")
    assert (bnn.widths, bnn.tau, bnn.length_scale, bnn.batch) == ((180, 110, 430, 830, 160), 7.0, 0.0005, 8)
    assert (bnn.learning_rate, bnn.decay, bnn.decay_every, bnn.patience, bnn.samples) == (0.001, 0.2, 10_000, 20_000, 50)
    dgp, dspp = build(DeepGaussianProcess, "paper"), build(DeepSigmaPointProcess, "paper")
    assert (dgp.kernel, dgp.inducing, dgp.learning_rate, dgp.patience, dgp.samples) == ("rq", 100, 0.01, 200, 50)
    assert (dspp.kernel, dspp.inducing, dspp.learning_rate, dspp.patience, dspp.sites) == ("rq", 100, 0.01, 200, 9)


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        (Ensemble, {"members": 1}),
        (Ensemble, {"steps": 0}),
        (Ensemble, {"learning_rate": 0.0}),
        (Ensemble, {"beta": 2.0}),
        (Ensemble, {"device": "gpu"}),
        (BayesianNetwork, {"widths": ()}),
        (BayesianNetwork, {"tau": 0.0}),
        (BayesianNetwork, {"decay": 1.5}),
        (BayesianNetwork, {"samples": 0}),
        (DeepGaussianProcess, {"kernel": "linear"}),
        (DeepGaussianProcess, {"inducing": 0}),
        (DeepGaussianProcess, {"patience": 0}),
        (DeepSigmaPointProcess, {"learning_rate": -1.0}),
        (DeepSigmaPointProcess, {"members": 6}),
        (SparseGaussianProcess, {"steps": 0}),
        (Auto, {"folds": 1}),
        (Auto, {"prior": -1.0}),
        (Auto, {"compare_rows": 9}),
    ],
)
def test_impossible_settings_are_refused(kind, settings):
    with pytest.raises(InputError, match=next(iter(settings))):
        build(kind, settings=settings)


ON_DEVICES = {
    **QUICK,
    "gp": GaussianProcess(),
    "gp paper": build(GaussianProcess, "paper", settings={"max_epochs": 20}),
    "auto": Auto(ensemble_rows=10**6),
}


@pytest.mark.parametrize("name", ON_DEVICES)
def test_everything_moves_to_the_device(name, monkeypatch):
    """What the CPU computes for a pretended CUDA device is what it computes for itself."""
    (u, y), asked = rows(40), rows(30, seed=3)[0]
    metamodel, critical = ON_DEVICES[name], CriticalInterval(high=0.0)
    here = metamodel.fit(u, y, np.random.default_rng(0))
    with pretended_cuda(monkeypatch) as marks:
        there = dataclasses.replace(metamodel, device="cuda").fit(u, y, np.random.default_rng(0))
        fitted = marks.marked
        prediction = there(asked)
        assert 0 < fitted < marks.marked  # both the fit and the prediction were there
        np.testing.assert_allclose(prediction.mean, here(asked).mean, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(prediction.std, here(asked).std, rtol=1e-6)
        if name.startswith("gp"):
            draws = [p.sample_paths(asked, 3, np.random.default_rng(1)) for p in (here, there)]
            np.testing.assert_allclose(*draws, rtol=1e-6, atol=1e-6)
            bounds = [p.probability_bounds(asked, critical) for p in (here, there)]
            np.testing.assert_allclose(*bounds, rtol=1e-6, atol=1e-9)


def test_a_pretended_device_refuses_what_cuda_refuses(monkeypatch):
    with pretended_cuda(monkeypatch):
        a, b = torch.ones(3).to("cuda"), torch.ones(3)
        assert a.device == (a + 1.0).device == torch.zeros(2, device="cuda").device == torch.device("cuda")
        with pytest.raises(RuntimeError, match="same device"):
            a * b
        with pytest.raises(TypeError, match="numpy"):
            a.sum().numpy()
        assert (a.cpu() * b).device == torch.device("cpu")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
@pytest.mark.parametrize("name", ON_DEVICES)
def test_cuda_believes_what_the_cpu_believes_and_repeats_it(name):
    (u, y), asked = rows(60), rows(30, seed=3)[0]
    here, there = ON_DEVICES[name], dataclasses.replace(ON_DEVICES[name], device="cuda")
    first, again = (there.fit(u, y, np.random.default_rng(0))(asked) for _ in range(2))
    np.testing.assert_array_equal(first.mean, again.mean)
    np.testing.assert_array_equal(first.std, again.std)
    own = here.fit(u, y, np.random.default_rng(0))(asked)
    alike = 1e-6 if name.startswith("gp") else 0.3  # networks take another way, or other random numbers
    assert np.sqrt(np.mean((first.mu - own.mu) ** 2)) < alike * y.std()


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
@pytest.mark.parametrize("name", ["ensemble", "bnn", "dgp", "dspp", "svgp", "gp student"])
def test_device_that_is_not_there_is_refused(name):
    u, y = rows(20)
    with pytest.raises(InputError, match="cuda"):
        dataclasses.replace(QUICK[name], device="cuda").fit(u, y, np.random.default_rng(0))
    assert device_of("auto") == torch.device("cpu")


@pytest.mark.parametrize("name", QUICK)
def test_global_random_states_are_neither_used_nor_changed(name):
    u, y = rows(30)
    torch.manual_seed(1)
    np.random.seed(1)  # noqa: NPY002
    before = torch.get_rng_state(), np.random.get_state()[1].copy(), torch.get_num_threads()  # noqa: NPY002
    first = QUICK[name].fit(u, y, np.random.default_rng(0))(u)
    assert torch.equal(before[0], torch.get_rng_state())
    np.testing.assert_array_equal(before[1], np.random.get_state()[1])  # noqa: NPY002
    assert torch.get_num_threads() == before[2]
    torch.manual_seed(2)
    np.testing.assert_array_equal(first.mean, QUICK[name].fit(u, y, np.random.default_rng(0))(u).mean)


@pytest.mark.slow
def test_bits_do_not_depend_on_the_number_of_threads():
    code = """
import hashlib, numpy as np
from sbt.acquisitions import boundary
from sbt.metamodels.bayesian_network import BayesianNetwork
from sbt.metamodels.extra_trees import ExtraTrees
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.sigma_point import DeepSigmaPointProcess
from sbt.metamodels.deep_ensemble import Ensemble
from sbt.problem.requirement import CriticalInterval
u = np.random.default_rng(0).random((300, 5)); y = np.sin(9 * u[:, 0]) + u[:, 1] * u[:, 2]
nets = Ensemble(steps=20), BayesianNetwork(widths=(256, 256), max_steps=10), DeepSigmaPointProcess(max_epochs=2)
for kind in (ExtraTrees(), GaussianProcess(), *nets):
    prediction = kind.fit(u[:150], y[:150], np.random.default_rng(1))(u)
    score = boundary(prediction, CriticalInterval(high=0.3), np.zeros(300))
    print(hashlib.sha256(prediction.mean.tobytes() + prediction.std.tobytes() + score.tobytes()).hexdigest())
"""
    runs = []
    for threads in ("1", "2"):
        limits = {"OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads, "MKL_NUM_THREADS": threads}
        runs.append(subprocess.Popen([sys.executable, "-c", code], env={**os.environ, **limits}, stdout=subprocess.PIPE))
    one, two = (run.communicate()[0] for run in runs)
    assert len(one.split()) == 5
    assert one == two


def test_minibatches_pass_over_all_rows():
    batches = minibatches(np.arange(12).reshape(2, 6), 2, np.random.default_rng(0))
    one_pass = np.concatenate([next(batches) for _ in range(3)], axis=1)
    np.testing.assert_array_equal(np.sort(one_pass, axis=1), np.arange(12).reshape(2, 6))
    assert next(minibatches(np.arange(3)[None], 8, np.random.default_rng(0))).shape == (1, 3)


def test_ensemble_learns_function_and_noise():
    rng = np.random.default_rng(2)
    u = rng.random((600, 2))
    y = np.sin(4 * u[:, 1]) + np.where(u[:, 0] > 0.5, 0.5, 0.05) * rng.normal(size=600)
    prediction = Ensemble(members=4, steps=600).fit(u, y, rng)(np.array([[0.2, 0.5], [0.8, 0.5]]))
    assert np.abs(prediction.mu[0] - np.sin(2.0)) < 0.15
    assert prediction.noise[0] < 0.2
    assert 0.3 < prediction.noise[1] < 0.8


@pytest.mark.parametrize("name", ["ensemble", "et"])
def test_scoring_candidates_is_fast(name):
    u, y = rows(300, d=7)
    predictor = dataclasses.replace(DEFAULTS[name], **({"steps": 20} if name == "ensemble" else {})).fit(
        u, y, np.random.default_rng(0)
    )
    asked = rows(20_000, d=7)[0]
    predictor(asked)
    start = time.process_time()
    predictor(asked)
    assert 20_000 / (time.process_time() - start) > 15_000  # 100,000 and more on an idle core


def test_masks_drop_the_share_they_learned():
    uniform = torch.from_numpy(np.random.default_rng(0).random((200_000, 1)).astype(np.float32))
    mask = _mask(torch.tensor(np.log(0.2 / 0.8)), uniform)
    assert float((mask < 0.5).float().mean()) == pytest.approx(0.2, abs=0.01)
    assert float(mask.mean()) == pytest.approx(1.0, abs=0.01)


def test_draws_of_the_bnn_are_different_functions():
    u, y = rows(60, d=2)
    prediction = QUICK["bnn"].fit(u, y, np.random.default_rng(0))(u)
    assert prediction.mean.shape == (10, 60)
    assert (prediction.mean.std(axis=0) > 0).all()
    assert (prediction.epistemic > 0).all()


@pytest.mark.parametrize("kernel", ["rq", "matern_0.5", "matern_1.5", "matern_2.5"])
def test_sparse_layer_is_gpytorchs(kernel):
    from sbt.metamodels.sparse import SparseLayer, _apply, _divergence

    rng = np.random.default_rng(0)
    at, x, root = rng.normal(size=(6, 2)), rng.normal(size=(9, 2)), np.tril(rng.normal(size=(6, 6)))
    root[np.diag_indices(6)] = np.abs(root.diagonal()) + 0.1
    arrays = {
        "inducing": at[None],
        "log_lengthscale": np.log([[[0.7, 1.3]]]),
        "log_outputscale": np.log([1.7]),
        "log_shape": np.log([0.8]),
        "slope": np.zeros((2, 1)),
        "offset": np.array([0.4]),
        "mean": rng.normal(size=(1, 6)),
        "root": root[None],
    }
    layer = SparseLayer(**{k: torch.from_numpy(np.asarray(v)) for k, v in arrays.items()})
    mean, variance = _apply(layer, kernel, torch.from_numpy(x))

    class Original(gpytorch.models.ApproximateGP):
        def __init__(self):
            posterior = gpytorch.variational.CholeskyVariationalDistribution(6)
            super().__init__(gpytorch.variational.VariationalStrategy(self, torch.from_numpy(at), posterior, jitter_val=1e-6))
            base = gpytorch.kernels.RQKernel(ard_num_dims=2)
            if kernel != "rq":
                base = gpytorch.kernels.MaternKernel(float(kernel[-3:]), ard_num_dims=2)
            self.mean_module, self.covar_module = gpytorch.means.ConstantMean(), gpytorch.kernels.ScaleKernel(base)

        def forward(self, x):
            return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))

    model = Original().double()
    model.covar_module.base_kernel.lengthscale = torch.tensor([[0.7, 1.3]])
    model.covar_module.outputscale = 1.7
    model.mean_module.initialize(constant=0.4)
    if kernel == "rq":
        model.covar_module.base_kernel.alpha = 0.8
    strategy = model.variational_strategy
    strategy.variational_params_initialized.fill_(1)
    strategy._variational_distribution.variational_mean.data = torch.from_numpy(arrays["mean"][0])
    strategy._variational_distribution.chol_variational_covar.data = torch.from_numpy(root)
    model.eval()
    with torch.no_grad():
        expected = model(torch.from_numpy(x))
        np.testing.assert_allclose(mean[0], expected.mean, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(variance[0], expected.variance, rtol=1e-4, atol=1e-5)
        assert float(_divergence(layer)) == pytest.approx(float(strategy.kl_divergence()), rel=1e-6)


def test_students_widths_follow_the_tails():
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(student_widths(rng.normal(size=500)), np.ones(1))
    np.testing.assert_array_equal(student_widths(rng.standard_t(2, size=10)), np.ones(1))
    heavy = student_widths(rng.standard_t(3, size=2000))
    assert len(heavy) == 7
    assert heavy.max() > 1.5 > 1.0 > heavy.min()


@pytest.mark.parametrize("degrees", [1.5, 3.0])
def test_a_mixture_has_the_tail_of_a_student_t_far_beyond_the_data(degrees):
    rng = np.random.default_rng(0)
    errors = 0.5 * rng.standard_t(degrees, size=4000)
    factor, probability = student_mixture(errors)
    for far in (2.0, 10.0, 100.0):
        truth = float(student_t.sf(far / 0.5, degrees))
        assert probability @ norm.sf(far / factor) == pytest.approx(truth, rel=0.5)
    prediction = Prediction.gaussian(np.array([0.0, 3.0]), np.array([1.0, 2.0])).with_tails(factor, probability)
    np.testing.assert_allclose(prediction.cdf(np.array([-10.0, -17.0]))[0], probability @ norm.sf(10.0 / factor), rtol=1e-9)
    np.testing.assert_allclose(*prediction.cdf(np.array([-10.0, -17.0])), rtol=1e-9)  # 10 standard deviations below both
    for few in (rng.normal(size=500), rng.standard_t(2, size=10)):
        assert student_mixture(few) is None


def test_weights_are_those_of_largest_likelihood():
    rng = np.random.default_rng(0)
    log_density = rng.normal(size=(2, 400))
    weights = stacking_weights(log_density, prior=0.0)
    grid = np.linspace(0.001, 0.999, 999)
    likelihood = [np.logaddexp(log_density[0] + np.log(w), log_density[1] + np.log1p(-w)).sum() for w in grid]
    assert weights[0] == pytest.approx(grid[int(np.argmax(likelihood))], abs=0.01)
    np.testing.assert_allclose(stacking_weights(log_density, prior=1e9), [0.5, 0.5], atol=1e-3)
    hopeless = np.array([[-1e308, -1e308], [0.0, 0.0]])
    np.testing.assert_allclose(stacking_weights(hopeless, prior=0.0), [0.0, 1.0], atol=1e-6)


def test_auto_says_what_it_chose_and_why():
    u, y = rows(120)
    predictor = Auto(ensemble_rows=10**6).fit(u, y, np.random.default_rng(0))
    choice = predictor.comparison
    assert set(choice.weights) == {"gp", "et"}
    assert set(choice.scores) == {"gp", "et", "mixture"}
    assert sum(choice.weights.values()) == pytest.approx(1.0)
    assert choice.weights["gp"] > 0.5  # a smooth function
    assert choice.scores["mixture"] > choice.scores["et"]
    assert "gp" in choice.reason
    assert "ensemble takes part from" in choice.reason
    few = Auto().fit(u[:6], y[:6], np.random.default_rng(0)).comparison
    assert few.scores == {}
    assert "too few" in few.reason


def test_auto_that_knows_the_critical_interval_looks_at_its_edge():
    u, critical = np.random.default_rng(1).random((120, 2)), CriticalInterval(high=0.0)
    y = np.where(u[:, 1] < 0.5, 8.0 * (u[:, 0] - 0.3) + np.sin(6.0 * u[:, 1]), 10.0)  # in half of the space no conflict
    settings = Auto(ensemble_rows=10**6)
    blind, targeted = (m.fit(u, y, np.random.default_rng(0)).comparison for m in (settings, with_target(settings, critical)))
    assert blind.weights["et"] > 0.7  # it knows the plateau best, to the last digit
    assert targeted.weights["gp"] > 0.5
    assert "ranges cut at" in targeted.reason
    assert with_target(GaussianProcess(), critical) == GaussianProcess()
    assert with_target(Recalibrated(settings), critical) == Recalibrated(with_target(settings, critical))


@pytest.mark.parametrize("critical", [CriticalInterval(high=0.0), CriticalInterval(low=1.0), CriticalInterval(-0.5, 0.5)])
def test_the_ranges_of_a_score_cover_all_values_and_m_c_is_closed(critical):
    bins, mass = Bins(critical, near=0.25), 0.0
    for y in [*(bins.cuts - 1e-9), bins.cuts[-1] + 1e-9]:
        mass += np.exp(bins.log_score(Prediction.gaussian([0.3], [0.7]), np.array([y]))[0])
    assert mass == pytest.approx(1.0)
    sure = Prediction.gaussian([0.5 * (max(critical.low, -1.0) + min(critical.high, 2.0))], [0.1])
    for end in (critical.low, critical.high):
        if np.isfinite(end):
            inward = np.clip(sure.mu, end - 1e-9, end + 1e-9)
            assert bins.log_score(sure, np.array([end])) == pytest.approx(bins.log_score(sure, inward))


def test_auto_leaves_the_gp_out_of_many_rows():
    u, y = rows(60)
    choice = Auto(gp_rows=50, ensemble_rows=10**6).fit(u, y, np.random.default_rng(0)).comparison
    assert choice.weights == {"et": 1.0}
    assert "gp takes part up to 50" in choice.reason


def test_auto_compares_on_some_rows_and_learns_from_all():
    u, y = rows(200)
    found = Auto(compare_rows=40, ensemble_rows=10**6).fit(u, y, np.random.default_rng(0))
    assert "of 40 rows" in found.comparison.reason
    gp = next(p for p, name in zip(found.predictors, found.comparison.weights, strict=False) if name == "gp")
    assert len(gp.u) == 200


@pytest.mark.slow
@pytest.mark.parametrize(("n", "least", "precision"), [(200, -1.48, 0.33), (500, -1.30, 0.42), (1000, -1.15, 0.53)])
def test_auto_on_recorded_jaywalking_runs(n, least, precision):
    pytest.importorskip("pyarrow", reason="reading the recorded runs needs pyarrow")
    import pandas as pd

    path = JAYWALKING / "quasi_random.parquet"
    if not path.exists():
        pytest.skip(f"the recorded runs are not at {path}")
    table = pd.read_parquet(path)
    inputs = ["v_av", "v_ped", "d_0", "rain_rel", "fog_rel", "wind_rel", "time_of_day"]
    low, high = np.array([4.5, 0.4, 0, 0, 0, 0, 0]), np.array([7.5, 2.0, 50, 1, 1, 1, 24])
    u, y = (table[inputs].to_numpy() - low) / (high - low), table["min_dist*"].to_numpy()
    results = []
    for seed in range(100, 105):
        order = np.random.default_rng(seed).permutation(len(y))
        train, test = order[:n], order[n:]
        prediction = Auto().fit(u[train], y[train], np.random.default_rng(seed))(u[test])
        results.append(scores(prediction, y[test], CriticalInterval(high=0.0)))
    assert np.mean([r["log_likelihood"] for r in results]) >= least
    assert np.mean([r["average_precision"] for r in results]) >= precision

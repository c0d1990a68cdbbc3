"""The exact screen of a_BI: bounds that hold everywhere, and the same points drawn with it as without."""

from __future__ import annotations

import numpy as np
import pytest

from sbt.acquisitions import boundary
from sbt.metamodels.automatic import Auto
from sbt.metamodels.base import log_ambiguity_bound
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.problem.requirement import CriticalInterval
from sbt.samplers.roi import rejection
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream

KINDS = {
    "nu 0.5": GaussianProcess(nu=0.5), "nu 1.5": GaussianProcess(), "nu 2.5": GaussianProcess(nu=2.5),
    "student": GaussianProcess(student_t=True), "paper": GaussianProcess(input_noise=False, priors=False, max_epochs=30),
    "auto": Auto(ensemble_rows=1000, folds=2), "two kernels": GaussianProcess(nu=2.5, input_noise=False),
}  # fmt: skip
INTERVALS = (CriticalInterval(high=-0.4), CriticalInterval(low=0.9), CriticalInterval(-0.7, -0.3), CriticalInterval(-9.0, 9.0))


def fitted(kind: str, n: int = 90, d: int = 3):
    rng = np.random.default_rng(2)
    u = rng.random((n, d))
    y = np.minimum(1.5 * u[:, 0] + np.sin(6 * u[:, 1]) - u[:, -1], 1.0) + rng.normal(scale=0.02 + 0.3 * (u[:, 0] < 0.2))
    if kind == "two kernels":
        y = 4.0 * ((u - 0.5) ** 2).sum(axis=1) + 0.1 * np.sin(25.0 * u[:, 0]) - 1.0
    predictor = KINDS[kind].fit(u, y, stream(0, "fit"))
    assert (getattr(getattr(predictor, "hyper", None), "outputscale", np.ones(1)).size == 2) == (kind == "two kernels")
    return predictor, u


@pytest.mark.parametrize("kind", KINDS)
def test_bounds_hold(kind):
    predict, rows = fitted(kind)
    u = np.vstack([rows, rows + 1e-9, np.random.default_rng(5).random((3000, 3))])
    prediction = predict(u)
    for critical in INTERVALS:
        p = prediction.probability(critical)
        low, high = predict.probability_bounds(u, critical)
        assert (low <= p).all()
        assert (p <= high).all()
        bound = log_ambiguity_bound(predict, u, critical)
        assert (np.maximum(boundary(prediction, critical, np.zeros(len(u))), -700.0) <= bound).all()


@pytest.mark.parametrize("kind", ["nu 1.5", "auto"])
@pytest.mark.parametrize("most", [2**16, 512], ids=["accepted", "pool"])
def test_the_same_points_are_drawn_at_less_cost(kind, most):
    predict, _ = fitted(kind)
    critical, scored = CriticalInterval(high=-0.9), []

    def score(u):
        scored.append(len(u))
        return boundary(predict(u), critical, np.zeros(len(u)))

    draws, costs = [], []
    for bound in (None, lambda u: log_ambiguity_bound(predict, u, critical)):
        scored.clear()
        sequence = SobolSequence(3, 1)
        draws.append(rejection(score, sequence, 100, start=7, seed=1, label=0, max_candidates=most, bound=bound, fill=False))
        costs.append(sum(scored))
    plain, screened = draws
    np.testing.assert_array_equal(plain.u, screened.u)
    assert (plain.positions.tolist(), plain.next_position, plain.candidates, plain.method, plain.acceptance) == (
        screened.positions.tolist(), screened.next_position, screened.candidates, screened.method, screened.acceptance
    )  # fmt: skip
    assert plain.method == ("rejection" if most > 512 else "short")
    if most > 512:
        assert costs[1] < costs[0] / 3

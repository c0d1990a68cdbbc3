"""What keeps proposals quick after thousands of runs: sketches, thinned searches, derivatives that are written down."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import stats

from sbt.estimators.surrogate import fit_log_probability, sketch_of
from sbt.metamodels.deep_ensemble import Ensemble, _Adam, _backward, _forward, _one_cycle, _views
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.problem.requirement import CriticalInterval
from sbt.samplers.search import Search, search_data
from sbt.samplers.smc import smc

SETTINGS = Ensemble(members=3, layers=2, width=8)


def layers(seed: int = 0) -> tuple[torch.Tensor, list[torch.Tensor]]:
    rng = torch.Generator().manual_seed(seed)
    shapes = [(3, 2, 8), (3, 1, 8), (3, 8, 8), (3, 1, 8), (3, 8, 2), (3, 1, 2)]
    parts = [torch.randn(shape, generator=rng) for shape in shapes]
    return torch.cat([part.reshape(-1) for part in parts]), parts


def test_slopes_of_an_ensemble_are_those_of_automatic_differentiation():
    flat, parts = layers()
    slope = torch.empty_like(flat)
    x, target = torch.randn(3, 5, 2), torch.randn(3, 5)
    _backward(_views(flat, parts), _views(slope, parts), x, target, SETTINGS)
    learned = flat.clone().requires_grad_()
    mean, variance = _forward(_views(learned, parts), x, SETTINGS.sigma_floor)
    loss = 0.5 * (variance.log() + (target - mean) ** 2 / variance) * variance.detach() ** SETTINGS.beta
    loss.mean(dim=1).sum().backward()
    torch.testing.assert_close(slope, learned.grad, rtol=1e-4, atol=1e-5)


def test_steps_of_an_ensemble_are_those_of_torch():
    steps, rate, decay = 23, 3e-3, 0.1
    ours, theirs = torch.ones(6), torch.nn.Parameter(torch.ones(6))
    adam = torch.optim.AdamW([theirs], lr=rate, weight_decay=decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(adam, rate, total_steps=steps + 1)
    mine = _Adam(ours, decay)
    for step in range(steps):
        slope = torch.sin(torch.arange(6.0) * (step + 1))
        theirs.grad = slope.clone()
        adam.step()
        schedule.step()
        mine.step(slope, *_one_cycle(step, steps, rate))
        torch.testing.assert_close(ours, theirs.detach())


def smooth(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    u = np.random.default_rng(seed).random((n, 2))
    return u, np.sin(5 * u[:, 0]) + u[:, 1] ** 2


@pytest.mark.parametrize("input_noise", [False, True])
def test_a_sketch_is_the_process_of_some_of_its_rows(input_noise):
    u, y = smooth(300)
    whole = GaussianProcess(nu=2.5, input_noise=input_noise).fit(u, y, np.random.default_rng(0))
    assert whole.sketch(150) is whole
    sketch = whole.sketch(50)
    assert 45 <= len(sketch.u) <= 55
    assert {tuple(row) for row in sketch.u} <= {tuple(row) for row in u}
    at = smooth(200, seed=1)[0]
    few, many = sketch(at), whole(at)
    if not input_noise:
        np.testing.assert_allclose(
            sketch(sketch.u).mean[0], y[[int(np.flatnonzero((u == r).all(1))[0]) for r in sketch.u]], atol=1e-3
        )
        assert (few.epistemic >= 0.999 * many.epistemic).all()  # fewer rows never know more
    assert np.abs(few.mu - many.mu).max() < 0.1


def test_a_process_learns_from_at_most_so_many_rows():
    u, y = smooth(90)
    fitted = GaussianProcess(most_rows=40, input_noise=False).fit(u, y, np.random.default_rng(0))
    assert len(fitted.u) == 40
    assert np.abs(fitted(u).mu - y).max() < 0.3


def test_an_estimation_sketches_its_metamodel_and_says_about_the_same():
    rng = np.random.default_rng(0)
    z = rng.standard_normal((200, 2))
    y = 1.5 - z[:, 0] + np.sin(3.0 * z[:, 1]) + 0.1 * rng.standard_normal(200)
    learned = fit_log_probability(
        GaussianProcess(nu=2.5, input_noise=False), lambda v: 0.5 + v / 10.0, CriticalInterval(high=0.0), z, y, rng
    )
    at = rng.standard_normal((300, 2)) * 2.0
    exact, rough = np.exp(learned(at)[0]), np.exp(sketch_of(learned, 60)(at)[0])
    assert not np.array_equal(exact, rough)
    assert np.abs(exact - rough).mean() < 0.06
    assert np.array_equal(np.exp(sketch_of(learned, 100)(at)[0]), exact)


def test_particles_follow_the_score_whatever_a_rough_score_says():
    def score(u: np.ndarray) -> np.ndarray:
        return stats.norm.logpdf(u[:, 0], 0.7, 0.05)

    def rough(u: np.ndarray) -> np.ndarray:
        return stats.norm.logpdf(u[:, 0], 0.6, 0.1)

    asked = []

    def counted(u: np.ndarray) -> np.ndarray:
        asked.append(len(u))
        return score(u)

    draws = [smc(counted, 2, np.random.default_rng(k), rough=rough) for k in range(5)]
    assert all(draw is not None for draw in draws)
    found = np.concatenate([draw.u for draw in draws if draw is not None])
    assert abs(found[:, 0].mean() - 0.7) < 0.005
    assert abs(found[:, 0].std() - 0.05) < 0.005
    assert abs(np.mean([draw.log_mean for draw in draws if draw is not None])) < 0.1  # the score is a density
    assert sum(asked) / 5 < 4 * 4096  # without the rough score the start alone takes 4,096 of some 20,000
    np.testing.assert_allclose(score(draws[0].u), draws[0].log_score, atol=1e-9)


def test_a_search_learns_from_few_of_many_runs_and_keeps_the_best():
    u, y = smooth(400)
    search = Search(CriticalInterval(high=-1.0), GaussianProcess(), most_rows=100)
    rng = np.random.default_rng(0)
    seen = search_data(search, u, y, None, rng)
    few = seen.thinned(search.critical.margin(seen.y), search.most_rows, rng)
    assert len(few.u) == len(few.y) == len(few.batch) == len(few.flank) == len(few.rows) == 100
    best = np.sort(seen.y)[:10]
    assert set(best) <= set(few.y)
    np.testing.assert_array_equal(few.u, u[few.rows])
    assert seen.thinned(search.critical.margin(seen.y), 400, rng) is seen

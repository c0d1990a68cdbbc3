"""What chance decides: how often runs are critical is learned beside values that are now this, now that."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import poisson

from sbt.metamodels.automatic import Auto
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.labelled import LabelledPredictor, better_labelled
from sbt.metamodels.persistence import load, save
from sbt.metamodels.saturation import Opened
from sbt.metamodels.stacking import cell_shares
from sbt.problem.requirement import CriticalInterval
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream

PROCESS = GaussianProcess(nu=2.5, input_noise=False)
Draw = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def inside(u: np.ndarray) -> np.ndarray:
    return (u[:, 0] > 0.5) & (u[:, 1] > 0.4)


def conflict(u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a time to collision: with a quarter of the seeds .5 to .8 s in a third of the space, else about 4."""
    far = 4.0 + u[:, 0] - u[:, -1] + 0.2 * rng.standard_normal(len(u))
    return np.where(inside(u) & (rng.random(len(u)) < 0.25), 0.5 + 0.3 * u[:, -1], far)


def count(u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return rng.poisson(np.exp(2.0 * u[:, 0] - 1.5 * u[:, 1] - 1.0)).astype(float)


def of_count(u: np.ndarray) -> np.ndarray:
    return poisson.sf(2, np.exp(2.0 * u[:, 0] - 1.5 * u[:, 1] - 1.0))


def sample(draw: Draw, critical: CriticalInterval, d: int, seed: int, n: int = 90) -> tuple[np.ndarray, np.ndarray]:
    """Return n even rows and their metric; the two nearest to the edge, or beyond it, are there twice."""
    rng = stream(seed, "chance")
    u = SobolSequence(d, seed).points(0, n - 2)
    y = draw(u, rng)
    again = np.argsort(critical.margin(y), kind="stable")[:2]
    return np.vstack([u, u[again]]), np.append(y, draw(u[again], rng))


def log_loss(p: np.ndarray, true: np.ndarray) -> float:
    p = np.clip(p, 1e-4, 1.0 - 1e-4)
    return float(-(true * np.log(p) + (1.0 - true) * np.log1p(-p)).mean())


@pytest.mark.parametrize(
    ("draw", "critical", "rates", "d"),
    [
        (conflict, CriticalInterval(high=1.0), lambda u: 0.25 * inside(u), 4),
        pytest.param(count, CriticalInterval(low=3.0), of_count, 2, marks=pytest.mark.slow),
    ],
    ids=["conflict", "count"],
)
def test_how_often_is_learned_of_what_chance_decides(draw: Draw, critical: CriticalInterval, rates, d: int):
    """Of a conflict with a quarter of the seeds P was learned worse than one rate for all inputs, and the share was a third."""
    at = SobolSequence(d, 99).points(0, 1000)
    true, lost, stated = rates(at), [], []
    for seed in range(1, 5):  # the first design meets no count of three
        u, y = sample(draw, critical, d, seed)
        fitted = Opened(Auto(ensemble_rows=1000).with_target(critical), critical).fit(u, y, stream(seed, "fit"))
        p = fitted(at).probability(critical)
        lost.append(log_loss(p, true))
        stated.append(float(p.mean()))
    least = log_loss(true, true)
    assert np.mean(lost) - least < 0.75 * (log_loss(np.full(len(at), true.mean()), true) - least)
    assert np.mean(stated) == pytest.approx(float(true.mean()), rel=0.4)


def test_labels_are_asked_beside_values_that_are_not_gaussian(tmp_path: Path):
    critical, at = CriticalInterval(high=1.0), SobolSequence(4, 9).points(0, 200)
    u, y = sample(conflict, critical, 4, 1)
    values, shares = PROCESS.fit(u, y, stream(1, "fit")), cell_shares(u, stream(1, "shares"))
    found = better_labelled(PROCESS, values, critical, u, y, shares, stream(1, "fit"))
    assert found is not None
    labelled, score = found
    assert 0.5 < labelled.weight <= 1.0
    assert score.shape == (90,)
    own = LabelledPredictor(labelled.process, values, critical, 0.0)
    np.testing.assert_allclose(own(at).mu, values(at).mu, rtol=1e-6, err_msg="of the values alone nothing changes")
    np.testing.assert_allclose(own(at).sigma, values(at).sigma, rtol=1e-6)
    p = labelled(at).probability(critical)
    rate, weight = np.clip(labelled.process.mu(at), 1 / 92, 91 / 92), labelled.weight
    np.testing.assert_allclose(p, weight * rate + (1.0 - weight) * own(at).probability(critical), rtol=1e-6)
    assert np.isfinite(labelled.sample_paths(at, 5, stream(1, "paths"))).all()
    assert np.corrcoef(labelled.mu(at), values.mu(at))[0, 1] > 0.8
    save(labelled, tmp_path / "m.sbtmodel")
    np.testing.assert_array_equal(load(tmp_path / "m.sbtmodel")(at).std, labelled(at).std)


def test_labels_are_not_asked_of_gaussian_noise_nor_without_noise():
    low, asked = CriticalInterval(high=0.0), 0
    for seed in range(6):
        for noise in (0.0, 0.3):
            u, y = sample(lambda u, rng, noise=noise: u[:, 0] - 0.4 + noise * rng.standard_normal(len(u)), low, 2, seed)
            values, shares = PROCESS.fit(u, y, stream(seed, "fit")), cell_shares(u, stream(seed, "shares"))
            found = better_labelled(PROCESS, values, low, u, y, shares, stream(seed, "fit"))
            assert found is None or noise > 0.0
            asked += found is not None
    assert asked <= 2

"""Learning on which side of the edge a run falls, where the metric jumps there: sharp, calibrated, and left alone elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtr

from sbt.metamodels.automatic import Auto
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.persistence import load, save
from sbt.metamodels.sided import SidedPredictor, _left_out, _signed, better_sided
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream

PROCESS = GaussianProcess(nu=2.5, input_noise=False)
LOW, HIGH = CriticalInterval(high=0.0), CriticalInterval(low=0.0)


def distance(u: Points) -> Vector:
    return np.hypot(u[:, 0] - 0.6, u[:, 1] - 0.4) - 0.25


def two_values(u: Points) -> Vector:
    return np.where(distance(u) <= 0.0, -1.0, 1.0)


def contact(u: Points) -> Vector:
    """A distance, and the speed of impact below 0."""
    return np.where(distance(u) <= 0.0, u[:, 0] - 3.0, distance(u))


def steps(u: Points) -> Vector:
    return np.floor(8.0 * distance(u)) + 0.5


def rows(seed: int, n: int = 90) -> Points:
    """Even points, and as many near the edge."""
    rng = stream(seed, "rows")
    at = rng.random((20 * n, 2))
    near = np.argsort(abs(distance(at)) + 0.1 * rng.random(len(at)))[: n // 2]
    return np.vstack([SobolSequence(2, seed).points(0, n // 2), at[near]])


def loss(p: Vector, inside: np.ndarray) -> float:
    return -float(np.log(np.clip(np.where(inside, p, 1.0 - p), 1e-9, 1.0)).mean())


@pytest.mark.parametrize("metric", [two_values, pytest.param(contact, marks=pytest.mark.slow), steps])
def test_the_sides_of_a_metric_that_jumps_are_learned_sharply_and_calibrated(metric: Callable[[Points], Vector]):
    at, found = stream(9, "at").random((4000, 2)), []
    inside = distance(at) <= 0.0
    for seed in range(4):
        u = rows(seed)
        y = metric(u)
        plain = PROCESS.fit(u, y, stream(seed, "fit"))
        p = Auto().with_target(LOW).fit(u, y, stream(seed, "fit"))(at).probability(LOW)
        wrong, expected = ((p > 0.5) != inside).mean(), np.minimum(p, 1.0 - p).mean()
        found.append((loss(p, inside) / loss(plain(at).probability(LOW), inside), wrong, expected))
    ratio, wrong, expected = np.mean(found, axis=0)
    assert ratio < {two_values: 0.5, contact: 0.7, steps: 0.95}[metric]
    assert wrong < 0.02
    assert 0.5 * wrong < expected < 4.0 * wrong + 0.01


def test_a_left_out_row_takes_part_in_no_distance():
    u = rows(1, 40)
    hit = distance(u) <= 0.0
    z, without, nearest = _signed(u, hit)
    process = PROCESS.fit(u, z, stream(1, "fit"))
    ratio = _left_out(process, u, z, without, nearest)
    centre, scale = process.shift + process.scale * process.centre, process.scale
    for i in (0, 3, 17, 25, 39):
        rest = np.arange(len(u)) != i
        others, _, _ = _signed(u[rest], hit[rest])
        covariance = process.hyper.covariance(u[rest], u[rest]) + process.hyper.noise * np.eye(len(others))
        cross = process.hyper.covariance(u[[i]], u[rest])[0]
        mean = centre + cross @ np.linalg.solve(covariance, others - centre)
        variance = process.hyper.variance + process.hyper.noise - cross @ np.linalg.solve(covariance, cross)
        assert ratio[i] == pytest.approx(mean / (scale * np.sqrt(variance)), rel=1e-6, abs=1e-8)


@pytest.mark.parametrize("critical", [LOW, HIGH])
def test_a_prediction_has_the_probability_of_the_distance_and_comes_back_from_a_file(critical: CriticalInterval, tmp_path: Path):
    rng = stream(3, "sided")
    u, at = rows(3), rng.random((500, 2))
    y = two_values(u) * (1.0 if critical is LOW else -1.0)
    found = better_sided(PROCESS, PROCESS.fit(u, y, rng), critical, u, y, np.full(len(u), 1.0 / len(u)), rng)
    assert found is not None
    sided, gain = found
    assert gain.mean() > 0.0
    moments = sided.process(at)
    p = sided(at).probability(critical)
    np.testing.assert_allclose(p, ndtr(-moments.mean[0] / (sided.factor * moments.std[0])), atol=1e-12)
    np.testing.assert_array_equal(critical.contains(sided.mu(at)), p > 0.5)
    assert (np.abs(sided.mu(at)) <= 1.5).all()
    paths = sided.sample_paths(at[:60], 400, rng)
    assert paths.shape == (400, 60)
    np.testing.assert_allclose(critical.contains(paths).mean(axis=0), p[:60], atol=0.12)
    assert isinstance(sided.sketch(30), SidedPredictor)
    save(sided, tmp_path / "m.sbtmodel")
    np.testing.assert_array_equal(load(tmp_path / "m.sbtmodel")(at).mean, sided(at).mean)


def test_it_is_left_alone_where_there_is_no_jump_where_seeds_decide_and_where_one_side_is_hardly_known():
    rng, u = stream(4, "none"), rows(4)
    def tried(u: Points, y: Vector, critical: CriticalInterval = LOW) -> object:
        return better_sided(PROCESS, PROCESS.fit(u, y, rng), critical, u, y, np.full(len(u), 1.0 / len(u)), rng)

    assert tried(u, distance(u)) is None
    coin = np.where(rng.random(len(u)) < 0.3, -1.0, 1.0)
    assert tried(u, coin) is None
    again, noisy = np.vstack([u, u[:5]]), np.concatenate([two_values(u), -two_values(u[:5])])
    assert tried(again, noisy) is None
    lone = np.where(np.arange(len(u)) < 2, -1.0, 1.0)
    assert tried(u, lone) is None
    assert tried(u, two_values(u), CriticalInterval(-2.0, 0.0)) is None
    assert tried(u, two_values(u)) is not None

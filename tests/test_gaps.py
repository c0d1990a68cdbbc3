"""A metric that jumps by a constant at the edge of M_c is learned as if it did not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import sbt
from sbt.metamodels.automatic import Auto
from sbt.metamodels.gaps import better_without_gap
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.persistence import load, save
from sbt.metamodels.warp import Warp, gap_of
from sbt.metamodels.warped import WarpedPredictor
from sbt.problem.requirement import CriticalInterval
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream

LOW, HIGH = CriticalInterval(high=0.0), CriticalInterval(low=0.0)
PROCESS = GaussianProcess(nu=2.5, input_noise=False)


def margin(u: np.ndarray) -> np.ndarray:
    return u[:, 0] + 0.5 * np.sin(5.0 * u[:, 1]) - 0.4 - 0.3 * u[:, 2]


@pytest.mark.parametrize(("critical", "sign"), [(LOW, 1.0), (HIGH, -1.0)])
def test_a_unit_without_the_gap_keeps_order_sides_and_probabilities(critical: CriticalInterval, sign: float, tmp_path: Path):
    rng, warp = stream(3, "gap"), Warp(0.0, 0.5, 2.0, gap=(0.3, 4.0))
    y = np.array([-9.0, -1.0, -0.31, 4.01, 6.0, 80.0])
    w = warp.values(y)
    assert (np.diff(w) > 0.0).all()
    assert (critical.contains(y) == warp.interval(critical).contains(w)).all()
    np.testing.assert_allclose(warp.back(w), y, rtol=1e-12)
    slope = (warp.values(y + 1e-6) - warp.values(y - 1e-6)) / 2e-6
    np.testing.assert_allclose(warp.log_slope(y), np.log(slope), atol=1e-5)

    u, at = rng.random((40, 2)), rng.random((500, 2))
    predictor = WarpedPredictor(PROCESS.fit(u, sign * (8.0 * u[:, 0] - 3.0 + u[:, 1]), rng), warp)
    found, inner = predictor(at), predictor.predictor(at)
    np.testing.assert_allclose(found.probability(critical), inner.probability(critical), rtol=1e-9, atol=1e-300)
    assert found.std[np.abs(inner.mean) < 1.0].max() < 5.0, "nor is the metric unknown where its mean is at the edge"
    save(predictor, tmp_path / "m.sbtmodel")
    np.testing.assert_array_equal(load(tmp_path / "m.sbtmodel")(at).mean, found.mean)


@pytest.mark.parametrize("noise", [0.0, 0.15])
@pytest.mark.parametrize(("critical", "sign"), [(LOW, 1.0), (HIGH, -1.0)])
def test_a_constant_that_is_added_on_one_side_changes_nothing(critical: CriticalInterval, sign: float, noise: float):
    """Before, a process climbed the jump: F1 .79 and .87 in four and five inputs after 100 runs, 1.00 without the constant."""
    rng = stream(4, "gap")
    u, at = SobolSequence(3, 0).points(0, 90), rng.random((4000, 3))
    u[-4:] = u[:4]  # repetitions tell of noise
    m = margin(u) + noise * rng.standard_normal(len(u))
    auto = Auto(**Auto.PRESETS["quick"]).with_target(critical)
    found = [auto.fit(u, sign * y, stream(5, "fit"))(at).probability(critical) for y in (m, np.where(m > 0.0, m + 3.0, m))]
    assert np.abs(found[1] - found[0]).mean() < 0.015 + 0.1 * noise
    if not noise:
        assert ((found[1] > 0.5) == (margin(at) <= 0.0)).mean() > 0.985


def test_values_on_the_other_side_that_tell_nothing_are_not_pulled_to_the_edge():
    u = SobolSequence(3, 1).points(0, 90)
    other = np.where(margin(u) > 0.0, 3.0 + 2.0 * np.abs(np.sin(9.0 * u[:, 2])), margin(u))
    assert gap_of(other, LOW) != (0.0, 0.0)
    assert better_without_gap(PROCESS, u, other, LOW, None) is None


@pytest.mark.parametrize("y", [[-1.0] * 6 + [1.0] * 6, np.linspace(-1.0, 1.0, 12), [-3.0, -2.0, 5.0, 6.0, 7.0, 8.0, 9.0]])
def test_flags_plain_metrics_and_few_values_have_no_gap(y):
    assert gap_of(np.array(y), LOW) == (0.0, 0.0)


@pytest.mark.slow
def test_noise_beside_a_jump_does_not_hide_critical_runs(tmp_path: Path):
    """.020 was stated for .113 where -0.3 and 3.3 come from equal inputs: noise seemed to be of the height of the jump."""

    def evaluate(values: dict[str, float], seed: int) -> dict[str, float]:
        m = 1.2 * values["a"] + 0.2 * np.sin(6.0 * values["b"]) - 0.1 + 0.2 * np.random.default_rng(seed).standard_normal()
        return {"m": m if m <= 0.0 else m + 3.0}

    box = [sbt.Parameter(name, 0.0, 1.0) for name in "ab"]
    scenario = sbt.Scenario("jump", box, sbt.Requirement("m", high=0.0), evaluate=evaluate)
    result = sbt.run(
        campaign="boundary", scenario=scenario, budget=80, seed=3, store=tmp_path / "s", executor="serial", report=False
    )
    x = stream(6, "at").random((20_000, 2))
    from scipy.special import ndtr

    p = ndtr(-(1.2 * x[:, 0] + 0.2 * np.sin(6.0 * x[:, 1]) - 0.1) / 0.2)
    said = result.predict(dict(zip("ab", x.T, strict=True)))["p_critical"].to_numpy()
    assert result.conclusion.critical_fraction == pytest.approx(p.mean(), abs=0.03)
    assert np.abs(said - p).mean() < 0.035


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 5])
def test_where_edges_are_known_runs_fill_the_space(seed: int, tmp_path: Path):
    """Nothing tells of the box: half of what is critical was missed in four of six campaigns."""

    def metric(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.where((np.minimum(a, b) > 0.7) & (np.maximum(a, b) < 0.95), -1.0, a + 0.5 * b - 0.25)

    box = [sbt.Parameter(name, 0.0, 1.0) for name in "ab"]
    scenario = sbt.Scenario(
        "box", box, sbt.Requirement("y", high=0.0), evaluate=lambda values, _: {"y": float(metric(values["a"], values["b"]))}
    )
    result = sbt.run(
        campaign="boundary", scenario=scenario, budget=100, seed=seed, store=tmp_path / "s", executor="serial", report=False
    )
    x = stream(6, "at").random((20_000, 2))
    said = result.predict(dict(zip("ab", x.T, strict=True)))["p_critical"].to_numpy() > 0.5
    inside = metric(*x.T) <= 0.0
    assert 2.0 * (said & inside).sum() / (said.sum() + inside.sum()) > 0.85

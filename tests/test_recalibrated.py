"""Recalibration: mends a sigma that is wrong by a factor, keeps the mean, is off unless asked for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from sbt.config.assemble import metamodel_of
from sbt.config.load import ConfigError, parse
from sbt.metamodels.extra_trees import ExtraTrees
from sbt.metamodels.persistence import load, save
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.recalibrated import Recalibrated
from sbt.seeds import stream

CONFIG = "campaign: boundary\nscenario: cut_in\nmetamodel: {{kind: et, recalibrate: {0}}}\n"


@dataclass(frozen=True)
class Wrong:
    """Says 0 +- sigma of y ~ N(0, 1)."""

    sigma: float

    def fit(self, u, y, rng):
        return lambda at: Prediction.gaussian(np.zeros(len(at)), np.full(len(at), self.sigma), np.full(len(at), self.sigma / 2))


@pytest.mark.parametrize("sigma", [0.2, 1.0, 6.0])
def test_sigma_comes_out_right_and_noise_with_it(sigma):
    y = np.random.default_rng(0).normal(size=1500)
    u = np.random.default_rng(1).random((1500, 2))
    prediction = Recalibrated(Wrong(sigma)).fit(u, y, stream(0, "fit"))(u[:5])
    np.testing.assert_allclose(prediction.sigma, 1.0, atol=0.12)
    np.testing.assert_allclose(prediction.noise / prediction.sigma, 0.5)
    few = Recalibrated(Wrong(sigma)).fit(u[:40], y[:40], stream(0, "fit"))(u[:5])
    np.testing.assert_array_equal(few.sigma, sigma)


def test_the_mean_stays_and_the_file_gives_the_same_bits(tmp_path):
    u = np.random.default_rng(1).random((80, 2))
    y = np.sin(5 * u[:, 0]) + 0.1 * u[:, 1]
    predict = Recalibrated(ExtraTrees(trees=10)).fit(u, y, stream(0, "fit"))
    plain, scaled = predict.predictor(u), predict(u)
    np.testing.assert_allclose(scaled.mu, plain.mu, atol=1e-12)
    np.testing.assert_allclose(scaled.sigma, predict.factor * plain.sigma)
    save(predict, tmp_path / "m.sbtmodel")
    np.testing.assert_array_equal(load(tmp_path / "m.sbtmodel")(u).std, scaled.std)


def test_it_is_an_option_of_the_configuration():
    assert isinstance(metamodel_of(parse(CONFIG.format("true"))), Recalibrated)
    assert isinstance(metamodel_of(parse(CONFIG.format("false"))), ExtraTrees)
    with pytest.raises(ConfigError, match=r"3:\d+: metamodel.recalibrate: must be true or false, but got 3"):
        metamodel_of(parse(CONFIG.format("3")))

"""P(critical | inputs) over the traffic that seeds draw: learned from pairs, kept in the store, right where it is known."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtr

import sbt
from sbt.loop.drawn_traffic import decoded, encoded
from sbt.metamodels.over_traffic import OverTrafficPrediction
from sbt.metamodels.prediction import Prediction
from sbt.problem.requirement import CriticalInterval
from sbt.store.database import Store
from sbt.workflows.study import Study

X = np.linspace(-0.98, 0.98, 50)


@dataclass(frozen=True)
class Drawn:
    """y = 1 + x + w + .3 e + far <= 0 is critical: w drawn by the seed and told (or another number is), e noise."""

    told: bool = True
    far: float = 0.0

    def __call__(self, values: dict[str, float], seed: int) -> dict[str, float]:
        w, e = np.random.default_rng(seed).standard_normal(2)
        return {"y": float(1.0 + values["x"] + w + 0.3 * e + self.far), "z": float(w)}

    def known_before(self, values: dict[str, float], seed: int) -> dict[str, float]:
        rng = np.random.default_rng(seed if self.told else (seed, 1))
        return {"w": float(rng.standard_normal())}


RATE = ndtr((-1.0 - X) / math.hypot(1.0, 0.3))


def run(folder: Path, **keys: object) -> sbt.Result:
    inputs = [sbt.Parameter("x", -1, 1), sbt.Parameter("idle", 0, 1)]
    given = {
        "campaign": "boundary", "seed": 2, "budget": 100, "executor": "serial", "report": False, "metamodel": "gp",
        "store": folder,
        "scenario": sbt.Scenario(
            "drawn", inputs, sbt.Requirement("y", high=0.0), evaluate=keys.pop("evaluate", Drawn()), metric_names=("y", "z")
        ),
    }  # fmt: skip
    return sbt.run(**{**given, **keys})


def error(result: sbt.Result) -> float:
    found = np.asarray(result.predict({"x": X, "idle": 0.5})["p_critical"])
    return float(np.sqrt(np.mean((found - RATE) ** 2)) / RATE.std())


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> sbt.Result:
    return run(tmp_path_factory.mktemp("over_traffic") / "store")


def test_p_over_traffic_is_nearer_the_truth_than_that_of_inputs_alone(result: sbt.Result) -> None:
    assert error(result) < 0.35
    assert result.conclusion.critical_fraction == pytest.approx(RATE.mean(), rel=0.3)


def test_half_of_what_is_chosen_has_chosen_seeds_and_nothing_else_has(result: sbt.Result) -> None:
    frame = result.frame
    later = frame[(frame.iteration >= 5) & (frame.stage == "boundary")]
    assert 0.3 < later.seed_chosen.mean() <= 0.5
    assert not frame[frame.stage != "boundary"].seed_chosen.any(), "held-out runs, repeats and the first batch have drawn seeds"
    assert frame[frame.seed_chosen].seed.is_unique
    w = np.array([np.random.default_rng(seed).standard_normal() for seed in later.seed])
    doubt, chosen = np.abs(1.0 + later["x.x"].to_numpy() + w), later.seed_chosen.to_numpy()
    assert np.median(doubt[chosen]) < 0.6 * np.median(doubt[~chosen]), "they lie where it is in doubt whether a pair is critical"
    assert not result.history.training.columns["seed_chosen"].any()


def test_a_store_tells_the_same_p_without_the_code_of_its_scenario(result: sbt.Result) -> None:
    with Store.read(result.store) as store:
        study, fit, history = Study.from_store(store), store.fits()[-1], store.history()
    assert study.covariates is None
    assert study.learner is not None
    assert study.learner.traffic is not None
    traffic = study.learner.traffic
    p = traffic.means(history)
    assert encoded(p) == fit.over_traffic
    fitted = study.fit(history)
    assert fitted.record.critical_fraction == pytest.approx(fit.critical_fraction, abs=1e-9)
    assert fitted.record.sides == fit.sides
    at = fitted.predict(traffic.points).probability(study.scenario.requirement.critical)
    assert np.corrcoef(at, p)[0, 1] > 0.85
    assert p.min() - 1e-9 <= at.min() <= at.max() <= p.max() + 1e-9


def test_a_campaign_that_stopped_and_went_on_in_other_processes_has_the_same_pairs(tmp_path: Path) -> None:
    more = {"initial": 15, "batch": 15}
    whole = run(tmp_path / "whole", budget=75, **more).frame
    run(tmp_path / "parts", budget=45, **more)
    parts = run(tmp_path / "parts", budget=75, executor={"kind": "local", "workers": 2}, **more).frame
    columns = ["x.x", "x.idle", "seed", "y.y", "seed_chosen"]
    assert whole.seed_chosen.any()
    assert whole[columns].equals(parts[columns])


@dataclass(frozen=True)
class Failing(Drawn):
    """Runs with w > 0 (or below -0.5) give no metric."""

    low: bool = False

    def __call__(self, values: dict[str, float], seed: int) -> dict[str, float]:
        w = np.random.default_rng(seed).standard_normal()
        if w < -0.5 if self.low else w > 0.0:
            raise ValueError("blocked")
        return super().__call__(values, seed)


@pytest.mark.slow
@pytest.mark.parametrize("low", [False, True])
def test_traffic_with_which_runs_fail_is_not_that_of_those_that_give_a_metric(low: bool, tmp_path: Path) -> None:
    w, e = np.random.default_rng(5).standard_normal((2, 20_000))
    gives = w >= -0.5 if low else w <= 0.0
    rate = np.array([((1.0 + x + w + 0.3 * e <= 0.0) & gives).sum() / gives.sum() for x in X])
    found = run(tmp_path / "failing", evaluate=Failing(low=low), budget=150)
    p = np.asarray(found.predict({"x": X, "idle": 0.5})["p_critical"])
    assert found.conclusion.over_traffic is not None
    assert float(np.sqrt(np.mean((p - rate) ** 2))) < 0.12
    assert found.conclusion.over_traffic.chosen == int(found.frame.seed_chosen.sum())


def test_of_a_combination_seeds_are_not_chosen(tmp_path: Path) -> None:
    both = {"all": [{"metric": "y", "critical": [None, 0.0]}, {"metric": "z", "critical": [None, 1.0]}]}
    found = run(tmp_path / "both", budget=60, requirement=both)
    assert not found.frame.seed_chosen.any(), "P(critical) of a combination is that of its metamodels of the inputs"


@pytest.mark.slow
def test_what_pairs_tell_of_rare_critical_runs_is_known(tmp_path: Path) -> None:
    found = run(tmp_path / "rare", evaluate=Drawn(far=1.6), budget=105)
    frame = found.frame
    drawn = int(frame[~frame.seed_chosen & (frame.stage == "boundary")].critical.sum())
    assert found.conclusion.over_traffic is not None
    assert int(frame.critical.sum()) >= 10 > 2 * drawn
    assert not any("critical run tells of it" in text for text in found.sentences())


def test_traffic_that_tells_nothing_is_not_looked_at(tmp_path: Path) -> None:
    found = run(tmp_path / "useless", evaluate=Drawn(told=False))
    assert [fit.over_traffic for fit in found.fits[-4:]] == [None] * 4
    assert not found.frame[found.frame.iteration == found.frame.iteration.max()].seed_chosen.any()


def test_without_covariates_nothing_of_it_is_there(tmp_path: Path) -> None:
    off = run(tmp_path / "off", budget=60, covariates=False)
    assert not off.frame.seed_chosen.any()
    assert {fit.over_traffic for fit in off.fits} == {None}


def test_a_prediction_over_traffic_has_its_own_p_and_all_else_of_its_values() -> None:
    critical, p = CriticalInterval(high=0.0), np.array([0.1, 0.5, 1e-6])
    values = Prediction.gaussian(np.array([1.0, 2.0, 3.0]), np.ones(3))
    found = OverTrafficPrediction.of(values, critical, p)
    assert found.probability(critical) == pytest.approx(p)
    log_p, log_not = found.log_probability(critical)
    assert np.exp(log_p) + np.exp(log_not) == pytest.approx(np.ones(3))
    other = CriticalInterval(high=1.0)
    assert found.probability(other) == pytest.approx(values.probability(other))
    assert found.mu == pytest.approx(values.mu)
    assert found.quantile(0.9) == pytest.approx(values.quantile(0.9))
    parts = found.take(slice(0, 1)), found.take(np.array([1, 2]))
    whole = parts[0].joined(parts[1:])
    assert whole.probability(critical) == pytest.approx(p)
    assert whole.log_density(np.zeros(3)) == pytest.approx(values.log_density(np.zeros(3)))


def test_rates_survive_being_written() -> None:
    p = np.concatenate([[0.0, 1.0], np.geomspace(1e-6, 1.0, 50)])
    assert decoded(encoded(p)) == pytest.approx(p, rel=0.02, abs=1e-8)

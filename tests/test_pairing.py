"""Estimation by pairs of inputs and seed: unbiased, told in the store, left where the seed decides nothing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtr

import sbt
from sbt.metamodels import risk as risk_module
from sbt.metamodels.extra_trees import ExtraTrees
from sbt.metamodels.risk import fit_risk
from sbt.problem.requirement import CriticalInterval
from sbt.samplers.noise import scores
from sbt.samplers.pairs import _picked, propose_pairs
from sbt.samplers.search import Search
from sbt.seeds import stream


class Crossing:
    """Critical where the car that the seed draws comes close, at some `a` more often than at others; drivers add noise."""

    def __init__(self, scale: float = 1.0, noise: float = 0.1) -> None:
        self.scale, self.noise = scale, noise

    def __call__(self, values: dict[str, float], seed: int) -> dict[str, float]:
        late, noise = stream(seed, "car").random(), self.noise * stream(seed, "driver").standard_normal()
        return {"gap": 2.0 * self.scale * abs(values["a"] - 0.7) + 6.0 * self.scale * abs(late - 0.5) + noise - 0.6}

    def known_before(self, values: dict[str, float], seed: int) -> dict[str, float]:
        return {"late": stream(seed, "car").random()}


class Deterministic(Crossing):
    def __call__(self, values: dict[str, float], seed: int) -> dict[str, float]:
        return {"gap": values["a"] - 0.05}


def run(folder: Path, source: object, **keys: object) -> sbt.Result:
    scenario = sbt.Scenario(
        "one_car", [sbt.Parameter("a", 0, 1), sbt.Parameter("b", 0, 1)], sbt.Requirement("gap", high=0.0), evaluate=source
    )
    given = {"campaign": "estimation", "scenario": scenario, "seed": 3, "budget": 200, "report": False, "executor": "serial"}
    return sbt.run(**{**given, "store": folder, **keys})


def crude(source: Crossing, n: int) -> float:
    """Return the share of critical runs, whose seeds draw as `Crossing` does."""
    rng = stream(0, "crude")
    gap = 2.0 * source.scale * abs(rng.random(n) - 0.7) + 6.0 * source.scale * abs(rng.random(n) - 0.5)
    return float((gap + source.noise * rng.standard_normal(n) <= 0.6).mean())


def test_pairs_estimate_with_fewer_runs_and_say_so(tmp_path: Path) -> None:
    truth = crude(Crossing(), 1_000_000)
    whole = run(tmp_path / "whole", Crossing(), stop={"cov": None})
    found, frame = whole.conclusion, whole.frame
    assert found.low <= truth <= found.high
    assert found.probability == pytest.approx(truth, rel=4.0 * found.cov)
    assert found.cov < 0.75 * np.sqrt((1.0 - truth) / truth / 200), "crude Monte Carlo needs almost twice the runs"
    assert found.pairs >= 10 * found.counted
    drawn = frame[frame.stage == "estimation"]
    assert 0.1 < 1.0 - drawn.seed_chosen.mean() < 0.4, "some of the pairs are drawn without a look"
    blind = drawn[~drawn.seed_chosen]
    assert blind.critical.mean() < 0.5 * drawn.critical.mean()
    assert not whole.history.training.columns["seed_chosen"].any()
    said = " ".join(whole.sentences())
    assert f"{found.counted:,} of {found.pairs:,} random pairs" in said
    parts = run(tmp_path / "parts", Crossing(), budget=160, stop={"cov": None}).frame
    columns = ["x.a", "seed", "y.gap", "seed_chosen", "log_q"]
    assert parts[parts.iteration <= 4][columns].equals(frame[frame.iteration <= 4][columns]), "a function of the log"
    again = whole.estimate()
    assert again.low <= truth <= again.high, "draws with known densities count again"


def test_the_inputs_alone_are_searched_where_seeds_decide_nothing_or_pairs_are_too_rare(tmp_path: Path) -> None:
    same = run(tmp_path / "same", Deterministic(), budget=60)
    assert same.conclusion.pairs is None
    assert same.conclusion.low <= 0.05 <= same.conclusion.high
    rare = run(tmp_path / "rare", Crossing(scale=100.0, noise=0.0), budget=45)
    assert rare.conclusion.pairs is None
    off = run(tmp_path / "off", Crossing(), budget=40, covariates=False)
    assert not off.frame.seed_chosen.any()


@pytest.mark.parametrize("hits", [0, 3, 40])
def test_a_risk_ranks_pairs_and_has_the_mean_of_the_runs(hits: int) -> None:
    rng = stream(hits, "risk")
    u = rng.random((300, 3))
    margin = u[:, 0] + 0.1 * rng.standard_normal(300)
    critical = margin <= (np.sort(margin)[hits - 1] if hits else -np.inf)
    risk = fit_risk(u, scores(margin), margin, critical, rng)
    fresh = rng.random((2000, 3))
    log_p, log_rest = risk(fresh)
    assert np.allclose(np.exp(log_p) + np.exp(log_rest), 1.0)
    assert np.exp(risk(u)[0]).mean() < 3.0 * (hits + 0.5) / 301
    near, far = (np.exp(log_p[side]).mean() for side in (fresh[:, 0] < 0.1, fresh[:, 0] > 0.6))
    assert near > 3.0 * far


@pytest.mark.parametrize("smooth", [True, False])
def test_a_process_takes_part_in_a_risk_where_it_tells_more(smooth: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a smooth margin P is much sharper than by forests; of one that hides in noise nothing changes."""
    rng = stream(1, "smooth", str(smooth))

    def labelled(n: int):
        u = rng.random((n, 8))
        margin = (u[:, :4] ** 2).sum(axis=1) - 0.55 + (0.02 if smooth else 1.0) * rng.standard_normal(n)
        return 100.0 * u, margin, margin <= (0.0 if smooth else -1.2)  # inputs in any units

    (u, margin, critical), (fresh, _, truth) = labelled(500), labelled(4000)

    def loss() -> float:
        log_p, log_rest = fit_risk(u, scores(margin), margin, critical, stream(2, "fit"))(fresh)
        return -float(np.where(truth, log_p, log_rest).mean())

    both = loss()
    monkeypatch.setattr(risk_module, "fit_process", lambda *_: None)
    assert both < 0.7 * loss() if smooth else both <= 1.02 * loss()


def test_a_skewed_covariate_tells_what_its_logarithm_tells() -> None:
    """The unit of a covariate does not decide how well it is learned: its exponential serves as well as itself."""
    rng = stream(6, "skewed")
    w, fresh = (rng.standard_normal((n, 2)) for n in (300, 4000))
    margin = w[:, 0] + 0.5 * w[:, 1] + 0.1 * rng.standard_normal(300) + 1.5
    truth = fresh[:, 0] + 0.5 * fresh[:, 1] + 0.1 * rng.standard_normal(4000) + 1.5 <= 0.0

    def loss(told: Callable[[np.ndarray], np.ndarray]) -> float:
        risk = fit_risk(told(w), scores(margin), margin, margin <= 0.0, stream(7, "fit"))
        log_p, log_rest = risk(told(fresh))
        return -float(np.where(truth, log_p, log_rest).mean())

    assert loss(lambda v: np.exp(4.0 * v)) < 1.25 * loss(lambda v: v)


class RareCar(Crossing):
    """Critical for one seed in 500 by what the seed draws alone, which the covariate tells."""

    def __call__(self, values: dict[str, float], seed: int) -> dict[str, float]:
        noise = 0.001 * stream(seed, "driver").standard_normal()
        return {"gap": stream(seed, "car").random() + 0.001 * values["a"] - 0.0025 + noise}


def test_pairs_go_on_where_the_traffic_decides_and_nothing_critical_was_met(tmp_path: Path) -> None:
    """A search among few pairs met fewer than three critical ones; pools of thousands meet them, inputs alone do not."""
    truth, found = 0.002, []
    for seed in range(3):
        scenario = sbt.Scenario(
            "rare", [sbt.Parameter("a", 0, 1)], sbt.Requirement("gap", high=0.0), evaluate=RareCar(), metric_names=("gap",)
        )
        result = sbt.run(
            campaign="estimation", scenario=scenario, budget=200, seed=seed, covariates=True, store=tmp_path / str(seed),
            executor="serial", report=False,
        )  # fmt: skip
        assert result.conclusion.pairs
        assert result.conclusion.low <= truth <= result.conclusion.high
        found.append(result.conclusion.probability)
    assert 0.5 * truth < np.mean(found) < 1.5 * truth


def test_a_fifth_of_the_pairs_leaves_a_trap() -> None:
    """Whatever promises more near the runs there are, two of ten pairs are the best of those that lie far from all of them."""
    value = np.arange(100.0)
    picked = _picked(np.zeros((100, 2)), np.arange(100), np.tile(value, (60, 1)), None, value >= 50.0, 10, stream(5, "trap"))
    assert sorted(picked.seeds) == [*range(8), 50, 51]


def test_pairs_have_traffic_of_their_own_and_the_process_chooses_in_turn() -> None:
    rng = stream(4, "turn")
    u, seeds, y = rng.random((30, 2)), np.arange(30), rng.random(30)
    search = Search(CriticalInterval(high=0.1), ExtraTrees(trees=5))
    found = propose_pairs(search, lambda points, _: points[:, :1], u, seeds, y, 10, stream(5, "turn"))
    assert len(set(found.seeds) - set(seeds.tolist())) == 10
    value = np.arange(100.0)
    picked = _picked(np.zeros((100, 2)), np.arange(100), np.tile(value, (60, 1)), -value, value >= 0.0, 10, stream(5, "turn"))
    assert {95, 96, 97, 98, 99} <= set(picked.seeds)
    assert {0, 1, 2, 3} <= set(picked.seeds)


def test_a_boundary_says_what_of_the_doubt_is_the_traffics(tmp_path: Path) -> None:
    """By hand: the variance of "critical" between inputs, between traffics of the same inputs, and what is left to drivers."""
    a, late = (np.linspace(0.0, 1.0, 401) + 0.5 / 401)[:400], (np.linspace(0.0, 1.0, 401) + 0.5 / 401)[:400]
    gap = 2.0 * abs(a[:, None] - 0.7) + 6.0 * abs(late[None, :] - 0.5) - 0.6
    p = ndtr(-gap / 0.1)
    whole = p.mean() * (1.0 - p.mean())
    found = run(tmp_path / "doubt", Crossing(), campaign="boundary", metamodel="et", budget=300).conclusion.doubt
    assert found.critical_fraction == pytest.approx(p.mean(), rel=0.35)
    assert found.inputs + found.traffic + found.rest == pytest.approx(1.0)
    assert found.inputs == pytest.approx(p.mean(axis=1).var() / whole, abs=0.05)
    assert 0.5 * p.var(axis=1).mean() / whole < found.traffic < 1.2 * p.var(axis=1).mean() / whole

"""Laws of what the boundary campaign chooses: particles, greedy picks, the mix, and when it is sure."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from studies import run_loaded, settings_of
from typer.testing import CliRunner

import sbt
from sbt import testbeds
from sbt.acquisitions import expected_feasibility, straddle
from sbt.campaigns.exploration import fruitless_runs, should_explore
from sbt.campaigns.records import BatchProposal
from sbt.campaigns.repeats import REPEAT
from sbt.campaigns.settings import Settings
from sbt.cli import app
from sbt.config.load import parse
from sbt.loop.learner import FittedMetamodel, Learner
from sbt.loop.stages import Log
from sbt.metamodels.automatic import Auto
from sbt.metamodels.base import sample_paths, simplest
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.recalibrated import Recalibrated
from sbt.problem.requirement import CriticalInterval
from sbt.samplers.greedy import influence_on_mean, refine_diverse, select_diverse, select_representative
from sbt.samplers.smc import smc
from sbt.samplers.surface import crossings
from sbt.seeds import stream
from sbt.store.database import Store
from sbt.store.history import VALIDATION, History, Record
from sbt.store.records import FitRecord, Iteration


def test_particles_have_the_density_of_the_score():
    centre, width = np.array([0.3, 0.7, 0.5]), 0.02

    def score(u: np.ndarray) -> np.ndarray:
        return -0.5 * (((u - centre) / width) ** 2).sum(axis=1)

    draw = smc(score, 3, stream(1, "smc"), particles=2000)
    assert draw is not None
    np.testing.assert_allclose(draw.u.mean(axis=0), centre, atol=4 * width / math.sqrt(500))
    np.testing.assert_allclose(draw.u.std(axis=0), width, rtol=0.15)
    assert draw.log_mean == pytest.approx(1.5 * math.log(2 * math.pi) + 3 * math.log(width), abs=0.3)


def test_mean_of_nominal_over_proposal_is_the_volume_of_the_support():
    """With q = a / Z on a support of volume V, the mean of Z / a over draws from q is V: of p / q it is 1."""

    def score(u: np.ndarray) -> np.ndarray:
        inside = (np.abs(u - 0.25) < 0.05).all(axis=1)
        return np.where(inside, np.log(np.maximum(0.2 + 8.0 * (u[:, 0] - 0.2), 0.1)), -np.inf)

    ratios = []
    for seed in range(8):
        draw = smc(score, 2, stream(seed, "law"), particles=1000)
        assert draw is not None
        assert np.isfinite(draw.log_score).all()
        ratios.append(np.mean(np.exp(draw.log_mean - draw.log_score)) / 0.01)
    assert np.mean(ratios) == pytest.approx(1.0, abs=4 * np.std(ratios, ddof=1) / math.sqrt(8))
    assert np.std(ratios) < 0.3


def test_no_region_no_particles():
    assert smc(lambda u: np.full(len(u), -np.inf), 2, stream(0, "none")) is None


def test_influence_is_the_root_of_the_total_effect():
    def predict(u: np.ndarray) -> Prediction:
        return Prediction.gaussian(4 * u[:, 0] + 2 * u[:, 1], np.ones(len(u)))

    found = influence_on_mean(predict, 3, stream(0, "influence"))
    np.testing.assert_allclose(found[:2], [1.0, 0.5], rtol=0.25)
    assert found[2] == 0.05


def test_greedy_picks_are_good_and_apart():
    rng = stream(2, "greedy")
    u = rng.random((2000, 2))
    log_score = -50 * np.abs(u[:, 0] - 0.5)
    there = np.array([[0.5, 0.5]])
    picks = select_diverse(u, log_score, there, 12, np.ones(2))
    assert len(set(picks.tolist())) == 12
    assert (np.abs(u[picks, 0] - 0.5) < 0.06).all()
    chosen = np.vstack([there, u[picks]])
    gaps = np.linalg.norm(chosen[:, None] - chosen[None], axis=2)[np.triu_indices(13, 1)]
    assert gaps.min() > 0.04
    assert len(select_diverse(u, np.full(2000, -np.inf), there, 3, np.ones(2))) == 0
    assert len(select_diverse(there, np.zeros(1), there, 3, np.ones(2))) == 0  # nobody's duplicate


def test_refinement_finds_a_small_region():
    def score(u: np.ndarray) -> np.ndarray:
        return -np.linalg.norm(u - 0.123, axis=1)

    start = stream(3, "start").random((500, 4))
    u, value = refine_diverse(score, start, np.ones(4), stream(3, "refine"))
    np.testing.assert_array_equal(value, score(u))
    assert value.max() > 0.4 * score(start).max()


@pytest.mark.parametrize("critical", [CriticalInterval(high=0.3), CriticalInterval(low=-1.0, high=0.5)])
def test_expected_feasibility_is_the_expectation(critical: CriticalInterval):
    rng = stream(4, "mc")
    mu, sigma = rng.normal(size=6), rng.uniform(0.2, 2.0, 6)
    y = mu + sigma * rng.standard_normal((200_000, 6))
    ends = [z for z in (critical.low, critical.high) if math.isfinite(z)]
    expected = np.max([np.maximum(2 * sigma - np.abs(y - z), 0).mean(axis=0) for z in ends], axis=0)
    got = np.exp(expected_feasibility(Prediction.gaussian(mu, sigma), critical, np.zeros(6)))
    np.testing.assert_allclose(got, expected, rtol=0.03, atol=2e-3)


def test_straddle():
    belief = Prediction.gaussian([0.0, 3.0, 3.0], [1.0, 1.0, 4.0])
    got = np.exp(straddle(belief, CriticalInterval(high=0.0), np.zeros(3)))
    np.testing.assert_allclose(got, [1.96, 0.0, 1.96 * 4 - 3])


def run(folder: Path, **keys: Any) -> dict[str, Any]:
    lines = [f"{key}: {value}" for key, value in keys.items()]
    base = ["campaign: boundary", "executor: {kind: serial}", f"store: {folder / 'store'}"]
    return run_loaded(parse("\n".join([*base, *lines])), report=False)


@dataclass(frozen=True)
class Targeted:
    """Keeps the critical intervals that it was given."""

    targets: list[CriticalInterval] = field(default_factory=list)

    def with_target(self, critical: CriticalInterval) -> Targeted:
        self.targets.append(critical)
        return self

    def fit(self, u: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> Any:
        return lambda at: Prediction.gaussian(np.zeros(len(at)), np.ones(len(at)))


@pytest.mark.parametrize(("campaign", "times"), [("boundary", 1), ("falsification", 1), ("estimation", 1), ("coverage", 0)])
def test_campaigns_that_look_for_the_edge_hand_it_to_the_metamodel(campaign: str, times: int):
    loaded = parse(f"campaign: {campaign}\nscenario: 'testbed:cut_in_near_miss:box'\nmetamodel: {{kind: et}}\n")
    settings, targeted = settings_of(loaded), Targeted()
    names, metric = settings.scenario.space.names, settings.scenario.requirement.metric
    runs = [
        Record(i, "initial", 0, dict(zip(names, x, strict=True)), i, "ok", {metric: i + 0.1})
        for i, x in enumerate(settings.scenario.space.from_unit(stream(0, "runs").random((3, len(names)))).tolist())
    ]
    assert settings.learner is not None
    learner = replace(settings.learner, metamodel=Recalibrated(targeted))
    learner.train(History.of(names, runs))
    assert targeted.targets == [CriticalInterval(high=0.6)] * times  # no run lies below 0


def test_a_bound_spares_scores_and_changes_no_particle():
    asked: list[int] = []

    def score(u: np.ndarray) -> np.ndarray:
        asked.append(len(u))
        return -200.0 * ((u - 0.3) ** 2).sum(axis=1)

    plain = smc(score, 3, stream(1, "smc"), particles=256, start=512)
    without = sum(asked)
    asked.clear()
    spared = smc(score, 3, stream(1, "smc"), particles=256, start=512, bound=lambda u: -190.0 * ((u - 0.3) ** 2).sum(axis=1))
    assert plain is not None
    assert spared is not None
    np.testing.assert_array_equal(plain.u, spared.u)
    assert sum(asked) < 0.7 * without


def test_a_process_alone_in_a_mixture_draws_functions_as_it_does_itself():
    u = stream(0, "rows").random((60, 2))
    y = np.sin(5 * u[:, 0]) + u[:, 1]
    mixed = Auto(ensemble_rows=10**6).with_target(CriticalInterval(high=0.0)).fit(u, y, stream(0, "fit"))
    assert mixed.comparison.weights["gp"] == 1.0
    line = np.column_stack([np.linspace(0, 1, 200), np.full(200, 0.5)])
    drawn, own = (sample_paths(p, line, 50, stream(1, "draws")) for p in (mixed, mixed.predictors[0]))
    np.testing.assert_array_equal(drawn.shape, (50, 200))
    np.testing.assert_allclose(np.abs(np.diff(drawn)).max(), np.abs(np.diff(own)).max(), rtol=0.3)
    blind = Auto(ensemble_rows=10**6).fit(u, np.round(y), stream(0, "fit"))
    assert 0 < blind.comparison.weights["et"] < 1
    assert sample_paths(blind, line, 50, stream(1, "draws")).shape == (50, 200)
    assert simplest(Auto()) == GaussianProcess(nu=2.5, input_noise=False)


@pytest.mark.parametrize("method", ["mix", "boundary", "u", "straddle", "expected_feasibility"])
def test_every_rule_finds_the_boundary(tmp_path: Path, method: str):
    result = run(
        tmp_path, scenario="'testbed:cut_in_crash:box'", budget=90, initial=30, batch=20, acquisition=f"{{kind: {method}}}",
        validation="{share: 0, reference: 400}",
    )  # fmt: skip
    assert result["conclusion"]["validation"]["f1"] > 0.85
    with Store.read(tmp_path / "store") as store:
        history = store.history()
    chosen, again = history.x[history.stage != VALIDATION], history.where(history.stage == REPEAT)
    repeats, critical = len(again), testbeds.find("cut_in_crash:box").scenario().requirement.critical_runs(again)
    assert repeats == 2 + int(critical[2:].sum())  # two, and critical runs that stand alone
    assert critical.sum() <= 3
    assert len(np.unique(chosen, axis=0)) == len(chosen) - repeats
    assert len(chosen) == 90


@pytest.mark.parametrize(("share", "filling"), [(0.1, 0), (0.0, 8)])
def test_shares_of_the_mix(tmp_path: Path, share: float, filling: int):
    """Ten percent fill the space, held-out runs included; of the others four fifths are representative."""
    keys = {"scenario": "'testbed:cut_in_crash:box'", "budget": 120, "initial": 40, "batch": 20}
    run(tmp_path, **keys, validation=f"{{share: {share}}}")
    with Store.read(tmp_path / "store") as store:
        batches = [batch.read(BatchProposal) for batch in store.iterations()[1:]]
    assert [batch.method for batch in batches] == ["mix"] * 4
    parts = ("explored", "filling", "representative", "greedy", "held_out", "repeats")
    counted = {part: sum(getattr(batch, part) or 0 for batch in batches) for part in parts}
    assert sum(counted.values()) == 80
    assert counted["explored"] == 0  # 14 % of the space is critical
    assert counted["filling"] + counted["held_out"] == 8
    assert counted["filling"] == filling
    assert counted["representative"] == pytest.approx(0.8 * (72 - counted["repeats"]), abs=2)
    assert [batch.repeats for batch in batches][:2] == [2, None]
    assert sum(batch.repeats or 0 for batch in batches) <= 5  # critical runs that stand alone are repeated later


def test_representative_picks_leave_little_weight_far_from_a_run():
    rng = stream(7, "representative")
    u, weight, there = rng.random((300, 3)), rng.random(300), rng.random((10, 3))
    scale = np.array([1.0, 0.5, 0.05])

    def left(picks: tuple[int, ...]) -> float:
        runs = np.concatenate([there, u[list(picks)]]) * scale
        return float(weight @ cdist(u * scale, runs, "sqeuclidean").min(axis=1))

    picks = tuple(select_representative(u, weight, there, 6, scale).tolist())
    assert len(set(picks)) == 6
    best = min(left((k,)) for k in range(300))
    assert left(picks[:1]) == pytest.approx(best)
    random = [left(tuple(rng.choice(300, 6, replace=False))) for _ in range(200)]
    assert left(picks) < min(random)
    assert len(select_representative(there, np.ones(10), there, 3, scale)) == 0  # nobody's duplicate
    assert len(select_representative(u, np.where(u[:, 0] < 0.5, 1.0, 0.0), u[u[:, 0] < 0.5], 3, scale)) == 0  # no weight is left


def log_of(batches: list[tuple[int, list[tuple[float, float]]]]) -> Log:
    """Return a log of batches (runs that explored, x and y of each run); critical is y <= 0, one input."""
    rows, iterations = [], []
    for k, (explored, runs) in enumerate(batches):
        iterations.append(Iteration(k, "boundary", {"method": "mix", "next_position": 0, "explored": explored}))
        for x, y in runs:
            rows.append(Record(len(rows), "boundary", k, {"x": x}, 0, "ok", {"y": y}))
    return Log(History.of(("x",), rows), tuple(iterations), ())


def with_budget(budget: int) -> Settings:
    scenario = testbeds.analytic(lambda x: x[:, 0], inputs={"x": (0.0, 1.0)}, critical=(-math.inf, 0.0), name="line")
    learner = Learner(scenario, GaussianProcess(), 0)
    return Settings(scenario=scenario, seed=0, budget=budget, initial=5, batch=5, learner=learner)


NEVER, HIT = [(0.2, 1.0), (0.4, 1.0), (0.6, 1.0)], [(0.1, -1.0), (0.2, 1.0), (0.3, 1.0)]


def test_exploration_ends_when_it_found_nothing_new_for_a_fifth_of_the_budget():
    records = (FitRecord(9, p, 0.0, 0.0, "") for p in (1e-3, 0.1))
    rare, common = (FittedMetamodel(lambda u: Prediction.gaussian(u, u), record, 0.0) for record in records)
    nothing = log_of([(0, NEVER)] + [(2, NEVER)] * 9)
    assert fruitless_runs(with_budget(40), nothing) == 0  # as long as nothing critical is known, nothing else is worth more
    assert should_explore(with_budget(40), rare, nothing)
    assert should_explore(with_budget(40), common, nothing)  # none of the runs that fill the space was critical
    seen = log_of([(0, [(0.1 * k, -1.0 if k < 3 else 1.0) for k in range(10)]), (2, NEVER)])
    assert not should_explore(with_budget(40), common, seen)
    assert not should_explore(with_budget(40), rare, seen)  # three of ten: they deny it
    before = [(0, NEVER), (2, HIT)]
    spent = [fruitless_runs(with_budget(40), log_of(before + [(2, NEVER)] * n)) for n in range(6)]
    assert spent == [0, 2, 4, 6, 8, 10]
    on = [should_explore(with_budget(40), rare, log_of(before + [(2, NEVER)] * n)) for n in range(6)]
    assert on == [True] * 4 + [False] * 2
    same = log_of([*before, (2, NEVER), (2, [(0.15, -1.0), (0.3, 1.0)])])
    another = log_of([*before, (2, NEVER), (2, [(0.3, 1.0), (0.9, -1.0)])])
    by_the_mix = log_of([*before, (2, NEVER), (1, [(0.3, 1.0), (0.9, -1.0)])])
    assert [fruitless_runs(with_budget(40), log) for log in (same, another, by_the_mix)] == [4, 0, 3]


SMALL = """
import numpy as np
from sbt.testbeds import analytic

def discs(x):
    return np.minimum(np.hypot(x[:, 0] - 0.2, x[:, 1] - 0.3), np.hypot(x[:, 0] - 0.8, x[:, 1] - 0.7)) - 0.02

DISCS = analytic(discs, inputs={"a": (0.0, 1.0), "b": (0.0, 1.0)}, critical=(-np.inf, 0.0), name="two small discs")
"""


def test_small_regions_are_searched_for_until_all_are_known(tmp_path: Path):
    (tmp_path / "small.py").write_text(SMALL)
    run(tmp_path, scenario=f"'{tmp_path / 'small.py'}:DISCS'", budget=100, initial=10, batch=10, seed=4)
    with Store.read(tmp_path / "store") as store:
        batches, history = [batch.read(BatchProposal) for batch in store.iterations()], store.history()
    hits = history.x[history.y("y") <= 0.0]
    assert len(np.unique(hits[:, 0] > 0.5)) == 2  # both regions
    explored = np.array([batch.explored or 0 for batch in batches])
    assert explored[1] > 0
    assert explored[-1] == 0


def test_stops_where_little_is_expected_on_the_wrong_side(tmp_path: Path):
    keys = {"scenario": "'testbed:wavy_level_d3:box'", "budget": 400, "initial": 40, "batch": 40, "seed": 1}
    result = run(tmp_path, **keys, stop="{misclassified: 0.01}")
    assert result["stopped"] == "misclassified"
    assert result["runs"] < 400
    assert result["conclusion"]["expected_misclassified"] <= 0.012
    even = result["conclusion"]["even_fraction"]["counted"]  # in doubt, and excluded as far as no even run denied it
    assert even >= 100
    assert result["conclusion"]["expected_misclassified"] + 0.5 / (even + 1.0) <= 0.01


CONE = """
import math
import sbt

def _cone(values, seed):
    return {"y": max(0.0, 30.0 * (0.12 - math.hypot(values["a"] - 0.7, values["b"] - 0.2)))}

SCENARIO = sbt.Scenario("cone", [sbt.Parameter(n, 0, 1) for n in "abc"], sbt.Requirement("y", low=1.0), evaluate=_cone)
"""


@pytest.mark.slow
def test_does_not_stop_while_few_runs_tell_of_a_side(tmp_path: Path):
    """2.3 % is critical: four of nine campaigns ended after 40 runs without a critical one, with as much on the wrong side."""
    (tmp_path / "cone.py").write_text(CONE)
    for seed in (0, 1):
        keys = {"scenario": f"'{tmp_path / 'cone.py'}:SCENARIO'", "budget": 140, "initial": 20, "batch": 20, "seed": seed}
        result = run(tmp_path / str(seed), **keys, stop="{misclassified: 0.02}")
        assert result["stopped"] == "budget" or result["conclusion"]["critical_fraction"] > 0.015


def test_crossings_lie_on_the_boundary():
    u = stream(5, "cross").random((3000, 3))
    found = crossings(lambda v: 1 / (1 + np.exp(-40 * (v.sum(axis=1) - 2.2))), u, 100)
    assert found.shape == (100, 3)
    np.testing.assert_allclose(found.sum(axis=1), 2.2, atol=1e-6)
    assert crossings(lambda v: np.zeros(len(v)), u, 100).shape == (0, 3)


def test_boundary_points_are_exported(tmp_path: Path):
    run(tmp_path, scenario="'testbed:cut_in_crash:box'", budget=60, initial=30, batch=30)
    done = CliRunner().invoke(app, ["export", str(tmp_path / "store"), "--format", "boundary"])
    assert done.exit_code == 0, done.output
    rows = np.loadtxt(tmp_path / "store" / "exports" / "boundary.csv", delimiter=",", skiprows=1)
    scenario = testbeds.find("cut_in_crash:box").scenario()
    anywhere = scenario.space.from_unit(stream(6, "anywhere").random((2000, 4)))
    critical = [scenario.requirement.critical.contains(testbeds.values("cut_in_crash:box", x)) for x in (rows, anywhere)]
    assert len(rows) > 100
    assert 0.25 < critical[0].mean() < 0.75  # half on either side, where 14 % are critical
    assert critical[1].mean() < 0.2


def test_where_there_is_no_boundary_that_is_said(tmp_path: Path):
    keys = {"budget": 12, "metamodel": "gp", "requirement": {"critical": [-100.0, -99.0]}, "executor": "serial"}
    sbt.run(campaign="coverage", scenario="testbed:four_branch_7", store=tmp_path / "s", report=False, **keys)
    done = CliRunner().invoke(app, ["export", str(tmp_path / "s"), "--format", "boundary"])
    assert (done.exit_code, done.stdout) == (2, "")
    assert done.stderr == (
        "a boundary needs places where the metamodel's P(critical) is 0.5, but it finds none (of 12 runs 0 are critical); "
        "no file is written\n"
    )


@pytest.mark.parametrize("recalibrate", [False, True])
def test_a_campaign_says_the_weights_of_auto_and_why(campaign, tmp_path, recalibrate):
    metamodel = {"kind": "auto", "preset": "quick", "recalibrate": recalibrate}
    result = campaign(campaign="boundary", budget=40, metamodel=metamodel, store=str(tmp_path / "s"), report=True)
    found = result["conclusion"]
    assert set(found["weights"]) == {"gp", "et"}
    assert sum(found["weights"].values()) == pytest.approx(1.0)
    reason = found["chosen_because"]
    assert all((f" % {name}" in reason.split(":")[0]) == (weight > 0) for name, weight in found["weights"].items())
    assert reason[:20] in (tmp_path / "s" / "report.html").read_text()
    with Store.read(tmp_path / "s") as store:
        assert all(fit.chosen_because for fit in store.fits())

"""Plateaus at the critical edge: what lies beneath is found, and a jump is learned as one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

import sbt
from sbt.campaigns.records import BatchProposal
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.persistence import load, save
from sbt.metamodels.stepped import Step, SteppedPredictor, better_stepped
from sbt.problem.requirement import CriticalInterval
from sbt.samplers.plateaus import beneath_plateaus, plateau
from sbt.samplers.search import Search, search_data
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream
from sbt.store.database import Store

LOW = CriticalInterval(high=0.0)
CENTRE = np.array([0.35, 0.6])
PROCESS = GaussianProcess(nu=2.5, input_noise=False)


def floor(u):
    """A funnel, cut off at 0.02 within 0.3 of its middle; critical is a disc of radius 0.06 there."""
    distance = np.sqrt(((u - CENTRE) ** 2).sum(axis=1))
    return np.where(distance < 0.06, -1.0, np.maximum(distance - 0.3, 0.0) + 0.02)


def test_a_plateau_is_a_value_shared_next_to_the_edge_and_slopes_around_it():
    slope = np.linspace(0.1, 1.0, 20)

    def shared(*margins: np.ndarray | float) -> np.ndarray:
        margin = np.r_[margins]
        return plateau(margin, stream(0, "anywhere").random((len(margin), 2)))

    assert shared(np.full(4, 0.02), slope, np.inf, -1.0).tolist() == [True] * 4 + [False] * 22
    assert not shared(np.full(3, 0.02), slope).any()  # by chance
    assert not shared(np.full(30, 0.02), np.full(30, 1.0)).any()  # no slopes: nothing to follow
    assert not shared(slope, np.full(30, 2.0)).any()  # far from the edge


def test_the_least_of_a_slope_at_the_end_of_a_range_is_no_plateau():
    """The same value at many inputs that do nothing, where the one that does is at its end: nothing lies beneath."""
    u = stream(0, "slope").random((40, 3))
    u[:12, 0] = 0.0
    assert not plateau(1.0 + u[:, 0], u).any()
    assert plateau(1.0 + np.maximum(u[:, 0] - 0.2, 0.0), u)[:12].all()  # it ends within the range, too


def _slope_away(values: dict[str, float], seed: int) -> dict[str, float]:
    """A slope to a corner where nothing is critical, and 1.6 % of the space at the opposite one, which nothing tells of."""
    a, b, c = values["a"], values["b"], values["c"]
    return {"y": -1.0 if abs(a - 0.85) < 0.1 and abs(b - 0.9) < 0.1 and c > 0.6 else 1.0 + a + b}


def test_a_known_least_value_is_not_run_again_and_again(tmp_path):
    inputs = [sbt.Parameter(name, 0.0, 1.0) for name in "abcd"]
    scenario = sbt.Scenario("slope_away", inputs, sbt.Requirement("y", high=0.0), evaluate=_slope_away)
    found, again = [], 0
    for seed in range(3, 7):
        result = sbt.run(
            campaign="falsification", scenario=scenario, budget=100, seed=seed, store=tmp_path / str(seed), executor="serial",
            report=False,
        )  # fmt: skip
        late = result.frame[["x.a", "x.b"]].to_numpy()[60:]
        again += int((late < 0.02).all(axis=1).sum())
        found.append(result.conclusion.critical_runs > 0)
    assert again <= 15  # of 160 runs; it was 52
    assert sum(found) >= 3


def test_picks_lie_beneath_the_middle_of_a_plateau_until_a_failure_explains_it():
    u = SobolSequence(2, 1).points(0, 40)
    u = u[np.sqrt(((u - CENTRE) ** 2).sum(axis=1)) > 0.09]
    search, rng = Search(LOW, PROCESS), stream(0, "plateau")
    seen = search_data(search, u, floor(u), None, rng)
    picks = beneath_plateaus(search, seen, u, floor(u), 3, rng)
    assert len(picks) == 3
    assert np.sqrt(((picks[0] - CENTRE) ** 2).sum()) < 0.12  # of 0.3
    found = np.vstack([u, CENTRE])
    seen = search_data(search, found, floor(found), None, rng)
    assert len(beneath_plateaus(search, seen, found, floor(found), 3, rng)) == 0


def test_some_picks_look_at_the_slopes_around_a_floor_that_no_failure_explains():
    u = SobolSequence(2, 1).points(0, 60)
    u = u[np.sqrt(((u - CENTRE) ** 2).sum(axis=1)) > 0.09]
    search, rng = Search(LOW, PROCESS), stream(1, "beside")
    picks = beneath_plateaus(search, search_data(search, u, floor(u), None, rng), u, floor(u), 8, rng, beside=True)
    distance = np.sqrt(((picks - CENTRE) ** 2).sum(axis=1))
    assert (distance[:-2] < 0.3).all()
    assert ((distance[-2:] > 0.28) & (distance[-2:] < 0.6)).all()


@pytest.mark.parametrize("critical", [LOW, CriticalInterval(low=0.0)])
def test_a_widened_jump_keeps_the_sides_and_comes_back(critical: CriticalInterval, tmp_path: Path):
    rng = stream(3, "step")
    u, y = rng.random((30, 2)), rng.standard_normal(30)
    step = Step(0.0, 1.5, critical)
    assert (critical.contains(step.moved(y)) == critical.contains(y)).all()
    np.testing.assert_allclose(step.back(step.moved(y)), y, atol=2e-3)
    stepped = SteppedPredictor(PROCESS.fit(u, step.moved(y), rng), step)
    at = rng.random((50, 2))
    p = stepped(at).probability(critical)
    np.testing.assert_allclose(p, stepped.process(at).probability(critical), rtol=1e-6, atol=1e-12)
    low, high = stepped.probability_bounds(at, critical)
    assert ((low <= p + 1e-9) & (p <= high + 1e-9)).all()
    save(stepped, tmp_path / "m.sbtmodel")
    np.testing.assert_array_equal(load(tmp_path / "m.sbtmodel")(at).mean, stepped(at).mean)


def test_a_jump_is_widened_only_where_that_predicts_the_sides_better():
    rng = stream(4, "jump")
    u = np.vstack([SobolSequence(2, 2).points(0, 60), CENTRE + 0.05 * rng.uniform(-1, 1, (3, 2))])
    shares, at = np.full(len(u), 1.0 / len(u)), rng.random((2000, 2))
    wrong = []
    for predictor in (
        PROCESS.fit(u, floor(u), rng),
        better_stepped(PROCESS, PROCESS.fit(u, floor(u), rng), LOW, u, floor(u), shares, rng),
    ):
        assert predictor is not None
        wrong.append(np.mean((predictor(at).probability(LOW)) * (floor(at) > 0)))
    assert wrong[1] < 0.5 * wrong[0]
    smooth = np.sin(5.0 * u[:, 0]) + u[:, 1] - 0.5
    assert better_stepped(PROCESS, PROCESS.fit(u, smooth, rng), LOW, u, smooth, shares, rng) is None


def test_a_boundary_beside_plateaus_explores_in_whole_batches_and_looks_about_what_it_knows(tmp_path: Path):
    """A disc of radius 0.04 beneath a funnel; batches of ten, though 20 are asked for, that explore or look about the disc."""

    def evaluate(values: Mapping[str, float], seed: int) -> dict[str, float]:
        distance = float(np.hypot(*(np.array([values["a"], values["b"]]) - CENTRE)))
        return {"m": -1.0 if distance < 0.04 else max(distance - 0.2, 0.0) + 0.02}

    inputs = [sbt.Parameter("a", 0.0, 1.0), sbt.Parameter("b", 0.0, 1.0)]
    scenario = sbt.Scenario("floors", inputs, sbt.Requirement("m", high=0.0), evaluate=evaluate)
    result = sbt.run(
        campaign="boundary", scenario=scenario, metamodel="gp", budget=60, initial=20, batch=20, seed=2, executor="serial",
        store=tmp_path / "s", report=False,
    )  # fmt: skip
    with Store.read(tmp_path / "s") as store:
        batches, history, about = [batch.read(BatchProposal) for batch in store.iterations()], store.history(), 0
    u, hit = history.x, result.scenario.requirement.critical_runs(history)
    for k, part in list(enumerate(batches))[2:]:  # the first 20 runs show the plateau
        rows = np.flatnonzero(history.iteration == k)
        before = u[hit & (history.iteration < k)]
        if not part.explored and len(before) and len(rows) == 10:
            guided = rows[(part.filling or 0) :][: (part.representative or 0) + (part.greedy or 0)]
            assert (np.abs(u[guided][:, None] - before[None]).max(axis=2).min(axis=1) < 0.3).all()  # boxes that touch are one
            about += len(guided)
        elif part.explored:
            assert len(rows) == 10
            assert not part.representative
    assert about > 0

"""Failure modes of a noisy simulator: regions with safe runs between them are told apart, one that seldom fails is not split."""

from __future__ import annotations

import runpy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import sbt
from sbt.campaigns.between import LIKELY, SURE, RunsBetween
from sbt.campaigns.linking import JoinedPart, LinksTold, connected, modes_counted, ways_in_noise
from sbt.campaigns.rates import LocalRates, local_rates
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.problem.arrays import Mask, Points
from sbt.problem.requirement import CriticalInterval
from sbt.samplers.search import Search
from sbt.seeds import stream

LINKS = runpy.run_path(str(Path(__file__).resolve().parents[1] / "benchmarks" / "links.py"))
FLAT: Any = SimpleNamespace(probability=lambda u: np.full(len(u), 0.1))
ENDS = np.array([[0.1, 0.1], [0.15, 0.1], [0.9, 0.9], [0.9, 0.85]])


def between(rate: float, runs: Points, ends: Points = ENDS, std: float = 0.05, hit: Mask | None = None) -> RunsBetween:
    n = len(ends)
    hits = np.ones(n, dtype=bool), np.zeros(len(runs), dtype=bool) if hit is None else hit
    rates = LocalRates(np.full(n, rate), np.full(n, std))
    return RunsBetween(np.vstack([ends, runs]), np.concatenate(hits), np.full(n + len(runs), 0.1), ends, np.zeros(n), rates)


def told(kind: str, seed: int, tmp_path: Path) -> sbt.Result:
    d, metric, _ = LINKS["problem"](kind, seed)
    names = [f"x{k}" for k in range(d)]

    def evaluate(values: dict, run: int) -> dict:
        return {"y": metric(np.array([values[name] for name in names]), run)}

    inputs = [sbt.Parameter(name, 0.0, 1.0) for name in names]
    scenario = sbt.Scenario(kind, inputs, sbt.Requirement("y", high=0.0), evaluate=evaluate, metrics=["y"])
    keys = {"campaign": "falsification", "executor": "serial", "report": False, "judges": []}
    return sbt.run(scenario=scenario, budget=150, seed=seed, store=tmp_path / f"{seed}", **keys)


MIDDLE = 0.5 + 0.1 * stream(0, "middle").uniform(-1.0, 1.0, (40, 2))


@pytest.mark.parametrize(("rate", "runs", "groups"), [(0.3, 40, [0, 0, 2, 2]), (0.3, 4, [0] * 4), (0.02, 40, [0] * 4)])
def test_safe_runs_between_divide_what_a_flat_metamodel_joins_if_they_are_too_many(rate: float, runs: int, groups: list):
    assert connected(FLAT, ENDS, np.zeros(4), noisy=True).tolist() == [0] * 4
    assert connected(FLAT, ENDS, np.zeros(4), noisy=True, between=between(rate, MIDDLE[:runs], std=0.2 * rate)).tolist() == groups


def test_what_is_hardly_known_of_a_rate_divides_nothing():
    known, guessed = (between(0.3, MIDDLE, std=std) for std in (0.05, 0.4))
    assert connected(FLAT, ENDS, np.zeros(4), noisy=True, between=known).max() > 0
    assert connected(FLAT, ENDS, np.zeros(4), noisy=True, between=guessed).max() == 0


def test_runs_on_the_way_count_where_the_metamodel_claims_failures():
    one, other = np.array([True, True, False, False]), np.array([False, False, True, True])
    beside = np.array([0.45, 0.0]) + np.column_stack([MIDDLE[:, 0], 0.02 * MIDDLE[:, 1]])
    likely = [between(0.3, runs).likely(1, 3, (one, other), 0.05) for runs in (MIDDLE, MIDDLE[:4], beside)]
    assert likely[0] < SURE < likely[1] < likely[2]
    assert between(0.3, MIDDLE).likely(1, 3, (one, other), 0.2) == likely[2] > LIKELY  # it claims none there


def test_a_critical_run_of_another_mode_between_speaks_for_a_way():
    ends = np.vstack([ENDS, [[0.5, 0.5]]])
    modes = np.array([True, True, False, False, False]), np.array([False, False, True, True, False])
    with_hit, without = between(0.3, MIDDLE[:12], ends), between(0.3, MIDDLE[:12])
    assert with_hit.likely(1, 3, modes, 0.05) > without.likely(1, 3, (modes[0][:4], modes[1][:4]), 0.05)


def test_the_ways_that_are_asked_divide_modes_or_are_long_and_in_doubt():
    at = np.zeros(4)
    ways, dividing = ways_in_noise(FLAT, ENDS, at, between(0.3, MIDDLE[:10]), {})
    assert (dividing, {way.ends for way in ways}) == (1, {(1, 3)})
    assert ways[0].at.tolist() == ENDS[[1, 3]].mean(axis=0).tolist()
    assert len(np.unique([way.at for way in ways], axis=0)) == len(ways) == 4
    later = ways_in_noise(FLAT, ENDS, at, between(0.3, MIDDLE[:10]), {frozenset((1, 3)): 2})[0]
    assert [way.at.tolist() for way in later[:2]] == [way.at.tolist() for way in ways[2:]]
    assert ways_in_noise(FLAT, ENDS, at, between(0.3, MIDDLE), {}) == ([], 0)  # surely two
    joined, none = ways_in_noise(FLAT, ENDS, at, between(0.3, MIDDLE[:4]), {})
    assert ({way.ends for way in joined}, none) == ({(1, 3)}, 0)
    assert ways_in_noise(FLAT, ENDS[:2], at[:2], between(0.3, MIDDLE, ENDS[:2]), {}) == ([], 0)  # near


def test_of_ways_within_a_mode_that_comes_first_which_joins_most_inputs_not_the_longest():
    ends = np.array([[0.1, 0.1], [0.1, 0.15], [0.1, 0.2], [0.5, 0.1], [0.5, 0.15], [0.5, 0.2], [0.5, 0.2], [0.5, 0.9]])
    ways, dividing = ways_in_noise(FLAT, ends, np.zeros(8), between(0.3, np.empty((0, 2)), ends), {})
    assert dividing == 0
    parts = {frozenset(part) for part in ((0, 1, 2), (3, 4, 5, 6), (7,))}
    assert {frozenset(side) for way in ways for side in way.sides} == parts, "none is in another one"
    assert len(ways) == 8
    assert {frozenset(map(len, way.sides)) for way in ways[:2]} == {frozenset({3, 4})}
    for way in ways:
        assert way.ends[0] in way.sides[0]
        assert way.ends[1] in way.sides[1]
    assert all(way.sides == () for way in ways_in_noise(FLAT, ENDS, np.zeros(4), between(0.3, MIDDLE[:10]), {})[0])  # divides


def test_the_rate_of_a_small_region_is_not_that_of_all_runs():
    """Heavy noise: the length scales of the metric tell nothing of where runs fail."""
    found = []
    for seed in range(4):
        rng = stream(seed, "small")
        corners = rng.random((30, 3)) * [0.15, 0.2, 1.0] + [0.85, 0.8, 0.0], rng.random((45, 3)) * [0.2, 0.25, 1.0]
        u = np.vstack([rng.random((75, 3)), *corners])
        exact = np.where((u[:, 0] > 0.85) & (u[:, 1] > 0.8), 0.6, np.where((u[:, 0] < 0.2) & (u[:, 1] < 0.25), 0.15, 0.0))
        fails = rng.random(150) < exact
        y = np.where(fails, np.where(exact > 0.3, -0.1, -4.0), 2.0 + u[:, 2] + 0.5 * rng.standard_normal(150))
        search = Search(CriticalInterval(high=0.0), GaussianProcess(nu=2.5, input_noise=False))
        rates = local_rates(search, u, y, np.ones(150, dtype=bool), np.empty((0, 3)), np.empty(0, dtype=bool), rng)
        found.append([np.median(rates.mean[fails & (exact == rate)]) for rate in (0.6, 0.15)])
    often, seldom = np.transpose(found)
    assert (often > 1.8 * seldom).all()
    assert np.mean(often) > 0.38  # .58 of the runs there were critical
    assert np.mean(seldom) < 0.25


@pytest.mark.parametrize(("kind", "seed", "least"), [("equal", 7, 2), ("box", 7, 1), ("slab", 8, 1)])
def test_regions_in_opposite_corners_are_two_modes_and_one_that_seldom_fails_is_one(
    kind: str, seed: int, least: int, tmp_path: Path
):  # fmt: skip
    result = told(kind, seed, tmp_path)
    modes, history = result.conclusion.failure_modes, result.history
    x = {int(index): row for index, row in zip(history.index, history.x, strict=True)}
    for mode in modes:
        assert len({LINKS["box_of"](kind, x[run]) for run in mode.runs}) == 1
    assert len(modes) == least
    asked = result.conclusion.links
    assert asked is None or asked.runs <= 15


def test_modes_may_be_fewer_where_too_few_runs_tell_of_a_way():
    open_ = LinksTold(0, 0, 1, dividing=1)
    assert open_.may_be_fewer
    assert open_.sentence().endswith("tell whether they are of one failure mode: 1 way between modes is in doubt.")
    said = LinksTold(9, 2, 4, dividing=1).sentence()
    assert said.endswith("; 4 ways between them are still in doubt, 1 of them between two modes.")
    assert not LinksTold(9, 2, 4).may_be_fewer


@pytest.mark.parametrize(
    ("dividing", "joining", "alone", "said"),
    [
        (None, None, 1, "3 distinct failure modes"),
        (1, None, 0, "up to 3 distinct failure modes"),
        (None, None, 2, "up to 3 distinct failure modes"),
        (None, 2, 0, "at least 3 distinct failure modes"),
        (1, 2, 0, "about 3 distinct failure modes (2 to 5)"),
        (1, 2, 2, "about 3 distinct failure modes (1 to 5)"),
    ],
)
def test_modes_are_at_least_so_many_where_ways_within_them_are_in_doubt(
    dividing: int | None, joining: int | None, alone: int, said: str
):  # fmt: skip
    assert modes_counted(3, alone, LinksTold(9, 2, 4, dividing=dividing, joining=joining)) == said
    assert modes_counted(3, 2, None) == "up to 3 distinct failure modes"


def test_parts_of_modes_that_ways_in_doubt_join_are_named():
    said = LinksTold(9, 2, 4, joining=4, parts=(JoinedPart(45, 13), JoinedPart(88, 4))).sentence()
    assert "4 ways between them are still in doubt. Joined to others only by ways in doubt, and perhaps of modes of" in said
    assert said.endswith(": run 45 (of 13 critical inputs), run 88 (of 4 critical inputs).")
    assert "2 ways within modes are in doubt." in LinksTold(0, 0, 2, joining=2).sentence()


BOXES = (((0.0, 0.0, 0.0), (0.4, 0.4, 1.0), 0.25), ((0.7, 0.7, 0.5), (1.0,) * 3, 0.9), ((0.6, 0.0, 0.0), (1.0, 0.3, 0.3), 0.5))


def box(x: np.ndarray) -> int | None:
    return next((k for k, (low, high, _) in enumerate(BOXES) if ((low <= x) & (x <= high)).all()), None)


@pytest.mark.parametrize("seed", [102, 109])
def test_a_region_that_is_joined_by_default_is_counted_and_named(seed: int, tmp_path: Path):
    """Three boxes, and no failure between them: all are met, two modes are told."""

    def evaluate(values: dict, run: int) -> dict:
        k, (chance, depth) = box(np.array(list(values.values()))), np.random.default_rng(run).random(2)
        return {"y": -0.1 - 1.5 * depth if k is not None and chance < BOXES[k][2] else 1.0 + 2.0 * depth}

    inputs = [sbt.Parameter(name, 0.0, 1.0) for name in "abc"]
    scenario = sbt.Scenario("boxes", inputs, sbt.Requirement("y", high=0.0), evaluate=evaluate, metrics=["y"])
    keys = {"campaign": "falsification", "executor": "serial", "report": False, "judges": []}
    result = sbt.run(scenario=scenario, budget=150, seed=seed, store=tmp_path / "s", **keys)
    found, history = result.conclusion, result.history
    at = {int(index): box(x) for index, x in zip(history.index, history.x, strict=True)}
    assert len({at[run] for mode in found.failure_modes for run in mode.runs}) == 3 > len(found.failure_modes)
    named = [mode.representative for mode in found.failure_modes] + [part.run for part in found.links.parts]
    assert {at[run] for run in named} == {0, 1, 2}
    said = result.sentences()
    assert ("in at least 2 distinct" in said[0]) != ("in about 2 distinct failure modes (1 to " in said[0])
    assert f"run {found.links.parts[0].run} (of {found.links.parts[0].inputs} critical inputs)" in " ".join(said)

"""Repeats with other seeds: every guided campaign learns whether its simulator is noisy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import sbt
from sbt.campaigns.repeats import REPEAT, SimulatorNoise, repeats_wanted, simulator_noise
from sbt.loop.stages import Facts
from sbt.problem.outcome import Status
from sbt.problem.requirement import Requirement
from sbt.store.history import VALIDATION, History, Record
from sbt.testbeds import analytic

OK, FAILED = Status.OK, Status.FAILED
Y = Requirement("y", high=0.0)


def history(rows: list[tuple[float, float | None]], stage: str = "initial") -> History:
    return History.of(("a",), [
        Record(k, stage, 0, {"a": a}, k, str(FAILED if y is None else OK), {} if y is None else {"y": y, "other": a})
        for k, (a, y) in enumerate(rows)
    ])  # fmt: skip


PLANE = analytic(lambda x: x[:, 0] - 0.1, inputs={"a": (0.0, 1.0)}, critical=(-np.inf, 0.0), name="plane")


def test_the_noise_is_pooled_over_equal_inputs():
    rng = np.random.default_rng(0)
    a = np.repeat(np.linspace(0.0, 1.0, 400), 3)
    found = simulator_noise(history(list(zip(a, 5.0 * a + 0.3 * rng.standard_normal(len(a)), strict=True))), Y)
    assert (found.repeats, found.noisy) == (800, True)
    assert found.std == pytest.approx(0.3, rel=0.08)
    same = simulator_noise(history([(0.5, 1.0), (0.5, 1.0 + 1e-13), (0.7, 2.0), (0.5, None)]), Y)
    assert (same.repeats, same.noisy, same.std) == (1, False, 0.0)
    unknown = simulator_noise(history([(0.5, 1.0), (0.7, 2.0), (0.7, None)]), Y)
    assert (unknown.repeats, unknown.noisy, unknown.std) == (0, None, None)


def test_noise_in_another_metric_is_noise():
    rows = history([(0.5, 3.0), (0.5, 3.0)])
    assert not simulator_noise(rows, Y).noisy
    rows.columns["y.other"][1] = 0.7
    assert simulator_noise(rows, Y).noisy
    assert simulator_noise(rows, Y).std == 0.0
    rows.columns["y.y"][1] += 1e-14
    assert simulator_noise(rows, Y) == SimulatorNoise(1, True, 0.0, inputs=1), "the last digit of a sum is no noise"


def test_the_smallest_margins_are_repeated_once_and_plateaus_last():
    rows = [(0.9, 3.0), (0.1, -2.0), (0.8, -2.0), (0.2, 0.4), (0.4, None), (0.3, 0.2)]
    wanted = repeats_wanted(history(rows), PLANE, 5)
    assert [run.inputs["a"] for run in wanted] == [0.3, 0.2]
    assert {run.stage for run in wanted} == {REPEAT}
    assert len(repeats_wanted(history(rows), PLANE, 1)) == 1
    assert repeats_wanted(history([*rows, (0.3, 0.2), (0.2, 0.5)]), PLANE, 5) == ()
    assert [run.inputs["a"] for run in repeats_wanted(history([*rows, (0.3, 0.2)]), PLANE, 5)] == [0.2]
    failed = history(rows).extended(history([(0.3, None), (0.2, None)], REPEAT))
    assert [run.inputs["a"] for run in repeats_wanted(failed, PLANE, 5)] == [0.9, 0.1]
    assert repeats_wanted(history(rows, VALIDATION), PLANE, 5) == ()


@pytest.mark.parametrize(("campaign", "budget"), [("falsification", 14), ("boundary", 26), ("estimation", 26)])
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_every_guided_campaign_learns_and_says_whether_the_simulator_is_noisy(
    campaign: str, budget: int, noise: float, tmp_path: Path
):
    scenario = analytic(
        lambda x: np.hypot(x[:, 0] - 0.3, x[:, 1] - 0.6) - 0.3, inputs={"a": (0.0, 1.0), "b": (0.0, 1.0)},
        critical=(-np.inf, 0.0), name="disc", noise=noise,
    )  # fmt: skip
    result = sbt.run(
        campaign=campaign, scenario=scenario, budget=budget, seed=1, executor="serial", store=tmp_path / "s", report=False,
        metamodel="gp", **({"initial": 20} if campaign == "boundary" else {}),
    )  # fmt: skip
    found, rows = result.conclusion.simulator_noise, result.history
    assert found.noisy == (noise > 0)
    again = rows.where(rows.stage == REPEAT)
    assert set(again.iteration.tolist()) == {1}
    assert len(again) == 2  # all that it costs
    assert {tuple(x) for x in again.x} <= {tuple(x) for x in rows.x[rows.iteration == 0]}
    assert (rows.stage != "confirm").sum() <= budget
    said = " ".join(result.conclusion.sentences(Facts(rows, scenario.requirement, unit="m")))
    assert ("The simulator is noisy: where" in said) == (noise > 0)
    assert ("No noise was met: metrics were equal at both inputs that were repeated" in said) == (noise == 0)


def test_repetitions_of_one_input_are_no_independent_looks():
    """The inputs, not the runs, are what may be noisy elsewhere: twelve runs at three inputs bound as three do."""
    found = simulator_noise(history([(a, a) for a in (0.1, 0.2, 0.3) for _ in range(5)]), Y)
    assert (found.repeats, found.inputs, found.noisy) == (12, 3, False)
    assert "all 3 inputs that were repeated" in found.sentences("y")[0]
    assert "less than 63.2" in found.sentences("y")[0]


def test_noise_of_other_metrics_is_not_called_a_deviation_of_zero():
    said = SimulatorNoise(2, noisy=True, std=0.0).sentences("ttc_min", "s")
    told = "where 2 runs repeated inputs with other seeds, other metrics differed; ttc_min did not."
    assert said == [f"The simulator is noisy: {told}"]


def test_critical_runs_that_stand_alone_are_repeated_until_a_repeat_differs():
    line = [(0.05 * k, 1.0 + 0.05 * k) for k in range(20)] + [(0.0, 1.0), (0.05, 1.05)]
    assert repeats_wanted(history([*line, (0.51, 0.5)]), PLANE, 5) == (), "nothing is critical"
    lone = history([*line, (0.51, -1.0), (0.72, -1.1)])
    assert [run.inputs["a"] for run in repeats_wanted(lone, PLANE, 5)] == [0.72, 0.51], "differs most from what is beside it"
    assert [run.inputs["a"] for run in repeats_wanted(lone, PLANE, 1)] == [0.72]
    agreed = lone.extended(history([(0.51, -1.0)], REPEAT))
    assert [run.inputs["a"] for run in repeats_wanted(agreed, PLANE, 5)] == [0.72]
    assert repeats_wanted(lone.extended(history([(0.51, 1.5)], REPEAT)), PLANE, 5) == (), "noise is known"
    assert repeats_wanted(history([*line, (0.51, -1.0), (0.515, -1.1)]), PLANE, 5) == (), "each has the other beside it"
    many = history([*line, *((0.12 + 0.2 * k, -1.0 - k) for k in range(5))])
    assert [run.inputs["a"] for run in repeats_wanted(many, PLANE, 5)] == pytest.approx([0.92, 0.72, 0.52])
    enough = many.extended(history([(0.12 + 0.2 * k, -1.0 - k) for k in range(1, 5)], REPEAT))
    assert repeats_wanted(enough, PLANE, 5) == (), "the three that differ most were repeated, one for another reason"
    first = history([*line, *((0.30 + 0.005 * k, -1.0 - k) for k in range(4)), (0.72, -1.1), (0.92, -1.2)])
    agreed = first.extended(history([(0.30 + 0.005 * k, -1.0 - k) for k in range(3)], REPEAT))
    told = "those that were found to be parts of a region tell nothing of those that stay alone"
    assert [run.inputs["a"] for run in repeats_wanted(agreed, PLANE, 5)] == [0.92, 0.72], told
    spent = first.extended(history([(0.30 + 0.0005 * k, -1.0 - k) for k in range(9)])).extended(
        history([(0.30 + 0.0005 * k, -1.0 - k) for k in range(9)], REPEAT)
    )  # fmt: skip
    assert repeats_wanted(spent, PLANE, 5) == (), "nine critical inputs were repeated"


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    "campaign", [pytest.param("boundary", marks=SLOW), pytest.param("estimation", marks=SLOW), "falsification"]
)  # fmt: skip
def test_a_failure_of_one_seed_in_fifty_gives_its_noise_away(campaign: str, tmp_path: Path):
    def dropout(inputs: dict[str, float], seed: int) -> dict[str, float]:
        return {"y": -1.0 if np.random.default_rng(seed).random() < 0.02 else 0.3 + inputs["a"]}

    inputs = [sbt.Parameter("a", 0.0, 1.0), sbt.Parameter("b", 0.0, 1.0)]
    scenario = sbt.Scenario("dropout", inputs, sbt.Requirement("y", high=0.0), evaluate=dropout)
    result = sbt.run(
        campaign=campaign, scenario=scenario, budget=150, seed=1, executor="serial", store=tmp_path / "s", report=False,
        metamodel="gp",
    )  # fmt: skip
    assert result.conclusion.simulator_noise.noisy


@pytest.mark.parametrize("noisy", [False, True])
def test_a_campaign_that_is_to_end_at_so_many_failures_counts_different_inputs(tmp_path: Path, noisy: bool):
    def evaluate(values: dict, seed: int) -> dict:
        inside = np.hypot(values["a"] - 0.3, values["b"] - 0.4) < 0.35
        return {"y": float(inside) + (0.1 * float(seed % 2) if noisy else 0.0)}

    inputs = [sbt.Parameter(name, 0.0, 1.0) for name in "ab"]
    scenario = sbt.Scenario("flag", inputs, sbt.Requirement("y", low=0.5), evaluate=evaluate, metrics=["y"])
    keys = {"campaign": "falsification", "seed": 2, "executor": "serial", "report": False, "judges": []}
    result = sbt.run(scenario=scenario, budget=60, stop={"failures": 5}, store=tmp_path / "s", **keys)
    hits = result.frame.query("critical == True and stage != 'confirm'")
    different = len(hits.drop_duplicates(["x.a", "x.b"]))
    assert 5 <= different < len(hits) == result.conclusion.critical_runs
    before = hits[hits["iteration"] < result.frame.query("stage != 'confirm'")["iteration"].max()]
    assert len(before.drop_duplicates(["x.a", "x.b"])) < 5
    assert result.conclusion.critical_inputs == different
    assert f", at {different} different inputs, in " in result.sentences()[0]
    assert f" They have {different} different inputs." in result.conclusion.statement


def test_modes_of_one_input_each_may_be_parts_of_one_region(tmp_path: Path):
    def bent(x: np.ndarray) -> np.ndarray:
        return abs(x[:, 1] - 0.5 - 0.3 * np.sin(2.0 * np.pi * x[:, 0])) - 0.01

    def round_(x: np.ndarray) -> np.ndarray:
        return np.hypot(x[:, 0] - 0.3, x[:, 1] - 0.6) - 0.3

    said = {}
    for region in (bent, round_):
        scenario = analytic(
            region, inputs={"a": (0.0, 1.0), "b": (0.0, 1.0)}, critical=(-np.inf, 0.0), name=region.__name__,
        )  # fmt: skip
        result = sbt.run(
            campaign="falsification", scenario=scenario, budget=60, executor="serial", store=tmp_path / scenario.name,
            report=False,
        )  # fmt: skip
        modes, runs = result.conclusion.failure_modes, result.history
        alone = sum(len({tuple(runs.x[k]) for k in mode.runs}) == 1 for mode in modes)
        said[region.__name__] = next((line for line in result.sentences() if "one input each" in line), "")
        assert (f"({alone} of {len(modes)})" in said[region.__name__] or f"(all {alone})" in said[region.__name__]) is (alone > 1)
    assert said["bent"]
    assert not said["round_"]


@pytest.mark.slow
def test_failures_by_chance_beside_a_smooth_region_pass_no_gate(tmp_path: Path):
    """All repeats were of the smooth region, "no noise was met", and a gate passed at a fifteenth of P = .0169 (seed 21)."""

    def evaluate(values: dict[str, float], seed: int) -> dict[str, float]:
        by_chance = values["c"] > 1.0 and np.random.default_rng(seed).random() < 0.1
        return {"m": -1.0 - 0.2 * values["b"] if by_chance else 3.2 - values["a"] - 0.3 * values["b"]}

    inputs = [sbt.Parameter(name, -6.0, 6.0, "", sbt.Normal(0, 1)) for name in "abc"]
    scenario = sbt.Scenario("chance", inputs, sbt.Requirement("m", high=0.0), evaluate=evaluate, metrics=["m"])
    for seed in (20, 21):
        found = sbt.run(
            campaign="estimation", scenario=scenario, budget=200, seed=seed, executor="serial", store=tmp_path / str(seed),
            report=False, gate={"probability": 0.012, "confidence": 0.95},
        ).conclusion  # fmt: skip
        assert found.low <= 0.0169 <= found.high
        assert found.gate.verdict != "pass"


def test_a_metamodel_that_gains_nothing_is_left_to_crude_monte_carlo(tmp_path: Path):
    """Seven waves along an input: the error was 1.2 of P = .0084 (12 seeds) where crude Monte Carlo has .77; now .69."""

    def waves(x: np.ndarray) -> np.ndarray:
        return 0.95 - np.sin(2.0 * np.pi * (7.0 * x[:, 0] + 2.0 * x[:, 1] ** 2)) * (0.6 + 0.4 * x[:, 2])

    scenario = analytic(
        waves, inputs={name: (0.0, 1.0) for name in "abc"}, critical=(-np.inf, 0.0), name="waves",
    )  # fmt: skip
    result = sbt.run(
        campaign="estimation", scenario=scenario, budget=200, seed=0, executor="serial", store=tmp_path / "s", report=False,
        stop={"cov": None},
    )  # fmt: skip
    assert (result.frame.stage == "monte_carlo").sum() >= 100
    assert result.conclusion.low <= 0.00843 <= result.conclusion.high < 0.1

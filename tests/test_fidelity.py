"""Two levels of fidelity: coarse runs teach, and are none of the scenario's."""

from __future__ import annotations

import itertools
import json
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from sbt.campaigns.levels import LevelsTold
from sbt.cli import app
from sbt.config.source import ConfigError
from sbt.errors import InputError, SbtError
from sbt.estimators.two_level import TwoPhases, drawn, inclusion, split_as_if_normal
from sbt.plugins import forget_changed
from sbt.seeds import stream
from sbt.store.database import Store
from sbt.workflows.exporting import FORMS
from sbt.workflows.judging import judge_run, with_driver
from sbt.workflows.pinning import pin_runs
from sbt.workflows.running import Summary, replay_run, run_study
from sbt.workflows.study import Study
from tests.warm_networks import town

NOISY = {"campaign": "estimation", "scenario": "testbed:two_hollows_noisy", "budget": 60, "stop": {"cov": None}, "initial": 10}
COARSE = {"scenario": "testbed:two_hollows_noisy:coarse", "cost": 0.2}

METRICS = "metrics: [distance_min]\nrequirement: {metric: distance_min, critical: [-.inf, 1.0]}\nstep_length: 0.2\n"
"""Last keys of a scenario file."""
STEP = 0.1
LEFT_TURN = {"campaign": "estimation", "scenario": "unprotected_left_turn"}


def study(folder: Path, data: dict[str, Any], **more: Any) -> Study:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "c.yaml").write_text(json.dumps({**data, "store": str(folder / "store"), **more}))
    return Study.from_file(folder / "c.yaml")


def run(folder: Path, data: dict[str, Any], **more: Any) -> Summary:
    return run_study(study(folder, data, **{"executor": {"kind": "serial"}, **more}), report=False)


def rows(folder: Path) -> list[Any]:
    with Store.read(folder / "store") as store:
        return [(r.index, r.stage, r.iteration, dict(r.inputs), r.seed, r.level, r.seed_chosen, r.log_q, dict(r.metrics))
                for r in store.history(level=None).records]  # fmt: skip


def test_the_estimate_of_two_phases_is_unbiased_for_any_belief() -> None:
    """By enumeration of all draws, with independent inclusion, of a pool of three pairs."""
    critical, before, after = np.array([1.0, 0.0, 1.0]), np.array([0.2, 0.7, 0.1]), np.array([0.9, 0.3, 0.05])
    first, second = np.array([0.5, 0.3, 0.8]), np.array([0.4, 0.9, 0.25])
    mean = 0.0
    for one in itertools.product([False, True], repeat=3):
        rows = np.flatnonzero(one)
        p_one = float(np.prod(np.where(one, first, 1.0 - first)))
        phases = TwoPhases(3, float(before.sum()), float((before**2).sum()), before[rows], first[rows], after[rows], second[rows])
        for two in itertools.product([False, True], repeat=len(rows)):
            chosen = np.flatnonzero(two)
            p_two = float(np.prod(np.where(two, second[rows], 1.0 - second[rows])))
            error = critical[rows][chosen] - after[rows][chosen]
            correction = float((phases.coefficient(chosen) * error).mean()) if len(chosen) else 0.0
            mean += p_one * p_two * (phases.prior + correction)
    assert mean == pytest.approx(critical.mean())


def test_pairs_are_drawn_as_often_as_is_known() -> None:
    rng = stream(1, "drawn")
    size, order = rng.gamma(0.2, size=40), rng.random(40)
    probability = inclusion(size, np.ones(40), 12)
    assert probability.sum() == pytest.approx(12.0)
    assert probability.max() <= 1.0 + 1e-12
    assert probability.min() > 0.0
    times = np.zeros(40)
    for k in range(3000):
        rows = drawn(probability, order, stream(k, "drawn"))
        assert len(rows) == 12
        times[rows] += 1
    assert np.abs(times / 3000 - probability).max() < 0.04


def test_coarse_runs_pay_where_they_are_cheap_and_alike_and_the_event_is_rare() -> None:
    assert split_as_if_normal(0.4, 0.93, 0.004, 0.5).pays
    assert not split_as_if_normal(0.4, 0.93, 0.28, 0.55).pays
    assert not split_as_if_normal(0.4, 0.45, 0.01, 0.9).pays
    cheap, dear = (split_as_if_normal(0.4, 0.9, 0.01, cost) for cost in (0.1, 0.4))
    assert cheap.two_levels < dear.two_levels
    assert cheap.fine <= dear.fine
    assert cheap.one_level == dear.one_level


def test_coarse_runs_are_none_of_the_scenarios(tmp_path: Path) -> None:
    summary = run(tmp_path, NOISY, fidelity=COARSE)
    with Store.read(tmp_path / "store") as store:
        fine, every = store.history(), store.history(level=None)
        coarse = store.history(level=1)
        assert (summary.runs, store.coarse, sum(store.counts.values())) == (len(fine), len(coarse), len(fine))
        assert len(coarse) > 20
        assert len(fine) + len(coarse) == len(every)
        assert not np.isin(fine.training.index, coarse.index).any()
        frame = pd.read_csv(FORMS["csv"](store, study(tmp_path / "again", NOISY)))
        at = int(coarse.index[3])
    told = summary.conclusion.to_dict()["fidelity"]
    assert told["coarse"] == len(coarse)
    assert told["fine"] == len(fine)
    assert 0.5 < told["correlation"] <= 1.0
    assert len(fine) + 0.2 * len(coarse) <= 60 + 1e-9
    assert frame.loc[frame["level"] > 0, "critical"].isna().all()
    assert frame.loc[frame["level"] == 0, "critical"].notna().all()
    pairs = {(tuple(x), s) for x, s in zip(coarse.x, coarse.seed, strict=True)}
    both = [(tuple(x), s) in pairs for x, s in zip(fine.x, fine.seed, strict=True)]
    assert sum(both) >= 12, "the same inputs and the same seed at both levels"
    assert replay_run(tmp_path / "store", at).identical, "a coarse run replays coarse"
    chosen = fine.columns["seed_chosen"]
    assert chosen.any()
    assert not chosen[~np.array(both)].any(), "whose seed was looked at, and only that, does not tell of rates"


def test_rows_are_a_function_of_the_log(tmp_path: Path) -> None:
    run(tmp_path / "whole", NOISY, fidelity=COARSE)
    run(tmp_path / "workers", NOISY, fidelity=COARSE, executor={"kind": "local", "workers": 2})
    assert rows(tmp_path / "whole") == rows(tmp_path / "workers")
    seen = 0

    class Killed(Exception):
        pass

    def kill(progress: Any) -> None:
        nonlocal seen
        seen += progress.activity == "simulating"
        if seen == 60:
            raise Killed

    killed = study(tmp_path / "killed", NOISY, fidelity=COARSE, executor={"kind": "serial"})
    with pytest.raises(Killed):
        run_study(killed, progress=kill, report=False)
    run_study(killed, report=False)
    assert rows(tmp_path / "whole") == rows(tmp_path / "killed")


@pytest.mark.slow
@pytest.mark.sumo
@pytest.mark.parametrize("campaign", ["estimation", "falsification"])
def test_killed_among_coarse_runs_and_run_again_gives_the_same_rows(tmp_path: Path, campaign: str) -> None:
    """The driver is killed five times, at the same numbers of finished runs in every campaign, once or more amid coarse ones."""
    data = {
        **LEFT_TURN, "campaign": campaign, "budget": 60, "initial": 12, "batch": 12,
        **({"stop": {"cov": None}} if campaign == "estimation" else {}),
        "fidelity": {"step_length": [0.1, 0.5], "cost": 0.3}, "executor": {"kind": "local", "workers": 2},
    }  # fmt: skip
    whole = run(tmp_path / "whole", data)
    study(tmp_path / "killed", data)
    command = [sys.executable, "-m", "sbt", "run", str(tmp_path / "killed" / "c.yaml")]
    found = 0
    for least in (1, 9, 20, 34, 55):
        driver = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        while driver.poll() is None and found < least:
            time.sleep(0.002)
            found = _finished(tmp_path / "killed")
        driver.send_signal(signal.SIGKILL)
        assert driver.wait() == -signal.SIGKILL, "it was over before it was killed"
    again = run(tmp_path / "killed", data)
    assert rows(tmp_path / "killed") == rows(tmp_path / "whole")
    assert any(row[5] == 1 for row in rows(tmp_path / "whole")), "there are coarse runs"
    assert again.conclusion == whole.conclusion


def _finished(folder: Path) -> int:
    try:
        return len(rows(folder))
    except SbtError:
        return 0


@pytest.mark.parametrize("executor", [{"kind": "serial"}, {"kind": "local", "workers": 1}], ids=["serial", "local"])
@pytest.mark.parametrize("fine", ["model.py:FINE", "testbed:two_hollows_noisy"], ids=["own", "installed"])
def test_a_coarse_model_that_was_changed_is_refused(tmp_path: Path, fine: str, executor: dict[str, Any]) -> None:
    """It was not tried: a store mixed the runs of two."""
    text = f"""import dataclasses
from sbt.plugins import load

FINE = load("scenarios", "{NOISY["scenario"]}")
COARSE = load("scenarios", "{NOISY["scenario"]}:coarse")
METRIC = COARSE.requirement.metric

def evaluate(values, seed):
    return {{METRIC: SIGN * COARSE.evaluate(values, seed)[METRIC]}}

COARSE_ONE = dataclasses.replace(COARSE, evaluate=evaluate)
"""
    for name in ("model", "coarse"):
        (tmp_path / f"{name}.py").write_text(text.replace("SIGN", "1.0"))
    data = {**NOISY, "scenario": fine, "fidelity": {"scenario": "coarse.py:COARSE_ONE", "cost": 0.2}, "executor": executor}
    run(tmp_path, data)
    before = rows(tmp_path)
    assert any(row[5] == 1 for row in before)
    (tmp_path / "coarse.py").write_text(text.replace("SIGN", "-1.0"))
    forget_changed()
    with pytest.raises(InputError, match=r"but run \d+ \(a coarse one, at level 1\) now gives .*changed since: .*coarse\.py"):
        run(tmp_path, data, budget=90)
    assert rows(tmp_path) == before
    (tmp_path / "coarse.py").write_text(text.replace("SIGN", "1.0 * 1.0"))
    forget_changed()
    run(tmp_path, data, budget=90)
    assert len(rows(tmp_path)) > len(before)


def test_what_does_not_pay_is_left_out_and_said(tmp_path: Path) -> None:
    dear = run(tmp_path / "dear", NOISY, fidelity={**COARSE, "cost": 0.95})
    assert any("do not clearly pay" in sentence for sentence in dear.sentences)
    exact = {**NOISY, "scenario": "testbed:four_branch_7", "budget": 40}
    same = run(tmp_path / "exact", exact, fidelity={"scenario": "testbed:four_branch_7", "cost": 0.5})
    assert any("equal inputs give equal metrics" in sentence for sentence in same.sentences)


def test_pairs_of_one_metric_promise_nothing() -> None:
    """Where all runs of both levels had one time to collision a ratio of .67 was told of them."""
    told = LevelsTold(coarse=20, fine=107, cost=0.3, correlation=None, pairs=8, pays=False, two_levels=1.5, one_level=1.0)
    assert told.sentence().endswith("They were left out: 8 pairs told nothing of how alike both levels are.")
    assert "0.67 times the runs" in replace(told, correlation=0.4).sentence()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"fidelity": {"step_length": [0.1, 0.25]}}, "a multiple of the fine one"),
        ({"fidelity": {"step_length": [0.05, 0.5]}}, "must be the scenario's own step, 0.1 s"),
        ({"fidelity": {"step_length": [0.1, 0.5], "scenario": "cut_in"}}, "but got both"),
        ({"fidelity": {"cost": 0.5}}, "but got neither"),
        ({"fidelity": {"step_length": [0.1, 0.5], "cost": 0}}, "between 0 and 1 run"),
        ({"fidelity": {"scenario": "cut_in"}}, "inputs of the scenario"),
        ({"scenario": "testbed:two_hollows_noisy", "fidelity": {"step_length": [0.1, 0.5]}}, "has none"),
        ({"campaign": "boundary", "fidelity": {"step_length": [0.1, 0.5]}}, "but the campaign is boundary"),
        ({"fidelity": {"step_length": [0.1, 0.5]}, "ego": {"kind": "sumo", "actionStepLength": 0.2}}, "is 0.2 s"),
    ],
)  # fmt: skip
def test_a_coarse_level_that_is_none_is_refused(tmp_path: Path, change: dict[str, Any], said: str) -> None:
    with pytest.raises((ConfigError, InputError)) as error:
        study(tmp_path, {**LEFT_TURN, "budget": 50}, **change).campaign  # noqa: B018
    assert said in str(error.value)


@pytest.mark.sumo
def test_check_says_what_coarse_runs_cost_and_how_alike_they_are(tmp_path: Path) -> None:
    from sbt.workflows.fidelity import fidelity_findings

    found = study(tmp_path, LEFT_TURN, fidelity={"step_length": [0.1, 0.5]})
    runs, told = fidelity_findings(found.spec, found.scenario, 1)
    assert runs.ok
    assert told.numbers["pairs"] >= 25
    assert 0.05 <= told.numbers["cost"] < 1.0
    assert told.numbers["correlation"] > 0.6


@pytest.mark.sumo
def test_the_cost_of_runs_of_milliseconds_is_measured(tmp_path: Path) -> None:
    """By a clock of 10 ms it was .05 for .62, whatever the coarse runs."""
    from sbt.workflows.fidelity import fidelity_findings

    given = {"campaign": "estimation", "scenario": "cut_in", "budget": 50}
    found = study(tmp_path, given, fidelity={"step_length": [0.05, 0.2]})
    _, told = fidelity_findings(found.spec, found.scenario, 1)
    assert told.numbers["cost"] >= 0.3


@pytest.mark.sumo
def test_a_coarse_run_is_shown_as_one_judged_at_its_step_and_not_pinned(tmp_path: Path) -> None:
    """A pin was refused as if SUMO did not repeat itself, and of a judged run it was said that it is not there."""
    data = {"campaign": "estimation", "scenario": "cut_in", "budget": 20, "stop": {"cov": None}}
    run(tmp_path, data, initial=12, fidelity={"step_length": [0.05, 0.2], "cost": 0.3})
    folder = tmp_path / "store"
    with Store.read(folder) as store:
        fine, coarse = ([int(k) for k in store.history(level=level).index] for level in (0, 1))

    def replayed(index: int, *more: str) -> str:
        done = CliRunner().invoke(app, ["replay", str(folder), str(index), *more])
        assert done.exit_code == 0, done.output
        return done.stdout

    assert replayed(coarse[0]).startswith(f"run {coarse[0]}, a coarse run (level 1 of fidelity), seed ")
    assert replayed(fine[0]).startswith(f"run {fine[0]}, seed ")
    assert json.loads(replayed(coarse[0], "--json"))["level"] == 1
    assert "level" not in json.loads(replayed(fine[0], "--json"))
    for index in coarse:
        (judged,) = judge_run(folder, index, ["fsm"])
        if judged.avoided is not None:
            break
    assert judged.avoided is not None, "the test needs a run that can be judged"
    driven = with_driver(replay_run(folder, index), "fsm")
    need = driven.scenario.requirement
    assert judged.metric == need.told_of(driven.outcome.metrics)
    again = study(tmp_path / "again", data).scenario.configured(ego={"kind": "fsm"})
    at_fine = again.run(driven.record.inputs, driven.record.seed)
    assert judged.metric != need.told_of(at_fine), "it was judged at the coarse step"
    states = tmp_path / "states.csv"
    said = json.loads(replayed(index, "--driver", "fsm", "--trace", str(states), "--json"))["preventable"]
    assert [each["metric"] for each in said] == [judged.metric]
    assert pd.read_csv(states)["time"].drop_duplicates().diff().dropna().round(6).unique().tolist() == [0.2]
    with pytest.raises(InputError, match=rf"run {coarse[1]} is a coarse one \(level 1 of fidelity\), which counts as no failure"):
        pin_runs(folder, [str(fine[0]), str(coarse[1])], tmp_path / "pins")
    assert not (tmp_path / "pins").exists()
    assert pin_runs(folder, [str(fine[0])], tmp_path / "pins").is_file()


@pytest.mark.slow
@pytest.mark.sumo
def test_coarse_runs_begin_with_coarse_warm_ups_and_replay_so(tmp_path: Path) -> None:
    scenario = town(tmp_path / "town")
    summary = run(
        tmp_path, {"campaign": "estimation", "scenario": str(scenario), "budget": 8, "stop": {"cov": None}},
        fidelity={"step_length": [STEP, 2 * STEP], "cost": 0.5},
    )  # fmt: skip
    with Store.read(tmp_path / "store") as store:
        coarse = store.history(level=1)
        assert coarse.ok.all()
        assert (coarse.columns["warm_up"] >= 0).all()
        assert store.configuration["isolation"]["level"] == "snapshot"
    assert summary.failed == 0
    assert len(list((tmp_path / "store" / "snapshots").glob("*.state.xml.gz"))) == 4, "two warm-ups, each at both steps"
    assert replay_run(tmp_path / "store", int(coarse.index[0])).identical


@pytest.mark.slow
@pytest.mark.sumo
def test_warm_ups_of_a_coarser_scenario_that_are_not_the_scenarios_are_refused(tmp_path: Path) -> None:
    """They were silently replaced by the scenario's."""
    own = town(tmp_path / "town")
    head, _, _ = own.read_text().partition("duration")
    names = itertools.count()

    def check(fine: str, other: str) -> None:
        number = next(names)
        paths = [own.with_name(f"{name}_{number}.yaml") for name in ("fine", "coarse")]
        for path, warm_up in zip(paths, (fine, other), strict=True):
            path.write_text(f"{head}duration: 3\n{warm_up}\n{METRICS}")
        data = {"campaign": "estimation", "scenario": str(paths[0]), "fidelity": {"scenario": str(paths[1]), "cost": 0.5}}
        study(tmp_path, data, budget=8).campaign  # noqa: B018

    stated = "warm_up: {seeds: 2}"
    with pytest.raises(ConfigError, match=r"which has until: auto, seeds: 2, but coarse_. asks for until: auto, seeds: 3"):
        check(stated, "warm_up: {seeds: 3}")
    with pytest.raises(ConfigError, match=r"which has until: auto, seeds: 2, but coarse_. asks for until: 40"):
        check(stated, "warm_up: {until: 40}")
    with pytest.raises(ConfigError, match=r"which has none, but coarse_. asks for until: auto"):
        check("", "warm_up: {until: auto}")
    for other in ("", stated, "warm_up: {until: auto}"):
        check(stated, other)


@pytest.mark.sumo
def test_an_action_step_of_the_files_is_named_by_its_line(tmp_path: Path) -> None:
    scenario = town(tmp_path / "town")
    cars = tmp_path / "town" / "cars.rou.xml"
    cars.write_text(cars.read_text().replace('<vType id="slow"', '<vType actionStepLength="0.1" id="slow"'))
    with pytest.raises(ConfigError, match=r"cars\.rou\.xml:3: actionStepLength is 0\.1 s and the step 0\.2 s"):
        study(tmp_path, LEFT_TURN, scenario=str(scenario), fidelity={"step_length": [STEP, 2 * STEP]}).campaign  # noqa: B018


@pytest.mark.parametrize(
    ("scenario", "budget", "cost"),
    [("four_branch_7", 10, 0.5), ("two_hollows_noisy", 10, 0.5), ("two_hollows_noisy", 1, 0.95), ("two_hollows_noisy", 33, 0.35)],
)
def test_the_budget_is_kept(tmp_path: Path, scenario: str, budget: int, cost: float) -> None:
    coarse = {"scenario": f"testbed:{scenario}" + ("" if scenario == "four_branch_7" else ":coarse"), "cost": cost}
    run(tmp_path, {**NOISY, "scenario": f"testbed:{scenario}", "budget": budget, "initial": 1}, fidelity=coarse)
    with Store.read(tmp_path / "store") as store:
        spent = len(store.history()) + cost * store.coarse
    assert budget - 2.0 < spent <= budget + 1e-9


def write_levels(folder: Path, metric: str) -> None:
    """Write two scenarios of one input whose metric, of `values`, `seed` and `name`, has noise of its own in each."""
    (folder / "own.py").write_text(
        "import sbt\nfrom sbt.seeds import stream\n"
        "def scenario(name):\n"
        "    return sbt.Scenario(name, inputs=[sbt.Parameter('a', 0, 1)], requirement=sbt.Requirement('y', high=0.2),\n"
        f"        evaluate=lambda values, seed: {{'y': {metric}}})\n"
        "FINE, COARSE = scenario('fine'), scenario('coarse')\n"
    )


def test_where_coarse_runs_tell_nothing_but_inputs_do_these_draw_the_rest(tmp_path: Path) -> None:
    write_levels(tmp_path, "values['a'] + 0.1 * float(stream(seed, name).normal())")
    own = {**NOISY, "scenario": str(tmp_path / "own.py:FINE"), "budget": 200}
    summary = run(tmp_path / "told", own, fidelity={"scenario": str(tmp_path / "own.py:COARSE"), "cost": 0.5})
    told = summary.conclusion
    assert any("do not clearly pay" in sentence for sentence in summary.sentences)
    with Store.read(tmp_path / "told" / "store") as store:
        drawn = store.history().where(store.history().stage == "estimation")
    assert np.ptp(drawn.log_q) > 0.5, "not those of crude Monte Carlo"
    assert told.low < 0.2 < told.high
    assert told.high - told.low < 2.0 * 1.96 * np.sqrt(0.16 / len(drawn)), "and narrower than its interval"


def test_where_coarse_runs_tell_nothing_the_rest_is_crude_monte_carlo(tmp_path: Path) -> None:
    """And where nothing critical is met, hardly a run is spent on what a belief promises."""
    write_levels(tmp_path, "float(stream(seed, name).random())")
    own = {**NOISY, "scenario": str(tmp_path / "own.py:FINE"), "budget": 100}
    summary = run(tmp_path / "unlike", own, fidelity={"scenario": str(tmp_path / "own.py:COARSE"), "cost": 0.2})
    told = summary.conclusion.to_dict()
    assert any("do not clearly pay" in sentence for sentence in summary.sentences)
    assert told["fidelity"]["coarse"] * 0.2 <= 12
    with Store.read(tmp_path / "unlike" / "store") as store:
        drawn = store.history().where(store.history().stage == "estimation")
    critical = drawn.y("y") <= 0.2
    assert told["probability"] == pytest.approx(critical.mean()), "every run counts, the first ones too"
    never = run(tmp_path / "never", {**NOISY, "requirement": {"metric": "y", "critical": [-1e9, -1e8]}}, fidelity=COARSE)
    found = never.conclusion.to_dict()
    assert found["exact_bound"] <= 1.4 * (1.0 - 0.05 ** (1.0 / found["fidelity"]["fine"]))


SEARCH = {**NOISY, "campaign": "falsification", "budget": 40, "stop": {}, "requirement": {"metric": "y", "critical": [-1e9, 0.0]}}


def test_a_falsification_screens_its_candidates_and_counts_no_coarse_run(tmp_path: Path) -> None:
    summary = run(tmp_path / "whole", SEARCH, fidelity=COARSE)
    told = summary.conclusion.to_dict()
    with Store.read(tmp_path / "whole" / "store") as store:
        fine, coarse = store.history(), store.history(level=1)
    searched = fine.where(fine.stage != "confirm")
    assert told["fidelity"]["screened"] >= 5
    assert len(coarse) > told["fidelity"]["screened"]
    assert 40 - 1.2 < len(searched) + 0.2 * len(coarse) <= 40 + 1e-9
    assert told["critical_runs"] == int((searched.y("y") <= 0.0).sum())
    pairs = {(tuple(x), s) for x, s in zip(coarse.x, coarse.seed, strict=True)}
    screened = np.array([(tuple(x), s) in pairs for x, s in zip(searched.x, searched.seed, strict=True)])
    assert screened.sum() >= told["fidelity"]["screened"], "the same inputs and the same seed at both levels"
    assert any("A coarse run counts as no failure" in sentence for sentence in summary.sentences)
    run(tmp_path / "workers", SEARCH, fidelity=COARSE, executor={"kind": "local", "workers": 2})
    assert rows(tmp_path / "whole") == rows(tmp_path / "workers")


def test_a_falsification_leaves_coarse_runs_out_that_predict_nothing(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(
        "import sbt\nfrom sbt.seeds import stream\n"
        "def scenario(name, times=1.0):\n"
        "    return sbt.Scenario(name, inputs=[sbt.Parameter('a', 0, 1)], requirement=sbt.Requirement('y', high=0.1),\n"
        "        evaluate=lambda values, seed: {'y': 0.5 + times * (float(stream(seed, name).random()) - 0.5)})\n"
        "FINE, COARSE, CONSTANT = scenario('fine'), scenario('coarse'), scenario('constant', 0.0)\n"
    )
    own = {"campaign": "falsification", "scenario": str(tmp_path / "own.py:FINE"), "budget": 30}
    for coarse, correlates in [("COARSE", True), ("CONSTANT", False)]:
        summary = run(tmp_path / coarse, own, fidelity={"scenario": str(tmp_path / f"own.py:{coarse}"), "cost": 0.2})
        told = summary.conclusion.to_dict()["fidelity"]
        assert told["coarse"] <= 10
        assert (told["correlation"] is not None) == correlates
        said = [sentence for sentence in summary.sentences if "Screening did not pay" in sentence]
        assert [("correlates" in sentence) for sentence in said] == [correlates]


def test_coarse_runs_without_a_metric_are_no_pairs(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(
        "import sbt, math\n"
        "def scenario(name, fails):\n"
        "    return sbt.Scenario(name, inputs=[sbt.Parameter('a', 0, 1)], requirement=sbt.Requirement('y', high=0.0),\n"
        "        evaluate=lambda values, seed: {'y': math.nan if fails < values['a'] < 0.75 else 1.0 + values['a']})\n"
        "FINE, COARSE = scenario('fine', 2.0), scenario('coarse', 0.6)\n"
    )
    own = {"campaign": "falsification", "scenario": str(tmp_path / "own.py:FINE"), "budget": 30}
    summary = run(tmp_path / "some", own, fidelity={"scenario": str(tmp_path / "own.py:COARSE"), "cost": 0.2})
    told = summary.conclusion.to_dict()["fidelity"]
    with Store.read(tmp_path / "some" / "store") as store:
        coarse = store.history(level=1)
    assert 0 < told["pairs"] <= told["coarse"] - told["without"] == int(coarse.ok.sum()) < len(coarse)
    assert any(f"and {told['without']} of the coarse runs gave no metric" in sentence for sentence in summary.sentences)

"""The campaign is a fold over its log: budget, stages, resumption, and where the runs lie."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from sbt.campaigns.repeats import REPEAT
from sbt.cli import app
from sbt.errors import InputError, SbtError
from sbt.estimators.binomial import interval
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import run_seed, stream
from sbt.store.database import Store
from sbt.store.history import VALIDATION

Run = Callable[..., dict[str, Any]]
Rows = Callable[..., dict[str, list[Any]]]


def history(result: dict[str, Any]) -> Any:
    with Store.read(Path(result["store"])) as store:
        return store.history()


def sbt(*args: str, code: int) -> Any:
    done = CliRunner().invoke(app, args)
    assert done.exit_code == code, done.output
    return done


def test_killed_at_any_moment_and_run_again_gives_the_same_rows(campaign: Run, configured: Callable[..., Path], rows: Rows):
    keys = {"budget": 150, "initial": 30, "batch": 30, "validation": {"reference": 10}}
    whole = campaign("whole", "SLOW", **keys)
    config = configured("killed", "SLOW", **keys)
    command = [sys.executable, "-m", "sbt", "run", str(config), "--json"]
    rng = stream(11, "moments")
    done: list[int] = []
    for least in (None, 1, 37, 95):  # None: the store itself is in the making
        driver = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            if (config.parent / "killed").exists() if least is None else len(_finished(config.parent / "killed")) >= least:
                break
            time.sleep(0.001)
        time.sleep(float(rng.uniform(0.0, 0.05)))
        driver.send_signal(signal.SIGKILL)
        assert driver.wait() == -signal.SIGKILL
        done.append(len(_finished(config.parent / "killed")))
    again = json.loads(sbt("run", str(config), "--json", code=0).stdout)
    assert 0 < done[1] <= done[2] <= done[3] < 160
    assert rows(again["store"]) == rows(whole["store"])
    same = ("runs", "ok", "failed", "critical", "iterations", "stopped", "conclusion")
    assert {k: again[k] for k in same} == json.loads(json.dumps({k: whole[k] for k in same}))


def _finished(folder: Path) -> list[Any]:
    try:
        with Store.read(folder) as store:
            return list(store.history().records)
    except SbtError:
        return []


def test_a_store_that_was_killed_at_birth_is_born_again(campaign: Run, rows: Rows, tmp_path: Path):
    Store.open(tmp_path / "c").close()  # a file without a campaign in it
    assert not Store.begun(tmp_path / "c")
    born = campaign()
    assert rows(born["store"]) == rows(campaign("other")["store"])


def test_running_again_changes_nothing(campaign: Run, rows: Rows):
    first = campaign()
    before = rows(first["store"])
    again = campaign(report=True)
    assert rows(again["store"]) == before
    assert {**again, "seconds": 0} == {**first, "seconds": 0}
    assert (Path(first["store"]) / "report.html").stat().st_size > 10_000
    with Store.read(Path(first["store"])) as store:
        assert store.conclusion == again


def test_no_executor_changes_the_rows(campaign: Run, rows: Rows):
    serial = campaign("serial", "SOME_FAIL")
    local = campaign("local", "SOME_FAIL", executor={"kind": "local", "workers": 2})
    assert rows(serial["store"]) == rows(local["store"])
    assert serial["failed"] > 0
    other = campaign("other", "SOME_FAIL", seed=4)
    assert rows(other["store"])["runs"] != rows(serial["store"])["runs"]


@pytest.mark.parametrize(
    ("budget", "initial", "batch", "sizes"),
    [
        (50, 20, 20, [20, 20, 10]),
        (20, 20, 7, [20]),
        (23, 20, 20, [20, 3]),
        (1, 1, 1, [1]),
        (4, 1, 1, [1] * 4),
        (5, 2, 10, [2, 3]),
    ],
)
def test_the_budget_is_kept_to_the_run(campaign: Run, budget: int, initial: int, batch: int, sizes: list[int]):
    result = campaign(budget=budget, initial=initial, batch=batch)
    found = history(result)
    assert (result["runs"], result["stopped"], result["iterations"]) == (budget, "budget", len(sizes))
    assert list(Counter(found.iteration.tolist()).values()) == sizes
    np.testing.assert_array_equal(found.index, np.arange(budget))
    assert [r.seed for r in found.records] == [run_seed(3, k) for k in range(budget)]


def test_the_first_batch_is_the_sobol_sequence_and_no_point_comes_twice(campaign: Run):
    found = history(campaign(budget=120, initial=40, batch=20, validation={"share": 0}, acquisition={"kind": "boundary"}))
    sequence = SobolSequence(2, 3).points(0, 20_000)
    np.testing.assert_array_equal(found.x[:40], sequence[:40])
    position = {tuple(u): k for k, u in enumerate(sequence.tolist())}
    chosen = found.where(found.stage != REPEAT)
    positions = [position[tuple(x)] for x in chosen.x.tolist()]
    assert (np.diff(positions) > 0).all()  # one sequence, continued: accepted or passed, never looked at again
    assert len(np.unique(found.x, axis=0)) == len(chosen) == 118  # two repeat inputs with other seeds


def test_coverage_is_the_sobol_sequence_alone(campaign: Run):
    result = campaign(campaign="coverage", metamodel=None, budget=50, initial=20, batch=20)
    found = history(result)
    np.testing.assert_array_equal(found.x, SobolSequence(2, 3).points(0, 50))
    share = float((found.y("y") <= 0).mean())
    assert result["conclusion"] == {
        "critical_fraction": share, "low": float(interval(round(50 * share), 50)[0]),
        "high": float(interval(round(50 * share), 50)[1]), "confidence": 0.95, "counted": 50,
    }  # fmt: skip
    assert result["conclusion"]["low"] < 0.09 * math.pi < result["conclusion"]["high"]


def test_a_share_of_every_batch_is_held_out(campaign: Run):
    found = history(campaign(budget=75, initial=20, batch=10, validation={"share": 0.2, "reference": 7}))
    stages = [Counter(found.stage[found.iteration == k].tolist()) for k in range(int(found.iteration.max()) + 1)]
    assert stages[0] == {"initial": 16, VALIDATION: 4 + 7}
    assert stages[1] == {"boundary": 6, REPEAT: 2, VALIDATION: 2}
    assert all(s == {"boundary": 8, VALIDATION: 2} for s in stages[2:-1])
    assert sum(s.total() for s in stages) == 75 + 7
    held_out = [r for r in found.records if r.stage == VALIDATION]
    assert len(held_out) == 15 + 7
    assert {r.log_q for r in held_out} == {0.0}  # uniform on the unit square
    assert {r.log_q for r in found.records if r.stage != VALIDATION} == {None}
    assert len(np.unique(found.x, axis=0)) == 82 - 2  # two repeat inputs with other seeds


def test_held_out_and_failed_runs_never_reach_the_metamodel(campaign: Run, tmp_path: Path):
    log = tmp_path / "taught"
    metamodel = {"kind": "analytic.py:Nearest", "log": str(log)}
    found = history(campaign("c", "SOME_FAIL", metamodel=metamodel, validation={"share": 0.25, "reference": 5}, budget=60))
    lessons = [[float(v) for v in line.split()] for line in log.read_text().splitlines()]
    y = found.y("y")
    assert (found.stage == VALIDATION).sum() == 20
    assert 0 < (~found.ok).sum() < 60
    expected = [
        y[(found.iteration < k) & found.ok & (found.stage != VALIDATION)].tolist()
        for k in range(1, int(found.iteration.max()) + 2)
    ]
    assert lessons == expected
    refused = [r for r in found.records if r.status == "invalid"]
    assert {r.reason for r in refused} == {"a < 0.3 cannot be realised"}
    assert all(r.inputs["a"] < 0.3 and dict(r.metrics) == {} for r in refused)


def test_a_larger_budget_goes_on(campaign: Run, rows: Rows):
    small = campaign("grown", budget=40)
    before = rows(small["store"])
    grown = campaign("grown", budget=80)
    after = rows(grown["store"])
    assert after["runs"][:40] == before["runs"]
    assert after["iterations"][:2] == before["iterations"]
    assert after == rows(campaign("at once", budget=80)["store"])
    assert (grown["runs"], grown["iterations"]) == (80, 4)
    smaller = campaign("grown", budget=30)
    assert (smaller["runs"], smaller["stopped"]) == (80, "budget")


@pytest.mark.parametrize(
    "change",
    [{"seed": 4}, {"batch": 10}, {"initial": 10}, {"requirement": {"critical": [-1.0, 0.1]}}, {"inputs": {"a": {"max": 0.9}}},
     {"validation": {"share": 0.3}}, {"metamodel": {"kind": "et"}}],
    ids=lambda change: next(iter(change)),
)  # fmt: skip
def test_a_changed_configuration_is_refused(campaign: Run, rows: Rows, change: dict[str, Any]):
    before = rows(campaign(budget=20)["store"])
    with pytest.raises(InputError, match=rf"belongs to one configuration, but .* was made with another \({next(iter(change))}: "):
        campaign(**{"budget": 20, **change})
    assert rows(campaign(budget=20, executor={"kind": "serial", "timeout": 5})["store"]) == before


def test_a_changed_configuration_ends_with_2(configured: Callable[..., Path], campaign: Run):
    campaign(budget=20)
    done = sbt("run", str(configured(budget=20)), "--set", "seed=9", "--json", code=2)
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert "seed: 3 there, 9 now" in done.stderr


def test_a_metamodel_that_raises_is_told_with_its_place_and_nothing_is_lost(configured: Callable[..., Path], rows: Rows):
    config = configured(metamodel={"kind": "analytic.py:Raising", "rows": 20}, validation={"share": 0})
    done = sbt("run", str(config), "--json", code=1)
    assert done.stdout == ""
    place = 1 + max(k for k, text in enumerate((config.parent / "analytic.py").read_text().splitlines()) if "# marked" in text)
    assert done.stderr == (
        "metamodel Raising must learn from 40 rows and predict, but raised RuntimeError: the matrix is singular "
        f"({config.parent}/analytic.py:{place})\n"
    )
    assert [run.status for run in rows(config.parent / "c")["runs"]] == ["ok"] * 40


def test_all_runs_failing_is_a_result(configured: Callable[..., Path]):
    done = sbt("run", str(configured("c", "ALL_FAIL")), "--json", code=4)
    result = json.loads(done.stdout)
    assert (result["runs"], result["ok"], result["failed"], result["critical"]) == (60, 0, 60, 0)
    assert result["conclusion"]["critical_fraction"] is None
    assert "at most half of the runs may fail, but 60 of 60 did" in done.stderr
    assert (Path(result["store"]) / "report.html").is_file()


@pytest.mark.parametrize("kind", ["analytic.py:Nearest", "et"])
def test_one_input_and_hardly_any_rows(campaign: Run, kind: str):
    result = campaign("c", "LINE", metamodel={"kind": kind}, budget=6, initial=1, batch=1, validation={"share": 0.5})
    assert (result["runs"], result["ok"]) == (6, 6)
    longer = campaign("d", "LINE", metamodel={"kind": kind}, budget=40, initial=10, batch=10)
    assert longer["conclusion"]["critical_fraction"] == pytest.approx(0.25, abs=0.1)


def test_a_stable_boundary_stops_the_campaign_and_stays_stopped(campaign: Run, rows: Rows):
    """The belief jumps at the second and third fit; two changes below the limit are what it takes."""
    keys = {
        "metamodel": {"kind": "analytic.py:Shifting", "rounds": "cnhhhccccc"}, "budget": 60, "initial": 8, "batch": 4,
        "validation": {"share": 0}, "stop": {"stable": 0.01},
    }  # fmt: skip
    result = campaign(**keys)
    assert (result["stopped"], result["iterations"], result["runs"]) == ("stable", 6, 8 + 5 * 4)
    before = rows(result["store"])
    again = campaign(**keys)  # its last, concluding fit has changed sides again: it was not asked
    assert (again["stopped"], rows(again["store"])) == ("stable", before)
    off = campaign("off", **{**keys, "stop": {"stable": None}, "metamodel": {"kind": "analytic.py:Shifting"}})
    assert (off["stopped"], off["runs"]) == ("budget", 60)


def test_runs_concentrate_on_the_boundary(campaign: Run):
    """The paper's claim, in small: distances of the adaptive runs to a known circle against even ones."""

    def distances(result: dict[str, Any]) -> Any:
        x = history(result).x[40:]
        return np.abs(np.hypot(x[:, 0] - 0.5, x[:, 1] - 0.5) - 0.3)

    keys = {"budget": 140, "initial": 40, "batch": 25, "validation": {"share": 0}}
    adaptive, even = (distances(campaign(kind, acquisition={"kind": kind}, **keys)) for kind in ("boundary", "even"))
    assert len(adaptive) == len(even) == 100
    assert np.median(adaptive) < 0.5 * np.median(even)
    assert (adaptive < 0.05).mean() > 2 * (even < 0.05).mean()


def test_progress_counts_what_was_run(configured: Callable[..., Path]):
    from studies import run_loaded

    from sbt.config.load import load

    seen: list[Any] = []
    run_loaded(load(configured("c", "SOME_FAIL", budget=40)), progress=seen.append, report=False)
    done = [p.done for p in seen]
    assert done == sorted(done)
    assert (done[0], done[-1], seen[-1].budget) == (0, 40, 40)
    found = _finished(configured().parent / "c")
    assert seen[-1].failed == sum(r.status != "ok" for r in found)
    assert seen[-1].critical == sum(r.metrics["y"] <= 0 for r in found if r.status == "ok")
    resumed: list[Any] = []
    run_loaded(load(configured("c", "SOME_FAIL", budget=60)), progress=resumed.append, report=False)
    assert resumed[0].done == 40


def test_an_interruption_can_be_resumed(configured: Callable[..., Path], rows: Rows, campaign: Run):
    config = configured("c", "SLOW", budget=240)
    driver = subprocess.Popen([sys.executable, "-m", "sbt", "run", str(config), "--json"], stdout=subprocess.PIPE,
                              stderr=subprocess.PIPE, text=True)  # fmt: skip
    while not len(_finished(config.parent / "c")):
        time.sleep(0.05)
    os.kill(driver.pid, signal.SIGINT)
    out, err = driver.communicate(timeout=30)
    assert (driver.returncode, out, err.splitlines()[-1]) == (130, "", "interrupted, run again to resume")
    assert rows(campaign("c", "SLOW", budget=240)["store"]) == rows(campaign("d", "SLOW", budget=240)["store"])

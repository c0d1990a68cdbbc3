"""Shards and merge: the parts of a campaign, run apart, are the campaign."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from studies import run_loaded
from typer.testing import CliRunner

from sbt.cli import app
from sbt.config.load import load
from sbt.errors import InputError
from sbt.loop.stages import Shard
from sbt.store.database import Store
from sbt.workflows.merging import merge_shards
from sbt.workflows.running import replay_run

Run = Callable[..., dict[str, Any]]
Rows = Callable[[Path | str], dict[str, list[Any]]]
Configured = Callable[..., Path]
COVERAGE: dict[str, Any] = {"campaign": "coverage", "budget": 53, "metamodel": None}
LEARNED: dict[str, Any] = {"campaign": "coverage", "budget": 53, "validation": {"share": 0.2, "reference": 7}}
CRUDE: dict[str, Any] = {
    "campaign": "estimation", "budget": 53, "acquisition": {"kind": "monte_carlo"}, "stop": {"cov": None}, "validation": {},
}  # fmt: skip


def sharded(configured: Configured, n: int, scenario: str = "SCENARIO", **keys: Any) -> list[Path]:
    """Run all shards of a configuration, the last first, into folders of unlike depth."""
    folders = []
    for k in range(n, 0, -1):
        file = configured(f"shard{k}", scenario, **keys)
        loaded = load(file, [f"store={file.parent.joinpath(*k * ['deep'], f'shard{k}')}"])
        result = run_loaded(loaded, shard=Shard(k, n))
        assert result["conclusion"]["shard"] == f"{k}/{n}"
        folders.append(Path(result["store"]))
    return folders


def timeless(result: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in result.items() if key not in ("seconds", "store")}


@pytest.mark.parametrize(
    ("keys", "n"), [
        pytest.param(COVERAGE, 3, marks=pytest.mark.slow), (LEARNED, 4), pytest.param(CRUDE, 2, marks=pytest.mark.slow),
        ({**CRUDE, "batch": 2, "initial": 1}, 7), pytest.param(COVERAGE, 1, marks=pytest.mark.slow),
    ],
    ids=["coverage", "with a metamodel", "monte carlo", "batches smaller than shards", "one shard"],
)  # fmt: skip
def test_merged_shards_are_the_campaign_row_for_row(
    keys: dict[str, Any], n: int, configured: Configured, campaign: Run, rows: Rows, tmp_path: Path
):
    whole = campaign("whole", "SOME_FAIL", **keys)
    merged = merge_shards(sharded(configured, n, "SOME_FAIL", **keys), tmp_path / "merged", report=False).to_dict()
    assert rows(merged["store"]) == rows(whole["store"])
    assert timeless(merged) == timeless(whole)
    assert 0 < merged["failed"] < merged["runs"]
    with Store.read(Path(merged["store"])) as store:
        assert {r.versions for r in store.history().records} != {""}
        assert all(r.seconds > 0 for r in store.history().records)


def test_every_run_is_in_one_shard_with_its_own_index(configured: Configured, rows: Rows):
    parts = [rows(folder)["runs"] for folder in sharded(configured, 3, **COVERAGE)]
    assert [{run.index % 3 for run in part} for part in parts] == [{2}, {1}, {0}]
    assert sorted(run.index for part in parts for run in part) == list(range(53))


def test_a_merged_store_is_a_store(configured: Configured, rows: Rows, tmp_path: Path):
    folders = sharded(configured, 2, **LEARNED)
    into = tmp_path / "deep" / "merged"
    merge_shards(folders, into)
    assert (into / "report.html").is_file()
    assert sorted(p.name for p in into.iterdir() if p.name.startswith(".")) == []
    before = rows(into)
    again = replay_run(into, 17)
    record, outcome = again.record, again.outcome
    assert dict(record.metrics) == dict(outcome.metrics)
    told = CliRunner().invoke(app, ["status", str(into), "--json"])
    assert json.loads(told.stdout)["runs"] == {"ok": 60}
    assert CliRunner().invoke(app, ["export", str(into)]).exit_code == 0
    (tmp_path / "asked.csv").write_text("a,b\n0.5,0.5\n")
    assert CliRunner().invoke(app, ["predict", str(into), "--inputs", str(tmp_path / "asked.csv")]).exit_code == 0
    again = run_loaded(load(configured("again", **LEARNED | {"store": str(into)})), report=False)
    assert (again["runs"], rows(into)) == (60, before)


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        ({}, "--shard needs batches that depend on no result, but here each batch depends on all results before it; run it"),
        ({"campaign": "falsification"}, "each batch depends on all results before it"),
        ({**CRUDE, "acquisition": {"kind": "difference"}}, "each batch depends on all results before it"),
        ({**CRUDE, "acquisition": {"kind": "subset"}}, "each batch depends on all results before it"),
        ({**CRUDE, "stop": {"cov": 0.1}}, "here stop.cov = 0.1 ends it where the results say (null: the whole budget is run)"),
        ({**COVERAGE, "budget": 20}, "at most as many shards as runs, but got shard 2/30 of 20 runs"),
    ],
)
def test_what_cannot_be_shared_out_is_refused(keys: dict[str, Any], told: str, configured: Configured):
    with pytest.raises(InputError, match=told.replace(".", r"\.").replace("(", r"\(").replace(")", r"\)")):
        run_loaded(load(configured("c", **keys)), shard=Shard(2, 30))


@pytest.mark.parametrize("text", ["0/3", "4/3", "3", "a/b", "-1/3", "1/0", "1/2/3"])
def test_a_shard_is_one_of_n(text: str):
    with pytest.raises(InputError, match="a shard is I/N"):
        Shard.parse(text)


def test_a_shard_belongs_to_one_number_and_budget(configured: Configured, rows: Rows):
    run_loaded(load(configured("c", **COVERAGE)), shard=Shard(1, 3))
    before = rows(configured().parent / "c")
    for shard, budget in ((None, 53), (Shard(2, 3), 53), (Shard(1, 4), 53), (Shard(1, 3), 90)):
        with pytest.raises(InputError, match="a store belongs to one configuration"):
            run_loaded(load(configured("c", **COVERAGE | {"budget": budget})), shard=shard)
    again = run_loaded(load(configured("c", **COVERAGE)), shard=Shard(1, 3))
    assert (again["runs"], rows(configured().parent / "c")) == (18, before)


def test_what_is_not_whole_is_not_merged(configured: Configured, campaign: Run, tmp_path: Path):
    three, two, one = sharded(configured, 3, **COVERAGE)
    other = tmp_path / "other"
    run_loaded(load(configured("other", **COVERAGE | {"seed": 9})), shard=Shard(2, 3))
    finer = tmp_path / "finer"
    run_loaded(load(configured("finer", **COVERAGE)), shard=Shard(2, 4))
    whole = Path(campaign("whole", **COVERAGE)["store"])
    cases = [
        ([one, three], r"all 53 runs must be there, but 1, 4, 7, .* \(18 in all\) are missing: shards 2 of 3 were not given"),
        ([one, two, three, two], rf"runs 1, 4, 7, .* \(18 in all\) are in {two} and in {two}"),
        ([one, other, three], r"shards must have one configuration, .* \(seed: 3 there, 9 here\)"),
        ([one, finer, three], r"number of shards: 3 there, 4 here"),
        ([one, whole, three], "holds a whole campaign"),
    ]
    for folders, told in cases:
        with pytest.raises(InputError, match=told):
            merge_shards(folders, tmp_path / "merged")
        assert not (tmp_path / "merged").exists()
    with pytest.raises(InputError, match="a folder without a campaign, but there is one in"):
        merge_shards([one, two, three], whole)


def test_shards_of_other_states_of_the_package_are_not_merged(
    configured: Configured, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    one = run_loaded(load(configured("one", **COVERAGE)), shard=Shard(1, 2))
    monkeypatch.setattr("sbt.workflows.running.package_print", lambda: "another")
    other = run_loaded(load(configured("other", **COVERAGE)), shard=Shard(2, 2))
    with pytest.raises(InputError, match="the same state of this package and of SUMO"):
        merge_shards([Path(one["store"]), Path(other["store"])], tmp_path / "merged")


def test_a_merge_that_fails_leaves_nothing(configured: Configured, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folders = sharded(configured, 2, **COVERAGE)
    into = tmp_path / "merged"

    def stop(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sbt.workflows.merging.summarise", stop)
    with pytest.raises(KeyboardInterrupt):
        merge_shards(folders, into)
    assert list(into.iterdir()) == []


KILLED = """
import os, signal, sys
from pathlib import Path
import sbt.workflows.merging
left, move = int(sys.argv[1]), sbt.workflows.merging.move_atomically
def moved(*paths):
    global left
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    left -= 1
    move(*paths)
sbt.workflows.merging.move_atomically = moved
sbt.workflows.merging.merge_shards([Path(p) for p in sys.argv[3:]], Path(sys.argv[2]))
"""


@pytest.mark.parametrize("moves", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_killed_merge_leaves_no_store_and_can_be_repeated(
    moves: int, configured: Configured, rows: Rows, campaign: Run, tmp_path: Path
):
    folders, into = sharded(configured, 2, **COVERAGE), tmp_path / "merged"
    killed = subprocess.run([sys.executable, "-c", KILLED, str(moves), str(into), *map(str, folders)])
    assert killed.returncode == -signal.SIGKILL
    assert list(into.iterdir()) != []
    assert not Store.begun(into)
    merged, whole = merge_shards(folders, into, report=False).to_dict(), campaign("whole", **COVERAGE)
    assert rows(into) == rows(whole["store"])
    assert timeless(merged) == timeless(whole)


def test_a_killed_shard_goes_on_and_is_not_merged_before(configured: Configured, rows: Rows, campaign: Run, tmp_path: Path):
    keys = {**COVERAGE, "budget": 160}
    config = configured("c", "SLOW", **keys)
    into = config.parent / "c"
    shard = into / "shard-1-of-2"
    command = [sys.executable, "-m", "sbt", "run", str(config), "--json", "--shard", "1/2"]
    killed = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    while not (Store.begun(shard) and _done(shard) > 5):
        time.sleep(0.01)
    os.kill(killed.pid, signal.SIGKILL)
    killed.wait()
    with pytest.raises(InputError, match=r"shards must be finished, but 1/2 in .*shard-1-of-2 is not: runs .* are missing"):
        merge_shards([shard], into)
    for k in (1, 2):
        run_loaded(load(config, [f"store={into}/shard-{k}-of-2"]), shard=Shard(k, 2))
    merged = merge_shards(sorted(into.glob("shard-*-of-2")), into, report=False).to_dict()  # where one run would have put it
    assert rows(merged["store"]) == rows(campaign("whole", "SLOW", **keys)["store"])


def _done(folder: Path) -> int:
    with Store.read(folder) as store:
        return len(store.history())


def test_verdict_of_a_merge(configured: Configured, tmp_path: Path):
    """Exit codes are those of the run that it stands for."""
    keys = {**CRUDE, "gate": {"probability": 0.01}}
    folders = [str(folder) for folder in sharded(configured, 2, **keys)]
    into = ["--into", str(tmp_path / "m")]
    done = CliRunner().invoke(app, ["merge", *folders, *into, "--json", "--junit", str(tmp_path / "v.xml")])
    assert done.exit_code == 3
    assert json.loads(done.stdout.splitlines()[0])["conclusion"]["gate"]["verdict"] == "fail"
    assert "failure" in (tmp_path / "v.xml").read_text()
    shutil.rmtree(tmp_path / "m")
    done = CliRunner().invoke(app, ["merge", folders[0], *into])
    assert done.exit_code == 2


def test_dask_that_is_not_installed_is_told_before_anything_is_written(configured: Configured, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("sbt.execution.dask.find_spec", lambda _: None)
    config = configured("c", executor={"kind": "dask"})
    with pytest.raises(InputError, match=r"needs dask\.distributed: pip install 'sumo-sbt\[dask\]', or choose local"):
        run_loaded(load(config))
    assert not (config.parent / "c").exists()

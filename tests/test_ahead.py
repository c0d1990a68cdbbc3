"""Batches chosen while earlier ones are run: functions of the log all the same."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sbt
from sbt.campaigns.parts import BatchStage
from sbt.errors import InputError
from sbt.loop.stages import Batch, Log
from sbt.samplers.greedy import select_representative
from sbt.seeds import run_seed, run_seeds

AHEAD = {"size": 8, "ahead": 1}
BASE: dict[str, Any] = {"scenario": "testbed:four_branch_7", "initial": 16, "metamodel": {"kind": "gp"}, "report": False}


def rows(folder: Path, **settings: Any) -> list[tuple[Any, ...]]:
    """Run a campaign; return what its rows are, without the times."""
    history = sbt.run(**{**BASE, "executor": "serial", **settings}, store=str(folder)).history
    return [(r.index, r.stage, r.iteration, dict(r.inputs), r.seed, dict(r.metrics), r.log_q) for r in history.records]


@pytest.mark.parametrize("campaign", ["boundary", "falsification", "estimation"])
def test_rows_do_not_depend_on_workers_or_on_when_it_was_killed(tmp_path: Path, campaign: str):
    settings = {"campaign": campaign, "budget": 40, "batch": AHEAD}
    expected = rows(tmp_path / "serial", **settings)
    assert len(expected) >= 40
    if campaign == "boundary":  # to start workers takes longer than all the rest
        assert rows(tmp_path / "local", **settings, executor="local", workers=2) == expected

    def kill(progress: Any) -> None:
        if progress.done == 29:  # in a batch whose successor is planned already
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rows(tmp_path / "killed", **settings, progress=kill)
    assert rows(tmp_path / "killed", **settings) == expected


def test_a_batch_sees_where_the_one_before_lies_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    seen: list[tuple[int, int, list[int]]] = []
    original = BatchStage.propose

    def propose(self: BatchStage, log: Log) -> Batch:
        if log.iteration:
            pending = [] if log.pending is None else np.unique(log.pending.iteration).tolist()
            seen.append((log.iteration, int(log.history.iteration.max()), pending))
            assert log.pending is None or not (log.pending.ok.any() or log.pending.metrics)
            assert len(log.planned) == 16 + 8 * (log.iteration - 1)
        return original(self, log)

    monkeypatch.setattr(BatchStage, "propose", propose)
    rows(tmp_path / "a", campaign="boundary", budget=48, batch=AHEAD)
    assert seen == [(1, 0, []), (2, 0, [1]), (3, 1, [2]), (4, 2, [3])]


def test_what_needs_all_results_refuses_to_look_ahead(tmp_path: Path):
    with pytest.raises(InputError, match=r"batch.ahead must be 0 .* estimation by subset"):
        rows(tmp_path / "a", campaign="estimation", budget=48, batch=AHEAD, acquisition={"kind": "subset"})
    with pytest.raises(InputError, match=r"batch.aheda: unknown key.* 'ahead'"):
        rows(tmp_path / "b", campaign="boundary", budget=48, batch={"aheda": 1})


@pytest.mark.parametrize("seed", [0, 7, 2**32 - 1, 2**40])
def test_seeds_drawn_at_once_are_those_drawn_alone(seed: int):
    indices = [*range(40), 999_999, 2**31]
    assert run_seeds(seed, indices) == [run_seed(seed, k) for k in indices]


def test_lazy_selection_takes_what_a_full_one_takes():
    rng = np.random.Generator(np.random.PCG64(5))
    u, existing, weight = rng.random((300, 3)), rng.random((40, 3)), rng.random(300) ** 4
    nearest = ((u[:, None] - existing) ** 2).sum(axis=2).min(axis=1)
    between, full = ((u[:, None] - u) ** 2).sum(axis=2), list[int]()
    for _ in range(90):
        full.append(int(np.argmax(weight @ np.maximum(nearest[:, None] - between, 0.0))))
        nearest = np.minimum(nearest, between[full[-1]])
    assert select_representative(u, weight, existing, 90, np.ones(3)).tolist() == full

"""Runs beside the budget, as the log tells them: repetitions of failure modes, and runs between critical ones."""

from __future__ import annotations

import numpy as np

from sbt.campaigns.linking import Link
from sbt.campaigns.records import CONFIRM, LINK, RACE, SearchProposal
from sbt.loop.stages import Log
from sbt.problem.arrays import Mask, Vector
from sbt.store.history import History

__all__ = ["Links", "batches_by", "confirmations", "links_of", "raced_runs", "with_links"]

Links = tuple[Link, ...]


def with_links(log: Log) -> History:
    """Return the runs of the search, and those between critical ones."""
    history = log.history
    return history.where((history.stage != CONFIRM) | np.isin(history.iteration, batches_by(log, LINK)))


def links_of(log: Log) -> Links:
    """Return the runs between critical ones, and between which."""
    found = []
    for batch in log.iterations:
        ends = batch.read(SearchProposal).ends if batch.stage == CONFIRM else None
        if ends is not None:
            runs = np.sort(log.history.index[log.history.iteration == batch.number]).tolist()
            found += [Link(run, pair) for run, pair in zip(runs, ends, strict=True)]
    return tuple(found)


def batches_by(log: Log, *methods: str) -> tuple[int, ...]:
    """Return the numbers of the batches beside the budget that are by one of these methods."""
    beside = (batch for batch in log.iterations if batch.stage == CONFIRM)
    return tuple(batch.number for batch in beside if batch.read(SearchProposal).method in methods)


def raced_runs(log: Log) -> History:
    """Return the repetitions that help to order the modes of a noisy simulator."""
    return log.history.where(np.isin(log.history.iteration, batches_by(log, RACE)))


def confirmations(history: History, x: Vector, aside: tuple[int, ...]) -> Mask:
    """Return (n,) booleans: the run repeated the inputs x (d,) to confirm a failure mode, in no batch of those set aside."""
    return (history.stage == CONFIRM) & (history.x == x).all(axis=1) & ~np.isin(history.iteration, aside)

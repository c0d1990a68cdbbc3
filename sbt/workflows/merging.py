"""Joins the stores of a campaign's shards into the one store that an unsharded run would have written.

The campaign is run once more, by the loop that always runs it, only that outcomes are recalled from the
shards: rows, batches, fits and the conclusion come about as they would have without shards.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from sbt.errors import InputError, SbtError
from sbt.files import move_atomically, scratch_in
from sbt.loop.running import run_stages
from sbt.loop.stages import Shard
from sbt.problem.description import is_complete
from sbt.problem.outcome import Job, Outcome, Status
from sbt.problem.plain import JsonMapping
from sbt.store.database import DATABASE, Store
from sbt.store.history import Record
from sbt.workflows.changes import CONTENTS, changed_since
from sbt.workflows.rechecking import check_code
from sbt.workflows.running import Summary, keep_configuration, rebuild_report, summarise
from sbt.workflows.study import PACKAGE, RESOLVED, Study

__all__ = ["merge_shards"]

_OWN = {"folder", "place", "yaml", "shard", "described", CONTENTS}
"""What may differ in the configurations of shards."""
_TOLD = 10


@dataclass(frozen=True, eq=False)
class _Part:
    """What one shard's store holds."""

    folder: Path
    shard: Shard
    configuration: JsonMapping
    records: tuple[Record, ...]
    total: int


def merge_shards(folders: Sequence[Path], into: Path, *, report: bool = True) -> Summary:
    """Join the finished stores of all shards of one configuration.

    The new store appears in `into` whole or, where the merge is killed, not at all.

    Args:
        folders: stores that `run --shard I/N` wrote, one for each I, in any order.
        into: a folder without a campaign; made where there is none.
        report: write `report.html` in the end.

    Returns:
        How the campaign ended, as without shards; the time to simulate is the sum over all runs.

    Raises:
        InputError: a folder holds no shard, or one that is not finished; configurations or versions differ;
            a run is there twice or not at all; there is a campaign in `into` already.
        StoreError: a store cannot be read or written.
    """
    into = Path(into)
    if Store.begun(into):
        raise InputError(f"--into must be a folder without a campaign, but there is one in {into}")
    parts = [_part(Path(folder)) for folder in folders]
    _check_same(parts)
    _check_whole(parts)
    with Store.read(parts[0].folder) as first:
        study = Study.from_store(first).with_store(into)
    _check_files(parts, study)
    into.mkdir(parents=True, exist_ok=True)
    with scratch_in(into, "merge") as folder:
        result = _run(study, parts, Path(folder))
        for name in (RESOLVED, DATABASE):  # the database last: with it the folder becomes a store
            move_atomically(Path(folder) / name, into / name)
    if report:
        rebuild_report(into)
    return result


def _part(folder: Path) -> _Part:
    """Read a shard.

    Raises:
        InputError: it is none, or not finished.
    """
    with Store.read(folder) as store:
        configuration, records, unfinished = store.configuration, store.history().records, store.unfinished()
        conclusion = store.conclusion
    if "shard" not in configuration:
        raise InputError(f"merge takes the stores of shards (run --shard I/N), but {folder} holds a whole campaign")
    shard = Shard(**configuration["shard"])
    if unfinished or conclusion is None:
        missing = f": runs {_listed([job.index for job in unfinished])} are missing" if unfinished else ""
        raise InputError(f"shards must be finished, but {shard} in {folder} is not{missing}; run it again to go on")
    return _Part(folder, shard, configuration, records, int(conclusion["conclusion"]["runs_of_the_campaign"]))


def _check_same(parts: Sequence[_Part]) -> None:
    """Refuse parts of different campaigns, or of one campaign cut or run differently."""
    first = parts[0]
    for part in parts[1:]:
        one, other = ({**p.configuration, "number of shards": p.shard.of} for p in (first, part))
        changed = sorted(key for key in {*one, *other} - _OWN if one.get(key) != other.get(key))
        if PACKAGE in changed:
            rule = "shards must have been run with the same state of this package and of SUMO"
            raise InputError(f"{rule}, but {first.folder} and {part.folder} were not")
        if changed:
            differing = "; ".join(f"{key}: {one.get(key)} there, {other.get(key)} here" for key in changed)
            raise InputError(f"shards must have one configuration, but {first.folder} and {part.folder} differ ({differing})")
    found = {record.versions: part.folder for part in parts for record in part.records}
    if len(found) > 1:
        differing = "; ".join(f"{versions} in {folder}" for versions, folder in found.items())
        raise InputError(f"shards must have been run with the same versions, but got {differing}")


def _check_files(parts: Sequence[_Part], study: Study) -> None:
    """Refuse a shard whose runs would not come again from code and files that were changed after it began.

    Not where they are absent, or code is not approved: merging needs none of it.
    """
    with study.loaded.scope.naming():
        try:
            study.spec.resolve()
        except SbtError:
            return
        for part in parts:
            if changed_since(part.folder, part.configuration):
                with Store.read(part.folder) as store, study.executor() as executor:
                    check_code(store, study, executor, changed=True, package=False)


def _check_whole(parts: Sequence[_Part]) -> None:
    """Refuse runs that are there twice or not at all."""
    owner: dict[int, _Part] = {}
    for part in parts:
        double = sorted(r.index for r in part.records if r.index in owner)
        if double:
            there = owner[double[0]].folder
            raise InputError(f"each run must be there once, but runs {_listed(double)} are in {there} and in {part.folder}")
        owner |= {record.index: part for record in part.records}
    missing = sorted(set(range(parts[0].total)) - set(owner))
    if missing:
        absent = sorted({index % parts[0].shard.of + 1 for index in missing})
        raise InputError(
            f"all {parts[0].total} runs must be there, but {_listed(missing)} are missing: "
            f"shards {_listed(absent)} of {parts[0].shard.of} were not given"
        )


def _listed(numbers: Sequence[int]) -> str:
    rest = f", ... ({len(numbers)} in all)" if len(numbers) > _TOLD else ""
    return ", ".join(map(str, numbers[:_TOLD])) + rest


def _run(study: Study, parts: Sequence[_Part], folder: Path) -> Summary:
    """Run the campaign in a folder of its own, with the shards' outcomes."""
    study = replace(study, live=not is_complete(study.kept["described"]))
    records = [record for part in parts for record in part.records]
    snapshot = study.snapshot() | {CONTENTS: parts[0].configuration.get(CONTENTS, {})}
    with Store.open(folder, snapshot, durable=False) as store:
        keep_configuration(store, study, snapshot)
        finished = run_stages(
            study.campaign, store, _Recalled({r.index: r for r in records}), seed=study.config.seed, budget=study.budget,
            requirement=study.scenario.requirement, versions=records[0].versions, listener=lambda _: None,
        )  # fmt: skip
        finished = replace(finished, seconds={**finished.seconds, "simulate": sum(record.seconds for record in records)})
        summary = summarise(store, study, finished)
        store.conclude(summary.to_dict())
    return summary


class _Recalled:
    """An executor that recalls the outcomes of runs that are done."""

    def __init__(self, records: Mapping[int, Record]):
        self._records = records

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def run(self, jobs: Sequence[Job]) -> Iterator[Outcome]:
        for job in jobs:
            r = self._records[job.index]
            if (r.inputs, r.seed) != (job.inputs, job.seed):
                raise InputError(
                    f"run {job.index} must be the one that the configuration plans, {dict(job.inputs)} with seed {job.seed}, "
                    f"but the shard has {dict(r.inputs)} with seed {r.seed}: it was made by another version"
                )
            yield Outcome(r.index, Status(r.status), r.metrics, r.reason, r.seconds, r.collisions, r.unconfirmed)

"""Pins found failures: writes a pytest file that guards concrete scenarios, and executes what it holds."""

from __future__ import annotations

import io
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from sbt.config.load import parse
from sbt.config.source import read_value, read_yaml, yaml_reader
from sbt.errors import InputError, RunError
from sbt.execution.worker import run_traced
from sbt.files import write_atomically
from sbt.plugins import OBJECT
from sbt.problem.outcome import Job, Status
from sbt.problem.plain import Json, JsonMapping, Value
from sbt.problem.trace import Trace
from sbt.store.database import Store
from sbt.store.history import History
from sbt.workflows.changes import told
from sbt.workflows.portable import place_of
from sbt.workflows.running import Replay, replay_run
from sbt.workflows.study import Study

__all__ = ["Pinned", "PinnedRun", "pin_runs", "uncritical"]

_OF_THE_SEARCH = (
    "seed", "budget", "initial", "batch", "acquisition", "metamodel", "validation", "stop", "gate", "judges", "store",
    "warm_start", "fidelity",
)  # fmt: skip
"""Keys of a campaign that say which runs are made, and not what a run does."""
_STATE = ("x", "y", "heading", "speed")


@dataclass(frozen=True)
class PinnedRun:
    """A pinned concrete scenario, as it went now.

    Attributes:
        start: x, y (m), heading (rad) and speed (m/s) of every road user at the first moment, to the last bit; empty where a
            scenario has no trace.
        metrics: by name.
        critical: the requirement is violated.
        metric: of the requirement, in words.
    """

    start: Mapping[str, tuple[float, ...]]
    metrics: Mapping[str, float]
    critical: bool
    metric: str


@dataclass(frozen=True)
class Pinned:
    """Concrete scenarios of a campaign, to be run again.

    Args:
        configuration: YAML of the campaign, as far as a run depends on it.
        folder: where its relative names start.
        ego: another AV under test, as in a configuration or as YAML; None or "": that of the campaign.
        warm_ups: number that the campaign's runs shared, where they began with warmed traffic; 0: as it is configured.
    """

    configuration: str
    folder: Path
    ego: JsonMapping | str | None = None
    warm_ups: int = 0
    _runs: dict[str, PinnedRun] = field(default_factory=dict, compare=False)

    def run(self, inputs: Mapping[str, Value], seed: int) -> PinnedRun:
        """Return the concrete scenario as it goes now; once for each.

        Raises:
            RunError: the run gives no metrics.
        """
        key = json.dumps([dict(inputs), seed])
        if key not in self._runs:
            self._runs[key] = self._executed(inputs, seed)
        return self._runs[key]

    @cached_property
    def _study(self) -> Study:
        given = read_value(self.ego, "ego") if isinstance(self.ego, str) and self.ego else self.ego
        changes: Json = {"ego": dict(given)} if given else {}
        folder = Path(self.folder).resolve()
        return Study(parse(self.configuration, name="the pinned configuration", folder=folder, changes=changes))

    def _executed(self, inputs: Mapping[str, Value], seed: int) -> PinnedRun:
        study = self._study
        with study.loaded.scope.naming():
            scenario = study.runnable
            spec = study.spec
            if self.warm_ups and spec.isolated is not None:
                spec = replace(spec, isolated=replace(spec.isolated, seeds=self.warm_ups))
            outcome, trace = run_traced(spec.resolve(), Job(0, dict(inputs), seed))
        if outcome.status != Status.OK:
            raise RunError(outcome.status, f"a pinned run must give metrics, but it ended as {outcome.status}: {outcome.reason}")
        need = scenario.requirement
        told = f"{need.told_as} = {need.told_of(outcome.metrics)!r}"
        return PinnedRun(_start(trace), dict(outcome.metrics), need.is_critical(outcome.metrics), told)


def pin_runs(folder: Path, runs: Sequence[str], into: Path) -> Path:
    """Write a pytest file for stored runs, and return its path; every run is executed first, from what the file holds.

    Args:
        folder: of the store.
        runs: indices, or `mode:1` for the representative of the first failure mode.
        into: folder of the tests, made where there is none.

    Raises:
        InputError: there is no such run, it is a coarse one, it does not replay bit by bit, its code is not approved, or it was
            defined in a notebook.
    """
    with Store.read(folder) as store:
        kept, conclusion = dict(store.configuration), (store.conclusion or {}).get("conclusion", {})
        if OBJECT in json.dumps(kept.get("yaml", "")):
            raise InputError("a pinned test must find the scenario in files, but this campaign took it from Python objects")
        study, (place, text) = Study.from_store(store), place_of(kept, store.folder)
        indices = list(dict.fromkeys(_index(run, conclusion) for run in runs))
        _check_levels(indices, store.history(level=None))
    replays = [replay_run(folder, index, execute=True) for index in indices]
    for again in replays:
        _check(again)
    into.mkdir(parents=True, exist_ok=True)
    configuration, place = _configuration(text), place if _names_files(study) else into
    warm_ups = int((kept.get("isolation") or {}).get("seeds", 0))
    pinned, pins = Pinned(configuration, place, warm_ups=warm_ups), []
    for again in replays:
        record = again.record
        found = pinned.run(record.inputs, record.seed)
        if dict(found.metrics) != dict(record.metrics):
            rule = f"a pinned run must come out of its test as it is stored, but run {record.index} gives {dict(found.metrics)}"
            raise InputError(f"{rule}, not {dict(record.metrics)}")
        pins.append({
            "run": record.index, "inputs": dict(record.inputs), "seed": record.seed, "critical": found.critical,
            "start": {name: list(state) for name, state in found.start.items()}, "metrics": dict(record.metrics),
        })  # fmt: skip
    infinite = "from math import inf\n" if "inf" in _written([pin["metrics"] for pin in pins]) else ""
    title = re.sub(r"\W+", "_", f"{study.scenario.name}_{folder.resolve().name}").strip("_").lower()
    page = files("sbt.workflows").joinpath("pinned_test.txt").read_text(encoding="utf-8")
    values = {
        "@SCENARIO@": study.scenario.name, "@STORE@": folder.name, "@PLACE@": repr(os.path.relpath(place, into.resolve())),
        "@CONFIGURATION@": configuration.replace("\\", "\\\\").replace('"""', '\\"\\"\\"'), "@PINS@": _written(pins),
        "@INF@": infinite, "@WARM_UPS@": f", warm_ups={warm_ups}" if warm_ups else "",
    }  # fmt: skip
    for key, value in values.items():
        page = page.replace(key, value)
    path = into / f"test_pinned_{title}_{_runs([again.record.index for again in replays])}.py"
    if path.is_file() and path.read_text(encoding="utf-8") != page:
        raise InputError(f"a pin replaces no other one, but {path} is there and differs; remove it, or choose another folder")
    return write_atomically(path, page)


def uncritical(folder: Path, runs: Sequence[str]) -> list[int]:
    """Return the indices, of runs given as to `pin_runs`, of those that violate nothing: there is no failure to guard."""
    with Store.read(folder) as store:
        study, history, conclusion = Study.from_store(store), store.history(), (store.conclusion or {}).get("conclusion", {})
    wanted = np.isin(history.index, [_index(run, conclusion) for run in runs])
    return [int(k) for k in history.index[wanted & history.ok & ~study.scenario.requirement.critical_runs(history)]]


def _runs(runs: Sequence[int]) -> str:
    """Return runs as a part of a file's name, many of them by their ends and number."""
    return "_".join(map(str, runs)) if len(runs) <= 5 else f"{runs[0]}_to_{runs[-1]}_{len(runs)}_runs"


def _index(run: str, conclusion: JsonMapping) -> int:
    """Return the index of a run given as a number, or as mode:K."""
    kind, _, number = run.rpartition(":")
    if kind in ("", "mode") and number.isascii() and number.isdigit():
        if not kind:
            return int(number)
        modes = conclusion.get("failure_modes") or ()
        if 1 <= int(number) <= len(modes):
            return int(modes[int(number) - 1]["representative"])
        raise InputError(f"RUN mode:K needs a failure mode of the campaign's conclusion (it has {len(modes)}), but got '{run}'")
    raise InputError(f"RUN must be the index of a run, or mode:1 for the first failure mode, but got '{run}'")


def _check_levels(indices: Sequence[int], history: History) -> None:
    """Refuse coarse runs: a test executes the scenario itself, and a coarse run says nothing of whether it fails."""
    level = history.columns["level"]
    for row in np.flatnonzero(np.isin(history.index, indices) & (level > 0))[:1]:
        rule = f"a pinned run must be one of the scenario itself, but run {history.index[row]} is a coarse one"
        raise InputError(f"{rule} (level {level[row]} of fidelity), which counts as no failure")


def _check(again: Replay) -> None:
    record = again.record
    if record.status != Status.OK or not again.as_stored:
        now = f"{again.differing or again.outcome.status} {again.outcome.reason}".strip()
        rule = f"a pinned run must give metrics, and the stored ones, but run {record.index} gives {now}"
        raise InputError(f"{rule}{told(again.changed)}")


def _names_files(study: Study) -> bool:
    """Say whether a run may read files that the configuration names."""
    config = study.config
    return study.own_code or bool(config.metrics or config.inputs) or config.scenario.startswith("table:")


def _configuration(text: str) -> str:
    """Return the YAML of a campaign without what only the search reads, and without keys that say nothing."""
    data = {key: value for key, value in read_yaml(text, "the stored configuration")[0].items() if key not in _OF_THE_SEARCH}
    executor = {"kind": "serial", "isolation": (data.get("executor") or {}).get("isolation", "auto")}
    whole = {key: _said(value) for key, value in {**data, "executor": executor}.items()}
    stream = io.StringIO()
    yaml_reader().dump({key: value for key, value in whole.items() if value not in (None, {}, [])}, stream)
    return stream.getvalue().strip()


def _said(value: Any) -> Any:
    """Return None in place of a mapping that says nothing."""
    return None if isinstance(value, Mapping) and all(item is None for item in value.values()) else value


def _start(trace: Trace | None) -> dict[str, tuple[float, ...]]:
    """Return the realised start of every road user that is there."""
    if trace is None or len(trace.time) == 0:
        return {}
    there = np.flatnonzero(trace.present[0])
    return {trace.actors[k]: tuple(float(getattr(trace, name)[0, k]) for name in _STATE) for k in there}


def _written(pins: Sequence[Any]) -> str:
    """Return the pins as Python; floats to the last bit."""
    from pprint import pformat

    return pformat(pins, width=120, sort_dicts=False)

"""Two egos on the same draws: did the probability of a critical run fall, what was fixed, what is new.

Both configurations run as crude Monte Carlo with one seed: draws of the inputs and seeds of the runs are
the same (common random numbers), so that only the runs with different verdicts tell the egos apart.

Where critical runs are rare, pairs tell nothing. Then each ego has an estimation of its own, and the second learns from the
first: its metamodel is a trend. No run of the first is counted for the second, so that the errors are independent. The second
has the first one's estimate as its gate: a new ego is looked at for what the old one did not do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sbt.campaigns.clustering import clustered_interval, likelier
from sbt.campaigns.counting import random_draws
from sbt.campaigns.gate import CONDITION
from sbt.campaigns.wording import number, requirement_words
from sbt.config.load import load
from sbt.errors import InputError, command_of
from sbt.loop.stages import Progress
from sbt.problem.arrays import Mask, Vector
from sbt.problem.plain import Json, unit_of
from sbt.report.versus import Question, write_versus
from sbt.store.database import DATABASE, Store
from sbt.store.history import History
from sbt.workflows.filming import film_runs
from sbt.workflows.running import Summary, run_study
from sbt.workflows.study import Study

__all__ = ["Pairs", "compare_egos", "compare_rare"]

_CONFIDENCE = 0.95
_FILMED = 6
"""Films are made of so many fixed and so many new failures ..."""
_SECONDS = 20.0
"""... whose runs took at most so long together when they were recorded (s)."""
_BATCH = 200
"""Runs of a batch of pairs."""
_NEAR = 1e-9
"""What is left above a gate, at least."""
_PRECISE = 0.1
"""Coefficient of variation with which the estimations of rare critical runs end."""


@dataclass(frozen=True, eq=False)
class Pairs:
    """Verdicts of n pairs of runs, (n,) each; a failed run has none.

    Args:
        before, after: critical with the first and with the second ego.
        failed_before, failed_after: the run failed.
        warm_up: (n,) that both runs began with; None, or negative: traffic was not warmed up.
    """

    before: Mask
    after: Mask
    failed_before: Mask
    failed_after: Mask
    warm_up: Vector | None = None

    @property
    def fixed(self) -> Mask:
        """(n,) critical before, safe after."""
        return self.before & ~self.after & ~self.failed_after

    @property
    def new(self) -> Mask:
        """(n,) safe before, critical after."""
        return self.after & ~self.before & ~self.failed_before

    def verdict(self, confidence: float = _CONFIDENCE) -> str:
        """Return `rose`, `fell` or `undecided`: the exact test on the pairs that differ, a failed run as whatever denies it."""
        tail = 0.5 * (1.0 + confidence)
        if likelier(self.new, self._perhaps_fixed, self.warm_up, tail):
            return "rose"
        return "fell" if likelier(self.fixed, self._perhaps_new, self.warm_up, tail) else "undecided"

    def difference(self, confidence: float = _CONFIDENCE) -> tuple[float, float]:
        """Return an interval of P(critical) after minus before that holds at least with this confidence.

        Exact binomial limits of the shares of new and of fixed failures, each with half of the error
        (Bonferroni), those of fewer pairs where they share warm-ups; a failed run counts as whatever is worse for the end in
        question. It ends at 0 where the verdict excludes what lies beyond, which keeps its confidence (by enumeration of the
        counts: an end misses in at most 1.9 % where .025 is allowed), and holds 0 where that is undecided.
        """
        each, verdict = 0.5 * (1.0 + confidence), self.verdict(confidence)
        new, fixed = (clustered_interval(hits, self.warm_up, each)[0] for hits in (self.new, self.fixed))
        most_new, most_fixed = (
            clustered_interval(hits, self.warm_up, each)[1] for hits in (self._perhaps_new, self._perhaps_fixed)
        )
        low, high = new - most_fixed, most_new - fixed
        return max(low, 0.0) if verdict == "rose" else min(low, 0.0), min(high, 0.0) if verdict == "fell" else max(high, 0.0)

    @property
    def _perhaps_new(self) -> Mask:
        return (self.after | self.failed_after) & (~self.before | self.failed_before)

    @property
    def _perhaps_fixed(self) -> Mask:
        return (self.before | self.failed_before) & (~self.after | self.failed_after)

    def share(self, *, after: bool, confidence: float = _CONFIDENCE) -> Json:
        """Return the critical share with one of the egos and its interval, failed runs as safe below and as critical above."""
        critical, failed = (self.after, self.failed_after) if after else (self.before, self.failed_before)
        low, high = (
            clustered_interval(hits, self.warm_up, confidence)[side] for side, hits in enumerate((critical, critical | failed))
        )
        value = float(critical.mean()) if len(critical) else 0.0
        return {"probability": value, "low": low, "high": high, "critical": int(critical.sum()), "failed": int(failed.sum())}


def compare_egos(
    first: Path, second: Path, *, store: Path, runs: int | None = None, progress: Callable[[Progress], None] | None = None
) -> Json:
    """Run both configurations on the same draws, or go on where the stores stopped, and compare them.

    Args:
        first: configuration with the ego before.
        second: configuration with the ego after; same scenario, inputs and requirement.
        store: folder; the campaigns are its subfolders a and b.
        runs: pairs; None: the budget of the first.
        progress: called after every run.

    Returns:
        Probabilities with intervals, their difference with its interval, a verdict (`fell`, `rose`,
        `undecided`), the runs that were fixed and that are new, with inputs, seed and metrics before and after, and the path of a
        page with their films.

    Raises:
        InputError: the configurations ask for different inputs, distributions or requirements.
    """
    config = load(first).config
    budget = config.budget if runs is None else runs
    size = _first_batch(store / "a", budget)
    common = {
        "campaign": "estimation", "acquisition": {"kind": "monte_carlo"}, "metamodel": {"kind": "gp"}, "stop": {"cov": None},
        "gate": None, "warm_start": None, "seed": config.seed, "budget": budget, "initial": size, "batch": size,
    }  # fmt: skip
    one, other = (_study(path, store / name, common) for path, name in ((first, "a"), (second, "b")))
    _check(one, other, (first, second))
    for study in (one, other):
        run_study(study, progress=progress, report=False)
    histories = [_history(store / name) for name in ("a", "b")]
    result = _result(histories[0], histories[1], one.scenario.requirement)
    return {**result, "page": str(_page(store, (one, other), histories, result, (first, second)))}


def _first_batch(folder: Path, budget: int) -> int:
    """Return the number of runs in each batch: that of the campaign which goes on, since the draws depend on it."""
    if (folder / DATABASE).is_file():
        with Store.read(folder) as kept:
            return min(int(kept.configuration.get("initial", _BATCH)), budget)
    return min(budget, _BATCH)


def _page(store: Path, studies: Sequence[Study], histories: Sequence[History], result: Json, paths: tuple[Path, Path]) -> Path:
    """Write the page of a comparison, with the films of some pairs, and return its path."""
    scenario, kinds = studies[0].scenario, {f["run"]: kind for kind in ("fixed", "new") for f in result[kind][:_FILMED]}
    rows = {int(index): row for row, index in enumerate(histories[0].index)}
    took = {run: sum(float(h.seconds[rows[run]]) for h in histories) for run in kinds}
    within = np.cumsum([took[run] for run in kinds]) <= _SECONDS
    chosen = [run for run, short in zip(kinds, within, strict=True) if short]
    films, notes = [], []
    for study, history in zip(studies, histories, strict=True):
        said = {run: _said(study, history, rows[run]) for run in chosen}
        found, note = film_runs(study, history, said)
        films.append({film.run: film for film in found})
        notes.append(note)
    both = [(kinds[run], films[0][run], films[1][run]) for run in chosen if run in films[0] and run in films[1]]
    commands = "\n".join(command_of("sumo-sbt", "replay", store / name) + " RUN --gif RUN.gif" for name in ("a", "b"))
    title = f"{scenario.name}: {paths[0].stem} and {paths[1].stem} on the same draws"
    units, note = {p.name: p.unit for p in scenario.space.parameters}, " ".join(dict.fromkeys(filter(None, notes)))
    question = _question(studies, paths)
    return write_versus(store, title, result, both, question=question, units=units, commands=commands, note=note)


def _question(studies: Sequence[Study], paths: tuple[Path, Path]) -> Question:
    """Return what is compared: when a run is critical, and the egos as they are configured."""
    scenario = studies[0].scenario
    requirement, meanings = scenario.requirement, {m.name: m.description for m in scenario.metrics if m.description}
    units = {part.metric: unit_of(scenario.units, part.metric) for part in requirement.parts}
    words = requirement_words(requirement, units[requirement.parts[0].metric], units)
    told = "; ".join(f"{name}: {meanings[name].removesuffix('.')}" for name in units if name in meanings)
    before, after = ((path.name, _ego(study)) for path, study in zip(paths, studies, strict=True))
    return Question(f"{words} ({told})" if told else words, units, before, after)


def _ego(study: Study) -> str:
    """Return the ego in the words of its configuration."""
    ego = study.config.ego
    if ego is None:
        return f"that of the scenario {study.config.scenario}"
    settings = ", ".join(f"{name}: {value}" for name, value in ego.settings.items())
    return f"{ego.kind}, {settings}" if settings else f"{ego.kind} with its default settings"


def _said(study: Study, history: History, row: int) -> str:
    """Return the verdict of a run and its metrics in words."""
    requirement, units = study.scenario.requirement, {m.name: m.unit for m in study.scenario.metrics}
    verdict = "critical" if requirement.critical_runs(history)[row] else "not critical"
    metrics = dict.fromkeys(part.metric for part in requirement.parts)
    return ", ".join([verdict, *(f"{m} {number(float(history.y(m)[row]), 3)} {units.get(m, '')}".strip() for m in metrics)])


def compare_rare(
    first: Path, second: Path, *, store: Path, runs: int | None = None, progress: Callable[[Progress], None] | None = None
) -> Json:
    """Estimate the probability with each ego, the second by transfer from the first, and compare them.

    Args:
        first: configuration with the ego before.
        second: configuration with the ego after; same scenario, inputs and requirement.
        store: folder; the campaigns are its subfolders a and b.
        progress: called after every run.
        runs: of each estimation at most; None: the budget of the first. They end at a coefficient of variation of 10 %.

    Returns:
        Probabilities with intervals, runs, whether each is as precise, their difference with its interval, a verdict (`fell`,
        `rose`, `undecided`), and in words on what condition it holds (`condition`; None: on none) or why it is open (`open`).

    Raises:
        InputError: as `compare_egos` does.

    Source:
        Zou and Donner (2008), doi 10.1002/sim.3095: the interval of a difference from those of independent estimates.
    """
    config = load(first).config
    budget = config.budget if runs is None else runs
    common = {
        "campaign": "estimation", "acquisition": {"kind": "auto"}, "gate": None, "warm_start": None, "seed": config.seed,
        "budget": budget, "stop": {"cov": _PRECISE},
    }  # fmt: skip
    one, other = (_study(path, store / name, common) for path, name in ((first, "a"), (second, "b")))
    _check(one, other, (first, second))
    before = _estimated(run_study(one, progress=progress, report=False), store / "a")
    warm = {"warm_start": {"store": str(store / "a"), "transfer": True}, "gate": _sought(before, store / "b")}
    other = _study(second, store / "b", common | warm)
    after = _estimated(run_study(other, progress=progress, report=False), store / "b")
    p, q = before["probability"], after["probability"]
    if p is None or q is None:
        low, high = after["low"] - before["high"], after["high"] - before["low"]
    else:
        low = q - p - float(np.hypot(q - after["low"], before["high"] - p))
        high = q - p + float(np.hypot(after["high"] - q, p - before["low"]))
    told = {"confidence": _CONFIDENCE, "before": before, "after": after, "difference": None if p is None or q is None else q - p}
    return {**told, "low": low, "high": high, **_rare_verdict(before, after, low, high)}


def _sought(before: Json, folder: Path) -> Json | None:
    """Return the gate of the second ego, the estimate of the first: with one there is an even start and a search.

    Where it would pass, draws go on until what none has met is within it, too. A campaign that goes on keeps its own gate, as
    what is run next depends on it.
    """
    if (folder / DATABASE).is_file():
        with Store.read(folder) as kept:
            gate = kept.configuration.get("gate")
            return None if gate is None else dict(gate)
    p = before["probability"] or before["high"]
    return {"probability": min(p, 1.0 - _NEAR), "confidence": 0.5 * (1.0 + _CONFIDENCE)} if p > 0.0 else None


def _rare_verdict(before: Json, after: Json, low: float, high: float) -> Json:
    """Return the verdict on two estimations, and its condition: that neither search has left out what would undo it."""
    verdict, gate = _verdict(low, high), after["gate"]
    doubted = gate is not None and gate["verdict"] == "undecided" and gate["upper"] <= gate["probability"]  # what draws deny
    if verdict == "fell" and doubted:
        return {"verdict": "undecided", "condition": None, "open": f"of the second: {gate['statement']}"}
    undoing = {"fell": (after["unmet"], -high, "second"), "rose": (before["unmet"], low, "first")}
    unmet, least, which = undoing.get(verdict, (0.0, np.inf, ""))
    if unmet < least:
        return {"verdict": verdict, "condition": None, "open": None}
    region = f"a critical region that no run of the {which} has met, or failures that few seeds show,"
    return {"verdict": verdict, "condition": f"{CONDITION}; {region} could hold up to {unmet:.2g}", "open": None}


def _study(path: Path, store: Path, changes: Mapping[str, Any]) -> Study:
    return Study.from_file(path, changes={**changes, "store": str(store)})


def _check(one: Study, other: Study, paths: tuple[Path, Path]) -> None:
    """Refuse to compare answers to different questions."""
    if one.scenario.space != other.scenario.space:
        raise InputError(f"compare-ego needs the same inputs and distributions, but {paths[0]} and {paths[1]} differ in them")
    if one.scenario.requirement != other.scenario.requirement:
        found = f"{one.scenario.requirement} in {paths[0]}, {other.scenario.requirement} in {paths[1]}"
        raise InputError(f"compare-ego needs one requirement, but got {found}")
    for part in one.scenario.requirement.parts:
        units = [unit_of(study.scenario.units, part.metric) or "no unit" for study in (one, other)]
        if units[0] != units[1]:
            there = f"in {units[0]} in {paths[0]}, in {units[1]} in {paths[1]}"
            raise InputError(f"compare-ego needs one requirement, but {part.metric} is {there}")


def _estimated(summary: Summary, folder: Path) -> Json:
    """Return what an estimation found."""
    found, history = summary.to_dict()["conclusion"], _history(folder)
    kept = {key: found[key] for key in ("probability", "low", "high", "undetected_mass_bound")}
    traffic = found.get("warmed_traffic")
    warmed = {} if traffic is None else {"warm_ups": traffic["warm_ups"]}
    precise = found["cov"] is not None and found["cov"] <= _PRECISE
    failed, drawn = int((~history.ok).sum()), random_draws(history)
    every = found.get("combinations") is not None or found["counted"] == drawn > 0  # limits have what no run has met
    rest = {"unmet": 0.0 if every else kept["undetected_mass_bound"], "gate": found.get("gate")}
    return {**kept, **warmed, "precise": precise, "runs": len(history), "critical": found["hits"], "failed": failed, **rest}


def _verdict(low: float, high: float) -> str:
    return "fell" if high < 0 else "rose" if low > 0 else "undecided"


def _history(folder: Path) -> History:
    with Store.read(folder) as store:
        return store.history()


def _result(first: History, second: History, requirement: Any) -> Json:
    """Return the comparison of two histories of the same draws."""
    same = np.array_equal(first.x, second.x) and np.array_equal(first.seed, second.seed)
    if not same:
        raise InputError("compare-ego needs the same draws in both stores, but they differ: give another --store")
    critical = [requirement.critical_runs(h) for h in (first, second)]
    pairs = Pairs(critical[0], critical[1], ~first.ok, ~second.ok, first.columns["warm_up"])
    metrics = tuple(dict.fromkeys(part.metric for part in requirement.parts))
    low, high = pairs.difference()
    before, after = (pairs.share(after=later) for later in (False, True))
    warm_up = first.columns["warm_up"]
    warmed = {"warm_ups": len(np.unique(warm_up))} if len(first) and (warm_up >= 0).all() else {}
    return {
        "pairs": len(first), "confidence": _CONFIDENCE, **warmed, "before": before, "after": after,
        "difference": after["probability"] - before["probability"], "low": low, "high": high,
        "verdict": pairs.verdict(),
        "fixed": _listed(first, second, pairs.fixed, metrics), "new": _listed(first, second, pairs.new, metrics),
        "still": int((pairs.before & pairs.after).sum()),
    }  # fmt: skip


def _listed(first: History, second: History, mask: Mask, metrics: Sequence[str]) -> list[Json]:
    """Return the pairs of runs where the mask holds: inputs, seed, and these metrics with each ego."""
    found = []
    for k in map(int, np.flatnonzero(mask)):
        run, (before, after) = first.record(k), ({m: float(h.y(m)[k]) for m in metrics} for h in (first, second))
        found.append({"run": run.index, "inputs": dict(run.inputs), "seed": run.seed, "before": before, "after": after})
    return found

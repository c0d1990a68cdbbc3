"""Boundary identification on problems of known truth, recorded rows and SUMO: which rule finds it with few runs?

    python benchmarks/boundary_table.py [--problems a,b] [--methods mix,boundary,even] [--seeds 20] [--store FOLDER]
    python benchmarks/boundary_table.py --methods mix --metamodels "gp,auto quick" --first-seed 300 --seeds 6

A cell is a campaign of one problem, method, metamodel and seed with the product's defaults (10 % of the runs are held
out while it goes on, and count), whose final metamodel, of all runs, is scored on points that no campaign saw:

- a testbed: 9,000 points out of 600,000 uniform ones, from three strata (critical; the 4 % of the others whose
  metric is nearest to critical; the rest), weighted so that the scores estimate those of uniform points. 20,000
  uniform points hold 50 critical ones on hartmann6_1e-3: too few to tell an F1 of .73 from one of .78;
- `table`: 600 of the 2,000 recorded rows, set apart at random by the seed before the campaign chooses among the
  others. (The rows that a campaign left are no fair sample: a good one has taken the critical ones.);
- SUMO: `--reference` pseudo-random runs, kept in the folder.

Finished cells are lines of FOLDER/cells.jsonl: stopped and started again it goes on.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import sbt
from sbt import testbeds
from sbt.execution.local import LocalExecutor
from sbt.execution.spec import ScenarioSpec
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.outcome import Job
from sbt.problem.scenario import LogicalScenario
from sbt.seeds import run_seed, stream

TABLE = Path(__file__).parents[2] / "shared" / "data" / "dsiod_jaywalking"
APART = 600  # rows
BUDGETS = {
    "testbed:cut_in_crash:box": 100, "testbed:borehole_1e-3:box": 60, "testbed:pedestrian:box": 200,
    "testbed:cut_in_near_miss:box": 200, "testbed:hartmann6_1e-3:box": 200, "testbed:wavy_level_d3:box": 60,
    "table": 400, "cut_in": 100, "emergency_braking": 200, "jaywalking": 200,
}  # fmt: skip
GP = {"kind": "gp", "nu": 2.5, "input_noise": False}
"""The process that `auto` falls back on at the critical edge."""
SHOWN = ("precision_at_recall_90", "f1", "average_precision", "calibration_error")
Test = tuple[Points, Mask, Vector]
"""x (n, d), whether each point is critical, and its weight."""


TABLE_REQUIREMENT = sbt.Requirement("min_dist*", -1e9, 0.0)


def run(problem: str, method: str, seed: int, folder: Path, metamodel: str) -> sbt.Result:
    kind, _, preset = metamodel.partition(" ")
    keys: dict[str, Any] = {"requirement": TABLE_REQUIREMENT} if problem == "table" else {}
    return sbt.run(
        campaign="coverage" if method == "even" else "boundary", seed=seed,
        scenario=f"table:{folder / 'table'}" if problem == "table" else problem, budget=BUDGETS[problem],
        metamodel=GP if metamodel == "gp" else {"kind": kind, "preset": preset or None},
        acquisition=method, store=folder / "store", executor="serial", report=False, **keys,
    )  # fmt: skip


def set_apart(folder: Path, seed: int) -> Test:
    """Write the recorded rows but 600 to folder/table, and return these 600."""
    recorded, need = ScenarioSpec(f"table:{TABLE}").resolve(), TABLE_REQUIREMENT
    rows = pd.read_parquet(next(TABLE.glob("*.parquet")))
    apart = stream(seed, "apart").permutation(len(rows))[:APART]
    (folder / "table").mkdir()
    rows.drop(index=rows.index[apart]).to_parquet(folder / "table" / "rows.parquet")
    shutil.copy(TABLE / "config.yml", folder / "table")
    chosen = rows.iloc[apart]
    critical = chosen[need.metric].between(need.low, need.high).to_numpy()
    return chosen[list(recorded.space.names)].to_numpy(np.float64), critical, np.ones(APART)


def test_points(problem: str, scenario: LogicalScenario, folder: Path, n: int) -> Test:
    """Return the points of a testbed or of SUMO that score, kept in the folder."""
    kept = folder / f"test_{problem.replace(':', '_')}.npz"
    if not kept.is_file():
        x, critical, weight = (strata if problem.startswith("testbed:") else simulated)(problem, scenario, n)
        np.savez(kept, x=x, critical=critical, weight=weight)
    with np.load(kept) as data:
        return data["x"], data["critical"], data["weight"]


def strata(problem: str, scenario: LogicalScenario, n: int) -> Test:
    del n
    space, interval = scenario.space, scenario.requirement.critical
    rng = stream(99, "strata")
    x = space.from_unit(rng.random((600_000, space.dimension)))
    y = testbeds.values(problem.removeprefix("testbed:"), x, rng)
    critical, margin = interval.contains(y), interval.margin(y)
    near = ~critical & (margin <= np.quantile(margin[~critical], 0.04))
    picks, weights = [], []
    for stratum, most in ((critical, 1500), (near, 3500), (~critical & ~near, 4000)):
        rows = np.flatnonzero(stratum)
        picks.append(rng.choice(rows, min(most, len(rows)), replace=False))
        weights.append(np.full(len(picks[-1]), len(rows) / len(picks[-1])))
    chosen = np.concatenate(picks)
    return x[chosen], critical[chosen], np.concatenate(weights)


def simulated(problem: str, scenario: LogicalScenario, n: int) -> Test:
    space, requirement = scenario.space, scenario.requirement
    x = space.from_unit(stream(99, "reference").random((n, space.dimension)))
    jobs = [Job(i, dict(zip(space.names, map(float, row), strict=True)), run_seed(99, i)) for i, row in enumerate(x)]
    y = np.full(n, np.nan)
    with LocalExecutor(ScenarioSpec(problem), os.cpu_count() or 1, 60.0) as executor:
        for outcome in executor.run(jobs):
            y[outcome.index] = outcome.metrics.get(requirement.metric, np.nan)
    good = np.isfinite(y)
    return x[good], requirement.critical.contains(y[good]), np.ones(int(good.sum()))


def weighted_scores(p: Vector, critical: Mask, weight: Vector) -> dict[str, float]:
    """Return the yardsticks of `sbt.metamodels.scores` over weighted points: ranking, classification, calibration."""
    order = np.argsort(-p, kind="stable")
    p, critical, weight = p[order], critical[order], weight[order]
    found, false = np.cumsum(weight * critical), np.cumsum(weight * ~critical)
    last = np.append(p[1:] < p[:-1], True)  # thresholds do not separate ties
    recall, precision = found[last] / found[-1], (found / (found + false))[last]
    sure = p >= 0.5
    hits, wrong = weight[sure & critical].sum(), weight[sure & ~critical].sum()
    width = np.bincount(np.minimum((p * 15).astype(int), 14), weights=weight * (p - critical), minlength=15)
    return {
        "precision_at_recall_90": float(precision[recall >= 0.9].max()), "f1": float(2 * hits / (hits + wrong + found[-1])),
        "average_precision": float(np.diff(recall, prepend=0.0) @ precision),
        "calibration_error": float(np.abs(width).sum() / weight.sum()), "base_rate": float(found[-1] / weight.sum()),
    }  # fmt: skip


def cell(problem: str, method: str, metamodel: str, seed: int, folder: Path, n: int) -> dict[str, Any]:
    """Return the scores of one campaign."""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        apart = set_apart(place, seed) if problem == "table" else None
        start = time.process_time()
        result = run(problem, method, seed, place, metamodel)
        seconds = time.process_time() - start
        scenario, learner, runs = result.scenario, result.study.learner, result.history.finished
        predict = learner.on_inputs(learner.train(runs), len(runs))
    space, interval = scenario.space, scenario.requirement.critical
    x, critical, weight = test_points(problem, scenario, folder, n) if apart is None else apart
    p = predict(space.to_unit(x)).probability(interval)
    return {**weighted_scores(p, critical, weight), "cpu_s": seconds}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", default=",".join(BUDGETS))
    parser.add_argument("--methods", default="mix,boundary,even")
    parser.add_argument("--metamodels", default="auto quick", help="kinds, each with its preset after a space")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--reference", type=int, default=5_000)
    parser.add_argument("--store", type=Path, default=Path("runs/boundary_table"))
    args = parser.parse_args()
    if unknown := set(args.problems.split(",")) - set(BUDGETS):
        parser.error(f"--problems: {', '.join(sorted(unknown))} is none of {', '.join(BUDGETS)}")
    args.store.mkdir(parents=True, exist_ok=True)
    kept = args.store / "cells.jsonl"
    done = {}
    if kept.is_file():
        done = {tuple(row["cell"]): row for row in map(json.loads, kept.read_text().splitlines())}
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    kinds = [(p, m, k) for p in args.problems.split(",") for m in args.methods.split(",") for k in args.metamodels.split(",")]
    for problem, method, metamodel, seed in [(*kind, seed) for kind in kinds for seed in seeds]:
        key = (problem, method, metamodel, seed)
        if key not in done:
            row = {"cell": key, **cell(problem, method, metamodel, seed, args.store, args.reference)}
            with kept.open("a") as file:
                file.write(json.dumps(row) + "\n")
            done[key] = row
    print("| problem | runs | base rate | rule | metamodel | P@90R: median (10 to 90 %) | F1 | AP | calibration error | CPU s |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for problem, method, metamodel in kinds:
        rows, cells = [done[problem, method, metamodel, s] for s in seeds], []
        for name in SHOWN:
            low, middle, high = np.quantile([row[name] for row in rows], [0.1, 0.5, 0.9])
            cells.append(f"{middle:.3f} ({low:.3f} to {high:.3f})" if name in SHOWN[:2] else f"{middle:.3f}")
        base, cpu = (np.median([row[k] for row in rows]) for k in ("base_rate", "cpu_s"))
        print(f"| {problem} | {BUDGETS[problem]} | {base:.4f} | {method} | {metamodel} | {' | '.join(cells)} | {cpu:.1f} |")


if __name__ == "__main__":
    main()

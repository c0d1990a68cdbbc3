"""Boundary identification on problems of known truth, recorded rows and SUMO: which rule finds it with few runs?

    python benchmarks/boundary_table.py [--problems a,b] [--methods mix,boundary,even] [--seeds 20] [--store FOLDER]
    python benchmarks/boundary_table.py --methods mix --metamodels "gp,auto,auto quick" --first-seed 100 --seeds 8

A cell is a campaign of one problem, method, metamodel and seed with the product's defaults (10 % of the runs are held out
while it goes on, and count), whose final metamodel, of all runs, is scored on a reference set that no campaign
saw: 20,000 uniform points of a testbed, 20,000 pseudo-random SUMO runs, or the rows of the table that were not
chosen. Finished cells are lines of FOLDER/cells.jsonl: stopped and started again it goes on; reference sets are kept there too.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from sbt import testbeds
from sbt.config.load import parse
from sbt.execution.local import LocalExecutor
from sbt.learner import chunked
from sbt.metamodels.scores import scores
from sbt.problem.outcome import Job
from sbt.run import assembly_of, run_campaign, settings_of
from sbt.seeds import run_seed, stream
from sbt.store import Store

TABLE = Path(__file__).parents[2] / "shared" / "data" / "dsiod_jaywalking"
BUDGETS = {
    "testbed:cut_in_crash:box": 100, "testbed:borehole_1e-3:box": 60, "testbed:pedestrian:box": 200,
    "testbed:cut_in_near_miss:box": 200, "testbed:hartmann6_1e-3:box": 200, "testbed:wavy_level_d3:box": 60,
    "table": 400, "cut_in": 100, "emergency_braking": 200, "jaywalking": 200,
}  # fmt: skip
SHOWN = ("precision_at_recall_90", "f1", "average_precision", "calibration_error")


def configuration(problem: str, method: str, seed: int, folder: str, metamodel: str = "gp") -> str:
    campaign = "coverage" if method == "even" else "boundary"
    kind, _, preset = metamodel.partition(" ")
    scenario = f"table:{TABLE}" if problem == "table" else problem
    lines = [
        f"campaign: {campaign}", f"scenario: '{scenario}'", f"seed: {seed}", f"budget: {BUDGETS[problem]}",
        f"metamodel: {{kind: {kind}, preset: {preset or 'null'}}}", f"acquisition: {{kind: {method}}}", f"store: {folder}",
    ]  # fmt: skip
    if problem == "table":
        lines.append('requirement: {metric: "min_dist*", critical: [-1.0e9, 0.0]}')
    return "\n".join(lines)


def reference(problem: str, settings: Any, folder: Path, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return x (n, d) and y (n,) of pseudo-random runs, kept in the folder."""
    kept, space = folder / f"reference_{problem.replace(':', '_')}.npz", settings.scenario.space
    if kept.is_file():
        with np.load(kept) as data:
            return data["x"], data["y"]
    x = space.from_unit(stream(99, "reference").random((n, space.dimension)))
    if problem.startswith("testbed:"):
        y = testbeds.values(problem.removeprefix("testbed:"), x, stream(99, "noise"))
    else:
        parts = assembly_of(parse(configuration(problem, "even", 0, "unused")))
        jobs = [Job(i, dict(zip(space.names, map(float, row), strict=True)), run_seed(99, i)) for i, row in enumerate(x)]
        y = np.full(n, np.nan)
        with LocalExecutor(parts.spec, os.cpu_count() or 1, 60.0) as executor:
            for outcome in executor.run(jobs):
                y[outcome.index] = outcome.metrics.get(settings.scenario.requirement.metric, np.nan)
    good = np.isfinite(y)
    np.savez(kept, x=x[good], y=y[good])
    return x[good], y[good]


def cell(problem: str, method: str, metamodel: str, seed: int, folder: Path, n: int) -> dict[str, Any]:
    """Return the scores of one campaign."""
    with tempfile.TemporaryDirectory() as place:
        loaded = parse(configuration(problem, method, seed, f"{place}/store", metamodel))
        start = time.process_time()
        run_campaign(loaded, report=False)
        seconds = time.process_time() - start
        settings = settings_of(loaded, assembly_of(loaded))
        with Store.read(Path(place) / "store") as store:
            history = store.history()
    predictor = settings.learner.train(history.finished)
    space, critical = settings.scenario.space, settings.scenario.requirement.critical
    x, y = settings.learner.unseen(history) if problem == "table" else reference(problem, settings, folder, n)
    found = scores(chunked(predictor, space.metamodel_inputs(space.to_unit(x))), y, critical)
    return {**{k: found[k] for k in (*SHOWN, "base_rate")}, "cpu_s": seconds}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", default=",".join(BUDGETS))
    parser.add_argument("--methods", default="mix,boundary,even")
    parser.add_argument("--metamodels", default="gp", help="kinds, each with its preset after a space")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--reference", type=int, default=20_000)
    parser.add_argument("--store", type=Path, default=Path("runs/boundary_table"))
    args = parser.parse_args()
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

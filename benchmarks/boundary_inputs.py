"""Boundary identification in 2 to 12 inputs: is the default ever below space filling?

    python benchmarks/boundary_inputs.py [--problems a,b] [--methods mix,even] [--seeds 6] [--store FOLDER]

A cell is a campaign of 300 runs of one problem, method and seed with the product's defaults. A metamodel of its first 100, of its
first 200 and of all runs is scored on points that no campaign saw (see `boundary_table.py`). Finished cells are lines of
FOLDER/cells.jsonl: stopped and started again it goes on.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from boundary_table import strata, weighted_scores

import sbt
from sbt.execution.spec import ScenarioSpec

PROBLEMS = (
    "himmelblau_partx", "interval_ring_d3", "wavy_level_d3", "multi_needle_d4", "hartmann6_1e-3", "borehole_1e-3:box",
    "ellipsoids_d8", "hills_d8", "ellipsoids_d10", "waves_d12",
)  # fmt: skip
BUDGETS = (100, 200, 300)


def cell(problem: str, method: str, seed: int) -> dict[str, Any]:
    """Return F1 at each number of runs, and what the last metamodel states."""
    name, found = f"testbed:{problem}", []
    with tempfile.TemporaryDirectory() as folder:
        start = time.process_time()
        result = sbt.run(
            campaign="coverage" if method == "even" else "boundary", scenario=name, seed=seed, budget=BUDGETS[-1],
            acquisition=method, metamodel={"kind": "auto", "preset": "quick"}, store=Path(folder) / "store",
            executor="serial", report=False,
        )  # fmt: skip
        seconds = time.process_time() - start
        scenario, learner, history = result.scenario, result.study.learner, result.history
    x, critical, weight = strata(name, scenario, 0)
    for n in BUDGETS:
        runs = history.where(np.arange(len(history)) < n).finished
        predict = learner.on_inputs(learner.train(runs), len(runs))
        p = predict(scenario.space.to_unit(x)).probability(scenario.requirement.critical)
        found.append({**weighted_scores(p, critical, weight), "stated": float(np.average(p, weights=weight))})
    return {"cell": [problem, method, seed], "cpu_s": seconds, "scores": found}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", default=",".join(PROBLEMS))
    parser.add_argument("--methods", default="mix,even")
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--store", type=Path, default=Path("runs/boundary_inputs"))
    args = parser.parse_args()
    args.store.mkdir(parents=True, exist_ok=True)
    kept = args.store / "cells.jsonl"
    rows = map(json.loads, kept.read_text().splitlines()) if kept.is_file() else ()
    done = {tuple(row["cell"]): row for row in rows}
    problems, methods = args.problems.split(","), args.methods.split(",")
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    for key in [(p, m, s) for s in seeds for p in problems for m in methods]:
        if key not in done:
            done[key] = cell(*key)
            with kept.open("a") as file:
                file.write(json.dumps(done[key]) + "\n")
    print(f"| problem | inputs | base rate | {' | '.join(f'{m} {n}' for n in BUDGETS for m in methods)} |")
    print("|" + "---|" * (3 + len(BUDGETS) * len(methods)))
    for problem in problems:
        space = ScenarioSpec(f"testbed:{problem}").resolve().space
        base = done[problem, methods[0], seeds[0]]["scores"][0]["base_rate"]
        f1 = [np.median([done[problem, m, s]["scores"][k]["f1"] for s in seeds]) for k in range(len(BUDGETS)) for m in methods]
        print(f"| {problem} | {space.dimension} | {base:.4f} | {' | '.join(f'{v:.3f}' for v in f1)} |")


if __name__ == "__main__":
    main()

"""What do large batches cost? Runs needed against runs at once, on problems of known truth.

    python benchmarks/batch_size.py [--seeds 10] [--store FOLDER] [--figure FILE.png]

Falsification: runs to the first critical one (median, 10 % to 90 %). Boundary: F1 at 100 runs. Beside them the
time that a campaign would take with a simulation of 60 s on as many workers as the batch has runs, fits included:
larger batches keep more workers busy and learn less often. Finished cells are lines of FOLDER/cells.jsonl.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np

import sbt
from sbt import testbeds
from sbt.metamodels.scores import scores
from sbt.seeds import stream

SIZES = (2, 5, 10, 20, 40)
SEARCHES = ("hartmann6_1e-3", "needle_d4_1e-3")
BOUNDARY = "cut_in_crash:box"
SIMULATION = 60.0


def search(name: str, size: int, seed: int) -> dict:
    with tempfile.TemporaryDirectory() as folder:
        result = sbt.run(
            campaign="falsification", scenario=f"testbed:{name}", seed=seed, budget=400, initial=max(size, 10), batch=size,
            stop={"failures": 1}, executor="serial", store=f"{folder}/store", report=False,
        )  # fmt: skip
        first = result.conclusion.runs_to_first
    return {"value": first or 400, "hours": hours(result)}


def hours(result: sbt.Result) -> float:
    seconds = result.summary["seconds"]
    return (result.summary["iterations"] * SIMULATION + seconds["fit"] + seconds["propose"]) / 3600


def boundary(size: int, seed: int) -> dict:
    with tempfile.TemporaryDirectory() as folder:
        result = sbt.run(
            campaign="boundary", scenario=f"testbed:{BOUNDARY}", seed=seed, budget=100, initial=20, batch=size, metamodel="gp",
            executor="serial", store=f"{folder}/store", report=False,
        )  # fmt: skip
        space, learner, runs = result.scenario.space, result.study.learner, result.history.finished
    u = stream(99, "reference").random((20_000, space.dimension))
    prediction = learner.on_inputs(learner.train(runs), len(runs))(u)
    y = testbeds.values(BOUNDARY, space.from_unit(u))
    return {"value": scores(prediction, y, result.scenario.requirement.critical)["f1"], "hours": hours(result)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--store", type=Path, default=Path("runs/batch_size"))
    parser.add_argument("--figure", type=Path, default=Path("docs/figures/batch_size.png"))
    args = parser.parse_args()
    args.store.mkdir(parents=True, exist_ok=True)
    kept = args.store / "cells.jsonl"
    done = {tuple(r["cell"]): r for r in map(json.loads, kept.read_text().splitlines())} if kept.is_file() else {}
    for seed in range(args.seeds):
        for name in (*SEARCHES, BOUNDARY):
            for size in SIZES:
                if (name, size, seed) not in done:
                    found = boundary(size, seed) if name == BOUNDARY else search(name, size, seed)
                    done[name, size, seed] = row = {"cell": [name, size, seed], **found}
                    with kept.open("a") as file:
                        file.write(json.dumps(row) + "\n")
    draw(done, args)


def draw(done: dict, args: argparse.Namespace) -> None:
    """Print the table and write the figure."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(10.5, 3.2), layout="constrained")
    print("| problem | runs at once | value: median (10 % to 90 %) | hours with 60 s a run |\n|---|---|---|---|")
    for name in (*SEARCHES, BOUNDARY):
        rows = [[done[name, size, s] for s in range(args.seeds)] for size in SIZES]
        low, middle, high = np.quantile([[r["value"] for r in row] for row in rows], [0.1, 0.5, 0.9], axis=1)
        hours = [float(np.median([r["hours"] for r in row])) for row in rows]
        axis = axes[1] if name == BOUNDARY else axes[0]
        line = axis.plot(SIZES, middle, "o-", label=name)[0]
        axis.fill_between(SIZES, low, high, alpha=0.15, color=line.get_color())
        axes[2].plot(SIZES, hours, "o-", label=name, color="C2" if name == BOUNDARY else line.get_color())
        if name == BOUNDARY:
            line.set_color("C2")
        for k, size in enumerate(SIZES):
            print(f"| {name} | {size} | {middle[k]:.3g} ({low[k]:.3g} to {high[k]:.3g}) | {hours[k]:.2f} |")
    for axis, title in zip(axes, ("runs to the first failure", "F1 at 100 runs", "hours, 60 s a run"), strict=True):
        axis.set(xscale="log", xlabel="runs at once (batch)", title=title)
        axis.set_xticks(SIZES, [str(size) for size in SIZES])
        axis.minorticks_off()
        axis.legend(fontsize=7, frameon=False)
    figure.savefig(args.figure, dpi=110)


if __name__ == "__main__":
    main()

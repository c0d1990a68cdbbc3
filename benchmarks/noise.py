"""Falsification of noisy simulators: critical runs of distinct inputs, beside what as many random runs would meet.

    python benchmarks/noise.py [--scenarios a,b] [--seeds 8] [--first-seed 0]

A row is a campaign of 200 runs with the product's defaults; repeats of the same inputs count once, confirmations not at all.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

import sbt
from sbt.campaigns.failures import search_runs

SHARES = {"unprotected_left_turn": 0.0058, "highway_merge": 0.0083}
"""Critical shares of 6,000 random runs."""


def cell(scenario: str, seed: int, budget: int) -> tuple[int, int, list[str]]:
    """Return the number of critical runs, of distinct inputs among them, and the failure rate of each mode in words."""
    with tempfile.TemporaryDirectory() as folder:
        result = sbt.run(
            campaign="falsification", scenario=scenario, seed=seed, budget=budget, store=Path(folder) / "store",
            executor="serial", report=False,
        )  # fmt: skip
        runs = search_runs(result.history)
        x = runs.x[result.scenario.requirement.critical_runs(runs)]
        rates = [mode.failure_rate for mode in result.conclusion.failure_modes]
    told = [f"{r.estimate or 0.0:.2f} ({r.low:.2f} to {r.high:.2f})" for r in rates if r is not None]
    return len(x), len(np.unique(x, axis=0)), told


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenarios", default=",".join(SHARES))
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--budget", type=int, default=200)
    args = parser.parse_args()
    print("| scenario | seed | critical runs | of distinct inputs | failure rates of the modes (95 %) |")
    print("|---|---|---|---|---|")
    for scenario in args.scenarios.split(","):
        distinct = []
        for seed in range(args.first_seed, args.first_seed + args.seeds):
            critical, inputs, rates = cell(scenario, seed, args.budget)
            distinct.append(inputs)
            print(f"| {scenario} | {seed} | {critical} | {inputs} | {'; '.join(rates)} |", flush=True)
        chance = args.budget * SHARES[scenario]
        print(f"| {scenario} | median | | {np.median(distinct):.1f} (random {chance:.1f}) | |", flush=True)


if __name__ == "__main__":
    main()

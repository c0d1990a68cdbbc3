"""Falsification of noisy simulators: critical runs of distinct inputs, beside what as many random runs would meet.

    python benchmarks/noise.py [--scenarios a,b] [--seeds 8] [--first-seed 0]

A row is a campaign of 200 runs with the product's defaults; repeats of the same inputs count once, confirmations not at all.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from scipy.special import ndtr

import sbt
from sbt.campaigns.failures import search_runs
from sbt.testbeds import find, values

SHARES = {
    "unprotected_left_turn": 0.0058, "highway_merge": 0.0083, "testbed:two_hollows_noisy": 0.01365,
    "testbed:slope_noisy": 0.01347,
}  # fmt: skip
"""Critical shares: of 6,000 random runs; of the testbeds exact."""


def cell(scenario: str, seed: int, budget: int) -> tuple[int, int, float, list[str]]:
    """Return the critical runs, the distinct inputs among them, the best representative's rate, and the modes' rates in words.

    The best representative is that of the largest measured rate; its rate is the exact one on a testbed, else the measured one.
    """
    with tempfile.TemporaryDirectory() as folder:
        result = sbt.run(
            campaign="falsification", scenario=scenario, seed=seed, budget=budget, store=Path(folder) / "store",
            executor="serial", report=False,
        )  # fmt: skip
        runs = search_runs(result.history)
        x = runs.x[result.scenario.requirement.critical_runs(runs)]
        modes = [mode for mode in result.conclusion.failure_modes if mode.failure_rate is not None]
    modes.sort(key=lambda mode: -(mode.failure_rate.estimate or 0.0))
    rates = [mode.failure_rate for mode in modes]
    best = np.nan
    if modes:
        best = rates[0].estimate or 0.0
        if scenario.startswith("testbed:"):
            at = np.array([list(modes[0].inputs.values())])
            name = scenario.removeprefix("testbed:")
            best = float(ndtr(-values(name, at)[0] / find(name).noise))
    told = [f"{r.estimate or 0.0:.2f} ({r.low:.2f} to {r.high:.2f})" for r in rates if r is not None]
    return len(x), len(np.unique(x, axis=0)), float(best), told


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenarios", default=",".join(SHARES))
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--budget", type=int, default=200)
    args = parser.parse_args()
    print("| scenario | seed | critical runs | of distinct inputs | best representative | failure rates of the modes (95 %) |")
    print("|---|---|---|---|---|---|")
    for scenario in args.scenarios.split(","):
        distinct, best = [], []
        for seed in range(args.first_seed, args.first_seed + args.seeds):
            critical, inputs, rate, rates = cell(scenario, seed, args.budget)
            distinct.append(inputs)
            best.append(rate)
            print(f"| {scenario} | {seed} | {critical} | {inputs} | {rate:.2f} | {'; '.join(rates)} |", flush=True)
        chance = args.budget * SHARES[scenario]
        print(
            f"| {scenario} | median | | {np.median(distinct):.1f} (random {chance:.1f}) | {np.nanmedian(best):.2f} | |",
            flush=True,
        )


if __name__ == "__main__":
    main()

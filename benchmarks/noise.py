"""Falsification of noisy simulators: critical runs of distinct inputs, beside what as many random runs would meet.

    python benchmarks/noise.py [--scenarios a,b] [--seeds 8] [--first-seed 0]

A row is a campaign of 200 runs with the product's defaults; repeats of the same inputs count once, confirmations not at all.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtr
from two_discs import SCENARIO as TWO_DISCS
from two_discs import rates as rates_of_discs

import sbt
from sbt.campaigns.failures import search_runs
from sbt.problem.arrays import Points, Vector
from sbt.seeds import stream
from sbt.testbeds import find, values

SHARES = {
    "unprotected_left_turn": 0.0058, "highway_merge": 0.0083, "testbed:two_hollows_noisy": 0.01365,
    "testbed:slope_noisy": 0.01347, "two_discs": 1.1 * math.pi * 0.15**2,
}  # fmt: skip
"""Critical shares: of 6,000 random runs; of the testbeds and the discs exact."""


def exact_rates(scenario: str, x: Points) -> Vector | None:
    """Return (n,) failure rates at x (n, d); None where they are not known."""
    if scenario == "two_discs":
        return rates_of_discs(x)
    if not scenario.startswith("testbed:"):
        return None
    name = scenario.removeprefix("testbed:")
    return ndtr(-values(name, x) / find(name).noise)


def cell(scenario: str, seed: int, budget: int) -> dict[str, Any]:
    """Return the critical runs, the distinct inputs among them, and the rates of the modes.

    The representative is that of the first mode, which the repetitions that are told did not choose; its rate is the exact one
    where that is known, else the measured one. There also that of the best critical run, and how many of the stated intervals
    cover.
    """
    with tempfile.TemporaryDirectory() as folder:
        result = sbt.run(
            campaign="falsification", scenario=TWO_DISCS if scenario == "two_discs" else scenario, seed=seed, budget=budget,
            store=Path(folder) / "store", executor="serial", report=False,
        )  # fmt: skip
        runs = search_runs(result.history)
        x = runs.x[result.scenario.requirement.critical_runs(runs)]
        modes = [mode for mode in result.conclusion.failure_modes if mode.failure_rate is not None]
    rates = [mode.failure_rate for mode in modes]
    found = {
        "seed": seed, "critical": len(x), "inputs": len(np.unique(x, axis=0)), "stated": len(rates), "covered": 0,
        "beside": len(result.history) - len(runs),
        "rates": [f"{r.estimate or 0.0:.2f} ({r.low:.2f} to {r.high:.2f})" for r in rates],
        "representative": (rates[0].estimate or 0.0) if rates else np.nan, "best": "",
    }  # fmt: skip
    exact = exact_rates(scenario, np.array([list(mode.inputs.values()) for mode in modes])) if modes else None
    if exact is not None:
        found["representative"] = float(exact[0])
        found["best"] = f" ({exact_rates(scenario, x).max():.3f})"
        found["covered"] = sum(r.low <= p <= r.high for r, p in zip(rates, exact, strict=True))
    return found


def best_rate(scenario: str) -> float:
    """Return the largest failure rate, of 200,000 inputs; NaN where it is not known."""
    name = scenario.removeprefix("testbed:")
    d = len(find(name).parameters) if name != scenario else 2
    found = exact_rates(scenario, stream(99, "rates").beta(0.5, 0.5, (200_000, d)))  # the best place may be a corner
    return np.nan if found is None else float(found.max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenarios", default=",".join(SHARES))
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--budget", type=int, default=200)
    args = parser.parse_args()
    columns = ("critical runs", "of distinct inputs", "rate of the first mode (best critical run)", "repetitions")
    print(f"| scenario | seed | {' | '.join(columns)} | stated rates (95 %) |")
    print("|---|---|---|---|---|---|---|")
    for scenario in args.scenarios.split(","):
        rows, best = [], best_rate(scenario)
        for seed in range(args.first_seed, args.first_seed + args.seeds):
            rows.append(cell(scenario, seed, args.budget))
            r = rows[-1]
            line = f"{r['critical']} | {r['inputs']} | {r['representative']:.3f}{r['best']} | {r['beside']}"
            print(f"| {scenario} | {seed} | {line} | {'; '.join(r['rates'])} |", flush=True)
        chance, rates = args.budget * SHARES[scenario], np.array([r["representative"] for r in rows])
        distinct, near = np.median([r["inputs"] for r in rows]), int((rates >= 0.8 * best).sum())
        print(f"| {scenario} | median | | {distinct:.1f} (random {chance:.1f}) | {np.nanmedian(rates):.3f} | | |")
        if np.isfinite(best):
            covered, stated = (sum(r[k] for r in rows) for k in ("covered", "stated"))
            print(
                f"\n{scenario}: the first mode has 80 % of the largest rate, {best:.3f}, in {near} of {len(rows)} seeds; "
                f"{covered} of {stated} intervals cover the exact rate\n", flush=True,
            )  # fmt: skip


if __name__ == "__main__":
    main()

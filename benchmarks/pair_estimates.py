"""What an estimation by pairs of inputs and seed costs for a coefficient of variation of 10 %, against crude Monte Carlo.

    python benchmarks/pair_estimates.py roundabout_entry --seeds 50 [--table runs/pair_estimates.jsonl]

CPU seconds of everything but imports, in one process. Beside each campaign 1,000 runs of crude Monte Carlo tell what each
of the (1 - P) / P / 0.01 that it needs would cost on the same machine.
"""

from __future__ import annotations

import math
import os
import statistics
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import sklearn.ensemble  # noqa: F401  imports are not what is compared
import torch  # noqa: F401
from resumed import arguments, collect, seeds

import sbt

COV = 0.1


def campaign(name: str, seed: int, budget: int, priced: int) -> dict:
    """Return what both cost for one seed."""
    with tempfile.TemporaryDirectory() as folder:
        given = {"campaign": "estimation", "scenario": name, "seed": seed, "executor": "serial", "report": False}
        begun = time.process_time()
        result = sbt.run(**given, budget=budget, stop={"cov": COV}, store=Path(folder) / "pairs")
        spent = time.process_time() - begun
        begun = time.process_time()
        sbt.run(**given, budget=priced, acquisition={"kind": "monte_carlo"}, store=Path(folder) / "crude")
        price = (time.process_time() - begun) / priced
        found = result.summary["conclusion"]
    return {"runs": result.summary["runs"], "cpu": spent, "price": price} | {k: found[k] for k in ("probability", "low", "high")}


def show(name: str, rows: list[dict], p: float) -> None:
    """Print the medians of a scenario, by a known P or that of all campaigns."""
    p = p or statistics.mean(row["probability"] for row in rows)
    crude = (1.0 - p) / p / COV**2
    error = [(row["probability"] or 0.0) / p - 1.0 for row in rows]
    covered = sum(row["low"] <= p <= row["high"] for row in rows)
    times = sorted(crude * row["price"] / row["cpu"] for row in rows)
    runs, cpu, price = (statistics.median(row[key] for row in rows) for key in ("runs", "cpu", "price"))
    print(
        f"| `{name}` | {p:.5f} | {len(rows)} | {runs:.0f} | {crude:,.0f} | {cpu:.1f} | {1e3 * price:.1f} | "
        f"{statistics.median(times):.2f} ({times[0]:.2f} to {times[-1]:.2f}) | "
        f"{math.sqrt(statistics.mean(e**2 for e in error)):.3f} | {statistics.mean(error):+.3f} | {covered} of {len(rows)} |"
    )


def main() -> None:
    """Run what is missing, and print the table."""
    parser = arguments(__doc__, "runs/pair_estimates.jsonl", 3)
    parser.add_argument("names", nargs="+")
    parser.add_argument("--probability", type=float, default=0.0, help="known P(critical) of a single scenario")
    parser.add_argument("--budget", type=int, default=20_000, help="runs at most")
    parser.add_argument("--priced", type=int, default=1000, help="runs of crude Monte Carlo that tell the price of one")
    args = parser.parse_args()
    jobs = [
        {"name": name, "seed": seed, "budget": args.budget, "priced": args.priced} for name in args.names for seed in seeds(args)
    ]
    rows = collect(args, jobs, campaign)
    head = "scenario", "P", "seeds", "runs", "crude runs", "CPU s", "a run, ms", "times (range)", "RMSE", "mean error", "covered"
    print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
    for name in args.names:
        if mine := [row for row in rows if row["name"] == name]:
            show(name, mine, args.probability)


if __name__ == "__main__":
    main()

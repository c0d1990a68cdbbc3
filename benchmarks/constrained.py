"""Does an estimation gain over crude Monte Carlo where constraints leave little of the box?

    python benchmarks/constrained.py [--seeds 10] [--sums 0.2,0.5,1.224] [--budget 200] [--table runs/constrained.jsonl]

Three uniform inputs of which the sum is at most 0.2, 0.5 or 1.224: .0013, .021 and .3 of the box are admissible. The metric is
linear, edge + 0.1 a - c, and critical from 0 down, P = .06 to .11. Campaigns with default settings and no stop rule, through the
public way. Finished cells are lines of the table: run again to go on, or split seeds over processes (`resumed.py`).
"""

from __future__ import annotations

import os
import tempfile
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from resumed import arguments, collect, seeds

import sbt

EDGES = {0.2: 0.1, 0.5: 0.3, 1.224: 0.7}
"""Largest sum of the inputs: where c becomes critical."""
_MIDDLES = (np.arange(100_000) + 0.5) / 100_000


def _area(length: np.ndarray) -> np.ndarray:
    """Return the integral of u, at most 1, for u from 0 to a length."""
    return np.where(length < 1.0, 0.5 * np.maximum(length, 0.0) ** 2, length - 0.5)


def _volume(largest: float, least: np.ndarray) -> float:
    """Return the volume of the cube where the sum is at most `largest` and c is at least `least` (one number for each a)."""
    left = largest - _MIDDLES
    return float((_area(left - np.minimum(least, 1.0)) - _area(left - 1.0)).mean())


def problem(largest: float) -> tuple[sbt.Scenario, float, float]:
    """Return a problem, the share of its box that is admissible, and its probability of a critical run."""
    edge = EDGES[largest]

    def evaluate(values: dict[str, float], seed: int) -> dict[str, float]:
        return {"y": edge + 0.1 * values["a"] - values["c"]}

    rule = (f"a + b + c <= {largest}", lambda columns: columns["a"] + columns["b"] + columns["c"] <= largest)
    space = sbt.ParameterSpace(tuple(sbt.Parameter(name, 0.0, 1.0) for name in "abc"), constraints=(rule,))
    scenario = sbt.Scenario("constrained", space, sbt.Requirement("y", high=0.0), evaluate=evaluate, metrics=["y"])
    share = _volume(largest, np.zeros(len(_MIDDLES)))
    return scenario, share, _volume(largest, edge + 0.1 * _MIDDLES) / share


def campaign(largest: float, seed: int, budget: int) -> dict:
    """Return what one campaign says."""
    scenario, _, _ = problem(largest)
    began = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        found = sbt.run(
            campaign="estimation", scenario=scenario, seed=seed, budget=budget, store=f"{folder}/store", executor="serial",
            report=False, stop={"cov": None},
        )  # fmt: skip
        told = found.conclusion
        return {
            "runs": len(found.history), "different": len(np.unique(found.history.x, axis=0)), "probability": told.probability,
            "low": told.low, "high": told.high, "unseen": told.undetected_mass_bound, "cpu": time.process_time() - began,
        }  # fmt: skip


def show(largest: float, rows: list[dict]) -> None:
    """Print one row of the table."""
    _, share, p = problem(largest)
    error = np.sqrt(np.mean([(row["probability"] / p - 1.0) ** 2 for row in rows]))
    crude = np.sqrt(np.mean([(1.0 - p) / p / row["runs"] for row in rows]))
    covered = sum(row["low"] <= p <= row["high"] for row in rows)
    half = np.median([0.5 * (row["high"] - row["low"]) for row in rows]) / p
    different, unseen, cpu = (np.median([row[key] for row in rows]) for key in ("different", "unseen", "cpu"))
    print(
        f"| {share:.2g} | {p:.3f} | {len(rows)} | {error:.3f} | {error / crude:.2f} | {half:.3f} | {covered} of {len(rows)} |"
        f" {different:.0f} | {unseen:.3f} | {cpu:.0f} |"
    )


def main() -> None:
    """Run what is missing, and print the table."""
    parser = arguments(__doc__, "runs/constrained.jsonl", 10)
    parser.add_argument("--sums", default=",".join(map(str, EDGES)))
    parser.add_argument("--budget", type=int, default=200)
    args = parser.parse_args()
    head = ("admissible share", "P", "seeds", "rel. RMSE", "RMSE / crude", "half width / P", "covered", "different inputs")
    print("| " + " | ".join((*head, "undetected", "CPU s")) + " |\n|" + "---|" * (len(head) + 2))
    for largest in map(float, args.sums.split(",")):
        jobs = [{"largest": largest, "seed": seed, "budget": args.budget} for seed in seeds(args)]
        rows = collect(args, jobs, campaign)
        if rows:
            show(largest, rows)


if __name__ == "__main__":
    main()

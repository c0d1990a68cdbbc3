"""Estimations in two corners: chains of subset simulation on equal values, and batches of half of the budget.

    python benchmarks/corners.py ties [--seeds 300]
    python benchmarks/corners.py batches [--seeds 16]

`ties` repeats one subset simulation of 200 points a level on a plane in two and ten normal inputs whose margin is rounded or cut
off. `batches` runs campaigns on P(x >= 2) of a normal x beside a second input that moves the edge, or makes the metric jump.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable

import numpy as np
from scipy.special import ndtr

import sbt
from sbt.estimators.subset import SubsetRun
from sbt.seeds import stream

MARGINS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "plain": lambda s: 3.0 - s,
    "whole numbers": lambda s: 3.0 - np.floor(s),
    "halves": lambda s: 6.0 - np.floor(2.0 * s),
    "cut off at 2": lambda s: np.minimum(3.0 - s, 2.0),
    "cut off at 1.3": lambda s: np.minimum(3.0 - s, 1.3),
}
WAVE = 0.3 * np.sin(5.0 * (np.arange(20_000) + 0.5) / 20_000)
METRICS: dict[str, tuple[Callable[[float, float], float], float]] = {
    "smooth": (lambda x, y: 2.0 - x + 0.3 * np.sin(5.0 * y), float(ndtr(-2.0 - WAVE).mean())),
    "cut off at 1.5": (lambda x, y: min(2.0 - x + 0.3 * np.sin(5.0 * y), 1.5), float(ndtr(-2.0 - WAVE).mean())),
    "inf where y < .1 and beyond 1.5": (lambda x, y: 2.0 - x if y >= 0.1 and x > 0.5 else np.inf, 0.9 * float(ndtr(-2.0))),
    "5 where y < .1": (lambda x, y: 2.0 - x if y >= 0.1 else 5.0, 0.9 * float(ndtr(-2.0))),
}
SIZES = ((300, 150), (300, 75), (150, 75))


def ties(seeds: int) -> None:
    print("| inputs | margin | mean / P (std. error) | std. deviation / P | runs |\n|---|---|---|---|---|")
    for d in (2, 10):
        for name, margin in MARGINS.items():
            shares, runs = [], 0
            for k in range(seeds):
                repeat, rng = SubsetRun(200, d), stream(k, "corners", name, d)
                while not repeat.finished:
                    z = repeat.ask(rng)
                    repeat, runs = repeat.tell(z, margin(z.sum(axis=1) / np.sqrt(d))), runs + len(z)
                shares.append(repeat.share / float(ndtr(-3.0)))
            mean, std = np.mean(shares), np.std(shares)
            print(f"| {d} | {name} | {mean:.2f} ({std / np.sqrt(seeds):.2f}) | {std:.2f} | {runs / seeds:.0f} |", flush=True)


def batches(seeds: int) -> None:
    print("| metric | runs, batch | rel. RMSE | half width (median) | covered |\n|---|---|---|---|---|")
    inputs = [sbt.Parameter("x", -5, 5, distribution=sbt.Normal(0, 1)), sbt.Parameter("y", 0, 1)]
    for name, (metric, p) in METRICS.items():
        scenario = sbt.Scenario(
            "corner", inputs, sbt.Requirement("m", high=0.0),
            evaluate=lambda v, seed, metric=metric: {"m": float(metric(v["x"], v["y"]))},
        )  # fmt: skip
        for budget, batch in SIZES:
            found = []
            for seed in range(seeds):
                with tempfile.TemporaryDirectory() as folder:
                    found.append(sbt.run(
                        campaign="estimation", scenario=scenario, budget=budget, batch=batch, stop={"cov": None}, seed=seed,
                        executor="serial", report=False, store=f"{folder}/s",
                    ).conclusion)  # fmt: skip
            error = np.array([(c.probability or 0.0) / p - 1.0 for c in found])
            width = np.median([0.5 * (c.high - c.low) / p for c in found])
            covered = sum(c.low <= p <= c.high for c in found)
            rmse = np.sqrt(np.mean(error**2))
            print(f"| {name} | {budget}, {batch} | {rmse:.3f} | {width:.3f} | {covered} of {seeds} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("corner", choices=("ties", "batches"))
    parser.add_argument("--seeds", type=int, default=16)
    asked = parser.parse_args()
    (ties if asked.corner == "ties" else batches)(asked.seeds)


if __name__ == "__main__":
    main()

"""Estimations in corners: chains of subset simulation on equal values, batches of half of the budget, failures by chance, waves.

    python benchmarks/corners.py ties [--seeds 300]
    python benchmarks/corners.py batches [--seeds 16]
    python benchmarks/corners.py chance [--seeds 30]
    python benchmarks/corners.py waves [--seeds 12]

`ties` repeats one subset simulation of 200 points a level on a plane in two and ten normal inputs whose margin is rounded or cut
off. `batches` runs campaigns on P(x >= 2) of a normal x beside a second input that moves the edge, or makes the metric jump.
`chance` has a smooth region of P = .001, and a sixth of the space where one seed in ten fails, which no metric shows, with a gate
of .012; `waves` a deterministic metric with seven periods along an input.
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


def campaign(scenario: sbt.Scenario, seed: int, **keys: object) -> object:
    """Return the conclusion of an estimation of 200 runs."""
    with tempfile.TemporaryDirectory() as folder:
        return sbt.run(
            campaign="estimation", scenario=scenario, seed=seed, budget=200, executor="serial", report=False, store=f"{folder}/s",
            **keys,
        ).conclusion  # fmt: skip


def told(found: list, p: float, name: str) -> None:
    """Print errors beside those of crude Monte Carlo, and how far up intervals reach."""
    error = np.sqrt(np.mean([((r.probability or 0.0) / p - 1.0) ** 2 for r in found]))
    crude = np.sqrt((1.0 - p) / (p * 200))
    covered = sum(r.low <= p <= r.high for r in found)
    high = np.median([r.high for r in found]) / p
    print("| problem | rel. RMSE (crude) | covered | upper end / P (median) | gates passed |\n|---|---|---|---|---|")
    passed = sum(r.gate is not None and r.gate.verdict == "pass" for r in found)
    print(f"| {name} | {error:.2f} ({crude:.2f}) | {covered} of {len(found)} | {high:.1f} | {passed} |", flush=True)


def chance(seeds: int) -> None:
    def evaluate(v: dict, seed: int) -> dict:
        by_chance = v["c"] > 1.0 and np.random.default_rng(seed).random() < 0.1
        return {"m": -1.0 - 0.2 * v["b"] if by_chance else 3.2 - v["a"] - 0.3 * v["b"]}

    inputs = [sbt.Parameter(name, -6.0, 6.0, distribution=sbt.Normal(0, 1)) for name in "abc"]
    scenario = sbt.Scenario("chance", inputs, sbt.Requirement("m", high=0.0), evaluate=evaluate, metrics=["m"])
    region = float(ndtr(-3.2 / np.sqrt(1.09)))
    p = region + (1.0 - region) * 0.1 * float(ndtr(-1.0))
    told([campaign(scenario, s, gate={"probability": 0.012, "confidence": 0.95}) for s in range(seeds)], p, "chance")


def waves(seeds: int) -> None:
    def margin(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        return 0.95 - np.sin(2.0 * np.pi * (7.0 * a + 2.0 * b**2)) * (0.6 + 0.4 * c)

    inputs = [sbt.Parameter(name, 0.0, 1.0) for name in "abc"]
    scenario = sbt.Scenario(
        "waves", inputs, sbt.Requirement("m", high=0.0),
        evaluate=lambda v, seed: {"m": float(margin(v["a"], v["b"], v["c"]))}, metrics=["m"],
    )  # fmt: skip
    p = float((margin(*np.random.default_rng(0).random((3, 10_000_000))) <= 0.0).mean())
    told([campaign(scenario, s, stop={"cov": None}) for s in range(seeds)], p, "waves")


CORNERS = {"ties": ties, "batches": batches, "chance": chance, "waves": waves}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("corner", choices=tuple(CORNERS))
    parser.add_argument("--seeds", type=int, default=16)
    asked = parser.parse_args()
    CORNERS[asked.corner](asked.seeds)


if __name__ == "__main__":
    main()

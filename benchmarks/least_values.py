"""Falsification where a slope leads to a least value that is not critical, and what fails lies elsewhere: is it met?

    python benchmarks/least_values.py [--problems slope,noisy] [--seeds 12] [--first-seed 0] [--budget 100]

A row is a problem, campaigns with the product's defaults: how many met something critical, beside the chance of as many random
runs, and critical runs in the mean, beside theirs.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import sbt
from sbt.seeds import stream

Given = Mapping[str, Any]


def corner(v: Given) -> bool:
    """Return whether it fails whatever its surroundings tell: 1.6 % of the space."""
    return abs(v["a"] - 0.85) < 0.1 and abs(v["b"] - 0.9) < 0.1 and v["c"] > 0.6


def slope(v: Given, seed: int) -> float:
    return -1.0 if corner(v) else 1.0 + v["a"] + v["b"]


def slope_far(v: Given, seed: int) -> float:
    return -1.0 if corner(v) else 100.0 + v["a"] + v["b"]


def waves(v: Given, seed: int) -> float:
    return -1.0 if corner(v) else 1.2 + math.sin(11.0 * v["a"]) * math.cos(13.0 * v["b"])


def trap(v: Given, seed: int) -> float:
    """A bowl that ends above 0, and a narrow well in the opposite corner."""
    x = np.array([v[name] for name in "abcd"])
    return float(0.3 + ((x - 0.25) ** 2).sum() - 1.6 * np.exp(-((x - 0.8) ** 2).sum() / (2.0 * 0.15**2)))


def noisy(v: Given, seed: int) -> float:
    """A noisy slope, and 3 of 10 seeds fail in 4 % of the space."""
    rng = np.random.default_rng(seed)
    return -1.0 if v["a"] > 0.8 and v["b"] < 0.2 and rng.random() < 0.3 else 2.0 + v["a"] + 0.2 * rng.standard_normal()


def whole(v: Given, seed: int) -> float:
    """A slope of two whole numbers."""
    return -1.0 if 7 <= v["a"] <= 8 and v["b"] >= 8 and v["c"] > 0.4 else 1.0 + 0.1 * v["a"] + 0.1 * v["b"]


def flat(v: Given, seed: int) -> float:
    return -1.0 if corner(v) else 1.0


PROBLEMS: dict[str, Callable[[Given, int], float]] = {
    "slope": slope, "slope_far": slope_far, "waves": waves, "trap": trap, "whole": whole, "noisy": noisy, "flat": flat,
}  # fmt: skip


def evaluate(v: Given, seed: int, problem: str) -> dict[str, float]:
    return {"y": PROBLEMS[problem](v, seed)}


def inputs(problem: str) -> list[sbt.Parameter]:
    if problem == "whole":
        return [*(sbt.Parameter(name, 0, 9, kind="integer") for name in "ab"), *(sbt.Parameter(name, 0.0, 1.0) for name in "cd")]
    return [sbt.Parameter(name, 0.0, 1.0) for name in ("abcde" if problem == "noisy" else "abcd")]


def share(scenario: sbt.Scenario, problem: str, runs: int = 60_000) -> float:
    """Return the share of random runs that is critical."""
    space = scenario.space
    points = space.sample(runs, stream(3, "random"))
    return float(np.mean([PROBLEMS[problem](space.named(x), seed) <= 0.0 for seed, x in enumerate(points)]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", default=",".join(PROBLEMS))
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--budget", type=int, default=100)
    given = parser.parse_args()
    print("| problem | met something | random | critical runs | random |\n|---|---|---|---|---|", flush=True)
    for problem in given.problems.split(","):
        scenario = sbt.Scenario(
            problem, inputs(problem), sbt.Requirement("y", high=0.0), evaluate=partial(evaluate, problem=problem)
        )
        critical, p = [], share(scenario, problem)
        for seed in range(given.first_seed, given.first_seed + given.seeds):
            with tempfile.TemporaryDirectory() as folder:
                found = sbt.run(
                    campaign="falsification", scenario=scenario, budget=given.budget, seed=seed, store=Path(folder) / "store",
                    executor="serial", report=False,
                ).conclusion  # fmt: skip
                critical.append(found.critical_runs)
        met, chance = sum(n > 0 for n in critical), 1.0 - (1.0 - p) ** given.budget
        row = (problem, f"{met} of {given.seeds}", f"{chance:.2f}", f"{np.mean(critical):.1f}", f"{p * given.budget:.1f}")
        print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()

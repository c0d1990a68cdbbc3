"""Estimations of whole numbers and choices whose budget hardly exceeds the number of combinations: error, coverage, width.

    python benchmarks/tight_sums.py [--seeds 20] [--problems dominant@80 ...]

Campaigns with the product's defaults and no stop rule; error (RMSE) over that of random draws of the whole budget, intervals that
cover both readings of failed runs, mean width: the table in docs/measured/estimation.md.
"""

from __future__ import annotations

import argparse
import itertools
import math
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import norm

import sbt
from sbt.seeds import stream

UNEVEN = [
    sbt.Parameter("kind", choices={"car": 0.95, "truck": 0.03, "bike": 0.02}),
    sbt.Parameter("n", 0, 24, kind="integer", distribution=sbt.Normal(0.0, 0.6)),
]
EVEN = [
    sbt.Parameter("kind", choices={"a": 0.7, "b": 0.25, "c": 0.05}),
    sbt.Parameter("n", 0, 4, kind="integer", distribution=sbt.Normal(1.0, 1.2)),
    sbt.Parameter("m", 0, 4, kind="integer"),
]


@dataclass(frozen=True)
class Problem:
    """Inputs, the metric of values and a generator (critical: at most 0), and P(critical | values) where runs succeed."""

    inputs: list[sbt.Parameter]
    metric: Callable[[dict, np.random.Generator], float]
    critical: Callable[[dict], float]
    fails: float = 0.0


def of_rate(inputs: list[sbt.Parameter], rate: Callable[[dict], float], fails: float = 0.0) -> Problem:
    return Problem(inputs, lambda values, rng: rng.random() - rate(values), rate, fails)


def of_slope(noise: float) -> Problem:
    def slope(values: dict) -> float:
        return 3.0 - 0.8 * values["n"] - 0.5 * values["m"] + (values["kind"] == "a")

    def critical(values: dict) -> float:
        return float(norm.cdf(-slope(values) / noise)) if noise else float(slope(values) <= 0.0)

    return Problem(EVEN, lambda values, rng: slope(values) + noise * rng.standard_normal(), critical)


def few_seeds(values: dict, rng: np.random.Generator) -> float:
    drawn = rng.random()
    return -1.0 - drawn if drawn < 0.01 else 1.0 + values["n"] + values["m"]


PROBLEMS = {
    "dominant": of_rate(UNEVEN, lambda values: 0.3),
    "with failures": of_rate(UNEVEN, lambda values: 0.25, fails=0.2),
    "rare": of_rate(UNEVEN, lambda values: 0.9 if values["kind"] != "car" and values["n"] >= 1 else 0.002),
    "even": of_rate(
        EVEN, lambda values: 0.8 if values["kind"] == "c" and values["m"] >= 3 else 0.3 if values["n"] == 4 else 0.0
    ),
    "gauss": of_slope(1.0), "small": of_slope(0.05), "exact": of_slope(0.0),
    "few seeds": Problem(EVEN, few_seeds, lambda values: 0.01),
}  # fmt: skip
TABLE = (
    "dominant@80", "dominant@200", "with failures@80", "rare@80", "even@90", "gauss@90", "small@90", "few seeds@90", "exact@90",
)  # fmt: skip


def probability(problem: Problem) -> float:
    """Return P(critical) where all runs succeed."""
    choices = [p.choices or tuple(range(int(p.low), int(p.high) + 1)) for p in problem.inputs]
    ways = zip(problem.inputs, choices, strict=True)
    weights = [np.exp(p.log_density(np.arange(len(c)) + (0.0 if p.choices else p.low))) for p, c in ways]
    names = [p.name for p in problem.inputs]
    rates = [problem.critical(dict(zip(names, values, strict=True))) for values in itertools.product(*choices)]
    joint = np.array([math.prod(w) for w in itertools.product(*weights)])
    return float(joint @ rates / joint.sum())


def estimates(problem: Problem, budget: int, seeds: range) -> Iterator[tuple[float, float, float]]:
    """Yield the probability and the ends of its interval, of each seed."""

    def evaluate(values: dict, seed: int) -> dict[str, float]:
        failed = stream(seed, "fails").random() < problem.fails
        return {"y": math.nan if failed else float(problem.metric(values, stream(seed, "metric")))}

    scenario = sbt.Scenario("tight", problem.inputs, sbt.Requirement("y", high=0.0), evaluate=evaluate)
    for seed in seeds:
        with tempfile.TemporaryDirectory() as folder:
            found = sbt.run(
                campaign="estimation", scenario=scenario, budget=budget, seed=seed, stop={"cov": None}, executor="serial",
                store=Path(folder) / "s", report=False,
            ).conclusion  # fmt: skip
        yield found.probability, found.low, found.high


def row(name: str, seeds: range) -> str:
    kind, _, budget = name.partition("@")
    problem = PROBLEMS[kind]
    p, (value, low, high) = probability(problem), np.array(list(estimates(problem, int(budget), seeds))).T
    safe, worst = p * (1.0 - problem.fails), p * (1.0 - problem.fails) + problem.fails
    error = math.sqrt(((value - safe) ** 2).mean() / (safe * (1.0 - safe) / int(budget)))
    covered = int(((low <= safe + 1e-12) & (high >= worst - 1e-12)).sum())
    return f"| {name} | {safe:.3g} | {error:.2f} | {covered} of {len(seeds)} | {(high - low).mean():.2f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--problems", nargs="+", default=TABLE)
    given = parser.parse_args()
    print("| problem@runs | P | error | covered | width |\n|---|---|---|---|---|")
    for name in given.problems:
        print(row(name, range(given.seeds)), flush=True)


if __name__ == "__main__":
    main()

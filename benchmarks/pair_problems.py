"""Estimation by pairs of inputs and seed on problems with known truth, against as many runs of crude Monte Carlo.

    python benchmarks/pair_problems.py --seeds 20 [--only skewed rare] [--table runs/pair_problems.jsonl]

The metric is linear in an input, in normal numbers that the seed draws and covariates tell, and in noise; P is exact.
"""

from __future__ import annotations

import math
import statistics
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from resumed import arguments, collect, seeds
from scipy.optimize import brentq
from scipy.special import ndtr

import sbt


@dataclass(frozen=True)
class Linear:
    """y = a x + b w + c e - t <= 0 is critical: x uniform in [-1, 1], w drawn and told, e noise.

    Attributes:
        p: P(critical).
        a, b, c: weights of the input, of the sum of what is drawn, and of the noise.
        drawn: numbers that the seed draws, of equal weight.
        told: `plain`, their `exponential`s, or `useless`, other numbers.
        cap: the metric ends here above the edge.
    """

    p: float
    a: float = 0.4
    b: float = 1.0
    c: float = 0.3
    drawn: int = 4
    told: str = "plain"
    cap: float = math.inf

    @property
    def edge(self) -> float:
        """The threshold t that gives P exactly: the mean over x of normal probabilities."""
        x = (np.arange(2000) + 0.5) / 1000.0 - 1.0
        return float(brentq(lambda t: ndtr((t - self.a * x) / math.hypot(self.b, self.c)).mean() - self.p, -20.0, 5.0))

    def _drawn(self, seed: int) -> tuple[np.ndarray, float]:
        rng = np.random.default_rng(seed)
        return rng.standard_normal(self.drawn), float(rng.standard_normal())

    def __call__(self, values: dict[str, float], seed: int) -> dict[str, float]:
        """Return the metric."""
        w, e = self._drawn(seed)
        y = self.a * values["x"] + self.b * w.sum() / math.sqrt(self.drawn) + self.c * e - self.edge
        return {"y": min(float(y), self.cap)}

    def known_before(self, values: dict[str, float], seed: int) -> dict[str, float]:
        """Return the covariates."""
        w = np.random.default_rng((seed, 1)).standard_normal(2) if self.told == "useless" else self._drawn(seed)[0]
        return {f"w{k}": float(v) for k, v in enumerate(np.exp(3.0 * w) if self.told == "exponential" else w)}


@dataclass(frozen=True)
class Flag:
    """Critical: half of the pairs with x > .2 and w0 < .1, and one in a hundred of all; w: three uniform numbers, told."""

    p: float = 1.0 - 0.98 * 0.99

    def __call__(self, values: dict[str, float], seed: int) -> dict[str, float]:
        """Return the metric."""
        rng = np.random.default_rng(seed)
        w, e = rng.random(3), rng.random(2)
        return {"y": -1.0 if (values["x"] > 0.2 and w[0] < 0.1 and e[0] < 0.5) or e[1] < 0.01 else 1.0}

    def known_before(self, values: dict[str, float], seed: int) -> dict[str, float]:
        """Return the covariates."""
        return {f"w{k}": float(v) for k, v in enumerate(np.random.default_rng(seed).random(3))}


PROBLEMS: dict[str, Linear | Flag] = {
    "plain": Linear(0.02), "skewed": Linear(0.02, told="exponential"), "many": Linear(0.01, drawn=12),
    "capped": Linear(0.02, cap=1.0), "useless": Linear(0.02, told="useless"), "rare": Linear(0.0015, a=0.2, c=0.1, drawn=1),
    "rare, skewed": Linear(0.0015, a=0.2, c=0.1, drawn=1, told="exponential"), "flag": Flag(),
}  # fmt: skip


def campaign(name: str, seed: int, budget: int) -> dict:
    """Return what one estimation says."""
    problem = PROBLEMS[name]
    inputs = [sbt.Parameter("x", -1, 1)]
    scenario = sbt.Scenario("pairs", inputs, sbt.Requirement("y", high=0.0), evaluate=problem, metric_names=("y",))
    with tempfile.TemporaryDirectory() as folder:
        result = sbt.run(
            campaign="estimation", scenario=scenario, budget=budget, seed=seed, covariates=True, store=Path(folder) / "store",
            executor="serial", report=False,
        )  # fmt: skip
        found = result.conclusion
        return {"runs": len(result.frame), "probability": found.probability, "low": found.low, "high": found.high}


def show(name: str, rows: list[dict]) -> None:
    """Print a line of the table."""
    p, runs = PROBLEMS[name].p, statistics.mean(row["runs"] for row in rows)
    error = [(row["probability"] or 0.0) / p - 1.0 for row in rows]
    rmse, crude = math.sqrt(statistics.mean(e**2 for e in error)), math.sqrt((1.0 - p) / p / runs)
    covered = sum(row["low"] <= p <= row["high"] for row in rows)
    print(
        f"| {name} | {p:g} | {len(rows)} | {runs:.0f} | {rmse:.2f} | {crude:.2f} | {rmse / crude:.2f} |"
        f" {statistics.mean(error):+.2f} | {covered} of {len(rows)} |"
    )


def main() -> None:
    """Run what is missing, and print the table."""
    parser = arguments(__doc__, "runs/pair_problems.jsonl", 20)
    parser.add_argument("--only", nargs="+", choices=PROBLEMS, default=list(PROBLEMS))
    parser.add_argument("--budget", type=int, default=300)
    args = parser.parse_args()
    rows = collect(args, [{"name": n, "seed": k, "budget": args.budget} for n in args.only for k in seeds(args)], campaign)
    head = "problem", "P", "seeds", "runs", "rel. RMSE", "crude", "ratio", "mean error", "covered"
    print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
    for name in args.only:
        if mine := [row for row in rows if row["name"] == name]:
            show(name, mine)


if __name__ == "__main__":
    main()

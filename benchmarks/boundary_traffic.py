"""P(critical | inputs) of boundary campaigns in traffic, against counts and exact P: a table in docs/measured/traffic.md.

    python benchmarks/boundary_traffic.py roundabout_entry --points 96 --runs 100 --into counts    # counts, kept there
    python benchmarks/boundary_traffic.py roundabout_entry --into counts --seeds 3                 # campaigns against them
    python benchmarks/boundary_traffic.py --problems --seeds 10                                    # exact P

Error: root mean square of P - true P over points, over the standard deviation of true P among them (1: no better than its mean);
what the counts miss themselves is taken off. Log loss: of runs at the points, over that of their mean P.
"""

from __future__ import annotations

import argparse
import math
import statistics
import tempfile
from pathlib import Path

import numpy as np
from pair_problems import Linear
from scipy.special import ndtr

import sbt
from sbt.errors import RunError
from sbt.execution.spec import ScenarioSpec
from sbt.problem.arrays import Points, Vector
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import run_seed

PROBLEMS = {
    "traffic decides": Linear(0.04), "inputs, too": Linear(0.1, a=2.0), "common": Linear(0.4, a=1.0),
    "rare": Linear(0.005), "useless covariates": Linear(0.1, a=2.0, told="useless"),
    "hardly any traffic": Linear(0.2, a=1.0, b=0.05, c=0.0), "nothing but noise": Linear(0.1, a=0.0, told="useless"),
}  # fmt: skip
METHODS = {"pairs": "auto", "inputs": False}
COUNTED, COUNT_SEED = 777, 900_000  # seeds of the points that are counted, and of their runs


def counted(name: str, points: int, runs: int, folder: Path) -> tuple[Points, Points]:
    """Return inputs (m, d) and whether each of (m, runs) runs was critical; made where they are not in the folder."""
    path, scenario = folder / f"counts_{name}.npz", ScenarioSpec(name).resolve()
    x = scenario.space.from_unit(SobolSequence(scenario.space.dimension, COUNTED).points(0, points))
    known = np.load(path)["y"] if path.exists() else np.empty((points, 0))
    if known.shape[1] < runs:
        more = np.full((points, runs - known.shape[1]), np.nan)
        for k, j in np.ndindex(more.shape):
            try:
                outcome = scenario.simulate(scenario.space.named(x[k]), run_seed(COUNT_SEED + k, j + known.shape[1]))
                more[k, j] = scenario.measure(outcome)[scenario.requirement.metric]
            except RunError:
                pass
        known = np.hstack([known, more])
        np.savez(path, y=known)
    return x, scenario.requirement.critical.contains(known[:, :runs])


def compared(p: Vector, rate: Vector, doubt: Vector) -> tuple[float, float, float]:
    """Return error, log loss and mean P over the true mean, of P (m,) where `rate` (m,) has been met with a variance `doubt`."""
    spread = max(float(rate.var() - doubt.mean()), 1e-12)
    square, mean = float(((p - rate) ** 2 - doubt).mean()), float(np.clip(rate.mean(), 1e-6, 1.0 - 1e-6))
    p = np.clip(p, 1e-6, 1.0 - 1e-6)
    loss = -float((rate * np.log(p) + (1.0 - rate) * np.log1p(-p)).mean())
    return math.sqrt(max(square, 0.0) / spread), loss / -(mean * math.log(mean) + (1 - mean) * math.log1p(-mean)), p.mean() / mean


def campaign(scenario: str | sbt.Scenario, x: Points, budget: int, seed: int, covariates: object) -> tuple[Vector, int, int]:
    """Return P (m,) at inputs (m, d) after a campaign, its critical runs and those of a chosen seed."""
    with tempfile.TemporaryDirectory() as folder:
        result = sbt.run(
            campaign="boundary", scenario=scenario, budget=budget, seed=seed, covariates=covariates, store=Path(folder) / "store",
            executor="serial", report=False,
        )  # fmt: skip
        told, frame = result.predict(x), result.frame
        p = np.asarray(told["p_critical"]) * (1.0 - np.asarray(told["p_fails"]) if "p_fails" in told else 1.0)
        return p, int(frame["critical"].sum()), int(frame.get("seed_chosen", np.zeros(len(frame))).sum())


def main() -> None:
    """Count, run the campaigns, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--problems", action="store_true", help="those with an exact P")
    parser.add_argument("--only", nargs="+", choices=PROBLEMS, default=list(PROBLEMS), help="of these")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--points", type=int, default=96)
    parser.add_argument("--runs", type=int, default=100, help="at each point")
    parser.add_argument("--budget", type=int, default=300)
    parser.add_argument("--seeds", type=int, default=0)
    parser.add_argument("--into", type=Path, default=Path("runs/boundary_traffic"))
    given = parser.parse_args()
    given.into.mkdir(parents=True, exist_ok=True)
    cases: dict[str, tuple[str | sbt.Scenario, Points, Vector, Vector]] = {}
    for name in given.names:
        x, critical = counted(name, given.points, given.runs, given.into)
        rate = critical.mean(axis=1)
        cases[name] = name, x, rate, rate * (1.0 - rate) / (given.runs - 1)
    for name, problem in ((name, PROBLEMS[name]) for name in given.only if given.problems):
        inputs = [sbt.Parameter("x", -1, 1)]
        scenario = sbt.Scenario("pairs", inputs, sbt.Requirement("y", high=0.0), evaluate=problem, metric_names=("y",))
        x = np.linspace(-0.99, 0.99, 100)[:, None]
        rate = ndtr((problem.edge - problem.a * x[:, 0]) / math.hypot(problem.b, problem.c))
        cases[name] = scenario, x, rate, np.zeros(len(rate))
    print("| problem | P | method | error | log loss | mean P / true | critical runs | chosen seeds |\n" + "|---" * 8 + "|")
    for name, (scenario, x, rate, doubt) in cases.items():
        for method in given.methods if given.seeds else ():
            covariates, rows = METHODS[method], []
            for seed in range(given.seeds):
                p, critical, chosen = campaign(scenario, x, given.budget, seed, covariates)
                rows.append((*compared(p, rate, doubt), critical, chosen))
            cells = [statistics.median(column) for column in zip(*rows, strict=True)]
            each = ", ".join(f"{row[0]:.2f}" for row in rows)
            told = f"{cells[0]:.2f} ({each}) | {cells[1]:.3f} | {cells[2]:.2f} | {cells[3]:g} | {cells[4]:g}"
            print(f"| {name} | {rate.mean():.3g} | {method} | {told} |", flush=True)


if __name__ == "__main__":
    main()

"""What batches that are chosen ahead cost in sample efficiency, and what they gain in the use of the workers.

    python benchmarks/ahead.py [--seeds 5] [--budget 160] [--batch 10] [--cells boundary:wavy_level_d3 ...]
    python benchmarks/ahead.py --use        # share of the workers' time that is used, with runs of 50 ms

Boundary: F1 of P(critical) > 0.5 at 20,000 uniform points against the truth. Falsification: critical runs, and runs to the first.
Estimation: error of log10 P against the truth of docs/testbeds.md. Medians (minimum, maximum) over seeds.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import textwrap
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

import sbt
from sbt.execution.spec import ScenarioSpec

CELLS = [
    "boundary:four_branch_7", "boundary:wavy_level_d3", "falsification:four_branch_7", "falsification:hartmann6_1e-3",
    "estimation:four_branch_7",
]  # fmt: skip
TRUTH = {"four_branch_7": 2.223e-3}
SLOW = """
import time

import sbt


def evaluate(values, seed):
    time.sleep(0.05)
    return {"y": (values["a"] - 0.3) ** 2 + (values["b"] - 0.6) ** 2}


SCENARIO = sbt.Scenario(
    "slow", [sbt.Parameter("a", 0, 1), sbt.Parameter("b", 0, 1)], sbt.Requirement("y", high=0.05), evaluate=evaluate,
)
"""


def campaign(folder: str, **settings: Any) -> sbt.Result:
    """Run one."""
    return sbt.run(**{"executor": "serial", "report": False, "stop": {}, **settings}, store=folder)


def f1(result: sbt.Result, testbed: str) -> float:
    """Return the F1 of the metamodel's sides at uniform points."""
    scenario = ScenarioSpec(f"testbed:{testbed}").resolve()
    x = scenario.space.from_unit(np.random.Generator(np.random.PCG64(1)).random((20_000, scenario.space.dimension)))
    truth = np.array([scenario.requirement.is_critical(scenario.run(scenario.space.named(row), 0)) for row in x])
    said = result.predict(x)["p_critical"].to_numpy() > 0.5
    return float(2 * (truth & said).sum() / max(truth.sum() + said.sum(), 1))


def scores(kind: str, testbed: str, ahead: int, seed: int, args: argparse.Namespace) -> dict[str, float]:
    """Return what one campaign is worth."""
    with tempfile.TemporaryDirectory() as folder:
        batch = {"size": args.batch, "ahead": ahead}
        result = campaign(folder, campaign=kind, scenario=f"testbed:{testbed}", budget=args.budget, batch=batch, seed=seed)
        if kind == "boundary":
            return {"F1": f1(result, testbed)}
        if kind == "estimation":
            found = result.conclusion
            inside = found.low <= TRUTH[testbed] <= found.high
            error = abs(np.log10(max(found.probability or 0.0, 1e-9) / TRUTH[testbed]))
            return {"error of log10 P": error, "truth inside the interval": float(inside)}
        first = result.conclusion.runs_to_first
        return {"critical runs": float(result.summary["critical"]), "runs to first": float(first or args.budget + 1)}


def use(args: argparse.Namespace) -> None:
    """Print how busy two workers are."""
    print("| batch | ahead | workers busy | clock (s) |\n|---|---|---|---|")
    for ahead in (0, 1):
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "slow.py").write_text(textwrap.dedent(SLOW))
            start = time.perf_counter()
            result = campaign(
                f"{folder}/store", campaign="boundary", scenario=f"{folder}/slow.py:SCENARIO", budget=args.budget,
                executor="local", workers=2, batch={"size": args.batch, "ahead": ahead},
            )  # fmt: skip
            spent = result.summary["seconds"]
            busy = spent["work"] / (spent["work"] + spent["idle"])
            print(f"| {args.batch} | {ahead} | {100 * busy:.0f} % | {time.perf_counter() - start:.1f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--budget", type=int, default=160)
    parser.add_argument("--batch", type=int, default=10)
    parser.add_argument("--cells", nargs="+", default=CELLS, metavar="CAMPAIGN:TESTBED")
    parser.add_argument("--use", action="store_true")
    args = parser.parse_args()
    if args.use:
        use(args)
        return
    print("| campaign | testbed | score | ahead 0 | ahead 1 |\n|---|---|---|---|---|", flush=True)
    for kind, testbed in (cell.split(":") for cell in args.cells):
        found = [[scores(kind, testbed, ahead, seed, args) for seed in range(args.seeds)] for ahead in (0, 1)]
        for name in found[0][0]:
            cells = [np.array([one[name] for one in each]) for each in found]
            told = " | ".join(f"{np.median(c):.3g} ({c.min():.3g}, {c.max():.3g})" for c in cells)
            print(f"| {kind} | {testbed} | {name} | {told} |", flush=True)


if __name__ == "__main__":
    main()

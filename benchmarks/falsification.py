"""Runs to the first failure, beside other samplers; and do all failure modes come to light?

    python benchmarks/falsification.py --into FOLDER [--seeds 20] [--only hartmann6_1e-3] [--samplers portfolio,random]

Every cell is a campaign as `sumo-sbt run` runs it, or a sampler of others on the same scenario, in this
process. Finished cells are kept in FOLDER and not run again: stop and continue as you like. `random` and
`sobol` have 2,000 runs, on SUMO and all others 400; initial designs and batches are the defaults (10 runs each). The
samplers cma_es and tpe need: pip install 'sumo-sbt[compare]'.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

import sbt
from sbt.benchmark.compare import compare, table
from sbt.campaigns.records import CONFIRM
from sbt.config.load import parse
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.samplers.portfolio import propose
from sbt.samplers.search import Search
from sbt.seeds import stream
from sbt.testbeds import find, values
from sbt.testbeds.search import WELLS

CASES = {
    "hartmann6_1e-3": ("testbed:hartmann6_1e-3", None, (45, 65)),
    "needle_d4_1e-3": ("testbed:needle_d4_1e-3", None, (45, 90)),
    "cut_in_near_miss": ("testbed:cut_in_near_miss:box", None, (30, 60)),
    "interval_ring_d3": ("testbed:interval_ring_d3", None, (55, 95)),
    "plateau_ttc_d6": ("testbed:plateau_ttc_d6", None, (100, 220)),
    "hartmann6_in_25": ("testbed:hartmann6_in_25", None, (65, 95)),
    "deceptive_d2": ("testbed:deceptive_d2", None, None),
    "deceptive_d3": ("testbed:deceptive_d3", None, None),
    "deceptive_d4": ("testbed:deceptive_d4", None, None),
    "deceptive_d6": ("testbed:deceptive_d6", None, None),
    "deceptive_d2_1e-5": ("testbed:deceptive_d2_1e-5", None, None),
    "deceptive_d4_1e-5": ("testbed:deceptive_d4_1e-5", None, None),
    "sumo_cut_in": ("cut_in", "{critical: [-5.0, -0.95]}", None),
    "sumo_emergency_braking": ("emergency_braking", "{metric: impact_speed, critical: [20.3, .inf]}", None),
}
MINIMA = np.array([[0.20169, 0.150011, 0.476874, 0.275332, 0.311652, 0.6573], [0.4047, 0.8824, 0.8436, 0.5740, 0.1389, 0.0385]])


def configuration(case: str, budget: int) -> str:
    scenario, tighter, _ = CASES[case]
    requirement = "" if tighter is None else f"requirement: {tighter}\n"
    return (
        f"campaign: falsification\nscenario: {scenario}\n{requirement}budget: {budget}\n"
        "stop: {failures: 1}\nexecutor: {kind: serial}\n"
    )


def first_failures(args: argparse.Namespace, case: str) -> None:
    cells = []
    for name in args.samplers.split(","):
        budget = 2000 if name in ("random", "sobol") and not case.startswith("sumo") else 400
        cells += compare(parse(configuration(case, budget)), [name], args.seeds, args.into / case)
    bar = CASES[case][2]
    print(f"\n{case}" + (f", bar {bar[0]} / {bar[1]}" if bar else "") + f"\n\n{table(cells)}", flush=True)


def _hartmann_modes(x: np.ndarray) -> np.ndarray:
    """Return (n,) which minimum a descent from each of x (n, d) ends in."""

    def end(v: np.ndarray) -> np.ndarray:
        return minimize(lambda w: float(values("hartmann6_1e-3", w[None])[0]), v, bounds=[(0, 1)] * 6, method="L-BFGS-B").x

    return np.array([int(np.abs(end(v) - MINIMA).max(axis=1).argmin()) for v in x], dtype=int)


def _needle_modes(x: np.ndarray) -> np.ndarray:
    """Return (n,) in which of the five balls each of x (n, d) lies."""
    return np.argmin([np.sqrt(((x - np.array(c)) ** 2).sum(axis=1)) - radius for c, radius, _ in WELLS], axis=0)


MODES = {"hartmann6_1e-3": (300, 2, 2, _hartmann_modes), "multi_needle_d4": (400, 5, 4, _needle_modes)}
"""Testbed: runs, how many modes there are, how many are asked for, and which mode critical inputs belong to."""


def all_modes(args: argparse.Namespace, case: str) -> None:
    """Seeds in which the modes of a testbed are among the critical runs, and what the campaign counts."""
    path = args.into / f"modes_{case}.jsonl"
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = {r["seed"]: r for r in map(json.loads, path.read_text().splitlines())} if path.is_file() else {}
    budget, there, wanted, which = MODES[case]
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    for seed in seeds:
        if seed in rows:
            continue
        with tempfile.TemporaryDirectory() as folder:
            result = sbt.run(
                campaign="falsification", scenario=f"testbed:{case}", budget=budget, seed=seed, executor="serial",
                store=f"{folder}/store", report=False,
            )  # fmt: skip
            history, found, critical = result.history, result.conclusion, result.scenario.requirement
        runs = history.where(history.stage != CONFIRM)
        hits = np.flatnonzero(critical.critical_runs(runs))
        mode = which(runs.x[hits])
        first = sorted(int(hits[mode == k][0]) + 1 for k in range(there) if (mode == k).any())
        rows[seed] = {"seed": seed, "first": first, "counted": len(found.failure_modes), "critical": found.critical_runs,
                      "seconds": result.summary["seconds"]}  # fmt: skip
        with path.open("a") as file:
            file.write(json.dumps(rows[seed]) + "\n")
        print(json.dumps(rows[seed]), flush=True)
    enough = [rows[k]["first"][wanted - 1] for k in seeds if len(rows[k]["first"]) >= wanted]
    mean = np.mean([len(rows[k]["first"]) for k in seeds])
    print(
        f"\n{case}: {wanted} of {there} modes within {budget} runs in {len(enough)} of {len(seeds)} seeds"
        + (f", median at {np.median(enough):.0f}" if enough else "") + f"; {mean:.1f} in the mean"
    )  # fmt: skip
    counted = [rows[k]["counted"] for k in seeds]
    print(f"failure modes the campaign counts: median {np.median(counted):.0f}, {min(counted)} to {max(counted)}")


def cost() -> None:
    """CPU seconds to propose a batch of ten, by runs so far."""
    print("\n| runs | CPU seconds a batch of 10, median of 3 (hartmann6_1e-3) |\n|---|---|")
    search = Search(find("hartmann6_1e-3").critical, GaussianProcess(nu=2.5, input_noise=False))
    for n in (50, 200, 500, 1000, 2000):
        u = stream(1, "cost", n).random((n, 6))
        y, spent = values("hartmann6_1e-3", u), []
        for k in range(3):
            start = time.process_time()
            propose(search, u, y, 9, stream(1, "cost", k))
            spent.append(time.process_time() - start)
        print(f"| {n} | {np.median(spent):.2f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--into", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0, help="of the modes")
    parser.add_argument("--modes", default=",".join(MODES))
    parser.add_argument("--only", default=",".join([*CASES, "modes", "cost"]))
    parser.add_argument("--samplers", default="portfolio,random,sobol,cma_es,tpe")
    args = parser.parse_args()
    if unknown := set(args.only.split(",")) - {*CASES, "modes", "cost"}:
        parser.error(f"--only: {', '.join(sorted(unknown))} is none of {', '.join((*CASES, 'modes', 'cost'))}")
    for case in args.only.split(","):
        if case == "modes":
            for name in args.modes.split(","):
                all_modes(args, name)
        elif case == "cost":
            cost()
        else:
            first_failures(args, case)


if __name__ == "__main__":
    main()

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
from sbt.campaigns.falsification import CONFIRM
from sbt.config.load import parse
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.samplers.portfolio import propose
from sbt.samplers.search import Search
from sbt.seeds import stream
from sbt.testbeds import find, values

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


def _basin(x: np.ndarray) -> int:
    """Return which minimum a descent from x ends in."""
    ends = minimize(lambda v: float(values("hartmann6_1e-3", v[None])[0]), x, bounds=[(0, 1)] * 6, method="L-BFGS-B").x
    return int(np.abs(ends - MINIMA).max(axis=1).argmin())


def both_modes(args: argparse.Namespace) -> None:
    """Seeds in which both modes of hartmann6_1e-3 are among the critical runs, and what the campaign counts."""
    path = args.into / "modes.jsonl"
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = {r["seed"]: r for r in map(json.loads, path.read_text().splitlines())} if path.is_file() else {}
    for seed in range(args.seeds):
        if seed in rows:
            continue
        with tempfile.TemporaryDirectory() as folder:
            result = sbt.run(
                campaign="falsification", scenario=CASES["hartmann6_1e-3"][0], budget=300, seed=seed, executor="serial",
                store=f"{folder}/store", report=False,
            )  # fmt: skip
            history, found = result.history, result.conclusion
        runs = history.where(history.stage != CONFIRM)
        hits = np.flatnonzero(runs.y("y") <= -2.4)
        basin = np.array([_basin(runs.x[k]) for k in hits], dtype=int)
        first = [hits[basin == k][:1] for k in (0, 1)]
        both = int(max(f[0] for f in first)) + 1 if all(len(f) for f in first) else None
        rows[seed] = {"seed": seed, "both": both, "counted": len(found.failure_modes),
                      "critical": found.critical_runs, "seconds": result.summary["seconds"]}  # fmt: skip
        with path.open("a") as file:
            file.write(json.dumps(rows[seed]) + "\n")
    found = [rows[k]["both"] for k in range(args.seeds) if rows[k]["both"] is not None]
    counted = [rows[k]["counted"] for k in range(args.seeds)]
    print(
        f"\nboth modes of hartmann6_1e-3 within 300 runs: {len(found)} of {args.seeds} seeds, median at {np.median(found):.0f};"
    )
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
    parser.add_argument("--only", default=",".join([*CASES, "modes", "cost"]))
    parser.add_argument("--samplers", default="portfolio,random,sobol,cma_es,tpe")
    args = parser.parse_args()
    if unknown := set(args.only.split(",")) - {*CASES, "modes", "cost"}:
        parser.error(f"--only: {', '.join(sorted(unknown))} is none of {', '.join((*CASES, 'modes', 'cost'))}")
    for case in args.only.split(","):
        if case == "modes":
            both_modes(args)
        elif case == "cost":
            cost()
        else:
            first_failures(args, case)


if __name__ == "__main__":
    main()

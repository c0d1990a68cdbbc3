"""What does a second kernel of other length scales bring to `gp` (Matern 2.5, one noise)?

    python benchmarks/kernels.py [--problems a,b] [--runs 60,200,350] [--seeds 5]

Half of the runs fill the space (Sobol), half lie at the edge, as in a campaign. The metric is learned warped around the
edge, as campaigns do, with at most one kernel and with at most two, and predicted at 4,000 points: three quarters about
the edge, a quarter uniform. Medians over the seeds.
"""

from __future__ import annotations

import argparse
import os
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from scipy.stats import qmc

from sbt import testbeds
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.warp import Warp
from sbt.problem.space import ParameterSpace

PROBLEMS = (
    "hartmann6_1e-3", "metaball", "wavy_level_d3", "borehole_1e-3", "four_branch_7", "cut_in_crash", "pedestrian",
    "needle_d4_1e-3", "hills_d8", "rastrigin_ak",
)  # fmt: skip
CANDIDATES, NEAREST, TEST = 2**15, 300, (3000, 1000)


def scores(name: str, runs: int, seed: int) -> list[tuple[float, ...]]:
    """Return for one and for two kernels: how many were taken, RMSE, mean log density, F1, CPU seconds of the fit."""
    problem, rng = testbeds.find(name), np.random.default_rng(seed)
    space, critical = ParameterSpace(tuple(problem.parameters)), problem.critical
    u = qmc.Sobol(space.dimension, rng=np.random.default_rng(seed)).random(CANDIDATES)
    y = problem.function(space.from_unit(u))
    near = np.argsort(np.abs(critical.margin(y)))[: max(4 * runs, NEAREST)]
    rows = np.unique(np.r_[np.arange(runs // 2), rng.permutation(near)[: runs - runs // 2]])
    about = u[near][rng.integers(len(near), size=TEST[0])] + 0.05 * rng.normal(size=(TEST[0], space.dimension))
    at = np.vstack([np.clip(about, 0.0, 1.0), rng.random((TEST[1], space.dimension))])
    warp = Warp.around_edge(y[rows], critical, quantile=0.5)
    truth = problem.function(space.from_unit(at))
    found = []
    for kernels in (1, 2):
        start = time.process_time()
        fitted = GaussianProcess(nu=2.5, input_noise=False, kernels=kernels).fit(u[rows], warp.values(y[rows]), rng)
        spent, p = time.process_time() - start, fitted(at)
        said, is_critical = p.probability(warp.interval(critical)) > 0.5, critical.contains(truth)
        f1 = 2.0 * (said & is_critical).sum() / max(said.sum() + is_critical.sum(), 1)
        rmse = float(np.sqrt(np.mean((p.mu - warp.values(truth)) ** 2)))
        found.append((len(fitted.hyper.outputscale), rmse, float(p.log_density(warp.values(truth)).mean()), float(f1), spent))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--problems", default=",".join(PROBLEMS))
    parser.add_argument("--runs", default="60,200,350")
    parser.add_argument("--seeds", type=int, default=5)
    args = parser.parse_args()
    print("| testbed | runs | two taken | RMSE | log density | F1 | CPU s of a fit |\n|" + "---|" * 7)
    for name in args.problems.split(","):
        for runs in map(int, args.runs.split(",")):
            every = np.array([scores(name, runs, seed) for seed in range(args.seeds)])  # (seeds, 2, scores)
            one, two = np.median(every, axis=0)
            taken = int((every[:, 1, 0] == 2).sum())
            print(
                f"| {name} | {runs} | {taken} of {args.seeds} | {one[1]:.3f} to {two[1]:.3f} | {one[2]:.2f} to {two[2]:.2f} | "
                f"{one[3]:.3f} to {two[3]:.3f} | {one[4]:.2f} to {two[4]:.2f} |", flush=True,
            )  # fmt: skip


if __name__ == "__main__":
    main()

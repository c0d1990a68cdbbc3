"""Sampling from a_BI where few scenarios are critical: plain rejection against the exact screen, as a markdown table.

OMP_NUM_THREADS=1 python benchmarks/screening.py --rows 500 --inputs 8 18 --samples 200
"""

from __future__ import annotations

import argparse
import time

import numpy as np

import sbt
from sbt.metamodels.automatic import Auto
from sbt.metamodels.base import build, log_ambiguity_bound, with_target
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.problem.requirement import CriticalInterval
from sbt.samplers.roi import RoiDraw, rejection
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream

KINDS = {"gp": GaussianProcess(), "auto quick": build(Auto, "quick")}
CRITICAL = 0.003


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Time the exact screen of a_BI.")
    parser.add_argument("--rows", nargs="+", type=int, default=[500])
    parser.add_argument("--inputs", nargs="+", type=int, default=[8, 18])
    parser.add_argument("--samples", type=int, default=200)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    print("| metamodel | inputs | rows | accepted | plain [ms/sample] | screened [ms/sample] | ratio | same points |")
    print("|---|---|---|---|---|---|---|---|")
    for kind in args.kinds:
        for d in args.inputs:
            for n in args.rows:
                _line(kind, d, n, args.samples, args.seed)


def _metric(u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a smooth metric of mostly four inputs, clipped above, noisy."""
    y = 3.0 * u[:, 0] + 2.0 * np.cos(2.5 * u[:, 1]) + u[:, 2] * u[:, -1] + 0.1 * u.sum(axis=1)
    return np.minimum(y, 4.0) + rng.normal(scale=0.05, size=len(u))


def _line(kind: str, d: int, n: int, samples: int, seed: int) -> None:
    rng = stream(seed, "screening", d, n)
    critical = CriticalInterval(high=float(np.quantile(_metric(rng.random((200_000, d)), rng), CRITICAL)))
    u = SobolSequence(d, seed).points(0, n)
    predict = with_target(KINDS[kind], critical).fit(u, _metric(u, rng), stream(seed, "fit", n))

    def score(points: np.ndarray) -> np.ndarray:
        return sbt.acquisitions.boundary(predict(points), critical, np.zeros(len(points)))

    def timed(screen: bool) -> tuple[RoiDraw, float]:
        bound = (lambda points: log_ambiguity_bound(predict, points, critical)) if screen else None
        start = time.process_time()
        draw = rejection(
            score, SobolSequence(d, seed), samples, start=n, seed=seed, label=1, max_candidates=2**21, bound=bound, fill=False,
        )
        return draw, time.process_time() - start

    (plain, slow), (screened, quick) = timed(False), timed(True)
    same = "yes" if np.array_equal(plain.positions, screened.positions) else "NO"
    print(
        f"| {kind} | {d} | {n} | {plain.acceptance:.2%} | {1e3 * slow / samples:.2f} | {1e3 * quick / samples:.2f} | "
        f"{quick / slow:.2f} | {same} ({plain.method}) |", flush=True,
    )  # fmt: skip


if __name__ == "__main__":
    main()

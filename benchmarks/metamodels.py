"""Seconds to fit and predictions per second of the metamodels, as a markdown table.

OMP_NUM_THREADS=1 python benchmarks/metamodels.py --rows 50 200 500 --inputs 2 7
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from sbt.metamodels.base import Metamodel, Predictor, build
from sbt.metamodels.et import ExtraTrees
from sbt.metamodels.gp import GaussianProcess
from sbt.seeds import stream

KINDS: dict[str, Metamodel] = {
    "et": ExtraTrees(),
    "et paper": build(ExtraTrees, "paper"),
    "gp": GaussianProcess(),
    "gp paper": build(GaussianProcess, "paper"),
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Time the metamodels.")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--rows", nargs="+", type=int, default=[50, 200, 500], help="numbers of rows n")
    parser.add_argument("--inputs", nargs="+", type=int, default=[2, 7], help="numbers of inputs d")
    parser.add_argument("--points", type=int, default=8192, help="points predicted at a time")
    parser.add_argument("--repeat", type=int, default=3, help="the median of so many is shown")
    args = parser.parse_args()
    print("| metamodel | d | n | fit [s] | predictions/s |")
    print("|---|---|---|---|---|")
    for kind in args.kinds:
        for d in args.inputs:
            for n in args.rows:
                fit_s, predict_s = _time(KINDS[kind], n, d, args.points, args.repeat)
                print(f"| {kind} | {d} | {n} | {fit_s:.2f} | {args.points / predict_s:,.0f} |", flush=True)


def _time(metamodel: Metamodel, n: int, d: int, points: int, repeat: int) -> tuple[float, float]:
    """Return the median wall seconds of a fit and of a prediction, after one fit to warm up."""
    rng = stream(0, "benchmark", n, d)
    u, asked = rng.random((n, d)), rng.random((points, d))
    y = _time_to_collision(u, rng)
    metamodel.fit(u[:20], y[:20], stream(0, "warm up"))(asked)
    fits, predictions = [], []
    for i in range(repeat):
        start = time.perf_counter()
        predictor: Predictor = metamodel.fit(u, y, stream(0, "fit", i))
        fits.append(time.perf_counter() - start)
        start = time.perf_counter()
        predictor(asked)
        predictions.append(time.perf_counter() - start)
    return float(np.median(fits)), float(np.median(predictions))


def _time_to_collision(u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a metric as simulations give it: smooth in parts, clipped at 10 s, noisier when near."""
    gap, closing = 5 + 60 * u[:, 0], -5 + 25 * u[:, -1]
    ttc = np.where(closing > 0, gap / np.maximum(closing, 0.1), 10.0)
    return np.clip(ttc + rng.normal(scale=0.1 + 0.5 * (ttc < 3), size=len(u)), -10.0, 10.0)


if __name__ == "__main__":
    main()

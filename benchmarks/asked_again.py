"""Do the answers of `estimate-again` cover, under other distributions and another threshold, from the same runs?

    python benchmarks/asked_again.py [--seeds 20] [--table runs/asked_again.jsonl]

Campaigns on `linear_d2` (P = 2.3e-4 of x1 + x2 >= 3.5 sqrt(2), both standard normal), 140 runs, `stop: {cov: null}`, and the
questions of `QUESTIONS`, with answers in closed form. Finished seeds are lines of the table: run again to go on, or split
seeds over processes (`resumed.py`).
"""

from __future__ import annotations

import math
import os
import tempfile
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from resumed import arguments, collect, seeds
from scipy.stats import norm

import sbt


def linear(mean: float = 0.0, std: float = 1.0, beta: float = 3.5) -> float:
    """Return P(x1 + x2 >= beta sqrt(2)), x1 normal with this mean and standard deviation."""
    return float(norm.sf((beta - mean / math.sqrt(2.0)) / math.sqrt((1.0 + std**2) / 2.0)))


def _normal(mean: float, std: float) -> tuple[dict[str, Any], float]:
    return {"inputs": {"x1": sbt.Normal(mean, std)}}, linear(mean, std)


QUESTIONS: dict[str, tuple[dict[str, Any], float]] = {
    "the campaign's own": ({}, linear()),
    "x1 ~ N(0.7, 1)": _normal(0.7, 1.0),
    "x1 ~ N(0, 1.4)": _normal(0.0, 1.4),
    "x1 ~ N(2, 0.5)": _normal(2.0, 0.5),
    "critical beyond 3.3": ({"critical": (-math.inf, 0.2)}, linear(beta=3.3)),
}


def answers(seed: int) -> dict:
    with tempfile.TemporaryDirectory() as folder:
        result = sbt.run(
            campaign="estimation", scenario="testbed:linear_d2", seed=seed, budget=140, stop={"cov": None}, executor="serial",
            store=f"{folder}/store", report=False,
        )  # fmt: skip
        found = {}
        for name, (keys, _) in QUESTIONS.items():
            try:
                said = result.estimate(**keys)
            except sbt.InputError:
                found[name] = None  # refused
                continue
            found[name] = {"p": said.probability, "low": said.low, "high": said.high, "hits": said.hits}
    return {"answers": found}


def show(rows: list[dict]) -> None:
    print("| question | P | seeds | refused | rel. RMSE | median half width / P | covered | one-sided |\n|" + "---|" * 8)
    for name, (_, p) in QUESTIONS.items():
        given = [row["answers"][name] for row in rows if row["answers"][name] is not None]
        if not given:
            print(f"| {name} | {p:.3g} | {len(rows)} | {len(rows)} | - | - | - | - |")
            continue
        value, low, high = (np.array([a[key] for a in given]) for key in ("p", "low", "high"))
        print(
            f"| {name} | {p:.3g} | {len(rows)} | {len(rows) - len(given)} | {np.sqrt(np.mean((value / p - 1.0) ** 2)):.3f} | "
            f"{np.median(0.5 * (high - low)) / p:.3f} | {int(((low <= p) & (p <= high)).sum())} of {len(given)} | "
            f"{int(((low == 0.0) | (high == 1.0)).sum())} |"
        )


def main() -> None:
    args = arguments(__doc__, "runs/asked_again.jsonl", 20).parse_args()
    show(collect(args, [{"seed": seed} for seed in seeds(args)], answers))


if __name__ == "__main__":
    main()

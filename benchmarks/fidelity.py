"""What coarse runs spare an estimation: CPU time times squared coefficient of variation, with and without them (docs/traffic.md).

    python benchmarks/fidelity.py unprotected_left_turn --steps 0.1 0.5 --budget 2500 --seeds 2
    python benchmarks/fidelity.py testbed:two_hollows_noisy --cost 0.2 --budget 500 --seeds 50

A testbed has a coarse level of its own and a known probability; its runs cost nothing, and count as what they are said to cost.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import sbt
from sbt import testbeds

TESTBED = "testbed:"


def estimated(name: str, seed: int, budget: int, fidelity: dict[str, Any] | None) -> dict[str, float]:
    """Return estimate, coefficient of variation, ends of the interval, CPU seconds and runs of one campaign."""
    with tempfile.TemporaryDirectory() as folder:
        begun = time.process_time()
        result = sbt.run(
            campaign="estimation", scenario=name, seed=seed, budget=budget, fidelity=fidelity, stop={"cov": None},
            executor="serial", store=Path(folder) / "store", report=False,
        )  # fmt: skip
        spent, found = time.process_time() - begun, result.conclusion.to_dict()
    told = found.get("fidelity") or {}
    return {
        "probability": found["probability"] or np.nan, "cov": found["cov"] or np.nan, "low": found["low"], "high": found["high"],
        "cpu": spent, "fine": told.get("fine", budget), "coarse": told.get("coarse", 0),
        "correlation": told.get("correlation") or np.nan,
    }  # fmt: skip


def main() -> None:
    """Print a row a campaign, and the means."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario")
    parser.add_argument("--steps", type=float, nargs=2, default=(0.1, 0.5))
    parser.add_argument("--cost", type=float)
    parser.add_argument("--budget", type=int, default=2500)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--only", choices=("with", "without"), help="one of the two")
    given = parser.parse_args()
    known = testbeds.truth(given.scenario.removeprefix(TESTBED)).probability if given.scenario.startswith(TESTBED) else None
    level: dict[str, Any] = {"scenario": f"{given.scenario}:coarse"} if known else {"step_length": list(given.steps)}
    ways = {"with": level | ({} if given.cost is None else {"cost": given.cost}), "without": None}
    merit: dict[str, float] = {}
    for way, fidelity in ways.items():
        if given.only in (None, way):
            rows = [estimated(given.scenario, seed, given.budget, fidelity) for seed in range(given.seeds)]
            for row in rows:
                print(way, " ".join(f"{key} {value:.4g}" for key, value in row.items()), flush=True)
            merit[way] = float(np.nanmean([(given.budget if known else row["cpu"]) * row["cov"] ** 2 for row in rows]))
            if known:
                p = np.array([row["probability"] for row in rows])
                covered = sum(row["low"] <= known <= row["high"] for row in rows)
                print(f"{way}: mean / truth {p.mean() / known:.3f}, spread {p.std() / known:.3f}, {covered} of {len(rows)} cover")
    if len(merit) > 1:
        print(f"cost at equal precision, without / with: {merit['without'] / merit['with']:.2f}")


if __name__ == "__main__":
    main()

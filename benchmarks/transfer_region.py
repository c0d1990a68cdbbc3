"""Does an interval by transfer cover where the new setup has a critical region that the earlier one did not have?

    python benchmarks/transfer_region.py [--seeds 21] [--first 1] [--gate] [--table runs/transfer_region.jsonl]

Three uniform inputs; the new metric has a jump to -0.2 in 7.5 % of the box, beside nearly the same edge as before. The earlier
campaign is an estimation of 120 runs, the new one has 100.
"""

from __future__ import annotations

import os
import tempfile

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from resumed import arguments, collect, seeds

import sbt


def metric(values: dict, *, new: bool) -> float:
    a, b, c = (values[name] for name in "abc")
    if new and a < 0.25 and c > 0.7:
        return -0.2
    return 1.0 - a - 0.3 * b + (0.05 + 0.1 * np.sin(7.0 * c) if new else 0.0)


def scenario(*, new: bool) -> sbt.Scenario:
    inputs = [sbt.Parameter(name, 0, 1) for name in "abc"]
    return sbt.Scenario(
        "later" if new else "earlier", inputs, sbt.Requirement("y", high=0.0),
        evaluate=lambda values, seed: {"y": float(metric(values, new=new))},
    )  # fmt: skip


def truth() -> float:
    a, b, c = np.random.default_rng(1).random((3, 2_000_000))
    rest = 1.05 - a - 0.3 * b + 0.1 * np.sin(7.0 * c) <= 0.0
    return float(np.mean(rest | ((a < 0.25) & (c > 0.7))))


def campaign(seed: int, gate: float | None) -> dict:
    keys = {"campaign": "estimation", "executor": "serial", "report": False}
    with tempfile.TemporaryDirectory() as folder:
        sbt.run(scenario=scenario(new=False), budget=120, seed=1000 + seed, store=f"{folder}/earlier", **keys)
        asked = {} if gate is None else {"gate": {"probability": gate}}
        found = sbt.run(
            scenario=scenario(new=True), budget=100, seed=seed, store=f"{folder}/later",
            warm_start={"store": f"{folder}/earlier", "transfer": True}, **asked, **keys,
        )  # fmt: skip
        told = found.conclusion
        verdict = None if told.gate is None else told.gate.verdict
        return {"p": told.probability, "low": told.low, "high": told.high, "runs": len(found.frame), "verdict": verdict}


def main() -> None:
    parser = arguments(__doc__, "runs/transfer_region.jsonl", 21)
    parser.add_argument("--gate", action="store_true", help="a gate at 0.9 of the probability")
    args, p = parser.parse_args(), truth()
    rows = collect(args, [{"seed": seed, "gate": 0.9 * p if args.gate else None} for seed in seeds(args)], campaign)
    covered, passed = sum(row["low"] <= p <= row["high"] for row in rows), sum(row["verdict"] == "pass" for row in rows)
    error = np.sqrt(np.mean([(row["p"] / p - 1.0) ** 2 for row in rows]))
    print(f"P {p:.4f}: {covered} of {len(rows)} intervals cover, {passed} gates at 0.9 P pass, relative RMSE {error:.3f}")


if __name__ == "__main__":
    main()

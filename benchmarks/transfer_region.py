"""Does an interval by transfer cover where the new setup has a critical region that the earlier one did not have?

    python benchmarks/transfer_region.py [--seeds 21] [--first 1] [--gate] [--table runs/transfer_region.jsonl]
    python benchmarks/transfer_region.py --egos jump box half [--seeds 10] [--budget 400] [--table runs/two_egos.jsonl]

Three uniform inputs; the new metric has a jump to -0.2 in 7.5 % of the box, beside nearly the same edge as before. The earlier
campaign is an estimation of 120 runs, the new one has 100. `--egos` compares two egos as `compare-ego --rare` does: critical is
what lies beyond a plane, P = .01, with the second one half of it, and as much in a new region behind a jump (`jump`: beyond a
plane of another input, `box`: in a box of two others) or nothing else (`half`).
"""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from resumed import arguments, collect, seeds

import sbt
from sbt.workflows.paired import compare_rare


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


EGOS = '''
import sbt
from scipy.special import ndtri

INPUTS = [sbt.Parameter(name, -6, 6, distribution=sbt.Normal(0, 1)) for name in "abc"]
FAR, SHARES = float(ndtri(0.995)), {"first": 0.01, "box": 0.005 / 0.995}
BOX = [[float(ndtri(c + side * 0.5 * 0.005**0.5)) for side in (-1, 1)] for c in (0.85, 0.2)]
NEW = {
    "first": lambda v: False, "half": lambda v: False, "jump": lambda v: v["b"] < -FAR,
    "box": lambda v: all(low < v[name] < high for name, (low, high) in zip("bc", BOX)),
}


def ego(kind):
    edge = float(ndtri(1.0 - SHARES.get(kind, 0.005)))
    metric = lambda v, seed: {"y": -1.0 if NEW[kind](v) else edge - v["a"]}
    inputs = INPUTS if IN_THREE else INPUTS[:2]
    return sbt.Scenario("ego", inputs, sbt.Requirement("y", high=0.0), evaluate=metric, metrics=["y"])
'''


def compared(kind: str, seed: int, budget: int) -> dict:
    """Return what a comparison of two egos says, and the difference of their probabilities."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "egos.py"
        names = {"A": "first", "B": kind}
        made = "".join(f"{name} = ego({ego!r})\n" for name, ego in names.items())
        source.write_text(f"IN_THREE = {kind == 'box'}\n{EGOS}\n\n{made}")
        for name in names:
            config = {"campaign": "estimation", "scenario": f"{source}:{name}", "seed": seed, "budget": budget}
            (Path(folder) / f"{name}.yaml").write_text(json.dumps(config | {"executor": {"kind": "serial"}}))
        found = compare_rare(Path(folder) / "A.yaml", Path(folder) / "B.yaml", store=Path(folder) / "store")
    keys = {key: found[key] for key in ("verdict", "low", "high", "condition", "open")}
    return keys | {"bound": found["after"]["unmet"], "runs": [found[name]["runs"] for name in ("before", "after")]}


def show_egos(kind: str, rows: list[dict]) -> None:
    """Print a line of the table."""
    change = {"half": -0.005, "jump": -0.005**2, "box": 0.0}[kind]
    said = [f"{sum(row['verdict'] == verdict for row in rows)}" for verdict in ("fell", "rose", "undecided")]
    without = sum(row["verdict"] == "fell" and row["condition"] is None for row in rows)
    covered = sum(row["low"] <= change <= row["high"] for row in rows)
    bound, runs = (np.median([row[key] for row in rows], axis=0) for key in ("bound", "runs"))
    print(
        f"| {kind} | {change:g} | {' | '.join(said)} | {without} | {covered} of {len(rows)} | {bound:.3f} |"
        f" {runs[0]:.0f}, {runs[1]:.0f} |"
    )


def main() -> None:
    parser = arguments(__doc__, "runs/transfer_region.jsonl", 21)
    parser.add_argument("--gate", action="store_true", help="a gate at 0.9 of the probability")
    parser.add_argument("--egos", nargs="+", choices=("jump", "box", "half"), help="compare two egos instead")
    parser.add_argument("--budget", type=int, default=400)
    args = parser.parse_args()
    if args.egos:
        asked = [{"kind": kind, "seed": seed, "budget": args.budget} for kind in args.egos for seed in seeds(args)]
        rows = collect(args, asked, compared)
        print("| new region | change | fell | rose | undecided | fell, no condition | covered | bound (median) | runs (median) |")
        print("|---|---|---|---|---|---|---|---|---|")
        for kind in args.egos:
            show_egos(kind, [row for row in rows if row["kind"] == kind])
        return
    p = truth()
    rows = collect(args, [{"seed": seed, "gate": 0.9 * p if args.gate else None} for seed in seeds(args)], campaign)
    covered, passed = sum(row["low"] <= p <= row["high"] for row in rows), sum(row["verdict"] == "pass" for row in rows)
    error = np.sqrt(np.mean([(row["p"] / p - 1.0) ** 2 for row in rows]))
    print(f"P {p:.4f}: {covered} of {len(rows)} intervals cover, {passed} gates at 0.9 P pass, relative RMSE {error:.3f}")


if __name__ == "__main__":
    main()

"""How many runs does an estimation save that knows an earlier campaign with another reaction time of the ego?

    python benchmarks/transfer.py [--seeds 50] [--cases cut_in,emergency_braking] [--table runs/transfer.jsonl] [--crude 1000]
    python benchmarks/transfer.py --seeds 6 --cases distance,speed,flag,count,plain --ways transfer,scratch

The earlier campaign is an estimation with a reaction time of 0.2 s; the new one, with 0.5 s, starts from scratch and from it,
until its coefficient of variation is 10 % (the default). The truth is that of crude runs, so many for
each seed. Further cases are Python's, with a known truth: what is critical shrinks and turns a little, and the metric is a
distance of 0 in every collision, a speed of impact of 0 without one, a flag, a count of steps, or goes on (`plain`). Finished
cells are lines of the table: run again to go on, or split seeds over processes (`resumed.py`).
"""

from __future__ import annotations

import math
import os
import tempfile
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from resumed import arguments, collect, seeds
from scipy.integrate import quad
from scipy.stats import norm

import sbt
from sbt.estimators.binomial import interval

CASES = {
    "cut_in": {"scenario": "cut_in", "inputs": {"d_v": sbt.Normal(15, 12), "d_t": sbt.LogNormal(1.8, 0.9)}},
    "emergency_braking": {"scenario": "emergency_braking"},
}
METRICS = {
    "plain": lambda y: y, "distance": lambda y: max(y, 0.0), "speed": lambda y: min(5.0 * y, 0.0),
    "flag": lambda y: float(y > 0.0), "count": lambda y: -math.floor(max(-3.0 * y, 0.0) + 1.0) * float(y <= 0.0),
}  # fmt: skip
"""Of the distance from the edge, negative where critical."""


def edge(b: float, moved: float) -> float:
    """Return the a from which on runs are critical."""
    return 2.6 + 0.3 * moved - 0.35 * b * abs(b) - 0.1 * moved * b


def ending(case: str, moved: float) -> sbt.Scenario:
    """Return a problem of two normal inputs, whose edge has moved by so much."""
    def evaluate(values: dict[str, float], seed: int) -> dict[str, float]:
        return {"m": METRICS[case](edge(values["b"], moved) - values["a"])}

    inputs = [sbt.Parameter(name, -5.0, 5.0, "m", sbt.Normal(0.0, 1.0)) for name in "ab"]
    high = {"speed": -0.1, "flag": 0.5, "count": -0.5}.get(case, 0.0)
    return sbt.Scenario(case, inputs, sbt.Requirement("m", high=high), evaluate=evaluate)


def known(case: str) -> float | None:
    """Return P(critical) of the later setup, where it is known."""
    further = 0.02 if case == "speed" else 0.0
    return quad(lambda b: norm.pdf(b) * norm.sf(edge(b, 1.0) + further), -5, 5)[0] if case in METRICS else None


EARLIER, LATER = ({"kind": "acc_aeb", "reaction_time": seconds} for seconds in (0.2, 0.5))


def estimation(case: str, store: Path, *, later: bool = True, **keys) -> sbt.Result:
    """Return the estimation of a case, of the later or the earlier setup."""
    which = CASES[case] | {"ego": LATER if later else EARLIER} if case in CASES else {"scenario": ending(case, float(later))}
    return sbt.run(campaign="estimation", executor="serial", report=False, store=store, **which, **keys)


class Campaigns:
    """Campaigns of every case, with the earlier one of each in a folder: run once, when it is first needed."""

    def __init__(self, folder: Path, budget: int) -> None:
        self._folder, self._budget = folder, budget

    def run(self, case: str, way: str, seed: int, runs: int | None = None) -> dict:
        """Return what a campaign from scratch, by transfer, or of so many crude runs gives."""
        store = self._folder / f"{case}_{way}_{seed}"
        if way == "crude":
            crude = {"acquisition": "monte_carlo", "stop": {"cov": None}, "budget": runs, "seed": 10_000 + seed}
            return {"hits": estimation(case, store, **crude).conclusion.hits}
        warm = {"warm_start": {"store": str(self._earlier(case)), "transfer": True}} if way == "transfer" else {}
        result = estimation(case, store, seed=seed, **warm)
        found = result.conclusion
        kept = {"p": found.probability, "low": found.low, "high": found.high, "cov": found.cov}
        return {"runs": len(result.history), "stopped": result.summary["stopped"], **kept}

    def _earlier(self, case: str) -> Path:
        store = self._folder / f"{case}_earlier"
        if not store.exists():
            estimation(case, store, later=False, seed=1000, budget=self._budget, stop={"cov": None})
        return store


def show(rows: list[dict]) -> None:
    """Print the table."""
    head = "scenario", "truth", "way", "seeds", "median runs", "reached 10 %", "covered", "median CoV", "rel. RMSE"
    print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
    for case in dict.fromkeys(row["case"] for row in rows):
        mine = [row for row in rows if row["case"] == case]
        crude = [row for row in mine if row["way"] == "crude"]
        hits, n = (sum(row[key] for row in crude) for key in ("hits", "runs"))
        truth = hits / n if n else known(case)
        told = "-" if truth is None else f"{truth:.4g}"
        told += " ({:.3g} to {:.3g})".format(*interval(hits, n, 0.95)) if n else ""
        for way in ("scratch", "transfer"):
            found = [row for row in mine if row["way"] == way]
            if not found:
                continue
            covered = "-" if truth is None else f"{sum(row['low'] <= truth <= row['high'] for row in found)} of {len(found)}"
            reached = f"{sum(row['stopped'] == 'cov' for row in found)} of {len(found)}"
            runs, cov = (np.median([row[key] for row in found]) for key in ("runs", "cov"))
            off = "-" if truth is None else f"{np.sqrt(np.mean([(row['p'] / truth - 1.0) ** 2 for row in found])):.3f}"
            print(f"| {case} | {told} | {way} | {len(found)} | {runs:.0f} | {reached} | {covered} | {cov:.3f} | {off} |")


def main() -> None:
    """Run what is missing, and print the table."""
    parser = arguments(__doc__, "runs/transfer.jsonl", 50)
    parser.add_argument("--cases", default=",".join(CASES))
    parser.add_argument("--ways", default="transfer,scratch,crude")
    parser.add_argument("--crude", type=int, default=1000, help="crude runs of each seed")
    parser.add_argument("--budget", type=int, default=300, help="runs of the earlier campaign")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        jobs = [
            {"case": case, "way": way, "seed": seed} | ({"runs": args.crude} if way == "crude" else {})
            for case in args.cases.split(",") for way in args.ways.split(",") for seed in seeds(args)
        ]  # fmt: skip
        rows = collect(args, jobs, Campaigns(Path(name), args.budget).run)
    show(rows)


if __name__ == "__main__":
    main()

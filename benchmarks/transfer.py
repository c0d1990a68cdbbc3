"""How many runs does an estimation save that knows an earlier campaign with another reaction time of the ego?

    python benchmarks/transfer.py [--seeds 50] [--cases cut_in,emergency_braking] [--table runs/transfer.jsonl] [--crude 40000]

The earlier campaign is an estimation with a reaction time of 0.2 s; the new one, with 0.5 s, starts from scratch and from it,
until its coefficient of variation is 10 % (the default). The truth is that of crude runs. Finished cells are lines of the
table: run again to go on; `--show` only prints what is there.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

import sbt

CASES = {
    "cut_in": {"scenario": "cut_in", "inputs": {"d_v": sbt.Normal(15, 12), "d_t": sbt.LogNormal(1.8, 0.9)}},
    "emergency_braking": {"scenario": "emergency_braking"},
}
EARLIER, LATER = ({"kind": "acc_aeb", "reaction_time": seconds} for seconds in (0.2, 0.5))


def estimation(case: str, store: Path, **keys) -> sbt.Result:
    """Return the estimation of a case."""
    return sbt.run(campaign="estimation", executor="serial", report=False, store=store, **CASES[case], **keys)


def crude(case: str, n: int, folder: Path) -> dict:
    """Return the truth by n crude runs."""
    given = {"acquisition": "monte_carlo", "stop": {"cov": None}, "budget": n, "seed": 101}
    found = estimation(case, folder / "crude", ego=LATER, **given).conclusion
    return {"case": case, "way": "crude", "seed": 101, "runs": n, "p": found.probability, "low": found.low, "high": found.high}


def campaign(case: str, way: str, seed: int, earlier: Path, folder: Path) -> dict:
    """Return what a campaign from scratch or by transfer gives."""
    warm = {"warm_start": {"store": str(earlier), "transfer": True}} if way == "transfer" else {}
    result = estimation(case, folder / f"{way}_{seed}", ego=LATER, seed=seed, **warm)
    found = result.conclusion
    kept = {"p": found.probability, "low": found.low, "high": found.high, "cov": found.cov}
    return {"case": case, "way": way, "seed": seed, "runs": len(result.history), "stopped": result.summary["stopped"], **kept}


def show(rows: list[dict]) -> None:
    """Print the table."""
    print("| scenario | truth (crude) | way | seeds | median runs | reached 10 % | covered | median CoV |\n|" + "---|" * 8)
    for case in dict.fromkeys(row["case"] for row in rows):
        mine = [row for row in rows if row["case"] == case]
        truth = next((row for row in mine if row["way"] == "crude"), None)
        told = "-" if truth is None else f"{truth['p']:.4g} ({truth['low']:.3g} to {truth['high']:.3g})"
        for way in ("scratch", "transfer"):
            found = [row for row in mine if row["way"] == way]
            if not found:
                continue
            covered = "-" if truth is None else f"{sum(row['low'] <= truth['p'] <= row['high'] for row in found)} of {len(found)}"
            reached = f"{sum(row['stopped'] == 'cov' for row in found)} of {len(found)}"
            runs, cov = (np.median([row[key] for row in found]) for key in ("runs", "cov"))
            print(f"| {case} | {told} | {way} | {len(found)} | {runs:.0f} | {reached} | {covered} | {cov:.3f} |")


def main() -> None:
    """Run what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--first", type=int, default=0, help="first seed, to split them over processes with a table each")
    parser.add_argument("--cases", default=",".join(CASES))
    parser.add_argument("--crude", type=int, default=40_000)
    parser.add_argument("--budget", type=int, default=300, help="runs of the earlier campaign")
    parser.add_argument("--table", type=Path, default=Path("runs/transfer.jsonl"))
    parser.add_argument("--show", action="store_true")
    args = parser.parse_args()
    args.table.parent.mkdir(parents=True, exist_ok=True)
    rows = [json.loads(line) for line in args.table.read_text().splitlines()] if args.table.is_file() else []

    def keep(row: dict) -> None:
        rows.append(row)
        with args.table.open("a") as file:
            file.write(json.dumps(row) + "\n")

    for case in () if args.show else args.cases.split(","):
        done = {(row["way"], row["seed"]) for row in rows if row["case"] == case}
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            estimation(case, folder / "earlier", ego=EARLIER, seed=1000, budget=args.budget, stop={"cov": None})
            for seed in range(args.first, args.seeds):
                for way in ("transfer", "scratch"):
                    if (way, seed) not in done:
                        keep(campaign(case, way, seed, folder / "earlier", folder))
            if args.crude and ("crude", 101) not in done:
                keep(crude(case, args.crude, folder))
    show(rows)


if __name__ == "__main__":
    main()

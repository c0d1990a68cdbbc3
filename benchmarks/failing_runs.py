"""Do campaigns avoid runs that fail, and are they as good as where none fails?

    python benchmarks/failing_runs.py [--seeds 20] [--only falsification,boundary]

Each testbed in which a part of the box gives no metric, beside the same one in which every run does. `failed` is the share of
the guided runs (neither initial nor held-out nor space-filling ones) that failed; at random it would be the share of the box.
Falsification: runs to the first critical one and critical runs of 150. Boundary: F1 after 300 runs on 20,000 random points of
the part that gives a metric.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator

import numpy as np

import sbt
from sbt.metamodels.scores import scores
from sbt.seeds import stream
from sbt.testbeds import find

PAIRS = {
    "falsification": (("needle_half_fails", "needle_d4_1e-3"), ("hartmann6_third_fails", "hartmann6_1e-3")),
    "boundary": (("wavy_half_fails", "wavy_level_d3"), ("hartmann6_third_fails", "hartmann6_1e-3")),
}
BUDGET = {"falsification": 150, "boundary": 300}


def cells(campaign: str, testbed: str, seeds: int) -> Iterator[dict[str, float]]:
    for seed in range(seeds):
        with tempfile.TemporaryDirectory() as folder:
            result = sbt.run(
                campaign=campaign, scenario=f"testbed:{testbed}", seed=seed, budget=BUDGET[campaign], executor="serial",
                store=f"{folder}/store", report=False,
            )  # fmt: skip
            frame = result.frame
            guided = frame[frame.stage.isin(["search", "boundary"])]
            found = {"failed": float((guided.status != "ok").mean())}
            hit = np.flatnonzero(frame.critical.fillna(False).to_numpy(bool))
            found |= {"first": float(hit[0] + 1) if len(hit) else np.inf, "critical": float(len(hit))}
            if campaign == "boundary":
                found["f1"] = f1(result, testbed)
            yield found


def f1(result: sbt.Result, testbed: str) -> float:
    problem, space = find(testbed), result.scenario.space
    x = space.from_unit(stream(7, "reference", testbed).random((20_000, space.dimension)))
    y = problem.function(x)
    ok = np.isfinite(y)
    return float(scores(result.fitted.predict(space.to_unit(x[ok])), y[ok], problem.critical)["f1"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--only", default="falsification,boundary")
    args = parser.parse_args()
    print("| campaign | testbed | failed, median (worst) | first critical, median | no hit | critical runs, mean | F1, median |")
    print("|---|---|---|---|---|---|---|")
    for campaign in args.only.split(","):
        for testbed in (name for pair in PAIRS[campaign] for name in pair):
            rows = list(cells(campaign, testbed, args.seeds))
            failed, first, critical = (np.array([r[k] for r in rows]) for k in ("failed", "first", "critical"))
            quality = f"{np.median([r['f1'] for r in rows]):.3f}" if campaign == "boundary" else "-"
            print(
                f"| {campaign} | `{testbed}` | {np.median(failed):.2f} ({failed.max():.2f}) | {np.median(first):g} | "
                f"{np.isinf(first).sum()} of {len(rows)} | {critical.mean():.1f} | {quality} |", flush=True,
            )  # fmt: skip


if __name__ == "__main__":
    main()

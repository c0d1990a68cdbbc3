"""Does an active campaign find the boundary better than evenly distributed runs? Scored on one common reference set.

    python benchmarks/boundary.py [--scenario cut_in] [--seeds 10] [--budget 200] [--reference 20000]
                                 [--acquisition mix]

For each seed two campaigns of equal budget run in SUMO: `boundary` and `coverage`, with the same
metamodel. After each batch the metamodel is fitted to the runs so far and scored on pseudo-random
reference runs that no campaign saw. `on the boundary` is the share of a campaign's runs, the first
batch left out, that have both critical and uncritical reference runs among the ones within 0.02 of
the unit cube's diagonal.
"""

from __future__ import annotations

import argparse
import os
import tempfile

import numpy as np
from scipy.spatial import cKDTree

import sbt
from sbt.execution.local import LocalExecutor
from sbt.execution.spec import ScenarioSpec
from sbt.metamodels.scores import scores
from sbt.problem.arrays import Points, Vector
from sbt.problem.outcome import Job
from sbt.problem.scenario import LogicalScenario
from sbt.seeds import run_seed, stream

METRICS = ("precision_at_recall_90", "average_precision", "f1", "log_likelihood_critical", "calibration_error")


def run(args: argparse.Namespace, campaign: str, seed: int, folder: str) -> sbt.Result:
    return sbt.run(
        campaign=campaign, scenario=args.scenario, seed=seed, budget=args.budget, initial=args.batch, batch=args.batch,
        metamodel=args.metamodel, validation={"share": 0.0}, acquisition=args.acquisition if campaign == "boundary" else "even",
        store=f"{folder}/store", report=False,
    )  # fmt: skip


def reference_set(args: argparse.Namespace, scenario: LogicalScenario) -> tuple[Points, Vector]:
    """Return x (n, d) and the metric (n,) of the reference runs, without those that failed."""
    space = scenario.space
    x = space.from_unit(stream(99, "reference").random((args.reference, space.dimension)))
    jobs = [Job(i, dict(zip(space.names, map(float, row), strict=True)), run_seed(99, i)) for i, row in enumerate(x)]
    y = np.full(len(x), np.nan)
    with LocalExecutor(ScenarioSpec(args.scenario), os.cpu_count() or 1, 60.0) as executor:
        for outcome in executor.run(jobs):
            y[outcome.index] = outcome.metrics.get(scenario.requirement.metric, np.nan)
    good = np.isfinite(y)
    return x[good], y[good]


def on_boundary(x: Points, reference: tuple[Points, Vector], scenario: LogicalScenario, radius: float) -> float:
    space, critical = scenario.space, scenario.requirement.critical.contains(reference[1])
    tree = cKDTree(space.to_unit(reference[0]))
    near = tree.query_ball_point(space.to_unit(x), radius * np.sqrt(space.dimension))
    return float(np.mean([len(i) > 0 and critical[i].any() and not critical[i].all() for i in near]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="cut_in")
    parser.add_argument("--metamodel", default="gp")
    parser.add_argument("--acquisition", default="mix", help="of the campaign boundary; `boundary`: the paper's rule")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--budget", type=int, default=200)
    parser.add_argument("--batch", type=int, default=50)
    parser.add_argument("--reference", type=int, default=20000)
    args = parser.parse_args()
    reference, rows, shares = None, {}, {"boundary": [], "coverage": []}
    for seed in range(args.seeds):
        for campaign in shares:
            with tempfile.TemporaryDirectory() as folder:
                result = run(args, campaign, seed, folder)
                learner, scenario, history = result.study.learner, result.scenario, result.history
                reference = reference or reference_set(args, scenario)
            for n in range(args.batch, args.budget + 1, args.batch):
                runs = history.where(np.arange(len(history)) < n).finished
                prediction = learner.on_inputs(learner.train(runs), len(runs))(scenario.space.to_unit(reference[0]))
                found = scores(prediction, reference[1], scenario.requirement.critical)
                for metric in METRICS:
                    rows.setdefault((n, campaign), {}).setdefault(metric, []).append(found[metric])
            shares[campaign].append(on_boundary(history.x[args.batch :], reference, scenario, 0.02))
    base = scenario.requirement.critical.contains(reference[1]).mean()
    print(f"{args.scenario}, {args.metamodel}, {args.seeds} seeds, {len(reference[1])} reference runs, base rate {base:.4f}\n")
    print("| runs | campaign | " + " | ".join(METRICS) + " |\n|---|---|" + "---|" * len(METRICS))
    for (n, campaign), found in sorted(rows.items()):
        cells = [f"{np.median(v):.3f} ({np.min(v):.3f} to {np.max(v):.3f})" for v in found.values()]
        print(f"| {n} | {campaign} | " + " | ".join(cells) + " |")
    print("\n| campaign | on the boundary: mean (min to max) |\n|---|---|")
    for campaign, values in shares.items():
        print(f"| {campaign} | {np.mean(values):.3f} ({np.min(values):.3f} to {np.max(values):.3f}) |")


if __name__ == "__main__":
    main()

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
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from sbt.config.load import parse
from sbt.execution.local import LocalExecutor
from sbt.loop.learner import Learner
from sbt.problem.outcome import Job
from sbt.seeds import run_seed, stream
from sbt.store.database import Store
from sbt.store.history import VALIDATION, History, Record
from sbt.workflows.running import assembly_of, run_campaign, settings_of

METRICS = ("precision_at_recall_90", "average_precision", "f1", "log_likelihood_critical", "calibration_error")


def configuration(args: argparse.Namespace, campaign: str, seed: int, folder: str) -> str:
    kind = args.acquisition if campaign == "boundary" else "even"
    return (
        f"campaign: {campaign}\nscenario: {args.scenario}\nseed: {seed}\nbudget: {args.budget}\ninitial: {args.batch}\n"
        f"batch: {args.batch}\nmetamodel: {{kind: {args.metamodel}}}\nvalidation: {{share: 0}}\nstore: {folder}\n"
        f"acquisition: {{kind: {kind}}}\n"
    )


def reference_set(args: argparse.Namespace, learner: Learner) -> History:
    loaded = parse(configuration(args, "coverage", 0, "unused"))
    parts, space = assembly_of(loaded), learner.scenario.space
    x = space.from_unit(stream(99, "reference").random((args.reference, space.dimension)))
    jobs = [Job(i, dict(zip(space.names, map(float, row), strict=True)), run_seed(99, i)) for i, row in enumerate(x)]
    records = []
    with LocalExecutor(parts.spec, os.cpu_count() or 1, 60.0) as executor:
        for o in executor.run(jobs):
            job = jobs[o.index]
            row = (o.index, VALIDATION, 0, job.inputs, job.seed, str(o.status), o.metrics, o.reason, None, 0.0, "", "")
            records.append(Record(*row))
    return History(space.names, tuple(sorted(records, key=lambda r: r.index)))


def on_boundary(history: History, reference: History, learner: Learner, radius: float) -> float:
    space, requirement = learner.scenario.space, learner.scenario.requirement
    tree = cKDTree(space.to_unit(reference.x))
    critical = requirement.critical.contains(reference.y(requirement.metric))
    near = tree.query_ball_point(space.to_unit(history.x), radius * np.sqrt(space.dimension))
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
                loaded = parse(configuration(args, campaign, seed, str(Path(folder) / "store")))
                run_campaign(loaded, report=False)
                learner = settings_of(loaded, assembly_of(loaded)).learner
                reference = reference or reference_set(args, learner)
                with Store.read(Path(folder) / "store") as store:
                    history = store.history()
            for n in range(args.batch, args.budget + 1, args.batch):
                seen = replace(history, records=history.records[:n])
                belief = learner.fit(History(history.names, seen.records + reference.records))
                for metric in METRICS:
                    rows.setdefault((n, campaign), {}).setdefault(metric, []).append(belief.scores[metric])
            later = replace(history, records=history.records[args.batch :])
            shares[campaign].append(on_boundary(later, reference, learner, 0.02))
    y = reference.y(learner.scenario.requirement.metric)
    base = learner.scenario.requirement.critical.contains(y).mean()
    print(f"{args.scenario}, {args.metamodel}, {args.seeds} seeds, {len(reference)} reference runs, base rate {base:.4f}\n")
    print("| runs | campaign | " + " | ".join(METRICS) + " |\n|---|---|" + "---|" * len(METRICS))
    for (n, campaign), found in sorted(rows.items()):
        cells = [f"{np.median(v):.3f} ({np.min(v):.3f} to {np.max(v):.3f})" for v in found.values()]
        print(f"| {n} | {campaign} | " + " | ".join(cells) + " |")
    print("\n| campaign | on the boundary: mean (min to max) |\n|---|---|")
    for campaign, values in shares.items():
        print(f"| {campaign} | {np.mean(values):.3f} ({np.min(values):.3f} to {np.max(values):.3f}) |")


if __name__ == "__main__":
    main()

"""How much the metric changes when the simulation step is halved, against its noise between seeds.

    python benchmarks/step_length.py [--scenario cut_in] [--points 300] [--seeds 8] [--reference 0.005]

Every Sobol point runs with the same seeds at every step. The noise is the standard deviation of the
metric over the seeds at the scenario's own step, measured where the metric is neither at an end of its
scale nor 0. The last line is the row of the table in docs/scenarios.md.
"""

from __future__ import annotations

import argparse
import os

import numpy as np
from scipy.stats import qmc

from sbt.execution.local import LocalExecutor
from sbt.execution.spec import ScenarioSpec
from sbt.problem.outcome import Job


def metric_at(name: str, step: float, x: np.ndarray, seeds: int) -> np.ndarray:
    """Return the (points, seeds) metric of the requirement at one step length."""
    spec = ScenarioSpec(name, step_length=step)
    scenario = spec.resolve()
    jobs = [
        Job(i * seeds + s, dict(zip(scenario.space.names, map(float, row), strict=True)), s)
        for i, row in enumerate(x) for s in range(seeds)
    ]  # fmt: skip
    y = np.full(len(jobs), np.nan)
    with LocalExecutor(spec, os.cpu_count() or 1, 120.0) as executor:
        for outcome in executor.run(jobs):
            y[outcome.index] = outcome.metrics[scenario.requirement.metric]
    return y.reshape(len(x), seeds)


def traffic(args: argparse.Namespace, x: np.ndarray) -> None:
    """Print how far the mean over seeds moves as the own step is halved, beside the spread and what it alone explains.

    With random drivers another step means other random numbers too: even without any effect of the step the
    means differ, by the spread times sqrt(2 / seeds).
    """
    scenario = ScenarioSpec(args.scenario).resolve()
    own = scenario.simulate.step_length
    steps = [own, own / 2, *([own / 4] if (250 * own).is_integer() else [])]  # SUMO counts whole milliseconds
    y = {step: metric_at(args.scenario, step, x, args.seeds) for step in steps}
    spread = y[own].std(axis=1, ddof=1)
    critical = scenario.requirement.critical
    print(f"{args.scenario}: {args.points} Sobol points x {args.seeds} seeds; spread over seeds: median {np.median(spread):.3f}, "
          f"mean {spread.mean():.3f}\n")
    print("| step (s) | mean metric | critical share | change to the step above: bias | mean change of a point "
          "| explained by the spread | points below their spread |\n|---|---|---|---|---|---|---|")
    above = None
    for step, values in y.items():
        share = float(critical.contains(values.ravel()).mean())
        row = f"| {step:g} | {values.mean():.3f} | {100 * share:.2f} % |"
        if above is None:
            print(row + " | | | |")
        else:
            change = values.mean(axis=1) - above.mean(axis=1)
            moves = spread > 0
            noise = np.sqrt(2 / args.seeds) * np.sqrt(2 / np.pi) * spread.mean()
            below = float((np.abs(change)[moves] < spread[moves]).mean())
            print(row + f" {change.mean():+.3f} +- {change.std(ddof=1) / np.sqrt(len(x)):.3f} | {np.abs(change).mean():.3f} "
                  f"| {noise:.3f} | {100 * below:.0f} % |")
        above = values


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="cut_in")
    parser.add_argument("--points", type=int, default=300)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--reference", type=float, default=0.005, help="finest step (s)")
    parser.add_argument("--traffic", action="store_true", help="random traffic: halve the own step twice, spread over seeds")
    args = parser.parse_args()
    scenario = ScenarioSpec(args.scenario).resolve()
    u = qmc.Sobol(scenario.space.dimension, rng=3).random(args.points)
    if args.scenario == "cut_in":  # most of the plane is uneventful: half of the points where it is not
        u[::2, 1] *= 0.35
    x = scenario.space.from_unit(u)
    if args.traffic:
        traffic(args, x)
        return
    y = {step: metric_at(args.scenario, step, x, args.seeds) for step in (0.1, 0.05, 0.025, args.reference)}
    own, critical = y[0.05], scenario.requirement.critical
    moving = np.ones(len(x), dtype=bool)
    if scenario.requirement.metric == "ttc_min":
        moving = (own > 0).all(axis=1) & (own < 9.9).all(axis=1)
    noise = own.std(axis=1, ddof=1)[moving]

    def changes(a: float, b: float) -> tuple[float, ...]:
        """Return median, mean and 95th percentile of how far the mean over the seeds moves, shares below the noise and sides."""
        change = np.abs(y[a].mean(axis=1) - y[b].mean(axis=1))[moving]
        sides = float((critical.contains(y[a].ravel()) != critical.contains(y[b].ravel())).mean())
        below = float((change <= noise).mean())
        return np.median(change), change.mean(), np.quantile(change, 0.95), below, sides

    print(f"{args.scenario}: {args.points} points x {args.seeds} seeds, noise at 0.05 s ({moving.sum()} points): "
          f"median sd {np.median(noise):.4f}, mean sd {noise.mean():.4f}\n")
    print("| step (s) against another | median change | mean change | 95th percentile | share below the noise | sides changed |")
    print("|---|---|---|---|---|---|")
    for a, b in ((0.1, args.reference), (0.05, args.reference), (0.025, args.reference), (0.1, 0.05), (0.05, 0.025)):
        print(f"| {a:g} against {b:g} | " + " | ".join(f"{value:.4f}" for value in changes(a, b)) + " |")
    median, mean, _, below, sides = changes(0.05, 0.025)
    print(f"\n| {args.scenario} | {args.points} x {args.seeds} | {np.median(noise):.4f} | {noise.mean():.4f} | {median:.4f} "
          f"| {mean:.4f} | {100 * below:.0f} % | {round(sides * own.size)} of {own.size} |")


if __name__ == "__main__":
    main()

"""How often runs of the built-in scenarios break a law of motion (`sbt.metrics.physics`), for every kind of ego.

    python benchmarks/physics.py [NAME ...] [--runs 1000] [--others 200] [--egos IDM,EIDM]

Sobol points (seed 11), seeds 0, 1, ...: `--runs` with the scenario's own ego, `--others` with each other kind it admits.
Prints a line for every law that a run breaks, a table of the worst values by scenario, and the shares of runs without a breach.
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

import numpy as np

import sbt
from sbt import InputError, RunError
from sbt.execution.spec import ScenarioSpec
from sbt.metrics.physics import LAWS, worst
from sbt.problem.scenario import LogicalScenario
from sbt.samplers.sobol import SobolSequence

EGOS: dict[str, dict[str, Any]] = {
    "acc_aeb": {"kind": "acc_aeb"},
    **{model: {"kind": "sumo", "model": model} for model in ("Krauss", "IDM", "EIDM", "ACC", "CACC", "W99")},
}
SEED = 11


def measure(scenario: LogicalScenario, runs: int) -> tuple[np.ndarray, dict[str, list[str]], int]:
    """Return the (runs, laws) worst values, who had them, and how many runs failed."""
    scripted = (scenario.roles.other or "",)
    points = scenario.space.from_unit(SobolSequence(scenario.space.dimension, SEED).points(0, runs))
    values, who, failed = np.full((runs, len(LAWS)), -np.inf), {law: [""] * runs for law in LAWS}, 0
    for k, point in enumerate(points):
        try:
            trace = scenario.simulate(dict(zip(scenario.space.names, point.tolist(), strict=True)), k)
        except RunError as error:
            failed += 1
            print(f"{scenario.name}, run {k}: {error}", file=sys.stderr)
            continue
        for j, law in enumerate(LAWS):
            values[k, j], who[law][k], _ = worst(trace, law, scripted)
    return values, who, failed


def egos(scenario: LogicalScenario, wanted: list[str]) -> dict[str, LogicalScenario]:
    """Return the scenario with its own ego and with every other kind that it admits."""
    found = {"own": scenario}
    for name in wanted:
        try:
            other = scenario.configured(ego=EGOS[name])
            other.simulate({p.name: p.centre for p in other.space.parameters}, 0)
        except (InputError, RunError):
            continue  # it says why: the scenario is about sensors that this ego lacks
        found[name] = other
    return found


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="scenarios; default: all built-in ones")
    parser.add_argument("--runs", type=int, default=1000, help="with the scenario's own ego")
    parser.add_argument("--others", type=int, default=200, help="with each other kind of ego")
    parser.add_argument("--egos", default=",".join(EGOS), help="the other kinds")
    args = parser.parse_args()
    print("| scenario | ego | runs | without a breach | " + " | ".join(LAWS) + " |\n|---" + "|---" * (len(LAWS) + 3) + "|")
    for name in args.names or sbt.list("scenarios"):
        for kind, scenario in egos(ScenarioSpec(name).resolve(), [e for e in args.egos.split(",") if e]).items():
            runs = args.runs if kind == "own" else args.others
            if runs == 0:
                continue
            values, who, failed = measure(scenario, runs)
            limits = np.array([law.limit for law in LAWS.values()])
            broken = values > limits
            cells = []
            for j, law in enumerate(LAWS):
                cell = "-" if np.isinf(values[:, j]).all() else f"{max(values[:, j].max(), 0.0):.3g}"
                if broken[:, j].any():
                    users = sorted({who[law][k].rstrip("_0123456789") for k in np.flatnonzero(broken[:, j])})
                    cell += f" ({100 * broken[:, j].mean():.1f} %: {', '.join(users)})"
                cells.append(cell)
            kept = 100 * (1 - broken.any(axis=1).mean())
            lost = f" ({failed} failed)" if failed else ""
            print(f"| {name} | {kind} | {runs}{lost} | {kept:.1f} % | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()

"""How jagged ttc_min is along one input, and what of it is the radar's noise.

    python benchmarks/slice_teeth.py [--scenario emergency_braking] [--points 8] [--values 31]

Slices through the first Sobol points with 0.1 s < ttc_min < 2 s, over a fifth of the range of every input, one
seed a slice. A tooth is the second difference of three values in a row, none of them a collision.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.stats import qmc

from sbt.execution.spec import ScenarioSpec
from sbt.problem.scenario import LogicalScenario

EGOS = {
    "as it is": {},
    "smoothing: 0.3": {"smoothing": 0.3},
    "no noise": {"gap_noise": 0.0, "speed_noise": 0.0},
}


def values(scenario: LogicalScenario, work: list[tuple[dict[str, float], int]]) -> np.ndarray:
    """Return ttc_min of every run."""
    return np.array([scenario.measure(trace)["ttc_min"] for trace in scenario.simulate.simulate_many(work)])


def centres(scenario: LogicalScenario, n: int) -> list[tuple[dict[str, float], int]]:
    """Return inputs and seeds of runs that come close without a collision."""
    x = scenario.space.from_unit(qmc.Sobol(scenario.space.dimension, rng=5).random(256))
    work = [(dict(zip(scenario.space.names, map(float, row), strict=True)), k) for k, row in enumerate(x)]
    y = values(scenario, work)
    return [work[k] for k in np.flatnonzero((y > 0.1) & (y < 2.0))[:n]]


def teeth(scenario: LogicalScenario, around: list[tuple[dict[str, float], int]], n: int) -> np.ndarray:
    """Return the second differences of all slices."""
    found = []
    for inputs, seed in around:
        for p in scenario.space.parameters:
            half = 0.1 * (p.high - p.low)
            line = np.linspace(max(p.low, inputs[p.name] - half), min(p.high, inputs[p.name] + half), n)
            y = values(scenario, [({**inputs, p.name: float(value)}, seed) for value in line])
            low = np.minimum(np.minimum(y[:-2], y[1:-1]), y[2:])
            found.append(np.abs(np.diff(y, 2))[(low > 0.0) & (y[1:-1] < 2.0)])
    return np.concatenate(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="emergency_braking")
    parser.add_argument("--points", type=int, default=8)
    parser.add_argument("--values", type=int, default=31)
    args = parser.parse_args()
    scenario = ScenarioSpec(args.scenario).resolve()
    around = centres(scenario, args.points)
    print(f"{args.scenario}: {len(around)} points, {args.values} values along each input\n")
    print("| ego | median tooth (s) | mean (s) | 90 % | 99 % |\n|---|---|---|---|---|")
    for name, settings in EGOS.items():
        ego = {"kind": "acc_aeb", **dict(scenario.simulate.ego.settings), **settings}
        found = teeth(scenario.configured(ego=ego), around, args.values)
        figures = (np.median(found), found.mean(), np.quantile(found, 0.9), np.quantile(found, 0.99))
        print(f"| {name} | " + " | ".join(f"{value:.4f}" for value in figures) + " |", flush=True)


if __name__ == "__main__":
    main()

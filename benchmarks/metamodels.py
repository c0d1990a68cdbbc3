"""The metamodels: seconds to fit and predictions per second, or quality on recorded runs, as a markdown table.

OMP_NUM_THREADS=1 python benchmarks/metamodels.py --rows 50 200 500 --inputs 2 7
OMP_NUM_THREADS=1 python benchmarks/metamodels.py --jaywalking FOLDER --rows 200 500 1000 --seeds 5
OMP_NUM_THREADS=1 python benchmarks/metamodels.py --store FOLDER --rows 1000 10000 --seeds 2
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import sbt
from sbt.metamodels.base import Metamodel, build
from sbt.metamodels.scores import scores
from sbt.problem.requirement import CriticalInterval
from sbt.seeds import stream

FAST = ("et", "et paper", "gp", "gp paper", "ensemble", "auto")
SCORES = {
    "log_likelihood": "ll",
    "log_likelihood_mixture": "ll mixture",
    "rmse": "RMSE",
    "average_precision": "AP",
    "precision_at_recall_90": "P@R90",
    "calibration_error": "ECE",
    "coverage_95": "cov95",
    "log_likelihood_critical": "ll critical",
}


def main() -> None:
    """Print the table."""
    classes = {name: getattr(sbt.metamodels, name) for name in sbt.list("metamodels")}
    kinds = {name: build(kind) for name, kind in classes.items()}
    for name, kind in classes.items():
        for preset in getattr(kind, "PRESETS", {}):
            kinds[f"{name} {preset}"] = build(kind, preset)
    parser = argparse.ArgumentParser(description="Time or score the metamodels.")
    parser.add_argument("--kinds", nargs="+", choices=kinds, default=list(FAST))
    parser.add_argument("--rows", nargs="+", type=int, default=[50, 200, 500], help="numbers of rows n")
    parser.add_argument("--inputs", nargs="+", type=int, default=[2, 7], help="numbers of inputs d (timing only)")
    parser.add_argument("--points", type=int, default=8192, help="points predicted at a time")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="cpu", help="of the metamodels that have one")
    parser.add_argument("--repeat", type=int, default=3, help="the median of so many is shown (timing only)")
    parser.add_argument("--jaywalking", type=Path, help="folder of the recorded runs: scores on all rows not learned from")
    parser.add_argument("--store", type=Path, help="folder of a campaign, best of evenly spread runs: the same with its runs")
    parser.add_argument("--seeds", type=int, default=3, help="random splits, the mean is shown")
    parser.add_argument("--first-seed", type=int, default=100)
    args = parser.parse_args()
    chosen = {kind: _on(kinds[kind], args.device) for kind in args.kinds}
    if args.jaywalking is not None:
        _print_quality(chosen, *_read_jaywalking(args.jaywalking), CriticalInterval(high=0.0), args)
    elif args.store is not None:
        _print_quality(chosen, *_read_store(args.store), args)
    else:
        _print_times(chosen, args)


def _on(metamodel: Metamodel, device: str) -> Metamodel:
    """Return the metamodel on a device, where it has one."""
    return replace(metamodel, device=device) if hasattr(metamodel, "device") else metamodel


def _print_times(kinds: dict[str, Metamodel], args: argparse.Namespace) -> None:
    print("| metamodel | d | n | fit [s] | predictions/s |")
    print("|---|---|---|---|---|")
    for kind, metamodel in kinds.items():
        for d in args.inputs:
            for n in args.rows:
                rng = stream(0, "benchmark", n, d)
                u, asked = rng.random((n, d)), rng.random((args.points, d))
                y = _time_to_collision(u, rng)
                metamodel.fit(u[:20], y[:20], stream(0, "warm up"))(asked[:20])
                runs = [_run(metamodel, u, y, asked, i)[1:] for i in range(args.repeat)]
                fit_s, predict_s = np.median(runs, axis=0)
                print(f"| {kind} | {d} | {n} | {fit_s:.2f} | {args.points / predict_s:,.0f} |", flush=True)


def _print_quality(
    kinds: dict[str, Metamodel], u: np.ndarray, y: np.ndarray, critical: CriticalInterval, args: argparse.Namespace
) -> None:
    print(f"Mean of {args.seeds} random splits (seeds {args.first_seed} to {args.first_seed + args.seeds - 1}); CPU seconds.\n")
    print(f"| n | metamodel | {' | '.join(SCORES.values())} | fit [s] | predictions/s |")
    print(f"|{'---|' * (len(SCORES) + 4)}")
    for n in args.rows:
        for kind, metamodel in kinds.items():
            table = []
            for seed in range(args.first_seed, args.first_seed + args.seeds):
                order = np.random.default_rng(seed).permutation(len(y))
                train, test = order[:n], order[n:]
                asked = np.resize(u[test], (args.points, u.shape[1]))
                predictor, fit_s, predict_s = _run(metamodel, u[train], y[train], asked, seed)
                found = scores(predictor(u[test]), y[test], critical)
                table.append([*(found[key] for key in SCORES), fit_s, args.points / predict_s])
            *quality, fit_s, speed = np.mean(table, axis=0)
            cells = " | ".join(f"{value:.3f}" for value in quality)
            print(f"| {n} | {kind} | {cells} | {fit_s:.1f} | {speed:,.0f} |", flush=True)


def _run(metamodel: Metamodel, u: np.ndarray, y: np.ndarray, asked: np.ndarray, seed: int):
    """Return a predictor and the seconds of its fit and of its predictions at `asked`; with a device, of the clock."""
    clock = time.process_time if getattr(metamodel, "device", "cpu") == "cpu" else time.perf_counter
    start = clock()
    predictor = metamodel.fit(u, y, stream(0, "fit", seed))
    fitted = clock()
    predictor(asked)
    return predictor, fitted - start, clock() - fitted


def _read_jaywalking(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the recorded runs: inputs in the unit cube and the metric min_dist* (critical below 0)."""
    import pandas as pd
    from ruamel.yaml import YAML

    inputs = YAML(typ="safe").load((folder / "config.yml").read_text())["inputs"]
    table = pd.read_parquet(folder / "quasi_random.parquet")  # needs the extra "parquet"
    u = np.stack([(table[name] - i["min"]) / (i["max"] - i["min"]) for name, i in inputs.items()], axis=1)
    return u, table["min_dist*"].to_numpy()


def _read_store(folder: Path) -> tuple[np.ndarray, np.ndarray, CriticalInterval]:
    """Return the finished runs of a campaign: inputs in the unit cube, the metric, what is critical."""
    result = sbt.open(folder)
    scenario, runs = result.scenario, result.history.finished
    u = scenario.space.metamodel_inputs(scenario.space.to_unit(runs.x))
    return u, runs.y(scenario.requirement.metric), scenario.requirement.critical


def _time_to_collision(u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a metric as simulations give it: smooth in parts, clipped at 10 s, noisier when near."""
    gap, closing = 5 + 60 * u[:, 0], -5 + 25 * u[:, -1]
    ttc = np.where(closing > 0, gap / np.maximum(closing, 0.1), 10.0)
    return np.clip(ttc + rng.normal(scale=0.1 + 0.5 * (ttc < 3), size=len(u)), -10.0, 10.0)


if __name__ == "__main__":
    main()

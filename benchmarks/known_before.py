"""How well fresh pairs of inputs and seed are predicted, and how well they could be: the tables in docs/measured/traffic.md.

    python benchmarks/known_before.py unprotected_left_turn --runs 5000 --into pairs     # random pairs, kept there
    python benchmarks/known_before.py unprotected_left_turn --again 40 --into pairs      # critical ones, other drivers
    python benchmarks/known_before.py unprotected_left_turn --show --into pairs          # the table

Pairs in the folder are not run again. Learned from some of them, tested on others: average precision of critical ones.

The ceiling is what the best prediction from (inputs, what the seed drew at the start) could reach. A pair is run again with its
scene and other seeds of SUMO. The k critical ones of K such runs of critical pairs are a mixture of binomials whose
distribution G of P(critical | pair) is that of critical pairs; where pairs are ranked by it, precision at P >= t is
G(P >= t) / E_G[1(P >= t) / P], and its mean over G is the largest average precision (Kiefer and Wolfowitz 1956 for G).
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from sklearn.metrics import average_precision_score

from sbt.errors import RunError
from sbt.execution.spec import ScenarioSpec
from sbt.metamodels.bootstrap import out_of_bag
from sbt.metamodels.risk import fit_risk
from sbt.problem.arrays import Points, Vector
from sbt.problem.covariates import Covariates
from sbt.problem.scenario import LogicalScenario
from sbt.samplers.noise import scores
from sbt.seeds import run_seed, stream

NAMES = ("unprotected_left_turn", "highway_merge", "roundabout_entry", "crossing_pedestrian")
PIECE = 500
"""Pairs of a file."""
GRID = np.geomspace(1e-3, 0.999, 60)
"""P(critical | pair) that the mixture of binomials is made of."""


def metric_of(scenario: LogicalScenario, values: Any, drawn: int, drivers: int) -> float:
    """Return the metric of a pair whose scene one seed draws, with the drivers' noise of another; NaN where the run fails."""
    simulate: Any = scenario.simulate

    def scene(values: Any, ego: Any, rng: np.random.Generator) -> Any:
        del rng
        return simulate.scene(values, ego, stream(drawn, "scene"))

    try:
        found = scenario.measure(replace(simulate, scene=scene)(values, drivers))
    except RunError:
        return float("nan")
    return found[scenario.requirement.metric]


def record(scenario: LogicalScenario, runs: int, folder: Path) -> None:
    """Run random pairs until so many are in the folder."""
    for piece in range(-(-runs // PIECE)):
        path = folder / f"{scenario.name}_{piece}.npz"
        if not path.exists():
            x = scenario.space.sample(PIECE, stream(piece, "known before", scenario.name))
            seeds = np.array([run_seed(piece, k) for k in range(PIECE)])
            y = [metric_of(scenario, scenario.space.named(row), int(k), int(k)) for row, k in zip(x, seeds, strict=True)]
            np.savez(path, x=x, seeds=seeds, y=np.array(y))


def recorded(scenario: LogicalScenario, folder: Path) -> tuple[Points, Vector, Vector]:
    """Return inputs, seeds and metrics of the pairs in the folder."""
    files = sorted(folder.glob(f"{scenario.name}_[0-9]*.npz"), key=lambda path: int(path.stem.rpartition("_")[2]))
    parts = [np.load(path) for path in files]
    return tuple(np.concatenate([part[name] for part in parts]) for name in ("x", "seeds", "y"))  # type: ignore[return-value]


def run_again(scenario: LogicalScenario, pairs: int, drivers: int, folder: Path) -> None:
    """Run the first critical pairs of the folder again with other drivers' noise, and as many random pairs once."""
    x, seeds, y = recorded(scenario, folder)
    critical = np.flatnonzero(scenario.requirement.critical.contains(y))[:pairs]
    found = [
        [metric_of(scenario, scenario.space.named(x[k]), int(seeds[k]), run_seed(int(seeds[k]), j + 1)) for j in range(drivers)]
        for k in critical
    ]
    every = np.arange(min(4 * pairs, len(y)))
    once = [metric_of(scenario, scenario.space.named(x[k]), int(seeds[k]), run_seed(int(seeds[k]), 1)) for k in every]
    np.savez(folder / f"{scenario.name}_again.npz", critical=np.array(found), first=y[every], once=np.array(once))


def ceiling(scenario: LogicalScenario, folder: Path) -> tuple[float, float, float]:
    """Return the largest average precision, how often a critical pair is critical again, and the largest R^2."""
    again = np.load(folder / f"{scenario.name}_again.npz")
    hits = scenario.requirement.critical.contains(again["critical"]).sum(axis=1)
    drivers = again["critical"].shape[1]
    log_chance = hits[:, None] * np.log(GRID) + (drivers - hits[:, None]) * np.log1p(-GRID)
    chance, share = np.exp(log_chance - log_chance.max(axis=1, keepdims=True)), np.full(len(GRID), 1.0 / len(GRID))
    for _ in range(5000):  # expectation maximisation of the shares
        of_each = chance * share
        share = (of_each / of_each.sum(axis=1, keepdims=True)).mean(axis=0)
    above = np.cumsum(share[::-1])[::-1]
    precision = above / np.cumsum((share / GRID)[::-1])[::-1]
    pair = np.column_stack([again["first"], again["once"]])
    pair = pair[np.isfinite(pair).all(axis=1)]
    return float((share * precision).sum()), float(hits.mean() / drivers), float(np.corrcoef(pair.T)[0, 1])


def predicted(scenario: LogicalScenario, folder: Path, learned: int, splits: int) -> tuple[Vector, Vector, int]:
    """Return AP on 5,000 fresh pairs, and R^2 out of bag, by inputs and with covariates; and critical fresh pairs in the mean."""
    x, seeds, y = recorded(scenario, folder)
    covariates = Covariates.of(scenario)
    if covariates is None:
        raise SystemExit(f"{scenario.name} tells no covariates")
    inputs = scenario.space.metamodel_inputs(scenario.space.to_unit(x))
    both = np.column_stack([inputs, covariates.at(x, seeds.tolist())])
    critical = scenario.requirement.critical.contains(y)
    score, precision, explained, fresh = scenario.requirement.critical.margin(y), [], [], []
    for split in range(splits):
        order = stream(split, "split").permutation(len(y))
        here, there = order[:learned], order[learned : learned + 5000]
        row, known = [], []
        for columns in (inputs, both):
            near = scores(np.nan_to_num(score[here], nan=np.inf))
            risk = fit_risk(columns[here], near, score[here], critical[here], stream(split, "fit"))
            row.append(average_precision_score(critical[there], risk(columns[there])[0]))
            finite = here[np.isfinite(y[here])]
            known.append(out_of_bag(columns[finite], y[finite], stream(split, "bag")))
        precision.append(row)
        explained.append(known)
        fresh.append(int(critical[there].sum()))
    return np.mean(precision, axis=0), np.mean(explained, axis=0), round(float(np.mean(fresh)))


def main() -> None:
    """Run what is asked for, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=NAMES)
    parser.add_argument("--into", type=Path, required=True, help="folder of the pairs")
    parser.add_argument("--runs", type=int, default=0, help="random pairs")
    parser.add_argument("--again", type=int, default=0, help="critical pairs that are run again")
    parser.add_argument("--drivers", type=int, default=16, help="times that they are")
    parser.add_argument("--learned", type=int, default=1000)
    parser.add_argument("--splits", type=int, default=5)
    parser.add_argument("--show", action="store_true")
    given = parser.parse_args()
    given.into.mkdir(exist_ok=True)
    if given.show:
        print("| scenario | learned | AP, inputs | AP, pairs | ceiling | R^2, inputs | R^2, pairs | ceiling | again | fresh |")
        print("|---|---|---|---|---|---|---|---|---|---|")
    for name in given.names:
        scenario = ScenarioSpec(name).resolve()
        record(scenario, given.runs, given.into)
        if given.again:
            run_again(scenario, given.again, given.drivers, given.into)
        if given.show:
            ap, r2, fresh = predicted(scenario, given.into, given.learned, given.splits)
            best, again, most = ceiling(scenario, given.into)
            cells = (*(f"{v:.3f}" for v in (*ap, best)), *(f"{v:.2f}" for v in (*r2, most)), f"{again:.0%}", fresh)
            print(f"| `{name}` | {given.learned:,} | {' | '.join(map(str, cells))} |", flush=True)


if __name__ == "__main__":
    main()

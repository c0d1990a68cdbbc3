"""Metrics that jump or end at the critical edge, as collisions, counts, sentinels and speeds of impact do: are boundaries sharp,
and do intervals cover?

    python benchmarks/jumps.py [--campaign boundary|estimation|values] [--problems a,b] [--seeds 6] [--first-seed 0]
        [--budget 100]

A row is a problem, campaigns with the product's defaults. Boundary: F1 and log loss at 8,000 fixed points, the stated share and
what is expected on the wrong side, beside the truth. Estimation (without a stop rule): relative error beside that of crude Monte
Carlo of as many runs, intervals that cover, and their half width over 1.96 of that error. Values: what `auto` predicts of the
metric itself at 3,000 fresh runs from as many random ones: mean log likelihood, of the mixture and of the Gaussian with its
moments, RMSE over the metric's standard deviation, root mean square of the error over sigma, and how many lie between the 5 % and
the 95 % quantile; medians over seeds.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from scipy.special import ndtr, rel_entr

import sbt
from sbt.metamodels.automatic import Auto
from sbt.metamodels.base import with_target
from sbt.problem.arrays import Mask, Points, Vector
from sbt.seeds import stream


def disc(x: Points) -> Vector:
    return np.hypot(x[:, 0] - 0.6, x[:, 1] - 0.4) - 0.25


def wave(x: Points) -> Vector:
    return x[:, 1] - 0.5 - 0.25 * np.sin(2.0 * np.pi * x[:, 0])


def corner(x: Points) -> Vector:
    return np.maximum(0.5 - x[:, 0], 0.6 - x[:, 1])


def ball(x: Points) -> Vector:
    return np.sqrt(((x[:, :3] - np.array([0.2, 0.75, 0.4])) ** 2).sum(axis=1)) - 1.0 / 6.0


def two_values(d: Vector, x: Points) -> Vector:
    return np.where(d <= 0.0, -1.0, 1.0)


def three_values(d: Vector, x: Points) -> Vector:
    return np.where(d <= 0.0, -1.0, np.where(x[:, 0] < 0.3, 1.0, 2.0))


def count(d: Vector, x: Points) -> Vector:
    return np.floor(8.0 * d) + 0.5


def contact(d: Vector, x: Points) -> Vector:
    """A distance, and below 0 minus a speed of impact."""
    return np.where(d <= 0.0, x[:, 0] - 3.0, d)


def sentinel(d: Vector, x: Points) -> Vector:
    """A metric that is 10 where nothing happens, and known a little beyond the edge only."""
    return np.where(d < 0.013, 3.0 * d, 10.0)


def depth(d: Vector, x: Points) -> Vector:
    """A depth in mm, 0 where nothing touches; from .1 on it is critical."""
    return 0.1 - 1000.0 * np.maximum(-d, 0.0)


def speed(d: Vector, x: Points) -> Vector:
    """A speed of impact, 0 where nothing touches; from .01 on it is critical."""
    return 0.01 - 15.0 * np.sqrt(np.maximum(-d, 0.0))


def slope(x: Points) -> Vector:
    return x[:, :4] @ np.array([1.0, 0.7, -0.5, 0.3]) - 0.35


def box(x: Points) -> Vector:
    """A corner, and a box that nothing tells of."""
    return np.where(((x > 0.7) & (x < 0.95)).all(axis=1), -1.0, x[:, 0] + 0.5 * x[:, 1] - 0.25)


def plain(d: Vector, x: Points) -> Vector:
    return d


def time_to_collision(d: Vector, x: Points) -> Vector:
    """A time that is 0 in a collision, and critical from 0 to 1.5."""
    return np.maximum(1.5 + 10.0 * d, 0.0)


def flag(d: Vector, x: Points) -> Vector:
    return np.where(d <= 0.0, 1.0, 0.0)


def gap(d: Vector, x: Points) -> Vector:
    """A distance, 0 in every collision, which is critical."""
    return np.maximum(10.0 * d, 0.0)


def none_below(d: Vector, x: Points) -> Vector:
    """A time that is -1 where nothing comes within 3, and critical from 0 to 1.5."""
    t = time_to_collision(d, x)
    return np.where(t > 3.0, -1.0, t)


def none_999(d: Vector, x: Points) -> Vector:
    """A time that is 999 where nothing comes within 3."""
    t = time_to_collision(d, x)
    return np.where(t > 3.0, 999.0, t)


def impact(d: Vector, x: Points) -> Vector:
    """A speed of impact that nothing reaches 100 of, 0 where nothing touches; critical from .1 to 100."""
    return 15.0 * np.sqrt(np.maximum(-d, 0.0))


def parted(d: Vector, x: Points) -> Vector:
    """A margin of which a collision takes 3 more."""
    return np.where(d <= 0.0, 10.0 * d - 3.0, 10.0 * d)


def orders(d: Vector, x: Points) -> Vector:
    """Values over many orders of magnitude."""
    return np.sign(d) * np.expm1(8.0 * np.abs(d))


def outliers(d: Vector, x: Points) -> Vector:
    """A margin, and far values where nothing happens."""
    return np.where(d > 0.3, 1e4 * (d - 0.3) ** 2 + d, d)


def steep(d: Vector, x: Points) -> Vector:
    return np.where(d < 0.0, 30.0 * d, d)


Metric = Callable[[Vector, Points], Vector]
PROBLEMS: dict[str, tuple[int, Callable[[Points], Vector], Metric]] = {
    "disc_01": (2, disc, two_values), "wave_01": (2, wave, two_values),
    "corner_01": (2, corner, two_values),
    "disc_three_values": (2, disc, three_values), "disc_count": (2, disc, count), "disc_contact": (2, disc, contact),
    "disc6_01": (6, disc, two_values), "ball_01": (3, ball, two_values),
    "ball_sentinel": (3, ball, sentinel),
    "disc_depth": (2, disc, depth), "disc_speed": (2, disc, speed), "wave_depth": (2, wave, depth),
    "ball_speed": (3, ball, speed), "slope_ttc": (4, slope, time_to_collision), "disc_flag": (2, disc, flag),
    "ball_gap": (3, ball, gap), "slope_gap": (4, slope, gap), "slope_near_miss": (4, slope, gap),
    "slope_none": (4, slope, none_below), "slope_999": (4, slope, none_999),
    "slope_impact": (4, slope, impact), "slope_scratch": (4, slope, impact),
    "disc_parted": (2, disc, parted), "ball_parted": (3, ball, parted), "slope_parted": (4, slope, parted),
    "disc_parted_noisy": (2, disc, parted), "slope_parted_noisy": (4, slope, parted), "box_hidden": (2, box, plain),
    "slope_orders": (4, slope, orders), "slope_orders_noisy": (4, slope, orders), "disc_outliers": (2, disc, outliers),
    "slope_steep": (4, slope, steep),
}  # fmt: skip
NOISE = {"disc_parted_noisy": 0.05, "slope_parted_noisy": 0.1, "slope_orders_noisy": 0.05}
"""Standard deviation of the distance from seed to seed; M_c of these is where it is at most 0."""
CRITICAL = {
    "slope_ttc": (0.0, 1.5), "disc_flag": (1.0, 1.0), "slope_near_miss": (1e-3, 1.0), "slope_none": (0.0, 1.5),
    "slope_999": (0.0, 1.5), "slope_impact": (0.1, 100.0), "slope_scratch": (0.1, 3.0),
}  # fmt: skip
"""M_c of those that are not critical at 0 and below."""


def evaluate(given: dict[str, float], seed: int, problem: str) -> dict[str, float]:
    _, region, metric = PROBLEMS[problem]
    x = np.array([list(given.values())])
    distance = region(x) + NOISE.get(problem, 0.0) * np.random.default_rng(seed).standard_normal()
    return {"y": float(metric(distance, x)[0])}


def requirement(problem: str) -> sbt.Requirement:
    return sbt.Requirement("y", *CRITICAL.get(problem, (-math.inf, 0.0)))


def critical(problem: str, x: Points) -> Mask:
    """Say where most runs are critical."""
    _, region, metric = PROBLEMS[problem]
    return requirement(problem).critical.contains(metric(region(x), x))


def share(problem: str, x: Points) -> Vector:
    """Return the P(critical) there is."""
    noise = NOISE.get(problem)
    return critical(problem, x).astype(float) if noise is None else ndtr(-PROBLEMS[problem][1](x) / noise)


def campaign(kind: str, problem: str, seed: int, budget: int, folder: Path) -> sbt.Result:
    inputs = [sbt.Parameter(name, 0.0, 1.0) for name in "abcdef"[: PROBLEMS[problem][0]]]
    need = requirement(problem)
    scenario = sbt.Scenario("jumps", inputs, need, evaluate=partial(evaluate, problem=problem))
    stop = {"stop": {"cov": None}} if kind == "estimation" else {}
    return sbt.run(
        campaign=kind, scenario=scenario, budget=budget, seed=seed, store=folder / "store", executor="serial", report=False,
        **stop,
    )  # fmt: skip


def boundary(problem: str, seed: int, budget: int) -> tuple[float, ...]:
    """Return F1, log loss beyond the least there is, stated and true share, expected and true share of runs on the wrong side."""
    x = stream(7, "points").random((8000, PROBLEMS[problem][0]))
    with tempfile.TemporaryDirectory() as folder:
        result = campaign("boundary", problem, seed, budget, Path(folder))
        found, space = result.conclusion, result.scenario.space
        p = result.predict(dict(zip(space.names, x.T, strict=True)))["p_critical"].to_numpy()
    inside, said = critical(problem, x), p > 0.5
    f1 = 2.0 * (said & inside).sum() / max(said.sum() + inside.sum(), 1)
    true = share(problem, x)
    loss = rel_entr(true, np.clip(p, 1e-9, 1.0)) + rel_entr(1.0 - true, np.clip(1.0 - p, 1e-9, 1.0))
    wrong = np.where(said, 1.0 - true, true)
    return f1, loss.mean(), found.critical_fraction or 0.0, true.mean(), found.expected_misclassified or 0.0, wrong.mean()


def estimation(problem: str, seed: int, budget: int) -> tuple[float, float, float]:
    """Return the estimate and the ends of its interval."""
    with tempfile.TemporaryDirectory() as folder:
        found = campaign("estimation", problem, seed, budget, Path(folder)).conclusion
    return found.probability or 0.0, found.low, found.high


def values(problem: str, seed: int, budget: int) -> tuple[float, ...]:
    """Return both log likelihoods, RMSE, root mean square of the standardised error, and the share between two quantiles."""
    d, region, metric = PROBLEMS[problem]
    rng = stream(seed, "values")
    x = rng.random((budget + 3000, d))
    y = metric(region(x) + NOISE.get(problem, 0.0) * rng.standard_normal(len(x)), x)
    known, fresh = slice(0, budget), slice(budget, None)
    predictor = with_target(Auto(), requirement(problem).critical).fit(x[known], y[known], stream(seed, "fit"))
    found = predictor(x[fresh])
    error, between = found.mu - y[fresh], (found.quantile(0.05) <= y[fresh]) & (y[fresh] <= found.quantile(0.95))
    likelihoods = [float(found.log_density(y[fresh]).mean()), float(found.log_density_gaussian(y[fresh]).mean())]
    return (*likelihoods, float(np.sqrt(np.mean(error**2)) / y.std()), float(np.sqrt(np.mean((error / found.sigma) ** 2))),
            float(between.mean()))  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--campaign", choices=("boundary", "estimation", "values"), default="boundary")
    parser.add_argument("--problems", default=",".join(PROBLEMS))
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--budget", type=int, default=100)
    given = parser.parse_args()
    seeds = range(given.first_seed, given.first_seed + given.seeds)
    if given.campaign == "boundary":
        print("| problem | F1 | log loss | share stated | true | wrong side, stated | true |")
    elif given.campaign == "values":
        print("| problem | log likelihood | Gaussian's | RMSE / std | error / sigma | in 5 to 95 % |")
    else:
        print("| problem | P | RMSE / P | crude | covered | half width / (1.96 RMSE) |")
    print("|---|---|---|---|---|---|" + "---|" * (given.campaign == "boundary"), flush=True)
    for problem in given.problems.split(","):
        if given.campaign == "values":
            found = np.median([values(problem, seed, given.budget) for seed in seeds], axis=0)
            print(f"| {problem} | {' | '.join(f'{value:.3g}' for value in found)} |", flush=True)
            continue
        if given.campaign == "boundary":
            f1, loss, *shares = np.mean([boundary(problem, seed, given.budget) for seed in seeds], axis=0)
            print(f"| {problem} | {f1:.3f} | {loss:.3f} | {' | '.join(f'{share:.3f}' for share in shares)} |", flush=True)
            continue
        truth = float(share(problem, stream(8, "truth").random((4_000_000, PROBLEMS[problem][0]))).mean())
        value, low, high = np.array([estimation(problem, seed, given.budget) for seed in seeds]).T
        error, crude = math.sqrt(np.mean((value / truth - 1.0) ** 2)), math.sqrt((1.0 - truth) / truth / given.budget)
        width = float(np.median(high - low)) / 2.0 / (1.96 * error * truth)
        covered = int(((low <= truth) & (truth <= high)).sum())
        print(f"| {problem} | {truth:.4f} | {error:.3f} | {crude:.3f} | {covered} of {len(seeds)} | {width:.1f} |", flush=True)


if __name__ == "__main__":
    main()

"""Boundary identification of noisy simulators whose failure rate is known: is P(critical | x) true, and what is said of it?

    python benchmarks/boundary_noise.py [--problems "a;b"] [--methods mix,even] [--seeds 10] [--first-seed 0] [--budget 100]
    python benchmarks/boundary_noise.py --methods fitted --problems chance     # to as many even runs, without a campaign

A row is a problem and a method, campaigns with the product's defaults, scored at 4,000 fixed points: the root mean square error
of P(critical | x), that of the stated critical share, and the expected misclassified beside the true one, mean of the smaller
risk of the stated sides. `one rate` is the error of the best constant: what knowing nothing of the inputs would cost. Log loss is
that of P above the least that there is, in nats a run, beside that of one rate.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from scipy.special import ndtr
from scipy.stats import cauchy, poisson, t

import sbt
from sbt.metamodels.automatic import Auto
from sbt.metamodels.base import build
from sbt.metamodels.saturation import Opened
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.requirement import CriticalInterval
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream
from sbt.testbeds import find, values

Draw = Callable[[np.random.Generator], float]


def beyond_disc(x: Points) -> Vector:
    return np.hypot(x[:, 0] - 0.6, x[:, 1] - 0.4) - 0.25


def disc(given: dict[str, float], seed: int, draw: Draw, size: float, jump: float) -> dict[str, float]:
    """Return the distance to a disc with noise; with probability `jump` it is a collision, wherever."""
    rng = np.random.default_rng(seed)
    y = float(beyond_disc(np.array([[given["a"], given["b"]]]))[0]) + size * draw(rng)
    return {"y": -1.0 if rng.random() < jump else y}


def uneven(given: dict[str, float], seed: int) -> dict[str, float]:
    """Return the distance to a disc with noise that is .01 at the one end of b and .31 at the other."""
    return disc(given, seed, NORMAL, 0.01 + 0.3 * given["b"], 0.0)


def two_valued(given: dict[str, float], seed: int, outside: float, inside: float) -> dict[str, float]:
    """Return -1 at a rate of its own inside and outside of the disc, else 1."""
    rate = inside if float(beyond_disc(np.array([[given["a"], given["b"]]]))[0]) <= 0.0 else outside
    return {"y": -1.0 if np.random.default_rng(seed).random() < rate else 1.0}


def inside(x: Points, share: float) -> Mask:
    return (x[:, :2] > 1.0 - math.sqrt(share)).all(axis=1)


def conflict(given: dict[str, float], seed: int, share: float, rate: float, cap: bool) -> dict[str, float]:
    """Return a time to collision: below 1 s with some of the seeds in a corner that is so much of the space, else uncritical."""
    rng, x = np.random.default_rng(seed), np.array([list(given.values())])
    if inside(x, share)[0] and rng.random() < rate:
        return {"y": float(0.9 * rng.random() if cap else 0.5 + 0.3 * x[0, -1])}
    return {"y": 10.0 if cap else float(4.0 + x[0, 0] - x[0, -1] + 0.2 * rng.standard_normal())}


def mean_count(x: Points) -> Vector:
    return np.exp(2.0 * x[:, 0] - 1.5 * x[:, 1] - 1.0)


def count(given: dict[str, float], seed: int) -> dict[str, float]:
    """Return a count that is critical from 3 on."""
    return {"y": -float(np.random.default_rng(seed).poisson(mean_count(np.array([list(given.values())]))[0]))}


def of_conflict(x: Points, share: float, rate: float) -> Vector:
    return rate * inside(x, share)


NORMAL: Draw = np.random.Generator.standard_normal
STUDENT: Draw = partial(np.random.Generator.standard_t, df=3)
CAUCHY: Draw = np.random.Generator.standard_cauchy
OWN: dict[str, tuple[Callable[..., dict[str, float]], Callable[[Points], Vector]]] = {
    "disc, noise .1": (partial(disc, draw=NORMAL, size=0.1, jump=0.0), lambda x: ndtr(-beyond_disc(x) / 0.1)),
    "disc, noise .3": (partial(disc, draw=NORMAL, size=0.3, jump=0.0), lambda x: ndtr(-beyond_disc(x) / 0.3)),
    "disc, noise 1": (partial(disc, draw=NORMAL, size=1.0, jump=0.0), lambda x: ndtr(-beyond_disc(x))),
    "disc, noise .01 to .31": (uneven, lambda x: ndtr(-beyond_disc(x) / (0.01 + 0.3 * x[:, 1]))),
    "disc, Student-t noise .2": (partial(disc, draw=STUDENT, size=0.2, jump=0.0), lambda x: t.cdf(-beyond_disc(x) / 0.2, df=3)),
    "disc, Cauchy noise .02": (partial(disc, draw=CAUCHY, size=0.02, jump=0.0), lambda x: cauchy.cdf(-beyond_disc(x) / 0.02)),
    "disc, collision with 3 % of seeds": (
        partial(disc, draw=NORMAL, size=0.0, jump=0.03), lambda x: np.where(beyond_disc(x) <= 0.0, 1.0, 0.03)),
    "two values, .8 inside, .1 outside": (
        partial(two_valued, outside=0.1, inside=0.8), lambda x: np.where(beyond_disc(x) <= 0.0, 0.8, 0.1)),
    "a coin, .5": (partial(two_valued, outside=0.5, inside=0.5), lambda x: np.full(len(x), 0.5)),
    "a coin, .02": (partial(two_valued, outside=0.02, inside=0.02), lambda x: np.full(len(x), 0.02)),
}  # fmt: skip
CONFLICTS = ((2, 0.3, 0.3, True), (4, 0.3, 0.25, False), (4, 0.2, 0.6, True), (2, 0.1, 0.6, False), (4, 0.3, 0.15, True),
             (2, 0.2, 0.15, False), (4, 0.3, 0.05, False))  # fmt: skip
CHANCE = {
    f"conflict{' below a cap' * cap}, {rate:g} of the seeds in {share:g} of {d} inputs": (
        d, (partial(conflict, share=share, rate=rate, cap=cap), partial(of_conflict, share=share, rate=rate)))
    for d, share, rate, cap in CONFLICTS
}  # fmt: skip
CHANCE["a count"] = 2, (count, lambda x: poisson.sf(2, mean_count(x)))
OWN |= {name: both for name, (_, both) in CHANCE.items()}
EDGE = {"a count": -3.0} | dict.fromkeys(CHANCE.keys() - {"a count"}, 1.0)
TESTBEDS = ("two_hollows_noisy", "slope_noisy", "ramp_uneven_d4", "four_branch_noisy")


def rates(problem: str, x: Points) -> Vector:
    """Return (n,) failure rates at x (n, d)."""
    if problem in OWN:
        return OWN[problem][1](x)
    noise = find(problem).noise
    return ndtr(-values(problem, x) / (noise(x) if callable(noise) else noise))


def scenario(problem: str) -> str | sbt.Scenario:
    if problem not in OWN:
        return f"testbed:{problem}"
    inputs = [sbt.Parameter(name, 0.0, 1.0) for name in "abcd"[: CHANCE[problem][0] if problem in CHANCE else 2]]
    return sbt.Scenario("noisy", inputs, sbt.Requirement("y", high=EDGE.get(problem, 0.0)), evaluate=OWN[problem][0])


def fitted(problem: str, seed: int, n: int) -> tuple[float, ...]:
    """Return what `cell` does, of the metamodel fitted to n even runs of a problem of OWN, two of them repeated."""
    d, critical = CHANCE[problem][0] if problem in CHANCE else 2, CriticalInterval(high=EDGE.get(problem, 0.0))

    def run(u: Points, first: int) -> Vector:
        given = [dict(zip("abcd", row, strict=False)) for row in u.tolist()]
        return np.array([OWN[problem][0](each, 1000 * seed + first + k)["y"] for k, each in enumerate(given)])

    u = SobolSequence(d, seed).points(0, n - 2)
    y = run(u, 0)
    again = np.argsort(y, kind="stable")[:2]
    u, y = np.vstack([u, u[again]]), np.append(y, run(u[again], n))
    x = stream(99, "points").random((4000, d))
    p = Opened(build(Auto, "quick"), critical).fit(u, y, stream(seed, "fit"))(x).probability(critical)
    return scored(p, rates(problem, x), float(p.mean()), float(np.minimum(p, 1.0 - p).mean()))


def scored(p: Vector, true: Vector, stated: float, expected: float) -> tuple[float, ...]:
    """Return error of P, stated and true share, misclassified as expected and in truth, one rate's error, log loss and its."""
    wrong = float(np.where(p > 0.5, 1.0 - true, true).mean())
    error = math.sqrt(float(((p - true) ** 2).mean()))
    mean, least = float(true.mean()), _log_loss(true, true)
    lost = _log_loss(p, true) - least, _log_loss(np.full(len(true), mean), true) - least
    return error, stated, mean, expected, wrong, float(true.std()), *lost


def _log_loss(p: Vector, true: Vector) -> float:
    p = np.clip(p, 1e-4, 1.0 - 1e-4)
    return float(-(true * np.log(p) + (1.0 - true) * np.log1p(-p)).mean())


def cell(problem: str, method: str, seed: int, budget: int) -> tuple[float, ...]:
    """Return the scores of a campaign, see `scored`."""
    if method == "fitted":
        return fitted(problem, seed, budget)
    with tempfile.TemporaryDirectory() as folder:
        result = sbt.run(
            campaign="boundary", scenario=scenario(problem), budget=budget, seed=seed, acquisition=method,
            store=Path(folder) / "store", executor="serial", report=False,
        )  # fmt: skip
        space, found = result.scenario.space, result.conclusion.to_dict()
        x = space.from_unit(stream(99, "points").random((4000, space.dimension)))
        p = result.predict(x)["p_critical"].to_numpy()
    return scored(p, rates(problem, x), found["critical_fraction"], found["expected_misclassified"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", default=None, help="separated by ;, or chance: those that chance decides")
    parser.add_argument("--methods", default="mix")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--budget", type=int, default=100)
    given = parser.parse_args()
    chosen = list(CHANCE) if given.problems == "chance" else given.problems.split(";") if given.problems else [*OWN, *TESTBEDS]
    columns = "error of P | one rate | share stated (rms error) | true | misclassified, stated | true | log loss | one rate"
    print(f"| problem | method | {columns} |\n{'|---' * 10}|")
    for problem in chosen:
        for method in given.methods.split(","):
            cells = [cell(problem, method, given.first_seed + k, given.budget) for k in range(given.seeds)]
            error, share, true, expected, wrong, one, lost, least = np.array(cells).T
            off = math.sqrt(float(((share - true) ** 2).mean()))
            print(
                f"| {problem} | {method} | {error.mean():.3f} | {one[0]:.3f} | {share.mean():.3f} ({off:.3f}) | {true[0]:.3f} "
                f"| {expected.mean():.3f} | {wrong.mean():.3f} | {lost.mean():.3f} | {least[0]:.3f} |", flush=True,
            )  # fmt: skip


if __name__ == "__main__":
    main()

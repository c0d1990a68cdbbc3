"""Boundary identification of noisy simulators whose failure rate is known: is P(critical | x) true, and what is said of it?

    python benchmarks/boundary_noise.py [--problems a,b] [--methods mix,even] [--seeds 10] [--first-seed 0] [--budget 100]

A row is a problem and a method, campaigns with the product's defaults, scored at 4,000 fixed points: the root mean square error
of P(critical | x), that of the stated critical share, and the expected misclassified beside the true one, mean of the smaller
risk of the stated sides. `one rate` is the error of the best constant: what knowing nothing of the inputs would cost.
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
from scipy.stats import cauchy, t

import sbt
from sbt.problem.arrays import Points, Vector
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
    inputs = [sbt.Parameter("a", 0.0, 1.0), sbt.Parameter("b", 0.0, 1.0)]
    return sbt.Scenario("noisy", inputs, sbt.Requirement("y", high=0.0), evaluate=OWN[problem][0])


def cell(problem: str, method: str, seed: int, budget: int) -> tuple[float, ...]:
    """Return error of P, stated and true share, expected and true misclassified, and the error of one rate."""
    with tempfile.TemporaryDirectory() as folder:
        result = sbt.run(
            campaign="boundary", scenario=scenario(problem), budget=budget, seed=seed, acquisition=method,
            store=Path(folder) / "store", executor="serial", report=False,
        )  # fmt: skip
        space, found = result.scenario.space, result.conclusion.to_dict()
        x = space.from_unit(stream(99, "points").random((4000, space.dimension)))
        p, true = result.predict(x)["p_critical"].to_numpy(), rates(problem, x)
    wrong = float(np.where(p > 0.5, 1.0 - true, true).mean())
    error = math.sqrt(float(((p - true) ** 2).mean()))
    return error, found["critical_fraction"], float(true.mean()), found["expected_misclassified"], wrong, float(true.std())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", default=None, help="separated by ;")
    parser.add_argument("--methods", default="mix")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--budget", type=int, default=100)
    given = parser.parse_args()
    print("| problem | method | error of P | one rate | share stated (rms error) | true | misclassified, stated | true |")
    print("|---|---|---|---|---|---|---|---|")
    for problem in given.problems.split(";") if given.problems else (*OWN, *TESTBEDS):
        for method in given.methods.split(","):
            cells = [cell(problem, method, given.first_seed + k, given.budget) for k in range(given.seeds)]
            error, share, true, expected, wrong, one = np.array(cells).T
            off = math.sqrt(float(((share - true) ** 2).mean()))
            print(
                f"| {problem} | {method} | {error.mean():.3f} | {one[0]:.3f} | {share.mean():.3f} ({off:.3f}) | {true[0]:.3f} "
                f"| {expected.mean():.3f} | {wrong.mean():.3f} |", flush=True,
            )  # fmt: skip


if __name__ == "__main__":
    main()

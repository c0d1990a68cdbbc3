"""Do the intervals of the failure mode that comes first cover? Simulated races of repetitions between candidates.

    python benchmarks/race.py [--races 2000]

Each mode has two candidates, each with four runs near it. Beside the race: as many repetitions spent evenly, the mode with
the most of them first, and the rate of these very repetitions told.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np

from sbt.campaigns.confirming import ROUNDS, shares
from sbt.campaigns.modes import FailureRate
from sbt.campaigns.rates import LocalRates, next_repetitions
from sbt.problem.arrays import Vector
from sbt.seeds import stream

RATES: dict[str, Callable[[np.random.Generator, int], Vector]] = {
    "0 to 1": lambda rng, n: rng.random(n),
    "one in ten": lambda rng, n: rng.beta(1.0, 9.0, n),
    "all 0.3": lambda rng, n: np.full(n, 0.3),
}
"""Exact rates of n candidates."""
_NEAR = 4


def race(modes: int, exact: Vector, rng: np.random.Generator) -> tuple[Vector, Vector]:
    """Return, by race and by even repetitions, (2,) whether the interval of the first mode covers.

    With them (2, 3): the rate that is told, the true one, and the largest of all candidates.
    """
    racing, told = shares(modes)
    known = rng.binomial(_NEAR, exact) + 0.5
    runs, hits, left = np.full(2 * modes, _NEAR + 1.0), known.copy(), racing
    before = known.reshape(modes, 2).argmax(axis=1) + 2 * np.arange(modes)
    while left:
        mean = hits / runs
        rates = LocalRates(mean, np.sqrt(mean * (1.0 - mean) / (runs + 1.0)))
        rows = next_repetitions(rates, [[2 * k, 2 * k + 1] for k in range(modes)], -(-racing // ROUNDS))[:left]
        np.add.at(runs, rows, 1.0)
        np.add.at(hits, rows, rng.random(len(rows)) < exact[rows])
        left -= len(rows)
    each = (racing + sum(told)) // modes
    even = rng.binomial(each, exact[before])
    most = int(even.argmax())
    first = int((hits / runs).argmax())
    found = [(first, rng.random(told[0]) < exact[first]), (int(before[most]), np.arange(each) < even[most])]
    rates_told = [FailureRate.of(critical, np.zeros(len(critical), dtype=bool)) for _, critical in found]
    covers = [rate.low <= exact[row] <= rate.high for rate, (row, _) in zip(rates_told, found, strict=True)]
    values = [(rate.estimate or 0.0, exact[row], exact.max()) for rate, (row, _) in zip(rates_told, found, strict=True)]
    return np.array(covers), np.array(values)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--races", type=int, default=2000)
    args = parser.parse_args()
    print("| rates | modes | race, then told | intervals cover | told minus true | true rate | largest |")
    print("|---|---|---|---|---|---|---|")
    for name, rates in RATES.items():
        for modes in (2, 3, 5):
            rng = stream(modes, "race", name)
            found = [race(modes, rates(rng, 2 * modes), rng) for _ in range(args.races)]
            covers, values = (np.mean([each[k] for each in found], axis=0) for k in (0, 1))
            racing, told = shares(modes)
            off = values[:, 0] - values[:, 1]
            print(
                f"| {name} | {modes} | {racing}, {told[0]} of {sum(told)} (even: {(racing + sum(told)) // modes} each)"
                f" | {covers[0]:.3f} ({covers[1]:.3f}) | {off[0]:+.3f} ({off[1]:+.3f})"
                f" | {values[0, 1]:.3f} ({values[1, 1]:.3f}) | {values[0, 2]:.3f} |", flush=True,
            )  # fmt: skip


if __name__ == "__main__":
    main()

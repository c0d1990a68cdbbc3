"""Several requirements in one campaign on problems whose probabilities are known: estimates, failure modes, boundary.

    OMP_NUM_THREADS=1 python benchmarks/several.py --seeds 20 [--what estimation falsification boundary]

Inputs a, b, c are standard normal, within [-5, 5]. `any`: too near, too fast or too late; `all`: near and fast, each of them
common. The truth is that of 20 million random draws.
"""

from __future__ import annotations

import tempfile

import numpy as np
from resumed import arguments, collect, seeds

import sbt
from sbt import Requirement, all_of, any_of

NEEDS = {
    "any": any_of(Requirement("near", high=0.0), Requirement("fast", low=35.0), Requirement("late", low=12.0)),
    "all": all_of(Requirement("near", high=1.5), Requirement("fast", low=15.0)),
}
INPUTS = [sbt.Parameter(name, -5.0, 5.0, "", sbt.Normal(0.0, 1.0)) for name in "abc"]
RUNS = {"estimation": 200, "falsification": 60, "boundary": 150}


def metrics(values, seed):
    """Return three metrics of the inputs."""
    a, b, c = (values[name] for name in "abc")
    del seed
    return {
        "near": 3.0 - (a + 0.3 * b * b - 0.2 * c), "fast": 10.0 * np.exp(0.5 * b) + 0.5 * c - a,
        "late": (c - 0.5 * a) ** 2 + 0.2 * b,
    }  # fmt: skip


class Measured:
    """Runs by metric."""

    def __init__(self, columns):
        self.columns = columns

    def y(self, metric):
        """Return the values of a metric."""
        return self.columns[metric]


def truth(need, parts=10, n=2_000_000):
    """Return the probability of the combination and of each requirement, and the largest relative standard error."""
    rng, shares = np.random.default_rng(12345), []
    for _ in range(parts):
        drawn = rng.standard_normal((n, 3))
        runs = Measured(metrics(dict(zip("abc", drawn[(np.abs(drawn) <= 5.0).all(axis=1)].T, strict=True)), 0))
        shares.append([one.critical_runs(runs).mean() for one in (need, *need.parts)])
    found = np.array(shares)
    names = ["combination", *(part.label for part in need.parts)]
    return dict(zip(names, found.mean(axis=0), strict=True)), float((found.std(0, ddof=1) / found.mean(0)).max() / parts**0.5)


def campaign(kind, need, seed, **keys):
    """Return the result of a campaign with the defaults."""
    scenario = sbt.Scenario("several", INPUTS, need, evaluate=metrics, metrics=["near", "fast", "late"])
    with tempfile.TemporaryDirectory() as folder:
        found = sbt.run(
            campaign=kind, scenario=scenario, budget=RUNS[kind], seed=seed, store=f"{folder}/store", executor="serial",
            report=False, **keys,
        )  # fmt: skip
        return found.conclusion, found.history


def estimation(need, seed):
    """Return probability and interval of the combination and of each requirement."""
    said, _ = campaign("estimation", need, seed, stop={"cov": None})
    rows = {"combination": said, **{one.name: one for one in said.requirements or ()}}
    return {name: (one.probability, one.low, one.high) for name, one in rows.items()}


def falsification(need, seed):
    """Return the failure modes and critical runs of each requirement."""
    said, history = campaign("falsification", need, seed)
    modes = {p.label: any(p.label in (mode.violates or {}) for mode in said.failure_modes) for p in need.parts}
    runs = {p.label: int((p.critical_runs(history) & need.critical_runs(history)).sum()) for p in need.parts}
    return {"modes": modes, "runs": runs, "found": len(said.failure_modes)}


def boundary(need, seed):
    """Return the stated shares of the space, expected error, correlation of residuals and calibration error."""
    said, _ = campaign("boundary", need, seed)
    shares = [said.critical_fraction, *(one.critical_fraction for one in said.requirements or ())]
    correlation = 0.0 if said.independence is None else abs(said.independence.correlation)
    return {"shares": shares, "rest": [said.expected_misclassified, correlation, said.validation.calibration_error]}


def show_estimation(need, rows):
    """Print error and coverage of the combination and of each requirement."""
    known, error = truth(need)
    print(f"\n| {need.metric} | truth (±{100 * error:.1g} %) | rel. RMSE | mean error | covered | half width |\n|" + "---|" * 6)
    for name, t in known.items():
        p, low, high = np.array([row[name] for row in rows]).T
        print(
            f"| {name} | {t:.4g} | {100 * np.sqrt(np.mean((p / t - 1) ** 2)):.1f} % | {100 * (p.mean() / t - 1):+.1f} % | "
            f"{int(((low <= t) & (t <= high)).sum())} of {len(p)} | {100 * np.median((high - low) / 2 / t):.1f} % |"
        )


def show_falsification(need, rows):
    """Print in how many campaigns there is a failure mode, or a critical run, of each requirement."""
    each = ", ".join(
        f"{p.label}: {sum(row['modes'][p.label] for row in rows)} of {len(rows)} "
        f"(median {np.median([row['runs'][p.label] for row in rows]):.0f} runs)" for p in need.parts
    )  # fmt: skip
    print(f"\n{need.metric}: modes that violate {each}; {np.median([row['found'] for row in rows]):.0f} modes in the median")


def show_boundary(need, rows):
    """Print the error of the shares of the space, and of the classification of fresh points."""
    x = np.random.default_rng(9).uniform(-5.0, 5.0, (50_000, 3))
    runs = Measured(metrics(dict(zip("abc", x.T, strict=True)), 0))
    shares = [one.critical_runs(runs).mean() for one in (need, *need.parts)]
    off = np.abs(np.array([row["shares"] for row in rows]) - shares).mean(axis=0)
    errors = ", ".join(
        f"{name} {100 * t:.1f} % (off by {100 * e:.2f} %)"
        for name, t, e in zip(["combination", *(p.label for p in need.parts)], shares, off, strict=True)
    )
    misclassified, correlation, calibration = np.array([row["rest"] for row in rows]).mean(axis=0)
    print(
        f"\n{need.metric}: shares {errors}; expected misclassified {100 * misclassified:.2f} %, correlation of residuals"
        f" {correlation:.2f} in the mean, calibration error {calibration:.3f}"
    )


def main() -> None:
    """Run what is missing, and print the tables."""
    parser = arguments(__doc__, "runs/several.jsonl", 20)
    parser.add_argument("--what", nargs="+", default=list(RUNS), choices=list(RUNS))
    parser.add_argument("--needs", nargs="+", default=list(NEEDS), choices=list(NEEDS))
    args = parser.parse_args()
    jobs = [{"what": what, "need": need, "seed": seed} for seed in seeds(args) for what in args.what for need in args.needs]
    rows = collect(args, jobs, lambda what, need, seed: globals()[what](NEEDS[need], seed))
    for what in args.what:
        for need in args.needs:
            mine = [row for row in rows if (row["what"], row["need"]) == (what, need)]
            if mine:
                globals()[f"show_{what}"](NEEDS[need], mine)


if __name__ == "__main__":
    main()

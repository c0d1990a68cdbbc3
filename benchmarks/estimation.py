"""Is the estimate right, and does its interval hold? Many seeds on testbeds with known probability.

    python benchmarks/estimation.py [--seeds 50] [--problems four_branch_7@124,rp38@200] [--table runs/estimation.jsonl]
    python benchmarks/estimation.py --cov 0.1 [--seeds 50] ...      # with the stop rule, at the default budget
    python benchmarks/estimation.py --cov 0.1 --problems many       # with many inputs, at the runs of the cell; bar: crude

Every cell (problem, runs, seed) is a campaign with default settings, through the public way. Finished
cells are lines of the table: run again to go on where it stopped, or split seeds over processes (`resumed.py`).
"""

from __future__ import annotations

import math
import os
import tempfile
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from resumed import arguments, collect, seeds
from scipy.integrate import quad
from scipy.special import ndtri
from scipy.stats import chi2, gamma, norm
from scipy.stats import t as student_t

import sbt
from sbt.testbeds import truth


def _truncated() -> float:
    """Return P(x1 + x2 >= 3.5 sqrt(2)) of standard normals, x1 truncated to [-1, 1]."""
    inside = quad(lambda x: norm.pdf(x) * norm.sf(3.5 * math.sqrt(2.0) - x), -1.0, 1.0, epsabs=1e-14)[0]
    return float(inside / (norm.cdf(1.0) - norm.cdf(-1.0)))


BARS = {
    "four_branch_7@124": 0.05, "four_branch_7@200": 0.025, "rp38@200": 0.05, "cut_in_crash@200": 0.07, "pedestrian@200": 0.10,
    "metaball@200": 0.10, "gayton_hat@200": 0.15, "linear_d10@200": 0.12, "rp110@250": 0.10, "damped_oscillator_15@300": 0.20,
}  # fmt: skip
"""Problem@runs: the largest relative RMSE."""
HARD = {
    "four_branch_noisy@300": 0.20, "chi2_d10@300": 0.12, "hartmann6_1e-3@340": 0.08, "linear_d30@2000": 0.30,
    "linear_d80@2000": 0.30,
}  # fmt: skip
"""The same with noise, a sharp edge in ten inputs, uniform inputs, and many inputs."""


def _line(name: str, drawn) -> sbt.Scenario:
    """Return a line in two normal inputs, and what a seed draws beside it."""

    def evaluate(values: dict, seed: int) -> dict:
        return {"m": drawn(3.5 - values["a"] - 0.3 * values["b"], np.random.default_rng(seed))}

    inputs = [sbt.Parameter(each, -6.0, 6.0, "", sbt.Normal(0, 1)) for each in "ab"]
    return sbt.Scenario(name, inputs, sbt.Requirement("m", high=0.0), evaluate=evaluate, metrics=["m"])


def _of_line(given: float | None = None, degrees: float = 1.5) -> float:
    """Return P(critical): of the share of seeds that fail anywhere, or of Student-t noise of width 0.05."""
    if given is not None:
        return given + (1.0 - given) * norm.sf(3.5 / math.sqrt(1.09))
    noise, edge = student_t(degrees), 3.5 / math.sqrt(1.09)
    return quad(lambda z: norm.pdf(z) * noise.cdf((z - edge) * math.sqrt(1.09) / 0.05), -9.0, 9.0, points=[edge], limit=500)[0]


_EXPONENTIAL = {"distribution": {"kind": "exponential", "mean": 1}, "min": 0, "max": math.inf}
LAWS = {
    "copula@200": (
        "testbed:linear_d2", {"correlation": [{"inputs": ["x1", "x2"], "value": 0.7}]}, norm.cdf(-3.5 / math.sqrt(1.7)),
    ),
    "counter_copula@200": (
        "testbed:linear_d2", {"correlation": [{"inputs": ["x1", "x2"], "value": -0.5}]}, norm.cdf(-3.5 / math.sqrt(0.5)),
    ),
    "constraint@200": ("testbed:linear_d2", {"constraints": ["x1 < x2"]}, norm.cdf(-3.5)),
    "truncated@200": ("testbed:linear_d2", {"inputs": {"x1": {"min": -1.0, "max": 1.0}}}, _truncated()),
    "exponential@200": (
        "testbed:linear_d2",
        {"inputs": {"x1": _EXPONENTIAL, "x2": _EXPONENTIAL}, "requirement": {"critical": [-math.inf, -4.0]}},
        gamma.sf(7.5 * math.sqrt(2.0), 2),
    ),
    "rare@200": ("testbed:linear_d2", {"requirement": {"critical": [-math.inf, -1.7]}}, norm.cdf(-5.2)),
    "rare_d10@300": ("testbed:linear_d10", {"requirement": {"critical": [-math.inf, -1.7]}}, norm.cdf(-5.2)),
    "sumo_cut_in@300": (
        "cut_in",
        {"inputs": {"d_v": sbt.Normal(15, 12), "d_t": sbt.LogNormal(1.8, 0.9)}},
        0.00238,  # 400,000 crude runs, seeds 101 and 102: 0.00223 to 0.00254
    ),
    "heavy_noise@200": (_line("heavy_noise", lambda m, rng: m + 0.05 * rng.standard_t(1.5)), {}, _of_line()),
    "few_seeds@200": (_line("few_seeds", lambda m, rng: m if rng.random() > 0.003 else -2.0), {}, _of_line(0.003)),
    "more_seeds@200": (_line("more_seeds", lambda m, rng: m if rng.random() > 0.02 else -2.0), {}, _of_line(0.02)),
    "noisy@200": ("testbed:four_branch_noisy", {}, truth("four_branch_noisy").probability),
}  # fmt: skip
"""Name@runs: scenario, what the configuration changes of it, and the probability; the testbeds' own inputs are unbounded."""


def _many(kind: str, d: int, p: float) -> sbt.Scenario:
    """Return a problem of d normal inputs and this probability: beyond a sphere, in the largest input, by a flag, with noise."""
    rest = 1.0 - (1.0 - p) ** (1.0 / d)
    edge = {"sphere": chi2(d).isf(p), "linear": norm.isf(p), "noise": math.sqrt(2.0) * norm.isf(p)}.get(kind, norm.isf(rest))

    def evaluate(values: dict, seed: int) -> dict:
        z = np.array([*values.values()], dtype=float)
        top = z.max()
        by = {
            "sphere": (z**2).sum(), "linear": z.sum() / math.sqrt(d), "max": top, "flag": edge + (1 if top > edge else -1),
            "noise": z[0] + ndtri(np.random.default_rng(seed).random()),
        }  # fmt: skip
        return {"m": float(edge - by[kind])}

    inputs = [sbt.Parameter(f"x{k}", -9.0, 9.0, "", sbt.Normal(0, 1)) for k in range(d)]
    return sbt.Scenario(f"{kind}_{d}", inputs, sbt.Requirement("m", high=0.0), evaluate=evaluate, metrics=["m"])


_CASES = [
    *(("sphere", 20, p, 300) for p in (0.5, 0.2, 0.0198)), ("max", 20, 0.0267, 300), ("flag", 20, 0.05, 300),
    ("noise", 20, 0.079, 300),
    *(("sphere", 20, p, runs) for runs in (300, 1000, 2000) for p in (0.001, 0.0002)), ("sphere", 20, 0.005, 2000),
    *(("linear", d, p, runs) for d in (20, 30, 80) for runs in (300, 1000, 2000) for p in (0.001, 0.0002)),
]  # fmt: skip
MANY = {f"{kind}_{d}_{p:g}@{runs}": (_many(kind, d, p), {}, p) for kind, d, p, runs in _CASES}
"""With many inputs: what no few directions explain, beside planes that one explains."""
KEPT = ("probability", "low", "high", "cov", "hits", "undetected_mass_bound", "warnings")


def campaign(cell: str, seed: int, stop: float | None) -> dict:
    name, _, runs = cell.partition("@")
    size = {"budget": int(runs)} if stop is None or cell in MANY else {}
    name, changed, _ = (LAWS | MANY).get(cell, (f"testbed:{name}", {}, 0.0))
    with tempfile.TemporaryDirectory() as folder:
        start, cpu = time.perf_counter(), time.process_time()
        result = sbt.run(
            campaign="estimation", scenario=name, seed=seed, stop={"cov": stop}, executor="serial",
            store=f"{folder}/store", report=False, **size, **changed,
        )  # fmt: skip
        summary = result.summary
    took = {"seconds": round(time.perf_counter() - start, 1), "cpu": round(time.process_time() - cpu, 1)}
    kept = {key: summary["conclusion"][key] for key in KEPT}
    return {"runs": summary["runs"], **took, **kept}


def one_sided(row: dict) -> bool:
    return any("bound is given" in w or "only bounded" in w for w in row["warnings"])


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else math.nan


def show(rows: list[dict]) -> None:
    head = (
        "problem@runs", "seeds", "runs", "rel. RMSE", "bar", "mean error (std. error)", "median CoV", "half width / (1.96 RMSE)",
        "covered", "one-sided", "undetected", "CPU s",
    )  # fmt: skip
    print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
    every, ratios = [], []
    for cell in dict.fromkeys(row["cell"] for row in rows):
        p = (LAWS | MANY)[cell][2] if cell in LAWS | MANY else truth(cell.partition("@")[0]).probability
        crude = f"{math.sqrt((1.0 - p) / p / int(cell.partition('@')[2])):.2f}" if cell in MANY else "-"
        mine = [row for row in rows if row["cell"] == cell]
        error = np.array([(row["probability"] or 0.0) / p - 1.0 for row in mine])
        covered = [row["low"] <= p <= row["high"] for row in mine]
        every += covered
        rmse = float(np.sqrt(np.mean(error**2)))
        half = np.median([0.5 * (row["high"] - row["low"]) for row in mine]) / p
        ratios.append(half / (1.96 * rmse))
        keys = ("runs", "cov", "undetected_mass_bound", "cpu")
        runs, cov, undetected, cpu = (_median([row[key] for row in mine if row[key] is not None]) for key in keys)
        print(
            f"| {cell} | {len(mine)} | {runs:.0f} | {rmse:.3f} | {({**BARS, **HARD}).get(cell, crude)} | {error.mean():+.3f} "
            f"({error.std(ddof=1) / np.sqrt(len(error)) if len(error) > 1 else math.nan:.3f}) | {cov:.3f} | {ratios[-1]:.1f} | "
            f"{sum(covered)} of {len(covered)} | {np.mean([one_sided(row) for row in mine]):.2f} | {undetected:.2f} | {cpu:.1f} |"
        )
    print(
        f"\npooled coverage of the 95 % interval: {np.mean(every):.3f} of {len(every)} campaigns; median of half width / (1.96 "
        f"RMSE): {np.median(ratios):.2f}; median runs: {np.median([row['runs'] for row in rows]):.0f}"
    )


def main() -> None:
    parser = arguments(__doc__, "runs/estimation.jsonl", 50)
    parser.add_argument("--problems", default=",".join((*BARS, *LAWS)))
    parser.add_argument("--cov", type=float, help="the stop rule; default: none, all runs of the cell are used")
    args = parser.parse_args()
    cells = [*MANY] if args.problems == "many" else args.problems.split(",")
    if unknown := set(cells) - {*BARS, *HARD, *LAWS, *MANY}:
        parser.error(f"--problems: {', '.join(sorted(unknown))} is none of {', '.join((*BARS, *HARD, *LAWS, *MANY))}")
    jobs = [{"cell": cell, "seed": seed, "stop": args.cov} for seed in seeds(args) for cell in cells]
    rows = collect(args, jobs, campaign)
    show([row for cell in cells for row in rows if row["cell"] == cell])


if __name__ == "__main__":
    main()

"""Do intervals of an estimation cover where runs fail, whether these count as safe or as critical?

    python benchmarks/failing_estimates.py [--seeds 20] [--problems overlap_d2_half,random_d3_tenth] [--table runs/failing.jsonl]
    python benchmarks/failing_estimates.py --counts 60 --seeds 3 ...    # simulated counts instead, with the metamodels of 3 seeds

Campaigns with default settings, `stop: {cov: null}`, 150 runs. The probability of both readings is known: P(critical, and the run
gives a metric) counts failed runs as safe, P(critical, or the run fails) as critical. Finished cells are lines of the table: run
again to go on, or split seeds over processes (`resumed.py`).
"""

from __future__ import annotations

import math
import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from resumed import arguments, collect, seeds
from scipy.stats import multivariate_normal, norm

import sbt
from sbt.campaigns import pools
from sbt.campaigns.counting import with_event
from sbt.estimators.events import with_failed_runs
from sbt.estimators.importance import BLIND, SHARES
from sbt.estimators.intervals import FEW_HITS, CountedBatch, combine_estimates
from sbt.estimators.mixture import wide_scales
from sbt.estimators.surrogate import Coordinates, fit_log_probability
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.seeds import stream
from sbt.testbeds import find

RUNS = 150
_BETA = 3.0
"""Of the hyperplane beyond which runs are critical: P = 1.3e-3."""
Fails = Callable[[np.ndarray, int], bool]
"""Normal scores (d,) and the seed of a run: it gives no metric."""


@dataclass(frozen=True)
class Cell:
    """A problem: its scenario, and the probabilities with failed runs as safe and as critical."""

    scenario: sbt.Scenario | str
    safe: float
    critical: float


def plane(d: int, fails: Fails, both: float, share: float) -> Cell:
    """Return the half-space of distance 3 in d standard-normal inputs; `both`: its part that fails, `share`: what fails."""

    def evaluate(values: dict[str, float], seed: int) -> dict[str, float]:
        z = np.array(list(values.values()))
        return {"y": math.nan if fails(z, seed) else _BETA - float(z.sum()) / math.sqrt(d)}

    inputs = [sbt.Parameter(f"x{k + 1}", -math.inf, math.inf, "", sbt.Normal(0.0, 1.0)) for k in range(d)]
    scenario = sbt.Scenario("plane", inputs=inputs, evaluate=evaluate, requirement=sbt.Requirement("y", high=0.0))
    whole = float(norm.sf(_BETA))
    return Cell(scenario, whole - both, share + whole - both)


def at_random(d: int, share: float) -> Cell:
    """Return the plane where runs fail whatever their inputs."""
    return plane(d, lambda z, seed: bool(stream(seed, "fails").random() < share), share * float(norm.sf(_BETA)), share)


def half_space(d: int, share: float, correlation: float) -> Cell:
    """Return the plane where runs fail beyond another one, whose normal has this correlation with the first."""
    first = np.full(d, 1.0 / math.sqrt(d))
    across = np.zeros(d)
    across[:2] = 1.0 / math.sqrt(2.0), -1.0 / math.sqrt(2.0)
    normal, edge = correlation * first + math.sqrt(1.0 - correlation**2) * across, float(norm.isf(share))
    both = multivariate_normal.cdf([-_BETA, -edge], cov=[[1.0, correlation], [correlation, 1.0]])
    return plane(d, lambda z, _: bool(z @ normal > edge), float(both), share)


def testbed(name: str, share: float) -> Cell:
    """Return a testbed of which this share fails."""
    p = find(name).truth.probability
    return Cell(f"testbed:{name}", p, share + p)


CELLS: dict[str, Callable[[], Cell]] = {
    "random_d3_tenth": lambda: at_random(3, 0.1),
    "random_d2_half": lambda: at_random(2, 0.5),
    "apart_d4_tenth": lambda: half_space(4, 0.1, 0.0),
    "apart_d2_half": lambda: half_space(2, 0.5, 0.0),
    "overlap_d2_half": lambda: half_space(2, 0.5, 0.3),
    "overlap_d6_tenth": lambda: half_space(6, 0.1, 0.5),
    "overlap_d5_half": lambda: half_space(5, 0.5, 0.3),
    "needle_half_fails": lambda: testbed("needle_half_fails", 0.5),
    "hartmann6_third_fails": lambda: testbed("hartmann6_third_fails", 0.37895),
    "wavy_half_fails": lambda: testbed("wavy_half_fails", 0.49868),
}
"""Where runs fail, whether that is apart from the critical region or overlaps it, inputs, share that fails."""
KEPT = ("probability", "failed_as_critical", "low", "high", "cov", "hits", "warnings")


def campaign(cell: str, seed: int) -> dict:
    with tempfile.TemporaryDirectory() as folder:
        cpu = time.process_time()
        result = sbt.run(
            campaign="estimation", scenario=CELLS[cell]().scenario, seed=seed, budget=RUNS, stop={"cov": None}, executor="serial",
            store=f"{folder}/store", report=False,
        )  # fmt: skip
        kept = {key: result.summary["conclusion"][key] for key in KEPT}
        failed = float((result.frame.status != "ok").mean())
    return {"failed": failed, "cpu": round(time.process_time() - cpu, 1), **kept}


def counts(name: str, seed: int, n: int) -> np.ndarray:
    """Return (n, 4) estimate and lower end with failed runs as safe, estimate and upper end with failed runs as critical."""
    pools._POOL = 2_500
    with tempfile.TemporaryDirectory() as folder:
        result = sbt.run(
            campaign="estimation", scenario=CELLS[name]().scenario, seed=seed, budget=75, stop={"cov": None}, executor="serial",
            store=f"{folder}/store", report=False,
        )  # fmt: skip
        history, scenario = result.history, result.scenario
    given_as = CELLS[name]().scenario
    evaluate = find(name).scenario().evaluate if isinstance(given_as, str) else given_as.evaluate
    space, requirement, rng = scenario.space, scenario.requirement, stream(seed, "counts", name)
    at, z, y = Coordinates(space), space.to_normal(history.x), requirement.values(history)
    rows = np.r_[np.flatnonzero(history.ok), np.flatnonzero(~history.ok)]  # those with a metric first
    z, y, ok = z[rows], y[rows], history.ok[rows]
    given = fit_log_probability(GaussianProcess(nu=2.5, input_noise=False), at, requirement.critical, z[ok], y[ok], rng)
    learned, frame = with_failed_runs(given, at, z, ok, rng), pools.Frame(wide_scales(at.bounded))
    hits = z[ok][requirement.critical.contains(y[ok])]
    proposal = pools.fit_proposal(space, frame, learned, hits if len(hits) else None, SHARES if len(hits) else BLIND, rng)
    found = []
    for _ in range(n):
        batches = [batch_of(scenario, evaluate, frame, proposal, rng) for _ in range(5)]
        low, high = (combine_estimates([batch[k] for batch in batches]) for k in (0, 1))
        outcomes = [np.concatenate([batch[k].critical for batch in batches]) for k in (0, 1)]
        few = [min(each.sum(), len(each) - each.sum()) < FEW_HITS for each in outcomes]
        if min(e.hits for e in (low, high)) == 0.0:
            found.append((low.value, 0.0, high.value, 1.0))  # only a bound is given
            continue
        ends = low.limit(0.975, side=-1, few=few[0]), high.limit(0.975, side=1, few=few[1])
        found.append((low.value, ends[0], high.value, ends[1]))
    return np.array(found)


def batch_of(scenario, evaluate, frame, proposal, rng) -> tuple[CountedBatch, CountedBatch]:
    """Return a batch of 15 draws from a fresh pool, failed ones as safe and as critical."""
    pool = pools.draw_pool(scenario.space, frame, proposal, SHARES, rng)
    runs, kept = pools.draw_batch(scenario.space, pool, 15, rng, counts=True)
    y = np.array([evaluate(run.inputs, int(rng.integers(2**31)))[scenario.requirement.metric] for run in runs])
    draws, critical = kept.counted, scenario.requirement.critical.contains(y)
    prior = kept.pool.probability if kept.method == "difference" else 0.0
    safe = CountedBatch(
        prior, kept.pool.anticipated, draws.pool_variance, np.array(draws.coefficient), np.array(draws.control_variate),
        critical.astype(np.float64),
    )  # fmt: skip
    worst = replace(safe, critical=(critical | np.isnan(y)).astype(np.float64))
    return safe, worst if draws.failed_critical is None else with_event(worst, draws.failed_critical)


def show_counts(names: list[str], seeds: int, n: int) -> None:
    head = (
        "problem", "counts", "low > P", "rel. RMSE", "median (P - low) / P", "high < P", "rel. RMSE (crude)",
        "median (high - P) / P",
    )  # fmt: skip
    print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
    for name in names:
        cell, found = CELLS[name](), np.vstack([counts(name, seed, n) for seed in range(seeds)])
        crude = math.sqrt((1.0 - cell.critical) / (cell.critical * 75))
        rmse = [np.sqrt(np.mean((found[:, k] / p - 1.0) ** 2)) for k, p in ((0, cell.safe), (2, cell.critical))]
        print(
            f"| {name} | {len(found)} | {(found[:, 1] > cell.safe).mean():.3f} | {rmse[0]:.3f} | "
            f"{np.median(1.0 - found[:, 1] / cell.safe):.2f} | {(found[:, 3] < cell.critical).mean():.3f} | {rmse[1]:.3f} "
            f"({crude:.3f}) | {np.median(found[:, 3] / cell.critical - 1.0):.2f} |",
            flush=True,
        )  # fmt: skip


def show(rows: list[dict]) -> None:
    head = (
        "problem", "seeds", "P, failed as safe", "low > P", "rel. RMSE", "median (P - low) / P", "P, failed as critical",
        "high < P", "rel. RMSE (crude)", "median (high - P) / P", "failed runs", "CPU s",
    )  # fmt: skip
    print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
    for name in dict.fromkeys(row["cell"] for row in rows):
        cell, mine = CELLS[name](), [row for row in rows if row["cell"] == name]
        safe, worst, low, high, failed, cpu = (
            np.array([row[key] if row[key] is not None else np.nan for row in mine], dtype=np.float64)
            for key in ("probability", "failed_as_critical", "low", "high", "failed", "cpu")
        )
        crude = math.sqrt((1.0 - cell.critical) / (cell.critical * RUNS))
        rmse = [float(np.sqrt(np.nanmean((found / p - 1.0) ** 2))) for found, p in ((safe, cell.safe), (worst, cell.critical))]
        print(
            f"| {name} | {len(mine)} | {cell.safe:.3g} | {int((low > cell.safe).sum())} | {rmse[0]:.3f} | "
            f"{np.median(1.0 - low / cell.safe):.2f} | {cell.critical:.3g} | {int((high < cell.critical).sum())} | "
            f"{rmse[1]:.3f} ({crude:.3f}) | {np.median(high / cell.critical - 1.0):.2f} | {failed.mean():.2f} | "
            f"{np.median(cpu):.1f} |"
        )


def main() -> None:
    parser = arguments(__doc__, "runs/failing.jsonl", 20)
    parser.add_argument("--problems", default=",".join(CELLS))
    parser.add_argument("--counts", type=int, help="simulate so many counts with the metamodel of each seed")
    args = parser.parse_args()
    names = args.problems.split(",")
    if unknown := set(names) - set(CELLS):
        parser.error(f"--problems: {', '.join(sorted(unknown))} is none of {', '.join(CELLS)}")
    if args.counts is not None:
        show_counts(names, args.seeds, args.counts)
        return
    rows = collect(args, [{"cell": name, "seed": seed} for seed in seeds(args) for name in names], campaign)
    show([row for name in names for row in rows if row["cell"] == name])


if __name__ == "__main__":
    main()

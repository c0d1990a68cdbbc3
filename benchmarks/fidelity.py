"""What coarse runs do for an estimation: errors, intervals on problems of known truth, CPU time (docs/measured/traffic.md).

    python benchmarks/fidelity.py problems --budget 200 --seeds 50
    python benchmarks/fidelity.py problems --campaign falsification --probabilities .003 --budget 100 --seeds 10
    python benchmarks/fidelity.py highway_merge --campaign falsification --steps 0.1 0.5 --budget 150 --seeds 3
    python benchmarks/fidelity.py unprotected_left_turn --steps 0.1 0.5 --budget 2500 --seeds 2
    python benchmarks/fidelity.py testbed:two_hollows_noisy --cost 0.2 --budget 500 --seeds 50

The problems are those of `coarse_problems.py`. Theirs and a testbed's runs cost nothing, and count as what they are said to cost.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from coarse_problems import COARSE, metric_at, scenario_of

import sbt
from sbt import testbeds
from sbt.estimators.monte_carlo import Proportion

TESTBED = "testbed:"


def estimated(name: str, seed: int, budget: int, fidelity: Mapping[str, Any] | None, **more: Any) -> dict[str, float]:
    """Return estimate, coefficient of variation, ends of the interval, CPU seconds and runs of one campaign."""
    with tempfile.TemporaryDirectory() as folder:
        begun = time.process_time()
        result = sbt.run(
            campaign="estimation", scenario=name, seed=seed, budget=budget, fidelity=fidelity, stop={"cov": None},
            executor="serial", store=Path(folder) / "store", report=False, **more,
        )  # fmt: skip
        spent, found = time.process_time() - begun, result.conclusion.to_dict()
    told = found.get("fidelity") or {}
    return {
        "probability": found["probability"] or 0.0, "cov": found["cov"] or np.nan, "low": found["low"], "high": found["high"],
        "cpu": spent, "fine": told.get("fine", budget), "coarse": told.get("coarse", 0),
        "correlation": told.get("correlation") or np.nan, "hits": found["hits"], "pays": float(bool(told.get("pays"))),
    }  # fmt: skip


def falsified(name: str, seed: int, budget: int, fidelity: Mapping[str, Any] | None, **more: Any) -> dict[str, float]:
    """Return critical runs of the search, runs to the first, failure modes, CPU seconds and runs of one falsification."""
    with tempfile.TemporaryDirectory() as folder:
        begun = time.process_time()
        result = sbt.run(
            campaign="falsification", scenario=name, seed=seed, budget=budget, fidelity=fidelity, judges=[],
            executor="serial", store=Path(folder) / "store", report=False, **more,
        )  # fmt: skip
        spent, found = time.process_time() - begun, result.conclusion.to_dict()
    told = found.get("fidelity") or {}
    return {
        "critical": found["critical_runs"], "first": found["runs_to_first"] or np.inf, "modes": len(found["failure_modes"]),
        "cpu": spent, "fine": told.get("fine", budget), "coarse": told.get("coarse", 0),
        "correlation": told.get("correlation", np.nan), "screened": told.get("screened", 0),
    }  # fmt: skip


def searched(given: argparse.Namespace) -> None:
    """Print critical runs of falsifications with and without coarse runs, by seed."""
    print("| scenario | coarse runs | critical runs with, by seed | without | fine, coarse runs | CPU s with, without |")
    print("|---|---|---|---|---|---|", flush=True)
    own = given.scenario != "problems"
    for coarse in ("",) if own else given.only or COARSE:
        level = {"step_length": list(given.steps)} if own else {"scenario": scenario_of(coarse)}
        level |= {"cost": given.cost} if given.cost else {} if own else {"cost": 0.2}
        name = given.scenario if own else scenario_of(None, coarse)
        more = {} if own else {"requirement": {"metric": "y", "critical": [-np.inf, metric_at(given.probabilities[0], coarse)]}}
        rows = [[falsified(name, seed, given.budget, way, **more) for seed in range(given.seeds)] for way in (level, None)]
        found = [", ".join(f"{row['critical']:.0f}" for row in each) for each in rows]
        cpu = [np.median([row["cpu"] for row in each]) for each in rows]
        runs = ", ".join(f"{np.median([row[key] for row in rows[0]]):.0f}" for key in ("fine", "coarse"))
        told = f"{given.steps[1]:g} s" if own else coarse
        print(f"| {given.scenario} | {told} | {found[0]} | {found[1]} | {runs} | {cpu[0]:.1f}, {cpu[1]:.1f} |", flush=True)


def problems(given: argparse.Namespace) -> None:
    """Print errors and intervals on problems of known truth, over those of crude Monte Carlo with as large a budget."""
    print("| coarse runs | P | RMSE / crude | mean / P | half width / crude | cover | pay | fine, coarse runs | CPU s |")
    print("|---|---|---|---|---|---|---|---|---|", flush=True)
    for p in given.probabilities:
        for coarse in given.only or COARSE:
            requirement = {"metric": "y", "critical": [-np.inf, metric_at(p, coarse)]}
            rows = [
                estimated(
                    scenario_of(None, coarse), seed, given.budget, {"scenario": scenario_of(coarse), "cost": given.cost or 0.2},
                    requirement=requirement,
                )
                for seed in range(given.seeds)
            ]  # fmt: skip
            found = {key: np.array([row[key] for row in rows]) for key in rows[0]}
            crude = [Proportion(given.budget, int(k)) for k in np.random.default_rng(1).binomial(given.budget, p, 2000)]
            width = np.mean([c.upper(0.975) - c.lower(0.975) for c in crude])
            error = np.sqrt(((found["probability"] - p) ** 2).mean() / (p * (1.0 - p) / given.budget))
            cover = int(((found["low"] <= p) & (p <= found["high"])).sum())
            runs = f"{np.median(found['fine']):.0f}, {np.median(found['coarse']):.0f}"
            mean, wide = found["probability"].mean() / p, (found["high"] - found["low"]).mean() / width
            said = f"{coarse} | {p:g} | {error:.2f} | {mean:.2f} | {wide:.2f} | {cover} of {len(rows)}"
            print(f"| {said} | {found['pays'].mean():.0%} | {runs} | {np.median(found['cpu']):.1f} |", flush=True)


def main() -> None:
    """Print a row a campaign, and the means; or the table of the problems."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario", help="a scenario, or: problems")
    parser.add_argument("--steps", type=float, nargs=2, default=(0.1, 0.5))
    parser.add_argument("--cost", type=float)
    parser.add_argument("--budget", type=int, default=2500)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--only", nargs="*", help="with, without; of the problems, which coarse runs")
    parser.add_argument("--probabilities", type=float, nargs="*", default=(0.023, 0.38))
    parser.add_argument("--campaign", choices=("estimation", "falsification"), default="estimation")
    given = parser.parse_args()
    if given.campaign == "falsification":
        return searched(given)
    if given.scenario == "problems":
        return problems(given)
    known = testbeds.truth(given.scenario.removeprefix(TESTBED)).probability if given.scenario.startswith(TESTBED) else None
    level: dict[str, Any] = {"scenario": f"{given.scenario}:coarse"} if known else {"step_length": list(given.steps)}
    ways = {"with": level | ({} if given.cost is None else {"cost": given.cost}), "without": None}
    merit: dict[str, float] = {}
    for way, fidelity in ways.items():
        if way in (given.only or ways):
            rows = [estimated(given.scenario, seed, given.budget, fidelity) for seed in range(given.seeds)]
            for row in rows:
                print(way, " ".join(f"{key} {value:.4g}" for key, value in row.items()), flush=True)
            merit[way] = float(np.nanmean([(given.budget if known else row["cpu"]) * row["cov"] ** 2 for row in rows]))
            if known:
                p = np.array([row["probability"] for row in rows])
                covered = sum(row["low"] <= known <= row["high"] for row in rows)
                print(f"{way}: mean / truth {p.mean() / known:.3f}, spread {p.std() / known:.3f}, {covered} of {len(rows)} cover")
    if len(merit) > 1:
        print(f"cost at equal precision, without / with: {merit['without'] / merit['with']:.2f}")
    return None


if __name__ == "__main__":
    main()

"""One campaign with choices, or one campaign for each choice? On problems of known truth, with the same number of runs in all.

    python benchmarks/choices.py [--task falsification] [--seeds 20] [--store FOLDER]

Two ranges and a kind of road user with four choices (70, 20, 9 and 1 %). Falsification: only the bicycle fails, in an
ellipse; runs to the first failure, of the campaigns for each choice all four in turn. Boundary and estimation: all kinds
fail, each beyond a boundary of its own. Metamodel: RMSE of a Gaussian process after 120 random runs, that sees an axis for
each choice, or their positions as a number. Finished cells are lines of FOLDER/cells.jsonl.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from pathlib import Path

import numpy as np

import sbt
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.seeds import stream

SHARES = {"car": 0.7, "truck": 0.2, "bicycle": 0.09, "bus": 0.01}
EDGES = {"car": 3.2, "truck": 2.2, "bicycle": 1.0, "bus": 0.0}
BUDGETS = {"falsification": 100, "boundary": 120, "estimation": 120, "metamodel": 120}
WAYS = {"falsification": ("choices", "each", "random"), "boundary": ("choices", "each"), "estimation": ("choices", "each"),
        "metamodel": ("axes", "positions")}  # fmt: skip
SEEDS = {"falsification": 20, "boundary": 10, "estimation": 50, "metamodel": 20}
V = sbt.Parameter("v", -5, 5, distribution=sbt.Normal(0, 1))
GAP = sbt.Parameter("gap", -5, 5, distribution=sbt.Normal(0, 1))


def ellipse(kind: str, v: float, gap: float) -> float:
    """Return a metric that is critical (<= 0) for the bicycle only, in 8.6 % of its plane."""
    distance = ((v + 2.5) / 1.5) ** 2 + ((gap - 1.4) / 1.82) ** 2
    return distance - 1.0 if kind == "bicycle" else distance + 2.0


def edges(kind: str, v: float, gap: float) -> float:
    """Return a metric that is critical beyond an edge, bent by the gap, that differs from kind to kind."""
    return EDGES[kind] + 0.25 * gap**2 - v if kind != "truck" else EDGES[kind] + 0.5 * gap - v


FUNCTIONS = {"falsification": ellipse, "boundary": edges, "estimation": edges, "metamodel": ellipse}


def scenario(task: str, kind: str | None) -> sbt.Scenario:
    """Return the problem with all choices, or with one kind of road user."""
    function = FUNCTIONS[task]

    def evaluate(values, seed):
        return {"m": function(kind or values["kind"], values["v"], values["gap"])}

    inputs = [V, GAP] if kind else [V, GAP, sbt.Parameter("kind", choices=SHARES)]
    return sbt.Scenario(kind or "kinds", inputs=inputs, evaluate=evaluate, requirement=sbt.Requirement("m", high=0.0))


def truth() -> float:
    """Return P(critical) of the estimation task, by quadrature."""
    at = np.linspace(-5, 5, 2001)
    p = np.exp(-0.5 * at**2)
    joint = np.outer(p, p) / p.sum() ** 2
    v, gap = np.meshgrid(at, at, indexing="ij")
    return float(sum(share * joint[edges(kind, v, gap) <= 0].sum() for kind, share in SHARES.items()))


def campaigns(task: str, way: str, seed: int) -> list[tuple[float, sbt.Result]]:
    """Return the campaigns of a cell with the probability of what each is about; their stores are in a temporary folder."""
    kinds = [None] if way == "choices" else list(SHARES)
    found = []
    for k, kind in enumerate(kinds):
        budget = BUDGETS[task] if task == "falsification" else BUDGETS[task] // len(kinds)
        rest = {"stop": {"failures": 1}} if task == "falsification" else {"stop": {"cov": None}} if task == "estimation" else {}
        folder = tempfile.mkdtemp(dir=SCRATCH[0])
        result = sbt.run(
            campaign=task, scenario=scenario(task, kind), seed=4 * seed + k, budget=budget, metamodel="gp", executor="serial",
            store=f"{folder}/store", report=False, **rest,
        )  # fmt: skip
        found.append((SHARES[kind] if kind else 1.0, result))
    return found


def falsification(way: str, seed: int) -> dict:
    if way == "random":
        rng = stream(seed, "random")
        v, gap, kind = rng.uniform(-5, 5, 5000), rng.uniform(-5, 5, 5000), rng.integers(0, 4, 5000)
        hit = [ellipse(list(SHARES)[k], a, b) <= 0 for a, b, k in zip(v, gap, kind, strict=True)]
        return {"value": int(np.argmax(hit)) + 1}
    found = [r.conclusion.runs_to_first or math.inf for _, r in campaigns("falsification", way, seed)]
    return {"value": min(len(found) * min(found), BUDGETS["falsification"])}


def boundary(way: str, seed: int) -> dict:
    rng = stream(99, "reference")
    v, gap, kind = rng.uniform(-5, 5, 20_000), rng.uniform(-5, 5, 20_000), rng.integers(0, 4, 20_000)
    y = np.array([edges(list(SHARES)[k], a, b) for k, a, b in zip(kind, v, gap, strict=True)])
    p = np.empty(len(y))
    for k, (_, result) in enumerate(campaigns("boundary", way, seed)):
        mine = np.ones(len(y), dtype=bool) if way == "choices" else kind == k
        at = {"v": v[mine], "gap": gap[mine]} | ({"kind": np.array(list(SHARES))[kind[mine]]} if way == "choices" else {})
        p[mine] = result.predict(at)["p_critical"]
    right = ((p > 0.5) & (y <= 0)).sum()
    return {"value": float(2 * right / ((p > 0.5).sum() + (y <= 0).sum()))}


def estimation(way: str, seed: int) -> dict:
    found = campaigns("estimation", way, seed)
    value = sum(share * (r.conclusion.probability or 0.0) for share, r in found)
    low, high = (sum(share * getattr(r.conclusion, end) for share, r in found) for end in ("low", "high"))
    return {"value": value, "low": low, "high": high}


def metamodel(way: str, seed: int) -> dict:
    space, rng = scenario("metamodel", None).space, stream(seed, "metamodel")
    u = rng.random((2120, 3))
    y = np.array([ellipse(**space.named(x)) for x in space.from_unit(u)])
    seen = space.metamodel_inputs(u) if way == "axes" else space.cube.snapped(u)
    predicted = GaussianProcess().fit(seen[:120], y[:120], stream(seed, "fit"))(seen[120:]).mu
    return {"value": float(np.sqrt(np.mean((predicted - y[120:]) ** 2)) / y.std())}


TASKS = {"falsification": falsification, "boundary": boundary, "estimation": estimation, "metamodel": metamodel}
SCRATCH: list[str] = []


def line(task: str, way: str, cells: list[dict]) -> str:
    values = np.array([cell["value"] for cell in cells])
    if task == "falsification":
        ends = np.quantile(values, [0.1, 0.9])
        said = f"{np.median(values):.0f} runs to the first failure ({ends[0]:.0f} to {ends[1]:.0f})"
    elif task == "metamodel":
        ends = np.quantile(values, [0.1, 0.9])
        said = f"RMSE {100 * np.median(values):.1f} % of the spread ({100 * ends[0]:.1f} to {100 * ends[1]:.1f} %)"
    elif task == "boundary":
        said = f"F1 {np.median(values):.3f} ({np.quantile(values, 0.1):.3f} to {np.quantile(values, 0.9):.3f})"
    else:
        exact = truth()
        error, bias = np.sqrt(np.mean((values / exact - 1) ** 2)), values.mean() / exact - 1
        standard = values.std(ddof=1) / exact / math.sqrt(len(values))
        held = np.mean([cell["low"] <= exact <= cell["high"] for cell in cells])
        width = np.median([(cell["high"] - cell["low"]) / exact for cell in cells])
        said = f"relative RMSE {100 * error:.0f} %, bias {100 * bias:+.1f} % (standard error {100 * standard:.1f} %)"
        said += f", intervals that hold {100 * held:.0f} %, median width {100 * width:.0f} %"
    return f"| {task} | {BUDGETS[task]} | {way} | {len(cells)} | {said} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=list(TASKS), action="append")
    parser.add_argument("--seeds", type=int)
    parser.add_argument("--store", type=Path, default=Path("runs/choices"))
    given = parser.parse_args()
    given.store.mkdir(parents=True, exist_ok=True)
    file = given.store / "cells.jsonl"
    done = {tuple(cell["key"]): cell for cell in map(json.loads, file.read_text().splitlines())} if file.is_file() else {}
    for task in given.task or TASKS:
        seeds = given.seeds or SEEDS[task]
        for way in WAYS[task]:
            for seed in range(seeds):
                if (task, way, seed) not in done:
                    with tempfile.TemporaryDirectory() as folder:
                        SCRATCH[:] = [folder]
                        done[task, way, seed] = {"key": [task, way, seed], **TASKS[task](way, seed)}
                    with file.open("a") as out:
                        out.write(json.dumps(done[task, way, seed]) + "\n")
            print(line(task, way, [done[task, way, seed] for seed in range(seeds)]), flush=True)


if __name__ == "__main__":
    main()

"""How many runs does a boundary save that learns from an earlier campaign of another setup?

    python benchmarks/boundary_warm.py [--seeds 3] [--budget 160] [--cases "shifted;cut_in, step"] [--table runs/warm.jsonl]

The earlier campaign is a boundary of 500 runs of the other setup, of two of them. In SUMO it has a reaction time of 0.2 s and the
new one 0.5 s, or a step of 0.2 s and the new one 0.02 s. After 20, 40, 80 and 160 runs the metamodel is asked which of 4,096
random points are critical (F1; in SUMO of as many even runs).
Finished cells are lines of the table: run again to go on, or split seeds over processes (`resumed.py`).
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from resumed import arguments, collect, seeds

import sbt
from sbt.seeds import stream

SLOW, SLOWER = ({"ego": {"kind": "acc_aeb", "reaction_time": seconds}} for seconds in (0.2, 0.5))
SUMO = {
    "cut_in": (SLOW, SLOWER),
    "emergency_braking": (SLOW, SLOWER),
    "cut_in, step": ({"simulation": {"step_length": 0.2}}, {"simulation": {"step_length": 0.02}}),
}
"""What the earlier and the new campaign of a scenario are given."""


def _hartmann(x):
    a = np.array([[10, 3, 17, 3.5, 1.7, 8], [0.05, 10, 17, 0.1, 8, 14], [3, 3.5, 1.7, 10, 17, 8], [17, 8, 0.05, 10, 0.1, 14]])
    p = 1e-4 * np.array([
        [1312, 1696, 5569, 124, 8283, 5886], [2329, 4135, 8307, 3736, 1004, 9991], [2348, 1451, 3522, 2883, 3047, 6650],
        [4047, 8828, 8732, 5743, 1091, 381],
    ])  # fmt: skip
    return -np.exp(-(a * (x[:, None] - p) ** 2).sum(axis=2)) @ np.array([1.0, 1.2, 3.0, 3.2])


def _ring(x):
    return np.abs(np.linalg.norm(x - 0.5, axis=1) - 0.35) - 0.06


def _waves(x):
    return np.sin(6 * x[:, 0]) + np.cos(5 * x[:, 1]) * x[:, 2] + 0.8 * x[:, 0] - 0.3


CASES = {
    "shifted": (6, lambda x: _hartmann(x) + 1.2, lambda x: _hartmann(np.clip(x + 0.05, 0, 1)) + 1.1),
    "bent": (6, lambda x: _hartmann(x) + 1.2, lambda x: 1.1 * _hartmann(x) + 1.2 + 0.4 * np.sin(3 * x[:, 0] + 2 * x[:, 3])),
    "ring": (3, _ring, lambda x: 1.5 * _ring(0.97 * x + 0.02) + 0.01),
    "waves": (3, _waves, lambda x: 0.7 * _waves(x) + 0.2 * x[:, 0] ** 2),
    "unrelated": (3, _waves, _ring),
    "opposite": (3, _waves, lambda x: -_waves(x)),
    "jump": (3, lambda x: np.where(_waves(x) < 0, -1.4, 0.05), lambda x: np.where(_waves(x + 0.03) < 0, -1.4, 0.05)),
}
"""Number of inputs, and the metric of the earlier and of the new setup; at most 0 is critical."""


def scenario(case: str, which: int):
    """Return the earlier (0) or the new (1) setup of a case."""
    d, function = CASES[case][0], CASES[case][1 + which]

    def evaluate(values, seed):
        return {"y": float(function(np.array([[values[f"x{k}"] for k in range(d)]]))[0])}

    inputs = [sbt.Parameter(f"x{k}", 0.0, 1.0) for k in range(d)]
    return sbt.Scenario(f"{case}_{which}", inputs=inputs, evaluate=evaluate, requirement=sbt.Requirement("y", high=0.0))


def keys_of(case: str, which: int) -> dict:
    """Return what a campaign of the setup is given."""
    if case in SUMO:
        return {"scenario": case.partition(",")[0], **SUMO[case][which]}
    return {"scenario": scenario(case, which)}


class Campaigns:
    """Campaigns of every case, with the earlier one of each in a folder: run once, when it is first needed."""

    def __init__(self, folder: Path, budget: int, earlier: int, reference: int) -> None:
        self._folder, self._budget, self._runs, self._reference = folder, budget, earlier, reference

    def _run(self, name: str, case: str, which: int, **keys) -> sbt.Result:
        given = {"campaign": "boundary", "executor": "serial", "report": False, "stop": {}, **keys_of(case, which), **keys}
        return sbt.run(store=self._folder / name, **given)

    def earlier(self, case: str, seed: int) -> Path:
        """Return the store of the earlier campaign."""
        store = self._folder / f"{case}_{seed % 2}_earlier"
        if not store.exists():
            self._run(store.name, case, 0, seed=1000 + seed % 2, budget=self._runs)
        return store

    def truth(self, case: str):
        """Return random points in the unit cube, and whether they are critical."""
        if case in CASES:
            u = stream(99, "reference").random((4096, CASES[case][0]))
            return u, CASES[case][2](u) <= 0.0
        store = self._folder / f"{case}_truth"
        if not store.exists():
            self._run(store.name, case, 1, campaign="coverage", seed=99, budget=self._reference, metamodel=None, stop={})
        result = sbt.open(store)
        runs = result.history.finished
        return result.scenario.space.to_unit(runs.x), result.scenario.requirement.critical_runs(runs)

    def run(self, case: str, way: str, seed: int) -> dict:
        """Return F1 after so many runs."""
        warm = {"warm_start": {"store": str(self.earlier(case, seed)), "transfer": True}} if way == "warm" else {}
        result = self._run(f"{case}_{way}_{seed}", case, 1, seed=seed, budget=self._budget, **warm)
        learner, (u, hit), found = result.study.learner, self.truth(case), {}
        for n in _points(self._budget):
            fitted = learner.fit(result.history.where(np.arange(len(result.history)) < n))
            p = fitted.predict(u).probability(learner.scenario.requirement.critical) > 0.5
            found[str(n)] = round(float(2 * (p & hit).sum() / max(p.sum() + hit.sum(), 1)), 4)
            found[f"earlier_{n}"] = fitted.record.earlier
        return {"f1": found, "share": float(hit.mean())}


def _points(budget: int) -> list[int]:
    return [n for n in (20, 40, 80, 160) if n <= budget]


def main() -> None:
    """Print the table."""
    parser = arguments(__doc__, "runs/boundary_warm.jsonl", 6)
    parser.add_argument("--budget", type=int, default=160)
    parser.add_argument("--earlier", type=int, default=500, help="runs of the earlier campaign")
    parser.add_argument("--reference", type=int, default=4096, help="even runs in SUMO that tell the truth")
    parser.add_argument("--cases", default=";".join([*CASES, *SUMO]))
    args = parser.parse_args()
    jobs = [{"case": c, "way": w, "seed": s} for c in args.cases.split(";") for s in seeds(args) for w in ("scratch", "warm")]
    with tempfile.TemporaryDirectory() as folder:
        rows = collect(args, jobs, Campaigns(Path(folder), args.budget, args.earlier, args.reference).run)
    points = _points(args.budget)
    print("| case | way | seeds | " + " | ".join(f"F1 at {n}" for n in points) + " | left out |")
    print("|---" * (4 + len(points)) + "|")
    for case in dict.fromkeys(row["case"] for row in rows):
        for way in ("scratch", "warm"):
            mine = [row["f1"] for row in rows if row["case"] == case and row["way"] == way]
            cells = [f"{np.median([f[str(n)] for f in mine]):.2f} ({min(f[str(n)] for f in mine):.2f})" for n in points]
            gone = sum(f[f"earlier_{n}"] == 0 for f in mine for n in points)
            print(f"| {case} | {way} | {len(mine)} | " + " | ".join(cells) + f" | {gone} of {len(mine) * len(points)} |")


if __name__ == "__main__":
    main()

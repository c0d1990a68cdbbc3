"""What the framework costs a run, beside stepping SUMO and the controllers.

    python benchmarks/overhead.py [--runs 2000]

`worker`: everything a worker does for a cut_in run except the steps and the controllers: building the
scene, inserting and verifying, the trace, all metrics, removing the actors. `driver`: the whole
campaign with a scenario that does nothing, planned, executed in workers and committed run by run.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import textwrap
import time
from pathlib import Path
from unittest.mock import patch

import numpy as np
from scipy.stats import qmc

import sbt
from sbt.execution.spec import ScenarioSpec
from sbt.sumo import simulation
from sbt.sumo.sumo_run import SumoRun

EMPTY = """
import sbt

SCENARIO = sbt.Scenario(
    "empty", [sbt.Parameter("a", 0, 1), sbt.Parameter("b", 0, 1)], sbt.Requirement("y", high=0.5),
    evaluate=lambda values, seed: {"y": values["a"]},
)
"""


def worker(runs: int) -> list[float]:
    """Return milliseconds a run outside the loop over the steps, five times."""
    scenario = ScenarioSpec("cut_in").resolve()
    x = scenario.space.from_unit(qmc.Sobol(2, rng=1).random_base2(math.ceil(math.log2(runs)))[:runs])
    values = [dict(zip(scenario.space.names, map(float, row), strict=True)) for row in x]
    inside, found = [0.0], []

    class TimedRun(SumoRun):
        """Knows how long the loop over the steps took: from its making to its trace."""

        def __init__(self, *args):
            super().__init__(*args)
            self.begun = time.perf_counter()

        def trace(self):
            inside[0] += time.perf_counter() - self.begun
            return super().trace()

    with patch.object(simulation, "SumoRun", TimedRun):
        scenario.run(values[0], 0)
        for _ in range(5):
            inside[0] = 0.0
            start = time.perf_counter()
            for k, v in enumerate(values):
                scenario.run(v, k)
            found.append((time.perf_counter() - start - inside[0]) / runs * 1e3)
    if inside[0] == 0.0:
        raise RuntimeError("no run was timed")
    return found


def driver(runs: int) -> list[float]:
    """Return milliseconds a run of a campaign whose scenario does nothing, five times."""
    found = []
    for _ in range(5):
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "empty.py").write_text(textwrap.dedent(EMPTY))
            result = sbt.run(
                campaign="coverage", scenario=f"{folder}/empty.py:SCENARIO", budget=runs, batch=runs, initial=runs,
                executor="local", workers=2, store=f"{folder}/store", report=False,
            )  # fmt: skip
            seconds = result.summary["seconds"]
        found.append((seconds["simulate"] + seconds["propose"]) / runs * 1e3)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=2000)
    args = parser.parse_args()
    print("| overhead | ms a run: median (min, max) of 5 |\n|---|---|")
    for name, values in {"worker, cut_in": worker(min(args.runs, 500)), "driver, empty simulation": driver(args.runs)}.items():
        print(f"| {name} | {np.median(values):.3f} ({min(values):.3f}, {max(values):.3f}) |")


if __name__ == "__main__":
    main()

"""What does it cost to propose a batch, fit of the metamodel included?

    python benchmarks/proposals.py [--runs 200,500,2000] [--testbed hartmann6_1e-3] [--repeats 3]

CPU seconds on one core of a proposal of ten runs after so many, by campaign with default settings, in a campaign
through the public way whose first batch is that large.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

import sbt
from sbt.campaigns.falsification import SearchStage
from sbt.campaigns.parts import BatchStage
from sbt.campaigns.sequential import SequentialStage

STAGES = {"boundary": BatchStage, "falsification": SearchStage, "estimation": SequentialStage}


def proposal(campaign: str, testbed: str, runs: int, seed: int) -> float:
    """Return the CPU seconds of the batch after the first one."""
    stage, spent = STAGES[campaign], []
    original = stage.propose

    def timed(self, log):
        start = time.process_time()
        batch = original(self, log)
        spent.append(time.process_time() - start)
        return batch

    stage.propose = timed
    try:
        with tempfile.TemporaryDirectory() as folder:
            sbt.run(
                campaign=campaign, scenario=f"testbed:{testbed}", budget=runs + 10, initial=runs, batch=10, seed=seed,
                stop={"failures": None}, executor="serial", store=f"{folder}/store", report=False,
            )  # fmt: skip
    finally:
        stage.propose = original
    return spent[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", default="200,500,2000")
    parser.add_argument("--testbed", default="hartmann6_1e-3")
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    sizes = [int(n) for n in args.runs.split(",")]
    print("| campaign | " + " | ".join(f"{n} runs" for n in sizes) + " |\n|" + "---|" * (1 + len(sizes)))
    for campaign in STAGES:
        proposal(campaign, args.testbed, 20, 0)  # libraries are imported at the first call
        took = [np.median([proposal(campaign, args.testbed, n, seed) for seed in range(args.repeats)]) for n in sizes]
        print(f"| {campaign} | " + " | ".join(f"{t:.2f}" for t in took) + " |", flush=True)


if __name__ == "__main__":
    main()

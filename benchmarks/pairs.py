"""Critical runs of distinct traffic in 200 runs of a falsification, with and without covariates (docs/measured/traffic.md).

    python benchmarks/pairs.py unprotected_left_turn highway_merge --seeds 2

Critical runs of the search count, each seed once; confirmations do not.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import sbt

NAMES = ("unprotected_left_turn", "highway_merge", "roundabout_entry", "crossing_pedestrian")


def distinct(name: str, seed: int, runs: int, *, covariates: bool | None) -> int:
    """Return the number of seeds with a critical run of the search."""
    with tempfile.TemporaryDirectory() as folder:
        result = sbt.run(
            campaign="falsification", scenario=name, seed=seed, budget=runs, covariates=covariates, judges=[],
            executor="serial", store=Path(folder) / "store", report=False,
        )  # fmt: skip
        frame = result.frame
        return int(frame[(frame.stage != "confirm") & frame.critical.fillna(value=False)].seed.nunique())


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=NAMES)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--runs", type=int, default=200)
    given = parser.parse_args()
    print("| scenario | pairs, by seed | inputs alone, by seed |\n|---|---|---|")
    for name in given.names:
        found = [[distinct(name, seed, given.runs, covariates=c) for seed in range(given.seeds)] for c in (None, False)]
        print(f"| `{name}` | {' | '.join(', '.join(map(str, counts)) for counts in found)} |", flush=True)


if __name__ == "__main__":
    main()

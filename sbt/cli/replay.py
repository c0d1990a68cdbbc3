"""The verb `replay`: a stored run again, and whether it is the same to the last bit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sbt.cli.campaign import Folder
from sbt.cli.console import Exit, clean_stdout, fail, print_json

__all__ = ["replay"]


def replay(
    folder: Folder,
    run: Annotated[int, typer.Argument(metavar="RUN", help="Index of the run, as in the report.")],
    *,
    trace: Annotated[Path | None, typer.Option(metavar="FILE.csv", help="Write the states over time.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as one JSON object.")] = False,
) -> None:
    """Execute a stored run again and compare it with the store, bit by bit."""
    with clean_stdout():
        from sbt.run import replay as execute

        record, outcome, states = execute(folder, run)
        if trace is not None and states is not None:
            import csv

            rows = states.rows()
            with trace.open("w", newline="") as file:
                writer = csv.DictWriter(file, list(rows[0]))
                writer.writeheader()
                writer.writerows(rows)
    same = str(outcome.status) == record.status and dict(outcome.metrics) == dict(record.metrics)
    if as_json:
        print_json({
            "run": record.index, "inputs": dict(record.inputs), "seed": record.seed, "status": str(outcome.status),
            "metrics": dict(outcome.metrics), "identical": same, "reason": outcome.reason,
            "ended": states.ended if states is not None else "",
        })  # fmt: skip
    else:
        ended = f", ended: {states.ended}" if states is not None else ""
        print(f"run {record.index}, seed {record.seed}: {outcome.status}{ended}")
        for name, value in outcome.metrics.items():
            print(f"  {name:<23} {value:.6g}")
        print("identical to the stored run" if same else "NOT identical to the stored run")
    if not same:
        now, stored = f"{outcome.status} {dict(outcome.metrics)}", f"{record.status} {dict(record.metrics)}"
        raise fail(f"a replay must equal the stored run, but got {now}, not {stored}", Exit.INTERNAL)

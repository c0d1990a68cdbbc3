"""The verb for recorded traffic: metrics."""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from sbt.cli.console import clean_stdout, print_json
from sbt.errors import InputError, RunError
from sbt.files import as_cell

__all__ = ["metrics"]

_OF_A_PAIR = ("ego", "other", "begin", "end")
"""Columns of a pair; a metric of such a name is called `y.NAME`, as in exports."""


def metrics(
    file: Annotated[
        Path, typer.Argument(metavar="FCD_FILE", help="SUMO's FCD (.xml[.gz], .csv[.gz], .parquet), or tracks (highD, inD).")
    ],
    *,
    pairs: Annotated[
        str, typer.Option(metavar="within=METRES", help="Only pairs of road users that come so near (centres, m).")
    ] = "within=100",
    length: Annotated[float, typer.Option(help="Length of vehicles whose length is not in the file (m).")] = 5.0,
    width: Annotated[float, typer.Option(help="Width of vehicles whose width is not in the file (m).")] = 1.8,
    out: Annotated[Path | None, typer.Option(metavar="FILE.csv", help="Write the table to this file.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Compute every installed metric for every pair of road users of recorded traffic, each as ego in turn."""
    with clean_stdout():
        from sbt.metrics.fcd import catalogue, encounters
        from sbt.metrics.tracks import read_recording

        within = _within(pairs)
        measured = {f"y.{m.name}" if m.name in _OF_A_PAIR else m.name: m for m in catalogue()}
        recording = read_recording(file, length=length, width=width)
        rows = [
            {"ego": ego, "other": other, "begin": float(trace.time[0]), "end": float(trace.time[-1])}
            | {name: _value(metric, trace) for name, metric in measured.items()}
            for ego, other, trace in encounters(recording, within)
        ]  # fmt: skip
    touching = sum(row.get("collision") == 1.0 for row in rows)
    if recording.z is None and touching:
        what = f"{touching} of {len(rows)} rows have a collision, and '{file}' has no heights (z)"
        print(f"note: {what}: who is on a bridge touches who is below it in the plane", file=sys.stderr)
    if recording.assumed and rows:
        what = f"{recording.assumed} of {recording.kinds.count('vehicle')} vehicles have no length or width in '{file}'"
        print(f"note: {what}, and are taken for {length:g} m x {width:g} m (--length, --width)", file=sys.stderr)
    columns = [*_OF_A_PAIR, *measured]
    if out is not None:
        try:
            with out.open("w", newline="") as target:
                _write(target, columns, rows)
        except OSError as error:
            raise InputError(f"--out must be a file that can be written, but got '{out}': {error.strerror}") from None
    if as_json:
        units = {name: metric.unit for name, metric in measured.items()}
        print_json({"file": str(file), "road_users": len(recording.names), "steps": len(recording.time),
                    "heights": recording.z is not None, "assumed_sizes": recording.assumed, "within": within, "units": units,
                    "pairs": rows})  # fmt: skip
    elif out is None:
        _write(sys.stdout, columns, rows)
    else:
        print(f"{len(rows)} rows of {len(recording.names)} road users over {len(recording.time)} time steps in {out}")


def _within(text: str) -> float:
    key, _, value = text.partition("=")
    try:
        within = float(value)
    except ValueError:
        within = -1.0
    if key != "within" or not 0 < within < float("inf"):
        raise InputError(f"--pairs must be within=METRES with a number > 0, but got '{text}'")
    return within


def _value(metric: Any, trace: Any) -> float | None:
    """Return a metric of a trace, None where it has none (another package's metric may need another actor)."""
    try:
        return float(metric(trace))
    except RunError:
        return None


def _write(target: Any, columns: list[str], rows: list[dict[str, Any]]) -> None:
    writer = csv.DictWriter(target, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: as_cell(value) for key, value in row.items()} for row in rows)

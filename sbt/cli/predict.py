"""The verb predict: predictions of a campaign's metamodel."""

from __future__ import annotations

import csv
import io
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from sbt.cli.campaign import Folder, Trust, with_store
from sbt.cli.console import clean_stdout, print_json
from sbt.errors import InputError
from sbt.files import as_cell

__all__ = ["predict"]


def predict(
    folder: Folder,
    *,
    inputs: Annotated[Path, typer.Option("--inputs", metavar="FILE.csv", help="A column for each input, a row each.")],
    output: Annotated[Path | None, typer.Option("--output", metavar="FILE.csv", help="Write here; default: print.")] = None,
    device: Annotated[str | None, typer.Option("--device", help="auto, cpu or cuda; default: where it was fitted.")] = None,
    trust: Trust = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Predict concrete scenarios with the campaign's metamodel: mean, sigma, P(critical)."""
    with clean_stdout():
        with_store(folder, trust=trust)
        from sbt.workflows.prediction import predict_rows

        table = predict_rows(folder, inputs, device)
    rows = table.rows()
    if table.ignored:
        print(f"not inputs, ignored: {', '.join(table.ignored)}", file=sys.stderr)
    if output is not None or not as_json:
        text = io.StringIO()
        names = [*table.inputs, *table.columns]
        writer = csv.writer(text, lineterminator="\n")
        lines: list[list[Any]] = [names, *([row[name] for name in names] for row in rows)]
        writer.writerows([as_cell(value) for value in line] for line in lines)
        _write(text.getvalue(), output)
    if as_json:
        print_json({
            "store": str(folder), "metric": table.metric, "metamodel": table.metamodel, "learned": table.learned,
            "source": table.source, "rows": rows,
        })  # fmt: skip
    else:
        print(f"{table.metric} by {table.metamodel}, {table.source}, learned from {table.learned} runs", file=sys.stderr)


def _write(text: str, output: Path | None) -> None:
    if output is None:
        print(text, end="", flush=True)
        return
    try:
        output.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"--output must be a file that can be written, but {output}: {error.strerror}") from None

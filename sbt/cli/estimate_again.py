"""The verb estimate-again: another question to the runs of an estimation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sbt.cli.campaign import Folder, Trust, with_store
from sbt.cli.console import clean_stdout, next_command, print_json
from sbt.errors import InputError

if TYPE_CHECKING:
    from sbt.workflows.asking import Answer

__all__ = ["estimate_again", "sensitivity_lines"]

_UNKNOWN = "dP/dvalue -: not known (an end of the distribution at which it has a density moves with the value, or no draw tells)"


def estimate_again(
    folder: Folder,
    *,
    inputs: Annotated[
        Path | None,
        typer.Option("--inputs", metavar="FILE.yaml", help="Other distributions: inputs: {...}, as in configurations."),
    ] = None,
    critical: Annotated[
        str | None, typer.Option("--critical", metavar="LOW,HIGH", help="Another critical interval, such as --critical=-inf,0.5.")
    ] = None,
    metric: Annotated[str | None, typer.Option("--metric", help="Another metric that the runs measured.")] = None,
    trust: Trust = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Estimate under other distributions, or another requirement, from the runs there are; nothing is run or stored."""
    interval = None if critical is None else _interval(critical)
    with clean_stdout():
        with_store(folder, trust=trust)
        from sbt.workflows.asking import estimate_again as ask

        found = ask(folder, inputs, critical=interval, metric=metric)
    if as_json:
        print_json(found.to_dict())
    else:
        print("\n".join(_lines(found)))
        next_command("sumo-sbt", "report", folder)


def _interval(text: str) -> tuple[float, float]:
    """Return the ends of an interval that is written LOW,HIGH."""
    try:
        low, high = (float(part.strip().replace(".inf", "inf")) for part in text.strip("[] ").split(","))
    except ValueError:
        raise InputError(f"--critical must be LOW,HIGH, such as -inf,0.5, but got '{text}'") from None
    return low, high


def _lines(found: Answer) -> list[str]:
    """Return the answer for people."""
    requirement, answer = found.requirement, found.conclusion
    asked = ", ".join(f"{part.metric} in [{part.low:g}, {part.high:g}]" for part in requirement.parts)
    asked = f"{requirement.metric}: {asked}" if requirement.combined else asked
    lines = [f"{found.store}: {asked}, {answer.counted} draws count"]
    lines += [f"  {sentence}" for sentence in found.sentences()]
    lines += [f"  warning: {warning}" for warning in answer.warnings]
    return [*lines, *sensitivity_lines([vars(each) for each in found.sensitivity])]


def sensitivity_lines(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the sensitivities as a table; empty where there are none."""
    if not rows:
        return []
    head = ("input", "parameter", "value", "dP/dvalue", "+-", "elasticity", "change", "P raised", "P lowered")
    keys = ("input", "parameter", "value", "derivative", "std_error", "elasticity", "change", "raised", "lowered")
    from sbt.campaigns.wording import input_value

    table = [head, *(tuple(input_value(row[key]) if key == "value" else _shown(row[key]) for key in keys) for row in rows)]
    widths = [max(len(row[k]) for row in table) for k in range(len(head))]
    lines = ["  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in table]
    unknown = any(row["derivative"] is None for row in rows)
    return [*lines, f"  {_UNKNOWN}"] if unknown else lines


def _shown(value: Any) -> str:
    return "-" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)

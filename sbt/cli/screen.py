"""How a person sees a result: sentences, a small table with units, and the next command; on a terminal only."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

__all__ = ["on_screen", "show_result"]

_BESIDE = 42
"""Characters that the columns beside the inputs of a failure mode take."""
_NARROWEST = 5
"""Characters of the narrowest column of numbers."""


def on_screen() -> bool:
    """Say whether stdout is a terminal."""
    return sys.stdout.isatty()


def show_result(result: Mapping[str, Any], report: str, following: str | None) -> None:
    """Print how a campaign ended.

    Args:
        result: as `run --json` prints it, with sentences.
        report: path of the report, or of the store.
        following: the next command to try.
    """
    from rich.console import Console
    from rich.padding import Padding
    from rich.text import Text

    console = Console(file=sys.stdout, force_terminal=True, highlight=False, soft_wrap=False)
    conclusion = result["conclusion"]
    counts = f"{result['runs']:,} runs, {result['critical']:,} critical, {result['failed']:,} failed"
    ended = f"; stopped: {result['stopped']}" if result.get("stopped") else ""
    console.print(Text.assemble((f"{result['campaign']} of {result['scenario']}", "bold cyan"), (f"  {counts}{ended}", "dim")))
    console.print()
    for k, sentence in enumerate(result["sentences"]):
        style = "bold" if k == 0 else "" if k < 3 else "dim"
        console.print(Padding(Text(sentence, style=style), (0, 0, 1 if k < 2 else 0, 0)))
        if k == 2:
            table = _modes(result, console.width) if conclusion.get("failure_modes") else _figures(conclusion)
            if table is not None:
                console.print()
                console.print(table)
    for warning in conclusion.get("warnings", ()):
        console.print(Text(f"warning: {warning}", style="yellow"))
    console.print()
    console.print(Text.assemble(("report  ", "dim"), report), soft_wrap=True)
    if following is not None:
        console.print(Text.assemble(("next    ", "dim"), (following, "bold")), soft_wrap=True)


def _table(*columns: str) -> Any:
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for k, name in enumerate(columns):
        table.add_column(name, justify="left" if k == 0 else "right", no_wrap=True)
    return table


def _modes(result: Mapping[str, Any], width: int) -> Any:
    """Return the table of failure modes, with as many inputs as there is room for."""
    from sbt.campaigns.wording import input_value, number, unit_of, written_unit

    modes, units = result["conclusion"]["failure_modes"], result.get("units", {})

    def head(name: str, unit: str) -> str:
        unit = written_unit(unit)
        return f"{name}\n{unit}" if unit else name

    names, room = [], width - _BESIDE - len(result["metric"])
    for name in modes[0]["inputs"]:
        wide = max((mode.get("digits") or {}).get(name, 0) for mode in modes) + 1
        room -= max(len(name), _NARROWEST, wide) + 3
        if room < 0:
            break
        names.append(name)
    told = (head(result["metric"], unit_of(units, result["metric"])), *(head(name, units.get(name, "")) for name in names))
    table = _table("mode", "run", *told, "critical\nruns", "critical\nagain")
    for k, mode in enumerate(modes, start=1):
        again, digits = mode.get("confirmed"), mode.get("digits") or {}
        gave = mode.get("confirmation_runs", 0) - (mode.get("confirmations_lost") or 0)
        inputs = [input_value(mode["inputs"][name], digits=digits.get(name, 3)) for name in names]
        table.add_row(
            str(k), str(mode["representative"]), number(mode["metric"], 3), *inputs,
            str(mode["size"]), "" if again is None else f"{round(again * gave)} of {gave}",
        )  # fmt: skip
    return table


_FIGURES = {
    "probability": "probability of a critical run", "exact_bound": "probability at most", "cov": "coefficient of variation",
    "undetected_mass_bound": "what no run has met, at most", "critical_fraction": "critical share of the space",
    "ambiguous_volume": "share of the space where P is 0.05 to 0.95",
}  # fmt: skip
_SCORES = {"error_rate": "held-out runs on the wrong side", "average_precision": "average precision"}
_SHARES = {"critical_fraction", "ambiguous_volume", "error_rate"}


def _figures(conclusion: Mapping[str, Any]) -> Any:
    """Return the table of the figures that matter; None where there are none."""
    from sbt.campaigns.wording import number, percent

    rows = [(name, key, conclusion.get(key)) for key, name in _FIGURES.items()]
    rows += [(name, key, (conclusion.get("validation") or {}).get(key)) for key, name in _SCORES.items()]
    rows = [(name, key, value) for name, key, value in rows if isinstance(value, (int, float))]
    if not rows:
        return None
    table, ends = _table("", "", "95 % interval"), (conclusion.get("low"), conclusion.get("high"))
    held = conclusion.get("held_out_fraction") or {}
    whose = {"critical_fraction": "critical share of the rows"} if conclusion.get("rows") else {}
    for name, key, value in rows:

        def written(value: float, key: str = key) -> str:
            return percent(value) if key in _SHARES else number(float(value), 3)

        low, high = ends if key in ("probability", "critical_fraction") else (None, None)
        between = "" if low is None or high is None else f"{written(low)} to {written(high)}"
        table.add_row(whose.get(key, name), written(float(value or 0.0)), between)
    if held.get("critical_fraction") is not None:
        low, high = percent(held["low"]), percent(held["high"])
        table.add_row("the same by the held-out runs", percent(held["critical_fraction"]), f"{low} to {high}")
    return table

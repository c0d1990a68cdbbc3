"""The verb `compare-ego`: two egos on the same draws."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from sbt.cli.console import (
    Exit,
    ProgressDisplay,
    clean_stdout,
    fail,
    fail_where_most_failed,
    infinite,
    next_command,
    print_json,
    resumable,
)

__all__ = ["compare_ego"]

_SHOWN = 5


def compare_ego(
    first: Annotated[Path, typer.Argument(metavar="A.yaml", help="Configuration with the ego before.")],
    second: Annotated[Path, typer.Argument(metavar="B.yaml", help="The same with the ego after.")],
    *,
    store: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder of both campaigns.")] = None,
    runs: Annotated[int | None, typer.Option(min=1, help="Pairs of runs; default: the budget of A.")] = None,
    rare: Annotated[
        bool, typer.Option("--rare", help="Critical runs are rare: estimate each probability, B's by what A's campaign taught.")
    ] = False,
    fail_if_rose: Annotated[bool, typer.Option("--fail-if-rose", help="Exit 3 if the probability rose.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as one JSON object.")] = False,
) -> None:
    """Run both on the same draws: did the probability fall, which failures were fixed, which are new."""
    folder = store if store is not None else Path("runs") / f"compare_{first.stem}_{second.stem}"
    with resumable("*/campaign.sqlite") as work, clean_stdout(), ProgressDisplay(silent=as_json) as show:
        from sbt.workflows.paired import compare_egos, compare_rare

        work.folder = folder
        result = (compare_rare if rare else compare_egos)(first, second, store=folder, runs=runs, progress=show)
    if as_json:
        print_json(result if rare else {**result, **{kind: [_whole(pair) for pair in result[kind]] for kind in ("fixed", "new")}})
    else:
        print("\n".join(_rare_lines(result) if rare else _lines(result)))
        if not rare and (result["new"] or result["fixed"]):
            side, found = ("b", result["new"]) if result["new"] else ("a", result["fixed"])
            next_command("sumo-sbt", "replay", folder / side, str(found[0]["run"]), "--film", "run.gif")
    if fail_if_rose and result["verdict"] == "rose":
        raise fail("the probability of a critical run rose", Exit.CRITICAL)
    for name in ("before", "after"):
        fail_where_most_failed(result[name]["failed"], result[name]["runs"] if rare else result["pairs"], f" ({name})")


def _lines(result: Mapping[str, Any]) -> list[str]:
    """Return the comparison for people."""
    lines = [f"{result['pairs']} pairs of runs with common draws and seeds, {result['confidence']:.0%} intervals"]
    for name in ("before", "after"):
        s = result[name]
        lines.append(f"  {name:<8}{s['probability']:.4g} ({s['low']:.4g} to {s['high']:.4g}), {s['failed']} failed runs")
    lines.append(f"  change  {result['difference']:+.4g} ({result['low']:+.4g} to {result['high']:+.4g}): {result['verdict']}")
    for name in ("fixed", "new"):
        found = result[name]
        shown = ", ".join(str(f["run"]) for f in found[:_SHOWN]) + (", ..." if len(found) > _SHOWN else "")
        lines.append(f"  {len(found)} {name}" + (f": runs {shown}" if found else ""))
    lines.append(f"  {result['still']} critical with both")
    if "warm_ups" in result:
        lines.append(f"  conditional on the traffic of {result['warm_ups']} warm-ups; runs that share one count for fewer")
    return [*lines, f"page: {result['page']}"]


def _whole(pair: Mapping[str, Any]) -> dict[str, Any]:
    """Return a pair of runs for JSON, with the ends of the scale at which its metrics are."""
    sides = {f"{side}.{name}": value for side in ("before", "after") for name, value in pair[side].items()}
    return {**pair, **infinite(sides)}


def _rare_lines(result: Mapping[str, Any]) -> list[str]:
    """Return the comparison of two estimations for people."""
    lines = [f"two estimations, the second learned from the first; {result['confidence']:.0%} intervals"]
    for name in ("before", "after"):
        s = result[name]
        p = "unknown" if s["probability"] is None else f"{s['probability']:.4g}"
        short = "" if s["precise"] else "; a coefficient of variation of 10 % is not reached: more --runs"
        lines.append(f"  {name:<8}{p} ({s['low']:.4g} to {s['high']:.4g}), {s['runs']} runs, {s['failed']} failed{short}")
    by = "unknown" if result["difference"] is None else f"{result['difference']:+.4g}"
    condition = f", {result['condition']}" if result.get("condition") else ""
    lines.append(f"  change  {by} ({result['low']:+.4g} to {result['high']:+.4g}): {result['verdict']}{condition}")
    lines += [f"  {result['open']}"] if result.get("open") else []
    warm_ups = [result[name].get("warm_ups", 0) for name in ("before", "after")]
    return [*lines, f"  conditional on the traffic of {max(warm_ups)} warm-ups"] if any(warm_ups) else lines

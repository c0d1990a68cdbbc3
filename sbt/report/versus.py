"""The page of two egos on the same draws: probabilities with intervals, and the films of what was fixed and what is new."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sbt.campaigns.wording import input_value, measured, percent, plural, written_unit
from sbt.files import write_atomically
from sbt.problem.plain import Json
from sbt.report.explorer import library, packed, render, scripts, styles
from sbt.report.reel import Film, Reels

__all__ = ["PAGE", "write_versus"]

PAGE = "compare.html"
_LISTED = 200
_VERDICTS = {"fell": "fell", "rose": "rose", "undecided": "may have fallen or risen: the runs do not decide"}
_LEFT, _RIGHT = 110.0, 540.0


def write_versus(
    folder: Path, title: str, result: Mapping[str, Any], films: Sequence[tuple[str, Film, Film]], *, units: Mapping[str, str],
    commands: str, note: str = "",
) -> Path:  # fmt: skip
    """Write the page and return its path.

    Args:
        folder: where to write.
        title: of the page.
        result: of `sbt.workflows.paired.compare_egos`.
        films: of the same draws: "fixed" or "new", the film with the ego before, and after.
        units: of inputs, by name.
        commands: how a pair is opened.
        note: why films are missing.
    """
    import markupsafe

    reels, inputs = Reels(), {(kind, found["run"]): found["inputs"] for kind in ("fixed", "new") for found in result[kind]}
    widths = _widths(list(inputs.values()))
    pairs = [
        {
            "title": f"{kind}: run {before.run}", "films": [reels.add(before), reels.add(after)],
            "said": [film.role for film in (before, after)], "inputs": _inputs(inputs[kind, before.run], units, widths),
        }
        for kind, before, after in films
    ]  # fmt: skip
    page = render("versus.html", {
        "title": title, "lead": _lead(result), "sentences": _sentences(result), **_bars(result), "note": note,
        "commands": commands,
        "tables": [
            _table(f"{kind.capitalize()} failures", result[kind], units, widths) for kind in ("fixed", "new")
        ],
        "explorer": {
            "data": packed({"pairs": pairs, "lanes": reels.lanes}), "library": library() if pairs else "",
            "styles": markupsafe.Markup(styles()),
            "scripts": markupsafe.Markup(scripts("data.js", "charts.js", "sight.js", "film.js", "versus.js")),
        },
    })  # fmt: skip
    return write_atomically(folder / PAGE, page)


def _lead(result: Mapping[str, Any]) -> str:
    before, after = (result[name]["probability"] for name in ("before", "after"))
    said = f"The probability of a critical run {_VERDICTS[result['verdict']]}: {percent(before)} before, {percent(after)} after"
    return f"{said}; change {100 * result['difference']:+.3g} percentage points ({_interval(result, result['confidence'])})."


def _interval(result: Mapping[str, Any], confidence: float) -> str:
    return f"{percent(confidence)} interval {100 * result['low']:+.3g} to {100 * result['high']:+.3g}"


def _sentences(result: Mapping[str, Any]) -> list[str]:
    failed, fixed = result["before"]["failed"] + result["after"]["failed"], plural(len(result["fixed"]), "failure")
    lost = f" {failed:,} failed runs count as whatever is worse for the end in question." if failed else ""
    of, conditional = "exact and paired", []
    if "warm_ups" in result:
        of = "paired, and that of fewer pairs, since some share a warm-up"
        conditional = [f"The comparison is conditional on the traffic of {plural(result['warm_ups'], 'warm-up')}."]
    return [
        f"{fixed} {'was' if len(result['fixed']) == 1 else 'were'} fixed, {len(result['new']):,} are new,"
        f" {result['still']:,} runs are critical with both, of {result['pairs']:,} pairs of runs with common draws and seeds.",
        f"The interval of the change is {of}: only runs with different verdicts tell the egos apart.{lost}"
        " They also decide whether P rose or fell (McNemar's test).", *conditional,
    ]


def _bars(result: Mapping[str, Any]) -> Json:
    """Return the three intervals in the units of the drawing."""
    change = {"probability": result["difference"], "low": result["low"], "high": result["high"]}
    given = [("before", result["before"]), ("after", result["after"]), ("change", change)]
    low = min(0.0, *(each["low"] for _, each in given))
    span = max(0.0, *(each["high"] for _, each in given)) - low or 1.0

    def place(value: float) -> float:
        return round(_LEFT + (value - low) / span * (_RIGHT - _LEFT), 1)

    bars = [
        {"name": name, "y": 22 + 38 * k, "low": place(each["low"]), "high": place(each["high"]), "at": place(each["probability"]),
         "text": f"{100 * each['probability']:+.3g} points" if name == "change" else f"{100 * each['probability']:.3g} %"}
        for k, (name, each) in enumerate(given)
    ]  # fmt: skip
    return {"bars": bars, "zero": place(0.0)}


def _widths(inputs: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return how far the values of each input reach in these runs; infinite where they are all alike."""
    numeric = [name for name, value in (inputs[0] if inputs else {}).items() if not isinstance(value, str)]
    numbers = {name: [each[name] for each in inputs] for name in numeric}
    return {name: (max(values) - min(values)) or math.inf for name, values in numbers.items()}


def _inputs(inputs: Mapping[str, Any], units: Mapping[str, str], widths: Mapping[str, float]) -> str:
    told = {name: input_value(value, widths.get(name, math.inf), 4) for name, value in inputs.items()}
    return ", ".join(measured(name, value, units.get(name, "")) for name, value in told.items())


def _table(title: str, found: Sequence[Mapping[str, Any]], units: Mapping[str, str], widths: Mapping[str, float]) -> Json:
    names = list(found[0]["inputs"]) if found else []
    return {
        "title": title, "count": f"{len(found):,}" + (f", the first {_LISTED}" if len(found) > _LISTED else ""),
        "columns": ["run", *(f"{n} ({written_unit(units[n])})" if units.get(n) else n for n in names), "seed"],
        "rows": [
            [r["run"], *(input_value(r["inputs"][n], widths.get(n, math.inf), 5) for n in names), r["seed"]]
            for r in found[:_LISTED]
        ],
    }  # fmt: skip

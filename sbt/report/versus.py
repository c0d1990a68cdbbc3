"""The page of two egos on the same draws: probabilities with intervals, and the films of what was fixed and what is new."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sbt.campaigns.wording import input_value, measured, number, percent, plural, written_unit
from sbt.files import write_atomically
from sbt.problem.plain import Json
from sbt.report.explorer import library, packed, render, scripts, styles
from sbt.report.reel import Film, Reels

__all__ = ["PAGE", "Question", "write_versus"]

PAGE = "compare.html"
_LISTED = 200
_VERDICTS = {"fell": "fell", "rose": "rose", "undecided": "may have fallen or risen: the runs do not decide"}
_LEFT, _RIGHT = 110.0, 540.0
_TICKS = 6
"""Most ticks of the axis."""


@dataclass(frozen=True)
class Question:
    """What is compared.

    Args:
        critical: when a run is critical, in words.
        metrics: unit of each metric of the requirement, by name.
        before, after: file of the configuration, and its ego in words.
    """

    critical: str
    metrics: Mapping[str, str]
    before: tuple[str, str]
    after: tuple[str, str]


def write_versus(
    folder: Path, title: str, result: Mapping[str, Any], films: Sequence[tuple[str, Film, Film]], *, question: Question,
    units: Mapping[str, str], commands: str, note: str = "",
) -> Path:  # fmt: skip
    """Write the page and return its path.

    Args:
        folder: where to write.
        title: of the page.
        result: of `sbt.workflows.paired.compare_egos`.
        films: of the same draws: "fixed" or "new", the film with the ego before, and after.
        question: what was asked of which egos.
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
        "critical": question.critical, "egos": _egos(result, question),
        "commands": commands,
        "tables": [
            _table(f"{kind.capitalize()} failures", result[kind], units, widths, question) for kind in ("fixed", "new")
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
    return f"{said}; change {_points(result['difference'])} percentage points ({_interval(result, result['confidence'])})."


def _egos(result: Mapping[str, Any], question: Question) -> Json:
    """Return the table of both egos and of the change: shares of critical runs with intervals."""
    interval = f"{percent(result['confidence'])} interval"
    columns = ["", "P(critical)", interval, "critical runs", "failed runs", "ego", "configuration"]
    rows = []
    for name, (path, ego) in (("before", question.before), ("after", question.after)):
        s = result[name]
        ends = f"{100 * s['low']:.3g} to {percent(s['high'])}"
        critical = f"{s['critical']:,} of {result['pairs']:,}"
        rows.append([name, percent(s["probability"]), ends, critical, f"{s['failed']:,}", ego, path])
    change = f"{_points(result['low'])} to {_points(result['high'])} points"
    more = result["after"]["critical"] - result["before"]["critical"]
    rows.append(["change", f"{_points(result['difference'])} points", change, f"{more:+,}" if more else "0", "", "", ""])
    return {"columns": columns, "rows": rows}


def _interval(result: Mapping[str, Any], confidence: float) -> str:
    return f"{percent(confidence)} interval {_points(result['low'])} to {_points(result['high'])}"


def _points(value: float) -> str:
    """Return a difference of probabilities in percentage points; 0 has no sign."""
    return f"{100 * value:+.3g}" if value else "0"


def _sentences(result: Mapping[str, Any]) -> list[str]:
    failed, fixed, new = result["before"]["failed"] + result["after"]["failed"], len(result["fixed"]), len(result["new"])
    still = result["still"]
    lost = f" {failed:,} failed runs count as whatever is worse for the end in question." if failed else ""
    of, conditional = "exact and paired", []
    if "warm_ups" in result:
        of = "paired, and that of fewer pairs, since some share a warm-up"
        conditional = [f"The comparison is conditional on the traffic of {plural(result['warm_ups'], 'warm-up')}."]
    return [
        f"{plural(fixed, 'failure')} {_be(fixed, 'was', 'were')} fixed, {new:,} {_be(new)} new, {plural(still, 'run')}"
        f" {_be(still)} critical with both, of {plural(result['pairs'], 'pair')} of runs with common draws and seeds.",
        f"The interval of the change is {of}: only runs with different verdicts tell the egos apart.{lost}"
        " They also decide whether P rose or fell (McNemar's test).", *conditional,
    ]


def _be(n: int, one: str = "is", several: str = "are") -> str:
    return one if n == 1 else several


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
         "text": f"{_points(each['probability'])} points" if name == "change" else f"{100 * each['probability']:.3g} %"}
        for k, (name, each) in enumerate(given)
    ]  # fmt: skip
    ticks = [{"at": place(value), "text": f"{100 * value:.6g}"} for value in _round_values(low, low + span)]
    return {"bars": bars, "zero": place(0.0), "ticks": ticks}


def _round_values(low: float, high: float) -> list[float]:
    """Return at most six round numbers between the two, evenly spaced, with 0 where it lies between.

    >>> [round(100 * value) for value in _round_values(-0.73, 0.74)]
    [-50, -25, 0, 25, 50]
    """
    power = 10.0 ** math.floor(math.log10((high - low) / _TICKS))
    step = next(step for factor in (1, 2, 2.5, 5, 10, 20) if (high - low) / (step := factor * power) < _TICKS)
    return [k * step for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


def _widths(inputs: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return how far the values of each input reach in these runs; infinite where they are all alike."""
    numeric = [name for name, value in (inputs[0] if inputs else {}).items() if not isinstance(value, str)]
    numbers = {name: [each[name] for each in inputs] for name in numeric}
    return {name: (max(values) - min(values)) or math.inf for name, values in numbers.items()}


def _inputs(inputs: Mapping[str, Any], units: Mapping[str, str], widths: Mapping[str, float]) -> str:
    told = {name: input_value(value, widths.get(name, math.inf), 4) for name, value in inputs.items()}
    return ", ".join(measured(name, value, units.get(name, "")) for name, value in told.items())


def _table(
    title: str, found: Sequence[Mapping[str, Any]], units: Mapping[str, str], widths: Mapping[str, float], question: Question
) -> Json:
    names = list(found[0]["inputs"]) if found else []
    sides = [(metric, side) for metric in question.metrics for side in ("before", "after")]
    return {
        "title": title, "count": f"{len(found):,}" + (f", the first {_LISTED}" if len(found) > _LISTED else ""),
        "columns": [
            "run", *(_headed(f"{m} {side}", question.metrics[m]) for m, side in sides),
            *(_headed(n, units.get(n, "")) for n in names), "seed",
        ],
        "rows": [
            [r["run"], *(number(r[side][m]) for m, side in sides),
             *(input_value(r["inputs"][n], widths.get(n, math.inf), 5) for n in names), r["seed"]]
            for r in found[:_LISTED]
        ],
    }  # fmt: skip


def _headed(name: str, unit: str) -> str:
    return f"{name} ({written_unit(unit)})" if unit else name

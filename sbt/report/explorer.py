"""The data of the report's explorer: runs as columns, what the metamodel believes, films; and the script that draws them."""

from __future__ import annotations

import base64
import gzip
import importlib.util
import json
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from sbt.campaigns.failures import FalsificationConclusion
from sbt.campaigns.modes import worst_first
from sbt.campaigns.wording import digits_of
from sbt.problem.parameter import Parameter
from sbt.problem.plain import Json, JsonMapping, unit_of
from sbt.problem.scenario import LogicalScenario
from sbt.report.influence import Influence
from sbt.report.projection import Predict
from sbt.report.reel import Film, Reels
from sbt.report.slices import slices_through
from sbt.report.thinning import shown_runs
from sbt.report.words import Findings

__all__ = ["explorer_data", "library", "packed", "packed_library", "render", "scripts", "styles"]

_FILMS = 3_000_000
"""Largest size of all films together as text (bytes), before it is packed."""
_SLICES = 40
"""Slices go through at most so many runs."""
_WORST = 8
"""... so many of the most critical ones among them."""
_NARROW = 0.01
"""Width of a range relative to its ends below which it is narrow."""
_DIGITS = 5
"""Significant digits of an input's values where its range begins at 0."""
_SCRIPTS = ("data.js", "charts.js", "table.js", "sight.js", "film.js", "explorer.js")
_STYLES = ("explorer.css",)


def explorer_data(
    found: Findings, scenario: LogicalScenario, predict: Predict | None, weights: Any, *,
    influence: Influence | None = None, films: Sequence[Film] = (), note: str = "", commands: Mapping[str, str] | None = None,
) -> Json:  # fmt: skip
    """Return what the explorer shows, as plain data.

    Args:
        found: rows and requirement.
        scenario: inputs and metrics, with their units.
        predict: the metamodel, None where there is none.
        weights: (d,) importance of the inputs; the two largest are the first axes.
        influence: of the inputs on P(critical), with intervals.
        films: runs to be shown, the most interesting first.
        note: why films are missing.
        commands: how a run is opened (`replay`, `film`), with RUN in place of its index.
    """
    history, requirement = found.history, found.requirement
    critical = found.critical
    keep = shown_runs(history.ok, critical, history.index, [film.run for film in films])
    shown = history.where(keep)
    verdict = np.where(~history.ok, 2, np.where(critical, 1, 0))[keep]
    margin = requirement.margins(shown)
    stages = sorted(set(shown.stage.tolist()))
    limits = {part.metric: [_number(part.critical.low), _number(part.critical.high)] for part in requirement.parts}
    reels, reeled = _within(films)
    return {
        "title": scenario.name, "told": requirement.told_as, "total": len(history), "critical_total": int(np.sum(critical)),
        "inputs": [_input(p, k, influence) for k, p in enumerate(scenario.space.parameters)],
        "metrics": [
            {"name": m, "unit": unit_of(found.units, m), "critical": limits.get(m), "description": found.meanings.get(m, "")}
            for m in history.metrics
        ],
        "weights": [float(f"{w:.4g}") for w in np.asarray(weights).tolist()],
        "order": np.argsort(-np.asarray(weights), kind="stable").tolist(),
        "index": _whole(shown.index), "verdict": verdict.tolist(), "margin": _floats(margin),
        "rank": _whole(np.argsort(worst_first(shown, requirement.depths(shown)), kind="stable")),
        "x": [_floats(shown.x[:, k] - _origin(p)) for k, p in enumerate(scenario.space.parameters)],
        "y": [_floats(shown.y(m)) for m in history.metrics],
        "stages": stages, "stage": [stages.index(s) for s in shown.stage.tolist()],
        "iteration": _whole(shown.iteration), "seed": [str(s) for s in shown.seed.tolist()],
        "reason": {str(k): str(shown.reason[k])[:300] for k in np.flatnonzero(~shown.ok)[:2000]},
        "modes": _modes(found), "films": reeled, "lanes": reels.lanes, "film_note": note,
        "films_left_out": len(films) - len(reeled), "commands": dict(commands or {}),
        "traced": (found.configuration.get("described") or {"traced": True})["traced"],
        "slices": _slices(found, scenario, predict, [film.run for film in films]),
    }  # fmt: skip


def _within(films: Sequence[Film]) -> tuple[Reels, list[Json]]:
    """Return films as data, as many as may be in a page."""
    reels, found, room = Reels(), [], _FILMS
    for film in films:
        data = reels.add(film)
        room -= len(json.dumps(data))
        if room < 0:
            break
        found.append(data)
    return reels, found


def _input(parameter: Parameter, k: int, influence: Influence | None) -> Json:
    low, high = parameter.bounds
    known = {} if influence is None else {
        "influence": [float(f"{v[k]:.4g}") for v in (influence.total, influence.low, influence.high)]
    }  # fmt: skip
    return {
        "name": parameter.name, "unit": parameter.unit, "low": _number(low), "high": _number(high),
        "origin": _origin(parameter), "digits": _digits(parameter),
        "choices": list(parameter.choices), "whole": parameter.discrete, "log": parameter.logarithmic,
        "description": parameter.description, **known,
    }  # fmt: skip


def _origin(parameter: Parameter) -> float:
    """Return what is subtracted from an input's values, of which seven digits are kept: 0 but for a narrow range."""
    low, high = parameter.bounds
    return low if high - low < _NARROW * max(abs(low), abs(high)) else 0.0


def _digits(parameter: Parameter) -> int:
    """Return the significant digits in which an input's values are written."""
    low, high = parameter.bounds
    return digits_of(max(abs(low), abs(high)), high - low, _DIGITS)


def _modes(found: Findings) -> list[Json]:
    if not isinstance(found.conclusion, FalsificationConclusion):
        return []
    return [{"representative": m.representative, "runs": list(m.runs)[:2000]} for m in found.conclusion.failure_modes]


def _slices(found: Findings, scenario: LogicalScenario, predict: Predict | None, filmed: Sequence[int]) -> Json | None:
    """Return slices through the runs with a film, the most critical ones, and others spread evenly."""
    history = found.history
    if predict is None or not history.ok.any():
        return None
    spread = history.index[history.ok]
    spread = spread[np.unique(np.linspace(0, len(spread) - 1, _SLICES).astype(int))].tolist()
    margin = np.where(history.ok, found.requirement.depths(history), np.inf)
    worst = history.index[worst_first(history, margin)[: min(_WORST, len(spread))]].tolist()
    runs = list(dict.fromkeys([*filmed, *worst, *spread]))[:_SLICES]
    rows = {int(index): row for row, index in enumerate(history.index)}
    x = history.x[[rows[run] for run in runs]]
    return slices_through(predict, found.requirement.critical, scenario.space, x, runs)


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _floats(values: Any) -> str:
    """Return numbers as base64 of 32-bit floats: seven digits, NaN where there is none."""
    return base64.b64encode(np.asarray(values, dtype="<f4").tobytes()).decode()


def _whole(values: Any) -> str:
    return base64.b64encode(np.asarray(values, dtype="<i4").tobytes()).decode()


def packed(data: Any) -> str:
    """Return plain data as base64 of its gzipped JSON: no text in it can end the script element it lies in."""
    text = json.dumps(data, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    return base64.b64encode(gzip.compress(text.encode(), 6, mtime=0)).decode()


@cache
def packed_library() -> bytes:
    """Return the gzip of plotly.js as it comes with its Python package; nothing where that is not installed."""
    spec = importlib.util.find_spec("plotly")
    if spec is None or not spec.submodule_search_locations:
        return b""
    script = Path(spec.submodule_search_locations[0]) / "package_data" / "plotly.min.js"
    return gzip.compress(script.read_bytes(), 6, mtime=0)


def library() -> str:
    """Return plotly.js as base64 of its gzip; "" where it is not installed."""
    return base64.b64encode(packed_library()).decode()


def scripts(*names: str) -> str:
    """Return our own scripts, one after the other."""
    return "\n".join(_own(name) for name in names or _SCRIPTS)


def styles() -> str:
    """Return the style sheet of the explorer."""
    return "\n".join(_own(name) for name in _STYLES)


def _own(name: str) -> str:
    return files("sbt.report").joinpath(name).read_text(encoding="utf-8")


def render(template: str, values: JsonMapping) -> str:
    """Return a page from a template of this folder; whatever is not ours is escaped."""
    import jinja2

    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        loader=jinja2.PackageLoader("sbt.report", "."),
    )  # fmt: skip
    return environment.get_template(template).render(values)

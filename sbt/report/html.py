"""The report of a campaign as one self-contained page: the question, the result, and how reliable it is."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from sbt.campaigns.asking import Sensitivity
from sbt.campaigns.estimation import EstimationConclusion
from sbt.campaigns.wording import NOTHING, number
from sbt.errors import command_of
from sbt.files import write_atomically
from sbt.loop.stages import Conclusion
from sbt.plugins import OBJECT
from sbt.problem.plain import Json, JsonMapping
from sbt.problem.scenario import LogicalScenario
from sbt.report.choosing import runs_to_film
from sbt.report.explorer import explorer_data, library, packed, render, scripts, styles
from sbt.report.gallery import DRAWN, Drawing, draw
from sbt.report.influence import influence_of
from sbt.report.modes import mode_table
from sbt.report.projection import Predict, influence_from_runs
from sbt.report.reel import Film
from sbt.report.tables import contact_table, critical_table, failed_table, input_table, iteration_table, sensitivity_table
from sbt.report.words import SCORES, Findings, conclusion_sentences, requirement_words, warnings_for
from sbt.store.database import Store

__all__ = ["REPORT", "write_report"]

REPORT = "report.html"

Filming = Callable[[Mapping[int, str]], tuple[Sequence[Film], str]]
"""Indices of runs, each with the reason why it is shown, to their films and in words why some are missing."""


def write_report(
    store: Store, scenario: LogicalScenario, predict: Predict | None, conclusion: Conclusion | None, *,
    folder: Path | None = None, sensitivity: Sequence[Sensitivity] = (), film: Filming | None = None,
    note: str = "",
) -> Path:  # fmt: skip
    """Write `report.html` and `figures/*.svg`; works at any moment of a campaign, and gives the same bytes twice.

    Args:
        store: open for reading or writing.
        scenario: as the campaign ran it, with the campaign's inputs and requirement.
        predict: the last metamodel as a function of (n, d) points of the unit cube; None: no metamodel.
        conclusion: what the campaign found; None while it goes on.
        folder: where to write; None: the store's folder.
        sensitivity: of an estimated probability to the parameters of the distributions.
        film: makes films of runs; None: the page shows none.
        note: what the page leaves out, and why; "": nothing.

    Returns:
        The path of the page.
    """
    target = Path(folder) if folder is not None else store.folder
    found, fits = Findings.of(store, scenario, conclusion), store.fits()
    critical, d = scenario.requirement.critical, scenario.space.dimension
    influence = None if predict is None else influence_of(predict, critical, d)
    weights = None if predict is None else (np.zeros(d) if influence is None else influence.relative)
    order = weights if weights is not None and weights.any() else influence_from_runs(found.history, scenario.requirement)
    films, film_note = ((), "") if film is None else film(runs_to_film(found, scenario.space))
    commands = _commands(found, store)
    data = explorer_data(
        found, scenario, predict, order, influence=influence, films=films, note=film_note, commands=commands,
    )  # fmt: skip
    coarse = store.history(level=None) if store.coarse else None
    coarse = None if coarse is None else coarse.where(coarse.columns["level"] > 0)
    drawings = draw(found, scenario.space, fits, predict, order)
    drawn = {drawing.name for drawing in drawings}
    for old in (target / "figures").glob("*.svg") if folder is None else ():
        if old.stem.rstrip("_0123456789") in DRAWN and old.stem not in drawn:
            old.unlink()  # of a report before, which no longer holds
    for drawing in drawings:
        write_atomically(target / "figures" / f"{drawing.name}.svg", drawing.svg)
    page = render("template.html", {
        "title": _title(scenario),
        "description": "\n".join(scenario.description.strip().splitlines()[1:]).strip(),
        "facts": _facts(found, scenario, store),
        "conclusion": conclusion_sentences(found),
        "warnings": [*([note] if note else []), *warnings_for(found)],
        "scores": _scores(found),
        "drawings": [_inline(drawing) for drawing in drawings],
        "modes": mode_table(found, scenario.space),
        "sensitivity": sensitivity_table(sensitivity),
        "inputs": input_table(scenario, influence),
        "iterations": iteration_table(store.iterations(), fits, found.history, scenario.requirement, coarse),
        "critical": critical_table(found.history, scenario.requirement, commands["replay"], store.judgements),
        "contacts": contact_table(found.history, scenario.requirement, commands["film"]),
        "failed": failed_table(found.history, commands["replay"]),
        "ego": found.configuration.get("ego"),
        "several": found.requirement.combined,
        "commands": commands,
        "explorer": _explorer(data, influence is not None),
        "configuration": _configuration(found),
    })  # fmt: skip
    return write_atomically(target / REPORT, page)


def _explorer(data: Json, from_metamodel: bool) -> Json:
    """Return the explorer's parts for the template; all of them are our own text or base64."""
    import markupsafe

    note = (
        "Total Sobol indices of the metamodel's P(critical) over the ranges; bars: 95 % intervals of the sampling."
        if from_metamodel
        else "How much of the rank of the metric each input explains alone in the runs, relative to the largest."
    )  # fmt: skip
    return {
        "data": packed(data), "library": library(), "note": note,
        **{name: markupsafe.Markup(text) for name, text in (("styles", styles()), ("scripts", scripts()))},
    }  # fmt: skip


def _inline(drawing: Drawing) -> Json:
    """Return a drawing for the template; its SVG, without the XML prologue, is the only text not escaped."""
    import markupsafe

    svg = drawing.svg[drawing.svg.index("<svg ") :]
    svg = svg.replace("<svg ", f'<svg role="img" aria-label="{markupsafe.escape(drawing.title)}" ', 1)
    return {
        "name": drawing.name,
        "title": drawing.title,
        "caption": drawing.caption,
        "wide": drawing.wide,
        "svg": markupsafe.Markup(svg),
    }


def _title(scenario: LogicalScenario) -> str:
    lines = scenario.description.strip().splitlines()
    return lines[0].rstrip(".") if lines else scenario.name


def _facts(found: Findings, scenario: LogicalScenario, store: Store) -> list[tuple[str, str]]:
    """Return the header: names and values."""
    history, configuration = found.history, found.configuration
    failed, planned = int((~history.ok).sum()), found.planned
    runs = f"{len(history):,} done, {int(found.critical.sum()):,} critical, {failed:,} failed"
    return [
        ("campaign", str(configuration.get("campaign", NOTHING)).removeprefix(OBJECT)),
        ("scenario", str(configuration.get("scenario", scenario.name)).removeprefix(OBJECT)),
        ("critical if", requirement_words(found.requirement, found.unit, found.units) + _meaning(found)),
        ("runs", runs + (f", {planned:,} planned" if planned else "")),
        ("ended", str(found.ended.get("stopped") or NOTHING)),
        ("seed", str(configuration.get("seed", NOTHING))),
        ("store", store.folder.name),
        ("time", _time(found)),
        ("versions", " | ".join(sorted({v for v in history.versions if v})[:5]) or NOTHING),
    ]


def _meaning(found: Findings) -> str:
    """Return what the metrics of the requirement are, where that is known."""
    asked = [part.metric for part in found.requirement.parts]
    told = [f"{metric}: {found.meanings[metric]}" for metric in asked if metric in found.meanings]
    return f" ({'; '.join(told)})" if told else ""


def _time(found: Findings) -> str:
    simulated = f"{_duration(float(found.history.seconds.sum()))} of simulation, summed over workers"
    spent = found.ended.get("seconds") or {}
    within = isinstance(found.conclusion, EstimationConclusion)  # whose metamodels are fitted while it proposes
    names = {"fit": "fit", "propose": "fit and propose" if within else "propose"}
    other = [f"{said} {_duration(spent[name])}" for name, said in names.items() if spent.get(name)]
    work, idle = (float(spent.get(name) or 0.0) for name in ("work", "idle"))
    used = [f"workers busy {100 * work / (work + idle):.0f} %"] if work else []
    return ", ".join([simulated, *other, *used])


def _duration(seconds: float) -> str:
    """Return a duration for people."""
    if seconds < 120:
        return f"{seconds:.3g} s"
    return f"{seconds / 60:.3g} min" if seconds < 7200 else f"{seconds / 3600:.3g} h"


def _scores(found: Findings) -> list[tuple[str, str]]:
    """Return the scores of the last metamodel on held-out runs."""
    scores = {} if found.validation is None else found.validation.to_dict()
    given = [(SCORES[key], _score(key, scores[key])) for key in SCORES if scores.get(key) is not None]
    counts = (("held-out runs", "n"), ("critical among them", "n_critical"))
    return given and given + [(name, number(scores[key])) for name, key in counts if scores.get(key) is not None]


def _score(key: str, value: float) -> str:
    """Return a score for people; errors of a probability have a thousandth as their least."""
    return "below 0.001" if key == "calibration_error" and value < 0.001 else number(value, 3)


def _commands(found: Findings, store: Store) -> dict[str, str]:
    written = found.ended.get("store")  # as the user wrote it, where the store is still there
    folder = str(written if written and Path(written).resolve() == store.folder.resolve() else store.folder)
    if given := _objects(found.configuration):
        return {
            "run": f"sbt.run({f'{folder}/config.resolved.yaml'!r}, {given}, store={f'{folder}-again'!r})",
            "replay": f"sbt.open({folder!r}, {given}).replay(RUN)",
            "film": f"sbt.open({folder!r}, {given}).film(RUN)",
            "export": f"sbt.open({folder!r}).export('csv')",
        }
    return {
        "run": command_of("sumo-sbt", "run", Path(folder, "config.resolved.yaml"), "--store", Path(f"{folder}-again")),
        "replay": f"{command_of('sumo-sbt', 'replay', Path(folder))} RUN",
        "film": f"{command_of('sumo-sbt', 'replay', Path(folder))} RUN --gif RUN.gif",
        "export": command_of("sumo-sbt", "export", Path(folder), "--format", "csv"),
    }


def _objects(configuration: JsonMapping) -> str:
    """Return the arguments that give again what was defined in Python; "" where nothing was."""
    choices = {key: configuration.get(key) for key in ("campaign", "scenario", "metamodel", "acquisition")}
    named = {key: str(choice.get("kind") if isinstance(choice, Mapping) else choice) for key, choice in choices.items()}
    own = {key: name.removeprefix(OBJECT) for key, name in named.items() if name.startswith(OBJECT)}
    return ", ".join(f"{key}={name}" for key, name in own.items())


def _configuration(found: Findings) -> str:
    """Return the configuration as the user would write it, or the whole snapshot in the store."""
    return str(found.configuration.get("yaml") or json.dumps(found.configuration, indent=2, ensure_ascii=False))

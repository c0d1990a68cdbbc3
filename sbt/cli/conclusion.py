"""How a campaign ended, on the console: the answer in sentences, the failure modes, and what to try next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sbt.errors import command_of

__all__ = ["conclusion_lines", "show_conclusion", "shown"]

_MOST_INPUTS = 6
"""More inputs of a failure mode are for `--verbose` and the report."""


def conclusion_lines(result: Mapping[str, Any], *, verbose: bool = False) -> list[str]:
    """Return the result of a campaign (`run --json`) for people.

    Args:
        result: see above.
        verbose: every number of the conclusion, instead of what it says.
    """
    ended = f", stopped: {result['stopped']}" if result.get("stopped") else ""
    head = f"{result['campaign']} of {result['scenario']}: {result['runs']} runs in {result['iterations']} iterations{ended}"
    lines = [head, f"  ok {result['ok']}, failed {result['failed']}, critical {result['critical']}{_doubts(result)}"]
    conclusion = result.get("conclusion", {})
    lines += _values(conclusion) if verbose or not result.get("sentences") else _answer(result)
    lines += _use_of_workers(result.get("seconds", {})) if verbose else []
    lines += [f"  warning: {warning}" for warning in conclusion.get("warnings", ())]
    path = Path(result["store"]) / "report.html"
    lines.append(f"report: {path}" if path.is_file() else f"store: {result['store']}")
    return [*lines, *([] if verbose else _next(result))]


def show_conclusion(result: Mapping[str, Any], *, verbose: bool = False) -> None:
    """Print how a campaign ended: with a table and colours on a terminal, else as lines of text."""
    from sbt.cli.screen import on_screen, show_result

    if verbose or not result.get("sentences") or not on_screen():
        print("\n".join(conclusion_lines(result, verbose=verbose)))
        return
    report = Path(result["store"]) / "report.html"
    following = next((line.removeprefix("next: ") for line in _next(result)), None)
    show_result(result, str(report if report.is_file() else report.parent), following)


def shown(value: Any) -> str:
    """Return a number with four significant digits, a dash where there is none, anything else as it is."""
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _doubts(result: Mapping[str, Any]) -> str:
    doubtful = result.get("unconfirmed", 0)
    words = f", of them {doubtful} with a contact that SUMO does not list" if doubtful else ""
    if struck := result.get("struck", 0):
        words += f", {struck} hit from behind by a recorded road user, who does not react"
    if passed := result.get("other_level", 0):
        words += f"; in {passed} runs roads are taken for bridges, and a contact across them is not counted"
    return words


def _use_of_workers(seconds: Mapping[str, float]) -> list[str]:
    """Return how much of the workers' time was used; nothing where it is not known."""
    work, idle = seconds.get("work", 0.0), seconds.get("idle", 0.0)
    return [f"  workers: busy {100 * work / (work + idle):.0f} % of the time from the first run to the last"] if work else []


def _answer(result: Mapping[str, Any]) -> list[str]:
    """Return the sentences, and a line for each failure mode."""
    modes = result["conclusion"].get("failure_modes") or ()
    told = [f"  mode {k}: {_mode(mode, result['metric'], result['units'])}" for k, mode in enumerate(modes, start=1)]
    return [*(f"  {sentence}" for sentence in result["sentences"]), *told]


def _mode(mode: Mapping[str, Any], metric: str, units: Mapping[str, str]) -> str:
    """Return a failure mode on one line."""
    from sbt.campaigns.wording import input_value, plural, unit_of

    def measured(name: str, value: Any, unit: str) -> str:
        return f"{name} {_short(value)} {_unit(unit)}".rstrip()

    inputs, digits = list(mode["inputs"].items()), mode.get("digits") or {}
    told = [
        measured(name, input_value(value, digits=digits.get(name, 3)), units.get(name, ""))
        for name, value in inputs[:_MOST_INPUTS]
    ]
    if len(inputs) > _MOST_INPUTS:
        told.append(f"and {plural(len(inputs) - _MOST_INPUTS, 'more input')}")
    said = [f"run {mode['representative']}, {measured(metric, mode['metric'], unit_of(units, metric))}, at {', '.join(told)}"]
    for name, found in (mode.get("choices") or {}).items():
        said.append(f"also with {name} {' or '.join(choice for choice in found if choice != mode['inputs'][name])}")
    said += [str(mode["conflict"])] if mode.get("conflict") else []
    violating = ", ".join(name if n == mode["size"] else f"{name} in {n}" for name, n in (mode.get("violates") or {}).items())
    said.append(f"{mode['size']} critical run{'' if mode['size'] == 1 else 's'}{violating and f', violating {violating}'}")
    if mode.get("confirmed") is not None:
        from sbt.campaigns.lost import repetitions

        lost = mode.get("confirmations_lost") or 0
        gave = mode["confirmation_runs"] - lost
        said.append(f"critical again in {repetitions(round(mode['confirmed'] * gave), gave, lost)}")
    if mode.get("unconfirmed"):
        said.append(f"{mode['unconfirmed']} with a contact that SUMO does not list")
    if mode.get("preventable"):
        said.append(_avoided(mode["preventable"]))
    return "; ".join(said)


def _avoided(judgements: Sequence[Mapping[str, Any]]) -> str:
    """Return which reference drivers avoid it, or why none was judged."""
    from sbt.workflows.judging import in_words

    said = in_words(judgements)
    return f"reference drivers {said}" if said.startswith("not applicable") else f"avoided {said}"


def _unit(unit: str) -> str:
    from sbt.campaigns.wording import written_unit

    return written_unit(unit)


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _values(conclusion: Mapping[str, Any]) -> list[str]:
    """Return every number of a conclusion by its name."""
    lines = []
    for key, value in conclusion.items():
        if key in {"convergence", "warnings"}:
            continue  # a figure of the report; said below
        if isinstance(value, Mapping):
            lines.append(f"  {key}")
            lines += [f"    {name:<24}{shown(item)}" for name, item in value.items()]
        elif isinstance(value, list) and all(isinstance(item, Mapping) for item in value):
            lines.append(f"  {key:<26}{len(value)}")
            lines += [f"    {_record(item)}" for item in value]
        else:
            lines.append(f"  {key:<26}{shown(value)}")
    return lines


def _record(item: Mapping[str, Any]) -> str:
    """Return the numbers of a record on one line, those of its inputs by their own names."""
    from sbt.campaigns.wording import input_value

    digits = item.get("digits") or {}
    inputs = {name: input_value(value, digits=max(digits.get(name, 4), 4)) for name, value in item.get("inputs", {}).items()}
    values = {k: v for k, v in item.items() if isinstance(v, (int, float, str))} | inputs
    found = [f"{name} {shown(value)}" for name, value in values.items()]
    if item.get("preventable"):
        found.append(_avoided(item["preventable"]))
    return ", ".join(found)


def _next(result: Mapping[str, Any]) -> list[str]:
    """Return the command that shows most: the film of the failure that the sentences name, else of the closest run."""
    conclusion, folder = result.get("conclusion", {}), Path(result["store"])
    modes, run = conclusion.get("failure_modes") or (), result.get("look_at")
    if run is None:
        run = modes[0]["representative"] if modes else (conclusion.get("closest") or {}).get("run")
    return [] if run is None else [f"next: {command_of('sumo-sbt', 'replay', folder, str(run))}"]

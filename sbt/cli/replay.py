"""The verb `replay`: executes a stored run again and compares the two bit by bit."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sbt.cli.campaign import Folder, Trust, with_store
from sbt.cli.console import Exit, clean_stdout, fail, infinite, next_command, print_json

if TYPE_CHECKING:
    from sbt.workflows.running import Replay

__all__ = ["replay"]


def replay(
    folder: Folder,
    run: Annotated[int, typer.Argument(metavar="RUN", help="Index of the run, as in the report.")],
    *,
    gui: Annotated[bool, typer.Option("--gui", help="Watch it in sumo-gui.")] = False,
    gif: Annotated[
        Path | None,
        typer.Option("--film", "--gif", metavar="FILE", help="Draw it from above, with the metric: .gif, .webp, .mp4, .webm."),
    ] = None,
    export: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Write network, trajectories (FCD, CSV) and a scene for sumo-gui.")
    ] = None,
    judge: Annotated[bool, typer.Option("--judge", help="Run it with each reference driver in the place of ego.")] = False,
    driver: Annotated[
        str | None, typer.Option(metavar="KIND", help="Show it with this driver in the place of ego, such as fsm.")
    ] = None,
    trace: Annotated[Path | None, typer.Option(metavar="FILE.csv", help="Write the states over time.")] = None,
    trust: Trust = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as one JSON object.")] = False,
) -> None:
    """Execute a stored run again and compare it with the store, bit by bit; show it or write it out."""
    with clean_stdout():
        from sbt.workflows.changes import told
        from sbt.workflows.judging import judge_run, judgement_line, stored_judgements, with_driver
        from sbt.workflows.rechecking import not_repeated
        from sbt.workflows.running import replay_run
        from sbt.workflows.showing import show_replay

        again = replay_run(with_store(folder, trust=trust), run)
        asked = None if driver is None else [driver]
        judgements = judge_run(folder, run, asked) if judge or driver else stored_judgements(folder, run)
        record, outcome, states = again.record, again.outcome, again.trace
        shown, view = gui or gif or export or trace, again if driver is None else with_driver(again, driver)
        if shown and not show_replay(view, gui=gui, gif=gif, folder=export, csv=trace):
            print("what sumo-gui showed differs from the run in the last digits", file=sys.stderr)
    same, changed = again.as_stored, [str(path) for path in again.changed]
    verdict = None if same and not (again.identical and again.executed) else same  # of other files it is not known
    if as_json:
        print_json({
            "run": record.index, "inputs": dict(record.inputs), "seed": record.seed, "status": str(outcome.status),
            "metrics": dict(outcome.metrics), "identical": verdict, "reason": outcome.reason,
            "ended": states.ended if states is not None else "", **infinite(outcome.metrics),
            **({"changed": changed} if changed else {}), **({"level": record.level} if record.level else {}),
            **({} if gif is None else {"film": str(gif.resolve())}),
            **({"unconfirmed": outcome.unconfirmed} if outcome.unconfirmed else {}),
            **({"preventable": [vars(each) for each in judgements]} if judgements else {}),
        })  # fmt: skip
    else:
        ended = f", ended: {states.ended}" if states is not None else ""
        coarse = f", a coarse run (level {record.level} of fidelity)" if record.level else ""
        print(f"run {record.index}{coarse}, seed {record.seed}: {outcome.status}{ended}")
        for name, value in outcome.metrics.items():
            print(f"  {name:<23} {value:.6g}")
        if outcome.unconfirmed:
            print(f"  doubtful: {outcome.unconfirmed}")
        print(_compared(again))
        if gif is not None:
            print(f"film: {gif.resolve()}")
        if judgements:
            print("\n".join(["with a reference driver in the place of ego:", *map(judgement_line, judgements)]))
        if same and outcome.status == "ok" and (gif is None or not record.level):  # a coarse run is no failure to pin
            film = ("sumo-sbt", "replay", folder, str(run), "--film", f"{run}.gif")
            next_command(*(film if gif is None else ("sumo-sbt", "pin", folder, str(run), "--into", "tests")))
    if not same:
        why = told(again.changed) or not_repeated(again.scenario)
        raise fail(f"a replay must equal the stored run, but got {again.differing}{why}", Exit.INTERNAL)


def _compared(again: Replay) -> str:
    if not again.executed:
        return "as stored: there is no trace to show, and the scenario's own code is executed only with --trust"
    if not again.as_stored:
        return "NOT identical to the stored run"
    if not again.changed:
        return "identical to the stored run"
    files = ", ".join(map(str, again.changed))
    return f"all that is stored of the run is the same, but what is not may differ, as files were changed since: {files}"

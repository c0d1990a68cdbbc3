"""The verb `replay`: executes a stored run again and compares the two bit by bit."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sbt.cli.campaign import Folder
from sbt.cli.console import Exit, clean_stdout, fail, print_json
from sbt.errors import InputError

if TYPE_CHECKING:
    from sbt.problem.scenario import LogicalScenario
    from sbt.problem.trace import Trace
    from sbt.store.history import Record

__all__ = ["replay"]


def replay(
    folder: Folder,
    run: Annotated[int, typer.Argument(metavar="RUN", help="Index of the run, as in the report.")],
    *,
    gui: Annotated[bool, typer.Option("--gui", help="Watch it in sumo-gui.")] = False,
    gif: Annotated[Path | None, typer.Option(metavar="FILE.gif", help="Draw it from above, with the metric over time.")] = None,
    export: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Write network, trajectories (FCD, CSV) and a scene for sumo-gui.")
    ] = None,
    trace: Annotated[Path | None, typer.Option(metavar="FILE.csv", help="Write the states over time.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as one JSON object.")] = False,
) -> None:
    """Execute a stored run again and compare it with the store, bit by bit; show it or write it out."""
    with clean_stdout():
        from sbt.workflows.running import replay_run

        again = replay_run(folder, run)
        record, outcome, states = again.record, again.outcome, again.trace
        if gui or gif or export or trace:
            if states is None:
                raise InputError(f"only a run with a trace can be shown or written out, but run {run} has none: {outcome.reason}")
            _show(again.scenario, record, states, gui=gui, gif=gif, export=export, trace=trace)
    same = again.identical
    if as_json:
        print_json({
            "run": record.index, "inputs": dict(record.inputs), "seed": record.seed, "status": str(outcome.status),
            "metrics": dict(outcome.metrics), "identical": same, "reason": outcome.reason,
            "ended": states.ended if states is not None else "",
        })  # fmt: skip
    else:
        ended = f", ended: {states.ended}" if states is not None else ""
        print(f"run {record.index}, seed {record.seed}: {outcome.status}{ended}")
        for name, value in outcome.metrics.items():
            print(f"  {name:<23} {value:.6g}")
        print("identical to the stored run" if same else "NOT identical to the stored run")
    if not same:
        now, stored = f"{outcome.status} {dict(outcome.metrics)}", f"{record.status} {dict(record.metrics)}"
        raise fail(f"a replay must equal the stored run, but got {now}, not {stored}", Exit.INTERNAL)


def _show(
    scenario: LogicalScenario,
    record: Record,
    states: Trace,
    *,
    gui: bool,
    gif: Path | None,
    export: Path | None,
    trace: Path | None,
) -> None:
    """Show a run or write it to files, as the options say."""
    from sbt.report.film import write_film
    from sbt.report.outside import write_csv, write_folder
    from sbt.sumo.gui import gui_program, run_in_gui
    from sbt.sumo.nets import lanes, net_file

    net = getattr(scenario.simulate, "net", None)
    if trace is not None:
        write_csv(trace, states)
    if export is not None:
        write_folder(export, states, None if net is None else net_file(net))
    if gif is not None:
        need = scenario.requirement
        metric = next(m for m in scenario.metrics if m.name == need.metric)
        title = f"{scenario.name}, run {record.index}: {metric.name} = {record.metrics[metric.name]:.3g} {metric.unit}"
        write_film(gif, states, metric, need, lanes=() if net is None else lanes(net), title=title)
    if gui:
        shown = run_in_gui(scenario.simulate, record.inputs, record.seed, gui_program())
        if not shown.identical(states):
            print("what sumo-gui showed differs from the run in the last digits", file=sys.stderr)

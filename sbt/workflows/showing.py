"""Shows a run that was executed again: as a film, in sumo-gui, as files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from sbt.errors import InputError
from sbt.problem.scenario import LogicalScenario
from sbt.problem.trace import Trace
from sbt.workflows.filming import shown_requirement
from sbt.workflows.networks import net_of
from sbt.workflows.running import Replay

__all__ = ["net_of_run", "save_film", "show_replay", "shown_trace"]


def show_replay(
    again: Replay, *, gui: bool = False, gif: Path | None = None, folder: Path | None = None, csv: Path | None = None
) -> bool:
    """Show a run, or write it to files.

    Args:
        again: the run; it has a trace.
        gui: in sumo-gui, in real time.
        gif: an animated GIF from above, with the metric over time.
        folder: network, trajectories (FCD, CSV), a scene for sumo-gui, what the files' detectors measured,
            and the run's own SUMO files.
        csv: the states over time.

    Returns:
        Whether sumo-gui, where it was opened, showed the run to the last bit.

    Raises:
        InputError: the run has no trace, or sumo-gui cannot be opened.
    """
    from sbt.report.outside import write_csv, write_folder
    from sbt.sumo.gui import gui_program, run_in_gui

    scenario, record, states = again.scenario, again.record, shown_trace(again)
    simulate: Any = scenario.simulate
    program = gui_program() if gui else ""
    try:
        if csv is not None:
            write_csv(csv, states)
        if folder is not None:
            write_folder(folder, states, net_of_run(again))
            if hasattr(simulate, "files_of_run"):
                _write_outputs(again, folder / "outputs")
                simulate.write_files(record.inputs, record.seed, folder.resolve() / "sumo")
        if gif is not None:
            save_film(gif, states, scenario, f"{scenario.name}, run {record.index}: {_result(again)}", net_of_run(again))
    except OSError as error:
        rule = "a place to write to must be in a folder that is there"
        raise InputError(f"{rule}, but {error.filename}: {error.strerror}") from None
    return not gui or run_in_gui(simulate, record.inputs, record.seed, program, ego=states.actors[0]).identical(states)


def _write_outputs(again: Replay, folder: Path) -> None:
    """Write what the files' detectors measured in the run, which is run again where it was one of a process of its own."""
    from sbt.sumo.outputs import collect_outputs
    from sbt.sumo.session import session

    simulate: Any = again.scenario.simulate
    if simulate.isolation.warm:
        simulate = simulate.isolated(replace(simulate.isolation, forking=False))
        simulate(again.record.inputs, again.record.seed)
    session().close()
    collect_outputs(simulate.outputs, folder)


def _result(again: Replay) -> str:
    """Return the metric of a run in words, or why it has none."""
    units, values = {m.name: m.unit for m in again.scenario.metrics}, again.outcome.metrics
    needs = [part.metric for part in again.scenario.requirement.parts]
    if not set(needs) <= set(values):
        return f"{again.outcome.status}, {again.outcome.reason}"
    return ", ".join(f"{need} = {values[need]:.3g} {units[need]}" for need in needs)


def shown_trace(again: Replay) -> Trace:
    """Return the trace of a run.

    Raises:
        InputError: it has none, as it failed or its scenario gives metrics directly.
    """
    if again.trace is None:
        reason = again.outcome.reason or f"scenario {again.scenario.name} gives its metrics directly"
        raise InputError(f"only a run with a trace can be shown, but run {again.record.index} has none: {reason}")
    return again.trace


def net_of_run(again: Replay) -> Path | None:
    """Return the network in which a run took place, with its placeholders filled; None where its scenario names none."""
    return net_of(again.scenario, again.record.inputs, again.record.seed)


def save_film(file: Path, states: Trace, scenario: LogicalScenario, title: str, net: Path | None) -> None:
    """Write a run as an animated GIF, with the lanes of its network and the metric of its requirement.

    Of several requirements it shows the first that the run violates, or else the first.
    """
    from sbt.report.film import write_film
    from sbt.sumo.nets import lanes

    need, metric = shown_requirement(scenario, states)
    write_film(file, states, metric, need, lanes=() if net is None else lanes(str(net)), title=title)

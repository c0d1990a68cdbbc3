"""Shows a run that was executed again: as a film, in sumo-gui, as files."""

from __future__ import annotations

from pathlib import Path

from sbt.errors import InputError
from sbt.workflows.running import Replay

__all__ = ["show_replay"]


def show_replay(
    again: Replay, *, gui: bool = False, gif: Path | None = None, folder: Path | None = None, csv: Path | None = None
) -> bool:
    """Show a run, or write it to files.

    Args:
        again: the run; it has a trace.
        gui: in sumo-gui, in real time.
        gif: an animated GIF from above, with the metric over time.
        folder: network, trajectories (FCD, CSV) and a scene for sumo-gui.
        csv: the states over time.

    Returns:
        Whether sumo-gui, where it was opened, showed the run to the last bit.

    Raises:
        InputError: the run has no trace.
    """
    from sbt.report.film import write_film
    from sbt.report.outside import write_csv, write_folder
    from sbt.sumo.gui import gui_program, run_in_gui
    from sbt.sumo.nets import lanes, net_file

    scenario, record, states = again.scenario, again.record, again.trace
    if states is None:
        raise InputError(f"only a run with a trace can be shown, but run {record.index} has none: {again.outcome.reason}")
    net = getattr(scenario.simulate, "net", None)
    if csv is not None:
        write_csv(csv, states)
    if folder is not None:
        write_folder(folder, states, None if net is None else net_file(net))
    if gif is not None:
        need = scenario.requirement
        metric = next(m for m in scenario.metrics if m.name == need.metric)
        title = f"{scenario.name}, run {record.index}: {metric.name} = {record.metrics[metric.name]:.3g} {metric.unit}"
        write_film(gif, states, metric, need, lanes=() if net is None else lanes(net), title=title)
    return not gui or run_in_gui(scenario.simulate, record.inputs, record.seed, gui_program()).identical(states)

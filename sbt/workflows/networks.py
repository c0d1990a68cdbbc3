"""The network that a run takes place in."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sbt.problem.plain import Values
from sbt.problem.scenario import LogicalScenario

__all__ = ["net_of"]


def net_of(scenario: LogicalScenario, values: Values, seed: int) -> Path | None:
    """Return the network in which a run took place, with its placeholders filled; None where its scenario names none."""
    from sbt.sumo.nets import net_file
    from sbt.sumo.session import scratch_folder
    from sbt.sumo.template import template

    simulate: Any = scenario.simulate
    if hasattr(simulate, "files_of_run"):
        files = simulate.files_of_run(values, seed)
        return template(files.net).write(values, scratch_folder())
    net = getattr(simulate, "net", None)
    return net_file(net) if isinstance(net, str) else None  # something else of a class of one's own is no network of SUMO's

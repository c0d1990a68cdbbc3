"""How often drivers act: SUMO's action steps, of which a simulation step must be a whole fraction."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator

from sbt.problem.parameter import Parameter
from sbt.sumo.ego import Ego
from sbt.sumo.files import SumoFiles

__all__ = ["Period", "periods_of"]

Period = tuple[str, float]
"""Where it is set, and its length (s); NaN where it depends on an input."""

_OPTION = "default.action-step-length"
_ATTRIBUTE = re.compile(rb"""\bactionStepLength\s*=\s*["']([^"']*)["']""")


def periods_of(egos: Iterable[Ego | None], files: SumoFiles | None = None) -> tuple[Period, ...]:
    """Return the action steps that egos and the files of a simulation set; SUMO's default, every step, is not among them."""
    own = (period for ego in egos if ego is not None for period in _of_ego(ego))
    return (*own, *(() if files is None else _of_files(files)))


def _of_ego(ego: Ego) -> Iterator[Period]:
    for name, value in ego.settings:
        if name == "actionStepLength":
            yield "ego.actionStepLength", math.nan if isinstance(value, Parameter) else float(value)


def _of_files(files: SumoFiles) -> Iterator[Period]:
    if _OPTION in files.options:
        yield f"SUMO's option {_OPTION}", _number(files.options[_OPTION])
    for each in files.templates:
        if each.path != files.net:
            with each.opened() as opened:
                for line, text in enumerate(opened, start=1):
                    for found in _ATTRIBUTE.findall(text):
                        yield f"{each.path}:{line}: actionStepLength", _number(found.decode(errors="replace"))


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan

"""Ranges for the placeholders that a user's files have already, by the attribute in which each stands."""

from __future__ import annotations

from sbt.sumo.files import SumoFiles
from sbt.sumo.own_ego import Suggestion

__all__ = ["suggested"]

_BY_ATTRIBUTE = {
    "departSpeed": (0.0, 15.0, "m/s"), "maxSpeed": (5.0, 40.0, "m/s"), "speed": (5.0, 40.0, "m/s"), "depart": (0.0, 30.0, "s"),
    "departPos": (10.0, 50.0, "m"), "begin": (0.0, 30.0, "s"), "vehsPerHour": (100.0, 1000.0, "1/h"), "period": (2.0, 20.0, "s"),
    "perHour": (100.0, 1000.0, "1/h"), "probability": (0.05, 0.5, "1/s"), "accel": (1.0, 4.0, "m/s^2"),
    "decel": (3.0, 7.0, "m/s^2"), "emergencyDecel": (6.0, 10.0, "m/s^2"), "tau": (0.5, 2.0, "s"), "minGap": (0.5, 3.0, "m"),
    "speedFactor": (0.8, 1.2, ""), "sigma": (0.0, 1.0, ""), "length": (3.0, 12.0, "m"), "duration": (5.0, 60.0, "s"),
    "actionStepLength": (0.1, 1.0, "s"), "scale": (0.5, 1.5, ""), "offset": (0.0, 90.0, "s"), "friction": (0.2, 1.0, ""),
}  # fmt: skip
"""Usual ranges of an attribute that is one placeholder and nothing else."""


def suggested(files: SumoFiles) -> tuple[Suggestion, ...]:
    """Return an input for every name in the placeholders: with a usual range where its attribute tells one, else from 0 to 1."""
    found: dict[str, Suggestion] = {}
    for hole in files.placeholders():
        for name in hole.formula.names():
            usual = _BY_ATTRIBUTE.get(hole.attribute) if hole.formula.text.strip() == name else None
            if usual is not None and (name not in found or found[name].description.startswith("your range")):
                found[name] = Suggestion(name, *usual, f"{hole.attribute}; a usual range, adapt it")
            found.setdefault(name, Suggestion(name, 0.0, 1.0, "", "your range, unit and description"))
    return tuple(found.values())

"""Ranges for the placeholders that a user's files have already, by the attribute in which each stands."""

from __future__ import annotations

from collections.abc import Mapping

from sbt.sumo.files import SumoFiles
from sbt.sumo.own_ego import Suggestion

__all__ = ["suggested", "units_apart"]

_BY_ATTRIBUTE = {
    "departSpeed": (0.0, 15.0, "m/s"), "maxSpeed": (5.0, 40.0, "m/s"), "speed": (5.0, 40.0, "m/s"), "depart": (0.0, 30.0, "s"),
    "departPos": (10.0, 50.0, "m"), "begin": (0.0, 30.0, "s"), "vehsPerHour": (100.0, 1000.0, "1/h"), "period": (2.0, 20.0, "s"),
    "perHour": (100.0, 1000.0, "1/h"), "probability": (0.05, 0.5, "1/s"), "accel": (1.0, 4.0, "m/s^2"),
    "decel": (3.0, 7.0, "m/s^2"), "emergencyDecel": (6.0, 10.0, "m/s^2"), "tau": (0.5, 2.0, "s"), "minGap": (0.5, 3.0, "m"),
    "speedFactor": (0.8, 1.2, ""), "sigma": (0.0, 1.0, ""), "length": (3.0, 12.0, "m"), "duration": (5.0, 60.0, "s"),
    "actionStepLength": (0.1, 1.0, "s"), "scale": (0.5, 1.5, ""), "offset": (0.0, 90.0, "s"), "friction": (0.2, 1.0, ""),
}  # fmt: skip
"""Usual ranges of an attribute that is one placeholder and nothing else."""


_ALIKE = {
    "m/s2": "m/s^2", "m/s²": "m/s^2", "mps": "m/s", "m s^-1": "m/s", "sec": "s", "seconds": "s", "metres": "m", "meters": "m",
}  # fmt: skip
"""Other ways to write SUMO's units."""
_FACTORS = {
    ("km/h", "m/s"): " / 3.6", ("kph", "m/s"): " / 3.6", ("mph", "m/s"): " * 0.44704", ("km", "m"): " * 1000",
    ("cm", "m"): " / 100", ("ft", "m"): " * 0.3048", ("ms", "s"): " / 1000", ("min", "s"): " * 60", ("h", "s"): " * 3600",
    ("g", "m/s^2"): " * 9.81",
}  # fmt: skip
"""What turns a number in one unit into one in another."""


def units_apart(files: SumoFiles, units: Mapping[str, str]) -> tuple[str, ...]:
    """Return where an input stands alone in an attribute for which SUMO takes another unit, with the formula that converts it.

    Args:
        files: the simulation.
        units: of the inputs; those without a unit are not compared.
    """
    found = []
    for hole in files.placeholders():
        name, usual = hole.formula.text.strip(), _BY_ATTRIBUTE.get(hole.attribute)
        unit = _ALIKE.get(units.get(name, ""), units.get(name, ""))
        if usual is None or not usual[2] or not unit or unit.rpartition("1/")[2] == usual[2].rpartition("1/")[2]:
            continue
        if usual[2].startswith("1/") and unit.rpartition("/")[2] == usual[2][2:]:  # veh/h
            continue
        factor = _FACTORS.get((unit, usual[2]))
        remedy = f": ${{{name}{factor}}}" if factor else ""
        found.append(f"{hole.place}: SUMO takes {hole.attribute} in {usual[2]}, but the input {name} has the unit {unit}{remedy}")
    return tuple(dict.fromkeys(found))


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

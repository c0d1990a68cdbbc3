"""Inputs that are profiles over time, and the road users that follow them, from the entries of a `scenario.yaml`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path

from sbt.config.scenario_model import ActorEntry, InputEntry, ProfileEntry
from sbt.config.source import Problems, must_be_one_of
from sbt.config.space import distribution_of
from sbt.problem.parameter import Parameter
from sbt.problem.profile import DEFORMATIONS, KnotProfile, Profile, RecordedProfile, read_curve
from sbt.sumo.files import SumoFiles
from sbt.sumo.guided import GuidedVehicle

__all__ = ["guided_vehicles", "profile_of"]


def profile_of(name: str, entry: InputEntry, folder: Path, problems: Problems) -> Profile | None:
    """Return the profile of an input's entry; what is wrong with it is added to `problems`.

    Args:
        name: of the input.
        entry: its entry, which has a profile.
        folder: that file names are relative to.
        problems: found so far.
    """
    path, wanted = ("inputs", name), entry.profile
    if wanted is None:
        return None
    if wanted.file is not None:
        return _recorded(name, entry, wanted, folder, problems)
    if wanted.knots is None or entry.min is None or entry.max is None:
        problems.add(path, "a profile must have knots: [times] with min and max beside it, or a file with a recorded curve")
        return None
    alien = [key for key in DEFORMATIONS if getattr(wanted, key) is not None]
    if alien:
        problems.add((*path, "profile", alien[0]), f"{alien[0]} deforms a recorded profile (file), but this one has knots")
        return None
    choice, knots, low, high = entry.distribution, wanted.knots, entry.min, entry.max
    distribution = None
    if choice is not None:
        distribution = problems.attempt((*path, "distribution"), partial(distribution_of, choice, folder))
    return problems.attempt(path, lambda: KnotProfile.of(
        name, knots, low, high, entry.unit, distribution, description=entry.description,
        interpolate=wanted.interpolate, rate=wanted.rate or (-math.inf, math.inf),
    ))  # fmt: skip


def _recorded(name: str, entry: InputEntry, wanted: ProfileEntry, folder: Path, problems: Problems) -> Profile | None:
    """Return a recorded curve with the inputs that deform it."""
    path = ("inputs", name)
    for key, given in (("knots", wanted.knots), ("rate", wanted.rate)):
        if given is not None:
            problems.add((*path, "profile", key), f"{key} is for a profile without a file, but this one has a file")
            return None
    if entry.min is not None or entry.max is not None or entry.distribution is not None:
        rule = f"a recorded profile has its ranges in {', '.join(DEFORMATIONS)}"
        problems.add(path, f"{rule}, but got min, max or distribution beside it")
        return None
    made: list[tuple[str, Parameter]] = []
    for what, (_, unit) in DEFORMATIONS.items():
        given = getattr(wanted, what)
        if given is not None:
            choice = given.distribution
            place = (*path, "profile", what)
            distribution = None if choice is None else problems.attempt(place, partial(distribution_of, choice, folder))
            units = entry.unit if unit == "value" else unit
            limits, about = (given.min, given.max), f"{what} of {name}"
            make = partial(Parameter, f"{name}_{what}", *limits, units, distribution, "continuous", about)
            parameter = problems.attempt(place, make)
            if parameter is None:
                return None
            made.append((what, parameter))
    file = folder / Path(wanted.file or "").expanduser()
    curve = problems.attempt((*path, "profile"), lambda: read_curve(file, wanted.time, wanted.value, wanted.interpolate))
    return None if curve is None else problems.attempt((*path, "profile"), lambda: RecordedProfile(name, curve, tuple(made)))


def guided_vehicles(
    entries: Mapping[str, ActorEntry], profiles: Mapping[str, Profile], files: SumoFiles | None, ego: str, problems: Problems
) -> tuple[GuidedVehicle, ...]:  # fmt: skip
    """Return the vehicles that follow a profile; what is wrong with them is added to `problems`."""
    made = []
    for name, entry in entries.items():
        if name == ego:
            problems.add(("actors", name), f"the ego has a driver (ego: kind), not a profile, but got '{name}'", at_key=True)
        elif files is not None and files.vehicle(name) is None:
            problems.add(("actors", name), must_be_one_of("an actor", name, files.names()[:8]), at_key=True)
        wanted = {key: value for key in ("speed", "acceleration") if (value := getattr(entry, key)) is not None}
        if len(wanted) != 1:
            problems.add(("actors", name), "an actor must have a speed or an acceleration: an input that is a profile")
        for quantity, profile in wanted.items():
            if profile in profiles:
                made.append(GuidedVehicle(name, profiles[profile], "speed" if quantity == "speed" else "acceleration"))
            else:
                known = list(profiles) or ["(no input has a profile)"]
                problems.add(("actors", name, quantity), must_be_one_of("a profile", profile, known))
    return tuple(made)

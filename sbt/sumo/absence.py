"""Why SUMO does not know a vehicle of the user's files at the time of its departure.

SUMO drops vehicles silently, or with a warning that does not name the cause; each cause here is read from the files and
options again. Called once, at the end of a run that is invalid.
"""

from __future__ import annotations

from collections.abc import Callable

from sbt.errors import InputError, RunError
from sbt.problem.plain import Values
from sbt.sumo.elements import PEOPLE, Element, element, elements
from sbt.sumo.files import SumoFiles
from sbt.sumo.session import session
from sbt.sumo.template import fill

__all__ = ["why_absent", "why_copied"]

_ROAD_USERS = ("vehicle", "trip", "flow", *PEOPLE)


def why_absent(
    files: SumoFiles, values: Values, name: str, depart: float | None, start: float, *, added: bool
) -> str:
    """Return the cause and the remedy as one text.

    Args:
        files: of the simulation.
        values: of the inputs, in placeholders.
        name: of the vehicle.
        depart: when it should (s); None where that is not known.
        start: when the simulation begins (s).
        added: the vehicle is not of the files.
    """
    one = element(files, name, _ROAD_USERS)
    if one is None:
        what = "has added it, and SUMO has dropped it" if added and depart is not None else "has not added it"
        return f"the loop {what}: sumo.vehicle.add('{name}', ...)"
    depart = depart if depart is not None else _number(one.depart, values)

    def option(key: str) -> tuple[float | None, str]:
        place = files.places.get(key, "")
        return _number(files.options.get(key), values), f" ({place})" if place else ""

    causes: tuple[Callable[[], str], ...] = (
        lambda: _before_begin(depart, start, option("begin")[1]),
        lambda: _unsorted(files, values, one, depart) if option("route-steps")[0] != 0 else "",
        lambda: _past_end_of_flow(one, name, values),
        lambda: _scaled(files, one, *option("scale")),
        lambda: _waited_too_long(*option("max-depart-delay")),
        lambda: _hidden_error(files),
    )
    found = next((text for text in (cause() for cause in causes) if text), "")
    if found:
        return found
    said = "; ".join(line for line in session().messages() if f"'{name}'" in line)
    return f"SUMO does not know it, or not any more{f': {said}' if said else ''}"


def _before_begin(depart: float | None, start: float, place: str) -> str:
    if depart is None or depart >= start:
        return ""
    return (
        f"the simulation begins later, at t = {start:g} s, and SUMO drops what departs before: let it depart at {start:g} s or "
        f"later, or set the option begin{place} to {depart:g} or less"
    )


def _unsorted(files: SumoFiles, values: Values, one: Element, depart: float | None) -> str:
    """Return the cause where an element that stands before it in its route file departs later."""
    in_routes = {str(path) for path in files.routes}
    if depart is None or one.file not in in_routes:
        return ""
    for before in elements(files):
        if before.file != one.file:
            continue
        if (before.line, before.column) >= (one.line, one.column):
            return ""
        later = _number(before.depart, values)
        if later is not None and later > depart:
            return (
                f"it stands behind '{before.attributes['id']}' ({before.place[:-2]}), which departs at {later:g} s, and SUMO "
                "drops what comes late: sort the file by depart, or set the option route-steps: 0"
            )
    return ""


def _past_end_of_flow(one: Element, name: str, values: Values) -> str:
    number = _number(one.attributes.get("number"), values)
    rank = name.rpartition(".")[2]
    if one.tag not in ("flow", "personFlow") or number is None or not rank.isdigit() or int(rank) < number:
        return ""
    last = f"{one.attributes['id']}.{number - 1:g}"
    who = "vehicles" if one.tag == "flow" else "persons"
    return f'the flow has number="{number:g}" {who}, and the last one is \'{last}\': raise its number'


def _scaled(files: SumoFiles, one: Element, scale: float | None, place: str) -> str:
    """Return the cause where the traffic is thinned out by an option or by the vehicle's type."""
    kind = element(files, one.attributes.get("type", "DEFAULT_VEHTYPE"), ("vType",))
    of_type = _number(kind.attributes.get("scale"), {}) if kind is not None else None
    kept = (1.0 if scale is None else scale) * (1.0 if of_type is None else of_type)
    if kept >= 1.0:
        return ""
    if scale is None or scale <= 0.0:
        at = f" ({kind.place[:-2]})" if kind is not None else place
        return f'the scale="{kept:g}" of its traffic{at} has dropped it: set it to 1 for the ego'
    return (
        f"the option scale: {scale:g}{place} has dropped it with a part of the traffic: give it a vType of its own with "
        f'scale="{1.0 / scale:.6g}", which keeps it, or set scale to 1'
    )


def why_copied(files: SumoFiles, values: Values, name: str) -> str:
    """Return the cause and the remedy where SUMO drives copies of a vehicle, from its place, as one text; "" without a cause."""
    scale = _number(files.options.get("scale"), values)
    if scale is None or scale <= 1.0:
        return ""
    one, place = element(files, name, _ROAD_USERS), files.places.get("scale", "")
    kind = one.attributes.get("type") if one is not None else None
    keeper = f"its vType '{kind}'" if kind else "it a vType of its own with"
    where = f" ({place})" if place else ""
    return f'the option scale: {scale:g}{where} copies vehicles: give {keeper} scale="{1.0 / scale:.6g}", or set scale to 1'


def _waited_too_long(limit: float | None, place: str) -> str:
    if limit is None or limit < 0.0:
        return ""
    option = f"the option max-depart-delay: {limit:g}{place}"
    return f"it found no gap within {option}, and SUMO dropped it: raise or remove the option"


def _hidden_error(files: SumoFiles) -> str:
    if files.options.get("ignore-route-errors") not in ("true", "1"):
        return ""
    return "the option ignore-route-errors hides what is wrong with its route: remove the option, and SUMO says it"


def _number(text: str | None, values: Values) -> float | None:
    """Return the number in a text with placeholders; None where there is none."""
    try:
        return None if text is None else float(fill(text, values))
    except (ValueError, InputError, RunError):
        return None

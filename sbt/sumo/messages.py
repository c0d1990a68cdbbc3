"""SUMO's messages about a user's files, with the place of what they speak of and what to change.

SUMO names the id of an element, but neither its file nor its line, and seldom a remedy.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from sbt.errors import RunError, did_you_mean
from sbt.problem.outcome import Status
from sbt.sumo.elements import Element, elements
from sbt.sumo.files import SumoFiles
from sbt.sumo.template import template

__all__ = ["DROPPED", "dropped", "explained", "refuse_dropped"]

DROPPED = "should be sorted by departure time, ignoring"
"""In SUMO's warning about such traffic."""
_PREFIX = "SUMO: "
_KINDS = {
    "vehicle": ("vehicle", "trip", "flow"), "flow": ("flow", "personFlow"), "route": ("route",), "vehicle type": ("vType",),
    "vtype": ("vType",),
    "person": ("person", "personFlow"), "stop": ("vehicle", "trip", "flow"), "trip": ("trip",),
}  # fmt: skip
"""Elements by the words with which SUMO speaks of them."""
_OF_TYPE = re.compile(r"Car-Following-Model Attribute (\w+)\.|^SUMO: (\w+) must be greater than 0")
"""Mistakes in a vType of which SUMO names the attribute, but not the type."""
_NAMED = re.compile(rf"\b({'|'.join(sorted(_KINDS, key=len, reverse=True))})(?: with (?:the )?id)?\s+'([^']+)'", re.IGNORECASE)


def explained(reason: str, files: SumoFiles) -> str:
    """Return the reason of an error of SUMO with `file:line:column: ` before it and the remedy behind it, where they are known.

    Args:
        reason: of a `RunError`, which begins with `SUMO: `; any other is returned as it is.
        files: of the simulation.
    """
    if not reason.startswith(_PREFIX):
        return reason
    known = list(elements(files))
    errors = "; ".join(part for part in reason.split("; ") if not part.startswith("Warning:"))
    named = (_element(known, kind.lower(), name) for text in (errors, reason) for kind, name in _NAMED.findall(text))
    first = next((one for one in named if one is not None), None) or _faulty_type(reason, known)
    reason = reason.replace(f"{_PREFIX}; Error: ", _PREFIX)
    remedy = ""
    for pattern, advise in _REMEDIES:
        match = pattern.search(reason)
        if match is not None:
            remedy = ": " + advise(match, known, files)
            break
    return f"{'' if first is None else _place(reason, first, known)}{reason.rstrip('. ')}{remedy}"


def dropped(lines: Sequence[str]) -> list[str]:
    """Return the traffic, as SUMO names it, that it left out of a run because a file is not sorted by departure."""
    return [line.rpartition("ignoring ")[2].rstrip("!") for line in lines if DROPPED in line]


def refuse_dropped(lines: Sequence[str]) -> None:
    """Refuse a run of which SUMO left out traffic that its files ask for.

    Raises:
        RunError: it did.
    """
    names = dropped(lines)
    if names:
        rule = "a route file must be sorted by departure, whatever the inputs are"
        remedy = "sort it, and put what departs by an input into a route file of its own"
        raise RunError(Status.INVALID, f"{rule}, but SUMO leaves out {', '.join(dict.fromkeys(names))}: {remedy}")


def _element(known: list[Element], kind: str, name: str) -> Element | None:
    for wanted in (name, name.rpartition(".")[0]):
        found = [one for one in known if one.tag in _KINDS[kind] and one.attributes["id"] == wanted]
        if found:
            return found[0]
    return None


def _faulty_type(reason: str, known: list[Element]) -> Element | None:
    """Return the vType with the attribute that SUMO refuses; None where it may be another one."""
    match = _OF_TYPE.search(reason)
    if match is None:
        return None
    attribute = match.group(1) or match.group(2)
    types = [one for one in known if one.tag == "vType" and attribute in one.attributes]
    refused = [one for one in types if _is_refused(one.attributes[attribute], reason)]
    return next(iter(refused), types[0] if len(types) == 1 else None)


def _is_refused(text: str, reason: str) -> bool:
    """Return whether a value is what the reason refuses; not known of placeholders."""
    if "${" in text:
        return False
    try:
        value = float(text)
    except ValueError:
        return True
    return not 0 <= value <= 1 if "[0-1]" in reason else value <= 0 if "greater than 0" in reason else False


def _place(reason: str, first: Element, known: list[Element]) -> str:
    """Return the place of the element to change: the second of two, and the route of a vehicle where it is the route."""
    if reason.startswith(f"{_PREFIX}Another"):
        return [one for one in known if one.tag in _KINDS["vehicle"] and one.attributes["id"] == first.attributes["id"]][-1].place
    if "o connection between" in reason and "route" in first.attributes:
        return (_element(known, "route", first.attributes["route"]) or first).place
    return first.place


def _net_bytes(files: SumoFiles) -> bytes:
    return template(files.net).opened().read()


def _net_ids(files: SumoFiles, tag: str) -> list[str]:
    found = re.findall(rf'<{tag}\b[^>]*?\sid="([^"]*)"'.encode(), _net_bytes(files))
    return [name.decode() for name in found if not name.startswith(b":")]


def _unconnected(match: re.Match[str], known: list[Element], files: SumoFiles) -> str:
    """Return the advice for two edges of a route, one of which does not lead to the other."""
    start, end = match.group(1), match.group(2)
    connection = rf'<connection\b(?=[^>]*\sfrom="{re.escape(start)}")(?=[^>]*\sto="{re.escape(end)}")'.encode()
    if re.search(connection, _net_bytes(files)):
        return (
            f"'{start}' leads to '{end}', but not for its vehicle class: allow it on the lanes of {files.net.name}, or choose "
            "another vClass"
        )
    return (
        f"name the edges that lie between '{start}' and '{end}', or only the first and the last, as a <trip from=... to=...>, "
        "for which SUMO finds the way"
    )


def _no_way(match: re.Match[str], known: list[Element], files: SumoFiles) -> str:
    return "no way leads from its first to its last edge for its vehicle class: choose other edges (from, to) or another vClass"


def _unknown_edge(match: re.Match[str], known: list[Element], files: SumoFiles) -> str:
    name = match.group(1)
    return f"name an edge of {files.net.name}{did_you_mean(name, _net_ids(files, 'edge'))}"


def _unknown_reference(match: re.Match[str], known: list[Element], files: SumoFiles) -> str:
    kind, name = match.group(1), match.group(2)
    tag = "route" if kind == "route" else "vType"
    ids = [one.attributes["id"] for one in known if one.tag == tag]
    if name in ids:
        return "it stands there, below what uses it: move it up"
    return f'define <{tag} id="{name}"> before it, or name one that is there{did_you_mean(name, ids)}'


def _fixed(text: str) -> Callable[[re.Match[str], list[Element], SumoFiles], str]:
    return lambda match, known, files: text


_Advise = Callable[[re.Match[str], list[Element], SumoFiles], str]
_SPEED = "lower its departSpeed, or raise the maxSpeed of its vType and the speed of its lane"
_REMEDIES: tuple[tuple[re.Pattern[str], _Advise], ...] = tuple(
    (re.compile(pattern), advise)
    for pattern, advise in (
        (r"o connection between edge '([^']+)' and edge '([^']+)' found", _no_way),
        (r"o connection between edge '([^']+)' and edge '([^']+)'", _unconnected),
        (r"has no valid route|o route for vehicle", _no_way),
        (r"edge '([^']+)' within the route .* is not known", _unknown_edge),
        (r"[Tt]he (?:\w+[- ])?edge '([^']+)' .*is not known", _unknown_edge),
        (r"The (route|vehicle type) '([^']+)' for .* is not known", _unknown_reference),
        (r"Another .* with the id", _fixed("give one of them another id")),
        (r"Invalid departLane [^:]*int>=0", _fixed("name one of these, or a whole number: of an input, `kind: integer`")),
        (r"Invalid departLane", _fixed("its first edge must have that lane for its vehicle class")),
        (r"eparture speed for .* too high", _fixed(_SPEED)),
        (r"Negative departure time", _fixed("let it depart at 0 s or later")),
        (r"Invalid start or end position for stop", _fixed("0 <= startPos < endPos <= the lane's length must hold")),
    )
)
"""What is searched in the reason, and what to change then; the first one counts."""

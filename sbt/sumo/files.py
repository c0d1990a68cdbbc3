"""The options of a user's simulation, from a `.sumocfg`, a command line or a scenario file, and the files they name.

All options are passed on SUMO's command line, so that every value may contain placeholders. File names are
relative to the file that contains them. Some options are fixed (`FIXED_OPTIONS`), and so is the seed of the run;
output options are dropped.
"""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from sbt.errors import InputError
from sbt.plugins import noted
from sbt.problem.plain import Values
from sbt.sumo.demand import seconds_of
from sbt.sumo.formatting import format_number
from sbt.sumo.outputs import begin_outputs
from sbt.sumo.places import made_here, place_in
from sbt.sumo.template import Placeholder, Template, Vehicle, fill, linked, placeholders, template, tried

__all__ = ["FIXED_OPTIONS", "Launch", "SumoFiles", "options_of_command", "options_of_config"]

FIXED_OPTIONS = {
    "random": "false", "collision.action": "warn", "collision.mingap-factor": "0", "collision.check-junctions": "true",
    "no-step-log": "true", "duration-log.disable": "true", "xml-validation": "never",
}  # fmt: skip
"""Set for every run, whatever a configuration says: they make runs repeatable and collisions visible."""
_DEFAULTS = {"step-length": "0.1", "time-to-teleport": "-1", "xml-validation.net": "never", "xml-validation.routes": "never"}
"""Where the user sets nothing else. SUMO's defaults are a step of 1 s, and teleporting after 300 s of waiting."""
_ALIASES = {
    "n": "net-file", "net": "net-file", "r": "route-files", "a": "additional-files", "additional": "additional-files",
    "w": "weight-files", "b": "begin", "e": "end", "c": "configuration-file", "routes": "route-files", "weights": "weight-files",
    "configuration": "configuration-file", "s": "route-steps",
}  # fmt: skip
"""Short names of options, as SUMO has them."""
_FILES = ("net-file", "route-files", "additional-files")
_OUTPUT = re.compile(
    r".*-output(\..*)?|output-prefix|output-suffix|(n|net)?(state-)?dump.*|netstate.*|(person-)?summary|(trip|person)info|person-fcd"
    r"|(veh|person)routes(\..*)?|device\.(rerouting|taxi\..*)\.output|device\.(ssm|toc)\.file|pedestrian\.jupedsim\.(wkt|py)"
    r"|save-.*|C|(.*-)?log(-file)?|l"
)
"""Options that make SUMO write files, their details, and their older names (of `sumo --save-template`)."""
_ENDLESS = re.compile(r"[+-]?(nan|inf|infinity)", re.IGNORECASE)
_NAME = re.compile(r"[A-Za-z][\w.-]*")
_LIKE_AN_OPTION = re.compile(r"--?[A-Za-z]")
_IDS = (".explicit", ".knownveh", "remove-vehicles")
"""How options end whose values are ids, which may begin with a minus; SUMO never takes these for options."""
_GUI = ("gui-settings-file", "start", "quit-on-end", "delay", "window-size", "window-pos", "tracker-interval", "S", "Q", "d", "g")
_TIMES = re.compile(
    r"begin|end|step-length|max-depart-delay|route-steps|time-to-teleport(\.(highways|disconnected|bidi|ride|railsignal-deadlock))?"
)
_LONGEST_TIME = 9e15
"""Options that are times, and the longest one that SUMO counts (s)."""
_FALSE = ("0", "no", "false", "off", "-", "f")
_OF_SERVER = ("remote-port", "num-clients", "configuration-file")
"""With these SUMO waits for a client, or reads further options by itself."""
_NEWEST_NET_VERSION = (1, 20)
"""Version of the network files that SUMO 1.28 writes."""


@dataclass(frozen=True)
class Launch:
    """A complete command line except for the seed; a `Loadable` of `Session.run`."""

    arguments: tuple[str, ...]

    def command(self, seed: int) -> list[str]:
        """Return SUMO's arguments without the program's name."""
        return [*self.arguments, "--seed", str(seed)]

    def write(self, seed: int, path: Path) -> Path:
        """Write the command line as a `.sumocfg`, and return its path; files below its folder are named relative to it."""
        root, words = ET.Element("configuration"), self.command(seed)
        for option, value in zip(words[::2], words[1::2], strict=True):
            ET.SubElement(root, option.removeprefix("--"), value=value.replace(f"{path.parent}{os.sep}", ""))
        ET.indent(root, "    ")
        path.write_text(ET.tostring(root, encoding="unicode") + "\n", encoding="utf-8")
        return path


@dataclass(frozen=True)
class SumoFiles:
    """The options and files of a simulation.

    Args:
        options: values by SUMO's option names, without the files below.
        net: network file.
        routes: route files, in order.
        additional: additional files, in order.
        places: where each option was given, for messages.
        compared: vehicles whose departures are compared with what is requested, beside the ego and those with placeholders.
    """

    options: Mapping[str, str]
    net: Path
    routes: tuple[Path, ...] = ()
    additional: tuple[Path, ...] = ()
    places: Mapping[str, str] = field(default_factory=dict)
    compared: tuple[str, ...] = ()

    @classmethod
    def of(cls, options: Mapping[str, str], folder: Path, place: str) -> SumoFiles:
        """Return the files that are named in options.

        Args:
            options: values by SUMO's option names; several files are separated by commas.
            folder: that file names are relative to.
            place: where the options were given, for messages.

        Raises:
            InputError: not exactly one network is named, or a file does not exist.
        """
        options = {_known(name, place): value for name, value in options.items()}
        if "configuration-file" in options:
            raise InputError(f"{place}: a configuration is named by config, but options name '{options['configuration-file']}'")
        named = {k: [_existing(k, name, folder, place) for name in _split(options.get(k, ""))] for k in _FILES}
        if len(named["net-file"]) != 1:
            raise InputError(f"{place}: a simulation needs one network (net-file), but got {len(named['net-file'])}")
        others = {k: _absolute(k, v, folder) for k, v in options.items() if k not in _FILES and not _dropped(k)}
        for name, value in others.items():
            _check_value(name, value, place)
        net, routes, additional = (tuple(named[k]) for k in _FILES)
        return cls(others, net[0], routes, additional, dict.fromkeys(others, place))

    @cached_property
    def templates(self) -> tuple[Template, ...]:
        """All files, with the files that they include, checked.

        Raises:
            InputError: a file is not as required.
        """
        found = tuple(t for path in (self.net, *self.routes, *self.additional) for t in template(path).tree())
        for name, value in self.options.items():
            for path in map(Path, _split(value) if _names_files(name) else ()):
                if path.name.endswith((".xml", ".xml.gz")) and path.is_file():
                    template(path)
                elif path.is_file() and not made_here(path):
                    noted(path, loaded_anew=True)
        _check_net(template(self.net))
        _check_ids(found)
        return found

    def placeholders(self) -> Iterator[Placeholder]:
        """Yield all placeholders in files and options."""
        for one in self.templates:
            yield from (hole for part in one.parts for hole in part.holes)
        for name, value in self.options.items():
            yield from placeholders(value, f"{self.places.get(name, '')}: {name}")

    def vehicle(self, name: str) -> tuple[Vehicle, Template] | None:
        """Return a vehicle, or the flow that generates it, and its file; None if there is none."""
        for wanted in (name, name.rpartition(".")[0]):
            for one in self.templates:
                if wanted in one.vehicles:
                    return one.vehicles[wanted], one
        return None

    def names(self) -> list[str]:
        """Return the ids of all vehicles, trips and flows."""
        return [name for one in self.templates for name in one.vehicles]

    def launch(self, values: Values, folder: Path, step_length: float | None = None) -> Launch:
        """Return the command line for these values, writing copies of files with placeholders to `folder`.

        Raises:
            RunError: a placeholder's value is not finite.
        """
        self.templates  # noqa: B018  (checks them before SUMO reads them)
        outputs = begin_outputs(folder)
        given = {k: fill(v, values, self.places.get(k, "")) for k, v in self.options.items()}
        for name, value in given.items():
            _check_value(name, value, self.places.get(name, name))
        if "load-state" in given:  # what is in it may name outputs too
            given["load-state"] = ",".join(
                str(template(path).write(values, folder)) for path in map(Path, _split(given["load-state"]))
            )
        written = {
            name: ",".join(str(template(path).write(values, folder)) for path in paths)
            for name, paths in zip(_FILES, ((self.net,), self.routes, self.additional), strict=True)
            if paths
        }
        step = {} if step_length is None else {"step-length": format_number(step_length)}
        options = {**_DEFAULTS, **given, **step, **FIXED_OPTIONS, **written, "device.ssm.file": str(outputs / "ssm.xml")}
        options.pop("seed", None)
        return Launch(tuple(part for name, value in options.items() for part in (f"--{name}", value)))

    def step_length(self) -> float | None:
        """Return the step that the options set (s); None where they do not, or set it by a placeholder."""
        try:
            return float(self.options["step-length"])
        except (KeyError, ValueError):
            return None


def options_of_config(path: Path) -> dict[str, str]:
    """Return the options of a `.sumocfg` by SUMO's names, with absolute file names and without outputs.

    Raises:
        InputError: it cannot be read, or is not a SUMO configuration.
    """
    root = template(path.resolve())
    if not re.fullmatch("(sumo-?)?configuration", root.root[0], re.IGNORECASE):
        raise InputError(f"{path}: a SUMO configuration must have the root <configuration>, but has <{root.root[0]}>")
    options: dict[str, str] = {}
    for section in ET.parse(path).getroot().iter():
        value = section.get("value", section.get("v"))
        if value is None:
            continue
        name = _known(section.tag, str(path))
        if not _dropped(name):
            options[name] = _absolute(name, value, path.resolve().parent)
    return options


def options_of_command(command: Sequence[str], folder: Path) -> dict[str, str]:
    """Return the options of a SUMO command line without the program's name, as passed to `traci.start`.

    Raises:
        InputError: an argument is not an option.
    """
    options: dict[str, str] = {}
    rest = [str(part) for part in command]
    while rest:
        word = rest.pop(0)
        if not re.match(r"--?[A-Za-z]", word):
            raise InputError(f"sumo.start takes SUMO's options (--name value), but got '{word}'")
        name, equals, value = word.lstrip("-").partition("=")
        if not equals:
            value = rest.pop(0) if rest and not re.match(r"--?[A-Za-z]", rest[0]) else "true"
        name = _known(name, "sumo.start")
        if name == "configuration-file":
            options = {**options_of_config((folder / value).resolve()), **options}
        elif not _dropped(name):
            options[name] = value if name in _FILES else _absolute(name, value, folder)
    return options


def _dropped(name: str) -> bool:
    return _OUTPUT.fullmatch(name) is not None or name in _GUI or name in _OF_SERVER


def _known(name: str, place: str) -> str:
    """Return the long name of an option.

    Raises:
        InputError: it is no name, which SUMO could read as an option with a value.
    """
    if not _NAME.fullmatch(name):
        raise InputError(f"{place}: the name of an option must be one of SUMO's, without dashes, but got '{name}'")
    return _ALIASES.get(name, name)


def _check_value(name: str, value: str, place: str) -> None:
    """Refuse a value that SUMO would take for a further option, where the option before it may stand alone.

    So is a mesoscopic simulation, whose vehicles have no place but that of the segment of road they are in.
    """
    if _LIKE_AN_OPTION.match(value) and not name.endswith(_IDS):
        raise InputError(f"{place}: the value of {name} must not look like an option, but got '{value}'")
    shown = tried(value)
    if "${" in shown:
        raise InputError(f"{place}: a placeholder in the value of {name} must be closed, but got '{value}'")
    if _TIMES.fullmatch(name):
        _check_option_time(name, value, place)
    elif _ENDLESS.fullmatch(shown.strip()) and not name.endswith(_IDS):
        raise InputError(f"{place}: {name} must be finite, but got '{value}'")
    if name == "mesosim" and "${" not in value and value.strip().lower() not in _FALSE:
        what = "vehicles of a mesoscopic simulation have no positions to measure"
        raise InputError(f"{place}: mesosim must be false, as {what}, but got '{value}'")


def _check_option_time(name: str, value: str, place: str) -> None:
    """Refuse what SUMO reads as no time, and times that it does not begin, end, or step with."""
    time, varies = seconds_of(tried(value)), "${" in value
    if time is None or not abs(time) < _LONGEST_TIME:
        raise InputError(f"{place}: {name} must be a time (s, or hours:minutes:seconds), but got '{value}'")
    if name == "step-length" and not varies and round(time * 1000) < 1:
        raise InputError(f"{place}: step-length must be at least 0.001 s, but got '{value}'")
    if not varies and time < 0 and (name == "begin" or (name == "end" and time != -1)):
        raise InputError(f"{place}: {name} must not be negative, but got '{value}'")


def _split(value: str) -> list[str]:
    return [name.strip() for name in value.split(",") if name.strip()]


def _existing(option: str, name: str, folder: Path, place: str) -> Path:
    path = linked(folder / Path(name).expanduser())
    if "${" in name:
        raise InputError(f"{place}: {option} must not hold a placeholder (their values may), but got '{name}'")
    if not path.is_file():
        raise InputError(f"{place}: {option} must name a file that exists, but got '{name}'")
    return path


def _names_files(option: str) -> bool:
    return option.endswith(("-file", "-files", "load-state"))


def _absolute(option: str, value: str, folder: Path) -> str:
    """Return the value of an option, with absolute names of existing files where it names files."""
    if not _names_files(option):
        return value
    return ",".join(
        str(linked(folder / name)) if (folder / name).exists() or option in _FILES else name for name in _split(value)
    )


def _check_ids(files: Sequence[Template]) -> None:
    """Check that no person has the id of a vehicle: SUMO takes them apart, but tells of both who is near by their ids alone.

    Raises:
        InputError: one has.
    """
    for one in files:
        for name, place in one.persons.items():
            for other in files:
                if name in other.vehicles:
                    there = place_in(other.path, *other.vehicles[name].place)
                    rule = f"no person may have the id of a vehicle, but there is a vehicle '{name}' too ({there})"
                    remedy = "give persons a prefix of their own (randomTrips.py --prefix p)"
                    raise InputError(f"{place_in(one.path, *place)}: {rule}: {remedy}")


def _check_net(net: Template) -> None:
    """Check that a file is a network of a version that this SUMO reads: any up to its own, also those before 1.0.

    Raises:
        InputError: it is not.
    """
    tag, attributes = net.root
    if tag != "net":
        source = "--opendrive" if tag == "OpenDRIVE" else "--osm" if tag == "osm" else "..."
        raise InputError(
            f"{net.path}: a network must have the root <net>, but has <{tag}>; "
            f"make it with netconvert {source} {net.path.name} -o {net.path.name.partition('.')[0]}.net.xml"
        )
    version = attributes.get("version", "")
    match = re.fullmatch(r"(\d+)\.(\d+)", version)
    numbers = (int(match.group(1)), int(match.group(2))) if match is not None else (0, 0)
    if not (0, 0) < numbers <= _NEWEST_NET_VERSION:
        newest = ".".join(map(str, _NEWEST_NET_VERSION))
        raise InputError(
            f"{net.path}: a network must be of a version up to {newest}, but is of '{version}', made by another SUMO; "
            f"convert it: netconvert -s {net.path.name} -o new.net.xml"
        )

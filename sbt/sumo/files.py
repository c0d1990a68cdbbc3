"""What SUMO is started with: the options of a `.sumocfg`, a command line or a scenario file, and the files they name.

All options go to SUMO's command line, so that placeholders may stand in every value. Files are found
relative to where they are named. A few options are this package's own (`OWN`): the run's seed, and what
makes a run repeatable and its collisions visible. What a configuration would write is left out.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from sbt.errors import InputError
from sbt.sumo.formatting import format_number
from sbt.sumo.template import Placeholder, Template, Vehicle, fill, placeholders, template

__all__ = ["OWN", "Launch", "SumoFiles", "options_of_command", "options_of_config"]

OWN = {
    "random": "false", "collision.action": "warn", "collision.mingap-factor": "0", "collision.check-junctions": "true",
    "no-step-log": "true", "duration-log.disable": "true", "xml-validation": "never",
}  # fmt: skip
"""Options that are the same for every run, whatever a configuration says; `seed` is the run's."""
_DEFAULTS = {"step-length": "0.1", "time-to-teleport": "-1", "xml-validation.net": "never", "xml-validation.routes": "never"}
"""Where nothing else is said. SUMO's own would be a step of 1 s, and to move who waits for 300 s."""
_NAMES = {
    "n": "net-file", "net": "net-file", "r": "route-files", "a": "additional-files", "additional": "additional-files",
    "w": "weight-files", "b": "begin", "e": "end", "c": "configuration-file",
}  # fmt: skip
_FILES = ("net-file", "route-files", "additional-files")
_WRITTEN = re.compile(r".*(-output|output-prefix|-log)$|save-state.*|save-configuration|save-template|log|l")
_GUI = ("gui-settings-file", "start", "quit-on-end", "delay", "window-size", "window-pos", "tracker-interval", "S", "Q", "d", "g")
_NEWEST_NET = (1, 20)
"""Version of the networks that this SUMO writes."""


@dataclass(frozen=True)
class Launch:
    """A finished command line but for the seed, as `Session.run` takes it."""

    arguments: tuple[str, ...]

    def command(self, seed: int) -> list[str]:
        """Return SUMO's arguments without the program's name."""
        return [*self.arguments, "--seed", str(seed)]


@dataclass(frozen=True)
class SumoFiles:
    """The options of a simulation and its files.

    Args:
        options: SUMO option to value, without the files.
        net: the network.
        routes, additional: the further files, in order.
        places: option to where it stands, for messages.
    """

    options: Mapping[str, str]
    net: Path
    routes: tuple[Path, ...] = ()
    additional: tuple[Path, ...] = ()
    places: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, options: Mapping[str, str], folder: Path, place: str) -> SumoFiles:
        """Return the files that options name.

        Args:
            options: by SUMO's names; files relative to `folder`, several of them joined by commas.
            folder: of what names them.
            place: what names them, for messages.

        Raises:
            InputError: no network, or a file that is not there.
        """
        named = {k: [_found(k, name, folder, place) for name in _split(options.get(k, ""))] for k in _FILES}
        if len(named["net-file"]) != 1:
            raise InputError(f"{place}: a simulation needs one network (net-file), but got {len(named['net-file'])}")
        others = {k: _absolute(k, v, folder) for k, v in options.items() if k not in _FILES}
        net, routes, additional = (tuple(named[k]) for k in _FILES)
        return cls(others, net[0], routes, additional, dict.fromkeys(others, place))

    @cached_property
    def templates(self) -> tuple[Template, ...]:
        """Every file with those it includes, checked.

        Raises:
            InputError: one of them is not what it should be.
        """
        found = tuple(t for path in (self.net, *self.routes, *self.additional) for t in template(path).tree())
        for name, value in self.options.items():
            for path in map(Path, _split(value) if _of_files(name) else ()):
                if path.name.endswith((".xml", ".xml.gz")) and path.is_file():
                    template(path)
        _check_net(template(self.net))
        return found

    def placeholders(self) -> Iterator[Placeholder]:
        """Yield every placeholder, in the files and in the options."""
        for one in self.templates:
            yield from (p.placeholder for p in one.parts if p.placeholder is not None)
        for name, value in self.options.items():
            yield from placeholders(value, f"{self.places.get(name, '')}: {name}")

    def vehicle(self, name: str) -> tuple[Vehicle, Template] | None:
        """Return a vehicle, or the flow that makes it, and its file; None where there is none."""
        for wanted in (name, name.rpartition(".")[0]):
            for one in self.templates:
                if wanted in one.vehicles:
                    return one.vehicles[wanted], one
        return None

    def names(self) -> list[str]:
        """Return the ids of all vehicles, trips and flows."""
        return [name for one in self.templates for name in one.vehicles]

    def launch(self, values: Mapping[str, float], folder: Path, step_length: float | None = None) -> Launch:
        """Return the command line for these values; filled copies go to `folder`.

        Raises:
            RunError: a placeholder's value is not finite.
        """
        self.templates  # noqa: B018  (checked before SUMO sees them)
        written = {
            name: ",".join(str(template(path).write(values, folder)) for path in paths)
            for name, paths in zip(_FILES, ((self.net,), self.routes, self.additional), strict=True)
            if paths
        }
        given = {k: fill(v, values, self.places.get(k, "")) for k, v in self.options.items()}
        chosen = {} if step_length is None else {"step-length": format_number(step_length)}
        options = {**_DEFAULTS, **given, **chosen, **OWN, **written}
        options.pop("seed", None)
        return Launch(tuple(part for name, value in options.items() for part in (f"--{name}", value)))

    def step_length(self) -> float | None:
        """Return the step that the options ask for (s), None where they do not, or by an input."""
        try:
            return float(self.options["step-length"])
        except (KeyError, ValueError):
            return None


def options_of_config(path: Path) -> dict[str, str]:
    """Return the options of a `.sumocfg`: names as SUMO's, files absolute, without what it would write.

    Raises:
        InputError: it cannot be read, or is no configuration of SUMO.
    """
    root = template(path.resolve())
    if not re.fullmatch("(sumo-?)?configuration", root.root[0], re.IGNORECASE):
        raise InputError(f"{path}: a SUMO configuration must have the root <configuration>, but has <{root.root[0]}>")
    options: dict[str, str] = {}
    for section in ET.parse(path).getroot().iter():
        value = section.get("value", section.get("v"))
        name = _NAMES.get(section.tag, section.tag)
        if value is not None and not _left_out(name):
            options[name] = _absolute(name, value, path.resolve().parent)
    return options


def options_of_command(command: Sequence[str], folder: Path) -> dict[str, str]:
    """Return the options of a command line such as `traci.start` takes, without the program's name.

    Raises:
        InputError: it is no such command line.
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
        name = _NAMES.get(name, name)
        if name == "configuration-file":
            options = {**options_of_config((folder / value).resolve()), **options}
        elif not _left_out(name):
            options[name] = value if name in _FILES else _absolute(name, value, folder)
    return options


def _left_out(name: str) -> bool:
    return _WRITTEN.fullmatch(name) is not None or name in _GUI


def _split(value: str) -> list[str]:
    return [name.strip() for name in value.split(",") if name.strip()]


def _found(option: str, name: str, folder: Path, place: str) -> Path:
    path = (folder / Path(name).expanduser()).resolve()
    if "${" in name:
        raise InputError(f"{place}: {option} must not hold a placeholder (their values may), but got '{name}'")
    if not path.is_file():
        raise InputError(f"{place}: {option} must name a file that exists, but got '{name}'")
    return path


def _of_files(option: str) -> bool:
    return option.endswith(("-file", "-files", "load-state"))


def _absolute(option: str, value: str, folder: Path) -> str:
    """Return the value with names of existing files absolute, where the option is about files."""
    if not _of_files(option):
        return value
    return ",".join(
        str((folder / name).resolve()) if (folder / name).exists() or option in _FILES else name for name in _split(value)
    )


def _check_net(net: Template) -> None:
    """Refuse what is no network, or one of a SUMO that this one does not know.

    Raises:
        InputError: it is another kind of file, or of another version.
    """
    tag, attributes = net.root
    if tag != "net":
        raise InputError(f"{net.path}: a network must have the root <net>, but has <{tag}>; make it with netconvert")
    version = attributes.get("version", "")
    match = re.fullmatch(r"(\d+)\.(\d+)", version)
    numbers = (int(match.group(1)), int(match.group(2))) if match is not None else (0, 0)
    if not (1, 0) <= numbers <= _NEWEST_NET:
        newest = ".".join(map(str, _NEWEST_NET))
        raise InputError(
            f"{net.path}: a network must be of a version from 1.0 to {newest}, but is of '{version}', made by another SUMO; "
            f"convert it: netconvert -s {net.path.name} -o new.net.xml"
        )

"""Where each key of a configuration stands: file, line and column, or the `--set` that gave it.

YAML 1.2 is read twice by ruamel.yaml: as nodes, for positions and doubled keys, and as values.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from sbt import plugins
from sbt.errors import InputError, did_you_mean

__all__ = [
    "LARGEST",
    "TOO_LARGE",
    "ConfigError",
    "Key",
    "Place",
    "Problems",
    "SourceMap",
    "must_be_measured",
    "must_be_one_of",
    "read_value",
    "read_yaml",
    "yaml_reader",
]

LARGEST = 2**20
"""Most bytes of a file that is read whole as YAML."""
TOO_LARGE = f"a configuration must have at most {LARGEST} bytes"
_NODES, _ENDLESS = 100_000, 10**12
"""Most values of a document, aliases counted in full; and how many count as endless."""

T = TypeVar("T")
Key = tuple[str | int, ...]
"""Path of keys and list positions."""
_SURROGATE = re.compile("[\ud800-\udfff]")
_TEXT = tuple(f"tag:yaml.org,2002:{name}" for name in ("str", "merge", "value"))
_DEPTH = 30
"""Deeper nesting is an alias that contains itself."""


class ConfigError(InputError):
    """Everything that is wrong with a configuration; `errors` has one line for each."""

    def __init__(self, errors: Sequence[str]):
        """Keep the lines, one an error."""
        super().__init__("\n".join(errors))
        self.errors = tuple(errors)

    def __reduce__(self) -> tuple[type[ConfigError], tuple[tuple[str, ...]]]:
        """Pickle by the errors."""
        return type(self), (self.errors,)


@dataclass(frozen=True)
class Place:
    """Line and column, from 1, of a key and of its value."""

    key: tuple[int, int] = (1, 1)
    value: tuple[int, int] = (1, 1)


@dataclass(frozen=True)
class SourceMap:
    """Places of the keys in one file, and the keys that options gave.

    Args:
        name: the file, as the user wrote it.
        places: by path of keys.
        overrides: what gave the paths that options did, such as `--set budget` or `--store`.
        texts: unquoted values as they are written, by path: `007` where YAML reads the number 7.
    """

    name: str
    places: Mapping[Key, Place] = field(default_factory=dict)
    overrides: Mapping[Key, str] = field(default_factory=dict)
    texts: Mapping[Key, str] = field(default_factory=dict)

    def located(self, key: str | Key, message: str, *, at_key: bool = False) -> str:
        """Return `file:line:column: key.path: message`, or `--set key.path: message`.

        Args:
            key: dotted path or its parts; the nearest key that is written somewhere gives the place.
            message: the rule, then the value.
            at_key: the key itself is wrong, not its value.
        """
        return self._sortable(_path(key), message, at_key)[1]

    def sorted(self, problems: Sequence[tuple[Key, str, bool]]) -> list[str]:
        """Return the located messages of (path, message, at_key), in the order of the file."""
        lines = [self._sortable(*problem) for problem in problems]
        return [text for _, text in sorted(lines, key=lambda line: line[0])]

    def _sortable(self, path: Key, message: str, at_key: bool) -> tuple[tuple[int, int, int], str]:
        dotted = ".".join(str(part) for part in path)
        for prefix in (path[:n] for n in range(len(path), -1, -1)):
            if prefix in self.overrides:
                inner = "" if prefix == path else f" {dotted}:"
                return (1, 0, 0), f"{self.overrides[prefix]}:{inner} {message}"
            if prefix in self.places:
                place = self.places[prefix]
                line, column = place.key if at_key and prefix == path else place.value
                subject = f" {dotted}:" if dotted else ""
                return (0, line, column), f"{self.name}:{line}:{column}:{subject} {message}"
            below = min((given for given in self.overrides if given[: len(prefix)] == prefix), default=None)
            if below is not None:  # what is written nowhere else came with it
                return (1, 0, 0), f"{self.overrides[below]}: {dotted}: {message}"
        return (0, 0, 0), f"{self.name}: {dotted}: {message}"


@dataclass
class Problems:
    """Collects what is wrong, each at its key, until `check` raises all of it."""

    source: SourceMap
    found: list[tuple[Key, str, bool]] = field(default_factory=list)

    def add(self, path: Key, message: str, *, at_key: bool = False) -> None:
        """Keep a problem."""
        self.found.append((path, message, at_key))

    def attempt(self, path: Key, make: Callable[[], T]) -> T | None:
        """Return what `make` makes; None where it raises an `InputError`, which is kept."""
        try:
            return make()
        except InputError as error:
            self.add(path, str(error))
            return None

    def error(self) -> ConfigError:
        """Return everything that was found as one error."""
        return ConfigError(self.source.sorted(self.found))

    def check(self) -> None:
        """Raise what was found, if anything was."""
        if self.found:
            raise self.error()


def must_be_one_of(what: str, name: str, known: Sequence[str]) -> str:
    """Return the message about a name that is not among the known ones."""
    return f"{what} must be one of {', '.join(known)}, but got '{name}'{did_you_mean(name, known)}"


def must_be_measured(name: str, measured: Sequence[str]) -> str:
    """Return the message about a metric that a scenario does not measure; an installed one can be."""
    more = f"; {name} is measured where it is among metrics" if name in plugins.names("metrics") else ""
    return f"{must_be_one_of('a metric', name, measured)}{more}"


def _path(key: str | Key) -> Key:
    parts = key.split(".") if isinstance(key, str) else key
    return tuple(int(p) if isinstance(p, str) and p.isdecimal() else p for p in parts)


def yaml_reader() -> YAML:
    """Return a reader and writer of YAML 1.2: plain data only, order kept."""
    yaml = YAML(typ="safe", pure=True)
    yaml.allow_duplicate_keys = True  # reported by `read_yaml`, all of them
    yaml.default_flow_style = False
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    return yaml


def read_yaml(text: str, name: str) -> tuple[Any, SourceMap, list[str]]:
    """Return the value of a YAML document, where its keys stand, and a message for each doubled key.

    Raises:
        ConfigError: the text is not YAML, is too large, or its aliases (*name) stand for too much.
    """
    if len(text) > LARGEST:
        raise ConfigError([f"{name}: {TOO_LARGE}, but has {len(text)}"])
    try:
        node = yaml_reader().compose(text)
        size = _size(node, {})
        value = yaml_reader().load(text) if size <= _NODES else None
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line, column = (mark.line + 1, mark.column + 1) if mark is not None else (1, 1)
        what = " ".join(filter(None, (error.context, error.problem))).replace("\n", " ")
        hint = " (indent with blanks, not with tabs)" if "'\\t'" in what else ""
        raise ConfigError([f"{name}:{line}:{column}: the file must be YAML, but {what}{hint}"]) from None
    except (YAMLError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        where = str(text[: getattr(error, "position", 0)]).count("\n") + 1
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        if not isinstance(error, YAMLError | ValueError | RecursionError):  # as !!bool x does
            reason = f"a value is not what its tag (!!) says: {reason}"
        raise ConfigError([f"{name}:{where}:1: the file must be YAML, but {reason}"]) from None
    if odd := _half_character(value):
        raise ConfigError([f"{name}: a file must be Unicode text, but has half of a character in {odd!r}"])
    if size > _NODES:
        rule = f"a file must have at most {_NODES} values, those that aliases (*name) stand for included"
        raise ConfigError([f"{name}:1:1: {rule}, but has {'more' if size == _ENDLESS else size}"])
    places: dict[Key, Place] = {}
    doubled: list[tuple[Key, str, bool]] = []
    texts: dict[Key, str] = {}
    for path, place, value_node in _walk(node, ()):
        if path in places:
            line = places[path].key[0]
            message = f"a key must stand once in its mapping, but '{path[-1]}' stands already in line {line}"
            doubled.append((path, message, True))
        places[path] = place
        if isinstance(value_node, ScalarNode) and value_node.style is None:
            texts[path] = value_node.value
    source = SourceMap(name, places, texts=texts)
    return value, source, source.sorted(doubled)


def read_value(text: str, name: str) -> Any:
    """Return the value of a YAML text.

    Raises:
        ConfigError: as `read_yaml`, or a key stands twice in its mapping.
    """
    value, _, doubled = read_yaml(text, name)
    if doubled:
        raise ConfigError(doubled)
    return value


def _half_character(value: Any) -> str:
    """Return a text, key or value, with a lone surrogate (as an escape can write it); "" for none."""
    todo = [value]
    while todo:
        one = todo.pop()
        if isinstance(one, str) and (odd := _SURROGATE.search(one)):
            return one[max(odd.start() - 10, 0) : odd.end() + 10]
        if isinstance(one, dict):
            todo += [*one, *one.values()]
        elif isinstance(one, list):
            todo += one
    return ""


def _size(node: Node | None, known: dict[int, int]) -> int:
    """Return how many values a node stands for, each alias counted in full; endless where it stands within itself."""
    if node is None or isinstance(node, ScalarNode):
        return 1
    if id(node) not in known:
        known[id(node)] = _ENDLESS
        pairs = isinstance(node, MappingNode)
        inner = [each for pair in node.value for each in pair] if pairs else node.value
        known[id(node)] = min(1 + sum(_size(each, known) for each in inner), _ENDLESS)
    return known[id(node)]


def _walk(node: Node | None, path: Key) -> Iterator[tuple[Key, Place, Node]]:
    """Yield the place and value of every key and list entry below a node, and of the node itself if it is the root."""
    if node is None or len(path) > _DEPTH:
        return
    if not path:
        yield (), Place(_mark(node), _mark(node)), node
    entries: list[tuple[str | int, Node, Node]] = []
    if isinstance(node, MappingNode):
        entries = [(_key(key), key, value) for key, value in node.value]
    elif isinstance(node, SequenceNode):
        entries = [(k, item, item) for k, item in enumerate(node.value)]
    for name, key, value in entries:
        yield (*path, name), Place(_mark(key), _mark(value)), value
        yield from _walk(value, (*path, name))


def _key(node: Node) -> str | int:
    """Return a key as paths have it, and pydantic: the text of what is neither text nor a whole number."""
    if node.tag in _TEXT:
        return str(node.value)
    value = yaml_reader().constructor.construct_object(node, deep=True)
    value = tuple(value) if isinstance(value, list) else value
    return value if isinstance(value, str | int) else repr(value)


def _mark(node: Node) -> tuple[int, int]:
    return node.start_mark.line + 1, node.start_mark.column + 1

r"""Configuration files to checked models: every error at once, each with file, line and column.

>>> loaded = parse("campaign: coverage\nscenario: cut_in\nbudget: 40\n")
>>> loaded.config.initial, loaded.config.acquisition.kind
(10, 'even')
>>> parse("campaign: coverage\nscenario: cut_in\nbugdet: 40\n", name="my.yaml")
Traceback (most recent call last):
    ...
sbt.config.source.ConfigError: my.yaml:3:1: bugdet: unknown key (did you mean 'budget'?)
"""

from __future__ import annotations

import io
import json
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

from sbt.campaigns.settings import CampaignKind
from sbt.config.kinds import kind_of, kinds, looked_up_in
from sbt.config.model import Configuration
from sbt.config.source import LARGEST, TOO_LARGE, ConfigError, Key, SourceMap, read_yaml, yaml_reader
from sbt.errors import did_you_mean
from sbt.plugins import Objects, Scope
from sbt.problem.plain import Json, JsonMapping

__all__ = [
    "ConfigError", "Loaded", "checked", "differences", "dump", "fingerprint", "from_mapping", "load", "located", "parse",
    "read_text", "resolve", "resumed", "schema",
]  # fmt: skip

M = TypeVar("M", bound=BaseModel)
_NOT_IDENTITY = ("executor", "store", "budget")
_RULES = {
    "missing": "is required",
    "int_type": "must be a whole number",
    "float_type": "must be a number",
    "string_type": "must be text",
    "bool_type": "must be true or false",
    "bool_parsing": "must be true or false",
    "list_type": "must be a list",
    "tuple_type": "must be a list",
    "dict_type": "must be a mapping (key: value)",
    "model_type": "must be a mapping (key: value)",
    "invalid_key": "keys must be text",
    "invalid-json-value": "must be plain data (quote it, if it is text)",
}
"""How pydantic's kinds of errors read here; of the others its own words are taken."""


@dataclass(frozen=True)
class Loaded:
    """A configuration, where its keys stand, and where its names are looked up."""

    config: Configuration
    source: SourceMap
    scope: Scope

    @property
    def folder(self) -> Path:
        """Where relative `file.py:NAME` start from."""
        return self.scope.folder

    @property
    def kind(self) -> CampaignKind:
        """The kind of campaign that is configured."""
        with looked_up_in(self.scope):
            return kind_of(self.config.campaign)


def load(
    path: str | Path, overrides: Sequence[str] = (), *, changes: JsonMapping | None = None,
    objects: Objects | None = None,
) -> Loaded:  # fmt: skip
    """Read and check a configuration file.

    Args:
        path: a YAML file.
        overrides: `key.path=value` texts that replace or add single values, each value in YAML; `--store=value` as it is.
        changes: keys that replace those of the file, with their values as plain data.
        objects: what was given in Python, by kind and name.

    Raises:
        ConfigError: the file cannot be read, or anything in it breaks a rule; all at once.
    """
    folder = Path(path).resolve().parent
    return parse(read_text(path), overrides, name=str(path), folder=folder, changes=changes, objects=objects)


def read_text(path: str | Path) -> str:
    """Return the text of a configuration file.

    Raises:
        ConfigError: the file cannot be read.
    """
    try:
        with Path(path).open("rb") as file:
            data = file.read(LARGEST + 1)
        if len(data) > LARGEST:
            raise ConfigError([f"{path}: {TOO_LARGE}, but has more"])
        return data.decode("utf-8-sig")
    except IsADirectoryError:
        raise ConfigError([f"{path}: a configuration must be a YAML file, but this is a folder"]) from None
    except OSError as error:
        raise ConfigError([f"{path}: a configuration must be a readable file, but: {error.strerror}"]) from None
    except UnicodeDecodeError as error:
        raise ConfigError([f"{path}: a configuration must be UTF-8 text, but byte {error.start} is not"]) from None


_KIND = re.compile(
    r"\[(key|number|keys)\]|(constrained|function)-.*|(literal|list|dict|tuple|union|nullable)\[.*\]|float|int|str|bool|dict|list"
)
"""What pydantic names in the path of an error beside keys: which of several kinds a value was compared with."""


def located(source: SourceMap, error: ValidationError, kind: type[BaseModel], wrong: Sequence[str] = ()) -> ConfigError:
    """Return what pydantic found as messages with places, after those that are known already.

    Args:
        source: where the keys stand.
        error: of the model's validation.
        kind: the model, whose keys near misses are compared with.
        wrong: messages known already.
    """
    found = [_problem(e, kind, source) for e in error.errors() if e["type"] != "default_factory_not_called"]
    return ConfigError([*wrong, *source.sorted(_joined(found))])


def _joined(found: Sequence[tuple[Key, str, bool]]) -> list[tuple[Key, str, bool]]:
    """Return the problems, with what a value of several kinds may be in one message."""
    joined: dict[tuple[Key, str, bool], str] = {}
    for path, message, at_key in found:
        rule, but, got = message.rpartition(", but got ")
        place = (path, but + got, at_key) if but else (path, message, at_key)
        before = joined.get(place)
        joined[place] = rule if before is None or not but else f"{before} or {rule.removeprefix('must be ')}"
    return [(path, rule + rest, at_key) for (path, rest, at_key), rule in joined.items()]


def parse(
    text: str, overrides: Sequence[str] = (), *, name: str = "<text>", folder: Path | None = None,
    changes: JsonMapping | None = None, objects: Objects | None = None, store: Path | None = None,
    without: Collection[str] = (),
) -> Loaded:  # fmt: skip
    """Check a configuration given as text; like `load`.

    Args:
        text: YAML.
        overrides: as for `load`.
        name: of the file, for messages.
        folder: where relative names are looked up; None: the working directory.
        changes: as for `load`.
        objects: what was given in Python, by kind and name.
        store: folder of the store that it was read from; None: the user gives it, and so approves the code that it names.
        without: keys at the top that are passed over.
    """
    scope = Scope(folder or Path.cwd(), objects or {}, store)
    with looked_up_in(scope):
        config, source = checked(Configuration, text, overrides, name, changes or {}, without)
    return Loaded(config, source, scope)


def from_mapping(data: JsonMapping, *, name: str, scope: Scope) -> Loaded:
    """Check a configuration given as plain data.

    Args:
        data: keys and values as in YAML.
        name: of what gave it, for messages.
        scope: where its names are looked up.

    Raises:
        ConfigError: anything in it breaks a rule; all at once.
    """
    source = SourceMap(name)
    try:
        with looked_up_in(scope):
            return Loaded(Configuration.model_validate(dict(data)), source, scope)
    except ValidationError as error:
        raise located(source, error, Configuration) from None


def checked(
    model: type[M], text: str, overrides: Sequence[str], name: str, changes: JsonMapping | None = None,
    without: Collection[str] = (),
) -> tuple[M, SourceMap]:
    """Return YAML text as a checked model, and where its keys stand.

    Raises:
        ConfigError: anything in it breaks a rule; all at once.
    """
    data, source, doubled = read_yaml(text, name)
    if data is None:
        needed = " and ".join(key for key, field in model.model_fields.items() if field.is_required())
        raise ConfigError([f"{name}:1:1: a configuration needs at least {needed}, but it is empty"])
    if not isinstance(data, dict):
        raise ConfigError([f"{name}:1:1: a configuration must be a mapping (key: value), but got {_shown(data)}"])
    if "campaign" not in data and {"sumo", "simulate"} & set(data):
        rule = "a configuration must name a campaign, but this is a scenario"
        raise ConfigError([f"{name}:1:1: {rule}; run one with scenario: {name}"])
    data, source, wrong = _overridden({**data, **(changes or {})}, source, overrides)
    data, wrong = {key: value for key, value in data.items() if key not in without}, [] if without else doubled + wrong
    try:
        config = model.model_validate(data)
    except ValidationError as error:
        wrong = list(located(source, error, model, wrong).errors)
    if wrong:
        raise ConfigError(wrong)
    return config, source


def resolve(config: Configuration) -> Json:
    """Return the configuration as plain data, every default filled in."""
    return config.model_dump(mode="json", by_alias=True)


def dump(config: Configuration) -> str:
    """Return the resolved configuration as YAML; `parse` reads back an equal one."""
    stream = io.StringIO()
    yaml_reader().dump(resolve(config), stream)
    return stream.getvalue()


def fingerprint(config: Configuration) -> Json:
    """Return what must stay the same when a campaign is resumed: all but executor, store and budget.

    Plain JSON data: infinite numbers are the texts "inf" and "-inf".
    """
    return {key: _jsonable(value) for key, value in resolve(config).items() if key not in _NOT_IDENTITY}


def differences(before: JsonMapping, now: JsonMapping, keys: Collection[str]) -> str:
    """Return in words where two fingerprints differ in these keys; "" where they agree.

    An unset key (None) and a missing one are the same, so that a later version may have more keys.

    >>> differences({"seed": 1, "ego": {"kind": "idm"}}, {"seed": 2, "ego": {"kind": "idm", "tau": None}}, ["seed", "ego"])
    'seed: 1 there, 2 now'
    """
    changed = sorted(key for key in keys if _stated(before.get(key)) != _stated(now.get(key)))
    return "; ".join(f"{key}: {before.get(key)} there, {now.get(key)} now" for key in changed)


def _stated(value: Any) -> Any:
    return {k: _stated(v) for k, v in value.items() if v is not None} if isinstance(value, Mapping) else value


def resumed(config: Configuration, stored: JsonMapping, ran: int = 0) -> Configuration:
    """Return the configuration with `initial` and `batch` as stored, where the user does not state them.

    Their defaults follow the budget, which may grow when a campaign is resumed; they must not. It does not shrink below what
    was run of it.
    """
    kept = {key: stored[key] for key in ("initial", "batch") if key not in config.model_fields_set and key in stored}
    budget = max(config.budget, min(stored.get("budget", 0), ran))
    return config.model_copy(update={**kept, "budget": budget})


def schema() -> Json:
    """Return the JSON schema of configurations, with what the installed campaigns declare."""
    found = {k: v for k, v in Configuration.model_json_schema().items() if k != "title"}
    campaigns, keys = kinds(), found["properties"]
    keys["campaign"]["examples"] = list(campaigns)
    described = (f"{n}: {kind.description}" for n, kind in campaigns.items())
    keys["campaign"]["description"] += " Installed: " + "; ".join(described) + "."
    learns = (f"{n}: {_flow(kind.metamodel) if kind.adaptive else 'none'}" for n, kind in campaigns.items())
    keys["metamodel"]["description"] += " Defaults: " + "; ".join(learns) + "."
    chooses = (f"{n}: {kind.acquisition} ({', '.join(kind.methods) or 'no methods'})" for n, kind in campaigns.items())
    keys["acquisition"]["description"] += " Defaults, and the methods of each: " + "; ".join(chooses) + "."
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "sumo-sbt campaign", **found}


def _overridden(data: Json, source: SourceMap, overrides: Sequence[str]) -> tuple[Json, SourceMap, list[str]]:
    """Return the data with the overrides in it, the source that knows them, and what is wrong with them."""
    wrong: list[str] = []
    given = dict(source.overrides)
    for text in overrides:
        dotted, equals, written = text.partition("=")
        path, own = tuple(dotted.removeprefix("--").strip().split(".")), dotted.startswith("--")
        if not equals or not all(path):
            wrong.append(f"--set {text}: must be key.path=value, but got '{text}'")
            continue
        try:
            value, _, doubled = (written, None, []) if own else read_yaml(written, f"--set {dotted}")
        except ConfigError as error:
            reason = error.errors[0].partition(", but ")[2]
            wrong.append(f"--set {dotted}: the value must be YAML, but got '{written}' ({reason})")
            continue
        wrong += doubled
        try:
            data = _with(data, path, value)
        except TypeError as error:
            wrong.append(f"--set {dotted}: {error}")
            continue
        given[path] = dotted if own else f"--set {'.'.join(path)}"
    return data, replace(source, overrides=given), wrong


def _with(data: Any, path: tuple[str, ...], value: Any) -> Json:
    """Return a copy of nested mappings with one value replaced or added; null counts as an empty mapping."""
    if data is not None and not isinstance(data, dict):
        raise TypeError(f"--set reaches into mappings only, but '{path[0]}' would be inside {_shown(data)}")
    head, rest = path[0], path[1:]
    inner = (data or {}).get(head)
    return {**(data or {}), head: _with(inner, rest, value) if rest else value}


def _problem(error: Any, model: type[BaseModel], source: SourceMap) -> tuple[Key, str, bool]:
    """Return path, message and whether the key is at fault, of one of pydantic's errors."""
    path: Key = ()
    for part in error["loc"]:
        if not _KIND.fullmatch(str(part)) or (*path, part) in source.places:  # a kind of value is no key
            path = (*path, part)
    kind = error["type"]
    if kind == "extra_forbidden":
        return path, _unknown_key(path, model), True
    if kind == "missing":
        return path, _RULES[kind], True
    if kind == "value_error":  # a rule of ours: the message has the value already, or names it
        return path, str(error["ctx"]["error"]), False
    if kind == "too_long":
        return path, f"must have at most {error['ctx']['max_length']} entries, but got {len(error['input'])}", False
    if kind == "too_short":
        return path, f"must have at least {error['ctx']['min_length']} right entries", False
    rule = _RULES.get(kind, error["msg"].replace("Input should be", "must be"))
    return path, f"{rule}, but got {_shown(error['input'])}", kind == "invalid_key"


def _unknown_key(path: Key, model: type[BaseModel]) -> str:
    known = _keys_at(path[:-1], model)
    return "unknown key" + (did_you_mean(str(path[-1]), known) or f"; the keys here are {', '.join(known)}")


def _keys_at(path: Key, model: type[BaseModel]) -> list[str]:
    """Return the keys of the model at a path."""
    kind: Any = model
    for part in path:
        kind = _inner(kind.model_fields[part].annotation) if _is_model(kind) else _inner(get_args(kind)[-1])
        if get_origin(kind) is tuple:
            kind = list[get_args(kind)[0]]  # type: ignore[misc]
    return list(kind.model_fields) if _is_model(kind) else []


def _is_model(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _inner(kind: Any) -> Any:
    """Return a type without `| None` and without annotations."""
    while get_origin(kind) in (Annotated, Union, UnionType):
        kind = next(k for k in get_args(kind) if k is not type(None))
    return kind


def _flow(settings: JsonMapping) -> str:
    """Return settings as YAML on one line."""
    return "{" + ", ".join(f"{key}: {json.dumps(value)}" for key, value in settings.items()).replace('"', "") + "}"


def _shown(value: Any) -> str:
    """Return a value as the user wrote it, about, and short."""
    text = {None: "null", True: "true", False: "false"}[value] if value is None or isinstance(value, bool) else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _jsonable(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _jsonable(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_jsonable(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value

"""The scenario's parameter space with the configured inputs, correlation, constraints and features."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sbt.config.model import Choice, Configuration, CorrelationEntry, InputChange
from sbt.config.source import Key, Problems, must_be_one_of
from sbt.errors import InputError
from sbt.problem.distribution import Distribution
from sbt.problem.expression import Expression
from sbt.problem.parameter import Parameter
from sbt.problem.space import ParameterSpace

__all__ = ["SpaceChanges", "configured_space", "distribution_of"]


@dataclass(frozen=True)
class SpaceChanges:
    """The part of a configuration that changes a parameter space."""

    inputs: Mapping[str, InputChange]
    correlation: tuple[CorrelationEntry, ...] = ()
    constraints: tuple[str, ...] = ()
    features: Mapping[str, str] = field(default_factory=dict)


def configured_space(
    config: Configuration | SpaceChanges, space: ParameterSpace, problems: Problems, folder: Path | None = None
) -> ParameterSpace:
    """Return the space with the configured changes; what is wrong with them is added to `problems`."""
    changed = {p.name: p for p in space.parameters}
    for name, change in config.inputs.items():
        if name not in changed:
            problems.add(("inputs", name), must_be_one_of("an input", name, space.names), at_key=True)
        else:
            changed[name] = _parameter(changed[name], change, problems, folder or Path())
    before = len(problems.found)
    correlation = _correlation(config.correlation, space, problems)
    constraints = _expressions("constraints", dict(enumerate(config.constraints)), space, problems)
    features = dict(space.features) | dict(_expressions("features", config.features, space, problems))
    if len(problems.found) > before:
        return space
    steps: tuple[tuple[str, Mapping[str, Any]], ...] = (
        ("inputs", {"parameters": tuple(changed.values())}),
        ("correlation", {"correlation": correlation}),
        ("constraints", {"constraints": (*space.constraints, *((f.text, f) for _, f in constraints))}),
        ("features", {"features": tuple(features.items())}),
    )
    for key, step in steps:
        space = problems.attempt((key,), partial(_changed, space, step)) or space
    return space


def _changed(space: ParameterSpace, step: Mapping[str, Any]) -> ParameterSpace:
    """Return the space with one change, after what it would otherwise check only when it is used."""
    with np.errstate(all="ignore"):  # a formula that is not finite is reported, not warned of
        space = replace(space, **step)
        if space.constraints:
            space.feasible_mass  # noqa: B018  (raises where the distributions give the constraints no mass)
        space.metamodel_inputs(np.full((1, space.dimension), 0.5))
    return space


def _parameter(old: Parameter, change: InputChange, problems: Problems, folder: Path) -> Parameter:
    """Return the input with another range or distribution, or fewer or otherwise likely choices."""
    path: Key = ("inputs", old.name)
    if old.choices or change.choices is not None:
        return problems.attempt(path, lambda: _with_choices(old, change)) or old
    distribution = old.distribution
    if change.distribution is not None:
        wanted = change.distribution
        distribution = problems.attempt((*path, "distribution"), lambda: distribution_of(wanted, folder))
        if distribution is None:
            return old
    low = old.low if change.min is None else change.min
    high = old.high if change.max is None else change.max
    return problems.attempt(path, lambda: replace(old, low=low, high=high, distribution=distribution)) or old


def _with_choices(old: Parameter, change: InputChange) -> Parameter:
    """Return the input with the configured ones of its choices.

    Raises:
        InputError: it has no choices, they are not among its own, or a range or distribution is given.
    """
    given: Any = change.choices
    surplus = [key for key in ("min", "max", "distribution") if getattr(change, key) is not None]
    if not old.choices:
        raise InputError(f"input {old.name} has the range {old.range}, but got choices")
    if surplus:
        raise InputError(f"input {old.name} has choices ({', '.join(old.choices)}), but got {', '.join(surplus)}")
    if given is None:
        return old
    made = Parameter(old.name, unit=old.unit, description=old.description, kind="categorical", choices=given)
    for choice in made.choices:
        old.number(choice)
    return made


def distribution_of(choice: Choice, folder: Path | None = None) -> Distribution:
    """Return the distribution that a configuration describes; a recorded sample's file is relative to the folder.

    Raises:
        InputError: there is no such distribution, or not with these parameters.
    """
    given = choice.settings
    if choice.kind == "empirical" and isinstance(given.get("file"), str):
        try:
            given["file"] = str(((folder or Path.cwd()) / Path(str(given["file"])).expanduser()).resolve())
        except (ValueError, OSError, RuntimeError) as error:
            raise InputError(f"distribution 'empirical' needs a file, but got {given['file']!r}: {error}") from None
    for name, value in given.items():
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            raise InputError(f"a distribution's parameters must be numbers, but got {name}: {value!r}")
    try:
        return Distribution.of(choice.kind, **given)
    except TypeError as error:
        raise InputError(f"distribution '{choice.kind}' cannot have the parameters {choice.settings}: {error}") from None


def _correlation(
    entries: tuple[CorrelationEntry, ...], space: ParameterSpace, problems: Problems
) -> tuple[tuple[float, ...], ...] | None:
    """Return the scenario's matrix with the configured pairs in it."""
    if not entries:
        return space.correlation
    matrix = np.eye(space.dimension) if space.correlation is None else np.array(space.correlation)
    seen: set[frozenset[str]] = set()
    for k, entry in enumerate(entries):
        path: Key = ("correlation", k, "inputs")
        unknown = [name for name in entry.inputs if name not in space.names]
        for name in unknown:
            problems.add(path, must_be_one_of("an input", name, space.names))
        pair = frozenset(entry.inputs)
        if len(pair) < 2 or pair in seen:
            problems.add(path, f"a correlation needs two inputs, each pair once, but got {', '.join(entry.inputs)}")
        elif not unknown:
            a, b = (space.names.index(name) for name in entry.inputs)
            matrix[a, b] = matrix[b, a] = entry.value
        seen.add(pair)
    return tuple(tuple(float(value) for value in row) for row in matrix)


def _expressions(key: str, texts: Mapping[Any, str], space: ParameterSpace, problems: Problems) -> list[tuple[Any, Expression]]:
    """Return the formulas by key, after a check that they use inputs only."""
    with np.errstate(all="ignore"):
        found = [(name, Expression(text)) for name, text in texts.items()]
    for name, rule in found:
        for used in rule.names():
            if used not in space.names:
                problems.add((key, name), must_be_one_of("a formula's name", used, space.names))
        problems.attempt((key, name), partial(space.check_formula, rule))
        if name in space.names:
            problems.add((key, name), f"a feature must not have the name of an input, but got '{name}'", at_key=True)
    return found

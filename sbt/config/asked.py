"""What an estimation is asked again with: other distributions of its inputs, in the words of a configuration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sbt.config.load import ConfigError, located, read_text
from sbt.config.model import Condition, CorrelationEntry, InputChange
from sbt.config.requirement_model import MOST
from sbt.config.source import Problems, SourceMap, must_be_one_of, read_yaml
from sbt.config.space import SpaceChanges, configured_space
from sbt.errors import did_you_mean
from sbt.problem.plain import JsonMapping
from sbt.problem.space import ParameterSpace

__all__ = ["Asked", "asked_space"]


class Asked(BaseModel):
    """The part of a configuration that decides how the inputs are distributed."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    inputs: dict[str, InputChange] = Field(default={}, description="Changes to the campaign's inputs, by name.")
    correlation: Annotated[tuple[CorrelationEntry, ...], Field(strict=False, max_length=1000)] = ()
    constraints: Annotated[tuple[Condition, ...], Field(strict=False, max_length=MOST)] = ()


def asked_space(inputs: Path | JsonMapping, space: ParameterSpace) -> ParameterSpace:
    """Return the space of a campaign with other distributions.

    Args:
        inputs: changes to inputs by name, or a YAML file with them: under `inputs`, beside `correlation` and `constraints`, or
            alone.
        space: of the campaign.

    Raises:
        ConfigError: anything in it breaks a rule; all at once.
    """
    if not isinstance(inputs, Path):
        return _space({"inputs": dict(inputs)}, SourceMap("estimate"), [], space, Path.cwd())
    data, source, wrong = read_yaml(read_text(inputs), str(inputs))
    if not isinstance(data, dict):
        raise ConfigError([f"{inputs}:1:1: must be a mapping such as inputs: {{speed: {{distribution: ...}}}}"])
    fields, known = Asked.model_fields, any(name in data for name in space.names)
    if not set(data) & set(fields) and (known or not any(did_you_mean(str(key), fields) for key in data)):
        data = {"inputs": data}
        source = replace(source, places={("inputs", *key): place for key, place in source.places.items()})
    return _space(data, source, wrong, space, inputs.resolve().parent)


def _space(data: Mapping[Any, Any], source: SourceMap, wrong: list[str], space: ParameterSpace, folder: Path) -> ParameterSpace:
    try:
        asked = Asked.model_validate(data)
    except ValidationError as error:
        raise located(source, error, Asked, wrong) from None
    if wrong:
        raise ConfigError(wrong)
    problems = Problems(source)
    for name in asked.inputs:
        if name not in space.names:
            rule = must_be_one_of("an input", name, space.names)
            problems.add(("inputs", name), f"{rule}; what was constant in all runs has no distribution", at_key=True)
    problems.check()
    changed = configured_space(SpaceChanges(asked.inputs, asked.correlation, asked.constraints), space, problems, folder)
    problems.check()
    return changed

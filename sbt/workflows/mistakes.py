"""What only the scenario can tell to be wrong with a configuration, beside what is wrong with its keys."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from sbt.config.assemble import check
from sbt.config.load import parse, read_text
from sbt.config.source import ConfigError
from sbt.errors import SbtError

__all__ = ["further_mistakes"]

_AT_KEY = re.compile(r"(?:--set |.*?:\d+:\d+: )(?P<key>\w+)")
"""The key at the top that an error of a configuration is about."""


def further_mistakes(path: Path, overrides: Sequence[str], error: ConfigError) -> list[str]:
    """Return what only the scenario can tell to be wrong with a configuration, beside what is wrong with its keys."""
    keys = {found["key"] for found in map(_AT_KEY.match, error.errors) if found}
    if not keys or keys & {"campaign", "scenario"}:
        return []
    try:
        check(parse(read_text(path), overrides, name=str(path), folder=path.resolve().parent, without=keys))
    except ConfigError as more:
        return [line for line in more.errors if line not in error.errors]
    except SbtError:
        return []
    return []

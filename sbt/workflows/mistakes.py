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

_AT_KEY = re.compile(r"(?:--(?:set )?|.*?:\d+:\d+: )(?P<key>\w+)")
"""The key at the top that an error of a configuration is about."""
_ANY, _OF_ANY = "falsification", (
    "scenario", "metamodel", "inputs", "correlation", "constraints", "features", "metrics", "requirement", "ego",
)  # fmt: skip
"""A campaign in place of one that is not there, and what means the same in any."""


def further_mistakes(path: Path, overrides: Sequence[str], error: ConfigError) -> list[str]:
    """Return what only the scenario can tell to be wrong with a configuration, beside what is wrong with its keys."""
    wrong = _keys(error)
    if not wrong or "scenario" in wrong:
        return []
    of = _OF_ANY if "campaign" in wrong else None
    given = [*overrides, f"campaign={_ANY}"] if of else overrides
    known = wrong - {"campaign"}
    while True:
        try:
            loaded = parse(read_text(path), given, name=str(path), folder=path.resolve().parent, without=known)
        except ConfigError as more:  # what is compared with the default of a wrong key: nobody wrote that
            if _keys(more) <= known:
                return []
            known |= _keys(more)
            continue
        except SbtError:
            return []
        break
    try:
        check(loaded)
    except ConfigError as more:
        found = [(line, _AT_KEY.match(line)) for line in more.errors if line not in error.errors]
        return [line for line, at in found if of is None or (at and at["key"] in of)]
    except SbtError:
        pass
    return []


def _keys(error: ConfigError) -> set[str]:
    return {found["key"] for found in map(_AT_KEY.match, error.errors) if found}

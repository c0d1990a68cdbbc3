"""Plain data: what JSON and YAML hold, and what therefore has no type of its own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sbt.errors import InputError

__all__ = ["Json", "JsonMapping", "Value", "Values", "check_table", "unit_of", "written"]

Json = dict[str, Any]
"""A JSON object."""
JsonMapping = Mapping[str, Any]
"""A JSON object that is only read."""
Value = float | str
"""What an input has: a number, or one of its choices as text."""
LARGEST_TABLE = 2**28
"""Most bytes of a table that is read whole."""
Values = Mapping[str, Any]
"""The inputs of a run by name, each a `Value`; whoever reads one knows which of the two it is."""


def written(values: Values) -> str:
    """Return the inputs of a run on one line, for people.

    >>> written({"v": 12.50, "kind": "truck"})
    'v=12.5, kind=truck'
    """
    return ", ".join(f"{name}={value if isinstance(value, str) else format(value, 'g')}" for name, value in values.items())


def check_table(path: Path) -> None:
    """Refuse what is read whole, and is no file (a device such as /dev/zero never ends) or a very large one.

    Raises:
        InputError: it is none of this.
    """
    try:
        size = path.stat().st_size if path.is_file() else -1
    except (OSError, ValueError) as error:
        raise InputError(f"a table must be a readable file, but '{path}' is not: {error}") from None
    if path.exists() and not 0 <= size <= LARGEST_TABLE:
        rule = f"a table must be a file of at most {LARGEST_TABLE // 2**20} MiB"
        raise InputError(f"{rule}, but '{path}' " + ("is none" if size < 0 else f"has {size // 2**20} MiB"))


def unit_of(units: Mapping[str, str], metric: str, default: str = "") -> str:
    """Return the unit of a metric among those of inputs and metrics by name, where an input may have its name.

    >>> unit_of({"gap": "m", "y.gap": "s", "ttc": "s"}, "gap")
    's'
    """
    return units.get(f"y.{metric}", units.get(metric, default))

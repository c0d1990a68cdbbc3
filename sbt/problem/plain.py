"""Plain data: what JSON and YAML hold, and what therefore has no type of its own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

__all__ = ["Json", "JsonMapping", "Value", "Values", "written"]

Json = dict[str, Any]
"""A JSON object."""
JsonMapping = Mapping[str, Any]
"""A JSON object that is only read."""
Value = float | str
"""What an input has: a number, or one of its choices as text."""
Values = Mapping[str, Any]
"""The inputs of a run by name, each a `Value`; whoever reads one knows which of the two it is."""


def written(values: Values) -> str:
    """Return the inputs of a run on one line, for people.

    >>> written({"v": 12.50, "kind": "truck"})
    'v=12.5, kind=truck'
    """
    return ", ".join(f"{name}={value if isinstance(value, str) else format(value, 'g')}" for name, value in values.items())

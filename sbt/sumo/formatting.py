"""Numbers on their way to SUMO: plain Python numbers for its API, decimal text for its XML files and options.

libsumo takes Python's int and float only, and SUMO's parsers take decimal text only. NumPy scalars
satisfy neither: libsumo refuses `np.float32(3)`, and `repr(np.float64(3))` is `np.float64(3.0)`.
"""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Integral
from typing import Any, SupportsFloat

import numpy as np

__all__ = ["format_number", "plain", "plain_values"]


def plain(value: Any) -> Any:
    """Return the Python number that a NumPy scalar stands for; any other value unchanged.

    >>> plain(np.float32(0.5)), plain(np.int64(3)), plain("max")
    (0.5, 3, 'max')
    """
    return value.item() if isinstance(value, np.generic) else value


def plain_values(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the inputs of a run with every number as a Python float; text is left as it is."""
    return {name: value if isinstance(value, str) else float(value) for name, value in values.items()}


def format_number(value: SupportsFloat) -> str:
    """Return the shortest text from which SUMO reads the same double; integers without a decimal point.

    >>> format_number(0.1), format_number(np.float64(0.1)), format_number(np.int64(2)), format_number(2.0)
    ('0.1', '0.1', '2', '2.0')
    """
    return repr(float(value)) if isinstance(value, float) or not isinstance(value, Integral) else str(int(value))

"""Inputs whose values leap where their distribution has next to no mass: between the modes of a sample, say."""

from __future__ import annotations

import numpy as np

from sbt.problem.arrays import Vector
from sbt.problem.parameter import Parameter

__all__ = ["leaping"]

_SCORES = np.linspace(-5.0, 5.0, 2001)
_LEAP = 20
"""Steps of the scores, .1 in all, in which a leap happens."""
_FAR, _SHARE, _TIMES = 3.0, 0.25, 4.0
"""Least leap: of the way between the normal scores -3 and 3, where it must be, and over what lies on either side of it."""
_VALUES = 2000


def leaping(parameter: Parameter) -> tuple[Vector, Vector] | None:
    """Return normal scores (m,) and the values in [0, 1] there (m,) of an input whose values leap; None where they do not.

    What is smooth in such a value is a cliff in its normal score.

    >>> from sbt.problem.distribution import Normal
    >>> leaping(Parameter("speed", 0.0, 50.0, "m/s", Normal(20.0, 5.0))) is None
    True
    """
    if parameter.truncated is None or parameter.discrete:
        return None
    x = parameter.from_normal(_SCORES)
    low, high = np.interp([-_FAR, _FAR], _SCORES, x)
    way = x[_LEAP:] - x[:-_LEAP]
    beside = np.maximum(way[: -2 * _LEAP], way[2 * _LEAP :])
    here = way[_LEAP:-_LEAP]
    within = np.abs(_SCORES[_LEAP : _LEAP + len(here)]) < _FAR
    if not ((here > _SHARE * (high - low)) & (here > _TIMES * beside) & within).any():
        return None
    between = np.linspace(x[0], x[-1], _VALUES)  # where scores tell little
    z = parameter.to_normal(between)
    scores, values = np.concatenate([_SCORES, z]), np.concatenate([x, between])
    order = np.argsort(scores, kind="stable")
    return scores[order], parameter.to_unit(np.maximum.accumulate(values[order]))

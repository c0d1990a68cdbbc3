"""Inputs whose distribution lies in a small part of their range, over which a guided search spreads all the same."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sbt.campaigns.wording import percent
from sbt.problem.parameter import Parameter
from sbt.problem.space import ParameterSpace

__all__ = ["crowded_inputs", "crowded_words"]

_CROWDED = 0.02  # of a range, that holds half of the distribution
_STEPS = 51


def crowded_inputs(space: ParameterSpace) -> dict[str, float] | None:
    """Return the share of the range that holds half of the distribution, of inputs where it is below 2 %; None: of none."""
    shares = {parameter.name: _half(parameter) for parameter in space.parameters if not parameter.discrete}
    return {name: share for name, share in shares.items() if share < _CROWDED} or None


def _half(parameter: Parameter) -> float:
    """Return the share of its range, as it is searched, of the shortest interval with half of an input's distribution."""
    if parameter.truncated is None:
        return 0.5
    low, high = parameter.bounds
    begin = np.linspace(0.0, 0.5, _STEPS)
    x = np.clip([parameter.truncated.ppf(begin), parameter.truncated.ppf(begin + 0.5)], low, high)
    u = parameter.to_unit(x)
    return float((u[1] - u[0]).min())


def crowded_words(shares: Mapping[str, float] | None) -> list[str]:
    r"""Return in words where distributions lie, and what to do; nothing where none is crowded.

    >>> crowded_words({"a": 0.001})[0].replace("\N{NO-BREAK SPACE}", " ")[:81]
    'Half of the distribution of a lies in 0.1 % of its range, but the search spreads '
    """
    if shares is None:
        return []
    first, *others = [f"of {name} lies in {percent(share)} of its range" for name, share in shares.items()]
    told = "; ".join([f"Half of the distribution {first}", *(f"half of that {each}" for each in others)])
    spreads = "the search spreads over ranges evenly, and hardly looks there"
    return [f"{told}, but {spreads}: narrow the ranges."]

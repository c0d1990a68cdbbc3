"""Analytic problems with known truth, as logical scenarios: `testbed:NAME`.

They serve to assess campaigns against exact or precise reference values. `testbed:NAME:box` is the same problem
with all inputs uniform in a box, for searches that do not use the distribution. `testbed:NAME:coarse` is a coarse level of
fidelity of a noisy problem.

>>> scenario = from_name("four_branch_7", Path())
>>> scenario.space.names, scenario.requirement.critical.high
(('x1', 'x2'), 0.0)
>>> float(values("four_branch_7", np.zeros((1, 2)))[0]), truth("four_branch_7").modes
(3.0, 4)
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sbt.errors import InputError, did_you_mean
from sbt.problem.arrays import Points, Vector, as_points, as_vector
from sbt.problem.scenario import LogicalScenario
from sbt.testbeds import failing, heavy, many_inputs, reliability, search, stochastic, thin, traffic
from sbt.testbeds.problem import Problem, Truth, analytic, noisy

__all__ = ["Problem", "Truth", "analytic", "find", "from_name", "names", "truth", "values"]

_ROOMS = (reliability, traffic, search, failing, many_inputs, stochastic, thin, heavy)
_PROBLEMS = {p.name: p for room in _ROOMS for p in room.PROBLEMS}
_BOX, _COARSE = ":box", ":coarse"


def names() -> list[str]:
    """Return the names of all testbeds; each of them also exists with the suffix `:box`."""
    return list(_PROBLEMS)


def find(name: str) -> Problem:
    """Return a testbed by name; `NAME:box` has all inputs uniform in their box.

    Raises:
        InputError: there is no testbed of this name.
    """
    plain = name.removesuffix(_BOX)
    if plain not in _PROBLEMS:
        hint = did_you_mean(plain, _PROBLEMS)
        raise InputError(f"a testbed must be one of {', '.join(_PROBLEMS)}, or one of them with {_BOX}, but got '{name}'{hint}")
    found = _PROBLEMS[plain]
    return found.in_box() if name.endswith(_BOX) else found


def from_name(name: str, folder: Path) -> LogicalScenario:
    """Return the logical scenario `testbed:NAME`; its only metric is `y`.

    Raises:
        InputError: there is no testbed of this name.
    """
    return find(name.removesuffix(_COARSE)).coarse().scenario() if name.endswith(_COARSE) else find(name).scenario()


def truth(name: str) -> Truth:
    """Return the reference values of a testbed: failure probability, modes, critical fraction of the box.

    Raises:
        InputError: there is no testbed of this name.
    """
    return find(name).truth


def values(name: str, x: Points, rng: np.random.Generator | None = None) -> Vector:
    """Return the metric at n points.

    Args:
        name: of the testbed.
        x: (n, d) physical values.
        rng: draws the noise of a noisy testbed; None: without noise.

    Returns:
        (n,) metrics.

    Raises:
        InputError: there is no testbed of this name.
        ValueError: x is not (n, d) or not finite.
    """
    found = find(name)
    x = as_points(x, len(found.parameters))
    return noisy(as_vector(found.function(x), len(x)), x, found.noise, rng)

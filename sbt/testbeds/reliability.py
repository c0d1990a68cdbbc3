"""Problems of structural reliability: failure where a limit-state function is <= 0 (borehole: a flow >= 190)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial

import numpy as np
from scipy.special import gammaincc, ndtr

from sbt.problem.arrays import Points, Vector
from sbt.problem.distribution import Distribution
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import CriticalInterval
from sbt.testbeds.problem import NEGATIVE, Input, Problem, Truth, lognormal, normal, parameters_of

__all__ = ["PROBLEMS"]


def _standard(d: int) -> tuple[Parameter, ...]:
    """Return d independent standard-normal inputs x1 ... xd."""
    return parameters_of({f"x{k + 1}": normal(0.0, 1.0) for k in range(d)})


def four_branch(x: Points, k: float) -> Vector:
    """A series system of two parabolas and two lines: min of four limit states.

    3 + (x1 - x2)^2 / 10 -+ (x1 + x2) / sqrt(2) and +-(x1 - x2) + k / sqrt(2).

    Source:
        Waarts (2000), Structural reliability using finite element methods; with k = 6 and 7 the first
        example of Echard, Gayton, Lemaire (2011), AK-MCS, Structural Safety 33.
    """
    across, along = x[:, 0] - x[:, 1], x[:, 0] + x[:, 1]
    parabolas = 3.0 + 0.1 * across**2 - np.abs(along) / math.sqrt(2.0)
    lines = k / math.sqrt(2.0) - np.abs(across)
    return np.minimum(parabolas, lines)


def rastrigin(x: Points) -> Vector:
    """A modified Rastrigin function, 10 - sum(x^2 - 5 cos(2 pi x)): many islands of failure.

    Source:
        Echard, Gayton, Lemaire (2011), AK-MCS, Structural Safety 33, example 2.
    """
    return 10.0 - (x**2 - 5.0 * np.cos(2.0 * np.pi * x)).sum(axis=1)


def gayton_hat(x: Points) -> Vector:
    """A cubic, (x1 - 2)^2 / 2 - 3 (x2 - 5)^3 / 2 - 3: one smooth rare failure.

    Source:
        Echard, Gayton, Lemaire, Relun (2013), AK-IS, Reliability Engineering and System Safety 111.
    """
    return 0.5 * (x[:, 0] - 2.0) ** 2 - 1.5 * (x[:, 1] - 5.0) ** 3 - 3.0


def metaball(x: Points) -> Vector:
    """Two merged hills; the steepest descent from the origin does not lead to the most likely failure.

    30 / (a^2 + 1) + 20 / (b^2 + 1) - 5 with a = 4 (x1 + 2)^2 / 9 + x2^2 / 25 and
    b = (x1 - 2.5)^2 / 4 + (x2 - 0.5)^2 / 25.

    Source:
        Breitung (2019), The geometry of limit state function graphs and subset simulation, Reliability
        Engineering and System Safety 182.
    """
    first, second = x.T
    a = 4.0 * (first + 2.0) ** 2 / 9.0 + second**2 / 25.0
    b = (first - 2.5) ** 2 / 4.0 + (second - 0.5) ** 2 / 25.0
    return 30.0 / (a**2 + 1.0) + 20.0 / (b**2 + 1.0) - 5.0


def rp38(x: Points) -> Vector:
    """Seven normal inputs of very different scale and influence.

    Source:
        TNO black-box reliability challenge (2019), problem RP38, Rozsas and Slobbe, rprepo.
    """
    x1, x2, x3, x4, x5, x6, x7 = x.T
    numerator = x4**2 - 4.0 * x5 * x6 * x7**2 + x4 * (x6 + 4.0 * x5 + 2.0 * x6 * x7)
    denominator = x4 * x5 * (x4 + x6 + 2.0 * x6 * x7)
    return 15.59e4 - x1 * x2**3 / (2.0 * x3**3) * numerator / denominator


def rp110(x: Points) -> Vector:
    """Two kinked branches: the values lead towards x2 > 5, but nearly all failures have x1 > 4.

    min of (0.85 - x1 / 10 up to x1 = 3.5, then 4 - x1) and (2.3 - x2 up to x2 = 2, then 0.5 - x2 / 10).

    Source:
        TNO black-box reliability challenge (2019), problem RP110, after Breitung (2019).
    """
    first = np.where(x[:, 0] <= 3.5, 0.85 - 0.1 * x[:, 0], 4.0 - x[:, 0])
    second = np.where(x[:, 1] <= 2.0, 2.3 - x[:, 1], 0.5 - 0.1 * x[:, 1])
    return np.minimum(first, second)


def oscillator(x: Points) -> Vector:
    """Displacement of an undamped oscillator with two springs under a rectangular pulse, below 3 r.

    3 r - |2 f1 / (m w^2) sin(w t1 / 2)| with w^2 = (c1 + c2) / m.

    Source:
        Bucher and Bourgund (1990), Structural Safety 7; Echard et al. (2011), AK-MCS, example 3.
    """
    c1, c2, m, r, t1, f1 = x.T
    stiffness = c1 + c2
    return 3.0 * r - np.abs(2.0 * f1 / stiffness * np.sin(0.5 * t1 * np.sqrt(stiffness / m)))


def damped_oscillator(x: Points) -> Vector:
    """Force in the secondary spring of a two-mass oscillator under white noise, below its capacity fs.

    fs - 3 ks sqrt(E[xs^2]), the mean square by the closed form for stationary response.

    Source:
        Der Kiureghian and De Stefano (1990), an efficient algorithm for second-order reliability
        analysis; Dubourg, Sudret, Deheeger (2013), Meta-IS, Probabilistic Engineering Mechanics 33.
    """
    mp, ms, kp, ks, zp, zs, s0, fs = x.T
    wp, ws = np.sqrt(kp / mp), np.sqrt(ks / ms)  # natural frequencies
    w, z = (wp + ws) / 2.0, (zp + zs) / 2.0
    ratio, tuning = ms / mp, (wp - ws) / w
    coupling = z * zs / (zp * zs * (4.0 * z**2 + tuning**2) + ratio * z**2)
    mean_square = np.pi * s0 / (4.0 * zs * ws**3) * coupling * (zp * wp**3 + zs * ws**3) * wp / (4.0 * z * w**4)
    return fs - 3.0 * ks * np.sqrt(mean_square)


def borehole(x: Points) -> Vector:
    """Flow of water through a borehole between two aquifers (m^3/yr).

    2 pi tu (hu - hl) / (log(r / rw) (1 + 2 l tu / (log(r / rw) rw^2 kw) + tu / tl)); a radius below
    1e-9 m, which the normal distribution of rw allows with probability 3e-10, counts as 1e-9 m.

    Source:
        Harper and Gupta (1983), report BMI/ONWI-516; Morris, Mitchell, Ylvisaker (1993), Technometrics
        35. The threshold of 190 is a choice of this package.
    """
    rw, r, tu, hu, tl, hl, length, kw = x.T
    rw = np.maximum(rw, 1e-9)
    log_ratio = np.log(r / rw)
    return 2.0 * np.pi * tu * (hu - hl) / (log_ratio * (1.0 + tu / tl) + 2.0 * length * tu / (rw**2 * kw))


def linear(x: Points, beta: float) -> Vector:
    """A hyperplane at distance beta from the origin: beta - sum(x) / sqrt(d), P = Phi(-beta) for every d.

    Source:
        Exact; among many, Au and Beck (2001), Probabilistic Engineering Mechanics 16.
    """
    return beta - x.sum(axis=1) / math.sqrt(x.shape[1])


def sphere(x: Points, radius: float) -> Vector:
    """The outside of a sphere, radius^2 - |x|^2: no most likely point at all.

    Source:
        Exact: P is the upper tail of the chi-square distribution with d degrees of freedom.
    """
    return radius**2 - (x**2).sum(axis=1)


_OSCILLATOR: Mapping[str, Input] = {
    "c1": normal(1.0, 0.1), "c2": normal(0.1, 0.01), "m": normal(1.0, 0.05), "r": normal(0.5, 0.05),
    "t1": normal(1.0, 0.2), "f1": normal(1.0, 0.2),
}  # fmt: skip
_DAMPED: Mapping[str, Input] = {
    "mp": lognormal(1.5, 0.15), "ms": lognormal(0.01, 0.001), "kp": lognormal(1.0, 0.2),
    "ks": lognormal(0.01, 0.002), "zp": lognormal(0.05, 0.02), "zs": lognormal(0.02, 0.01),
    "s0": lognormal(100.0, 10.0), "fs": lognormal(15.0, 1.5),
}  # fmt: skip
_INFLUENCE = Distribution.of(kind="scipy", name="lognorm", s=1.0056, scale=math.exp(7.71))
_BOREHOLE: Mapping[str, Input] = {
    "rw": Parameter("rw", -math.inf, math.inf, "m", normal(0.10, 0.0161812), description="radius of the borehole"),
    "r": Parameter("r", -math.inf, math.inf, "m", _INFLUENCE, description="radius of influence"),
    "tu": Parameter("tu", 63070.0, 115600.0, "m^2/yr", description="transmissivity of the upper aquifer"),
    "hu": Parameter("hu", 990.0, 1110.0, "m", description="head of the upper aquifer"),
    "tl": Parameter("tl", 63.1, 116.0, "m^2/yr", description="transmissivity of the lower aquifer"),
    "hl": Parameter("hl", 700.0, 820.0, "m", description="head of the lower aquifer"),
    "length": Parameter("length", 1120.0, 1680.0, "m", description="length of the borehole"),
    "kw": Parameter("kw", 9855.0, 12045.0, "m/yr", description="hydraulic conductivity"),
}
_RP38: Mapping[str, Input] = {
    "x1": normal(350.0, 35.0), "x2": normal(50.8, 5.08), "x3": normal(3.81, 0.381), "x4": normal(173.0, 17.3),
    "x5": normal(9.38, 0.938), "x6": normal(33.1, 3.31), "x7": normal(0.036, 0.0036),
}  # fmt: skip
_SIX = ((-6.0, 6.0), (-6.0, 6.0))
_FOUR = ((-4.0, 4.0), (-4.0, 4.0))
_OSCILLATOR_BOX = ((0.6, 1.4), (0.06, 0.14), (0.8, 1.2), (0.3, 0.7), (0.2, 1.8), (0.2, 1.8))
_BOREHOLE_BOX = ((0.05, 0.15), (100.0, 50000.0), (63070.0, 115600.0), (990.0, 1110.0), (63.1, 116.0), (700.0, 820.0),
                 (1120.0, 1680.0), (9855.0, 12045.0))  # fmt: skip


def _sphere(d: int, radius: float, box_fraction: float, box_std_error: float = 0.0) -> Problem:
    exact = float(gammaincc(d / 2.0, radius**2 / 2.0))
    return Problem(
        f"chi2_d{d}", f"The outside of a sphere in {d} dimensions", _standard(d), partial(sphere, radius=radius), NEGATIVE,
        Truth(exact, 0.0, 1, box_fraction, box_std_error),
    )  # fmt: skip


def _linear(d: int, box_fraction: float, box_std_error: float = 0.0) -> Problem:
    return Problem(
        f"linear_d{d}", f"A hyperplane in {d} dimensions", _standard(d), partial(linear, beta=3.5), NEGATIVE,
        Truth(float(ndtr(-3.5)), 0.0, 1, box_fraction, box_std_error),
    )  # fmt: skip


PROBLEMS = (
    Problem("four_branch_6", "Four failure modes, k = 6", _standard(2), partial(four_branch, k=6.0), NEGATIVE,
            Truth(0.0044573315, 0.0, 4, 0.699915), box=_SIX),
    Problem("four_branch_7", "Four failure modes, k = 7", _standard(2), partial(four_branch, k=7.0), NEGATIVE,
            Truth(0.0022227951, 0.0, 4, 0.630316), box=_SIX),
    Problem("four_branch_noisy", "Four failure modes under noise", _standard(2), partial(four_branch, k=7.0), NEGATIVE,
            Truth(0.0033196576, 0.0, 4, 0.630687), noise=0.3, box=_SIX),
    Problem("rastrigin_ak", "Many islands of failure", _standard(2), rastrigin, NEGATIVE,
            Truth(0.07296933, 0.0, None, 0.517412), box=_FOUR),
    Problem("gayton_hat", "A smooth rare failure", _standard(2), gayton_hat, NEGATIVE,
            Truth(2.8745361e-05, 0.0, 1, 0.044102)),
    Problem("metaball", "Merged hills that mislead", _standard(2), metaball, NEGATIVE,
            Truth(1.1283373e-05, 0.0, 4, 0.074773)),
    Problem("rp38", "Seven inputs of a black-box challenge", parameters_of(_RP38), rp38, NEGATIVE,
            Truth(0.0080527503, 3.1e-06, 1, 0.209159, 2.4e-05)),
    Problem("rp110", "The visible branch is the wrong one", _standard(2), rp110, NEGATIVE,
            Truth(3.1957884e-05, 0.0, 2, 0.079250)),
    Problem("oscillator", "An undamped oscillator", parameters_of(_OSCILLATOR), oscillator, NEGATIVE,
            Truth(0.0285923, 3.7e-05, 1, 0.196923, 2.3e-05), box=_OSCILLATOR_BOX),
    Problem("damped_oscillator_15", "A two-mass oscillator, capacity 15", parameters_of(_DAMPED), damped_oscillator, NEGATIVE,
            Truth(0.0047770912, 2.2e-06, 1, 0.003839, 1.4e-05)),
    Problem("borehole_1e-3", "Too much flow through a borehole", parameters_of(_BOREHOLE), borehole, CriticalInterval(low=190.0),
            Truth(0.0015840019, 6.9e-07, 1, 0.015074, 1.8e-05), box=_BOREHOLE_BOX),
    _linear(2, 0.114890),
    _linear(10, 0.102711, 3.9e-05),
    _linear(30, 0.101621),
    _linear(80, 0.101291),
    _sphere(2, 4.0, 0.443843),
    _sphere(10, 6.2, 0.965290, 2.2e-05),
)  # fmt: skip

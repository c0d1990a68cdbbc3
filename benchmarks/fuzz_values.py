"""What `fuzz.py` puts in the place of values: odd ones, and those at the limits of what is right."""

from __future__ import annotations

import math
from typing import Any

NUMBERS = (
    0, -1, 1, 2, 7, 10**6, 10**12, 10**400, -(10**400), 1e308, -1e308, 1e-300, 5e-324, math.inf, -math.inf, math.nan, 0.5, 2**63,
)  # fmt: skip
TEXTS = (
    "", " ", "~", "null", "yes", "1e3", "0x10", "a" * 100_000, "ü" * 50, "\u202e", "\0", "a\nb", "../../etc/passwd", "/dev/zero",
    "/dev/stdin", "/", ".", "${gap}", "${", "${1/0}", "file.py:NAME", ":", "a:b:c", "*", "&", "{}", "[]", "%s%n", "'", '"',
    "x" * 300,
    "__class__", "x ** 9 ** 9 ** 9", "testbed:", "a.b.c", "tcp://", "\ud800",
)  # fmt: skip
OTHERS: tuple[Any, ...] = (
    None, True, False, [], {}, [[]], [{}], {"": None}, {"kind": "gp"}, [1, 2], [0.0, 1.0], ["a"], [None], {"a": {"b": {"c": []}}},
    {"min": 1e308, "max": -1e308}, {"min": -1e308, "max": 1e308}, {"min": 0, "max": 1e-300}, {"choices": ["a", "b"]},
    {"choices": {"a": 0.5, "b": 0.5}}, {"distribution": {"kind": "normal", "mean": 0, "std": 1e-300}},
)  # fmt: skip
SECTIONS: dict[str, tuple[Any, ...]] = {
    "requirement": (
        {"metric": "ttc_min", "critical": [0, 1e-300]},
        {"metric": "ttc_min", "critical": [-1e308, 1e308]},
        {"stl": "G[0,1e308](ttc > 1)"},
        {"stl": "F[0,5](gap < 1e-300)"},
        {"metric": "d_min", "critical": [None, 1e308]},
        {"any": [{"metric": "ttc_min", "critical": [None, 0.5]}, {"metric": "d_min", "critical": [None, 1]}]},
        {"all": [{"metric": "ttc_min", "critical": [None, 0.5]}, {"stl": "G(gap > 0)"}]},
    ),
    "constraints": (
        ["d_t < 2"],
        ["d_t < -1e9"],
        ["d_t == d_v"],
        ["d_t * 1e308 > d_v"],
        ["d_v / (d_t - d_t) > 0"],
        ["a < 1", "b > 0"],
    ),
    "features": (
        {"f": "d_t * d_v"},
        {"f": "d_t / 0"},
        {"f": "1e308 * d_v"},
        {"d_t": "d_v"},
        {"f": "log(-d_t)"},
        {"f": "d_t ** 400"},
    ),
    "metrics": (["pet"], ["ttc_min"], ["pet", "pet"], ["drac_max", "thw_min", "d_min"]),
    "correlation": ([{"inputs": ["d_t", "d_v"], "value": 0.999999}], [{"inputs": ["d_t", "d_t"], "value": 0.5}]),
    "ego": (
        {"kind": "sumo", "model": "IDM"},
        {"kind": "sumo", "model": {"choices": ["IDM", "Krauss"]}},
        {"kind": "acc_aeb"},
        {"kind": "acc_aeb", "reaction_time": 1e308},
        {"kind": "acc_aeb", "reaction_time": {"min": 0.1, "max": 0.1}},
        {"kind": "sumo", "model": "Krauss", "tau": {"min": 1e-300, "max": 1e308}},
        {"kind": "sumo", "accel": 1e308},
    ),
    "simulation": (
        {"step_length": 1e308},
        {"step_length": 1e-300},
        {"step_length": 0.1},
        {"step_length": 5},
        {"friction": 1e-300},
        {"friction": {"min": 0.1, "max": 1.0}},
        {"friction": 1e308},
    ),
    "seed": (10**400, 2**64, 2**128 - 1, -1),
    "budget": (1, 2, 3, 10**7, 10**12),
    "initial": (1, 2, 10**6),
    "batch": (1, 2, 10**6),
    "validation": ({"share": 0.0}, {"share": 0.99}, {"share": 1e-300}, {"reference": 3}),
    "metamodel": (
        {"kind": "gp"},
        {"kind": "et"},
        {"kind": "et", "trees": 10**9},
        {"kind": "gp", "nu": 2.5, "max_epochs": 0},
        {"kind": "gp", "recalibrate": True},
        {"kind": "gp", "preset": "paper", "max_epochs": 2},
        {"kind": "et", "trees": 1},
    ),
    "acquisition": tuple(
        {"kind": kind}
        for kind in (
            "boundary",
            "even",
            "importance",
            "u",
            "straddle",
            "expected_feasibility",
            "mix",
            "portfolio",
            "auto",
            "difference",
            "monte_carlo",
            "subset",
            "random",
        )
    ),
    "stop": ({"failures": 1}, {"modes": 1}, {"stable": 1e-300}, {"misclassified": 0.999}, {"cov": 1e308}, {"cov": 1e-300}, {}),
    "gate": ({"probability": 1e-300}, {"probability": 0.999999, "confidence": 0.500001}, {"probability": 0.5}),
    "judges": ([], ["cc_human"], ["fsm", "fsm"]),
    "campaign": ("falsification", "boundary", "estimation", "coverage"),
}
"""Values of keys that are right, or nearly so, in some campaign."""
RANGES: tuple[Any, ...] = (
    {"min": -1e308, "max": 1e308}, {"min": 0, "max": 1e-300}, {"min": 1e-300, "max": 2e-300}, {"min": 1e15, "max": 1e15 + 1},
    {"max": 1e308}, {"min": -1e308}, {"min": 1.0, "max": 1.0000000000000002},
    {"distribution": {"kind": "normal", "mean": 1e9, "std": 1}},
    {"distribution": {"kind": "normal", "mean": 1, "std": 1e-300}},
    {"distribution": {"kind": "lognormal", "mean": 1, "std": 1e300}},
    {"distribution": {"kind": "weibull", "shape": 1e-9, "scale": 1}}, {"distribution": {"kind": "beta", "a": 1e9, "b": 1e-9}},
    {"distribution": {"kind": "scipy", "name": "skewnorm", "a": 1e9}}, {"distribution": {"kind": "scipy", "name": "cauchy"}},
    {"distribution": {"kind": "exponential", "mean": 1e-300}}, {"distribution": {"kind": "triangular", "mode": 2}},
    {"distribution": {"kind": "gumbel", "mean": 1, "std": 1e308}}, {"min": 0, "max": 5e-324}, {"min": 1e-310, "max": 1e-309},
)  # fmt: skip
"""Ranges and distributions at the limits of what numbers can be."""

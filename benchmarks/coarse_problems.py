"""Problems with known truth that have a coarse level of fidelity: scenarios for `fidelity.py`.

The metric is linear in two normal inputs (standard deviations .5 and .3) and in what the seed draws (1): mean 0, standard
deviation 1.16. Low values are critical.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
from scipy.special import ndtri

import sbt
from sbt.seeds import stream

COARSE = ("perfect", "good", "fair", "useless", "anticorrelated", "biased", "blind", "faulty")
"""Coarse runs: the same; correlated by .9; by .7; noise; by -.9; by .9 with another mean and scale; that see no low value;
correlated by .9, of a scenario with a fault (1.2 % of all seeds) that they lack."""
_OWN, _SPREAD, _FAULT = (0.5, 0.3), 1.34**0.5, 0.0116
_ERROR = {"perfect": 0.0, "good": 0.56, "fair": 1.18, "anticorrelated": 0.56, "biased": 0.56, "blind": 0.0, "faulty": 0.56}


def metric_at(p: float, coarse: str) -> float:
    """Return the value below which the metric has probability p, fault included."""
    return _SPREAD * float(ndtri(1.0 - (1.0 - p) / (1.0 - _FAULT) if coarse == "faulty" else p))


def scenario_of(coarse: str | None, of: str = "") -> str:
    """Return the name of a coarse scenario, or of the finer one of it."""
    return f"{Path(__file__).resolve()}:{coarse or ('with_fault' if of == 'faulty' else 'fine')}".replace("-", "_")


def _metric(values: Mapping[str, float], seed: int) -> float:
    return _OWN[0] * values["a"] + _OWN[1] * values["b"] + float(stream(seed, "traffic").standard_normal())


def _fine(values: Mapping[str, float], seed: int, *, fault: float) -> dict[str, float]:
    """Return the metric of a run."""
    return {"y": -9.0 if stream(seed, "fault").random() < fault else _metric(values, seed)}


def _coarse(values: Mapping[str, float], seed: int, *, kind: str) -> dict[str, float]:
    """Return the metric of a coarse run."""
    error = float(stream(seed, "coarse").standard_normal())
    if kind == "useless":
        return {"y": _SPREAD * error}
    y = _metric(values, seed) + _ERROR[kind] * error
    return {"y": {"anticorrelated": -y, "biased": 2.0 + 1.5 * y, "blind": max(y, -1.0)}.get(kind, y)}


def _scenario(name: str, evaluate: sbt.Evaluate) -> sbt.Scenario:
    inputs = [sbt.Parameter(k, -np.inf, np.inf, "", sbt.Normal(0.0, 1.0)) for k in ("a", "b")]
    return sbt.Scenario(name, inputs=inputs, evaluate=evaluate, requirement=sbt.Requirement("y", high=0.0))


fine, with_fault = (_scenario(f"fault {q:g}", partial(_fine, fault=q)) for q in (0.0, _FAULT))
perfect, good, fair, useless, anticorrelated, biased, blind, faulty = (_scenario(k, partial(_coarse, kind=k)) for k in COARSE)

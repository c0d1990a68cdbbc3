"""Samplers of other libraries behind one interface: ask for points, tell their margins."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np

from sbt.errors import InputError
from sbt.problem.arrays import Points, Vector
from sbt.problem.cube import CONTINUOUS, Cube
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import SEED_END, stream

__all__ = ["OUTSIDE", "Outside"]

_WORST = 1e9  # stands for the margin of a failed run where a library takes no failures


class Outside(Protocol):
    """A sampler that keeps its own state."""

    def ask(self, n: int) -> Points:
        """Return the next n points (n, d) in the unit cube."""
        ...

    def tell(self, margins: Vector) -> None:
        """Take the margins (n,) of the points that `ask` returned last; NaN where a run failed."""
        ...


class Random:
    """Independent uniform points."""

    def __init__(self, dimension: int, seed: int, initial: int, cube: Cube = CONTINUOUS):
        del initial, cube
        self._dimension, self._rng = dimension, stream(seed, "compare", "random")

    def ask(self, n: int) -> Points:
        """Return n points."""
        return self._rng.random((n, self._dimension))

    def tell(self, margins: Vector) -> None:
        """Learn nothing."""


class Sobol:
    """One scrambled Sobol sequence."""

    def __init__(self, dimension: int, seed: int, initial: int, cube: Cube = CONTINUOUS):
        del initial, cube
        self._sequence, self._at = SobolSequence(dimension, seed), 0

    def ask(self, n: int) -> Points:
        """Return the next n points."""
        self._at += n
        return self._sequence.points(self._at - n, self._at)

    def tell(self, margins: Vector) -> None:
        """Learn nothing."""


class Cma:
    """CMA-ES of pycma: a population a batch, started anew at a random point once it has converged.

    An input with choices has a coordinate for each, and takes the one of the largest.

    Source:
        Hansen (2016), The CMA evolution strategy: a tutorial, arXiv 1604.00772.
    """

    def __init__(self, dimension: int, seed: int, initial: int, cube: Cube = CONTINUOUS):
        del initial
        _require("cma_es", "cma")
        self._rng, self._inputs, self._cube = stream(seed, "compare", "cma"), dimension, cube
        self._dimension = int(cube.embedded(np.full((1, dimension), 0.5)).shape[1])
        self._strategy: Any = None
        self._generation: list[Any] = []

    def ask(self, n: int) -> Points:
        """Return the next generation."""
        if self._strategy is None or self._strategy.stop():
            import cma

            options = {
                "bounds": [0.0, 1.0], "popsize": max(n, 4), "verbose": -9, "seed": math.nan,
                "randn": lambda *shape: self._rng.standard_normal(shape),
            }  # fmt: skip
            start = np.full(self._dimension, 0.5) if self._strategy is None else self._rng.random(self._dimension)
            self._strategy = cma.CMAEvolutionStrategy(start.tolist(), 0.3, options)
        self._generation = self._strategy.ask(n)
        return self._cube.restored(np.clip(np.array(self._generation), 0.0, 1.0).reshape(n, -1), self._inputs)

    def tell(self, margins: Vector) -> None:
        """Adapt to the generation."""
        self._strategy.tell(self._generation, np.where(np.isfinite(margins), margins, _WORST).tolist())


class Tpe:
    """The tree-structured Parzen estimator of Optuna, with constant liars within a batch; choices are its categories.

    Source:
        Bergstra et al. (2011); library Optuna.
    """

    def __init__(self, dimension: int, seed: int, initial: int, cube: Cube = CONTINUOUS):
        _require("tpe", "optuna")
        import optuna

        optuna.logging.set_verbosity(optuna.logging.ERROR)
        number = int(stream(seed, "compare", "tpe").integers(0, SEED_END))
        sampler = optuna.samplers.TPESampler(seed=number, n_startup_trials=initial, constant_liar=True)
        self._study = optuna.create_study(sampler=sampler)
        self._dimension, self._trials, self._choices = dimension, list[Any](), dict(cube.nominal)

    def ask(self, n: int) -> Points:
        """Return the next n points."""
        self._trials = [self._study.ask() for _ in range(n)]
        return np.array([[self._asked(t, k) for k in range(self._dimension)] for t in self._trials])

    def _asked(self, trial: Any, k: int) -> float:
        n = self._choices.get(k)
        if n is None:
            return float(trial.suggest_float(f"u{k}", 0.0, 1.0))
        return (float(trial.suggest_categorical(f"u{k}", list(range(n)))) + 0.5) / n

    def tell(self, margins: Vector) -> None:
        """Learn from the batch; failed runs are failed trials."""
        from optuna.trial import TrialState

        for trial, margin in zip(self._trials, margins, strict=True):
            if math.isfinite(margin):
                self._study.tell(trial, float(margin))
            else:
                self._study.tell(trial, state=TrialState.FAIL)


OUTSIDE: Mapping[str, Callable[[int, int, int, Cube], Outside]] = {"random": Random, "sobol": Sobol, "cma_es": Cma, "tpe": Tpe}
"""By name: (dimension, seed, runs before the first adaptation, where choices lie in the cube) -> sampler."""


def _require(name: str, library: str) -> None:
    if importlib.util.find_spec(library) is None:
        raise InputError(f"sampler {name} needs the library {library}, but it is not installed: pip install 'sumo-sbt[compare]'")

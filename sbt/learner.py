"""What a campaign believes: fits the metamodel to the history and scores it on runs it had not seen."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sbt.arrays import Mask, Points
from sbt.history import History
from sbt.metamodels.base import Metamodel, Predictor
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.scores import scores
from sbt.problem.scenario import LogicalScenario
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream

__all__ = ["Belief", "Learner"]

_PROBE = 4096
_CHUNK = 4096


@dataclass(frozen=True)
class Belief:
    """A fitted metamodel and how good it is.

    Attributes:
        predict: (n, d) unit-cube points of the inputs to a `Prediction`.
        scores: on held-out runs, empty without them; plus `sides`, the classification of 4,096
            fixed Sobol points as hexadecimal bits, and `critical_fraction`, the mean P(critical) there.
        runs: rows it learned from.
        seconds: the fit took.
    """

    predict: Callable[[Points], Prediction]
    scores: dict[str, Any]
    runs: int
    seconds: float


@dataclass(frozen=True)
class Learner:
    """Fits and scores one metamodel for one scenario; the same history gives the same belief."""

    scenario: LogicalScenario
    metamodel: Metamodel
    seed: int

    def fit(self, history: History) -> Belief | None:
        """Return the belief after these runs; None with fewer than two to learn from."""
        training = history.training
        if len(training) < 2:
            return None
        start = time.perf_counter()
        space = self.scenario.space
        y = training.y(self.scenario.requirement.metric)
        u = space.metamodel_inputs(space.to_unit(training.x))
        predictor = self.metamodel.fit(u, y, stream(self.seed, "fit", len(training)))
        seconds = time.perf_counter() - start

        def predict(points: Points) -> Prediction:
            return predictor(space.metamodel_inputs(points))

        return Belief(predict, self._scores(predict, history.held_out), len(training), seconds)

    def _scores(self, predict: Predictor, held_out: History) -> dict[str, Any]:
        critical = self.scenario.requirement.critical
        found: dict[str, Any] = {}
        if len(held_out):
            u = self.scenario.space.to_unit(held_out.x)
            found = scores(predict(u), held_out.y(self.scenario.requirement.metric), critical)
        p = self._probe(predict)
        found["critical_fraction"] = float(p.mean())
        found["sides"] = np.packbits(p > 0.5).tobytes().hex()
        return found

    def _probe(self, predict: Predictor) -> Points:
        """Return P(critical) at 4,096 fixed points of the space."""
        space = self.scenario.space
        u = SobolSequence(space.dimension, self.seed).points(0, _PROBE)
        if space.constraints:
            u = u[space.feasible(space.from_unit(u))]
        critical = self.scenario.requirement.critical
        return np.concatenate([predict(u[k : k + _CHUNK]).probability(critical) for k in range(0, len(u), _CHUNK)])


def changed_share(before: str, after: str) -> float:
    """Return the share of the probe points that two `sides` classify differently."""
    a, b = (np.frombuffer(bytes.fromhex(s), np.uint8) for s in (before, after))
    differ: Mask = np.unpackbits(a ^ b).astype(bool)
    return float(differ.mean())

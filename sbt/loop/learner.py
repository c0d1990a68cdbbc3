"""What a campaign believes: fits the metamodel to the history and scores it on runs it had not seen."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from hashlib import sha256
from typing import Any

import numpy as np

from sbt.metamodels.base import Metamodel, Predictor, Screened, checked, log_ambiguity_bound, named_errors, with_target
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.scores import scores
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.scenario import LogicalScenario
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream
from sbt.store.history import History

__all__ = ["FittedMetamodel", "Learner", "changed_share", "chunked"]

_PROBE = 4096
_CHUNK = 4096


@dataclass(frozen=True)
class FittedMetamodel:
    """A fitted metamodel and how good it is.

    Attributes:
        predict: (n, d) unit-cube points of the inputs to a `Prediction`.
        scores: on held-out runs, empty without them; plus `sides`, the classification of 4,096
            fixed Sobol points as hexadecimal bits, and over these points `critical_fraction`, the mean
            P(critical), `expected_misclassified`, the mean of the smaller of P and 1 - P, and
            `ambiguous_volume`, the share with P between 0.05 and 0.95; of a metamodel that chose among others
            `believed`, what it chose and why, and `weights`, the share of each.
        runs: rows it learned from.
        seconds: the fit took.
        log_ambiguity_bound: (n, d) points -> (n,) quick upper bounds of log a_BI; None: the metamodel has none.
    """

    predict: Callable[[Points], Prediction]
    scores: dict[str, Any]
    runs: int
    seconds: float
    log_ambiguity_bound: Callable[[Points], Vector] | None = None


@dataclass(frozen=True)
class Learner:
    """Fits and scores one metamodel for one scenario; the same history gives the same belief.

    Args:
        scenario: with the campaign's space and requirement.
        metamodel: its settings.
        seed: of the campaign.
        target_aware: the critical edge is what is looked for, and the metamodel is told where it is; otherwise all of y counts.
        last: the last belief by what it was made from: a campaign's conclusion and its report ask for the same.
    """

    scenario: LogicalScenario
    metamodel: Metamodel
    seed: int
    target_aware: bool = True
    last: dict[bytes, FittedMetamodel] = field(default_factory=dict, repr=False, compare=False)

    def fit(self, history: History) -> FittedMetamodel | None:
        """Return the belief after these runs; None with fewer than two to learn from."""
        if len(history.training) < 2:
            return None
        made_from = [history.x, history.y(self.scenario.requirement.metric), history.stage.astype(str)]
        key = sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in made_from)).digest()
        if key not in self.last:
            self.last.clear()
            self.last[key] = self._fit(history)
        return self.last[key]

    def _fit(self, history: History) -> FittedMetamodel:
        training, start = history.training, time.perf_counter()
        space, predictor = self.scenario.space, self.train(training)
        seconds = time.perf_counter() - start

        def predict(points: Points) -> Prediction:
            inputs = space.metamodel_inputs(points)
            with named_errors(self.metamodel, len(training)):
                return checked(predictor(inputs), len(inputs))

        bound = None
        if isinstance(predictor, Screened):
            critical = self.scenario.requirement.critical

            def bound(points: Points) -> Vector:
                return log_ambiguity_bound(predictor, space.metamodel_inputs(points), critical)

        chosen = getattr(getattr(predictor, "predictor", predictor), "comparison", None)  # also of a recalibrated one
        told = {} if chosen is None else {"believed": chosen.reason, "weights": dict(chosen.weights)}
        return FittedMetamodel(predict, self._scores(predict, history) | told, len(training), seconds, bound)

    def train(self, training: History) -> Predictor:
        """Return the metamodel fitted to these runs; it takes `metamodel_inputs` of the space."""
        space, requirement = self.scenario.space, self.scenario.requirement
        y = training.y(requirement.metric)
        u = space.metamodel_inputs(space.to_unit(training.x))
        metamodel = with_target(self.metamodel, requirement.critical) if self.target_aware else self.metamodel
        with named_errors(self.metamodel, len(training)):
            return metamodel.fit(u, y, stream(self.seed, "fit", len(training)))

    def unseen(self, history: History) -> tuple[Points, Vector]:
        """Return x (n, d) and y (n,) that no metamodel learned from: held-out runs, or a table's rows not chosen."""
        metric, pool = self.scenario.requirement.metric, self.scenario.pool
        if pool is None:
            return history.held_out.x, history.held_out.y(metric)
        left = ~pool.taken(history.x)
        return pool.x[left], pool.metrics[metric][left]

    def _scores(self, predict: Predictor, history: History) -> dict[str, Any]:
        critical, space = self.scenario.requirement.critical, self.scenario.space
        x, y = self.unseen(history)
        found: dict[str, Any] = scores(chunked(predict, space.to_unit(x)), y, critical) if len(y) else {}
        p = self._probe(predict)
        found["critical_fraction"] = float(p.mean())
        found["expected_misclassified"] = float(np.minimum(p, 1.0 - p).mean())
        found["ambiguous_volume"] = float(((p > 0.05) & (p < 0.95)).mean())
        found["sides"] = np.packbits(p > 0.5).tobytes().hex()
        return found

    def _probe(self, predict: Predictor) -> Points:
        """Return P(critical) at 4,096 fixed points of the space."""
        space = self.scenario.space
        u = SobolSequence(space.dimension, self.seed).points(0, _PROBE)
        if space.constraints:
            u = u[space.feasible(space.from_unit(u))]
        return predict(u).probability(self.scenario.requirement.critical)


def chunked(predict: Predictor, u: Points) -> Prediction:
    """Return the belief at many points, a few thousand at a time."""
    parts = [predict(u[k : k + _CHUNK]) for k in range(0, len(u), _CHUNK)]
    if len(parts) == 1:
        return parts[0]
    return Prediction(
        np.concatenate([p.mean for p in parts], axis=1), np.concatenate([p.std for p in parts], axis=1), parts[0].weight,
        np.concatenate([p.noise for p in parts]),
    )  # fmt: skip


def changed_share(before: str, after: str) -> float:
    """Return the share of the probe points that two `sides` classify differently."""
    a, b = (np.frombuffer(bytes.fromhex(s), np.uint8) for s in (before, after))
    differ: Mask = np.unpackbits(a ^ b).astype(bool)
    return float(differ.mean())

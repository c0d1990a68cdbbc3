"""The metamodel of a campaign: fitted to the history, scored on runs that it has not seen."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from sbt.loop.drawn_traffic import DrawnTraffic, decoded, encoded
from sbt.loop.earlier import EarlierRuns
from sbt.loop.several import each_requirement, independence
from sbt.metamodels.base import Metamodel, Predictor, Screened, is_flag, log_ambiguity_bound, named_errors, predicted, sketched
from sbt.metamodels.joint import JointPrediction, JointPredictor, in_units, metamodel_for
from sbt.metamodels.over_traffic import MeanOverTraffic, OverTrafficPredictor
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.saturation import scored
from sbt.metamodels.scores import scores
from sbt.metamodels.success import Success, learned_success
from sbt.metamodels.unvaried import with_unvaried
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.combination import MARGIN
from sbt.problem.scenario import LogicalScenario
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream
from sbt.store.history import History
from sbt.store.records import FitRecord, Validation

__all__ = ["FittedMetamodel", "Learner", "changed_share", "chunked"]

_PROBE = 4096
"""Points at which shares of the space are measured: their standard error is below 0.8 %."""
_LEAST_PROBE = 1024
"""Of them, feasible ones: a standard error below 1.6 %."""
_FINE, _FINE_COST = 2**16, 6e9
"""Points at which a small share is measured for a conclusion, at most; and points times squared number of runs: some seconds."""
_SKETCH = 600
"""Runs that a sketch of the metamodel is made of."""
_CHUNK = 4096
"""Points that are predicted at once: bounds the memory of mixtures."""


@dataclass(frozen=True)
class FittedMetamodel:
    """A fitted metamodel and how good it is.

    Attributes:
        predict: (n, d) unit-cube points of the inputs to a `Prediction`.
        record: its scores, as the log keeps them.
        seconds: the fit took.
        log_ambiguity_bound: (n, d) points -> (n,) quick upper bounds of log a_BI; None: the metamodel has none.
        log_success: (n, d) points -> (n,) log P(a run gives a metric); None: all runs so far did.
        sketch: predicts about the same and many times quicker, to guide what `predict` judges; None: there is no such thing.
        sketch_bound: as `log_ambiguity_bound`, of the sketch.
    """

    predict: Callable[[Points], Prediction]
    record: FitRecord
    seconds: float
    log_ambiguity_bound: Callable[[Points], Vector] | None = None
    log_success: Callable[[Points], Vector] | None = None
    sketch: Callable[[Points], Prediction] | None = None
    sketch_bound: Callable[[Points], Vector] | None = None


@dataclass(frozen=True)
class Learner:
    """Fits and scores one metamodel for one scenario; the same history gives the same fitted metamodel.

    Args:
        scenario: with the campaign's space and requirement.
        metamodel: its settings.
        seed: of the campaign.
        target_aware: the critical edge is what is looked for, and the metamodel knows where it is; otherwise all of y counts.
        earlier: runs of an earlier campaign that it learns from, too, where they help; None: there are none.
        traffic: that seeds draw, over which P(critical) is averaged; None: seeds are not looked at.
    """

    scenario: LogicalScenario
    metamodel: Metamodel
    seed: int
    target_aware: bool = True
    earlier: EarlierRuns | None = None
    traffic: DrawnTraffic | None = None

    def fit(self, history: History) -> FittedMetamodel | None:
        """Return the metamodel fitted to these runs, and scored; None with fewer than two to learn from."""
        training, start = history.training, time.perf_counter()
        if len(training) < 2:
            return None
        predictor, taken = self._trained(training)
        predictor, averaged = self.over_traffic(predictor, history)
        seconds = time.perf_counter() - start
        predict = self.on_inputs(predictor, len(training))
        success = self.success(history)
        record = replace(self._record(predict, predictor, history, len(training), success, taken), over_traffic=averaged)
        rough = sketched(predictor, _SKETCH)
        sketch, quick = None, None
        if rough is not predictor:
            sketch, quick = self.on_inputs(rough, len(training)), self._bound(rough)
        return FittedMetamodel(predict, record, seconds, self._bound(predictor), success, sketch, quick)

    def telling(self, history: History) -> Learner:
        """Return what learns metrics of two values for what is told of them: sides, where this one takes them for Gaussian."""
        parts, runs = self.scenario.requirement.parts, history.finished
        if not any(is_flag(part.values(runs), part.critical) for part in parts):
            return self
        from sbt.metamodels.automatic import Auto  # torch

        auto: Metamodel = Auto(**Auto.PRESETS["quick"])
        followed = self.metamodel == replace(Auto().simplest, kernels=1)  # by a search, unless another one is chosen
        return replace(self, metamodel=auto if followed else self.metamodel, target_aware=True)

    def told(self, predict: Predictor, history: History, runs: History) -> Predictor:
        """Return a predictor as it is told: margins in the units that those of all runs have, doubt of metrics of one value.

        Args:
            predict: of the metric, or of a combination.
            history: all runs.
            runs: those that it has learned from.
        """
        requirement, space = self.scenario.requirement.in_units_of(history), self.scenario.space
        y, before = np.column_stack([part.values(runs) for part in requirement.parts]), np.empty((0, len(requirement.parts)))
        if any(len(np.unique(each[np.isfinite(each)])) == 1 for each in y.T) and (earlier := self._helping(runs)) is not None:
            before = earlier.y.reshape(-1, y.shape[1])
        inputs, every = len(np.unique(runs.x, axis=0)), space.combinations
        n = len(y) if every is not None and inputs == len(every) else inputs  # repeats tell of no other inputs
        return with_unvaried(in_units(predict, requirement.critical), np.concatenate([before, y]).T, len(before) + n)

    def _helping(self, training: History) -> EarlierRuns | None:
        """Return the earlier runs where these are predicted no worse with them."""
        if self.earlier is None:
            return None
        u, y = self.inputs(self.scenario.space.to_unit(training.x)), self.scenario.requirement.values(training)
        rng = stream(self.seed, "earlier", len(training))
        return self.earlier if self.earlier.helps(u, y, self.scenario.requirement.critical, rng) else None

    def over_traffic(self, predictor: Predictor, history: History) -> tuple[Predictor, str | None]:
        """Return a predictor with P(critical) as the mean over traffic, and what a record keeps of it; or itself, None."""
        traffic = self.traffic
        p = None if traffic is None else traffic.means(history)
        if traffic is None or p is None:
            return predictor, None
        kept = encoded(p)
        mean = MeanOverTraffic.of(self.inputs(traffic.points), decoded(kept), stream(self.seed, "over traffic"))
        return OverTrafficPredictor(predictor, mean, self.scenario.requirement.critical), kept

    def _bound(self, predictor: Predictor) -> Callable[[Points], Vector] | None:
        """Return quick upper bounds of log a_BI at the inputs' (n, d) unit-cube points; None: the predictor has none."""
        if not isinstance(predictor, Screened):
            return None
        critical = self.scenario.requirement.critical
        return lambda points: log_ambiguity_bound(predictor, self.inputs(points), critical)

    def success(self, history: History) -> Success | None:
        """Return log P(a run gives a metric) at the inputs' (n, d) unit-cube points; None where all runs did, or none."""
        space = self.scenario.space
        if history.ok.all():
            return None
        u = space.metamodel_inputs(space.to_unit(history.x))
        score = learned_success(u, history.ok, stream(self.seed, "success", len(history)))
        return None if score is None else score.of(space.metamodel_inputs)

    def on_inputs(self, predictor: Predictor, learned: int) -> Predictor:
        """Return a predictor as a function of the inputs' (n, d) unit-cube points; derived features are added here."""

        def predict(points: Points) -> Prediction:
            inputs = self.inputs(points)
            with named_errors(self.metamodel, learned):
                return predicted(predictor, inputs)

        return predict

    def inputs(self, points: Points) -> Points:
        """Return what the metamodel takes for (n, d) unit-cube points of the inputs."""
        own = self.scenario.space.metamodel_inputs(points)
        return own if self.earlier is None else self.earlier.own(own)

    def train(self, training: History) -> Predictor:
        """Return the metamodel fitted to these runs; it takes `inputs`."""
        return self._trained(training)[0]

    def _trained(self, training: History) -> tuple[Predictor, int | None]:
        """Return the metamodel fitted to these runs, and how many earlier ones it learned from; None: there are none."""
        requirement, rng = self.scenario.requirement, stream(self.seed, "fit", len(training))
        u, y = self.inputs(self.scenario.space.to_unit(training.x)), requirement.values(training)
        earlier = self._helping(training)
        taken = None if self.earlier is None else 0 if earlier is None else len(earlier)
        u, y = (u, y) if earlier is None else earlier.joined(u, y)
        metamodel = metamodel_for(self.metamodel, requirement.critical, target_aware=self.target_aware)
        with named_errors(self.metamodel, len(y)):
            return metamodel.fit(u, y, rng), taken

    def unseen(self, history: History) -> tuple[Points, Vector]:
        """Return x (n, d) and what is learned of runs, (n,) or (n, q), that no metamodel learned from.

        They are held-out runs, or a table's rows not chosen.
        """
        requirement, pool = self.scenario.requirement, self.scenario.pool
        if pool is None:
            return history.held_out.x, requirement.values(history.held_out)
        left = ~pool.taken(history.x)
        return pool.x[left], requirement.values(pool)[left]

    def _record(
        self, predict: Predictor, predictor: Predictor, history: History, learned: int,
        success: Callable[[Points], Vector] | None, taken: int | None,
    ) -> FitRecord:  # fmt: skip
        """Return the scores of a fitted metamodel, and its classification of fixed points."""
        (x, y), critical = self.unseen(history), self.scenario.requirement.critical
        unseen = chunked(predict, self.scenario.space.to_unit(x)) if len(y) else None
        found: Any = None if unseen is None else self._scores(predictor, unseen, y)
        u = self.probe
        at_probe = predict(u)
        p = at_probe.probability(critical)
        ok = None if success is None else np.exp(success(u))
        shares = _shares(p, ok)
        comparison = getattr(getattr(predictor, "predictor", predictor), "comparison", None)  # also of a recalibrated one
        return FitRecord(
            learned, shares[0], shares[1], shares[2],
            np.packbits(p > 0.5).tobytes().hex(), None if found is None else Validation(**found),
            None if comparison is None else dict(comparison.weights), None if comparison is None else comparison.reason,
            failing_fraction=None if ok is None else float(1.0 - ok.mean()), earlier=taken,
            **self._several(predictor, at_probe, ok, unseen, y),
        )  # fmt: skip

    def _scores(self, predictor: Predictor, unseen: Prediction, y: Vector) -> dict[str, Any]:
        """Return the scores of a prediction of runs; of a combination (n, q) those of its margin."""
        if not isinstance(predictor, JointPredictor):
            critical = self.scenario.requirement.critical
            told = scored(y, unseen.mu, critical) if self.target_aware else y
            return scores(unseen, told, critical, critical.contains(y))
        margin = predictor.critical.margin(y)
        known = np.isfinite(margin)
        return scores(unseen.take(known), margin[known], MARGIN)

    def _several(
        self, predictor: Predictor, probe: Prediction, ok: Vector | None, unseen: Prediction | None, y: Vector
    ) -> dict[str, Any]:
        """Return what a record says of each requirement of a combination; nothing of a single one."""
        if not isinstance(predictor, JointPredictor) or not isinstance(probe, JointPrediction):
            return {}
        parts = self.scenario.requirement.parts
        seen = (unseen, y) if isinstance(unseen, JointPrediction) else None
        return {
            "requirements": each_requirement(predictor, parts, probe, ok, seen),
            "independence": None if seen is None else independence(parts, *seen),
        }

    def fine_shares(self, fitted: FittedMetamodel) -> tuple[float, float, float]:
        """Return critical fraction, expected misclassified and ambiguous volume of a record at up to 65,536 points.

        Of a critical share of 1e-3 the probe meets four points. Fewer points with many runs, whose predictions cost their square.
        """
        space, critical = self.scenario.space, self.scenario.requirement.critical
        n = int(np.clip(_FINE_COST / fitted.record.learned**2, _PROBE, _FINE))
        sequence = SobolSequence(space.dimension, self.seed)
        u = sequence.points(0, n)
        u = u[space.feasible(space.from_unit(u))] if space.constraints else u
        u = u if len(u) >= _LEAST_PROBE else self.probe
        parts = [u[k : k + _CHUNK] for k in range(0, len(u), _CHUNK)]
        p = np.concatenate([fitted.predict(part).probability(critical) for part in parts])
        success = fitted.log_success
        return _shares(p, None if success is None else np.exp(np.concatenate([success(part) for part in parts])))

    @cached_property
    def probe(self) -> Points:
        """The feasible ones of 4,096 fixed points of the space; where those are few, of as many as it takes to have 1,024."""
        space = self.scenario.space
        sequence = SobolSequence(space.dimension, self.seed)
        if not space.constraints:
            return sequence.points(0, _PROBE)
        return sequence.admissible(lambda u: space.feasible(space.from_unit(u)), _PROBE, _LEAST_PROBE)


def _shares(p: Vector, weight: Vector | None) -> tuple[float, float, float]:
    """Return means of P(critical) (n,), of the smaller of it and its complement, and of whether it is ambiguous."""
    return (
        float(np.average(p, weights=weight)), float(np.average(np.minimum(p, 1.0 - p), weights=weight)),
        float(np.average((p > 0.05) & (p < 0.95), weights=weight)),
    )  # fmt: skip


def chunked(predict: Predictor, u: Points) -> Prediction:
    """Return the predictions at many points, a few thousand at a time."""
    parts = [predict(u[k : k + _CHUNK]) for k in range(0, len(u), _CHUNK)]
    return parts[0] if len(parts) == 1 else parts[0].joined(parts[1:])


def changed_share(before: str, after: str) -> float:
    """Return the share of the probe points that two `sides` classify differently."""
    a, b = (np.frombuffer(bytes.fromhex(s), np.uint8) for s in (before, after))
    differ: Mask = np.unpackbits(a ^ b).astype(bool)
    return float(differ.mean())

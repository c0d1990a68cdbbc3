"""The laws that plug-ins keep, as checks: `sbt.testing` offers them.

Each check runs the laws that campaigns rely on and raises `ContractError` with the rule and the value
that broke it; it returns nothing where all hold.
"""

from __future__ import annotations

import dataclasses
import math
import pickle
import tempfile
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sbt.acquisitions import Acquisition
from sbt.campaigns.settings import CampaignKind, Settings
from sbt.errors import RAISED, RunError, SbtError, described
from sbt.loop.stages import Campaign, Progress
from sbt.metamodels.base import Metamodel, Predictor
from sbt.metamodels.prediction import Prediction
from sbt.problem.arrays import Points, Vector
from sbt.problem.metric import Metric
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import CriticalInterval, Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.trace import Trace
from sbt.seeds import stream
from sbt.store.history import Record
from sbt.store.records import to_json
from sbt.workflows.checking import check_scenario

if TYPE_CHECKING:
    from sbt.workflows.result import Result

__all__ = [
    "ContractError", "check_acquisition", "check_campaign", "check_metamodel", "check_metric", "check_sampler", "check_scenario",
]  # fmt: skip

_INTERVALS = (CriticalInterval(high=0.0), CriticalInterval(low=1.0), CriticalInterval(-0.5, 0.5), CriticalInterval(high=-1e6))
_SINGLE = 1e-5  # relative: networks predict in single precision (eps 1.2e-7), and another shape adds in another order


class ContractError(SbtError, AssertionError):
    """A plug-in breaks a law that campaigns rely on."""


def check_metamodel(metamodel: Metamodel, *, dimensions: tuple[int, ...] = (1, 2, 7), seed: int = 0) -> None:
    """Check a metamodel against the laws that campaigns rely on.

    Shapes and finiteness; sigma > 0; the same rng gives the same bits; the order of rows, the scale and
    the shift of y hardly matter; few rows, constant y, duplicates and an outlier are survived; a prediction
    at a point does not depend on the other points; a pickled copy of the predictor, where it can be pickled, predicts
    the same; a smooth function is learned better than by its mean.

    Args:
        metamodel: an object with `fit`.
        dimensions: numbers of inputs to try.
        seed: seed >= 0 of the rows and of the fits.

    Raises:
        ContractError: a law is broken.
    """
    for d in dimensions:
        rng = stream(seed, "check_metamodel", d)
        u, at = rng.random((30 + 10 * d, d)), rng.random((25, d))
        y = _smooth(u)

        def fit(u: Points, y: Vector, d: int = d) -> Predictor:
            return metamodel.fit(u.copy(), y.copy(), stream(seed, "check_metamodel", "fit", d))

        try:
            predictor, same = fit(u, y), fit(u, y)
            prediction = predictor(at.copy())
        except RAISED as error:
            raise ContractError(f"a metamodel must learn from {len(y)} rows and predict, but raised {error!r}") from error
        _check_prediction(prediction, len(at), f"d = {d}")
        _check_predictor(predictor, same, at, prediction)
        _check_learning(predictor, u, y, at)
        _check_rows(fit, u, y, at, prediction)
        _check_awkward_rows(fit, u, y, at)


def check_acquisition(acquisition: Acquisition, *, seed: int = 0) -> None:
    """Check an acquisition function: (n,) scores < inf without NaN, each from its own point alone.

    Scores may exceed 0, but must be finite from above: points are drawn in proportion to exp(score), or taken in the
    order of the scores where the acquisition is declared greedy.

    Args:
        acquisition: (prediction, critical, log_density) -> (n,) log scores.
        seed: seed >= 0 of the predictions.

    Raises:
        ContractError: a law is broken.
    """
    rng = stream(seed, "check_acquisition")
    n, k = 20, 3
    mean = rng.normal(0.0, 5.0, (k, n))
    mean[:, :2] = 1e6, -1e6  # certain points
    mixture = Prediction(mean, rng.uniform(0.1, 2.0, (k, n)), np.full(k, 1 / k), np.full(n, 0.05))
    gaussian = Prediction.gaussian(mixture.mu, mixture.sigma, mixture.noise)
    log_density = rng.normal(0.0, 3.0, n)
    order = rng.permutation(n)
    selection = getattr(acquisition, "selection", "draw")
    _require(selection in ("draw", "greedy"), "selection of an acquisition must be 'draw' or 'greedy'", repr(selection))
    for critical in _INTERVALS:
        for prediction in (gaussian, mixture):
            score = _scored(acquisition, prediction, critical, log_density)
            _require(score.shape == (n,), "an acquisition must return shape (n,)", f"{score.shape} for {n} points")
            _require(not np.isnan(score).any(), "an acquisition must not return NaN", f"NaN for {critical}")
            _require(not np.isposinf(score).any(), "an acquisition must be < inf", f"inf for {critical}")
            permuted = acquisition(prediction.take(order), critical, log_density[order])
            _close(permuted, score[order], 1e-9, "an acquisition must not depend on the order of the points")
            one = [acquisition(prediction.take(np.array([i])), critical, log_density[[i]])[0] for i in range(n)]
            _close(np.array(one), score, 1e-9, "a score must not depend on the other points scored")
    nothing = _scored(acquisition, gaussian.take(slice(0)), _INTERVALS[0], log_density[:0])
    _require(nothing.shape == (0,), "an acquisition must take n = 0 points", f"shape {nothing.shape}")


def _scored(acquisition: Acquisition, prediction: Prediction, critical: CriticalInterval, log_density: Vector) -> Vector:
    try:
        return np.asarray(acquisition(prediction, critical, log_density), dtype=np.float64)
    except RAISED as error:
        raise ContractError(f"an acquisition must score {len(prediction)} points, but raised {error!r}") from error


def check_sampler(propose: Callable[[int, int], Points], *, dimension: int, seed: int = 0) -> None:
    """Check a sampler: (n, d) distinct points in the unit cube that depend on the seed only.

    Args:
        propose: (n, seed) -> (n, d) points; wrap a sampler with a fixed history in a function.
        dimension: number of inputs d.
        seed: seed >= 0 to propose with.

    Raises:
        ContractError: a law is broken.
    """
    for n in (0, 1, 7, 64):
        points = np.asarray(propose(n, seed))
        shape = (n, dimension)
        _require(points.shape == shape, f"a sampler must return shape {shape}", str(points.shape))
        inside = np.isfinite(points).all() and ((points >= 0) & (points <= 1)).all()
        _require(bool(inside), "a sampler must return points in the unit cube", f"{points.min(initial=0)} to "
                 f"{points.max(initial=0)}")  # fmt: skip
        distinct = len(np.unique(points, axis=0))
        _require(distinct == n, "a sampler must return distinct points", f"{distinct} of {n}")
        again = np.array_equal(points, np.asarray(propose(n, seed)))
        _require(again, "the same seed must give the same points, bit by bit", f"other points for n = {n}")


def check_metric(metric: Metric, traces: Iterable[Trace]) -> None:
    """Check a safety metric: a pure function of the trace, never NaN, that says what it gives without an interaction.

    Args:
        metric: measures the actors `ego` and `co`, or all of them.
        traces: examples to measure, of runs with and without a critical encounter.

    Raises:
        ContractError: a law is broken.
    """
    alone, said = _measured(metric, _apart()), metric.without
    _require(math.isfinite(said) or alone == said, "a metric must say its value without an interaction", str(said))
    _require(metric.direction in ("low", "high"), "a metric's direction must be low or high", repr(metric.direction))
    for trace in traces:
        before, y = _copy(trace), _measured(metric, trace)
        _require(trace.identical(before), "a metric must not change the trace", f"another trace after {metric.name}")
        again = _measured(metric, before)
        _require(again == y, "the same trace must give the same value, bit by bit", f"{again} after {y}")
        later = _measured(metric, dataclasses.replace(before, time=before.time + 64.0))
        _close(np.array([later]), np.array([y]), 1e-9, "a metric must not depend on when the run began")
    _close(np.array([alone]), np.array([metric.without]), 1e-9, "where the two never meet a metric must give its `without`")


def check_campaign(kind: CampaignKind | Callable[[Settings], Campaign], *, seed: int = 0) -> None:
    """Check a campaign by running it, tiny, on a scenario of two inputs, and on one where a quarter of the runs fail.

    It ends; the same seed gives the same runs and the same conclusion, also where it was stopped in the middle and went on;
    the conclusion goes to JSON and back, and its sentences are text.

    Args:
        kind: the campaign, or its recipe alone.
        seed: of the campaigns, >= 0.

    Raises:
        ContractError: a law is broken.
    """
    for share in (0.0, 0.25):
        with tempfile.TemporaryDirectory() as folder:
            case = f"{share:.0%} of the runs fail"
            whole, rows = _ran(kind, share, seed, Path(folder) / "whole", case)
            again, same = _ran(kind, share, seed, Path(folder) / "again", case)
            _require(same == rows, "the same seed must give the same runs", f"others ({case})")
            said, found = again.conclusion.to_dict(), whole.conclusion.to_dict()
            _require(said == found, "the same runs must give the same conclusion", f"{said} after {found} ({case})")
            half = len(rows) // 2
            stopped, part = Path(folder) / "stopped", f"{case}, stopped after {half} runs"
            with suppress(_StoppedError):
                _ran(kind, share, seed, stopped, part, stop_after=half)
            resumed, same = _ran(kind, share, seed, stopped, part)
            _require(same == rows, "a campaign that was stopped must go on to the same runs: a stage may look at the log alone",
                     f"others ({part})")  # fmt: skip
            said = resumed.conclusion.to_dict()
            _require(said == found, "a campaign that was stopped must conclude the same", f"{said} after {found} ({part})")
            _check_conclusion(whole, case)


_BUDGET = 36
_ENDLESS = 10  # times the budget: confirmations come beside it


class _StoppedError(Exception):
    """The campaign was stopped on purpose."""


def _ran(
    kind: CampaignKind | Callable[[Settings], Campaign], share: float, seed: int, store: Path, case: str, *,
    stop_after: int | None = None,
) -> tuple[Result[Any], list[Record]]:  # fmt: skip
    """Return the result of a small campaign and its runs without what may differ."""
    from sbt.workflows.front import run_campaign

    def evaluate(values: Mapping[str, float], seed: int) -> dict[str, float]:
        del seed
        if values["b"] < share:
            raise RunError("invalid", "b is too small")
        return {"y": float(np.hypot(values["a"] - 0.6, values["b"] - 0.5)) - 0.3}

    def listen(progress: Progress) -> None:
        rule = f"a campaign must end near its budget of {_BUDGET}"
        _require(progress.done <= _ENDLESS * _BUDGET, rule, f"{progress.done} runs")
        if stop_after is not None and progress.done >= stop_after:
            raise _StoppedError

    inputs = [Parameter("a", 0, 1), Parameter("b", 0, 1)]
    scenario = LogicalScenario("disc", inputs, Requirement("y", high=0.0), evaluate=evaluate)
    settings: dict[str, Any] = {"budget": _BUDGET, "initial": 12, "batch": 12, "seed": seed, "store": store}
    if CampaignKind.of(kind, "check_campaign").adaptive:
        settings["metamodel"] = "et"
    try:
        found = run_campaign(
            campaign=kind, scenario=scenario, executor="serial", report=False, progress=listen, **settings
        )
    except (_StoppedError, ContractError):
        raise
    except RAISED as error:
        raise ContractError(f"a campaign must run to its end, but raised {described(error)} ({case})") from error
    return found, [dataclasses.replace(record, seconds=0.0, versions="") for record in found.history.records]


def _check_conclusion(result: Result[Any], case: str) -> None:
    """Check that a conclusion goes to JSON and back, and says what it found."""
    found = result.summary["conclusion"]
    try:
        back, sentences = result.conclusion.to_dict(), result.sentences()
    except RAISED as error:
        rule = "a conclusion must be read back from its JSON and say what was found"
        raise ContractError(f"{rule}, but raised {described(error)} ({case})") from error
    _require(to_json(back) == found, "a conclusion must go to JSON and back", f"{back} after {found} ({case})")
    texts = isinstance(sentences, list) and all(isinstance(sentence, str) for sentence in sentences)
    _require(texts, "sentences of a conclusion must be a list of text", f"{sentences!r} ({case})")


def _measured(metric: Metric, trace: Trace) -> float:
    """Return the value, finite or an end of the scale."""
    try:
        value = float(metric(trace))
    except RAISED as error:
        rule = "not change the trace" if "read-only" in str(error) else "measure every trace"
        raise ContractError(f"a metric must {rule}, but {metric.name} raised {error!r}") from error
    _require(not math.isnan(value), "a metric must be finite, inf or -inf", f"{value} of {metric.name}")
    return value


def _copy(trace: Trace) -> Trace:
    """Return an equal trace that shares no array with this one."""
    copied: Trace = pickle.loads(pickle.dumps(trace))
    return copied


def _apart() -> Trace:
    """Return ego and co, 5 km beside each other at constant 20 m/s, for 5 s."""
    t = np.arange(0.0, 5.01, 0.1)
    both, zero = np.ones((len(t), 2)), np.zeros((len(t), 2))
    y = zero + np.array([0.0, 5000.0])
    return Trace(t, ("ego", "co"), 20.0 * t[:, None] * both, y, zero, 20.0 * both, zero, np.full(2, 5.0), np.full(2, 1.8))


def _check_prediction(prediction: Prediction, n: int, case: str) -> None:
    """Check shapes, finiteness, positive sigma and probabilities."""
    _require(isinstance(prediction, Prediction), "a predictor must return a Prediction", f"{type(prediction)} ({case})")
    _require(len(prediction) == n, "a prediction must have one value a point", f"{len(prediction)} of {n} ({case})")
    finite = np.isfinite(prediction.mu).all() and np.isfinite(prediction.sigma).all()
    _require(bool(finite), "mu and sigma must be finite", f"NaN or infinity ({case})")
    _require(bool((prediction.sigma > 0).all()), "sigma must be > 0", f"{prediction.sigma.min()} ({case})")
    most = 1.0 + 1e-6
    _require(bool((prediction.noise <= most * prediction.sigma).all()), "noise is a part of sigma", f"noise > sigma ({case})")
    for critical in _INTERVALS:
        p = prediction.probability(critical)
        _require(bool(((p >= 0) & (p <= 1)).all()), "P(y in M_c) must be in [0, 1]", f"{p} ({case})")


def _check_predictor(predictor: Predictor, same: Predictor, at: Points, prediction: Prediction) -> None:
    """Check that a predictor is a pure function that the rng decides."""
    _same_bits(_predicted(same, at), prediction, "the same rng must give the same predictor, bit by bit")
    _same_bits(_predicted(predictor, at), prediction, "a predictor must return the same prediction when called again")
    try:
        pickled = pickle.dumps(predictor)
    except Exception:  # it holds a local function, say; campaigns do not need it
        pickled = None
    if pickled is not None:
        _same_bits(_predicted(pickle.loads(pickled), at), prediction, "a pickled predictor must predict the same")
    single = [_predicted(predictor, at[i : i + 1]) for i in range(len(at))]
    rule = "a prediction must not depend on the other points"
    scale = float(prediction.sigma.max())
    _close(np.array([s.mu[0] for s in single]), prediction.mu, _SINGLE, rule, scale)
    _close(np.array([s.sigma[0] for s in single]), prediction.sigma, _SINGLE, rule, scale)
    _require(len(_predicted(predictor, at[:0])) == 0, "a predictor must take n = 0 points", "another number of predictions")


def _predicted(predictor: Predictor, at: Points) -> Prediction:
    try:
        return predictor(at.copy())
    except RAISED as error:
        raise ContractError(f"a predictor must take n = {len(at)} points, but raised {error!r}") from error


def _check_learning(predictor: Predictor, u: Points, y: Vector, at: Points) -> None:
    """Check that a smooth function is learned better than by the mean of y."""
    near = np.clip(u + 0.01 * (at.mean() - 0.5), 0.0, 1.0)
    error = float(np.sqrt(np.mean((_predicted(predictor, near).mu - _smooth(near)) ** 2)))
    limit = 0.8 * float(y.std())
    rule = "near its rows a metamodel must predict a smooth function better than the mean does"
    _require(error < limit, rule, f"RMSE {error:.3g} for a standard deviation of {y.std():.3g}")


def _check_rows(fit: Callable[[Points, Vector], Predictor], u: Points, y: Vector, at: Points, prediction: Prediction) -> None:
    """Check that scale, shift and order of the rows hardly matter."""
    scaled = _predicted(fit(u, 1e6 * y + 3e6), at)
    size = float(prediction.sigma.max())
    rule = "scaling and shifting y must scale and shift the prediction"
    _close((scaled.mu - 3e6) / 1e6, prediction.mu, 0.05, rule, size)
    _close(scaled.sigma / 1e6, prediction.sigma, 0.05, rule, size)
    order = np.random.Generator(np.random.PCG64(0)).permutation(len(y))
    other = _predicted(fit(u[order], y[order]), at)
    rule = "the order of the rows must not change the prediction beyond its own sigma"
    _require(float(np.median(np.abs(other.mu - prediction.mu) / prediction.sigma)) < 2.0, rule, "a shift > 2 sigma")


def _check_awkward_rows(fit: Callable[[Points, Vector], Predictor], u: Points, y: Vector, at: Points) -> None:
    """Check that few rows, constant y, duplicates, an outlier and a plateau are survived."""
    few = u.shape[1] + 2
    outlier, plateau = y.copy(), np.clip(y, np.median(y), None)
    outlier[0] = 1e6
    cases = {
        "n = d + 2": (u[:few], y[:few]),
        "n = 2": (u[:2], y[:2]),
        "constant y": (u, np.full(len(y), 10.0)),
        "y = 0": (u, np.zeros(len(y))),
        "duplicates": (np.repeat(u[:10], 3, axis=0), np.repeat(y[:10], 3)),
        "one point, two values": (np.repeat(u[:1], 8, axis=0), np.tile([0.0, 1.0], 4)),
        "one outlier": (u, outlier),
        "a plateau": (u, plateau),
    }
    for case, (rows, values) in cases.items():
        try:
            prediction = fit(rows, values)(at.copy())
        except RAISED as error:
            raise ContractError(f"a metamodel must learn from {case}, but got {error!r}") from error
        _check_prediction(prediction, len(at), case)
    constant = _predicted(fit(u, np.full(len(y), 10.0)), at)
    off = float(np.abs(constant.mu - 10.0).max())
    _require(off < 1.0, "where all y are 10 the prediction must be about 10", f"off by {off}")


def _smooth(u: Points) -> Vector:
    """Return a smooth function of mostly the first two inputs."""
    return np.asarray(np.sin(4.0 * u[:, 0]) + u[:, -1] ** 2 + 0.1 * u.sum(axis=1))


def _same_bits(a: Prediction, b: Prediction, rule: str) -> None:
    for name in ("mean", "std", "weight", "noise"):
        _require(np.array_equal(getattr(a, name), getattr(b, name)), rule, f"another {name}")


def _close(got: NDArray[np.float64], expected: NDArray[np.float64], tolerance: float, rule: str, size: float = 1.0) -> None:
    with np.errstate(invalid="ignore"):
        gap = np.abs(np.asarray(got) - expected) - tolerance * np.abs(expected)
    worst = float(np.where(got == expected, 0.0, gap).max(initial=0.0))
    _require(worst <= tolerance * size, rule, f"a difference of {worst:.3g}")


def _require(holds: bool, rule: str, value: str) -> None:
    if not holds:
        raise ContractError(f"{rule}, but got {value}")

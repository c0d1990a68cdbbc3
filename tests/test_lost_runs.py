"""What conclusions say where runs give no metric, and where an interval is wider than asked."""

import math
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import sbt
from sbt.campaigns.boundary import BoundaryConclusion
from sbt.campaigns.clustering import Spread
from sbt.campaigns.combinations import EveryCombination
from sbt.campaigns.estimation import EstimationConclusion
from sbt.campaigns.gate import GateVerdict
from sbt.campaigns.lost import failed_runs, narrower, runs_to_halve
from sbt.campaigns.parts import CriticalShare
from sbt.campaigns.telling import tell_boundary, tell_estimation, tell_share
from sbt.cli import app
from sbt.estimators import binomial
from sbt.estimators.binomial import interval
from sbt.loop.stages import Facts, Log
from sbt.problem.requirement import Requirement
from sbt.seeds import stream
from sbt.store.database import Store
from sbt.store.history import History, Rows
from sbt.workflows.study import Study

LOW = Requirement("m", high=0.0)
NARROW = {"probability": 0.1, "low": 0.09, "high": 0.11, "cov": 0.05, "hits": 40, "counted": 60, "undetected_mass_bound": 0.05}


def _next(**found):
    facts = Facts(History.of(("a",)), LOW, "m", "s")
    return tell_estimation(
        EstimationConclusion(**{**NARROW, "failed_as_critical": found.get("probability", 0.1), **found}), facts
    )[2]


def _never(values, seed):
    raise sbt.RunError("failed", "never")


def _low(values, seed):
    return {"m": -1.0 - values["a"]}


def test_no_number_of_runs_is_advised_where_failed_runs_decide_the_width():
    """Nor of a bound, nor of a share; few failed runs leave the advice as it was."""
    lost = "failed runs decide"
    assert "narrow enough" in _next()
    assert "more runs (budget" in _next(cov=0.2)
    for learned in (None, ()):  # a sum, or random draws; draws that a metamodel chose
        assert ("where a metamodel goes on to learn" in _next(cov=0.2, convergence=learned)) is (learned is not None)
    for cov in (0.05, 0.2):
        assert lost in _next(cov=cov, high=0.5, failed_as_critical=0.3)
        assert lost not in _next(cov=cov, failed_as_critical=0.11)
    few = _next(cov=0.5, high=0.5, failed_as_critical=0.3, warmed_traffic=Spread(4, 0.09, std_error_apart=0.01))
    assert "more warm-ups (warm_up.seeds), hardly more runs, would bring it to about 0.3" in few
    assert lost in _next(probability=0.0, low=0.0, exact_bound=0.3, failed_as_critical=0.2, hits=0)
    assert "tenfold" in _next(probability=0.0, low=0.0, exact_bound=0.3, failed_as_critical=0.0, hits=0)
    facts = Facts(History.of(("a",)), LOW, "m", "s")
    for n, told in ((16, True), (1, False)):
        said = tell_share(CriticalShare(0.0625, 0.014, 0.36, 0.95, 80, n), facts)
        assert "of what gives a metric" in said[0]
        assert f"{n} of 80 runs gave no metric" in said[0]
        assert (lost in said[2]) is told


@pytest.mark.parametrize("wide", [{"hits": 3}, {"low": 0.0, "high": 0.4}, {"cov": 0.2}])
def test_an_interval_is_as_narrow_as_asked_by_the_rule_that_ends_a_campaign(wide):
    """Ten hits, and a half width of at most three coefficients of variation."""
    assert "narrow enough" not in _next(**wide)
    assert "more runs (budget" in _next(**wide)
    told = "until 10 critical draws count" if "hits" in wide else "give it to"
    assert told in _next(**wide), "what more runs give"


@pytest.mark.parametrize("campaign", ["coverage", "boundary", "falsification", "estimation"])
def test_nothing_is_known_where_no_run_gave_a_metric(tmp_path, campaign):
    scenario = sbt.Scenario("never", [sbt.Parameter("a", 0, 1)], LOW, evaluate=_never, metrics=["m"])
    result = sbt.run(campaign=campaign, scenario=scenario, budget=10, seed=1, store=tmp_path / "s", executor="serial")
    shown = CliRunner().invoke(app, ["status", str(tmp_path / "s")]).stdout
    first = "Nothing is known of never: none of 10 runs gave a metric."
    assert result.sentences()[0] == first
    assert first in " ".join(shown.split())
    assert not any("tenfold" in sentence for sentence in result.sentences())


def test_where_all_is_critical_a_boundary_says_to_widen(tmp_path):
    scenario = sbt.Scenario("all", [sbt.Parameter("a", 0, 1)], LOW, evaluate=_low, metrics=["m"])
    result = sbt.run(
        campaign="boundary",
        scenario=scenario,
        budget=20,
        seed=1,
        store=tmp_path / "s",
        executor="serial",
        metamodel={"kind": "gp"},
    )
    said = tell_boundary(result.conclusion, CriticalShare(1.0, 0.9, 1.0, 0.95, 20), Facts.of(result.history, result.scenario))
    assert np.all(result.history.y("m") < 0)
    assert "an uncritical region" in said[1]
    assert "widen the ranges" in said[2]


def test_a_repetition_without_a_metric_is_not_told_as_uncritical(tmp_path):
    """Nor as a simulator without noise."""

    def often_lost(values, seed):
        if np.random.default_rng(seed).random() < 0.5:
            raise sbt.RunError("failed", "bad luck")
        return {"m": abs(values["a"] - 0.5) - 0.2}

    scenario = sbt.Scenario("lost", [sbt.Parameter("a", 0, 1)], LOW, evaluate=often_lost, metrics=["m"])
    result = sbt.run(campaign="falsification", scenario=scenario, budget=30, seed=1, store=tmp_path / "s", executor="serial")
    mode, said = result.conclusion.failure_modes[0], " ".join(result.sentences())
    again = mode.confirmation_runs - mode.confirmations_lost
    assert mode.confirmed == 1.0
    assert f"{again} of the {again} repetitions with fresh seeds that gave a metric ({mode.confirmations_lost} gave none)" in said
    assert "did not all fail" not in said
    assert "No noise was met" not in said
    assert "The seed decides, too, whether a run fails: at " in said


def test_sums_over_all_combinations_have_derivatives_with_an_error(tmp_path):
    """It was 0, although no repeat proves that seeds decide nothing."""
    from sbt.workflows.asking import estimate_again

    inputs = [sbt.Parameter("n", 1, 6, kind="integer"), sbt.Parameter("c", choices={"a": 0.8, "b": 0.2})]
    scenario = sbt.Scenario(
        "few", inputs, LOW, evaluate=lambda values, seed: {"m": values["n"] - 3.5 + (values["c"] == "b")}, metrics=["m"]
    )
    result = sbt.run(campaign="estimation", scenario=scenario, budget=40, seed=1, store=tmp_path / "s", executor="serial")
    told = estimate_again(result.store, objects=result.objects).sensitivity
    assert told
    assert all(each.std_error > 0.0 for each in told)


def test_held_out_runs_that_fail_tell_nothing_of_the_share_among_those_that_give_a_metric():
    share = CriticalShare(0.5, 0.0252, 0.975, 0.95, 10, 6)
    given = share.given_a_metric
    assert (given.counted, given.lost) == (4, None)
    assert (given.low, given.high) == pytest.approx((0.0676, 0.9324), abs=1e-4), "2 of 4"
    assert CriticalShare(0.5, 0.2, 0.8, 0.95, 10).given_a_metric.counted == 10
    found = BoundaryConclusion(0.4, 0.01, 0.1, None, failing_fraction=0.5)
    said = " ".join(tell_boundary(found, share, Facts(History.of(("a",)), LOW, "m", "s")))
    assert "of what gives a metric" in said
    assert "the 4 held-out runs that gave one alone say 50" in said


@pytest.mark.parametrize("safe", [0, 9])
def test_that_nearly_all_is_critical_does_not_deny_the_runs_that_were_not(safe):
    """The weights of draws may sum to more than 1 although some were safe: P is not 1 then, and these runs were met."""
    rows, n = Rows(("a",)), 60
    rows.append(np.zeros((n, 1)), {"status": ["ok"] * n, "index": range(n)}, [{"m": 1.0 if k < safe else -1.0} for k in range(n)])
    all_but = {**NARROW, "probability": 1.0, "low": 0.905, "high": 1.0, "hits": 58, "failed_as_critical": 1.0}
    said = tell_estimation(EstimationConclusion(**all_but), Facts(rows.history(), LOW, "m", "s"))
    assert ("which no run met" in said[1]) == (safe == 0)
    assert ("is 1 (" in said[0]) == (safe == 0)
    assert safe == 0 or ("is at least 0.905" in said[0] and "9 runs were not critical" in said[1])


class _Cars:
    """Critical by an input, what the seed draws and tells, and noise."""

    def __call__(self, values, seed):
        return {"m": values["a"] + self.known_before(values, seed)["w"] + 0.2 * stream(seed, "driver").standard_normal() + 0.9}

    def known_before(self, values, seed):
        return {"w": float(stream(seed, "car").standard_normal())}


@pytest.mark.parametrize(("budget", "covariates"), [(12, True), (80, True), (80, False)])
def test_a_failed_run_is_told_to_count_where_the_interval_depends_on_it(tmp_path, budget, covariates):
    """And only there: those of stages that search, learn or repeat were told to be in the upper end."""
    scenario = sbt.Scenario("cars", [sbt.Parameter("a", 0, 1)], LOW, evaluate=_Cars(), metrics=["m"])
    store = sbt.run(
        campaign="estimation", scenario=scenario, budget=budget, seed=2, covariates=covariates, store=tmp_path / "s",
        stop={"cov": None}, executor="serial", report=False,
    ).store  # fmt: skip
    with Store.read(store) as opened:
        study = Study.from_store(opened, objects={("scenarios", "object:cars"): scenario}, live=True)
        history, iterations = opened.history(), tuple(opened.iterations())

    def concluded(failed):
        columns = {**history.columns, "status": np.where(failed, "failed", history.columns["status"]).astype(object)}
        columns["y.m"] = np.where(failed, np.nan, columns["y.m"])
        found, _ = study.campaign.conclude(Log(replace(history, columns=columns), iterations, ()))
        return found

    safe, told = ~LOW.critical_runs(history), set()
    before = concluded(np.zeros(len(history), dtype=bool))
    for stage in np.unique(history.stage[safe]):
        row = np.flatnonzero(safe & (history.stage == stage))[-1]
        found = concluded(np.arange(len(history)) == row)
        counts = "the upper end" in found.warnings[0]
        assert counts or found.warnings[0] == f"1 of {budget} runs failed, none of them a draw that counts"
        assert counts == ((before.high, before.low) != (found.high, found.low)), stage
        told.add(counts)
    assert budget < 80 or told == {True, False}


def test_failed_runs_are_told_apart_by_whether_they_count():
    assert failed_runs(0, 0, 9) == ()
    (every,) = failed_runs(2, 2, 9)
    assert every == "2 of 9 runs failed: the estimate and its lower end count them as safe, the upper end as critical"
    (some,) = failed_runs(1, 3, 9)
    assert some.startswith("3 of 9 runs failed: the estimate and its lower end count 1 of them as safe")
    assert some.endswith("the others are no draws that count")
    (apart,) = failed_runs(1, 3, 9, beside=2)
    assert apart == "3 of 9 runs failed: the estimate and its lower end count 1 of them as safe, the upper end 3 as critical"
    (only,) = failed_runs(0, 3, 9, beside=2)
    assert only == "3 of 9 runs failed: the upper end counts 2 of them as critical; the others are no draws that count"


def test_failed_runs_decide_an_upper_end_of_whose_distance_they_make_up_half():
    assert narrower(0.02, 0.07, 0.1, "more runs").startswith("failed runs decide the width of the interval")
    first = narrower(0.02, 0.03, 0.09, "more runs")
    assert first.startswith("more runs bring the upper end of the interval, 0.09, to about 0.03, as far as these tell")


@pytest.mark.parametrize(
    "kind", [{}, {"cov": 0.3, "hits": 4}, {"cov": 0.02, "hits": 400}, {"gate": GateVerdict("undecided", 0.1, 0.95, 0.3, 0.0, "")}]
)
@pytest.mark.parametrize(("p", "n"), [(0.157, 150), (0.02, 300), (0.9, 200), (0.0, 100)])
def test_crude_draws_are_advised_wherever_their_interval_would_be_clearly_narrower(p, n, kind):
    """Whatever else is advised: of an estimate that others would have narrowed it was told only where the upper end was high."""
    rows = Rows(("a",))
    rows.append(np.zeros((n, 1)), {"status": ["ok"] * n, "index": range(n)}, [{"m": 1.0}] * n)
    facts, (low, high) = Facts(rows.history(), LOW, "m", "s"), map(float, binomial.interval(n * p, n))
    for times in (0.5, 1.0, 1.4, 1.6, 3.0):
        ends = {"low": max(p - times * (p - low), 0.0), "high": min(p + times * (high - p), 1.0)}
        wide = ends["high"] - ends["low"] > 1.5 * (high - low) or ends["high"] > 1.5 * high
        bound = {"exact_bound": ends["high"], "hits": 0} if p == 0.0 else {}
        given = {**NARROW, **kind, "probability": p, "failed_as_critical": p, **ends, **bound}
        said = tell_estimation(EstimationConclusion(**given), facts)[2]
        assert ("would bound it better (acquisition: {kind: monte_carlo})" in said) == wide, said


@pytest.mark.parametrize(("critical", "lost"), [(0.3, 0.0), (0.35, 0.02), (0.27, 0.12), (0.5, 0.05)])
def test_as_many_runs_as_are_promised_halve_an_interval(critical, lost):
    """Of 100 runs of which 12 fail it was said that 300 more would; they took it from .316 to .230."""

    def ends(n):
        return float(interval(round(critical * n), n)[0]), float(interval(round((critical + lost) * n), n)[1])

    low, high = ends(400)
    more = runs_to_halve(round(lost * 400), 400, low, high)
    if lost >= 0.5 * (high - low):
        assert more == math.inf
        low, high = ends(10**9)
        assert high - low >= lost
        return
    after = ends(400 + round(more))
    assert after[1] - after[0] == pytest.approx(0.5 * (high - low), rel=0.03)


def test_what_is_infinite_or_single_is_told_as_it_is(tmp_path):
    inputs = [sbt.Parameter("n", 1, 2, kind="integer")]
    endless = sbt.Scenario("endless", inputs, LOW, evaluate=lambda v, seed: {"m": math.inf})
    said = sbt.run(campaign="falsification", scenario=endless, budget=9, store=tmp_path / "i", executor="serial", report=False)
    assert "(m inf)" in " ".join(said.sentences())
    half = [sbt.Parameter("a", 0, 1)]
    deep = sbt.Scenario("deep", half, LOW, evaluate=lambda v, seed: {"m": -math.inf if v["a"] > 0.4 else 1.0})
    said = sbt.run(campaign="falsification", scenario=deep, budget=9, store=tmp_path / "d", executor="serial", report=False)
    assert "(m -inf)" in " ".join(said.sentences())
    assert "1 of all 2 combinations of the inputs of two is critical" in EveryCombination(2, 1).sentences("two", "m ≤ 0")[0]

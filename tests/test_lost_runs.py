"""What conclusions say where runs give no metric, and where an interval is wider than asked."""

import numpy as np
import pytest
from typer.testing import CliRunner

import sbt
from sbt.campaigns.boundary import BoundaryConclusion
from sbt.campaigns.clustering import Spread
from sbt.campaigns.estimation import EstimationConclusion
from sbt.campaigns.parts import CriticalShare
from sbt.campaigns.telling import tell_boundary, tell_estimation, tell_share
from sbt.cli import app
from sbt.loop.stages import Facts
from sbt.problem.requirement import Requirement
from sbt.store.history import History, Rows

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
    again = round(mode.confirmed * mode.confirmation_runs)
    assert again + mode.confirmations_lost == mode.confirmation_runs
    assert f"{again} of the {again} repetitions with fresh seeds that gave a metric ({mode.confirmations_lost} gave none)" in said
    assert "did not all fail" not in said
    assert "No noise was met" not in said
    assert "may give a metric or none" in said


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

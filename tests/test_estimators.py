"""Laws of the estimators: unbiased for any metamodel, weights fixed in advance, bounds that are exact."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from scipy.special import gammaincinv, log_ndtr, ndtr
from scipy.stats import binomtest, chi2

from sbt.campaigns.pools import Frame, draw_batch, draw_pool, fit_proposal
from sbt.campaigns.stopping import spared
from sbt.campaigns.teaching import select_teaching
from sbt.estimators.binomial import interval, lower, upper
from sbt.estimators.choices import log_normal
from sbt.estimators.events import FailingLogProbability, events
from sbt.estimators.importance import BLIND, SHARES, draw_systematic, plan_batch, stated
from sbt.estimators.intervals import FEWEST_HITS, CountedBatch, combine_estimates
from sbt.estimators.mixture import Mixture, Near, Normals, fit_mixture, particles, wide_scales, within_reach
from sbt.estimators.monte_carlo import Proportion
from sbt.estimators.subset import SubsetRun, combine_repeats, has_levels, next_levels
from sbt.estimators.subspace import find_subspace, inputs_that_matter
from sbt.estimators.surrogate import JointLogProbability
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.problem.combination import all_of, any_of
from sbt.problem.distribution import Normal, Triangular
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.space import ParameterSpace
from sbt.seeds import stream
from sbt.testbeds import from_name

WIDE = wide_scales(np.zeros(2))
TRUTH = ndtr(-2.0)  # of x1 > 2


def wrong(z):
    """A metamodel that is wrong everywhere: it takes the failure to lie at x2 > 1.5, and is nearly sure of that."""
    pi = np.clip(0.9 * (z[:, 1] > 1.5) + 0.02, 0.0, 1.0)
    return np.log(pi), np.log1p(-pi)


def nothing(z):
    """A metamodel that gives no failure any probability."""
    return np.full(len(z), -60.0), np.full(len(z), -1e-26)


H = Mixture(WIDE, Normals(np.ones(1), np.array([[2.2, 0.5]]), np.eye(2)[None]))


def replicate(predict, rng, *, form=None, n=20, shares=SHARES):
    """Return one batch on the line x1 = 2 with a fresh, rather small pool."""
    z, stratum = H.sample(300, rng)
    log_h = H.log_density(z)
    log_pi, log_not = predict(z)
    plan = plan_batch(log_pi, log_not, log_normal(z) - log_h, log_normal(z, WIDE) - log_h, stratum, shares, form)
    draws = draw_systematic(plan, n, log_pi, rng)
    critical = (z[draws.rows, 0] > 2.0).astype(float)
    return CountedBatch(plan.prior, plan.anticipated, plan.pool_variance, draws.coefficient, draws.control_variate, critical)


@pytest.mark.parametrize("form", [None, "meta"])
@pytest.mark.parametrize("predict", [wrong, nothing])
def test_unbiased_with_a_wrong_metamodel(predict, form):
    rng = stream(1, "unbiased")
    values = np.array([replicate(predict, rng, form=form).value for _ in range(250)])
    error = values.std(ddof=1) / math.sqrt(len(values))
    assert abs(values.mean() - TRUTH) < 3 * error
    assert error < 0.5 * TRUTH  # the law says something


def test_both_readings_of_failed_runs_are_unbiased_with_wrong_metamodels():
    """Runs fail where x2 > 0, half of them; the metamodels are wrong about where, and about what is critical."""
    rng, values = stream(1, "failing"), []
    for _ in range(250):
        z, stratum = H.sample(300, rng)
        log_h = H.log_density(z)
        event = events(FailingLogProbability(wrong, lambda at: np.clip(0.9 * (at[:, 0] < 0.5), 0.05, 0.95)), z)[0]
        assert event.critical is not None
        given = log_normal(z) - log_h, log_normal(z, WIDE) - log_h, stratum
        plan = plan_batch(*event.safe, *given, others=(event.critical,))
        draws = draw_systematic(plan, 20, z[:, 0], rng)
        at, fails, worst = draws.rows, z[draws.rows, 1] > 0.0, stated(event.critical, plan, stratum)
        met = (z[at, 0] > 2.0) & ~fails
        safe = CountedBatch(plan.prior, plan.anticipated, 0.0, draws.coefficient, draws.control_variate, met.astype(float))
        critical = CountedBatch(worst.prior, worst.anticipated, 0.0, draws.coefficient, worst.pi[at], (met | fails).astype(float))
        values.append((safe.value, critical.value))
    mean, error = np.mean(values, axis=0), np.std(values, axis=0, ddof=1) / math.sqrt(len(values))
    truth = np.array([0.5 * TRUTH, 0.5 + 0.5 * TRUTH])
    assert (np.abs(mean - truth) < 3 * error).all()
    assert (error < 0.5 * truth).all()


def test_draws_for_a_further_event_take_half_of_the_guided_ones_at_most():
    z, stratum = H.sample(300, stream(15, "further"))
    log_h = H.log_density(z)
    given = log_normal(z) - log_h, log_normal(z, WIDE) - log_h, stratum
    there = z[:, 1] < -1.5  # where the further event is uncertain
    further = np.log(np.where(there, 0.5, 1e-6)), np.log(np.where(there, 0.5, 1.0))
    alone, both = (plan_batch(*wrong(z), *given, others=others) for others in ((), (further,)))
    assert both.probability[there].sum() > 1.5 * alone.probability[there].sum()
    assert (both.probability > 0.5 * alone.probability).all()


def test_the_mean_of_p_over_q_is_one():
    rng = stream(2, "weights")
    means = np.array([replicate(wrong, rng, n=50).coefficient.mean() for _ in range(120)])
    assert abs(means.mean() - 1.0) < 3 * means.std(ddof=1) / math.sqrt(len(means))


@pytest.mark.parametrize("shares", [SHARES, BLIND])
def test_the_defence_bounds_the_weights(shares):
    assert sum(shares) == pytest.approx(1.0)
    assert replicate(wrong, stream(3, "bounded"), shares=shares).coefficient.max() <= 1.05 / shares[1]


@pytest.mark.parametrize("once", [True, False])
def test_every_pool_point_is_expected_as_often_as_its_probability_says(once):
    """Also where belief is sharp: one of 60 points would be drawn three times of ten, and is drawn once where that is asked."""
    rng = stream(4, "systematic")
    z, stratum = Mixture(WIDE).sample(60, rng)
    log_h = Mixture(WIDE).log_density(z)
    pi = np.where(np.arange(60) == np.argmin((z**2).sum(axis=1)), 0.5, 1e-4)
    plan = plan_batch(np.log(pi), np.log1p(-pi), log_normal(z) - log_h, log_normal(z, WIDE) - log_h, stratum)
    counts, most, drawn = np.zeros(60), 0, []
    for _ in range(3000):
        drawn.append(draw_systematic(plan, 10, z[:, 0], rng, once=once))
        found = drawn[-1].rows
        counts += np.bincount(found, minlength=60)
        most = max(most, np.bincount(found[drawn[-1].nominal :]).max())
    expected = sum(10 * each.plan.probability for each in drawn)
    assert np.all(np.abs(counts - expected) < 5 * np.sqrt(expected) + 5)
    assert bool(most == 1) is once


def test_the_mixture_has_the_density_it_claims():
    rng = stream(5, "mixture")
    cloud = rng.standard_normal((400, 2)) * np.array([0.3, 1.0]) + np.array([3.0, -1.0])
    h = fit_mixture((cloud, cloud - np.array([6.0, 0.0])), WIDE, rng)
    z, _ = h.sample(40_000, rng)
    ratio = np.exp(log_normal(z) - h.log_density(z))
    assert ratio.mean() == pytest.approx(1.0, abs=4 * ratio.std() / 200)
    far = log_normal(z - [3.0, -1.0], np.array([0.3, 1.0]))  # a density that h was fit_mixture to
    ratio = np.exp(far - h.log_density(z))
    assert ratio.mean() == pytest.approx(1.0, abs=4 * ratio.std() / 200)


def test_a_subspace_leaves_the_rest_of_the_inputs_as_they_are():
    rng = stream(11, "subspace")
    z = rng.standard_normal((200, 30))
    slope = np.arange(1.0, 31.0) / np.linalg.norm(np.arange(1.0, 31.0))
    found = find_subspace(z, 2.0 - z @ slope, ())
    assert abs(float(found.basis[0] @ slope)) == pytest.approx(1.0, abs=1e-6)
    lifted = found.lift(np.full((4000, 1), 5.0), rng)
    assert np.allclose(found.reduce(lifted), 5.0)
    rest = lifted - 5.0 * found.basis
    assert (rest**2).sum(axis=1).mean() == pytest.approx(29.0, abs=4 * math.sqrt(2 * 29 / 4000))


def test_a_sphere_has_no_subspace_and_a_plane_has():
    gp, z = GaussianProcess(nu=2.5, input_noise=False), stream(13, "sphere").standard_normal((120, 24))
    axes, explained = inputs_that_matter(gp, z, z @ np.linspace(0.1, 1.0, 24), stream(14, "plane"))
    assert axes == ()
    assert explained > 0.95
    assert inputs_that_matter(gp, z, (z**2).sum(axis=1), stream(14, "sphere"))[1] < 0.5


def test_the_pool_of_a_sharp_belief_in_ten_inputs_is_precise():
    """P = 1e-7: fitted to particles of a few ancestors alone, the error of the pool was up to 14 %."""
    plane, space = np.ones(10) / math.sqrt(10.0), from_name("linear_d10", Path()).space

    def belief(z):
        beyond = (z @ plane - 5.2) / 1e-3
        return log_ndtr(beyond), log_ndtr(-beyond)

    hits = stream(12, "hits").standard_normal((300, 10)) * 3.0
    hits = hits[hits @ plane > 5.2]
    frame, plans = Frame(wide_scales(np.zeros(10))), []
    for k in range(5):
        rng = stream(12, "sharp", k)
        plans.append(draw_pool(space, frame, fit_proposal(space, frame, belief, hits, SHARES, rng), SHARES, rng).plan)
    assert np.median([math.sqrt(plan.pool_variance) for plan in plans]) < 0.05 * ndtr(-5.2)
    assert np.median([abs(plan.prior - ndtr(-5.2)) for plan in plans]) < 0.1 * ndtr(-5.2)


def test_particles_follow_their_target():
    rng = stream(9, "particles")
    start = Near(Mixture(WIDE), np.empty((0, 2)))
    found = particles(lambda v: np.where(v[:, 0] > 2.0, log_normal(v), -np.inf), start, 800, rng, 2000)
    assert (found[:, 0] > 2.0).all()
    assert found[:, 0].mean() == pytest.approx(2.373, abs=0.06)  # phi(2) / Phi(-2)
    assert found[:, 1].std() == pytest.approx(1.0, abs=0.12)


def batch(values, anticipated=0.0):
    critical = np.asarray(values, dtype=float)
    return CountedBatch(0.0, anticipated, 0.0, np.ones(len(critical)), np.zeros(len(critical)), critical)


def test_weights_of_batches_look_at_no_result():
    """Inverse variance would give nearly all weight to the calm batch."""
    calm, wild = batch([0.1] * 10), batch([0.0] * 9 + [5.0])
    c = np.array([1.0, math.sqrt(2.0)]) / (1.0 + math.sqrt(2.0))
    assert combine_estimates([calm, wild]).value == pytest.approx(c @ [0.1, 0.5])
    assert combine_estimates([wild, calm]).value == pytest.approx(c @ [0.5, 0.1])


def test_the_interval_takes_what_the_metamodel_anticipates_until_outcomes_speak():
    alike = combine_estimates([batch([0.5] * 5) for _ in range(5)])
    assert alike.std_error == pytest.approx(0.0, abs=1e-12)
    few = combine_estimates([batch([0.5] * 5, anticipated=1.0) for _ in range(5)])
    many = combine_estimates([batch([0.5] * 50, anticipated=10.0) for _ in range(5)])  # the same variance of a batch
    assert few.own > many.own > 0.0
    assert few.own < math.sqrt(1.0 / 25)  # 25 calm outcomes count for more than what was anticipated
    doubtful = combine_estimates([batch([0.0, 1.0] * 10, anticipated=0.01) for _ in range(5)])
    assert doubtful.own == pytest.approx(math.sqrt(0.25 / 95 * 1.02), rel=0.03)  # a variance that was met is believed


def test_the_interval_takes_the_variance_between_batches_too():
    c = combine_estimates([batch([v] * 5) for v in (0.1, 0.9, 0.2, 0.8)])
    assert c.std_error == c.between > 0.1
    assert c.limit(0.975, side=-1) < c.limit(0.9, side=-1) < c.value < c.limit(0.9, side=1) < c.limit(0.975, side=1)


def test_a_variance_that_one_error_decides_has_few_observations():
    calm = combine_estimates([batch([0.0, 1.0] * 10) for _ in range(5)])
    wild = combine_estimates([batch([0.0] * 20) for _ in range(4)] + [batch([0.0] * 19 + [8.0])])
    assert calm.freedom > 40.0
    assert wild.freedom == 3.0


@pytest.mark.parametrize("scale", [1e-150, 1e-120, 1e60])
def test_degrees_of_freedom_have_no_scale(scale):
    """Nothing critical ever, and a metamodel that knows it: errors whose fourth powers are too small for a float."""
    some, scaled = (combine_estimates([batch(np.array([1.0, 2.0, 3.0]) * s) for _ in range(4)]) for s in (1.0, scale))
    assert scaled.freedom == pytest.approx(some.freedom)


@pytest.mark.parametrize("hits", [1, 4, 9])
def test_with_few_hits_the_interval_is_also_that_of_their_number(hits):
    found = combine_estimates([batch([1.0] * hits + [0.0] * (1000 - hits))])
    low, high = (found.limit(0.975, side=side, few=True) for side in (-1, 1))
    assert low <= gammaincinv(hits, 0.025) / 1000
    assert high >= gammaincinv(hits + 1, 0.975) / 1000
    safe = combine_estimates([batch([0.0] * hits + [1.0] * (1000 - hits))])
    mirrored = [1.0 - safe.limit(0.975, side=side, few=True) for side in (1, -1)]
    assert mirrored == pytest.approx([low, high], abs=1e-9)


@pytest.mark.parametrize("excess", [0.0, 0.004, 0.009])
def test_an_estimate_that_corrections_take_to_nothing_keeps_the_width_of_its_hits(excess):
    """One hit of 166 draws: whatever a metamodel claimed and draws took back, the limit is that of the hit alone."""
    x = np.array([1.0] + [0.0] * 165)
    claimed = CountedBatch(0.0, 0.0, 0.0, np.ones(166), np.full(166, 1 / 166 + excess), x)
    found = combine_estimates([claimed])
    assert found.value <= 0.0 + 1e-12
    assert found.limit(0.975, side=1, few=True) >= gammaincinv(2.0, 0.975) / 166 - 1e-12
    assert found.limit(0.975, side=-1, few=True) == 0.0
    mirrored = combine_estimates([CountedBatch(1.0, 0.0, 0.0, np.ones(166), np.full(166, 165 / 166 - excess), 1.0 - x)])
    assert mirrored.limit(0.975, side=-1, few=True) <= 1.0 - gammaincinv(2.0, 0.975) / 166 + 1e-12


@pytest.mark.parametrize("stop", [False, True])
def test_intervals_cover_with_a_wrong_metamodel_and_optional_stopping(stop):
    """The metamodel denies most of the failures: corrections are rare and large. 95 % is meant, 0.91 is 2.6 errors below."""
    rng, covered, halves, values = stream(10, "coverage"), [], [], []
    for _ in range(200):
        batches = [replicate(wrong, rng, n=13) for _ in range(4)]
        found = combine_estimates(batches)
        while stop and len(batches) < 8 and found.std_error > 0.3 * abs(found.value):
            batches.append(replicate(wrong, rng, n=13))
            found = combine_estimates(batches)
        low, high = found.limit(0.975, side=-1), found.limit(0.975, side=1)
        covered.append(low <= TRUTH <= high)
        halves.append(0.5 * (high - low))
        values.append(found.value)
    assert np.mean(covered) >= 0.91
    assert np.median(halves) < 2.0 * 1.96 * np.std(values)


def test_the_nominal_draws_are_the_first_and_their_share_is_exact():
    rng = stream(11, "nominal")
    z, stratum = H.sample(300, rng)
    log_h = H.log_density(z)
    plan = plan_batch(*wrong(z), log_normal(z) - log_h, log_normal(z, WIDE) - log_h, stratum)
    drawn = [draw_systematic(plan, 13, z[:, 0], rng) for _ in range(2000)]
    counts = np.array([d.nominal for d in drawn])
    assert set(counts) == {2, 3}
    assert counts.mean() == pytest.approx(13 * SHARES[1], abs=0.05)
    first = np.concatenate([d.rows[: d.nominal] for d in drawn])
    expected = float(plan.nominal_probability @ (z[:, 0] > 1.0))
    assert (z[first, 0] > 1.0).mean() == pytest.approx(expected, abs=0.02)  # as in the inputs' distribution


def right(z):
    """A metamodel that knows the line x1 = 2 but for a hundredth."""
    return log_ndtr((z[:, 0] - 2.0) / 0.01), log_ndtr((2.0 - z[:, 0]) / 0.01)


def test_precision_beyond_what_is_asked_goes_to_the_inputs_distribution():
    z, stratum = H.sample(3000, stream(13, "spared"))
    log_h = H.log_density(z)
    given = log_normal(z) - log_h, log_normal(z, WIDE) - log_h, stratum
    plan = plan_batch(*right(z), *given)
    shares = spared(plan, SHARES, 65.0, 0.1)
    assert sum(shares) == pytest.approx(1.0)
    assert shares[2:] == SHARES[2:]
    assert shares[1] > 0.45
    moved, again = plan.moved(shares[1] - SHARES[1]), plan_batch(*right(z), *given, shares)
    assert moved.probability == pytest.approx(again.probability, rel=1e-9, abs=1e-15)
    assert (moved.nominal, moved.anticipated) == pytest.approx((again.nominal, again.anticipated))
    assert again.anticipated > plan.anticipated  # it is precision that is spent, and not all of it
    assert math.sqrt(again.anticipated / 65.0) < 0.05 * again.predicted
    assert 65.0 * again.hits >= FEWEST_HITS
    for draws, target in [(65.0, 1e-4), (15.0, 0.1)]:  # what was asked is not reached; too few critical draws would be left
        assert spared(plan, SHARES, draws, target) == SHARES


def test_runs_that_teach_leave_less_doubt_far_from_a_run_than_draws_and_keep_the_nominal_share():
    rng = stream(12, "teaching")
    z, stratum = H.sample(3000, rng)
    log_h = H.log_density(z)
    plan = plan_batch(*wrong(z), log_normal(z) - log_h, log_normal(z, WIDE) - log_h, stratum)
    runs = z[draw_systematic(plan, 30, z[:, 0], rng).rows]

    def doubt_left(rows):
        return plan.guided @ cdist(z, np.vstack([runs, z[rows]]), "sqeuclidean").min(axis=1)

    chosen = [select_teaching(plan, 13, z, runs, rng) for _ in range(200)]
    drawn = [draw_systematic(plan, 13, z[:, 0], rng).rows for _ in range(200)]
    assert {len(rows) for rows, _ in chosen} == {13}
    assert max(doubt_left(rows) for rows, _ in chosen) < np.mean([doubt_left(rows) for rows in drawn])
    assert np.mean([first for _, first in chosen]) == pytest.approx(13 * SHARES[1], abs=0.15)
    first = np.concatenate([rows[:first] for rows, first in chosen])
    assert (z[first, 0] > 0.0).mean() == pytest.approx(float(plan.nominal_probability @ (z[:, 0] > 0.0)), abs=0.08)
    sharp = replace(plan, guided=np.eye(len(z))[0])  # one point holds all the doubt: the others are draws
    assert len(select_teaching(sharp, 13, z, runs, rng)[0]) == 13


def test_meta_is_says_what_the_metamodel_predicts():
    """Its own first sum is zero: taken for the prediction, it would look infinitely imprecise."""
    z, stratum = H.sample(300, stream(12, "meta"))
    log_h = H.log_density(z)
    known = (*wrong(z), log_normal(z) - log_h, log_normal(z, WIDE) - log_h, stratum)
    meta, difference = (plan_batch(*known, form=form) for form in ("meta", "difference"))
    assert (meta.prior, difference.prior) == (0.0, difference.predicted)
    assert meta.predicted == difference.predicted > 0.0


@pytest.mark.parametrize("n", [1, 20, 3000])
@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.999])
def test_exact_binomial_limits_against_scipy(n, confidence):
    hits = np.unique([0, 1, n // 3, n - 1, n])
    limits = [interval(hits, n, confidence), (lower(hits, n, confidence), upper(hits, n, confidence))]
    for side, (low, high) in zip(("two-sided", "one-sided"), limits, strict=True):
        for k, hit in enumerate(hits):
            # at most p, at least p: SciPy solves the tails of the binomial distribution themselves
            least, most = (binomtest(int(hit), n, alternative=a) for a in ("greater", "less"))
            if side == "two-sided":
                least = most = binomtest(int(hit), n)
            truth = least.proportion_ci(confidence, method="exact").low, most.proportion_ci(confidence, method="exact").high
            assert (low[k], high[k]) == pytest.approx(truth, rel=1e-9, abs=1e-12)


def test_exact_binomial_limits_without_runs_or_hits_and_in_any_shape():
    assert [float(end) for end in interval(0, 0)] == [0.0, 1.0]
    assert (float(lower(0, 0, 0.9)), float(upper(0, 0, 0.9))) == (0.0, 1.0)
    assert float(upper(0, 100, 0.95)) == pytest.approx(1 - 0.05 ** (1 / 100), rel=1e-12)
    low, high = interval([[0, 3], [7, 20]], [20, 20])
    assert low.shape == high.shape == (2, 2)
    for (i, j), hit in np.ndenumerate([[0, 3], [7, 20]]):
        assert (low[i, j], high[i, j]) == tuple(map(float, interval(hit, 20)))


def test_crude_monte_carlo_covers():
    rng, p = stream(6, "crude"), 0.03
    shares = [Proportion(100, int(rng.binomial(100, p))) for _ in range(2000)]
    assert np.mean([s.lower(0.975) <= p <= s.upper(0.975) for s in shares]) >= 0.95
    assert Proportion(100, 2, failed=5).upper(0.9) == Proportion(100, 7).upper(0.9)
    assert Proportion(100, 2, failed=5).lower(0.9) == Proportion(100, 2).lower(0.9)


def test_subset_simulation_meets_a_plane_in_many_dimensions():
    truth = float(ndtr(-3.0))
    found = []
    for k in range(10):
        repeat, rng = SubsetRun(300, 30), stream(7, "subset", k)
        while not repeat.finished:
            z = repeat.ask(rng)
            repeat = repeat.tell(z, 3.0 - z.sum(axis=1) / math.sqrt(30))
        found.append(repeat.share)
    spread = combine_repeats(found)
    assert abs(spread.value - truth) < 3 * spread.std_error < 1.5 * truth


@pytest.mark.parametrize(
    "margin",
    [lambda s: 6.0 - np.floor(2.0 * s), lambda s: np.minimum(3.0 - s, 1.3), lambda s: 3.0 - np.floor(s)],
    ids=["halves", "capped", "whole"],
)
def test_subset_simulation_is_unbiased_where_values_are_equal(margin):
    """The deepest of all that reach a level began its chains: 2.2, 2.7 and 1.3 times the truth."""
    found = []
    for k in range(150):
        repeat, rng = SubsetRun(200, 2), stream(9, "ties", k)
        while not repeat.finished:
            z = repeat.ask(rng)
            repeat = repeat.tell(z, margin(z.sum(axis=1) / math.sqrt(2)))
        found.append(repeat.share)
    spread, truth = combine_repeats(found), float(ndtr(-3.0))
    assert abs(spread.value - truth) < 3 * spread.std_error + 0.1 * truth < 0.6 * truth


def _repeats(n: int, margin, seed: int, most: int = 10**6) -> list[SubsetRun]:
    """Five repeats in 20 inputs that set each other's levels, until they end or the next step needs more than `most` runs."""
    repeats, spent = [SubsetRun(n, 20, alone=False) for _ in range(5)], 0
    rngs = [stream(seed, "others", k) for k in range(5)]
    while (width := sum(r.width for r in repeats if r.asks)) and spent + width <= most:
        z = [r.ask(rng) if r.asks else None for r, rng in zip(repeats, rngs, strict=True)]
        told = [r if at is None else r.tell(at, margin(at)) for r, at in zip(repeats, z, strict=True)]
        repeats, spent = next_levels(told), spent + width
    return repeats


@pytest.mark.slow
@pytest.mark.parametrize(
    ("margin", "p"),
    [
        (lambda z: chi2(20).isf(1e-3) - (z**2).sum(axis=1), 1e-3),
        (lambda z: 3.0 - np.floor(z.sum(axis=1) / math.sqrt(20)), float(ndtr(-3.0))),
    ],
    ids=["sphere", "whole"],
)
def test_levels_that_other_repeats_set_leave_no_bias(margin, p):
    """With 80 points a level, own levels gave 1.35 times the truth of the first one."""
    groups = [combine_repeats([r.estimate for r in _repeats(80, margin, seed)]) for seed in range(100)]
    spread = combine_repeats([g.value for g in groups])
    assert abs(spread.value - p) < 2.5 * spread.std_error < 0.25 * p
    assert np.mean([g.limit(0.975, side=-1) <= p <= g.limit(0.975, side=1) for g in groups]) >= 0.9


@pytest.mark.slow
def test_upper_limits_of_few_chains_hold():
    """150 points of five repeats a level (budget 600): 13 of 100 ended below P, of 5 allowed."""
    p = 1e-3

    def margin(z):
        return chi2(20).isf(p) - (z**2).sum(axis=1)

    found = [combine_repeats([r.estimate for r in _repeats(30, margin, seed, most=600)]) for seed in range(300)]
    assert np.mean([each.limit(0.95, side=1) < p for each in found]) <= 0.075
    assert np.mean([each.limit(0.95, side=-1) > p for each in found]) <= 0.05


def test_limits_of_repeats():
    """The cube root of a mean of normal cube roots: by 10^7 draws of their mean and variance."""
    found = combine_repeats([1e-3, 2e-3, 1.5e-3, 0.8e-3, 1.2e-3])
    for confidence, limit in ((0.6, 1.3865e-3), (0.9, 1.7266e-3), (0.99, 2.645e-3), (0.999, 5.10e-3)):
        assert found.limit(confidence, side=1) == pytest.approx(limit, rel=3e-3)
    same, alone, wide = (combine_repeats(v) for v in ([0.2, 0.2], [0.0, 0.0, 0.0, 0.0, 0.5], [0.0, 1.0]))
    assert (same.limit(0.95, side=-1), same.limit(0.95, side=1)) == pytest.approx((0.2, 0.2))
    assert same.tells_spread
    assert not alone.tells_spread
    assert wide.limit(0.95, side=1) == 1.0
    assert alone.limit(0.51, side=1) >= alone.value


def test_repeats_that_the_budget_cuts_off_state_their_last_full_levels():
    """A tenth of the fourth level is critical; the budget is that of three, or of two where one took longer."""
    p = 2e-4

    def margin(z):
        return chi2(20).isf(p) - (z**2).sum(axis=1)

    found = [_repeats(80, margin, seed, most=1200) for seed in range(60)]
    assert np.mean([r.finished for repeats in found for r in repeats]) < 0.1  # few, that none of their points went on from
    spread = combine_repeats([r.estimate for repeats in found for r in repeats])
    assert abs(spread.value - p) < 2.5 * spread.std_error < 0.6 * p


def test_what_has_no_levels():
    assert has_levels(np.arange(100.0))
    assert has_levels(np.r_[np.arange(1.0, 8.0), np.full(93, 9.0)])  # the next lower value is one
    for margin in (np.ones(100), np.full(100, np.nan), np.r_[np.arange(1.0, 3.0), np.full(98, 9.0)], np.full(100, np.inf)):
        assert not has_levels(margin)


def test_subset_simulation_ends_on_a_plateau_and_without_a_run():
    for margin in (np.ones(100), np.full(100, np.nan)):
        assert all(r.finished and r.share == 0.0 for r in _repeats(100, lambda z, given=margin: given[: len(z)], 1))
        repeat = SubsetRun(100, 3)
        for _ in range(300):
            if repeat.finished:
                break
            z = repeat.ask(stream(8, "plateau"))
            repeat = repeat.tell(z, margin[: len(z)])
        assert repeat.finished
        assert repeat.share == 0.0


class Denied:
    """What a metamodel says of a metric that had one value in all runs: P of e^-1e6, and the more the farther out."""

    def __init__(self, sign: int):
        self.sign = sign

    def __call__(self, z):
        log_p = -1e6 / (1.0 + (z**2).sum(axis=1) / 100.0)
        return (log_p, np.log1p(-np.exp(log_p)))[:: self.sign]


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("how", [any_of, all_of])
def test_what_no_run_has_met_takes_no_share_of_a_pool(how, sign):
    """A requirement that none, or every, run violates: its share of the pool ran off to normal scores of 3,000."""

    def line(z):
        return log_ndtr(5.0 * (z[:, 0] - 2.5)), log_ndtr(5.0 * (2.5 - z[:, 0]))

    space = ParameterSpace(tuple(Parameter(name, -8.0, 8.0, "", Normal(0.0, 1.0)) for name in "ab"))
    critical = how(Requirement("ttc", low=0.0), Requirement("impact", low=0.0)).critical
    frame, hits = Frame(WIDE), np.array([[2.6, 0.0], [3.0, 1.0]])
    for metamodel in (JointLogProbability(critical, (line, Denied(sign))), Denied(sign)):
        proposal = fit_proposal(space, frame, metamodel, hits, SHARES, stream(1, "fit"))
        pool = draw_pool(space, frame, proposal, SHARES, stream(1, "draw"))
        normals = proposal.mixture.normals
        assert normals is None or within_reach(normals.mean).all()
        assert (pool.plan.weight > 0.0).mean() > 0.99
        runs, kept = draw_batch(space, pool, 200, stream(1, "batch"), counts=True)
        assert np.isfinite([run.log_q for run in runs]).all()
        assert min(kept.counted.coefficient) > 0.0


def test_points_without_density_are_never_drawn():
    """Of weight 0, and where a score is the end of a range at which a triangle has none; they were, with log q = inf, or -inf."""
    space = ParameterSpace((Parameter("a", 0.0, 10.0, "", Triangular(0.0, 3.0, 10.0)),))
    frame = Frame(wide_scales(np.zeros(1)))
    proposal = fit_proposal(space, frame, None, None, BLIND, stream(1, "fit"))
    pool = draw_pool(space, frame, proposal, BLIND, stream(1, "draw"))
    lost = ~np.isfinite(space.log_density(pool.x))
    assert lost.any()
    assert not pool.plan.probability[lost].any()
    runs, _ = draw_batch(space, pool, 2000, stream(1, "batch"), counts=True)
    assert np.isfinite([run.log_q for run in runs]).all()
    flat, far = np.full(4, np.log(0.5)), np.array([0.0, -1.0, -800.0, -np.inf])
    plan = plan_batch(flat, flat, far, np.zeros(4), np.zeros(4), others=((flat, flat),))
    assert (plan.probability > 0.0).tolist() == [True, True, False, False]


def test_draws_of_no_weight_are_neither_critical_nor_safe():
    batch = CountedBatch(0.0, 0.1, 0.0, np.array([1.0, 0.0, 2.0, 0.0]), np.zeros(4), np.array([1.0, 1.0, 0.0, 0.0]))
    assert (batch.hits, batch.misses) == (1, 1)

"""Laws of the sequence (position decides the point) and of rejection (the density is the score's)."""

from __future__ import annotations

import time
import warnings

import numpy as np
import pytest
from scipy import stats

from sbt.acquisitions import even
from sbt.errors import InputError
from sbt.metamodels.prediction import Prediction
from sbt.problem.requirement import CriticalInterval
from sbt.samplers.pool import PoolSequence
from sbt.samplers.roi import RoiDraw, rejection
from sbt.samplers.sobol import SobolSequence
from sbt.testing import check_sampler

SOBOL = SobolSequence(2, seed=3)


def hill(u: np.ndarray) -> np.ndarray:
    """A known acceptance a(u) = u_0 (1 - u_1)^2, as a log score."""
    return np.log(u[:, 0]) + 2 * np.log1p(-u[:, 1])


@pytest.mark.parametrize("dimension", [1, 2, 7, 24])
def test_position_decides_the_point(dimension):
    sequence = SobolSequence(dimension, seed=11)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        whole = sequence.points(0, 300)
        parts = np.concatenate([sequence.points(a, b) for a, b in ((0, 1), (1, 2), (2, 100), (100, 300))])
    np.testing.assert_array_equal(whole, parts)
    assert whole.shape == (300, dimension)
    assert ((whole > 0) & (whole < 1)).all()
    assert len(np.unique(whole[:, 0])) == 300
    assert sequence.points(5, 5).shape == (0, dimension)


def test_sequence_depends_on_the_seed_only():
    np.testing.assert_array_equal(SOBOL.points(0, 64), SobolSequence(2, seed=3).points(0, 64))
    assert not np.array_equal(SOBOL.points(0, 64), SobolSequence(2, seed=4).points(0, 64))


def test_sequence_is_balanced():
    u = SobolSequence(7, seed=0).points(0, 1024)
    np.testing.assert_array_equal(np.sort(np.floor(u * 1024), axis=0), np.arange(1024.0)[:, None] + np.zeros(7))


def test_far_positions_cost_little_and_stay_inside():
    sequence = SobolSequence(20, seed=0)
    sequence.points(0, 10)
    start = time.process_time()
    far = sequence.points(50_000_000, 50_000_010)
    assert time.process_time() - start < 1.0  # 0.01 s; the points before them would be 8 GB
    assert far.shape == (10, 20)
    assert ((far > 0) & (far < 1)).all()


@pytest.mark.parametrize(("start", "stop"), [(-1, 2), (3, 2), (0, 2**32 + 1)])
def test_positions_outside_are_refused(start, stop):
    with pytest.raises(InputError, match="positions must be"):
        SOBOL.points(start, stop)


def test_dimension_zero_is_refused():
    with pytest.raises(InputError, match="dimension"):
        SobolSequence(0, seed=0)


def test_even_is_the_sequence_itself():
    critical = CriticalInterval(high=0.0)
    draw = rejection(
        lambda u: even(Prediction.gaussian(np.zeros(len(u)), np.ones(len(u))), critical, np.zeros(len(u))),
        SOBOL, 700, start=40, seed=0, label=1,
    )  # fmt: skip
    np.testing.assert_array_equal(draw.u, SOBOL.points(40, 740))
    np.testing.assert_array_equal(draw.positions, np.arange(40, 740))
    assert (draw.next_position, draw.candidates, draw.method, draw.acceptance) == (740, 700, "rejection", 1.0)


def test_accepted_density_is_proportional_to_the_score():
    draw = rejection(hill, SOBOL, 4000, start=100, seed=5, label="law")
    counts, x, y = np.histogram2d(draw.u[:, 0], draw.u[:, 1], bins=5, range=[[0, 1], [0, 1]])
    mass = np.outer(np.diff(x**2), -np.diff((1 - y) ** 3))
    assert mass.sum() == pytest.approx(1.0)
    assert stats.chisquare(counts.ravel(), 4000 * mass.ravel()).pvalue > 0.01
    assert draw.method == "rejection"
    assert draw.acceptance == pytest.approx(1 / 6, rel=0.05)


@pytest.mark.parametrize("chunk", [1, 37, 512, 100_000])
def test_chunks_do_not_change_the_draw(chunk):
    n = 20 if chunk == 1 else 200
    draws = [rejection(hill, SOBOL, n, start=7, seed=5, label=2, chunk=c) for c in (4096, chunk)]
    for name in ("u", "positions", "next_position", "candidates", "method", "acceptance"):
        np.testing.assert_array_equal(getattr(draws[0], name), getattr(draws[1], name))


def test_a_draw_goes_on_where_the_last_one_stopped():
    whole = rejection(hill, SOBOL, 100, start=0, seed=5, label=0)
    first = rejection(hill, SOBOL, 60, start=0, seed=5, label=0)
    second = rejection(hill, SOBOL, 40, start=first.next_position, seed=5, label=0)
    np.testing.assert_array_equal(np.concatenate([first.positions, second.positions]), whole.positions)
    assert second.next_position == whole.next_position == whole.positions[-1] + 1


def test_another_label_draws_other_points():
    one, two = (rejection(hill, SOBOL, 50, start=0, seed=5, label=label) for label in (1, 2))
    assert not np.array_equal(one.positions, two.positions)


def test_constraints_hold_and_are_never_scored():
    def below_diagonal(u: np.ndarray) -> np.ndarray:
        return u[:, 0] > u[:, 1]

    def score(u: np.ndarray) -> np.ndarray:
        assert below_diagonal(u).all()
        return hill(u)

    draw = rejection(score, SOBOL, 200, start=0, seed=1, label=0, accept_filter=below_diagonal)
    assert below_diagonal(draw.u).all()
    np.testing.assert_array_equal(draw.u, np.concatenate([SOBOL.points(p, p + 1) for p in draw.positions]))


def test_a_hopeless_score_falls_back_to_the_pool_in_proportion():
    def peak(u: np.ndarray) -> np.ndarray:
        return -60.0 - 5.0 * u[:, 0]

    draws = [rejection(peak, SOBOL, 300, start=10, seed=2, label=0, max_candidates=8192, chunk=c) for c in (64, 4096)]
    assert draws[0].method == "pool"
    assert draws[0].next_position == 10 + 8192
    assert draws[0].acceptance == 0.0
    np.testing.assert_array_equal(draws[0].positions, draws[1].positions)
    assert (np.diff(draws[0].positions) > 0).all()
    expected = (1 - np.exp(-5.0 * np.array([0.1, 0.2, 0.4]))) / (1 - np.exp(-5.0))
    shares = [(draws[0].u[:, 0] < x).mean() for x in (0.1, 0.2, 0.4)]
    np.testing.assert_allclose(shares, expected, atol=0.07)


def test_part_accepted_part_pool():
    draw = rejection(lambda u: np.full(len(u), -6.0), SOBOL, 100, start=0, seed=0, label=0, max_candidates=4096)
    assert draw.method == "pool"
    assert 0 < draw.acceptance < 100 / 4096
    assert len(np.unique(draw.positions)) == 100


def test_no_score_at_all_continues_evenly():
    draw = rejection(lambda u: np.full(len(u), -np.inf), SOBOL, 30, start=5, seed=0, label=0, max_candidates=2048)
    np.testing.assert_array_equal(draw.u, SOBOL.points(5, 35))
    assert (draw.method, draw.next_position, draw.acceptance) == ("even", 35, 0.0)


def test_nothing_asked_nothing_drawn():
    draw = rejection(hill, SOBOL, 0, start=5, seed=0, label=0)
    assert draw.u.shape == (0, 2)
    assert (draw.next_position, draw.method) == (5, "rejection")


def test_bad_scores_and_constraints_are_refused():
    for value in (np.nan, np.inf):
        with pytest.raises(InputError, match="must be < inf and not NaN"):
            rejection(lambda u, v=value: np.full(len(u), v), SOBOL, 3, start=0, seed=0, label=0)
    with pytest.raises(InputError, match="shape"):
        rejection(lambda u: u, SOBOL, 3, start=0, seed=0, label=0)
    with pytest.raises(InputError, match="constraints must admit"):
        rejection(
            hill, SOBOL, 3, start=0, seed=0, label=0, max_candidates=100,
            accept_filter=lambda u: np.zeros(len(u), bool),
        )  # fmt: skip
    with pytest.raises(InputError, match="max_candidates"):
        rejection(hill, SOBOL, 3, start=0, seed=0, label=0, max_candidates=2)


@pytest.mark.parametrize("shift", [0.5, 3.0, 40.0])
def test_scores_above_zero_have_the_density_of_the_score(shift):
    """The constant is unknown: the largest score seen takes the place of the bound."""
    draw = rejection(lambda u: hill(u) + shift, SOBOL, 4000, start=100, seed=5, label="law")
    counts, x, y = np.histogram2d(draw.u[:, 0], draw.u[:, 1], bins=5, range=[[0, 1], [0, 1]])
    mass = np.outer(np.diff(x**2), -np.diff((1 - y) ** 3))
    assert stats.chisquare(counts.ravel(), 4000 * mass.ravel()).pvalue > 0.01
    assert draw.method == "rejection"
    assert shift - 0.05 < draw.log_bound <= shift
    assert draw.acceptance == pytest.approx(1 / 6, rel=0.1)


def test_few_points_of_an_unbounded_score_are_no_worse_than_many():
    """The first candidates are not taken for want of a bound: 300 draws of 5 points have the mean of the density."""
    draws = [rejection(lambda u: 2 + hill(u), SOBOL, 5, start=0, seed=s, label="few", chunk=512).u for s in range(300)]
    mean = np.concatenate(draws).mean(axis=0)  # of u_0 (1 - u_1)^2: 2/3 and 1/4
    np.testing.assert_allclose(mean, [2 / 3, 1 / 4], atol=0.03)


@pytest.mark.parametrize("chunk", [1, 37, 512, 100_000])
def test_chunks_do_not_change_the_draw_of_scores_above_zero(chunk):
    def rising(u: np.ndarray) -> np.ndarray:
        """Records come late: the bound rises again and again."""
        return np.where(u[:, 0] > 0.999, 3 + 1000 * (u[:, 0] - 0.999), np.where(u[:, 0] > 0.9, 1.0, -1.0))

    n = 5 if chunk == 1 else 150
    draws = [rejection(rising, SOBOL, n, start=7, seed=5, label=2, chunk=c) for c in (4096, chunk)]
    for name in ("u", "positions", "next_position", "candidates", "method", "acceptance", "log_bound"):
        np.testing.assert_array_equal(getattr(draws[0], name), getattr(draws[1], name))
    assert draws[0].log_bound > 3


def test_a_score_above_zero_that_is_seen_too_late_does_not_matter():
    score = np.full(2000, -1.0)
    score[1500] = 2.0

    class Line:
        dimension = 1

        def points(self, start: int, stop: int) -> np.ndarray:
            return np.arange(start, min(stop, 2000))[:, None] / 2000

    def at(values: np.ndarray, n: int) -> RoiDraw:
        return rejection(
            lambda u: values[np.rint(u[:, 0] * 2000).astype(int)], Line(), n, start=0, seed=0, label=0, max_candidates=2000
        )

    draws = [at(values, 100) for values in (score, np.minimum(score, -1.0))]
    np.testing.assert_array_equal(draws[0].positions, draws[1].positions)
    assert (draws[0].log_bound, draws[0].positions[-1] < 1500) == (0.0, True)
    many = at(score, 1000)
    assert (many.method, many.log_bound, 1500 in many.positions) == ("pool", 2.0, True)


def test_a_bound_of_zero_and_one_from_the_candidates_draw_alike():
    """Shifting a score by its largest value over the candidates is what the sampler does itself."""
    shifted = rejection(lambda u: hill(u) + 1.0, SOBOL, 200, start=7, seed=5, label=2)
    by_hand = rejection(lambda u: hill(u) + 1.0 - shifted.log_bound, SOBOL, 200, start=7, seed=5, label=2)
    np.testing.assert_array_equal(shifted.positions, by_hand.positions)


def test_samplers_obey_their_contract():
    check_sampler(lambda n, seed: SobolSequence(3, seed).points(0, n), dimension=3)
    check_sampler(lambda n, seed: rejection(hill, SobolSequence(2, seed), n, start=0, seed=seed, label=0).u, dimension=2)


def test_rows_of_a_table_come_once_each_before_any_repeat_of_them():
    u = np.repeat(SobolSequence(2, 1).points(0, 50), 3, axis=0)
    taken = np.zeros(150, dtype=bool)
    first = PoolSequence(u, taken, 1).points(0, 50)
    assert len(np.unique(first, axis=0)) == 50
    taken[::3] = True  # the first row of each
    taken[1] = True  # and a repeat
    left = PoolSequence(u, taken, 1)
    assert len(left) == 99
    assert len(np.unique(left.points(0, 49), axis=0)) == 49
    alone = PoolSequence(u[::3], np.zeros(50, dtype=bool), 1)
    assert not np.array_equal(alone.rows, np.arange(50))

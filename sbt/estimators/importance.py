"""Importance sampling from a pool: with which probability a point is drawn, and the coefficient of each draw.

    P_t = (1/N) sum_i w_i pi_i + (1/n) sum_j w_j (1_j - pi_j) / (N r_j)

over a fresh pool of N points from the proposal h with weights w = p/h and predicted probabilities pi, and n draws from
the pool with probabilities r. Unbiased for any metamodel that was fitted to earlier runs only: the first sum is the
prediction, the second corrects it by true runs (pi is a control variate). With pi = 0 in both it is Meta-IS.

Source:
    Dubourg, Sudret, Deheeger (2013), Meta-IS, Probabilistic Engineering Mechanics 33; the difference
    form is that of survey sampling: Cassel, Saerndal, Wretman (1976), Biometrika 63.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sbt.problem.arrays import Mask, Vector

__all__ = [
    "BLIND", "SHARES", "Draws", "Plan", "Stated", "at_most_one", "draw_systematic", "plan_batch", "rows_at", "stated",
    "stratified_variance",
]  # fmt: skip

SHARES = (0.63, 0.20, 0.05, 0.12)
"""Shares of the draws in proportion to the metamodel's uncertainty, to the nominal distribution, to the pool and to the
wide distribution. The last three (37 %) do not depend on the metamodel: they bound what it misses. The nominal share alone
says how much a region may hold that no run has met: 15 such draws in 200 runs bound it by 0.2."""
BLIND = (0.0, 0.5, 0.1, 0.4)
"""The same while all runs are on one side of the boundary: the metamodel knows nothing of the other."""


_LEAST_DRAWN = 1e-300
"""Probability of a pool point that is never drawn, as a divisor: its weight is 0."""
_LEAST_PROBABILITY = 1e-12
"""Of an event, in the coefficient of variation that draws are planned by: one that is denied must not take them all."""
_OWN = 0.5
"""Share of the guided draws that no further event has a say in."""

LogPair = tuple[Vector, Vector]
"""(N,) log P(event) and (N,) log of the rest, at the points of a pool."""


@dataclass(frozen=True, eq=False)
class Stated:
    """What the metamodel states of an event at the points of a pool, as a control variate of its draws.

    Attributes:
        pi: (N,) P(event).
        prior: mean of w pi, the prediction of its probability.
        anticipated: variance of one draw in the difference form, if the metamodel is right.
        pool_variance: of the prior through the pool.
    """

    pi: Vector
    prior: float
    anticipated: float
    pool_variance: float


@dataclass(frozen=True, eq=False)
class Plan:
    """The sampling plan of a batch.

    Attributes:
        form: "difference" or "meta" (Meta-IS).
        probability: (N,) r, the probability of each pool point, sum 1.
        control_variate: (N,) pi as the correction subtracts it: 0 for Meta-IS.
        weight: (N,) w / N.
        prior: the first sum; 0 for Meta-IS.
        predicted: the metamodel's prediction of the probability, whatever the form.
        anticipated: variance of one draw if the metamodel is right.
        pool_variance: of P_t through the pool, in total.
        nominal: share of the draws in proportion to the nominal distribution.
        nominal_probability: (N,) of each pool point in such a draw, sum 1.
        moment: (N,) mean square of what a run would correct at each pool point, by the metamodel.
        guided: (N,) probability of each pool point in a draw that the metamodel guides, sum 1.
        guided_share: of the draws.
    """

    form: str
    probability: Vector
    control_variate: Vector
    weight: Vector
    prior: float
    predicted: float
    anticipated: float
    pool_variance: float
    nominal: float
    nominal_probability: Vector
    moment: Vector
    guided: Vector
    guided_share: float

    def moved(self, share: float) -> Plan:
        """Return the plan with this share of all draws taken from the guided ones and made from the nominal distribution."""
        probability = self.probability + share * (self.nominal_probability - self.guided)
        moved = replace(self, nominal=self.nominal + share, guided_share=self.guided_share - share)
        return moved.drawn_with(np.maximum(probability, 0.0))

    @property
    def hits(self) -> float:
        """Share of the draws that are critical, if the metamodel is right."""
        second = self.moment if self.form == "meta" else self.control_variate
        return float(self.probability @ second)

    def drawn_with(self, probability: Vector) -> Plan:
        """Return the same plan with other probabilities r (N,) of the pool points."""
        corrected = (self.weight**2 * self.moment / np.maximum(probability, _LEAST_DRAWN)).sum()
        mean = 0.0 if self.form == "difference" else self.predicted
        return replace(self, probability=probability, anticipated=max(float(corrected) - mean**2, 0.0))


@dataclass(frozen=True, eq=False)
class Draws:
    """n draws from a pool.

    Attributes:
        rows: (n,) rows of the pool.
        plan: with the probabilities r that these draws had.
        nominal: number of the draws, the first ones, that were made in proportion to the nominal distribution.
    """

    rows: Vector
    plan: Plan
    nominal: int

    @property
    def coefficient(self) -> Vector:
        """(n,) w / (N r)."""
        return np.asarray(self.plan.weight[self.rows] / self.plan.probability[self.rows])

    @property
    def control_variate(self) -> Vector:
        """(n,) pi, as the correction subtracts it."""
        return np.asarray(self.plan.control_variate[self.rows])


def plan_batch(
    log_pi: Vector, log_not: Vector, log_w: Vector, log_wide: Vector, stratum: Vector, shares: tuple[float, ...] = SHARES,
    form: str | None = None, *, others: Sequence[LogPair] = (),
) -> Plan:  # fmt: skip
    """Return the plan of a form, the difference form or Meta-IS.

    Where the same draws estimate several events, half of the guided ones are in proportion to w sqrt(sum of u^2 / P^2), u the
    uncertainty of an event and P its probability: that minimises the sum of the squared coefficients of variation. The
    other half is the first event's alone.

    Args:
        log_pi: (N,) log P(critical) of the metamodel.
        log_not: (N,) log P(uncritical) of the metamodel.
        log_w: (N,) log p/h; -inf where the nominal distribution has no mass.
        log_wide: (N,) log of the wide density over h.
        stratum: (N,) component of h that each point was drawn from: their counts are fixed.
        shares: of the draws, as `SHARES`.
        form: "difference" or "meta"; None: that of smaller anticipated variance. A pool that is counted must not choose its
            own form: it would choose the one that its points happen to flatter.
        others: further events that the draws estimate.
    """
    n = len(log_w)
    w, pi = np.exp(log_w) / n, np.exp(log_pi)
    alive = w > 0.0
    log_uncertainty = {"difference": 0.5 * (log_pi + log_not), "meta": 0.5 * log_pi}  # standard deviation of the term
    nominal = w / w.sum()
    plans = []
    for name, log_spread in log_uncertainty.items():
        if form not in (None, name):
            continue
        r = shares[1] * nominal + shares[2] * alive / alive.sum() + shares[3] * _normalised(log_wide, alive)
        mean = float((w * pi).sum())
        guided = _guided(log_spread, mean, others, w, log_w, alive)
        r += shares[0] * guided
        r /= r.sum()
        variance = stratified_variance(n * w * pi, stratum)
        if name == "difference":
            plan = Plan(name, r, pi, w, mean, mean, 0.0, variance, shares[1], nominal, pi * np.exp(log_not), guided, shares[0])
        else:
            plan = Plan(name, r, np.zeros(n), w, 0.0, mean, 0.0, variance, shares[1], nominal, pi, guided, shares[0])
        plans.append(plan.drawn_with(r))
    return min(plans, key=lambda plan: plan.anticipated)


def stated(event: LogPair, plan: Plan, stratum: Vector) -> Stated:
    """Return what is stated of an event at the points of a pool that draws are made from by this plan."""
    w, pi = plan.weight, np.exp(event[0])
    one_draw = w**2 * pi * np.exp(event[1]) / np.maximum(plan.probability, _LEAST_DRAWN)
    return Stated(pi, float((w * pi).sum()), float(one_draw.sum()), stratified_variance(len(w) * w * pi, stratum))


def _guided(
    log_spread: Vector, mean: float, others: Sequence[LogPair], w: Vector, log_w: Vector, alive: Mask
) -> Vector:
    """Return (N,) the probabilities of guided draws, sum 1; `log_spread` and `mean` are those of the first event."""
    own = _normalised(log_spread + log_w, alive)
    if not others:
        return own
    every = 2.0 * (log_spread - _log(mean))
    for event in others:
        every = np.logaddexp(every, _relative(event, w))
    return _OWN * own + (1.0 - _OWN) * _normalised(0.5 * every + log_w, alive)


def _relative(event: LogPair, w: Vector) -> Vector:
    """Return (N,) log u^2 / P^2 of an event."""
    return event[0] + event[1] - 2.0 * _log(float((w * np.exp(event[0])).sum()))


def _log(probability: float) -> float:
    return float(np.log(max(probability, _LEAST_PROBABILITY)))


def _normalised(log_value: Vector, alive: Mask) -> Vector:
    """Return values that sum to 1 over the points that are alive; even there where all vanish."""
    log_value = np.where(alive, log_value, -np.inf)
    top = float(log_value.max())
    if not np.isfinite(top):
        return np.asarray(alive / alive.sum())
    value = np.exp(log_value - top)
    return np.asarray(value / value.sum())


def stratified_variance(values: Vector, stratum: Vector) -> float:
    """Return the variance of the mean of values whose numbers in each stratum were fixed."""
    n, total = len(values), 0.0
    for s in np.unique(stratum):
        inside = values[stratum == s]
        if len(inside) > 1:
            total += len(inside) * float(inside.var(ddof=1))
    return total / n**2


def draw_systematic(plan: Plan, n: int, order: Vector, rng: np.random.Generator, *, once: bool = True) -> Draws:
    """Return n draws: the nominal share independently, the others systematic along an order of the pool.

    Every pool point is expected n r times, exactly, with the r of the plan that is returned. The nominal draws are
    independent, so that what they miss has an exact bound; of the others, neighbours in the order are not drawn together more
    often than needed.

    Args:
        plan: probabilities and control variates.
        n: number of draws.
        order: (N,) a number by which the pool is ordered.
        rng: the only source of randomness.
        once: none of the systematic draws repeats a point: what a sharp belief would give it beyond certainty goes to the
            others. A deterministic simulator tells nothing new the second time.
    """
    nominal = int(plan.nominal * n + rng.random())  # rounded at random: its expectation is exact
    known = rows_at(plan.nominal_probability, rng.random(nominal))
    rest, others = np.maximum(plan.probability - plan.nominal * plan.nominal_probability, 0.0), n - nominal
    if once and others:
        expected = at_most_one(rest, others)
        plan, rest = plan.drawn_with((expected + nominal * plan.nominal_probability) / n), expected
    rows = np.argsort(order, kind="stable")
    drawn = rows[rows_at(rest[rows], (np.arange(others) + rng.random()) / max(others, 1))]
    return Draws(np.concatenate([known, drawn]), plan, nominal)


def at_most_one(probability: Vector, n: int) -> Vector:
    """Return (N,) how often n draws are expected to meet each point: in proportion to a probability, never above 1.

    Where there are no more than n points, they are met in proportion alone.
    """
    certain, total = np.zeros(len(probability), dtype=bool), float(probability.sum())
    if np.count_nonzero(probability) <= n:
        return probability * (n / total)
    while True:
        left = np.where(certain, 0.0, probability)
        expected = np.where(certain, 1.0, left * ((n - certain.sum()) / float(left.sum())))
        beyond = expected > 1.0
        if not beyond.any():
            return expected
        certain |= beyond


def rows_at(probability: Vector, at: Vector) -> Vector:
    """Return the rows at which the cumulative probability, not normalised, reaches `at` in [0, 1)."""
    edges = np.cumsum(probability)
    return np.minimum(np.searchsorted(edges, at * edges[-1], side="right"), len(edges) - 1)

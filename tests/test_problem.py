"""Laws of the ground: maps invert, densities integrate to one, samples follow them, wrong values are told."""

from __future__ import annotations

import functools
import itertools
import math
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, stats
from scipy.special import ndtri

import sbt
from sbt.campaigns.parts import _uniform
from sbt.errors import InputError, RunError
from sbt.problem.distribution import KINDS, Distribution
from sbt.problem.expression import Expression
from sbt.problem.metric import Metric
from sbt.problem.outcome import Status
from sbt.problem.parameter import TAIL, Parameter
from sbt.problem.requirement import CriticalInterval, Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.problem.trace import Trace
from sbt.seeds import run_seed, stream

NORMAL = Distribution.of("normal", mean=0.0, std=1.0)
LAWS = {
    "none": Parameter("p", -2.0, 3.0),
    "uniform": Parameter("p", 1.0, 1.5, distribution=Distribution.of("uniform")),
    "normal": Parameter("p", 0.0, 120.0, distribution=Distribution.of("normal", mean=40, std=15)),
    "upper tail": Parameter("p", 8.0, 12.0, distribution=NORMAL),
    "lower tail": Parameter("p", -12.0, -8.0, distribution=NORMAL),
    "half line in the tail": Parameter("p", 9.0, math.inf, distribution=NORMAL),
    "line": Parameter("p", -math.inf, math.inf, distribution=NORMAL),
    "lognormal": Parameter("p", 0.1, 9.0, distribution=Distribution.of("lognormal", mean=2.0, std=1.0)),
    "exponential": Parameter("p", 0.0, math.inf, distribution=Distribution.of("exponential", mean=3.0)),
    "gumbel": Parameter("p", -5.0, 30.0, distribution=Distribution.of("gumbel", mean=2.0, std=3.0)),
    "weibull": Parameter("p", 0.2, 8.0, distribution=Distribution.of("weibull", shape=1.5, scale=2.0)),
    "beta": Parameter("p", 0.05, 0.9, distribution=Distribution.of("beta", a=2.0, b=3.0)),
    "triangular": Parameter("p", 0.0, 4.0, distribution=Distribution.of("triangular", low=-1.0, mode=1.0, high=4.0)),
    "scipy": Parameter("p", -3.0, 20.0, distribution=Distribution.of("scipy", name="t", df=3)),
}
INTEGERS = {
    "uniform": Parameter("k", -3, 4, kind="integer"),
    "normal": Parameter("k", 0, 9, distribution=Distribution.of("normal", mean=3, std=2), kind="integer"),
    "upper tail": Parameter("k", 8, 12, distribution=NORMAL, kind="integer"),
    "lower tail": Parameter("k", -12, -8, distribution=NORMAL, kind="integer"),
}
SQUARE = ParameterSpace((Parameter("a", -1.0, 3.0), Parameter("b", 10.0, 20.0)))
COPULA = ParameterSpace(
    (LAWS["normal"], Parameter("q", 0.0, 5.0, distribution=Distribution.of("exponential", mean=1.0))), ((1.0, 0.7), (0.7, 1.0))
)
HALF = ParameterSpace(SQUARE.parameters, constraints=(("b > 10 + 2.5 (a + 1)", lambda v: v["b"] > 10 + 2.5 * (v["a"] + 1)),))

unit = st.floats(0.0, 1.0)


def one(parameter: Parameter) -> ParameterSpace:
    return ParameterSpace((parameter,))


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_law_is_among_the_tested(kind):
    assert any(p.distribution is not None and p.distribution.kind == kind for p in LAWS.values())


@pytest.mark.parametrize("name", LAWS)
@given(u=unit)
@settings(max_examples=40)
def test_maps_of_a_continuous_input_invert(name, u):
    p = LAWS[name]
    low, high = p.bounds
    assert math.isfinite(low) and math.isfinite(high)  # noqa: PT018  (one fact)
    x = p.from_unit(np.array([u]))
    assert p.contains(x).all()
    assert p.to_unit(x)[0] == pytest.approx(u, abs=1e-12 * max(1, abs(low / (high - low))))
    scale = high - low
    back = p.from_normal(p.to_normal(x))
    assert p.contains(back).all()
    if p.log_density(x)[0] > math.log(1e-290) and p.to_normal(x)[0] < 8.2:  # where the law is not below the last bit
        assert back[0] == pytest.approx(x[0], rel=1e-9, abs=1e-9 * scale)


@pytest.mark.parametrize("name", LAWS)
def test_normal_scores_invert_in_both_tails(name):
    p = LAWS[name]
    z = np.linspace(-7.5, 7.5, 61)
    x = p.from_normal(z)
    assert (np.diff(x) >= 0).all()
    changing = np.flatnonzero(np.diff(x) > 1e-12 * (np.abs(x[:-1]) + 1e-300))  # elsewhere x has no more digits to tell
    kept = np.intersect1d(changing, changing + 1)
    assert len(kept) > 25
    np.testing.assert_allclose(p.to_normal(x)[kept], z[kept], atol=2e-3)
    middle = np.abs(z) < 4
    np.testing.assert_allclose(p.to_normal(x)[middle], z[middle], atol=1e-8)


@pytest.mark.parametrize("name", LAWS)
def test_scores_beyond_all_numbers_have_finite_values_in_the_range(name):
    p = LAWS[name]
    x = p.from_normal(np.array([-1e6, -38.6, 38.6, 1e6]))
    assert np.isfinite(x).all()
    assert p.contains(x).all()
    assert (np.diff(x) >= 0).all()


@pytest.mark.parametrize("name", INTEGERS)
def test_maps_of_an_integer_input_invert_exactly(name):
    p = INTEGERS[name]
    k = np.arange(p.low, p.high + 1)
    np.testing.assert_array_equal(p.from_unit(p.to_unit(k)), k)
    np.testing.assert_array_equal(p.from_normal(p.to_normal(k)), k)
    u = np.linspace(0, 1, 10 * len(k) + 1)
    np.testing.assert_array_equal(np.unique(p.from_unit(u)), k)
    assert not p.contains(k[:-1] + 0.5).any()
    assert p.log_density(np.array([p.low + 0.5, p.low - 1, p.high + 1])).tolist() == [-np.inf] * 3
    assert np.exp(p.log_density(k)).sum() == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize(
    ("low", "high", "distribution"),
    [
        (0, 20, sbt.Exponential(4.0)), (0, 10, sbt.Triangular(0.0, 3.0, 10.0)), (0, 30, sbt.LogNormal(1.0, 1.0)),
        (-3, 9, sbt.Normal(0.0, 1.0)),
    ],
)
def test_a_whole_number_at_an_end_of_its_distribution_has_the_score_of_its_cell(low: int, high: int, distribution: Distribution):
    """It was that of the end itself, -inf, which ended estimations."""
    p = Parameter("n", low, high, kind="integer", distribution=distribution)
    k = np.arange(low, high + 1.0)
    np.testing.assert_array_equal(p.from_normal(p.to_normal(k)), k)
    mass = np.exp(p.log_density(k))
    np.testing.assert_allclose(stats.norm.cdf(p.to_normal(k)), np.cumsum(mass) - 0.5 * mass, rtol=1e-6)


@pytest.mark.parametrize("name", LAWS)
def test_density_of_an_input_integrates_to_one_and_is_the_slope_of_its_law(name):
    p = LAWS[name]
    ends = p.from_normal(np.array([-8.0, -3.0, -1.0, 0.0, 1.0, 3.0, 8.0]))
    ends[[0, -1]] = [p.low if math.isfinite(p.low) else ends[0], p.high if math.isfinite(p.high) else ends[-1]]
    total = sum(
        integrate.quad(lambda x: float(np.exp(p.log_density(np.array([x]))[0])), a, b, epsabs=1e-11, epsrel=1e-9)[0]
        for a, b in itertools.pairwise(ends)
    )
    assert total == pytest.approx(1.0, abs=1e-6)
    outside = np.array([p.low - 1e-6 * max(1, abs(p.low)), p.high + 1e-6 * max(1, abs(p.high)), np.nan])
    assert (p.log_density(outside[np.isfinite(outside)]) == -np.inf).all()
    assert not p.contains(np.array([np.nan]))[0]


@pytest.mark.parametrize("name", [*LAWS, *(f"integer {name}" for name in INTEGERS)])
def test_samples_follow_the_law(name):
    p = INTEGERS[name.removeprefix("integer ")] if name.startswith("integer") else LAWS[name]
    x = one(p).sample(4000, stream(1, name))[:, 0]
    assert p.contains(x).all()
    np.testing.assert_array_equal(x, one(p).sample(4000, stream(1, name))[:, 0])
    if p.kind == "integer":
        k = np.arange(p.low, p.high + 1)
        expected = 4000 * np.exp(p.log_density(k))
        seen = np.array([(x == v).sum() for v in k])
        many = expected > 5
        np.testing.assert_allclose(seen[~many], expected[~many], atol=12)
        assert (((seen - expected) ** 2 / expected)[many]).sum() < stats.chi2(many.sum()).ppf(0.999)
        return
    low, high = p.bounds
    grid = np.linspace(low, high, 400)
    density = np.exp(p.log_density(grid))
    law = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(grid))])
    assert stats.kstest(x, lambda v: np.interp(v, grid, law / law[-1])).pvalue > 1e-3


@given(st.floats(0.001, 0.999), st.floats(0.001, 0.999))
@settings(max_examples=60)
def test_maps_of_a_space_invert_with_and_without_copula(u, v):
    for space in (SQUARE, COPULA):
        x = space.from_unit(np.array([[u, v]]))
        np.testing.assert_allclose(space.to_unit(x), [[u, v]], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(space.from_normal(space.to_normal(x)), x, rtol=1e-9)


@pytest.mark.parametrize("space", [SQUARE, COPULA], ids=["independent", "copula"])
def test_the_corners_of_the_box_come_back_from_their_normal_scores(space):
    ends = [p.bounds for p in space.parameters]
    corners = np.array([[a, b] for a in ends[0] for b in ends[1]])
    scores = space.to_normal(corners)
    assert np.isfinite(scores).all()
    np.testing.assert_allclose(space.from_normal(scores), corners, rtol=1e-9, atol=1e-9)


def test_copula_density_integrates_to_one_and_has_the_marginals_and_the_correlation():
    ends = [p.bounds for p in COPULA.parameters]
    x, y = (low + (high - low) * (np.arange(1200) + 0.5) / 1200 for low, high in ends)
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    density = np.exp(COPULA.log_density(grid.reshape(-1, 2))).reshape(len(x), len(y))
    assert density.sum() * (x[1] - x[0]) * (y[1] - y[0]) == pytest.approx(1.0, abs=2e-3)
    p = COPULA.parameters[0]
    middle = slice(240, 600)
    np.testing.assert_allclose(density.sum(axis=1)[middle] * (y[1] - y[0]), np.exp(p.log_density(x))[middle], rtol=0.02)
    sample = COPULA.sample(20_000, stream(2))
    rank = stats.spearmanr(sample[:, 0], sample[:, 1]).statistic
    assert rank == pytest.approx(6 / math.pi * math.asin(0.7 / 2), abs=0.02)
    assert stats.kstest(COPULA.to_normal(sample)[:, 1], "norm").pvalue > 1e-3
    cell = (sample[:, 0] > 50) & (sample[:, 1] > 2)
    assert cell.mean() == pytest.approx(_mass_above(COPULA, 50, 2), abs=0.01)


def _mass_above(space: ParameterSpace, a: float, b: float) -> float:
    za, zb = (float(p.to_normal(np.array([v]))[0]) for p, v in zip(space.parameters, (a, b), strict=True))
    return float(stats.multivariate_normal([0, 0], space.correlation).cdf([-za, -zb]))


@pytest.mark.parametrize("law", [each for each in LAWS if each not in ("none", "uniform")])
def test_values_at_the_ends_of_a_range_have_scores_that_they_can_tell(law):
    """Far scores are rounded to an end: what is told of it is no farther than the least of them."""
    space = ParameterSpace((LAWS[law],))
    z = np.linspace(-12.0, 12.0, 97)[:, None]
    back = space.to_normal(space.from_normal(z))
    assert (np.abs(back) <= np.abs(z) + 1.0).all()
    assert (np.abs(back) >= np.minimum(np.abs(z), 8.0) - 0.5).all()


def test_density_is_minus_infinity_outside_only():
    inside = np.array([[0.0, 15.0], [-1.0, 10.0], [3.0, 20.0]])
    outside = np.array([[-1.1, 15.0], [3.1, 15.0], [0.0, 9.9], [0.0, 20.1]])
    np.testing.assert_allclose(SQUARE.log_density(inside), -math.log(40.0))
    assert (SQUARE.log_density(outside) == -np.inf).all()
    assert not SQUARE.feasible(outside).any()
    ends = np.array([[p.low, q.high] for p, q in [COPULA.parameters]])
    assert not np.isnan(COPULA.log_density(ends)).any()


def test_constraints_cut_the_density_and_the_samples():
    assert HALF.feasible_mass == pytest.approx(0.5, abs=2e-3)
    x = HALF.sample(2000, stream(3))
    assert x.shape == (2000, 2)
    assert HALF.feasible(x).all()
    assert HALF.log_density(np.array([[-0.5, 19.0], [2.5, 11.0]])).tolist() == [
        pytest.approx(math.log(1 / 20), abs=5e-3), -math.inf,
    ]  # fmt: skip
    u = stream(4).random((40_000, 2))
    density = np.exp(HALF.log_density(HALF.from_unit(u)))
    assert density.mean() * 40 == pytest.approx(1.0, abs=0.02)
    assert HALF.sample(0, stream(3)).shape == (0, 2)


def test_feasible_mass_is_that_of_the_law_not_of_the_box():
    law = Distribution.of("normal", mean=0.0, std=1.0)
    space = ParameterSpace((Parameter("a", -9.0, 9.0, distribution=law),), constraints=(("a > 1", lambda v: v["a"] > 1.0),))
    assert space.feasible_mass == pytest.approx(stats.norm.sf(1.0), abs=1e-3)
    with pytest.raises(InputError, match=r"at least 0\.001 of the box"):
        ParameterSpace(SQUARE.parameters, constraints=(("never", lambda v: v["a"] > 9.0),))
    far = ParameterSpace((Parameter("a", -1e3, 1e3, distribution=law),), constraints=(("far", lambda v: v["a"] > 500.0),))
    with pytest.raises(InputError, match="must have mass"):
        far.log_density(np.array([[600.0]]))


def test_infinite_ranges_are_searched_between_their_quantiles_and_estimated_whole():
    p = Parameter("p", -math.inf, math.inf, distribution=NORMAL)
    np.testing.assert_allclose(p.bounds, [ndtri(TAIL), -ndtri(TAIL)])
    assert p.centre == pytest.approx(0.0, abs=1e-12)
    assert p.log_density(np.array([30.0]))[0] == pytest.approx(stats.norm.logpdf(30.0))
    assert p.from_normal(np.array([20.0]))[0] == pytest.approx(20.0)


def test_features_are_further_columns_between_zero_and_one():
    space = ParameterSpace(SQUARE.parameters, features=(("ratio", lambda v: v["b"] / (v["a"] + 2)),))
    u = stream(5).random((500, 2))
    columns = space.metamodel_inputs(u)
    assert columns.shape == (500, 3)
    np.testing.assert_array_equal(columns[:, :2], u)
    assert columns[:, 2].min() > -0.01
    assert columns[:, 2].max() < 1.01
    np.testing.assert_array_equal(space.metamodel_inputs(u[:5]), columns[:5])
    assert SQUARE.metamodel_inputs(u) is u
    flat = ParameterSpace(SQUARE.parameters, features=(("flat", lambda v: v["a"] * 0),))
    with pytest.raises(InputError, match="must be finite and vary over the box, but 'flat' does not"):
        flat.metamodel_inputs(u)


def test_values_of_a_concrete_scenario_are_checked_and_filled():
    assert SQUARE.values({"b": 12}) == {"a": 1.0, "b": 12.0}
    assert HALF.values({"a": 0.0, "b": 19.0}) == {"a": 0.0, "b": 19.0}
    with pytest.raises(InputError, match="must satisfy 'b > 10"):
        HALF.values({"a": 2.0, "b": 11.0})
    with pytest.raises(InputError, match=r"input k must be a whole number in \[-3, 4\], but got 1.5"):
        one(INTEGERS["uniform"]).values({"k": 1.5})
    with pytest.raises(InputError, match="but got nan"):
        SQUARE.values({"a": math.nan})


WRONG = {
    "name": (lambda: Parameter("2b", 0, 1), "identifier, but got '2b'"),
    "order": (lambda: Parameter("a", 1.0, 1.0), "low < high must hold, but got low 1.0, high 1.0"),
    "nan end": (lambda: Parameter("a", 0.0, math.nan), "low < high must hold"),
    "infinite": (lambda: Parameter("a", 0.0, math.inf), "an infinite range needs a distribution"),
    "kind": (lambda: Parameter("a", 0, 1, kind="real"), "continuous, integer or categorical, but got 'real'"),
    "integer ends": (lambda: Parameter("a", 0, 1.5, kind="integer"), "whole ends, but got"),
    "no mass": (lambda: Parameter("a", 5.0, 6.0, distribution=Distribution.of("beta", a=1, b=1)), "must have mass in its range"),
    "law": (lambda: Distribution.of("gauss", mean=0, std=1), "one of uniform, normal"),
    "missing": (lambda: Distribution.of("normal", mean=0), "takes mean, std, but got mean"),
    "surplus": (lambda: Distribution.of("uniform", low=0), "takes no parameters, but got low"),
    "negative": (lambda: Distribution.of("normal", mean=0, std=-1), "cannot have the parameters"),
    "zero": (lambda: Distribution.of("lognormal", mean=0, std=1), "cannot have the parameters"),
    "scipy": (lambda: Distribution.of("scipy", name="poisson", mu=3), "continuous distribution of scipy.stats, but got poisson"),
    "no inputs": (lambda: ParameterSpace(()), "at least one input"),
    "doubled": (lambda: ParameterSpace((Parameter("a", 0, 1),) * 2), "different names, but got a, a"),
    "shape": (lambda: ParameterSpace(SQUARE.parameters, ((1.0,),)), "symmetric \\(2, 2\\) matrix"),
    "asymmetric": (lambda: ParameterSpace(SQUARE.parameters, ((1.0, 0.5), (0.4, 1.0))), "symmetric"),
    "indefinite": (lambda: ParameterSpace(SQUARE.parameters, ((1.0, 1.0), (1.0, 1.0))), "positive definite"),
    "interval": (lambda: CriticalInterval(1.0, 0.0), r"low <= high, but got \[1.0, 0.0\]"),
    "interval nan": (lambda: CriticalInterval(math.nan, 0.0), "low <= high"),
    "everything": (lambda: CriticalInterval(), "at least one finite end"),
    "no way to run": (lambda: LogicalScenario("s", SQUARE, Requirement("y", 0, 1)), "simulate or evaluate"),
    "metric": (
        lambda: LogicalScenario("s", SQUARE, Requirement("z", 0, 1), evaluate=dict, metric_names=("y",)),
        "one of y, but got 'z'",
    ),
    "seed": (lambda: stream(-1), "a seed must be an integer >= 0, but got -1"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_wrong_values_are_told_with_rule_and_value(case):
    build, message = WRONG[case]
    with pytest.raises(ValueError, match=message):
        build()


def test_errors_survive_pickling():
    error = pickle.loads(pickle.dumps(RunError(Status.INVALID, "not there")))
    assert (error.status, error.reason, str(error)) == (Status.INVALID, "not there", "not there")


def trees(depth: int) -> st.SearchStrategy[str]:
    """Formulas over x and y whose value is a number."""
    leaf = st.sampled_from(["x", "y"]) | st.integers(0, 9).map(str) | st.floats(0.125, 9, width=16).map(repr)

    def grow(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
        return (
            st.tuples(inner, st.sampled_from("+-*/"), inner).map(lambda t: f"({t[0]} {t[1]} {t[2]})")
            | inner.map(lambda t: f"-{t}")
            | st.tuples(inner, st.sampled_from(["2", "3"])).map("({0[0]} ** {0[1]})".format)
            | st.tuples(st.sampled_from(["min", "max"]), inner, inner).map("{0[0]}({0[1]}, {0[2]})".format)
            | inner.map("abs({})".format)
        )

    return st.recursive(leaf, grow, max_leaves=depth)


@given(trees(8), trees(4), st.sampled_from(["<", "<=", ">", ">="]), st.sampled_from(["and", "or"]))
@settings(max_examples=150)
def test_expressions_equal_python(number, other, comparison, joint):
    names = {"x": np.array([0.5, -1.25, 3.0]), "y": np.array([2.0, 0.75, -4.0])}
    condition = f"{number} {comparison} {other} {joint} not x < y"
    with np.errstate(all="ignore"):
        for k in range(3):
            point = {name: np.float64(values[k]) for name, values in names.items()}
            as_numbers = {**point, "min": min, "max": max, "abs": abs}
            for text in (number, condition):
                try:
                    expected = eval(text, {"__builtins__": {}}, as_numbers)
                except (ZeroDivisionError, OverflowError):
                    continue
                if isinstance(expected, float) and not math.isfinite(expected):
                    continue
                found = np.broadcast_to(Expression(text)(names), 3)[k]
                assert found == pytest.approx(expected, rel=1e-12)


def test_a_word_of_python_is_no_name_in_a_formula():
    with pytest.raises(InputError, match="'lambda' is a word of Python"):
        Expression("2 * lambda + 1")


def test_expressions_know_their_functions_and_names():
    x = np.array([0.25, 1.0])
    for name, function in {"sqrt": np.sqrt, "exp": np.exp, "log": np.log, "sin": np.sin, "cos": np.cos}.items():
        np.testing.assert_array_equal(Expression(f"{name}(x)")({"x": x}), function(x))
    assert Expression("b * a < b + min(c, 2)").names() == ("b", "a", "c")
    assert set(Expression("2 * \u00b5 < \u03bc").names()) == {"\u00b5", "\u03bc"}  # micro sign, Greek letter
    np.testing.assert_array_equal(Expression("0 < x < 0.5")({"x": x}), [True, False])
    with pytest.raises(InputError, match=r"'z' in 'x \+ z' must be an input, one of: x"):
        Expression("x + z")({"x": x})
    with pytest.raises(InputError, match=r"min\(\) in 'min\(x\)' takes 2 arguments, but got 1"):
        Expression("min(x)")


@pytest.mark.parametrize(
    "text",
    ["x.real", "__import__('os')", "print(x)", "x[0]", "[x]", "lambda: x", "x if y else 0", "'a'", "x == 1", "x @ y", "f'{x}'",
     "x <", "", "x := 1", "(x for x in y)", "min(*x)", "abs(x=1)", "None", "True", "1j", "x\0", "(" * 300 + "x" + ")" * 300,
     "-" * 5000 + "x"],
    ids=repr,
)  # fmt: skip
def test_expressions_run_nobody_elses_code(text):
    with pytest.raises(InputError):
        Expression(text)


@given(st.floats(-10, 10), st.floats(0, 5), st.floats(-20, 20))
@settings(max_examples=200)
def test_the_sign_of_the_margin_is_the_verdict(low, width, y):
    for interval in (CriticalInterval(low, low + width), CriticalInterval(high=low), CriticalInterval(low=low)):
        assert bool(interval.contains(y)) is bool(interval.margin(y) <= 0)


def test_closed_ends_belong_to_the_critical_interval():
    ends = CriticalInterval(-5.0, 0.0)
    assert ends.contains(np.array([-5.0, 0.0, -0.0, np.nextafter(0, 1), np.nan])).tolist() == [True, True, True, False, False]
    assert CriticalInterval(0.0, 0.0).contains(np.array([0.0, 1e-300])).tolist() == [True, False]
    assert CriticalInterval(high=0.0).contains(np.array([-np.inf, np.nan])).tolist() == [True, False]
    assert np.isnan(CriticalInterval(high=0.0).margin(np.array([np.nan]))).all()
    with np.errstate(all="raise"):
        for interval, deep, far in ((CriticalInterval(high=0.0), -np.inf, np.inf), (CriticalInterval(low=2.0), np.inf, -np.inf)):
            assert interval.margin(np.array([deep, far])).tolist() == [-np.inf, np.inf]


def test_metrics_of_a_run_are_finite_or_the_run_failed():
    trace = Trace(np.zeros(1), (), *np.zeros((5, 1, 0)), np.zeros(0), np.zeros(0))
    assert Metric("m", lambda trace: 2)(trace) == 2.0
    with pytest.raises(RunError, match="metric m must be finite") as caught:
        Metric("m", lambda trace: math.nan)(trace)
    assert caught.value.status == Status.FAILED
    assert Metric("m", lambda trace: -math.inf)(trace) == -math.inf  # an end of its scale
    made = LogicalScenario("s", SQUARE, Requirement("y", 0, 1), evaluate=lambda v, s: {"y": math.nan},
                           metric_names=("y",))  # fmt: skip
    with pytest.raises(RunError, match="metric y must be finite"):
        made.run({}, 0)
    with pytest.raises(ValueError, match=r"trace.x must have shape \(2, 1\)"):
        Trace(np.zeros(2), ("a",), *np.zeros((5, 1, 1)), np.ones(1), np.ones(1))


def test_streams_depend_on_seed_and_path_only():
    drawn = [stream(*key).random() for key in ((1,), (2,), (1, "a"), (1, "b"), (1, "a", 0), (1, "a", "0"), (1, "a", 1))]
    assert len(set(drawn)) == len(drawn)
    seeds = [run_seed(7, k) for k in range(200)]
    assert len(set(seeds)) == 200
    assert 0 <= min(seeds) <= max(seeds) < 2**31
    assert seeds == [run_seed(7, k) for k in range(200)]


@pytest.mark.parametrize(("make", "said"), [
    (lambda: sbt.Parameter("a", 0, 1, "m", 5), "input a: a distribution is one such as Normal.*but got 5"),
    (lambda: sbt.any_of("m"), "what is combined must be requirements, but got 'm'"),
    (lambda: _of(inputs=sbt.Parameter("a", 0, 1)), "inputs must be a list of parameters, but got the parameter a"),
    (lambda: _of(requirement="m"), "a requirement is needed"),
    (lambda: _of(evaluate=5), "must be a function of values and seed"),
    (lambda: sbt.simulate(_of(), [1, 2]), r"inputs must be values by name.*but got \[1, 2\]"),
    (lambda: sbt.simulate(_of(), ego=5), "ego must be a kind, or a mapping of kind and settings, but got 5"),
    (lambda: sbt.Parameter(5, 0, 1), "an input's name must be an identifier, but got 5"),
    (lambda: sbt.Parameter("a", 0, 1, "m", sbt.Normal(50, 0.001)), r"must have mass in its range .*\(input a\)"),
    (lambda: sbt.Normal("0", 1), "distribution 'normal': mean must be a number, but got '0'"),
    (lambda: sbt.Normal(None, 1), "mean must be a number, but got None"),
    (lambda: sbt.Requirement(["m"], high=0), r"a requirement's metric must be text, but got \['m'\]"),
    (lambda: sbt.CriticalInterval("a", 1), "an end of a critical interval must be a number, but got 'a'"),
    (lambda: sbt.Metric(5), "a metric's name must be text, but got 5"),
    (lambda: sbt.Metric("m", 5), "metric m must have a function of a trace, but got 5"),
    (lambda: sbt.Metric("m\n"), "a metric's name must be text on one line"),
    (lambda: _of(metrics=[sbt.Metric("m", direction="lo")]), "metric m: direction must be 'low' or 'high', but got 'lo'"),
    (lambda: sbt.Metric("m", without=math.nan), r"\(without\) must be a number, but got nan"),
    (lambda: sbt.Metric("m", lambda: 1.0), "metric m must have a function of one argument, the trace, but: too many"),
    (lambda: _of(evaluate=lambda values: {"m": 1.0}), "scenario x: what simulates .* must take values and seed, but: too many"),
    (lambda: _of(inputs={"a": (0, 1)}), "inputs must be a list of parameters.*but got 'a'"),
    (lambda: _of(inputs=5), "inputs must be a list of parameters, but got 5"),
    (lambda: _of(metrics="m"), "scenario x: metrics must be a list, but got 'm'"),
    (lambda: _of(metrics=["m", "m"]), "scenario x: metrics must have different names, but got 'm' twice"),
    (lambda: sbt.check(5), "a scenario must be a Scenario or its name, but got 5"),
    (lambda: sbt.open(None), "a store must be the path of a folder, but got None"),
    (lambda: sbt.run(5), "a configuration must be the path of a file, but got 5"),
    (lambda: sbt.list(5), "KIND must be text, but got 5"),
    (lambda: sbt.run(campaign="coverage", scenario=_of(), progress=5), "progress must be a function, but got 5"),
    (lambda: sbt.run(campaign="coverage", scenario=_of(), inputs={"a": sbt.Parameter("b", 0, 1)}), "but got the parameter b"),
])  # fmt: skip
def test_what_is_no_such_thing_is_told_as_that(make, said):
    with pytest.raises(InputError, match=said):
        make()


def test_a_decorated_function_is_asked_for_its_own_arguments():
    def with_limit(function):
        @functools.wraps(function)
        def inner(trace):
            return function(trace, 3.0)

        return inner

    assert Metric("m", with_limit(lambda trace, limit: limit))(None) == 3.0


def test_the_ends_of_a_range_are_plain_numbers():
    made = sbt.Parameter("g", np.float32(0.0), np.int64(3))
    assert (type(made.low), type(made.high)) == (float, int)


@pytest.mark.parametrize(("changed", "said"), [
    ({"time": np.array([1.0, 0.0])}, "time must increase"),
    ({"length": np.zeros(1)}, "length must have 1 values > 0"),
    ({"actors": ("ego", "ego"), **{name: np.ones((2, 2)) for name in ("x", "y", "heading", "speed", "acceleration")},
      "length": np.ones(2), "width": np.ones(2)}, "actors must have different names"),
])  # fmt: skip
def test_a_trace_goes_forward_with_bodies_of_different_names(changed, said):
    states = {name: np.ones((2, 1)) for name in ("x", "y", "heading", "speed", "acceleration")}
    with pytest.raises(ValueError, match=said):
        Trace(**{"time": np.arange(2.0), "actors": ("ego",), **states, "length": np.ones(1), "width": np.ones(1), **changed})


def test_text_is_no_metric():
    with pytest.raises(RunError, match="metric m must be one number, but got '1'"):
        Metric("m", lambda trace: "1")(Trace(np.zeros(1), (), *np.zeros((5, 1, 0)), np.zeros(0), np.zeros(0)))


def _of(inputs=None, requirement=None, evaluate=lambda values, seed: {"m": values["a"]}, metrics=()):
    inputs = [sbt.Parameter("a", 0, 1)] if inputs is None else inputs
    return sbt.Scenario("x", inputs, requirement or sbt.Requirement("m", high=0.0), evaluate=evaluate, metrics=metrics)


@pytest.mark.parametrize(("low", "high", "distribution", "logarithmic"), [
    (1e-9, 1e-3, Distribution.of("scipy", name="loguniform", a=1e-9, b=1e-3), True),
    (0.1, 1000.0, Distribution.of("lognormal", mean=5.0, std=5.0), True),
    (0.1, 1000.0, Distribution.of("uniform"), False), (0.1, 1000.0, None, False),  # every value counts the same
    (0.0, 1000.0, Distribution.of("exponential", mean=5.0), False),  # there is no logarithm
    (5e-324, 1000.0, Distribution.of("exponential", mean=5.0), False),
    (0.1, 5.0, Distribution.of("lognormal", mean=0.3, std=0.3), False),
    (0.1, 1000.0, Distribution.of("normal", mean=500.0, std=100.0), False),
])  # fmt: skip
def test_an_input_over_decades_is_searched_in_its_logarithm(low, high, distribution, logarithmic):
    parameter, u = Parameter("a", low, high, distribution=distribution), np.linspace(0.0, 1.0, 9)
    x = parameter.from_unit(u)
    assert parameter.logarithmic == logarithmic
    assert (x[0], x[-1]) == (low, high)
    np.testing.assert_allclose(parameter.to_unit(x), u, atol=1e-12)
    even = np.diff(np.log(x)) if logarithmic else np.diff(x)
    np.testing.assert_allclose(even, even[0])
    assert parameter.centre == pytest.approx(x[4])


def test_densities_of_inputs_over_decades_are_those_of_the_cube_where_draws_are_from_it():
    """A log-uniform input is uniform in the cube, whose volume the density there fills; held-out runs know theirs."""
    law = Distribution.of("scipy", name="loguniform", a=1e-4, b=1.0)
    a, b, k = Parameter("a", 1e-4, 1.0, distribution=law), Parameter("b", 0.0, 4.0), Parameter("k", 1, 3, kind="integer")
    space = ParameterSpace((a, b, k))
    x, log_q = _uniform(space, 400, np.random.default_rng(1))
    u = space.to_unit(x)
    assert np.ptp(space.log_density_in_cube(u)) < 1e-9
    np.testing.assert_allclose(np.exp(log_q), 1.0 / (x[:, 0] * np.log(1e4) * 4.0 * 3.0))
    np.testing.assert_allclose(space.log_density(x), log_q)  # all inputs are drawn as they are distributed
    lognormal = ParameterSpace((Parameter("a", 1e-3, 100.0, distribution=Distribution.of("lognormal", mean=1.0, std=2.0)),))
    grid = np.linspace(0.0, 1.0, 20_001)[:, None]
    density = np.exp(lognormal.log_density_in_cube(grid)) * np.log(1e5)
    assert np.trapezoid(density, grid[:, 0]) == pytest.approx(1.0, abs=1e-6)


def test_a_misspelt_kind_of_distribution_is_told_the_nearest_name():
    with pytest.raises(InputError, match=r"did you mean '?normal"):
        Distribution.of("norml", mean=0, std=1)

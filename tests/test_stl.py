"""Signal temporal logic: laws, a brute-force oracle, rtamt where it is installed, and errors that point."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sbt
from sbt.errors import InputError, RunError
from sbt.metrics.longitudinal import d_min, ttc_min
from sbt.metrics.signals import ACTOR_SIGNALS, PAIR_SIGNALS, check_signal, signal
from sbt.metrics.stl import parse, robustness, stl
from sbt.metrics.stl_grammar import Binary, Number, Signal, Term, Unary
from sbt.problem.trace import Trace

DT = 0.25
NUMBERS = st.floats(-5, 5, allow_nan=False).map(lambda v: round(v, 3))


def trace(n: int = 41, dt: float = 0.1, gap: float = 20.0, v_ego: float = 15.0, v_co: float = 10.0) -> Trace:
    """Ego behind co in one lane, both 5 m x 1.8 m at constant speeds."""
    t = np.arange(n) * dt
    x = np.stack([v_ego * t, gap + 5.0 + v_co * t], axis=1)
    speed = np.broadcast_to([v_ego, v_co], x.shape)
    zero = np.zeros_like(x)
    return Trace(t, ("ego", "co"), x, zero, zero, speed, zero, np.full(2, 5.0), np.full(2, 1.8))


def rho(text: str, time: np.ndarray, **signals: np.ndarray) -> np.ndarray:
    return robustness(parse(text), signals.__getitem__, time)


# --- a brute-force oracle: the definitions, one instant at a time -----------------------------------------------


def oracle(term: Term, signals: dict[str, np.ndarray], time: np.ndarray, i: int) -> float:
    def at(of: Term, j: int) -> float:
        return oracle(of, signals, time, j)

    def window(low: float, high: float) -> list[int]:
        """A sample holds over [its time, the next one's), the last for ever; those that meet [t + low, t + high]."""
        ends = [*time[1:], math.inf]
        return [j for j in range(len(time)) if time[j] <= time[i] + high and ends[j] > time[i] + low]

    match term:
        case Number(value):
            return value
        case Signal(name):
            return float(signals[name][i])
        case Unary("neg" | "not", of):
            return -at(of, i)
        case Unary("G", of, low, high):
            return min(at(of, j) for j in window(low, high))
        case Unary("F", of, low, high):
            return max(at(of, j) for j in window(low, high))
        case Binary("U", p, q, low, high):
            # the first s of a sample is its time or t + low: p of the sample itself counts where the window begins within it
            begun = [j + int(time[j] < time[i] + low) for j in range(len(time))]
            return max(min([at(q, j), *(at(p, k) for k in range(i, begun[j]))]) for j in window(low, high))
        case Binary(op, left, right):
            f, g = at(left, i), at(right, i)
            pointwise = {
                "+": f + g, "-": f - g, "*": f * g, ">": f - g, ">=": f - g, "<": g - f, "<=": g - f,
                "and": min(f, g), "or": max(f, g), "->": max(-f, g),
            }  # fmt: skip
            return pointwise[op]
    raise AssertionError(term)


numbers = st.recursive(
    st.sampled_from(["a", "b"]) | NUMBERS.map(lambda v: f"({v})"),
    lambda inner: st.tuples(inner, st.sampled_from("+-*"), inner).map(lambda p: f"({p[0]} {p[1]} {p[2]})"),
    max_leaves=3,
)
comparisons = st.tuples(numbers, st.sampled_from([">", ">=", "<", "<="]), numbers).map(" ".join)
bounds = st.one_of(
    st.just(""),
    st.tuples(st.integers(0, 12), st.integers(0, 12)).map(lambda p: f"[{min(p) * DT},{max(p) * DT}]"),
    st.tuples(st.integers(0, 20), st.integers(0, 20)).map(lambda p: f"[{min(p) * 0.15:.2f},{max(p) * 0.15:.2f}]"),
    st.integers(0, 12).map(lambda k: f"[{k * DT},inf]"),
)
formulas = st.recursive(
    comparisons,
    lambda inner: st.one_of(
        st.tuples(st.sampled_from("GF"), bounds, inner).map(lambda p: f"{p[0]}{p[1]}({p[2]})"),
        inner.map(lambda p: f"not ({p})"),
        st.tuples(inner, st.sampled_from(["and", "or", "->"]), inner).map(lambda p: f"({p[0]}) {p[1]} ({p[2]})"),
        st.tuples(inner, bounds, inner).map(lambda p: f"({p[0]}) U{p[1]} ({p[2]})"),
    ),
    max_leaves=4,
)
samples = st.integers(1, 12).flatmap(lambda n: st.tuples(*[st.lists(NUMBERS, min_size=n, max_size=n)] * 2))


@given(formulas, samples)
@settings(max_examples=200, deadline=None)
def test_robustness_is_that_of_the_definition(text, values):
    signals = dict(zip("ab", map(np.array, values), strict=True))
    time = np.arange(len(signals["a"])) * DT
    term = parse(text)
    expected = [oracle(term, signals, time, i) for i in range(len(time))]
    np.testing.assert_allclose(robustness(term, signals.__getitem__, time), expected, rtol=1e-12, atol=1e-12)


@given(formulas, samples, st.lists(st.floats(0.01, 2.0), min_size=12, max_size=12))
@settings(max_examples=60, deadline=None)
def test_samples_need_not_be_even(text, values, steps):
    signals = dict(zip("ab", map(np.array, values), strict=True))
    time = np.cumsum(steps)[: len(signals["a"])]
    term = parse(text)
    expected = [oracle(term, signals, time, i) for i in range(len(time))]
    np.testing.assert_allclose(robustness(term, signals.__getitem__, time), expected, rtol=1e-12, atol=1e-12)


def test_until_holds_over_the_sample_in_which_its_window_begins():
    """That sample was passed over: what held on [0, 1) alone was taken to hold when the window begins at .5 s."""
    time, a, b = np.arange(5.0), np.array([-1.0, 4.0, 4.0, 4.0, 4.0]), np.array([3.0, -1.0, -1.0, -1.0, -1.0])
    assert rho("(a > 0) U[0.5,2] (b > 0)", time, a=a, b=b)[0] == -1.0
    assert rho("(a > 0) U[0,2] (b > 0)", time, a=a, b=b)[0] == 3.0
    longer = np.arange(21.0), *(np.append(v, np.full(16, v[-1])) for v in (b, a))
    for within in ("[6,20]", "[4,20]", "[3.5,9]"):  # the last state holds for ever, as if it were written out
        text = f"(a > 0) U{within} (b > 0)"
        assert rho(text, time, a=b, b=a)[2] == rho(text, longer[0], a=longer[1], b=longer[2])[2] == -1.0


@given(formulas, formulas, bounds, samples)
@settings(max_examples=60, deadline=None)
def test_laws(p, q, within, values):
    signals = dict(zip("ab", map(np.array, values), strict=True))
    time = np.arange(len(signals["a"])) * DT

    def same(one: str, two: str) -> None:
        np.testing.assert_array_equal(rho(one, time, **signals), rho(two, time, **signals))

    same(f"not (({p}) and ({q}))", f"not ({p}) or not ({q})")
    same(f"not (({p}) or ({q}))", f"not ({p}) and not ({q})")
    same(f"G{within}({p})", f"not F{within}(not ({p}))")
    same(f"({p}) -> ({q})", f"not ({p}) or ({q})")
    same(f"not not ({p})", p)
    same(f"F{within}({q})", f"(1e6 > 0) U{within} ({q})")
    np.testing.assert_array_equal(rho(f"not ({p})", time, **signals), -rho(p, time, **signals))


@given(samples, NUMBERS, st.floats(0, 3), bounds)
@settings(max_examples=50, deadline=None)
def test_a_stricter_threshold_is_kept_by_as_much_less(values, threshold, more, within):
    a = np.array(values[0])
    time = np.arange(len(a)) * DT
    loose, strict = (rho(f"G{within} a > ({t!r})", time, a=a) for t in (threshold, threshold + more))
    np.testing.assert_allclose(loose - strict, more, atol=1e-9)


def test_rtamt_agrees():
    rtamt = pytest.importorskip("rtamt")
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 60))
    time = np.arange(60.0)
    texts = {
        "G[0,20](a > -2 and b > -1.5)": "always[0:20]((a >= -2) and (b >= -1.5))",
        "F[3,9](a > b)": "eventually[3:9](a >= b)",
        "G[0,10](a > 1 -> F[0,5](b > 0))": "always[0:10]((a >= 1) implies (eventually[0:5](b >= 0)))",
        "(a > -1) U[2,8] (b > 1)": "(a >= -1) until[2:8] (b >= 1)",
        "not F(a > 2)": "not(eventually(a >= 2))",
        "(a > -1) U (b > 1)": "(a >= -1) until (b >= 1)",
    }
    for ours, theirs in texts.items():
        spec = rtamt.StlDiscreteTimeSpecification()
        spec.declare_var("a", "float")
        spec.declare_var("b", "float")
        spec.spec = theirs
        spec.parse()
        result = spec.evaluate({"time": time.tolist(), "a": a.tolist(), "b": b.tolist()})
        # rtamt takes a window beyond the end for empty: compare where no window reaches it
        expected = np.array([value for _, value in result])[:40]
        np.testing.assert_allclose(rho(ours, time, a=a, b=b)[:40], expected, atol=1e-12, err_msg=ours)


# --- the grammar ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "meaning"),
    [
        ("a > 1 and b > 1 or a > 2", "((a > 1) and (b > 1)) or (a > 2)"),
        ("a > 1 -> b > 1 -> a > 2", "(a > 1) -> ((b > 1) -> (a > 2))"),
        ("G a > 1 and b > 1", "(G(a > 1)) and (b > 1)"),
        ("not a > 1 and b > 1", "(not (a > 1)) and (b > 1)"),
        ("a > 1 U b > 1 and a > 2", "((a > 1) U (b > 1)) and (a > 2)"),
        ("a - b - 1 > 2 * a + 1", "((a - b) - 1) > ((2 * a) + 1)"),
        ("-a / 2 / 3 < .5e1", "(((-a) / 2) / 3) < 5"),
        ("G[0,inf](a>1)", "G(a > 1)"),
    ],
)
def test_precedence(text, meaning):
    assert parse(text) == parse(meaning)


@pytest.mark.parametrize(
    ("text", "column", "words"),
    [
        ("G[0,20](gap > 2 and ttx > 1.5)", 21, "ttx"),
        ("gap", 1, "true or false"),
        ("gap > 2 and 3", 13, "right of 'and'"),
        ("(gap > 2) + 1 > 0", 1, "left of '+'"),
        ("G[3,1] gap > 1", 2, "low <= high"),
        ("G[-1,2] gap > 1", 3, "bound"),
        ("G[0 2] gap > 1", 5, "','"),
        ("gap > 2 )", 9, "end here"),
        ("(gap > 2", 9, "')'"),
        ("1 < gap < 3", 9, "chained"),
        ("gap > $3", 7, "$3"),
        ("gap > 2.5.1", 7, "2.5.1"),
        ("gap > 1e999", 7, "finite"),
        ("gap > ", 6, "signal"),
        ("", 1, "signal"),
        ("gap >> 2", 6, "'>'"),
        ("(" * 500, 41, "nested"),
        ("not " * 500 + "gap > 1", 161, "nested"),
        ("gap > 1" + " + 1" * 600, 2003, "1000 words"),
        ("gap.speed. > 2", 10, "."),
    ],
)
def test_errors_point_at_the_column(text, column, words):
    with pytest.raises(InputError) as error:
        stl(text)
    message = str(error.value)
    assert message.startswith(f"stl, column {column}: ")
    assert words in message
    *_, shown, pointer = message.splitlines()
    assert (shown, pointer) == (f"  {text}", "  " + " " * (column - 1) + "^")


@given(st.text("GFU[](),.><=+-*/ 019ab andortn", max_size=30))
@settings(max_examples=150, deadline=None)
def test_any_text_is_a_formula_or_an_input_error(text):
    message = "stl, column 1"
    try:
        parse(text)
    except InputError as error:
        message = str(error)
    assert message.startswith("stl, column ")


# --- over traces ------------------------------------------------------------------------------------------------


def test_signals_are_finite_and_agree_with_the_metrics():
    run = trace()
    for name in (*PAIR_SIGNALS, *ACTOR_SIGNALS, "time", "co.speed", "co.gap"):
        values = signal(run, name)
        assert values.shape == run.time.shape
        assert np.isfinite(values).all()
    assert stl("G(gap > 0)")(run) == d_min()(run)
    assert stl("G(ttc > 1.5)")(run) == ttc_min()(run) - 1.5
    assert stl("G[0,1](closing > 4)")(run) == 1.0
    assert stl("F(co.speed > ego.speed)")(run) == -5.0
    assert stl("ego.x + 25 > co.x")(run) == 0.0


def test_from_a_rear_end_collision_on_signals_stay():
    run = trace(gap=10.0)  # contact at 2 s
    for name, value in {"gap": 0.0, "ttc": 0.0, "thw": 0.0, "mttc": 0.0, "drac": 100.0, "mdrac": 100.0}.items():
        assert (signal(run, name)[21:] == value).all(), name
    assert stl("G(gap > 0)")(run) == 0.0


def test_what_lies_beyond_the_end_is_the_last_state():
    run = trace(n=11)  # 1 s
    assert stl("F[5,8](gap > 17)")(run) == stl("F[1,1](gap > 17)")(run) == pytest.approx(-2.0)
    assert stl("G[0,20](gap > 15)")(run) == pytest.approx(0.0, abs=1e-12)


def test_a_missing_actor_or_a_division_by_zero_fails_the_run():
    with pytest.raises(RunError, match="no actor 'bike'"):
        stl("G(bike.speed > 1)")(trace())
    with pytest.raises(RunError, match="finite"):
        stl("G(gap / acceleration > 1)", name="odd")(trace())


def test_signal_names():
    check_signal("a.b.speed")
    with pytest.raises(InputError, match="one of time, gap"):
        signal(trace(), "co.time")


@pytest.mark.parametrize("name", ["roundabout_entry", "highway_merge", "unprotected_left_turn", "crossing_pedestrian"])
def test_bare_signals_of_traffic_are_the_worst_over_all(name: str, tmp_path):
    """They asked for an actor `co`, which no run had: every run failed."""
    result = sbt.run(
        campaign="coverage", scenario=name, budget=2, seed=1, store=tmp_path / "s", executor="serial", report=False,
        requirement={"stl": "G[0,20](distance > 1)"},
    )  # fmt: skip
    assert (result.frame["status"] == "ok").all()


def test_a_misspelt_signal_is_told_the_nearest_name():
    for wrong, meant in (("gapp", "gap"), ("ego.sped", "speed")):
        with pytest.raises(InputError, match=f"did you mean '?{meant}"):
            check_signal(wrong)

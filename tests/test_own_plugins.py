"""Metamodels and acquisitions of one's own: any class with fit, any function of a prediction, in real campaigns."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.distance import pdist
from typer.testing import CliRunner

import sbt
from sbt import plugins
from sbt.acquisitions import boundary, greedy, is_greedy, log_scores
from sbt.cli import app
from sbt.config.load import parse
from sbt.errors import InputError, PluginError
from sbt.metamodels.base import build
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.recalibrated import Recalibrated
from sbt.plugins import load
from sbt.problem.requirement import CriticalInterval
from sbt.store.database import Store
from sbt.testing import ContractError, check_acquisition, check_metamodel
from sbt.workflows.running import Summary, run_study
from sbt.workflows.study import Study

PLUGINS = '''
import numpy as np

from sbt.acquisitions import greedy
from sbt.metamodels.prediction import Prediction
from sbt.testbeds import analytic


class Quadratic:
    def __init__(self, ridge=1e-6, *, least=0.05):
        self.ridge, self.least = ridge, least

    def fit(self, u, y, rng):
        basis = lambda v: np.column_stack([np.ones(len(v)), v, v**2, v**3])
        b, (shift, scale) = basis(u), (y.mean(), y.std() or 1e-3)
        w = np.linalg.solve(b.T @ b + self.ridge * np.eye(b.shape[1]), b.T @ ((y - shift) / scale))
        sigma = max(np.std(y - shift - scale * (b @ w)), self.least * scale)
        return lambda v: Prediction.gaussian(shift + scale * (basis(v) @ w), np.full(len(v), sigma))


QUADRATIC = Quadratic(ridge=1e-4)


class Nearest:
    """Doubts what is far from a run."""

    def fit(self, u, y, rng):
        def predict(v):
            distance = np.linalg.norm(v[:, None, :] - u[None], axis=2)
            near = distance.argmin(axis=1)
            return Prediction.gaussian(y[near], 0.02 + 3 * distance[np.arange(len(v)), near])

        return predict


def made(predict):
    class M:
        def fit(self, u, y, rng):
            return predict

    return M


G = Prediction.gaussian
shape = made(lambda v: G(np.zeros((len(v), 1)), np.ones((len(v), 1))))
short = made(lambda v: G(np.zeros(len(v) - 1), np.ones(len(v) - 1)))
nan = made(lambda v: G(np.full(len(v), np.nan), np.ones(len(v))))
negative = made(lambda v: G(np.zeros(len(v)), -np.ones(len(v))))
pair = made(lambda v: (np.zeros(len(v)), np.ones(len(v))))
nothing = made(lambda v: None)


class Tuple:
    def fit(self, u, y, rng):
        return lambda v: (np.zeros(len(v)), np.ones(len(v)))


class Needy:
    def __init__(self, degree, /, order):
        pass

    def fit(self, u, y, rng):
        return None


def score(prediction, critical, log_density):
    return np.log(prediction.sigma)


@greedy
def farthest(prediction, critical, log_density):
    return np.log(prediction.sigma)


class Wide:
    """An object that is declared greedy by its attribute."""

    selection = "greedy"

    def __call__(self, prediction, critical, log_density):
        return prediction.sigma


WIDE = Wide()


def nowhere(prediction, critical, log_density):
    return np.full(len(log_density), -np.inf)


@greedy
def nowhere_greedily(prediction, critical, log_density):
    return np.full(len(log_density), -np.inf)


def broken(prediction, critical, log_density):
    return prediction.sgima  # marked


PLANE = analytic(
    lambda x: 3 * (x[:, 0] - 0.5) + x[:, 1] ** 2, inputs={"a": (0.0, 0.5), "b": (0.0, 0.5)}, critical=(-np.inf, 0.0), name="plane"
)
'''
Run = Callable[..., tuple[Summary, np.ndarray]]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "own.py").write_text(PLUGINS)
    return tmp_path


@pytest.fixture
def run(folder: Path) -> Run:
    """Run a campaign; return its result and x of the runs (n, d)."""

    def runner(store: str = "s", **keys: Any) -> tuple[Summary, np.ndarray]:
        settings = {"campaign": "boundary", "scenario": "own.py:PLANE", "budget": 60, "initial": 20, "batch": 20, "seed": 1,
                    "executor": {"kind": "serial"}, "store": str(folder / store), **keys}  # fmt: skip
        text = "".join(f"{key}: {json.dumps(value)}\n" for key, value in settings.items())
        result = run_study(Study(parse(text, folder=folder)), report=False)
        with Store.read(folder / store) as written:
            return result, written.history().x

    return runner


def plain(name: str, folder: Path) -> Any:
    return load("metamodels", f"own.py:{name}", folder)


def test_a_plain_class_obeys_the_contract(folder):
    check_metamodel(build(plain("Quadratic", folder)), dimensions=(1, 2))


def test_settings_are_the_keyword_arguments_of_the_constructor(folder):
    kind = plain("Quadratic", folder)
    made = build(kind, settings={"ridge": 0.5, "least": 0.1})
    assert (made.ridge, made.least) == (0.5, 0.1)
    assert build(plain("QUADRATIC", folder)).ridge == 1e-4
    assert isinstance(build(plain("Nearest", folder)), plain("Nearest", folder))


class Missing:
    def __init__(self, degree, order, seed=0):
        self.fit = None


class Refuses:
    def __init__(self, degree=1):
        assert degree < 5, "too wiggly"

    def fit(self, u, y, rng):
        return None


class TwoArguments:
    def fit(self, u, y):
        return None


class Anything:
    def __init__(self, **settings):
        self.settings = settings

    def fit(self, u, y, rng):
        return None


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        (Refuses, {"degre": 2}, r"Refuses takes a setting of degree, but got 'degre' \(did you mean 'degree'\?\)"),
        (Refuses, {"degree": 7}, r"Refuses does not take the settings \{'degree': 7\}: AssertionError: too wiggly"),
        (Missing, {"seed": 1}, "Missing needs the settings degree, order, but got seed"),
        (Missing, {"order": 1}, "Missing needs the setting degree, but got order"),
        (Missing, {"degree": 1, "order": 1}, r"must have a method fit\(u, y, rng\), but Missing has not"),
        (TwoArguments, {}, r"must have a method fit\(u, y, rng\), but TwoArguments has not: too many positional arguments"),
        (Refuses(), {"degree": 1}, "Refuses is an object, which takes no settings, but got degree"),
    ],
)
def test_what_a_class_cannot_take_is_said(kind, settings, message):
    with pytest.raises(InputError, match=message):
        build(kind, settings=settings)


def test_positional_only_arguments_and_presets_of_nobody_are_refused(folder):
    with pytest.raises(InputError, match="the constructor of Needy takes degree by position only"):
        build(plain("Needy", folder), settings={"order": 2})
    with pytest.raises(InputError, match=r"Anything takes a preset of \(none\), but got 'paper'"):
        build(Anything, "paper")
    with pytest.raises(InputError, match=r"Refuses takes a preset of \(none\)"):
        build(Refuses(), "paper")
    assert build(Anything, settings={"whatever": 1}).settings == {"whatever": 1}


@pytest.mark.parametrize("campaign", ["boundary", "falsification", "estimation"])
def test_a_plain_class_runs_a_campaign(run, campaign):
    metamodel = {"kind": "own.py:Quadratic", "ridge": 1e-4}
    result, x = run(campaign=campaign, metamodel=metamodel)
    assert len(x) >= 60  # confirmations come beside the budget
    again, same = run("again", campaign=campaign, metamodel=metamodel)
    np.testing.assert_array_equal(x, same)
    assert again.conclusion == result.conclusion


class InPlace:
    """Changes what it, and its predictor, is given."""

    def __init__(self, factor=1.0):
        self.factor = factor

    def fit(self, u, y, rng):
        w, sigma = np.linalg.lstsq(np.column_stack([np.ones(len(u)), u]), y, rcond=None)[0], 1e-9 + y.std() / 4
        if self.factor != 1.0:
            u[:], y[:] = 0.0, 7.0

        def predict(v):
            v *= self.factor
            return Prediction.gaussian(w[0] + (v / self.factor) @ w[1:], np.full(len(v), sigma))

        return predict


METRICS: dict[str, Callable[[float, int], float]] = {
    "smooth": lambda y, seed: y,
    "floor": lambda y, seed: max(y, 0.5) if seed % 7 else y,
    "steps": lambda y, seed: round(y),
    "noise": lambda y, seed: y + (seed * 7919 % 101 - 50) / 25,
}


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("campaign", ["boundary", "falsification", "estimation"])
def test_a_metamodel_that_changes_its_points_changes_no_other_ones(folder, campaign, metric):
    """A boundary had a critical share of 1 for .52, a falsification other runs."""
    plane = sbt.Scenario(
        "plane", [sbt.Parameter("a", 0.0, 1.0), sbt.Parameter("b", 0.0, 1.0)], sbt.Requirement("y", high=0.0),
        evaluate=lambda values, seed: {"y": METRICS[metric](3.0 * (values["a"] - 0.5) + values["b"] ** 2, seed)},
    )  # fmt: skip
    plain, changing = (
        sbt.run(campaign=campaign, scenario=plane, metamodel=InPlace(factor), budget=45, seed=3, initial=20, batch=10,
                executor="serial", store=folder / f"{campaign}{factor}", report=False)
        for factor in (1.0, 0.5)
    )  # fmt: skip
    np.testing.assert_array_equal(changing.history.x, plain.history.x)
    assert changing.conclusion == plain.conclusion
    check_metamodel(InPlace(0.5), dimensions=(2,))


class Columns:
    def fit(self, u, y, rng):
        return lambda v: Prediction.gaussian(np.zeros((len(v), 1)), np.ones((len(v), 1)))


class Raises:
    def fit(self, u, y, rng):
        raise ArithmeticError("no")


class Leaves:
    """Ends the program well, where a script would have to say that nothing was found."""

    def __init__(self, where="fit"):
        self.where = self.at("__init__", where)

    def at(self, place, where):
        return sys.exit(0) if place == where else where

    def fit(self, u, y, rng):
        self.at("fit", self.where)
        return lambda v: self.at("predict", self.where) and Prediction.gaussian(v[:, 0], np.ones(len(v)))


def leaving(prediction, critical, log_density):
    sys.exit(0)


@pytest.mark.parametrize("campaign", ["boundary", "falsification", "estimation"])
@pytest.mark.parametrize("where", ["__init__", "fit", "predict"])
def test_code_that_ends_the_program_is_an_error_that_names_it(tmp_path, campaign, where):
    line = sbt.Scenario("line", [sbt.Parameter("a", 0, 1)], sbt.Requirement("y", high=0.2), evaluate=lambda v, s: {"y": v["a"]})
    said = "Leaves does not take the settings" if where == "__init__" else "metamodel Leaves must learn from .* rows and predict"
    with pytest.raises(sbt.SbtError, match=rf"{said}.* SystemExit: 0"):
        sbt.run(campaign=campaign, scenario=line, metamodel={"kind": Leaves, "where": where}, budget=20, initial=10, batch=10,
                executor="serial", store=tmp_path / "s", report=False)  # fmt: skip


def test_an_acquisition_and_a_check_that_end_the_program_do_not():
    prediction = Prediction.gaussian(np.zeros(3), np.ones(3))
    with pytest.raises(InputError, match="acquisition leaving must score 3 points, but raised SystemExit: 0"):
        log_scores(leaving, prediction, CriticalInterval(high=0.0), np.zeros(3))
    with pytest.raises(ContractError, match=r"a metamodel must learn from .* but raised SystemExit"):
        check_metamodel(Leaves(), dimensions=(2,))
    with pytest.raises(ContractError, match=r"an acquisition must score .* but raised SystemExit"):
        check_acquisition(leaving)


@pytest.mark.parametrize(
    ("metamodel", "said"),
    [
        (Columns(), r"metamodel Columns, fitted to 9 rows: mu must have shape \(n,\), one value a point, but got \(\d+, 1\)"),
        (Recalibrated(Raises()), "metamodel Raises must learn from 9 rows and predict, but raised ArithmeticError: no"),
    ],
)
def test_an_error_names_the_users_class_and_what_it_gave(tmp_path, metamodel, said):
    line = sbt.Scenario("line", [sbt.Parameter("a", 0, 1)], sbt.Requirement("y", high=0.2), evaluate=lambda v, s: {"y": v["a"]})
    with pytest.raises(sbt.SbtError, match=said):
        sbt.run(campaign="boundary", scenario=line, metamodel=metamodel, budget=20, initial=10, batch=10, executor="serial",
                store=tmp_path / "s", report=False)  # fmt: skip


def test_two_packages_with_one_name_are_told(monkeypatch):
    """The one of a stranger was taken, or not, in silence."""
    known = plugins._entries("metamodels")
    stranger = EntryPoint("gp", "theirs:Quadratic", "sbt.metamodels")
    monkeypatch.setattr(plugins, "_entries", lambda kind: {**known, "gp": [*known["gp"], stranger]})
    with pytest.raises(PluginError, match=r"metamodels must have names of their own, but packages offer 'gp' as .*theirs"):
        load("metamodels", "gp")
    load("metamodels", "et")


def test_objects_and_recalibration_work_in_campaigns(run, folder):
    result, _ = run(metamodel={"kind": "own.py:QUADRATIC", "recalibrate": True})
    assert result.runs == 60
    points = folder / "points.csv"
    points.write_text("a,b\n0.1,0.1\n0.4,0.4\n")
    done = CliRunner().invoke(app, ["predict", str(folder / "s"), "--inputs", str(points), "--json"])
    assert done.exit_code == 0, done.output


@pytest.mark.parametrize("campaign", ["boundary", "falsification", "estimation"])
def test_what_is_no_prediction_is_said_with_the_metamodels_name(run, campaign):
    said = r"metamodel Tuple, fitted to .*must return a Prediction, .* but returned a tuple"
    with pytest.raises(Exception, match=said) as caught:
        run(campaign=campaign, metamodel={"kind": "own.py:Tuple"})
    assert type(caught.value).__name__ == "SbtError"


@pytest.mark.parametrize("campaign", ["boundary", pytest.param("falsification", marks=pytest.mark.slow),
                                      pytest.param("estimation", marks=pytest.mark.slow)])  # fmt: skip
@pytest.mark.parametrize(("name", "said"), [
    ("shape", r"mu must have shape \(n,\), one value a point, but got \(\d+, 1\)"),
    ("short", r"a predictor must return one value a point, but returned \d+ for \d+ points?"),
    ("nan", "mean must be finite, but got nan"), ("negative", r"std must be finite and > 0, but got -1\.0"),
    ("pair", r"a predictor must return a Prediction, such as Prediction\.gaussian\(mu, sigma\), but returned a tuple"),
    ("nothing", r"a predictor must return a Prediction, such as Prediction\.gaussian\(mu, sigma\), but returned a NoneType"),
])  # fmt: skip
def test_what_is_no_prediction_is_one_kind_of_error_with_the_configured_name(run, campaign, name, said):
    with pytest.raises(sbt.SbtError, match=rf"^metamodel {name}, fitted to \d+ rows: {said}$") as caught:
        run(campaign=campaign, metamodel={"kind": f"own.py:{name}"})
    assert type(caught.value) is sbt.SbtError


REPEATS = 2
"""Runs that repeat inputs with other seeds, to know whether a simulator is noisy."""


@pytest.mark.parametrize("campaign", ["boundary", "falsification"])
@pytest.mark.parametrize("kind", ["importance", "own.py:score"])
def test_scores_above_zero_are_drawn_from(run, campaign, kind):
    """The density on [0, 0.5]^2 is 4, and so is the largest score of `importance`; log sigma has no bound."""
    result, x = run(campaign=campaign, acquisition={"kind": kind}, metamodel={"kind": "own.py:Nearest"}, validation={"share": 0})
    assert result.conclusion.unscored is None
    assert len(np.unique(x, axis=0)) >= 60 - REPEATS


@pytest.mark.parametrize("campaign", ["boundary", "falsification"])
@pytest.mark.parametrize("kind", ["own.py:nowhere", "own.py:nowhere_greedily"])
def test_an_acquisition_that_scores_nothing_is_told(run, campaign, kind):
    result, _ = run(campaign=campaign, acquisition={"kind": kind}, metamodel={"kind": "own.py:Nearest"})
    assert result.conclusion.unscored == 2
    said = "The acquisition scored nothing above -inf in 2 batches: what it was to choose there is spread evenly."
    assert result.sentences[-1] == said


@pytest.mark.parametrize("campaign", ["boundary", pytest.param("falsification", marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", ["straddle", "expected_feasibility", "u", "own.py:farthest", "own.py:WIDE"])
def test_greedy_acquisitions_are_chosen_greedily(run, campaign, kind):
    """No point twice but the repeats; where the score is the distance to the runs, points lie farther apart than even ones."""
    keys = {"campaign": campaign, "metamodel": {"kind": "own.py:Nearest"}, "validation": {"share": 0}}
    _, x = run(acquisition={"kind": kind}, **keys)
    x = np.unique(x[:60], axis=0)
    assert len(x) == 60 - REPEATS
    if kind.startswith("own.py"):
        _, even = run("even", acquisition={"kind": "even"}, **keys)
        assert pdist(x).min() > pdist(even[:60]).min()


def test_an_error_of_an_acquisition_names_it_and_the_line(run, folder):
    line = next(i for i, text in enumerate(PLUGINS.splitlines(), 1) if "# marked" in text)
    message = rf"acquisition broken must score \d+ points, but raised AttributeError: .*own.py:{line}\)"
    with pytest.raises(InputError, match=message):
        run(acquisition={"kind": "own.py:broken"})


GAUSSIAN = Prediction.gaussian([0.0, 1.0], [1.0, 2.0])


def test_selection_is_declared(folder):
    own = {name: load("acquisitions", f"own.py:{name}", folder) for name in ("score", "farthest", "WIDE")}
    assert {name: is_greedy(each) for name, each in own.items()} == {"score": False, "farthest": True, "WIDE": True}
    for each in own.values():
        check_acquisition(each)

    def other(prediction, critical, log_density):
        return np.zeros(len(prediction))

    assert greedy(other) is other
    other.selection = "gredy"
    with pytest.raises(InputError, match="must be 'draw' or 'greedy', but other has 'gredy'"):
        is_greedy(other)
    with pytest.raises(ContractError, match="must be 'draw' or 'greedy', but got 'gredy'"):
        check_acquisition(other)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda p, c, d: np.zeros(1), r"must return shape \(2,\), but returned \(1,\)"),
        (lambda p, c, d: p.mu * np.nan, "must return scores < inf, but returned nan"),
        (lambda p, c, d: p.mu + np.inf, "must return scores < inf, but returned inf"),
    ],
)
def test_scores_are_checked_where_they_are_made(wrong, message):
    with pytest.raises(InputError, match=message):
        log_scores(wrong, GAUSSIAN, CriticalInterval(high=0.0), np.zeros(2))
    scores = log_scores(boundary, GAUSSIAN, CriticalInterval(high=0.0), np.zeros(2))
    np.testing.assert_array_equal(scores, boundary(GAUSSIAN, CriticalInterval(high=0.0), np.zeros(2)))

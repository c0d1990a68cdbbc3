"""The report: one page that needs nothing else, at any moment of a campaign, whatever the rows hold."""

from __future__ import annotations

import base64
import dataclasses
import re
import shlex
import time
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sbt.campaigns.boundary import BoundaryConclusion
from sbt.campaigns.coverage import CoverageConclusion
from sbt.campaigns.estimation import EstimationConclusion
from sbt.campaigns.failures import FalsificationConclusion
from sbt.campaigns.modes import NearestSafe
from sbt.campaigns.parts import CriticalShare
from sbt.metamodels.prediction import Prediction
from sbt.problem.distribution import Distribution
from sbt.problem.outcome import Outcome, Status
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import CriticalInterval, Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.report import curves, figures
from sbt.report.explorer import explorer_data
from sbt.report.gallery import _lines_of
from sbt.report.html import write_report
from sbt.report.influence import influence_of
from sbt.report.modes import _change
from sbt.report.projection import influence_from_runs, most_influential_pairs, probability_plane
from sbt.report.style import figure_style, new_figure, to_svg
from sbt.report.tables import critical_table, iteration_table, of_run
from sbt.report.words import Findings, requirement_words, warnings_for
from sbt.samplers.sobol import SobolSequence
from sbt.store.database import PlannedRun, Store
from sbt.store.history import VALIDATION
from sbt.store.records import FitRecord, Validation

CRITICAL = CriticalInterval(-5.0, 0.5)
SECTIONS = ("conclusion", "figures", "inputs", "iterations", "critical", "failed", "reproduce", "references")
SCORES = Validation(
    log_likelihood=-0.4, rmse=0.3, average_precision=0.9, precision_at_recall_90=0.8, calibration_error=0.03, n=50, n_critical=17
)


def fit_record(runs, iteration, **scores):
    """Return what the log keeps of a fit."""
    return FitRecord(runs, 0.16, 0.02, 0.1, "", dataclasses.replace(SCORES, **scores), runs=runs, iteration=iteration)



def metric(u):
    """A wedge: about a sixth of the square is critical; inputs after the second matter less and less."""
    weights = np.array([4.0, -5.0, *(1.0 / k for k in range(1, u.shape[1] - 1))])[: u.shape[1]]
    return 2.0 + (u - 0.5) @ weights


def predict(u):
    return Prediction.gaussian(metric(u), np.full(len(u), 0.4))


def scenario_of(d, description="Wedge.\nAn analytic stand-in.", **changes):
    distribution = Distribution.of(kind="normal", mean=0, std=8)
    first = (Parameter("d_t", 0.2, 4.0, "s", description="time gap"), Parameter("d_v", -10.0, 30.0, "m/s", distribution))
    rest = tuple(Parameter(f"x{k}", 0, 5, "", kind="integer") for k in range(2, d))
    return LogicalScenario(
        "wedge", ParameterSpace((first + rest)[:d]), Requirement("ttc_min", CRITICAL.low, CRITICAL.high), description=description,
        evaluate=lambda values, seed: {}, metric_names=("ttc_min", "speed"), **changes,
    )  # fmt: skip


def fill(folder, scenario, runs=60, held_out=50, *, fail=False, fits=True, reason="no SUMO", configuration=None):
    """Return a store as a campaign leaves it."""
    space = scenario.space
    extra = {"campaign": "boundary", "scenario": "wedge", "seed": 7, "budget": runs + held_out, **(configuration or {})}
    store = Store.open(folder, {"names": list(space.names), **extra}, durable=False)  # the disk is not what is tested
    rng = np.random.default_rng(3)
    for iteration, (stage, n) in enumerate([(VALIDATION, held_out), ("initial", runs // 2), ("boundary", runs - runs // 2)]):
        if n == 0:
            continue
        x = space.from_unit(rng.random((n, space.dimension)))
        start, y = store.planned, metric(space.to_unit(x))
        planned = [PlannedRun(stage, dict(zip(space.names, map(float, row), strict=True))) for row in x]
        store.plan(iteration, stage, planned, list(range(start, start + n)), {"acceptance": 0.25, "sobol": [0, n]})
        for k in range(n):
            lost = fail or k == 7
            metrics = {} if lost else {"ttc_min": float(y[k]), "speed": 3.0}
            outcome = Outcome(start + k, Status.FAILED if lost else Status.OK, metrics, reason if lost else "", 0.01)
            store.append(outcome, "sbt 0, libsumo 1.28")
    if fits:
        store.add_fit(fit_record(60, 1))
        store.add_fit(fit_record(110, 2, log_likelihood=-0.2))
    return store


class Page(HTMLParser):
    """What a browser would load, and which ids there are."""

    def __init__(self, text):
        super().__init__()
        self.text, self.ids, self.loads, self.tags = text, [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.tags.append(tag)
        self.ids += [given["id"]] if "id" in given else []
        if tag in ("script", "img", "iframe", "link", "source", "image", "use", "object", "embed"):
            self.loads += [value for key, value in attrs if key in ("src", "href", "xlink:href", "data") and value]


def page_of(store, scenario, predictor=predict, conclusion=None):
    text = write_report(store, scenario, predictor, conclusion).read_text(encoding="utf-8")
    return Page(text.replace("\N{NO-BREAK SPACE}", " "))


@pytest.fixture(scope="module")
def wedge(tmp_path_factory):
    scenario = scenario_of(2)
    with fill(tmp_path_factory.mktemp("wedge"), scenario) as store:
        yield store, scenario, page_of(store, scenario)


def test_needs_nothing_from_outside(wedge):
    page = wedge[2]
    assert all(value.startswith(("#", "data:")) for value in page.loads)
    assert not re.search(r"url\((?!#)|@import|<link|src=\"http", page.text)
    addresses = set(re.findall(r"https?://[^\"'\s<)]+", page.text))
    assert addresses <= {
        "https://doi.org/10.1109/TITS.2022.3206882",
        "http://www.w3.org/2000/svg",
        "http://www.w3.org/1999/xlink",
    }


def test_has_every_section_and_figure_and_no_id_twice(wedge):
    store, _, page = wedge
    assert set(SECTIONS) <= set(page.ids)
    assert len(page.ids) == len(set(page.ids))
    names = {"runs", "probability", "validation", "precision_recall", "reliability", "metric", "progress"}
    assert names <= set(page.ids)
    assert names == {path.stem for path in (store.folder / "figures").glob("*.svg")}
    for text in ("ttc_min in [-5, 0.5]", "normal (mean 0, std 8)", "held-out runs", "acceptance 0.25"):
        assert text in page.text


def test_is_the_same_twice(wedge):
    store, scenario, page = wedge
    before = {path.name: path.read_bytes() for path in (store.folder / "figures").iterdir()}
    assert page_of(store, scenario).text == page.text
    assert before == {path.name: path.read_bytes() for path in (store.folder / "figures").iterdir()}
    assert not any(b"<dc:date>" in content for content in before.values())


def test_critical_and_failed_runs_are_replayed_from_the_store(wedge):
    store, _scenario, page = wedge
    history = store.history()
    shown = history.where(CRITICAL.contains(history.y("ttc_min")) | ~history.ok)
    commands = {tuple(shlex.split(c)) for c in re.findall(r"<code>(sumo-sbt replay [^<]*)</code>", page.text)}
    assert {("sumo-sbt", "replay", str(store.folder), str(index)) for index in shown.index} <= commands


def test_hostile_text_stays_text(tmp_path):
    evil = "<script>alert(1)</script></noscript>\n</style><img src=http://x.invalid/a onerror=alert(2)> ${x} {{ 7*7 }}"
    space = ParameterSpace((Parameter("a", 0, 1, "$<b>&\\frac"), Parameter("b", 0, 1, "--><script>", description=evil)))
    scenario = LogicalScenario(
        "evil", space, Requirement("m", CRITICAL.low, CRITICAL.high), description=evil, evaluate=lambda v, s: {},
    )
    configuration = {"names": ["a", "b"], "scenario": "my; rm -rf <x>.yaml", "campaign": evil}
    with Store.open(tmp_path, configuration) as store:
        store.plan(0, "<b>$stage", [PlannedRun("<b>$stage", {"a": 0.1, "b": 0.2})] * 2, [1, 2], {"<i>": "<i>"})
        store.append(Outcome(0, Status.OK, {"m": 0.1}))
        store.append(Outcome(1, Status.FAILED, {}, evil))
        page = page_of(store, scenario)
    assert page.tags.count("script") == 4
    assert "img" not in page.tags
    assert page.text.count("</noscript>") == page.tags.count("noscript") == 2
    assert "{{ 7*7 }}" in page.text


@pytest.mark.parametrize("predictor", [None, predict])
def test_empty_store(tmp_path, predictor):
    scenario = scenario_of(2)
    with fill(tmp_path, scenario, 0, 0, fits=False) as store:
        page = page_of(store, scenario, predictor)
    assert set(SECTIONS) <= set(page.ids)
    assert "not concluded" in page.text
    assert "No run has given a metric yet" in page.text


@pytest.mark.parametrize("d", [1, 2, 7])
def test_all_failed(tmp_path, d):
    scenario = scenario_of(d)
    with fill(tmp_path, scenario, fail=True, fits=False) as store:
        page = page_of(store, scenario, None)
    assert "110 of 110 runs failed" in page.text
    assert "no SUMO" in page.text


@pytest.mark.parametrize(
    ("d", "held_out", "predictor"),
    [(1, 0, None), (2, 12, predict), (7, 50, None), (20, 0, predict)],
)
def test_any_number_of_inputs(tmp_path, d, held_out, predictor):
    scenario = scenario_of(d)
    with fill(tmp_path, scenario, held_out=held_out) as store:
        page = page_of(store, scenario, predictor)
    assert {"runs", "metric", "progress"} <= set(page.ids)
    assert ("probability" in page.ids) == (predictor is not None)
    assert ("reliability" in page.ids) == (predictor is not None and held_out >= 20), "of a handful nothing can be read"


def test_thousands_of_runs_stay_a_small_file(tmp_path):
    scenario = scenario_of(5)
    with fill(tmp_path, scenario, 4500, 500) as store:
        start = time.process_time()
        path = write_report(store, scenario, predict, None)
        assert time.process_time() - start < 10
    assert path.stat().st_size < 5_000_000
    assert "more critical runs are in the store" in path.read_text(encoding="utf-8")


def test_writes_elsewhere_and_leaves_no_temporary_file(tmp_path):
    scenario = scenario_of(2)
    with fill(tmp_path / "store", scenario) as store:
        assert write_report(store, scenario, None, None, folder=tmp_path / "out") == tmp_path / "out" / "report.html"
    assert not (tmp_path / "store" / "report.html").exists()
    assert not [path for path in Path(tmp_path / "out").rglob(".*")]


def warned(tmp_path, conclusion=None, fit=None, runs=60, **settings):
    scenario = scenario_of(2)
    with fill(tmp_path, scenario, runs, fits=False, **settings) as store:
        if fit is not None:
            store.add_fit(fit_record(110, 2, **fit))
        if conclusion is not None:
            store.conclude({"stopped": "budget"})
        return " ".join(warnings_for(Findings.of(store, scenario, conclusion)))


def test_says_what_limits_the_conclusion(tmp_path):
    done = EstimationConclusion(0.1, 0.0, 0.2, warnings=("own warning",))
    assert "not concluded: 110 of 110" in warned(tmp_path / "a")
    text = warned(tmp_path / "b", done, {"n_critical": 3, "calibration_error": 0.3})
    for part in ("Only 3 critical runs", "Poor calibration", "Own warning.", "3 of 110 runs failed"):
        assert part in text
    assert "not concluded" not in text
    fine = warned(tmp_path / "c", EstimationConclusion(0.1, 0.0, 0.2), {})
    assert "Only" not in fine
    assert "calibration" not in fine
    assert "never tested" in warned(tmp_path / "d", done, {"n": 0, "n_critical": 0})


def test_says_where_runs_lie_beyond_the_critical_interval(tmp_path):
    scenario = scenario_of(2)
    with fill(tmp_path, scenario) as store:
        narrow = dataclasses.replace(scenario, requirement=Requirement("ttc_min", 0.0, 0.5))
        n = int((store.history().y("ttc_min") < 0).sum())
        assert f"{n} runs have ttc_min below 0, beyond" in " ".join(warnings_for(Findings.of(store, narrow, None)))
        assert "beyond" not in " ".join(warnings_for(Findings.of(store, scenario, None)))


@pytest.mark.parametrize(
    ("result", "expected"),
    [
        (
            CoverageConclusion(0.163, 0.12, 0.21),
            "16.3 % of what gives a metric in the parameter space of wedge is critical (ttc_min in [-5, 0.5]; 95 % interval",
        ),
        (BoundaryConclusion(0.163, 0.01, 0.1, None), "takes 16.3 % of the parameter space"),
        (
            BoundaryConclusion(0.163, 0.01, 0.1, None, held_out_fraction=CriticalShare(0.2, 0.1, 0.3, 0.95, 150)),
            "the 150 held-out runs alone say 20 % (95 % interval 10 % to 30 %). They agree",
        ),
        (
            FalsificationConclusion(11, 12, 5, (), None, None, "What follows."),
            "falsified: 5 of 110 runs of the search were critical (ttc_min in [-5, 0.5]), the first after 12 runs",
        ),
        (FalsificationConclusion(None, None, 0, (), None, None, ""), "not falsified"),
        (EstimationConclusion(1.2e-5, 8e-6, 2e-5), "1.2e-05 (95 % interval 8e-06"),
        (EstimationConclusion(0.0, 0.0, 0.003, exact_bound=0.003), "at most 0.003"),
        (BoundaryConclusion(None, None, None, None), "by 50 runs spread evenly over it"),
        (None, "from 50 runs spread over it"),
    ],
)
def test_conclusion_in_words(tmp_path, result, expected):
    scenario = scenario_of(2)
    with fill(tmp_path, scenario) as store:
        store.conclude({"stopped": "budget", "seconds": {"fit": 2.0}})
        assert expected in page_of(store, scenario, None, result).text


def test_ego_of_the_campaign_is_not_forgotten(tmp_path):
    scenario = scenario_of(2)
    (tmp_path / "a b").mkdir()
    with fill(tmp_path / "a b", scenario, configuration={"ego": {"kind": "acc"}}) as store:
        store.conclude({"store": "runs/before it was moved"})
        text = page_of(store, scenario, None).text
    assert "which <code>simulate</code> does not know" in text
    assert f"replay &#39;{store.folder}&#39; RUN" in text


def test_requirement_in_words():
    assert requirement_words(Requirement("ttc_min", CRITICAL.low, CRITICAL.high), "s") == "ttc_min in [-5, 0.5] s"
    assert requirement_words(Requirement("m", high=0.0), "") == "m ≤ 0"
    assert requirement_words(Requirement("m", low=2.0), "m") == "m ≥ 2 m"


def test_influence_finds_what_matters(tmp_path):
    influence = influence_of(predict, CRITICAL, 4)
    assert influence.relative.argmax() == 1
    assert (influence.low <= influence.total).all()
    assert (influence.total <= influence.high).all()
    assert influence_of(lambda u: predict(u * 0 + 0.5), CRITICAL, 4) is None
    drawn = SobolSequence(8, seed=0).points(0, 2)
    here, moved = drawn[0, :4], np.concatenate([drawn[1, 4:5], drawn[1, 1:4]])

    def sharp(u):  # critical at one of the points, and where one input of another one is changed
        mean = np.where((u == here).all(axis=1) | (u == moved).all(axis=1), 0.0, 100.0)
        return Prediction.gaussian(mu=mean, sigma=np.full(len(u), 0.01))

    alone = influence_of(sharp, CRITICAL, 4)
    assert alone is None or all(np.isfinite(values).all() for values in (alone.total, alone.low, alone.high))
    scenario = scenario_of(4)
    with fill(tmp_path, scenario, 400, 0) as store:
        order = influence_from_runs(store.history(), scenario.requirement)
    assert order.argmax() == 1
    assert order.max() == 1.0
    pairs = most_influential_pairs(np.array([0.1, 1.0, 0.5, 0.2, 0.0]))
    assert pairs[0] == (1, 2)
    assert len(pairs) == 6
    assert all(4 not in pair for pair in pairs)
    assert most_influential_pairs(np.zeros(20)) == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]


def test_plane_is_the_mean_over_the_other_inputs():
    space = scenario_of(3).space
    plane = probability_plane(predict, CRITICAL, space, (0, 1), samples=8)
    assert plane.probability.shape == (len(plane.axes[1]), len(plane.axes[0]))
    u = np.random.default_rng(0).random((4000, 3))
    u[:, 0], u[:, 1] = 0.5, 1.0
    by_hand = predict(u).probability(CRITICAL).mean()
    at = plane.probability[-1, len(plane.axes[0]) // 2]
    assert plane.averaged == 8
    assert at == pytest.approx(by_hand, abs=0.05)


def test_plane_leaves_out_what_the_constraints_forbid():
    rule = ("d_t < 2", lambda columns: columns["d_t"] < 2.0)
    space = ParameterSpace(scenario_of(2).space.parameters, constraints=(rule,))
    plane = probability_plane(predict, CRITICAL, space, (0, 1))
    assert (np.isnan(plane.probability) == (plane.axes[0] >= 2.0)[None, :]).all()
    with figure_style():
        figures.plot_probability(plane, space, new_figure().subplots())


def test_integer_inputs_are_drawn_value_by_value():
    space = scenario_of(3).space
    plane = probability_plane(predict, CRITICAL, space, (1, 2), samples=2)
    assert plane.axes[1].tolist() == [0, 1, 2, 3, 4, 5]


def test_star_and_base_rate():
    with figure_style():
        ax = curves.plot_precision_recall(
            np.array([0.9, 0.8, 0.7, 0.1]), np.array([True, False, True, False]), new_figure().subplots()
        )
    star = next(line for line in ax.lines if line.get_marker() == "*")
    assert star.get_ydata()[0] == pytest.approx(2 / 3)
    assert any("base rate 0.5" in text.get_text() for text in ax.get_legend().get_texts())


def test_svgs_of_a_page_share_no_id():
    with figure_style():
        texts = []
        for name in ("one", "two"):
            figure = new_figure()
            figure.subplots().plot([0, 1], [0, 1])
            texts.append(to_svg(figure, name))
    first, second = (set(re.findall(r' id="([^"]+)"', text)) for text in texts)
    assert first
    assert not first & second
    references = set(re.findall(r'href="#([^"]+)"', texts[0]))
    assert references
    assert references <= first


def test_user_settings_of_matplotlib_are_left_alone():
    import matplotlib as mpl

    with mpl.rc_context({"font.size": 31.0}):
        with figure_style():
            assert mpl.rcParams["font.size"] < 12
        assert mpl.rcParams["font.size"] == 31.0


def test_of_runs_with_the_same_margin_the_hardest_impact_comes_first(tmp_path):
    """A metric that saturates at a contact says nothing of how bad the contact is."""
    runs = {"a": np.linspace(0.0, 1.0, 4)}
    scenario = LogicalScenario(
        "s", ParameterSpace((Parameter("a", 0, 1),)), Requirement("ttc_min", high=0.1), evaluate=lambda v, s: {},
        metric_names=("ttc_min", "impact_speed"),
    )  # fmt: skip
    with Store.open(tmp_path, {"names": ["a"], "scenario": "s", "campaign": "coverage"}) as store:
        store.plan(0, "even", [PlannedRun("even", {"a": float(a)}) for a in runs["a"]], [1, 2, 3, 4], {})
        for k, speed in enumerate((3.0, 9.0, 6.0, 0.0)):
            store.append(Outcome(k, Status.OK, {"ttc_min": 0.0 if speed else 2.0, "impact_speed": speed}))
        table = critical_table(store.history(), scenario.requirement, "s")
        data = explorer_data(Findings.of(store, scenario, None), scenario, None, np.ones(1))
    assert [row[0].text for row in table.rows] == ["1", "2", "0"]
    assert np.frombuffer(base64.b64decode(data["rank"]), "<i4").tolist() == [2, 0, 1, 3]


def test_a_batch_is_of_the_stages_that_its_runs_name(tmp_path):
    with Store.open(tmp_path, {"names": ["d_t", "d_v"], "scenario": "w", "campaign": "coverage"}, durable=False) as store:
        stages = ("initial", "repeat", "initial")
        store.plan(0, "search", [PlannedRun(stage, {"d_t": 1.0, "d_v": 2.0}) for stage in stages], [1, 2, 3], {})
        for k in range(3):
            store.append(Outcome(k, Status.OK, {"ttc_min": 1.0}))
        table = iteration_table(store.iterations(), [fit_record(3, 9)], store.history(), Requirement("ttc_min", high=0.5))
    assert table.rows[0][1].text == "initial, repeat"
    assert table.columns == ("iteration", "stage", "runs", "critical", "failed", "how it was chosen"), "no column without a value"


def test_what_spares_a_failure_may_be_the_seed_alone():
    mode = SimpleNamespace(nearest_safe=NearestSafe(27, {}, 0.3544, {}))
    assert _change(mode, scenario_of(2).space) == "another seed: 0.3544 (run 27)"


def test_a_caption_speaks_of_the_lines_there_are():
    assert "no line is drawn" in _lines_of(np.full((3, 3), 0.02), whole=True)
    assert "P is at most 0.064 all over" in _lines_of(np.array([[1e-7, 0.064]]), whole=True)
    both = _lines_of(np.array([[0.0, 1.0]]), whole=True)
    assert "Solid: P = 0.5" in both
    assert "dashed: 0.1 and 0.9" in both
    assert _lines_of(np.array([[0.0, 0.3]]), whole=False) == " Dashed: 0.1."


def test_a_first_look_reads_runs_that_are_evenly_spaced(tmp_path):
    """The same rows as of all runs, at most so many, from the first to the last; those without an outcome are none."""
    scenario = scenario_of(2)
    with fill(tmp_path, scenario, runs=60, held_out=40, fits=False) as store:
        store.plan(9, "boundary", [PlannedRun("boundary", {"d_t": 1.0, "d_v": 2.0})], [7], {})
        whole, some, all_ = store.history(), store.sample(20), store.sample(500)
        assert all_.index.tolist() == whole.index.tolist()
        assert len(some) <= 20
        assert np.diff(some.index).max() <= 6
        np.testing.assert_array_equal(some.x, whole.x[some.index])
        np.testing.assert_array_equal(some.y("ttc_min"), whole.y("ttc_min")[some.index])


def test_where_every_run_failed_the_first_sentence_says_so(tmp_path):
    """With what to do next, and no figure that shows nothing."""
    scenario = scenario_of(2)
    with fill(tmp_path, scenario, runs=10, held_out=0, fail=True, fits=False) as store:
        text = page_of(store, scenario, None, CoverageConclusion(None, 0.0, 1.0)).text
    assert "Nothing is known of wedge: none of 10 runs gave a metric." in text
    assert 'id="figure-progress"' not in text


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        ("sumo-sbt replay 'RUN 1/RUN' RUN", "sumo-sbt replay 'RUN 1/RUN' 7"),
        ("sumo-sbt replay runs/RUNS RUN --gif RUN.gif", "sumo-sbt replay runs/RUNS 7 --gif 7.gif"),
        ("sbt.open('RUN', scenario=s).replay(RUN)", "sbt.open('RUN', scenario=s).replay(7)"),
    ],
)
def test_a_command_of_a_run_leaves_the_name_of_the_folder_alone(command, expected):
    assert of_run(command, 7) == expected


@pytest.mark.parametrize(("ends", "direction"), [((3.0, np.inf), "high"), ((-np.inf, 3.0), "low"), ((0.0, 3.0), "low")])
def test_which_values_of_a_metric_of_ones_own_are_bad_is_said_by_the_requirement(ends, direction):
    """Of a count of at least 3, all uncritical runs were "below 3, beyond the critical interval. Is that meant?"."""
    space = ParameterSpace((Parameter("a", 0.0, 1.0),))
    scenario = LogicalScenario("own", space, Requirement("count", *ends), evaluate=lambda v, s: {}, metric_names=("count",))
    assert scenario.direction == direction

"""Laws of inputs with choices: words outside, exact masses inside, and no order among them."""

from __future__ import annotations

import html
import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from studies import run_loaded
from typer.testing import CliRunner

import sbt
from sbt.cli import app
from sbt.config.assemble import assemble
from sbt.config.load import parse
from sbt.errors import InputError, RunError, StoreError
from sbt.estimators.choices import choice_scores, from_cube, log_normal, log_wide, to_cube
from sbt.estimators.importance import draw_systematic, plan_batch
from sbt.estimators.mixture import Mixture, fit_mixture, wide_scales
from sbt.estimators.surrogate import Coordinates
from sbt.loop.stages import Shard
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.problem.cube import Cube
from sbt.problem.description import describe_scenario, rebuild_scenario, scenario_differences
from sbt.problem.expression import Expression
from sbt.problem.outcome import Outcome, Status
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import CriticalInterval
from sbt.problem.space import ParameterSpace
from sbt.samplers import evolution, portfolio
from sbt.samplers.search import DEFLATION, Search, deflate, refine_best
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream
from sbt.store.database import PlannedRun, Store
from sbt.sumo.template import fill, template
from sbt.workflows.merging import merge_shards

KINDS = ("car", "truck", "bicycle", "bus")
SHARES = {"car": 0.7, "truck": 0.2, "bicycle": 0.09, "bus": 0.01}
KIND = Parameter("kind", choices=KINDS)
WEIGHTED = Parameter("kind", choices=SHARES)
SPEED = Parameter("v", 5.0, 25.0, "m/s")
SPACE = ParameterSpace((SPEED, WEIGHTED, Parameter("gap", 5.0, 60.0, "m")))
BAD = "bicycle"


def metric(values, seed):
    """Return a metric that is <= 0 for the bicycle alone, in an ellipse of speed and gap."""
    distance = ((values["v"] - 10) / 3) ** 2 + ((values["gap"] - 40) / 10) ** 2
    return {"m": distance - 1 if values["kind"] == BAD else distance + 2}


def scenario(choices=KINDS, evaluate=metric):
    inputs = [SPEED, Parameter("gap", 5.0, 60.0, "m"), Parameter("kind", choices=choices)]
    return sbt.Scenario("kinds", inputs=inputs, evaluate=evaluate, requirement=sbt.Requirement("m", high=0.0))


# Maps and masses


@pytest.mark.parametrize("p", [KIND, WEIGHTED])
def test_maps_of_choices_return_to_the_choice_and_their_masses_sum_to_one(p):
    x = np.arange(4.0)
    assert (p.from_unit(p.to_unit(x)) == x).all()
    assert (p.from_normal(p.to_normal(x)) == x).all()
    assert np.exp(p.log_density(x)).sum() == pytest.approx(1.0)
    assert (p.log_density(np.array([-1.0, 0.5, 4.0])) == -np.inf).all()
    z = np.linspace(-9, 9, 200_001)
    share = np.array([np.trapezoid(stats.norm.pdf(z) * (p.from_normal(z) == k), z) for k in range(4)])
    assert share == pytest.approx(np.exp(p.log_density(x)), abs=1e-4)


def test_a_design_is_balanced_and_a_sample_follows_the_probabilities():
    design = SPACE.from_unit(SobolSequence(3, seed=1).points(0, 256))[:, 1]
    assert np.bincount(design.astype(int)).tolist() == [64, 64, 64, 64]
    drawn = np.bincount(SPACE.sample(20_000, stream(1, "sample"))[:, 1].astype(int), minlength=4)
    assert stats.chisquare(drawn, 20_000 * np.array(list(SHARES.values()))).pvalue > 1e-3


def test_choices_are_words_wherever_an_input_is_named():
    x = np.array([10.0, 2.0, 30.0])
    assert SPACE.named(x) == {"v": 10.0, "kind": "bicycle", "gap": 30.0}
    assert (SPACE.numbers(SPACE.named(x)) == x).all()
    assert SPACE.values({"v": 7.0}) == {"v": 7.0, "kind": "car", "gap": 32.5}  # the likeliest
    described = json.loads(json.dumps(describe_scenario(scenario(SHARES))))
    again = rebuild_scenario(described)
    assert again.space.parameters[2] == Parameter("kind", choices=SHARES)
    other = describe_scenario(scenario([*KINDS[:3], "tram"]))
    assert "choices of input kind" in scenario_differences(described, other)


WRONG = {
    "one": (lambda: Parameter("k", choices=["car"]), "at least two choices are needed, but got car"),
    "none": (lambda: Parameter("k", kind="categorical"), "at least two choices are needed, but got none"),
    "nothing": (lambda: Parameter("k"), "a range (low, high) or choices are needed"),
    "doubled": (lambda: Parameter("k", choices=["a", "b", "a"]), "'a' stands twice"),
    "number": (lambda: Parameter("k", choices=["a", 1]), "a choice must be text (write a number in quotes), but got 1"),
    "blank": (lambda: Parameter("k", choices=["a", " "]), "text on one line without blanks around it, but got ' '"),
    "line": (lambda: Parameter("k", choices=["a", "b\nc"]), r"but got 'b\nc'"),
    "text": (lambda: Parameter("k", choices="ab"), "choices must be a list of texts"),
    "range": (lambda: Parameter("k", 0, 5, choices=["a", "b"]), "a range or choices, not both, but got choices and high"),
    "kind": (lambda: Parameter("k", kind="integer", choices=["a", "b"]), "an input with choices is categorical"),
    "sum": (lambda: Parameter("k", choices={"a": 0.5, "b": 0.4}), "must sum to 1, but sum to 0.9"),
    "zero": (lambda: Parameter("k", choices={"a": 1.0, "b": 0.0}), "between 0 and 1, but 'a' has 1.0"),
    "word": (lambda: Parameter("k", choices={"a": 0.5, "b": "x"}), "between 0 and 1, but 'b' has 'x'"),
    "few": (lambda: Parameter("k", choices=["a", "b"], probabilities=[1.0]), "2 choices and 1 probabilities"),
    "value": (lambda: SPACE.values({"kind": "trunk"}), "but got 'trunk' (did you mean 'truck'?)"),
    "digit": (lambda: SPACE.values({"kind": 1}), "input kind must be one of car, truck, bicycle, bus, but got 1"),
    "copula": (
        lambda: ParameterSpace((SPEED, KIND), ((1.0, 0.3), (0.3, 1.0))), "no order to correlate by, but kind is in a correlation"
    ),
    "arithmetic": (
        lambda: ParameterSpace((SPEED, KIND), features=(("f", Expression("v * kind")),)), "'kind' in 'v * kind' is an input with"
    ),
    "unknown": (
        lambda: ParameterSpace((SPEED, KIND), constraints=(("c", Expression("kind == 'cat'")),)), "(did you mean 'car'?)"
    ),
    "reverse": (
        lambda: ParameterSpace((SPEED, KIND), constraints=(("c", Expression("v != 'car'")),)), "'v' in 'v != 'car'' is a number"
    ),
    "order": (lambda: Expression("kind < 'car'"), "an expression may use numbers"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_wrong_choices_are_told_with_rule_and_value(name):
    make, message = WRONG[name]
    with pytest.raises(InputError) as error:
        make()
    assert message in str(error.value)


def test_constraints_compare_with_choices():
    space = ParameterSpace((SPEED, KIND), constraints=(("slow trucks", Expression("not (kind == 'truck' and v > 20)")),))
    assert space.feasible(np.array([[21.0, 1.0], [19.0, 1.0], [21.0, 0.0]])).tolist() == [False, True, True]
    x = space.sample(4000, stream(1, "constrained"))
    assert x[x[:, 1] == 1.0, 0].max() <= 20.0
    assert np.exp(space.log_density(x)).max() == pytest.approx(1 / (20 * 4 * space.feasible_mass))
    assert Expression("4 + 8 * ('truck' == kind)")({"kind": "truck"}) == 12.0


def test_a_configuration_takes_some_of_the_choices_and_says_what_is_wrong(tmp_path):
    (tmp_path / "s.py").write_text(
        "import sbt\n"
        "SCENARIO = sbt.Scenario('s', inputs=[sbt.Parameter('v', 5, 25), sbt.Parameter('kind', choices=['car', 'truck', 'bus'])],"
        " evaluate=lambda values, seed: {'m': values['v']}, requirement=sbt.Requirement('m', high=6.0))\n"
    )
    text = "campaign: coverage\nscenario: s.py:SCENARIO\n"

    def space(line: str):
        return assemble(parse(text + line, folder=tmp_path)).scenario.space

    assert space("inputs: {kind: {choices: [bus, car]}}").choices == {"kind": ("bus", "car")}
    assert space("inputs: {kind: {choices: {bus: 0.25, car: 0.75}}}").parameters[1].probabilities == (0.25, 0.75)
    for line, told in {
        "inputs: {kind: {choices: [bus, cra]}}": "inputs.kind: input kind must be one of car, truck, bus, but got 'cra'",
        "inputs: {kind: {choices: [bus]}}": "at least two choices",
        "inputs: {kind: {min: 1}}": "input kind has choices (car, truck, bus), but got min",
        "inputs: {v: {choices: [a, b]}}": "input v has the range [5, 25], but got choices",
        "correlation: [{inputs: [v, kind], value: 0.5}]": "correlation: an input with choices has no order",
        "constraints: ['kind > 1']": "constraints.0: 'kind' in 'kind > 1' is an input with choices",
        "constraints: [\"kind == 'bsu'\"]": "(did you mean 'bus'?)",
        "features: {f: kind}": "features.f: 'kind' in 'kind' is an input with choices",
    }.items():
        with pytest.raises(InputError) as error:
            space(line)
        assert told in str(error.value)


# Geometry


def test_no_choice_is_nearer_than_another():
    u = SPACE.to_unit(np.array([[10.0, k, 30.0] for k in range(4)]))
    at = SPACE.cube.embedded(u)
    assert at.shape == (4, 6)
    apart = [np.linalg.norm(a - b) for a, b in itertools.combinations(at, 2)]
    assert apart == pytest.approx([1.0] * 6)
    assert (SPACE.cube.restored(at, 3) == u).all()
    whole = ParameterSpace((Parameter("n", 1, 4, kind="integer"),))
    assert whole.metamodel_inputs(np.array([[0.26], [0.49]])).tolist() == [[0.375], [0.375]]  # what is run is what is predicted
    plain = ParameterSpace((SPEED,))
    assert plain.metamodel_inputs(u[:, :1]) is u[:, :1] or (plain.metamodel_inputs(u[:, :1]) == u[:, :1]).all()


def test_steps_take_every_other_choice_alike_and_never_one_between():
    cube, rng = Cube(nominal=((0, 5),)), stream(1, "flip")
    start = np.full((20_000, 1), 0.1)
    stepped = cube.flipped(start + 0.2, start, 0.3, rng)
    counts = np.bincount(cube.choices(stepped)[:, 0].astype(int), minlength=5)
    assert stats.chisquare(counts, 20_000 * np.array([0.7, *[0.075] * 4])).pvalue > 1e-3
    assert set(np.round(stepped[:, 0], 6)) == {0.1, 0.3, 0.5, 0.7, 0.9}


def test_deflation_leaves_other_choices_alone_and_trust_regions_keep_to_one():
    search = Search(CriticalInterval(high=0.0), GaussianProcess(), cube=SPACE.cube)
    hit = SPACE.to_unit(np.array([[15.0, 1.0, 30.0]]))
    free = deflate(search, hit, stream(1, "probe"), 3)
    assert free.radius == DEFLATION
    same_place = SPACE.to_unit(np.array([[15.0, k, 30.0] for k in range(4)]))
    assert free(SPACE.cube.embedded(same_place)).tolist() == [True, False, True, True]
    best = portfolio.regions(same_place, np.array([0.1, 0.2, 0.3, 9.0]), np.arange(4.0), SPACE.cube)
    assert [SPACE.cube.choices(r.centre[None])[0, 0] for r in best] == [0.0, 1.0]
    small = portfolio.Region(same_place[1], 2.0**-6).candidates(2000, stream(1, "region"), SPACE.cube)
    assert (SPACE.cube.choices(small)[:, 0] == 1.0).mean() > 0.98
    found, value = refine_best(
        lambda u: -np.abs(SPACE.cube.choices(u)[:, 0] - 2.0), same_place[:1], lambda u: np.ones(len(u), bool),
        stream(2, "refine"), SPACE.cube,
    )  # fmt: skip
    assert (SPACE.cube.choices(found)[value == 0.0] == 2.0).all()


def test_an_evolution_strategy_moves_between_choices_by_none_of_their_order():
    pytest.importorskip("cma")
    start, margins, taken = np.array([0.5, 0.125, 0.5]), [], []
    for _ in range(25):
        picks = evolution.propose(start, margins, 10, 3, SPACE.cube)
        kinds = SPACE.cube.choices(picks.u)[:, 0]
        taken.append(kinds)
        margins.append(np.where(kinds == 3.0, 0.0, 1.0) + ((picks.u[:, [0, 2]] - 0.3) ** 2).sum(axis=1))
    assert set(np.concatenate(taken[:5])) == {0.0, 1.0, 2.0, 3.0}
    assert (np.concatenate(taken[15:]) == 3.0).mean() > 0.6  # from the first of the list to the last


def test_the_order_and_the_names_of_choices_do_not_change_what_a_gaussian_process_predicts():
    rng = stream(1, "data")
    x = np.column_stack([rng.uniform(5, 25, 60), rng.integers(0, 4, 60), rng.uniform(5, 60, 60)])
    y = np.array([metric(SPACE.named(row), 0)["m"] for row in x])
    at = np.column_stack([rng.uniform(5, 25, 200), rng.integers(0, 4, 200), rng.uniform(5, 60, 200)])

    def predicted(order: list[int]):
        space = ParameterSpace((SPEED, Parameter("kind", choices=[f"name {k}" for k in order]), SPACE.parameters[2]))
        move = np.argsort(order).astype(float)

        def moved(points):
            return np.column_stack([points[:, 0], move[points[:, 1].astype(int)], points[:, 2]])

        inputs = [space.metamodel_inputs(space.to_unit(moved(points))) for points in (x, at)]
        return GaussianProcess().fit(inputs[0], y, stream(1, "fit"))(inputs[1])

    one, other = predicted([0, 1, 2, 3]), predicted([2, 0, 3, 1])
    assert other.mu == pytest.approx(one.mu, abs=0.02 * y.std())
    assert np.log(other.sigma) == pytest.approx(np.log(one.sigma), abs=0.1)


# Proposals of the estimation


ALONE = ParameterSpace((WEIGHTED, Parameter("other", choices=KINDS)))


@pytest.mark.parametrize("space", [SPACE, ALONE], ids=["mixed", "choices alone"])
def test_the_density_of_a_proposal_is_exact_in_its_choices(space):
    scores, rng = choice_scores(space), stream(1, "proposal")
    wide = wide_scales(Coordinates(space).bounded)
    cloud = rng.standard_normal((800, space.dimension))
    cloud = cloud[scores[0].cells(cloud) != 0]  # a region without the likeliest choice
    h = fit_mixture((cloud,), wide, rng, choices=scores)
    z, component = h.sample(40_000, rng)
    w = np.exp(log_normal(z) - h.log_density(z))
    assert w.max() <= 10.0 + 1e-9
    assert w.mean() == pytest.approx(1.0, abs=4 * w.std() / 200)
    x = space.from_normal(z)
    for k, choice in enumerate(scores):
        for cell, p in enumerate(choice.shares):
            hit = w * (choice.cells(z) == cell)
            assert hit.mean() == pytest.approx(p, abs=4 * hit.std() / 200 + 1e-12)
        assert (x[:, choice.column] == choice.cells(z)).all()
        fitted = np.bincount(scores[0].cells(z[component >= 2]), minlength=4) if k == 0 else None
        assert fitted is None or fitted[0] < 0.02 * fitted.sum()  # and drawn as it was fitted
    u = rng.random((2000, space.dimension))
    assert to_cube(from_cube(u, wide, scores), wide, scores) == pytest.approx(u, abs=1e-6)
    balanced = scores[0].cells(from_cube(u, wide, scores))
    assert stats.chisquare(np.bincount(balanced, minlength=4)).pvalue > 1e-3


def test_the_estimate_is_unbiased_whatever_the_metamodel_says_of_the_choices():
    """The pool, plan and draws of a batch on an analytic truth, with a metamodel that is wrong about two choices."""
    edges = {"car": 3.5, "truck": 1.0, "bicycle": -1.0, "bus": 0.0}  # critical where the score of v exceeds it
    v = Parameter("v", -math.inf, math.inf, distribution=sbt.Normal(0, 1))
    space = ParameterSpace((v, WEIGHTED))
    truth = sum(SHARES[kind] * stats.norm.sf(edge) for kind, edge in edges.items())
    edge, scores = np.array(list(edges.values())), choice_scores(space)
    believed = edge + np.array([0.5, -1.0, 2.0, 0.0])
    wide = wide_scales(Coordinates(space).bounded)
    found = []
    for seed in range(400):
        rng = stream(seed, "estimate")
        h = Mixture(wide, choices=scores)
        z, stratum = h.sample(400, rng)
        x, log_h = space.from_normal(z), h.log_density(z)
        kinds = x[:, 1].astype(int)
        pi = stats.norm.cdf(2.0 * (x[:, 0] - believed[kinds]))
        log_pi, log_not = np.log(np.clip(pi, 1e-12, 1)), np.log(np.clip(1 - pi, 1e-12, 1))
        plan = plan_batch(log_pi, log_not, log_normal(z) - log_h, log_wide(z, wide, scores) - log_h, stratum)
        draws = draw_systematic(plan, 60, log_pi - log_not, rng)
        critical = x[draws.rows, 0] > edge[kinds[draws.rows]]
        found.append(plan.prior + (draws.coefficient * (critical - draws.control_variate)).mean())
    error = np.std(found) / math.sqrt(len(found))
    assert np.mean(found) == pytest.approx(truth, abs=3.5 * error)
    assert error < 0.02 * truth  # the law can fail


# Campaigns


def test_a_store_keeps_words_and_gives_them_back(tmp_path):
    described = describe_scenario(scenario())
    runs = [PlannedRun("s", {"v": 6.0 + k, "gap": 30.0, "kind": kind}) for k, kind in enumerate(KINDS)]
    with Store.open(tmp_path, {"names": ["v", "gap", "kind"], "described": described}) as store:
        store.plan(0, "s", runs, [1, 2, 3, 4], {})
        assert [job.inputs["kind"] for job in store.unfinished()] == list(KINDS)
        for k in range(4):
            store.append(Outcome(k, Status.OK, {"m": float(k)}))
        history = store.history()
        assert json.loads(store._db.execute("SELECT inputs FROM runs WHERE idx = 1").fetchone()[0]) == [7.0, 30.0, "truck"]
    assert history.x[:, 2].tolist() == [0.0, 1.0, 2.0, 3.0]
    assert [r.inputs["kind"] for r in history.records] == list(KINDS)
    assert list(history.to_frame()["x.kind"]) == list(KINDS)
    fewer = history.recoded({"kind": ("bus", "truck")})
    assert [r.inputs["kind"] for r in fewer.records] == ["truck", "bus"]
    unlike = tmp_path / "unlike"
    with Store.open(unlike, {"names": ["v", "gap", "kind"], "described": describe_scenario(scenario(["car", "bus"]))}) as store:
        store.plan(0, "s", runs, [1, 2, 3, 4], {})
        for k in range(4):
            store.append(Outcome(k, Status.OK, {"m": 0.0}))
        with pytest.raises(StoreError, match="choices of its scenario"):
            store.history()


def test_a_campaign_speaks_in_words_and_is_the_same_with_workers_and_after_a_stop(tmp_path):
    keys = {"campaign": "falsification", "scenario": scenario(), "seed": 3, "metamodel": "gp", "budget": 16, "report": False}
    one = sbt.run(**keys, store=str(tmp_path / "a"), executor="serial")
    two = sbt.run(**keys, store=str(tmp_path / "b"), executor={"kind": "local", "workers": 1})

    def stop(progress):
        if progress.done == 12:
            raise RuntimeError("stopped")

    with pytest.raises(RuntimeError, match="stopped"):
        sbt.run(**keys, store=str(tmp_path / "c"), executor="serial", progress=stop)
    three = sbt.run(**keys, store=str(tmp_path / "c"), executor="serial")
    same = ["index", "x.v", "x.gap", "x.kind", "y.m", "seed"]
    assert one.frame[same].equals(two.frame[same])
    assert one.frame[same].equals(three.frame[same])
    assert set(one.frame["x.kind"]) <= set(KINDS)
    mode = sbt.open(tmp_path / "a").conclusion.failure_modes[0]  # from the JSON
    assert mode.inputs["kind"] == BAD
    assert {one.history.inputs(int(run))["kind"] for run in mode.runs} == {BAD}
    assert f">{BAD}<" in html.unescape(one.report().read_text())  # in the table of critical runs
    assert one.export("csv").read_text().splitlines()[1].split(",")[5] in KINDS
    table = one.predict({"v": 10.0, "gap": 40.0, "kind": list(KINDS)})
    assert int(table["mean"].argmin()) == KINDS.index(BAD)
    with pytest.raises(InputError, match=r"column kind: input kind must be one of .* but got 'tram'"):
        one.predict({"v": 10.0, "gap": 40.0, "kind": "tram"})


def _well(values, v, gap):
    return ((values["v"] - v) / 4) ** 2 + ((values["gap"] - gap) / 12) ** 2 - 1


WELLS = {
    "idle": (lambda values, seed: {"m": _well(values, 12, 35)}, 1),
    "elsewhere": (lambda values, seed: {"m": _well(values, *((10, 20) if values["kind"] in ("car", "bus") else (20, 45)))}, 2),
}


@pytest.mark.parametrize("name", WELLS)
def test_a_choice_that_changes_nothing_makes_no_mode_of_its_own_and_one_that_does_keeps_its_failures(name, tmp_path):
    """One failure with every kind was told as four, each of them searched for again."""
    evaluate, wells = WELLS[name]
    keys = {"campaign": "falsification", "seed": 2, "budget": 80, "report": True, "store": tmp_path / "s", "executor": "serial"}
    modes = sbt.run(**keys, scenario=scenario(evaluate=evaluate)).conclusion.failure_modes
    assert len(modes) == wells
    alike = [set((mode.choices or {"kind": (mode.inputs["kind"],)})["kind"]) for mode in modes]
    assert sum(len(each) for each in alike) >= 2
    assert not set.intersection(*alike) if wells == 2 else len(alike[0]) > 1
    with_several = next(mode for mode in modes if mode.choices)
    said = " ".join(CliRunner().invoke(app, ["status", str(tmp_path / "s")]).stdout.split())
    assert f"also with kind {next(k for k in with_several.choices['kind'] if k != with_several.inputs['kind'])}" in said
    assert f">{with_several.inputs['kind']}, also " in html.unescape((tmp_path / "s" / "report.html").read_text())


def test_a_table_of_recorded_runs_with_choices_comes_back(tmp_path):
    from sbt.store.tables import from_folder

    store = str(tmp_path / "s")
    done = sbt.run(campaign="coverage", scenario=scenario(SHARES), budget=16, seed=1, store=store, executor="serial")
    folder = done.export("dsiod").parent
    table = from_folder(str(folder), tmp_path)
    assert table.space.parameters[2].choices == KINDS
    assert table.space.parameters[2].probabilities == tuple(SHARES.values())
    assert (np.sort(table.pool.x, axis=0) == np.sort(done.history.x, axis=0)).all()
    first = done.history.record(0)
    assert table.run(first.inputs, 0)["m"] == pytest.approx(first.metrics["m"])


def test_choices_that_mean_nothing_to_others_come_back_from_a_table(tmp_path):
    from sbt.store.tables import from_folder

    inputs = [sbt.Parameter("k", choices=["1", "03", "NA", "null", "nan"]), sbt.Parameter("v", 0, 1)]
    plain = sbt.Scenario("na", inputs, sbt.Requirement("m", high=0.5), evaluate=lambda values, _: {"m": values["v"]})
    done = sbt.run(
        campaign="coverage", scenario=plain, budget=30, seed=1, store=tmp_path / "s", executor="serial", report=False
    )  # fmt: skip
    table = from_folder(str(done.export("dsiod").parent), tmp_path)
    assert sorted(table.pool.x[:, 0]) == sorted(done.history.x[:, 0])
    assert len(set(table.pool.x[:, 0])) == 5


@pytest.mark.parametrize("form", ["text", "xml"])
def test_placeholders_take_choices_as_text_escaped_and_formulas_compare(tmp_path, form):
    values = {"kind": "Fish & \"Chips\" 'n' é", "v": 10.0}
    if form == "text":
        assert fill("a=${kind} b=${v / 4}", values) == f"a={values['kind']} b=2.5"
        with pytest.raises(RunError, match="'kind' is an input with choices and no number"):
            fill("${kind + 1}", values)
        return
    path = tmp_path / "r.rou.xml"
    path.write_text(
        '<routes><vType id="t" vClass="${kind}" length="${4 + 8 * (kind == \'truck\')}"/>'
        '<vType id="u" accel="${v * (kind != &quot;truck&quot;)}"/></routes>'
    )
    import xml.etree.ElementTree as ET

    types = ET.parse(template(path).write(values, tmp_path)).getroot()
    assert types[0].attrib == {"id": "t", "vClass": values["kind"], "length": "4"}
    assert types[1].get("accel") == "10"
    types = ET.parse(template(path).write({"kind": "truck", "v": 10.0}, tmp_path)).getroot()
    assert (types[0].get("length"), types[1].get("accel")) == ("12", "0")


# SUMO

ROAD = """<net version="1.20" junctionCornerDetail="5" limitTurnSpeed="5.50">
    <location netOffset="0,0" convBoundary="0,0,2000,0" origBoundary="0,0,2000,0" projParameter="!"/>
    <edge id="road" from="west" to="east" priority="-1">
        <lane id="road_0" index="0" speed="50.00" length="2000.00" shape="0.00,-1.60 2000.00,-1.60"/>
    </edge>
    <junction id="east" type="dead_end" x="2000.00" y="0.00" incLanes="road_0" intLanes="" shape="2000.00,-3.20 2000.00,0.00"/>
    <junction id="west" type="dead_end" x="0.00" y="0.00" incLanes="" intLanes="" shape="0.00,0.00 0.00,-3.20"/>
</net>
"""
ROUTES = """<routes>
    <vType id="car_trailer" length="9.0" sigma="0"/>
    <vType id="truck" vClass="truck" length="12.0" sigma="0"/>
    <vType id="ego" length="5.0" sigma="0"/>
    <route id="ahead" edges="road"/>
    <vehicle id="lead" type="${kind}" route="ahead" depart="0" departSpeed="10"
             departPos="${100 + gap + 12 * (kind == 'truck') + 9 * (kind != 'truck')}" insertionChecks="none"/>
    <vehicle id="ego" type="ego" route="ahead" depart="0" departPos="100" departSpeed="20" insertionChecks="none"/>
</routes>
"""
OWN = """sumo: {net: road.net.xml, routes: cars.rou.xml}
inputs:
  gap: {min: 20, max: 60, unit: m}
  kind: {choices: {car_trailer: 0.75, truck: 0.25}}
ego: ego
duration: 3
metrics: [ttc_min, d_min]
requirement: {metric: ttc_min, critical: [-.inf, 1.0]}
"""


@pytest.fixture
def own(tmp_path):
    for name, text in {"road.net.xml": ROAD, "cars.rou.xml": ROUTES, "scenario.yaml": OWN}.items():
        (tmp_path / name).write_text(text)
    return tmp_path


@pytest.mark.sumo
def test_own_files_take_the_text_and_formulas_compare_with_it(own):
    for kind, length in {"car_trailer": 9.0, "truck": 12.0}.items():
        run = sbt.simulate(own / "scenario.yaml", {"kind": kind, "gap": 30.0})
        lead = run.trace[run.trace["actor"] == "lead"].iloc[0]
        ego = run.trace[run.trace["actor"] == "ego"].iloc[0]
        assert lead["length"] == length
        assert lead["x"] - ego["x"] - (length + 5.0) / 2 == pytest.approx(30.0, abs=1.1)  # after the first step of 0.1 s
    done = sbt.run(
        campaign="coverage", scenario=str(own / "scenario.yaml"), budget=8, seed=1, store=str(own / "s"), executor="serial",
        report=False,
    )  # fmt: skip
    assert set(done.frame["status"]) == {"ok"}
    assert set(done.frame["x.kind"]) == {"car_trailer", "truck"}
    assert done.replay(3).identical


@pytest.mark.sumo
@pytest.mark.parametrize(
    ("change", "told"),
    {
        "choices: [1, 2]": "inputs.kind: input kind: a choice must be text (write a number in quotes), but got 1",
        "{min: 0, max: 1, choices: [a, b]}": "inputs.kind: an input must have a range, choices, or a profile, one of them",
        "{unit: m}": "inputs.kind: an input must have min and max, choices, or a profile",
        "choices: [truck, truk]": "",
    }.items(),
)
def test_a_scenario_file_says_what_is_wrong_with_choices(own, change, told):
    text = OWN.replace("{choices: {car_trailer: 0.75, truck: 0.25}}", change if change[0] == "{" else f"{{{change}}}")
    (own / "scenario.yaml").write_text(text)
    if not told:  # the formula compares with a choice that there is, the text with a type that there is not
        run = sbt.simulate(own / "scenario.yaml", {"kind": "truk", "gap": 30.0})
        assert run.status != "ok"
        assert "truk" in run.reason
        return
    with pytest.raises(InputError) as error:
        sbt.simulate(own / "scenario.yaml", {})
    assert told in str(error.value)


@pytest.mark.sumo
def test_a_placeholder_that_takes_a_choice_for_a_number_is_refused_at_its_place(own):
    (own / "cars.rou.xml").write_text(ROUTES.replace("${100 + gap", "${100 + kind + gap"))
    with pytest.raises(InputError, match=r"cars.rou.xml:6:5: .* 'kind' must be an input with choices .*, but is both"):
        sbt.simulate(own / "scenario.yaml", {})


@pytest.mark.sumo
def test_a_setting_of_the_ego_with_choices_is_an_input():
    ego = {"kind": "sumo", "model": {"choices": ["IDM", "Krauss"]}}
    runs = [sbt.simulate("cut_in", {"ego_model": model, "d_v": 90.0, "d_t": 1.0}, ego=ego) for model in ("IDM", "Krauss")]
    assert [run.inputs["ego_model"] for run in runs] == ["IDM", "Krauss"]
    assert runs[0].metrics != runs[1].metrics
    with pytest.raises(InputError, match="did you mean 'IDM'"):
        sbt.simulate("cut_in", {}, ego={"kind": "sumo", "model": {"choices": ["IDN", "Krauss"]}})
    with pytest.raises(InputError, match="it decides how SUMO is started"):
        sbt.simulate("cut_in", {}, ego={"kind": "sumo", "lane_change": {"choices": ["LC2013", "SL2015"]}})


@pytest.mark.slow
def test_falsification_finds_a_failure_of_one_choice_sooner_than_random_runs(tmp_path):
    def runs_to_first(seed: int) -> int:
        found = sbt.run(
            campaign="falsification", scenario=scenario(), seed=seed, budget=100, metamodel="gp", stop={"failures": 1},
            store=str(tmp_path / str(seed)), executor="serial", report=False,
        )  # fmt: skip
        return found.conclusion.runs_to_first or math.inf

    searched = np.array([runs_to_first(seed) for seed in range(20)])
    share = math.pi * 30 / (20 * 55) / 4
    random = np.array([stream(seed, "random").geometric(share) for seed in range(20)])
    assert np.median(searched) < 0.6 * np.median(random)
    assert np.quantile(searched, 0.9) < 0.6 * math.log(0.1) / math.log(1 - share)


def test_shards_of_a_campaign_with_choices_join_to_the_whole(tmp_path):
    (tmp_path / "s.py").write_text(
        "import sbt\n"
        "SCENARIO = sbt.Scenario('s', inputs=[sbt.Parameter('v', 5, 25), sbt.Parameter('kind', choices=['car', 'truck', 'bus'])],"
        " evaluate=lambda values, seed: {'m': values['v']}, requirement=sbt.Requirement('m', high=6.0))\n"
    )
    text = "campaign: coverage\nscenario: s.py:SCENARIO\nbudget: 13\nexecutor: {kind: serial}\nstore: "
    stores = [
        Path(run_loaded(parse(f"{text}{tmp_path / name}", folder=tmp_path), shard=shard)["store"])
        for name, shard in {"whole": None, "one": Shard(1, 2), "two": Shard(2, 2)}.items()
    ]
    merge_shards(stores[1:], tmp_path / "merged", report=False)
    rows = ["index", "x.v", "x.kind", "y.m", "seed"]
    assert sbt.open(tmp_path / "merged").frame[rows].equals(sbt.open(tmp_path / "whole").frame[rows])


@pytest.mark.parametrize(
    ("edge", "said"), [(-1.0, "None of all 50 combinations of the inputs"), (6.5, "every combination of the inputs was run")]
)
def test_a_falsification_says_where_every_combination_was_run(tmp_path, edge, said):
    inputs = [sbt.Parameter("i", 1, 10, kind="integer"), sbt.Parameter("j", 1, 5, kind="integer")]

    def evaluate(values, seed):
        return {"m": float(3 * abs(values["i"] - 7) + values["j"] + 4)}

    grid = sbt.Scenario("grid", inputs, sbt.Requirement("m", high=edge), evaluate=evaluate, metrics=["m"])
    result = sbt.run(campaign="falsification", scenario=grid, budget=60, store=tmp_path, executor="serial", report=False)
    told = " ".join(result.sentences())
    assert said in told
    assert "a larger budget" not in told
    assert "no other mode" not in told

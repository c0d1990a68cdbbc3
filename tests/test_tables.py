"""Recorded tables as scenarios: a campaign chooses among the rows, each at most once, and is scored on the rest."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from studies import run_loaded
from typer.testing import CliRunner

import sbt
from sbt.cli import app
from sbt.config.load import parse
from sbt.errors import InputError
from sbt.execution.spec import ScenarioSpec
from sbt.loop.stages import notes_of
from sbt.plugins import Scope, load
from sbt.problem.combination import CombinedRequirement
from sbt.problem.scenario import LogicalScenario
from sbt.samplers.pool import PoolSequence
from sbt.seeds import stream
from sbt.store.database import Store
from sbt.workflows.checking import check_scenario
from sbt.workflows.running import run_study
from sbt.workflows.study import Study

CONFIG = """
title: "Disc"
logical_scenario: "A disc in a box."
inputs:
  a: {type: continuous, unit: m, min: 1, max: -1, explanation: "first"}
  k: {type: integer, unit: "", min: 0, max: 5, explanation: "second"}
outputs:
  "dist*": {type: continuous, unit: m}
"""
RECORDED = Path(__file__).resolve().parents[2] / "shared" / "data" / "dsiod_jaywalking"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rng = stream(0, "table")
    a, k = rng.uniform(-1, 1, 200), rng.integers(0, 6, 200)
    rows = ["a,k,dist*", *(f"{x!r},{n},{abs(x) + n / 5 - 0.4!r}" for x, n in zip(a.tolist(), k.tolist(), strict=True))]
    rows += [rows[1], "0.5,2,"]  # a duplicate and an incomplete row
    (tmp_path / "table").mkdir()
    (tmp_path / "table" / "rows.csv").write_text("\n".join(rows) + "\n")
    (tmp_path / "table" / "config.yml").write_text(CONFIG)
    return tmp_path / "table"


def configuration(folder: Path, campaign: str, store: str, budget: int = 60) -> str:
    return (
        f"campaign: {campaign}\nscenario: 'table:{folder}'\nrequirement: {{metric: 'dist*', critical: [-.inf, 0.0]}}\n"
        f"budget: {budget}\ninitial: 20\nbatch: 20\nmetamodel: {{kind: et}}\nexecutor: {{kind: serial}}\n"
        f"store: {folder.parent / store}\n"
    )


def test_rows_that_are_left_over_check_no_share_and_no_others_are_promised(folder: Path) -> None:
    for budget, left in ((60, True), (200, False)):
        done = run_study(Study(parse(configuration(folder, "boundary", f"s{budget}", budget), folder=folder)), report=False)
        said = " ".join(done.sentences)
        assert "held-out run checks that" not in said
        assert "validation.reference" not in said
        assert ("that it had not seen" in said) is left
    with pytest.raises(InputError, match=r"validation\.reference: recorded rows have no runs beside them"):
        run_study(Study(parse(configuration(folder, "boundary", "r") + "validation: {reference: 30}\n", folder=folder)))


def test_rows_that_were_changed_do_not_go_on_with_a_store(folder: Path) -> None:
    """50 runs of the old rows and 50 of the new ones were in one store, exit code 0."""
    run_study(Study(parse(configuration(folder, "boundary", "s"), folder=folder)), report=False)
    before = Scope(folder.parent).prints([f"table:{folder.name}"])
    assert sorted(before) == ["table/config.yml", "table/rows.csv"]
    lines = (folder / "rows.csv").read_text().splitlines()
    (folder / "rows.csv").write_text("\n".join([lines[0], *(f"{line}1" for line in lines[1:])]))
    assert Scope(folder.parent).prints([f"table:{folder.name}"]) != before
    with pytest.raises(InputError, match=r"code and files must give the runs of .* again to go on"):
        run_study(Study(parse(configuration(folder, "boundary", "s", 80), folder=folder)), report=False)


def test_table_is_a_scenario(folder: Path) -> None:
    scenario = load("scenarios", f"table:{folder.name}", folder.parent)
    assert scenario.space.names == ("a", "k")
    assert (scenario.space.parameters[0].low, scenario.space.parameters[0].high) == (-1.0, 1.0)
    assert scenario.space.parameters[1].kind == "integer"
    assert len(scenario.pool.x) == 200
    for x, y in zip(scenario.pool.x, scenario.pool.metrics["dist*"], strict=True):
        assert scenario.run(dict(zip(("a", "k"), x.tolist(), strict=True)), seed=1) == {"dist*": y}


@pytest.mark.parametrize("campaign", ["boundary", "coverage"])
def test_every_row_is_chosen_at_most_once_and_the_rest_is_the_validation(folder: Path, campaign: str) -> None:
    result = run_loaded(parse(configuration(folder, campaign, "s")), report=False)
    with Store.read(folder.parent / "s") as store:
        x = store.history().x
    pool = load("scenarios", f"table:{folder}").pool
    assert len(np.unique(x, axis=0)) == len(x) == result["runs"] == 60
    assert pool.taken(x).sum() == 60
    assert result["conclusion"]["validation"]["n"] == 140
    assert result["failed"] == 0


def test_a_campaign_ends_with_the_table(folder: Path) -> None:
    result = run_loaded(parse(configuration(folder, "coverage", "all", budget=500)), report=False)
    assert result["runs"] == 200
    assert result["stopped"] == "no rows left"


def test_pool_order_is_one_permutation_whatever_was_taken() -> None:
    u = stream(1, "u").random((50, 2))
    taken = np.zeros(50, dtype=bool)
    order = PoolSequence(u, taken, 3).rows
    taken[order[5:20]] = True
    assert PoolSequence(u, taken, 3).rows.tolist() == [*order[:5], *order[20:]]
    assert sorted(order.tolist()) == list(range(50))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: (f / "config.yml").unlink(), "config.yml"),
        (lambda f: (f / "rows.csv").unlink(), "needs one table"),
        (lambda f: (f / "more.csv").write_text("a,k\n"), "several by name"),
        (lambda f: (f / "rows.csv").write_text("a,k\n1,2\n"), "missing: dist"),
        (lambda f: (f / "config.yml").write_text("[1, 2]"), "must be a mapping"),
        (lambda f: (f / "config.yml").write_text("a: [1"), "must be YAML"),
    ],
)
def test_broken_tables_are_refused(folder: Path, change: object, message: str) -> None:
    change(folder)  # type: ignore[operator]
    with pytest.raises(InputError, match=message):
        load("scenarios", f"table:{folder}")


@pytest.mark.skipif(not RECORDED.is_dir(), reason="the recorded data are not beside the checkout")
def test_the_public_data_set_loads() -> None:
    pytest.importorskip("pyarrow", reason="parquet needs pyarrow")
    scenario = load("scenarios", f"table:{RECORDED}")
    assert scenario.pool.x.shape == (2000, 7)
    assert set(scenario.measured) == {"min_dist*", "carla_collision"}
    assert 0.05 < (scenario.pool.metrics["min_dist*"] < 0).mean() < 0.12


def test_export_in_the_data_set_layout_reads_back_the_same_rows(folder: Path) -> None:
    run_loaded(parse(configuration(folder, "coverage", "out")), report=False)
    done = CliRunner().invoke(app, ["export", str(folder.parent / "out"), "--format", "dsiod"])
    assert done.exit_code == 0, done.output
    with Store.read(folder.parent / "out") as store:
        history = store.history()
    again = load("scenarios", f"table:{folder.parent / 'out' / 'exports' / 'dsiod'}")
    assert again.space.names == history.names
    assert np.array_equal(again.pool.x, history.x)
    assert np.array_equal(again.pool.metrics["dist*"], history.y("dist*"))


def endless(values: dict[str, float], seed: int) -> dict[str, float]:
    """A time to collision that never comes, of most runs."""
    return {"t": np.inf if values["a"] > 2 else values["a"]}


def test_rows_with_infinite_metrics_are_rows_of_the_table(tmp_path: Path) -> None:
    """10 % of 200 runs were critical, and 57 % of the rows of their table: those of runs without a collision were dropped."""
    scenario = sbt.Scenario(
        "endless", [sbt.Parameter("a", 0, 10), sbt.Parameter("b", 0, 10)], sbt.Requirement("t", high=1.0), evaluate=endless
    )
    common = {"campaign": "coverage", "executor": "serial", "report": False, "seed": 1}
    made = sbt.run(scenario=scenario, budget=100, store=tmp_path / "made", **common)
    table = made.export("dsiod").parent
    pool = load("scenarios", f"table:{table}").pool
    assert (len(pool.x), int(np.isinf(pool.metrics["t"]).sum())) == (100, int(np.isinf(made.frame["y.t"]).sum()))
    again = sbt.run(
        scenario=f"table:{table}", requirement=scenario.requirement, budget=100, store=tmp_path / "again", **common
    )  # fmt: skip
    assert again.conclusion.critical_fraction == made.conclusion.critical_fraction
    assert again.frame["status"].eq("ok").all()


@pytest.mark.parametrize("column", ["", ",seed"])
def test_repeats_of_inputs_are_rows_of_the_table_each_taken_once(tmp_path: Path, column: str) -> None:
    """Of 12 combinations with 10 seeds each, 108 of 120 rows were dropped; whatever is taken first, all come once."""
    rng = stream(5, "repeats")
    hit = rng.integers(0, 2, (12, 10))
    rows = [f"{k // 4},{k % 4},{hit[k, j]}{f',{j}' if column else ''}" for j in range(10) for k in range(12)]
    inputs = "inputs: {a: {type: integer, min: 0, max: 2}, b: {type: integer, min: 0, max: 3}}\n"
    (tmp_path / "config.yml").write_text(f"{inputs}outputs: {{hit: {{type: binary}}}}\n")
    (tmp_path / "rows.csv").write_text("\n".join([f"a,b,hit{column}", *rows]) + "\n")
    assert len(load("scenarios", f"table:{tmp_path}").pool.x) == 120
    for campaign, more in (("coverage", ""), ("boundary", "metamodel: {kind: et}\nstop: {stable: null}\n")):
        study = parse(
            f"campaign: {campaign}\nscenario: 'table:{tmp_path}'\nrequirement: {{metric: hit, critical: [1, 1]}}\nbudget: 150\n"
            f"initial: 30\nbatch: 30\n{more}executor: {{kind: serial}}\nstore: {tmp_path / campaign}\n"
        )
        found = run_loaded(study, report=False)
        assert (found["runs"], found["critical"], found["failed"]) == (120, int(hit.sum()), 0)
        with Store.read(tmp_path / campaign) as store:
            history = store.history()
        asked = history.y("hit")[(history.x == [1, 2]).all(axis=1)]
        assert sorted(asked.tolist()) == sorted(hit[6].tolist())
    done = CliRunner().invoke(app, ["export", str(tmp_path / "coverage"), "--format", "dsiod"])
    assert done.exit_code == 0, done.output
    assert len(load("scenarios", f"table:{tmp_path / 'coverage' / 'exports' / 'dsiod'}").pool.x) == 120


def test_what_is_left_out_of_a_table_is_said(folder: Path) -> None:
    said = "2 of 202 rows are left out: 1 without a number in some column, 1 the same as another one."
    found = run_study(Study(parse(configuration(folder, "coverage", "s"), folder=folder)), report=False)
    assert any(said in sentence for sentence in found.sentences)
    assert any(said in finding.detail for finding in check_scenario(ScenarioSpec(f"table:{folder}", str(folder))))


def rates(values: dict[str, float], seed: int) -> dict[str, float]:
    """A metric of a rate over five decades."""
    return {"m": float(np.log10(values["rate"])) + values["a"] / 10, "other": values["a"]}


LOW_RATE = sbt.Requirement("m", high=-2.5)
RATES = sbt.Scenario(
    "rates", [sbt.Parameter("rate", 1e-4, 10, "", sbt.LogNormal(mean=0.01, std=0.05)), sbt.Parameter("a", 0, 10, "m")], LOW_RATE,
    evaluate=rates, metrics=["other", "m"],
)  # fmt: skip


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with 300 runs even in the logarithm of a rate, of which 21 % are critical."""
    made = sbt.run(
        campaign="coverage", scenario=RATES, budget=300, seed=1, executor="serial", report=False,
        store=tmp_path_factory.mktemp("rates") / "made",
    )  # fmt: skip
    return made.export("dsiod").parent


def asked_again(table: Path, store: Path, **more: object) -> sbt.Result:
    return sbt.run(scenario=f"table:{table}", budget=100, seed=1, executor="serial", report=False, store=store, **more)


def test_a_table_of_an_export_asks_what_its_campaign_asked(exported: Path, tmp_path: Path) -> None:
    """It asked whether the first metric is at most 0."""
    assert load("scenarios", f"table:{exported}").requirement == LOW_RATE
    found = asked_again(exported, tmp_path / "s", campaign="coverage")
    assert "m ≤ -2.5" in found.sentences()[0]
    assert "assumed" not in " ".join(found.sentences())


@pytest.mark.parametrize("how", ["any", "all"])
def test_requirements_of_several_metrics_are_kept_with_the_rows(how: str, tmp_path: Path) -> None:
    named = sbt.Requirement("other", low=2.0, high=3.5, name="in the middle")
    need = CombinedRequirement(how=how, items=(LOW_RATE, named))
    scenario = replace(RATES, requirement=need)
    made = sbt.run(campaign="coverage", scenario=scenario, budget=20, executor="serial", report=False, store=tmp_path / "s")
    table = made.export("dsiod").parent
    assert load("scenarios", f"table:{table}").requirement == need
    critical = asked_again(table, tmp_path / "t", campaign="coverage").frame["critical"]
    assert critical.sum() == made.frame["critical"].sum()


def test_a_requirement_that_nobody_stated_is_told_as_assumed(folder: Path) -> None:
    said = "Nothing says what is critical of these rows: dist* ≤ 0 is assumed"
    assert said in " ".join(f.detail for f in check_scenario(ScenarioSpec(f"table:{folder}", str(folder))))
    common = {"campaign": "coverage"}
    assert said in " ".join(asked_again(folder, folder.parent / "a", **common).sentences())
    stated = {"metric": "dist*", "critical": [None, 0.0]}
    assert said not in " ".join(asked_again(folder, folder.parent / "b", requirement=stated, **common).sentences())
    (folder / "config.yml").write_text(f"{CONFIG}requirement: {{metric: 'dist*', critical: [null, 0.1]}}\n")
    found = asked_again(folder, folder.parent / "c", **common)
    assert "dist* ≤ 0.1" in found.sentences()[0]
    assert said not in " ".join(found.sentences())


@pytest.mark.parametrize(
    "wrong", ["[1]", "{metric: 'dist*'}", "{metric: 'dist*', critical: [1]}", "{metric: 'dist*', critical: [2, 1]}",
              "{metric: speed, critical: [0, 1]}", "{any: []}", "{any: 3}", "{critical: [0, 1]}",
              "{metric: 'dist*', critical: [a, b]}"],
)  # fmt: skip
def test_a_table_with_a_wrong_requirement_is_refused(folder: Path, wrong: str) -> None:
    (folder / "config.yml").write_text(f"{CONFIG}requirement: {wrong}\n")
    with pytest.raises(InputError, match=r"config\.yml.*requirement"):
        load("scenarios", f"table:{folder}")


def test_a_table_of_an_export_is_even_in_the_logarithm_where_its_campaign_was(exported: Path, tmp_path: Path) -> None:
    """21 % of the rows are critical, and .011 % of the space that a boundary over them spoke of."""
    rate, a = load("scenarios", f"table:{exported}").space.parameters
    assert (rate.logarithmic, a.logarithmic) == (True, False)
    found = asked_again(exported, tmp_path / "s", campaign="boundary", metamodel="et", stop={"stable": None})
    assert found.conclusion.critical_fraction == pytest.approx(0.21, abs=0.05)
    again = load("scenarios", f"table:{found.export('dsiod').parent}").space.parameters
    assert [p.logarithmic for p in again] == [True, False]


def foreign(table: Path, u: np.ndarray, more: str = "") -> LogicalScenario:
    """Return the scenario of a table that nobody exported, with these values of one input."""
    table.mkdir()
    (table / "rows.csv").write_text("\n".join(["r,m", *(f"{x!r},{x!r}" for x in u.tolist())]) + "\n")
    (table / "config.yml").write_text(f"inputs: {{r: {{type: continuous{more}}}}}\noutputs: {{m: {{unit: s}}}}\n")
    return load("scenarios", f"table:{table}")


def test_rows_over_decades_say_that_their_input_is_even_in_the_logarithm(tmp_path: Path) -> None:
    u = (np.arange(400) + 0.5) / 400
    even, decades = 1e-4 + u * 10.0, 1e-4 * 1e5**u
    for name, rows, more, logarithmic, said in (
        ("even", even, "", False, ""),
        ("decades", decades, "", True, "r is shared out evenly in its logarithm"),
        ("stated", decades, ", logarithmic: true", True, ""),
        ("denied", decades, ", logarithmic: false", False, ""),
        ("from zero", decades, ", min: 0", False, "80 % of the rows lie in the lowest tenth of the range of r"),
    ):
        scenario = foreign(tmp_path / name, rows, more)
        assert scenario.space.parameters[0].logarithmic is logarithmic, name
        notes = " ".join(notes_of(scenario))
        assert said in notes, name
        assert said or " r " not in notes, name
    with pytest.raises(InputError, match=r"logarithmic.*0 < min.*hundred"):
        foreign(tmp_path / "wrong", even, ", min: 0, logarithmic: true")


@pytest.mark.parametrize("high", [9.0, pytest.param(-0.1, marks=pytest.mark.slow), pytest.param(-9.0, marks=pytest.mark.slow)])
def test_no_table_is_told_to_run_what_it_cannot(folder: Path, high: float) -> None:
    """Its conclusions ended with "campaign: estimation says how probable", which is refused, or with wider ranges."""
    for campaign, more in (("coverage", {}), ("boundary", {"metamodel": "et"}), ("falsification", {"metamodel": "et"})):
        need = {"metric": "dist*", "critical": [None, high]}
        found = asked_again(folder, folder.parent / f"{campaign}{high}", campaign=campaign, requirement=need, **more)
        (advice,) = (sentence for sentence in found.sentences() if sentence.startswith("Next: "))
        assert "campaign: estimation" not in advice.replace("campaign: estimation with the simulator that the rows are of", "")
        assert "widen the ranges" not in advice
        assert "validation.reference" not in advice

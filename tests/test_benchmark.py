"""Benchmarks: resumable, the same in parallel, scored on runs nobody learned from, mistakes where they stand."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from sbt.benchmark import cell as cell_module
from sbt.benchmark import experiment
from sbt.benchmark.cell import PREDICTIONS, is_done, run_cell
from sbt.benchmark.failing import cells_that_fail
from sbt.benchmark.figures import Results, _curves, _times
from sbt.benchmark.panels import recall_curve
from sbt.benchmark.reference import make_reference, reference_rows
from sbt.benchmark.table import COLUMNS, read_table, rows_of, write_table
from sbt.cli import app
from sbt.config.benchmark import LoadedBenchmark, load_benchmark
from sbt.config.source import ConfigError
from sbt.errors import FailedRunsError, InputError, StoreError
from sbt.plugins import Scope
from sbt.store.database import Store

ROOT = Path(__file__).resolve().parent.parent
TINY = """
scenarios:
  - {scenario: analytic.py:SCENARIO, name: disc, batch: 12}
metamodels:
  - {kind: et, trees: 10}
  - {kind: gp}
seeds: [4]
iterations: 3
reference: 60
max_candidates: 1024
"""
UNTIMED = [c for c in COLUMNS if not c.endswith("_seconds")]


def written(folder: Path, text: str = TINY, **changes: object) -> LoadedBenchmark:
    path = folder / "benchmark.yaml"
    path.write_text(text)
    return load_benchmark(path, [f"{k}={json.dumps(v)}" for k, v in {"store": str(folder / "b"), **changes}.items()])


def table(loaded: LoadedBenchmark) -> list[tuple[object, ...]]:
    return [tuple(row.get(key) for key in UNTIMED) for cell in loaded.cells() for row in rows_of(cell)]


def invoked(folder: Path, *more: str) -> dict[str, object]:
    done = CliRunner().invoke(app, ["benchmark", str(folder / "benchmark.yaml"), "--json", *more])
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def test_killed_and_run_again_ends_as_one_that_was_not(analytic, tmp_path, monkeypatch):
    folder = analytic.parent
    whole, other = written(folder, store=str(tmp_path / "a")), written(folder, store=str(tmp_path / "b"))
    for loaded in (whole, other):
        for _, reference in loaded.references():
            make_reference(reference, 1)
    for cell in whole.cells():
        run_cell(cell)
    kept = cell_module._ReferenceLearner.fit
    calls = []

    def killed(self, history):
        calls.append(len(history))
        if len(calls) == 2:
            raise KeyboardInterrupt
        return kept(self, history)

    cells = list(other.cells())
    monkeypatch.setattr(cell_module._ReferenceLearner, "fit", killed)
    with pytest.raises(KeyboardInterrupt):
        run_cell(cells[1])
    monkeypatch.undo()
    assert not is_done(cells[1])
    for cell in reversed(cells):  # another order: what is recalled from sibling cells changes nothing
        run_cell(cell)
    assert all(map(is_done, cells))
    assert table(other) == table(whole)
    assert len(table(whole)) == 2 * 2 * 3


@pytest.mark.slow
def test_the_command_runs_resumes_and_draws(analytic):
    folder = analytic.parent
    loaded = written(folder)
    first = invoked(folder, "--store", str(folder / "b"), "--workers", "2")
    assert (first["cells"], first["done"], first["failed"], first["rows"]) == (4, 4, {}, 12)
    assert {Path(p).stem for p in first["figures"]} == {
        "likelihood_even", "rmse_even", "likelihood_critical", "rmse_critical", "precision_recall", "reliability", "times",
        "scatter_disc",
    }  # fmt: skip
    rows = read_table(Path(first["table"]))
    assert tuple(rows[0]) == COLUMNS
    assert all(row["n"] == 60 and 0 < row["base_rate"] < 1 for row in rows)
    serial = written(folder, store=str(folder / "serial"))
    make_reference(next(serial.references())[1], 1)
    for cell in serial.cells():
        run_cell(cell)
    assert table(serial) == table(loaded)
    before = {p: p.stat().st_mtime_ns for p in (folder / "b").rglob("*.npz")}
    assert invoked(folder, "--store", str(folder / "b"))["done"] == 4
    assert {p: p.stat().st_mtime_ns for p in (folder / "b").rglob("*.npz")} == before  # nothing was done again


def test_reference_only_makes_the_runs_of_every_scenario(analytic):
    folder = analytic.parent
    written(folder, TINY.replace("metamodels:", "  - {scenario: analytic.py:LINE, name: line, batch: 12}\nmetamodels:"))
    result = invoked(folder, "--store", str(folder / "b"), "--reference-only")
    assert [Path(p).name for p in result["references"]] == ["disc", "line"]
    assert (result["cells"], result["done"], result["table"]) == (8, 0, None)
    for name in ("disc", "line"):
        with Store.read(folder / "b" / "reference" / name) as store:
            assert len(store.history()) == 60


def test_scores_are_those_of_the_reference_runs_and_no_metamodel_learns_from_them(analytic):
    loaded = written(analytic.parent)
    (_, reference), cell = next(loaded.references()), next(loaded.cells())
    folder = make_reference(reference, 1)
    run_cell(cell)
    scenario = cell_module.assemble(cell.loaded).scenario
    x, y = reference_rows(folder, scenario, 60)
    with np.load(cell.folder / PREDICTIONS) as kept:
        np.testing.assert_array_equal(kept["y"], y)
        density = -0.5 * ((kept["y"] - kept["mu"]) / kept["sigma"]) ** 2 - np.log(kept["sigma"] * np.sqrt(2 * np.pi))
    *_, last = rows_of(cell)
    assert last["log_likelihood"] == pytest.approx(density.mean())
    assert (last["runs"], last["learned"], last["n"]) == (36, 36, 60)
    with Store.read(cell.folder) as store:
        learned = {tuple(row) for row in store.history().x}
    assert learned.isdisjoint({tuple(row) for row in x})


def test_reference_runs_grow_without_changing(analytic, tmp_path):
    few, many = (written(analytic.parent, store=str(tmp_path / str(n)), reference=n) for n in (30, 90))
    for loaded in (few, many, written(analytic.parent, store=str(tmp_path / "30"), reference=90)):
        for _, reference in loaded.references():
            make_reference(reference, 1)
    frames = []
    for n in (30, 90):
        with Store.read(tmp_path / str(n) / "reference" / "disc") as store:
            frames.append(store.history())
    np.testing.assert_array_equal(frames[0].x, frames[1].x)
    np.testing.assert_array_equal(frames[0].y("y"), frames[1].y("y"))


def test_a_store_of_other_settings_is_refused(analytic):
    loaded = written(analytic.parent)
    make_reference(next(loaded.references())[1], 1)
    run_cell(next(loaded.cells()))
    with pytest.raises(ValueError, match=r"a cell belongs to one configuration, .*max_candidates: 1024 there, 2048 now"):
        run_cell(next(written(analytic.parent, max_candidates=2048).cells()))


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"metamodels": [{"kind": "gp", "name": "et"}, {"kind": "gp"}]}, "metamodel: {'kind': 'et', "),
        ({"iterations": 2}, "budget: 36 there, 24 now"),
        ({"scenarios": [{"scenario": "analytic.py:LINE", "name": "disc", "batch": 12}]}, "scenario: analytic.py:SCENARIO there"),
        ({"max_candidates": 2048}, "max_candidates: 1024 there, 2048 now"),
        ({"reference": 50}, "reference: 60 there, 50 now"),
    ],
)
def test_finished_cells_of_other_settings_are_no_results(analytic, changed, said):
    """The table and the figures of the old settings were told as those of the new ones, with exit code 0."""
    folder = analytic.parent
    loaded = written(folder, metamodels=[{"kind": "et", "trees": 10}])
    make_reference(next(loaded.references())[1], 1)
    for cell in loaded.cells():
        run_cell(cell)
    write_table(folder / "b" / "results.csv", loaded.cells())
    before = (folder / "b" / "results.csv").read_text()
    other = written(folder, **{"metamodels": [{"kind": "et", "trees": 10}], **changed})
    assert not any(is_done(cell) for cell in other.cells())
    assert table(other) == []
    asked = [part for key, value in changed.items() for part in ("--set", f"{key}={json.dumps(value)}")]
    kept = ["--store", str(folder / "b"), "--set", 'metamodels=[{"kind": "et", "trees": 10}]']
    done = CliRunner().invoke(app, ["benchmark", str(folder / "benchmark.yaml"), *kept, *asked])
    assert (done.exit_code, said in done.stderr) == (2, True), done.output
    assert (folder / "b" / "results.csv").read_text() == before


def test_an_edited_file_is_another_configuration_and_recalls_nothing(analytic):
    folder = analytic.parent
    loaded = written(folder)
    make_reference(next(loaded.references())[1], 1)
    cell = next(loaded.cells())
    run_cell(cell)
    assert is_done(cell)
    analytic.write_text(analytic.read_text() + "\n# edited\n")
    assert not is_done(cell)
    assert cell_module._known_runs(list(loaded.cells())[2]) == {}


def test_growth_that_was_killed_goes_on(analytic, monkeypatch):
    """The cell was taken for finished, with the conclusion and the predictions of fewer iterations."""
    folder = analytic.parent
    few, many = (next(written(folder, metamodels=[{"kind": "et", "trees": 10}], iterations=n).cells()) for n in (2, 3))
    make_reference(next(written(folder).references())[1], 1)
    run_cell(few)

    def killed(self, history):
        raise KeyboardInterrupt

    for kind, method in ((cell_module._BenchmarkStage, "propose"), (cell_module._ReferenceLearner, "fit")):
        with monkeypatch.context() as patched:
            patched.setattr(kind, method, killed)
            with pytest.raises(KeyboardInterrupt):
                run_cell(many)
        assert not is_done(many)
    run_cell(many)
    assert is_done(many)
    assert len(list(rows_of(many))) == 3


def test_own_files_of_one_name_are_told_apart(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "model.py").write_text(f"X = {name!r}\n")
    found = Scope(tmp_path).prints(["a/model.py:X", "b/model.py:X", "cut_in"])
    assert sorted(found) == ["a/model.py", "b/model.py"]
    assert len(set(found.values())) == 2


def test_a_benchmark_of_more_iterations_goes_on(analytic):
    folder = analytic.parent
    grown, whole = (written(folder, store=str(folder / name), metamodels=[{"kind": "et", "trees": 10}]) for name in "gw")
    for loaded in (grown, whole):
        make_reference(next(loaded.references())[1], 1)
    few = written(folder, store=str(folder / "g"), metamodels=[{"kind": "et", "trees": 10}], iterations=2)
    for loaded in (few, grown, whole):
        for cell in loaded.cells():
            run_cell(cell)
    assert table(grown) == table(whole)


def test_figures_are_over_the_runs_that_were_learned_from():
    """Runs that failed were counted: 60 in the figure where 58 were learned from."""
    cell = {"scenario": "disc", "metamodel": "gp", "acquisition": "even", "fit_seconds": 1.0, "sampled": 0, "rmse": 0.1}
    rows = [cell | {"seed": seed, "runs": runs, "learned": runs - failed}
            for seed, (first, second) in ((1, (0, 2)), (2, (1, 4))) for runs, failed in ((30, first), (60, second))]  # fmt: skip
    results = Results(tuple(rows), (), ("disc",), ("gp",))
    for figure in (_curves(results, "even", "rmse", "RMSE", None), _times(results)):
        ax = figure.axes[0]
        assert ax.get_xlabel() == "runs learned from"
        assert ax.get_lines()[0].get_xdata().tolist() == [29.5, 57.0]


@pytest.mark.parametrize("more", [["--reference-only"], [], ["--json"]])
def test_reference_runs_that_all_fail_are_told_once_with_their_reason(analytic, more):
    """150 of 150 failed, and nobody said why: exit code 0 with --reference-only, else 1 and each cell's line twice."""
    folder = analytic.parent
    written(folder, TINY.replace("SCENARIO", "ALL_FAIL"))
    command = ["benchmark", str(folder / "benchmark.yaml"), "--store", str(folder / "b"), *more]
    for _ in range(2):
        done = CliRunner().invoke(app, command)
        assert done.exit_code == 4
        assert done.stderr.count("60 of 60 runs failed; run 0: ZeroDivisionError: division by zero (") == 1
        assert f"remove {folder / 'b' / 'reference' / 'disc'}" in done.stderr
        assert "metamodel" not in done.output
    if more == ["--json"]:
        found = json.loads(done.stdout)
        assert (found["failed"], found["left_out"], list(found["failing"])) == ({}, 4, ["disc"])
    elif not more:
        assert "0 of 4 cells done, 0 failed, 4 left out" in done.stdout


def test_more_than_half_of_the_runs_failing_ends_with_4(analytic):
    """With enough that went well for the cells to be done, and again when there is nothing left to do."""
    folder = analytic.parent
    analytic.write_text(analytic.read_text() + """

def most_fail(values, seed):
    if values["a"] < 0.7:
        raise RunError("invalid", "a < 0.7 cannot be realised")
    return disc(values, seed)


MOST_FAIL = scenario(most_fail)
""")
    text = TINY.replace("SCENARIO", "MOST_FAIL").replace("  - {kind: gp}\n", "").replace("iterations: 3", "iterations: 1")
    written(folder, text)
    loaded, listener = written(folder, text), experiment.Listener(lambda line: None, lambda state: None)
    for _ in range(2):
        found = experiment.run_benchmark(loaded, listener, figures=False)
        assert (found["done"], found["failed"], found["left_out"]) == (2, {}, 0)
        assert "at most half of the reference runs may fail, but" in found["failing"]["disc"]
    told = cells_that_fail(list(loaded.cells()))
    assert "runs of its cells may fail, but 18 of 24 did; disc / et / even / seed 4: 9 of 12 runs failed; run 1: a < 0.7" in told
    command = ["benchmark", str(folder / "benchmark.yaml"), "--store", str(folder / "b"), "--reference-only"]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 4
    assert done.stderr.count("a < 0.7 cannot be realised") == 1


@pytest.mark.parametrize(
    ("error", "code"),
    [(InputError("is wrong"), 2), (FailedRunsError("is wrong"), 4), (StoreError("is wrong"), 1), (KeyError("is wrong"), 1)],
)
def test_a_cell_that_fails_is_told_once_and_by_its_own_exit_code(analytic, monkeypatch, error, code):
    folder = analytic.parent
    written(folder)

    def broken(cell):
        raise error

    monkeypatch.setattr(experiment, "run_cell", broken)
    for more in ([], ["--quiet"]):
        done = CliRunner().invoke(app, ["benchmark", str(folder / "benchmark.yaml"), "--store", str(folder / "b"), *more])
        assert done.exit_code == code
        assert done.stderr.count("disc / et / even / seed 4") == 1
        assert "internal error" not in done.output


def test_a_cell_without_runs_that_went_well_says_why(analytic):
    loaded = written(analytic.parent, TINY.replace("SCENARIO", "ALL_FAIL"))
    make_reference(next(loaded.references())[1], 1)
    with pytest.raises(FailedRunsError, match=r"^a metamodel needs two .* but 36 of 36 runs failed; run 0: ZeroDivisionError"):
        run_cell(next(loaded.cells()))


def test_missing_reference_runs_are_said(analytic):
    with pytest.raises(StoreError, match="there is none in"):
        run_cell(next(written(analytic.parent).cells()))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("iterations: 3", "iteration: 3", r"benchmark.yaml:8:1: iteration: unknown key \(did you mean 'iterations'\?\)"),
        ("kind: gp}", "kind: gpp}", r"benchmark.yaml:6:\d+: metamodel.kind: .*did you mean 'gp'"),
        ("trees: 10}", "tree: 10}", r"benchmark.yaml:5:\d+: metamodel: ExtraTrees takes a setting .*did you mean 'trees'"),
        ("batch: 12", "batch: 1", r"benchmark.yaml:3:\d+: scenarios.0.batch: .*greater than or equal to 2, but got 1"),
        ("seeds: [4]", "seeds: 0", r"benchmark.yaml:7:\d+: seeds: must be a number of seeds of 1 to 10000 or .*, but got 0"),
        ("seeds: [4]", "seeds: [4, 4]", r"seeds must be distinct \(give them a name\), but got '4' twice"),
        ("analytic.py:SCENARIO", "cut_inn", r"benchmark.yaml:3:\d+: scenario: .*did you mean 'cut_in'"),
    ],
)
def test_mistakes_are_told_where_they_stand(analytic, old, new, message):
    with pytest.raises(ConfigError, match=message):
        written(analytic.parent, TINY.replace(old, new))


def test_a_recorded_table_is_scored_on_the_rows_that_were_not_chosen(tmp_path):
    rng = np.random.default_rng(0)
    u = rng.random((150, 2))
    folder = tmp_path / "rows"
    folder.mkdir()
    inputs = "".join(f"  {n}: {{type: continuous, unit: m, min: 0, max: 1}}\n" for n in "ab")
    (folder / "config.yml").write_text(f"inputs:\n{inputs}outputs:\n  y: {{type: continuous, unit: m}}\n")
    lines = [f"{float(a)!r},{float(b)!r},{float(np.hypot(a, b) - 0.6)!r}" for a, b in u]
    (folder / "rows.csv").write_text("a,b,y\n" + "\n".join(lines) + "\n")
    text = TINY.replace("analytic.py:SCENARIO, name: disc", "'table:rows'")
    loaded = written(tmp_path, text)
    assert make_reference(next(loaded.references())[1], 1) is None
    cells = list(loaded.cells())
    for cell in cells:
        run_cell(cell)
        assert [(r["runs"], r["n"]) for r in rows_of(cell)] == [(12, 138), (24, 126), (36, 114)]


def test_expected_recall_is_the_observed_one_where_probabilities_are_true():
    p = np.random.default_rng(3).random(200_000) ** 3
    critical = np.random.default_rng(4).random(len(p)) < p
    expected, observed = recall_curve(p, critical)
    assert np.abs(expected - observed).max() < 0.01


@pytest.mark.sumo
def test_the_tiny_benchmark_runs(tmp_path):
    done = CliRunner().invoke(app, ["benchmark", str(ROOT / "configs/benchmark_tiny.yaml"), "--store", str(tmp_path), "--json"])
    assert done.exit_code == 0, done.output
    result = json.loads(done.stdout)
    assert (result["done"], result["failed"], result["rows"]) == (8, {}, 24)
    even = [row for row in read_table(Path(result["table"])) if row["acquisition"] == "even"]
    assert {row["method"] for row in even} == {"rejection", ""}
    shutil.rmtree(tmp_path / "figures")
    loaded = load_benchmark(ROOT / "configs/benchmark_tiny.yaml", [f"store={json.dumps(str(tmp_path))}"])
    assert write_table(tmp_path / "results.csv", loaded.cells()) == 24

"""Recorded rows that do not fill the parameter space evenly tell of the rows, and of no share of the space."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import qmc
from typer.testing import CliRunner

import sbt
from sbt.cli import app
from sbt.errors import InputError
from sbt.plugins import load
from sbt.problem.evenness import spread_evenly
from sbt.problem.space import ParameterSpace
from sbt.seeds import stream

PLANE = [sbt.Parameter("a", 0, 1, "m"), sbt.Parameter("b", 0, 1, "m")]
COMMON = {"executor": "serial", "report": False, "seed": 1}


def twentieth(values: dict[str, float], seed: int) -> dict[str, float]:
    """Critical in 5 % of the space, where y is at most 0.05."""
    return {"y": values["a"]}


@pytest.fixture(scope="module")
def exports(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return folders of 100 rows by kind of campaign: a third of a boundary's are critical."""
    folder, found = tmp_path_factory.mktemp("tables"), {}
    scenario = sbt.Scenario("twentieth", PLANE, sbt.Requirement("y", high=0.05), evaluate=twentieth)
    small = {"initial": 20, "batch": 20, "metamodel": "et"}
    for name, kind, more in (("coverage", "coverage", {}), ("boundary", "boundary", small),
                             ("even", "boundary", {**small, "acquisition": "even"})):  # fmt: skip
        made = sbt.run(campaign=kind, scenario=scenario, budget=100, store=folder / name, **COMMON, **more)
        found[name] = made.export("dsiod").parent
    return found


@pytest.mark.slow
@pytest.mark.parametrize("stated", [True, False])
def test_no_share_of_the_space_is_told_by_rows_that_results_chose(
    exports: dict[str, Path], tmp_path: Path, stated: bool
) -> None:
    """30 % of the parameter space was said to be critical, by runs spread evenly over it; 5 % is."""
    table = exports["boundary"]
    if not stated:
        config = (table / "config.yml").read_text()
        table = tmp_path / "table"
        table.mkdir()
        assert "spread_evenly: false\n" in config
        (table / "config.yml").write_text(config.replace("spread_evenly: false\n", ""))
        (table / "runs.csv").write_bytes((exports["boundary"] / "runs.csv").read_bytes())
    covered = sbt.run(campaign="coverage", scenario=f"table:{table}", budget=60, store=tmp_path / "c", **COMMON)
    said = covered.sentences()
    assert "of the 100 rows" in said[0]
    assert "of the parameter space" not in said[0] + said[2]
    assert "spread evenly over it (" in said[1]
    assert covered.conclusion.to_dict()["rows"] == 100
    never = sbt.Requirement("y", high=-1.0)
    none = sbt.run(
        campaign="falsification", scenario=f"table:{table}", budget=30, store=tmp_path / "f", requirement=never, **COMMON
    )  # fmt: skip
    assert none.conclusion.bound is None
    assert "% of the parameter space" not in " ".join(none.sentences())
    edge = sbt.run(campaign="boundary", scenario=f"table:{table}", budget=60, metamodel="et", store=tmp_path / "b", **COMMON)
    assert edge.conclusion.even_fraction is None
    assert not any(word in " ".join(edge.sentences()) for word in ("deny", "too sure", "fill the space"))
    checked = CliRunner().invoke(app, ["check", f"table:{table}"])
    assert "not spread evenly over the parameter space" in checked.output


@pytest.mark.parametrize("kind", ["coverage", "even"])
def test_shares_of_the_space_are_told_by_even_rows(exports: dict[str, Path], tmp_path: Path, kind: str) -> None:
    table = exports[kind]
    assert "spread_evenly" not in (table / "config.yml").read_text()
    found = sbt.run(campaign="coverage", scenario=f"table:{table}", budget=60, store=tmp_path / "s", **COMMON)
    assert "of the parameter space of table:" in found.sentences()[0]
    assert found.conclusion.rows is None
    edge = sbt.run(campaign="boundary", scenario=f"table:{table}", budget=60, metamodel="et", store=tmp_path / "b", **COMMON)
    assert edge.conclusion.even_fraction is None, "rows that guided runs leave are no random ones"
    assert "fill the space evenly deny" not in edge.sentences()[0]


def test_what_is_not_known_to_be_even_stays_so_from_table_to_table(exports: dict[str, Path], tmp_path: Path) -> None:
    again = sbt.run(campaign="coverage", scenario=f"table:{exports['boundary']}", budget=60, store=tmp_path / "s", **COMMON)
    assert "spread_evenly: false" in (again.export("dsiod").parent / "config.yml").read_text()


MIXED = ParameterSpace((
    sbt.Parameter("a", 0, 1), sbt.Parameter("k", 0, 4, kind="integer"), sbt.Parameter("c", choices=("x", "y", "z")),
))  # fmt: skip
CUBE = ParameterSpace(tuple(sbt.Parameter(name, 0, 1) for name in "abcdefg"))
FEW = ParameterSpace((sbt.Parameter("k", 0, 3, kind="integer"), sbt.Parameter("m", 0, 2, kind="integer")))


@pytest.mark.parametrize("space", [ParameterSpace(tuple(PLANE)), MIXED, CUBE, FEW])
def test_even_and_random_points_are_spread_evenly(space: ParameterSpace) -> None:
    for n in (8, 64, 2048):
        sobol = space.from_unit(qmc.Sobol(space.dimension, rng=2).random(n))
        random = [space.from_unit(stream(seed, "r").random((n, space.dimension))) for seed in range(3)]
        for x in (sobol, *random, np.repeat(sobol, 4, axis=0)):
            assert spread_evenly(space, x), n


@pytest.mark.parametrize("space", [ParameterSpace(tuple(PLANE)), MIXED, CUBE, FEW])
def test_points_that_crowd_are_not_spread_evenly(space: ParameterSpace) -> None:
    """A third of them at an edge; a half near a diagonal, which no single input shows."""
    u = stream(3, "r").random((1000, space.dimension))
    edge, diagonal = u.copy(), u.copy()
    edge[:330, 0] *= 0.1
    diagonal[:500, 1] = np.clip(diagonal[:500, 0] + 0.02 * (diagonal[:500, 1] - 0.5), 0.0, 1.0)
    assert not spread_evenly(space, space.from_unit(edge))
    assert not spread_evenly(space, space.from_unit(diagonal))


@pytest.mark.parametrize("levels", [(20, 20, 20), (10, 10, 10), (5, 5, 5, 5), (3,) * 6, (2,) * 10, (100, 3), (50, 5)])
@pytest.mark.parametrize("centred", [False, True])
def test_grids_are_spread_evenly(levels: tuple[int, ...], centred: bool) -> None:
    """Ties were taken for points that crowd: a finer grid was denied where a coarser one was not."""
    space = ParameterSpace(tuple(sbt.Parameter(name, 0, 1) for name in "abcdefghij"[: len(levels)]))
    axes = [(np.arange(n) + 0.5) / n if centred else np.linspace(0.0, 1.0, n) for n in levels]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(levels))
    assert spread_evenly(space, x)
    assert not spread_evenly(space, x[x[:, 0] < 0.5]), "half of the space has none"


def test_even_points_of_what_constraints_leave_are_spread_evenly() -> None:
    space = ParameterSpace(tuple(PLANE), constraints=(("a + b < 1", lambda v: v["a"] + v["b"] < 1.0),))
    x = qmc.Sobol(2, rng=2).random(1024)
    x = x[space.satisfied(x)]
    assert spread_evenly(space, x)
    assert not spread_evenly(space, x[x[:, 0] < 0.3])


def test_whoever_made_a_table_may_say_that_it_is_even(exports: dict[str, Path], tmp_path: Path) -> None:
    config = (exports["boundary"] / "config.yml").read_text()
    (tmp_path / "config.yml").write_text(config.replace("spread_evenly: false", "spread_evenly: true"))
    (tmp_path / "runs.csv").write_bytes((exports["boundary"] / "runs.csv").read_bytes())
    assert load("scenarios", f"table:{tmp_path}").uneven == ""


BOTH = """inputs: {a: {type: continuous, min: 0, max: 1}, b: {type: continuous, min: 0, max: 1}}
outputs: {y: {type: continuous}}
"""


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (BOTH.replace("outputs: {", "outputs: {a: {type: continuous}, "), "both have 'a'"),
        (BOTH.replace("max: 1}}", "max: 0.9}}"), "b: all rows must lie"),
        (BOTH + "spread_evenly: perhaps\n", "spread_evenly must be true or false"),
    ],
)
def test_tables_that_contradict_their_description_are_refused(tmp_path: Path, config: str, message: str) -> None:
    (tmp_path / "rows.csv").write_text("a,b,y\n0.1,0.2,3\n0.5,0.95,4\n1.0000000001,0.1,5\n")
    (tmp_path / "config.yml").write_text(BOTH)
    assert len(load("scenarios", f"table:{tmp_path}").pool.x) == 3
    (tmp_path / "config.yml").write_text(config)
    with pytest.raises(InputError, match=message):
        load("scenarios", f"table:{tmp_path}")


def test_no_input_is_lost_for_a_metric_of_its_name(tmp_path: Path) -> None:
    """Column `gap` of the export was the metric's, and the table's input gap, in [5, 60], was -20.5."""
    scenario = sbt.Scenario(
        "two gaps", [sbt.Parameter("gap", 5, 60, "m")], sbt.Requirement("gap", high=0.0),
        evaluate=lambda values, seed: {"gap": values["gap"] - 30.0},
    )  # fmt: skip
    made = sbt.run(campaign="coverage", scenario=scenario, budget=10, store=tmp_path / "s", **COMMON)
    with pytest.raises(InputError, match=r"both have 'gap': rename one of them"):
        made.export("dsiod")
    assert not (made.store / "exports" / "dsiod").exists()

"""Every planned run satisfies the constraints, however little they leave and whatever chooses; few are where runs fail."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sbt
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.problem.requirement import CriticalInterval
from sbt.samplers.greedy import select_diverse, select_representative
from sbt.samplers.room import Room, fill_uniformly
from sbt.samplers.search import DEFLATION, Search, deflate, search_data
from sbt.seeds import stream
from sbt.store.planning import PlannedPoints

UNIT = [sbt.Parameter(name, 0.0, 1.0) for name in "xyz"]
WHOLE = [sbt.Parameter(name, 1, 30, kind="integer") for name in "xyz"]
KINDS = [*UNIT[:2], sbt.Parameter("z", choices=["a", "b", "c"])]
NARROW: dict[str, tuple[list[sbt.Parameter], str, Callable[[Any], bool], float]] = {
    "corner": (UNIT, "x + y + z > 2.8", lambda v: v["x"] + v["y"] + v["z"] > 2.8, 2.83),
    "whole": (WHOLE, "x + y + z > 84", lambda v: v["x"] + v["y"] + v["z"] > 84, 86.5),
    "choice": (KINDS, "x + y > 1.9 and z != 'b'", lambda v: v["x"] + v["y"] > 1.9 and v["z"] != "b", 1.95),
    "edge": (UNIT[:2], "x + y <= 1", lambda v: v["x"] + v["y"] <= 1, 0.3),
}
"""Inputs, their constraint, the same in Python, and up to which x + y (+ z) a run is critical."""
PLANNED = [
    *((case, "falsification", "portfolio") for case in NARROW), ("whole", "falsification", "thompson"),
    ("corner", "falsification", "cma_es"), ("choice", "falsification", "cma_es"), ("edge", "falsification", "boundary"),
    ("whole", "boundary", None), ("corner", "estimation", None), ("choice", "coverage", None),
]  # fmt: skip
"""Constraint, campaign, and how a falsification chooses."""


def total(values: Any) -> float:
    return float(sum(v for v in values.values() if not isinstance(v, str)))


@pytest.mark.parametrize(("case", "campaign", "method"), PLANNED)
def test_no_run_breaks_the_constraints(case: str, campaign: str, method: str | None, tmp_path: Path) -> None:
    """Of three inputs with x + y + z > 2.8 a falsification ran 21 of 67 scenarios that break it, and told one as the worst."""
    if method == "cma_es" and importlib.util.find_spec("cma") is None:
        pytest.skip("needs the library cma")
    inputs, text, holds, edge = NARROW[case]
    settings: dict[str, Any] = {} if method is None else {"acquisition": {"kind": method}}

    def run(values: Any, seed: int) -> dict[str, float]:
        if total(values) > edge and seed % 7 == 0:
            raise ValueError("some runs give no metric")
        return {"y": total(values)}

    result = sbt.run(
        campaign=campaign, scenario=sbt.Scenario("narrow", inputs, sbt.Requirement("y", high=edge), evaluate=run), budget=35,
        constraints=[text], store=tmp_path / "s", executor="serial", report=False, **settings,
    )  # fmt: skip
    frame = result.frame
    rows = [{p.name: frame[f"x.{p.name}"].iloc[k] for p in inputs} for k in range(len(frame))]
    assert len(rows) >= 30
    assert [row for row in rows if not holds(row)] == []


def test_what_is_taken_over_from_another_setup_satisfies_them(tmp_path: Path) -> None:
    def scenario(name: str) -> sbt.Scenario:
        return sbt.Scenario(name, UNIT[:2], sbt.Requirement("y", high=0.4), evaluate=lambda v, seed: {"y": total(v)})

    common: dict[str, Any] = {"campaign": "falsification", "budget": 30, "executor": "serial", "report": False}
    sbt.run(scenario=scenario("one"), store=tmp_path / "one", **common)
    result = sbt.run(
        scenario=scenario("two"), store=tmp_path / "two", constraints=["x > 0.2 and y < 0.1"],
        warm_start={"store": str(tmp_path / "one"), "transfer": True}, **common,
    )  # fmt: skip
    assert ((result.frame["x.x"] > 0.2) & (result.frame["x.y"] < 0.1)).all()


@pytest.mark.parametrize("many", [False, True])
def test_a_campaign_of_ones_own_cannot_break_them(tmp_path: Path, many: bool) -> None:
    """Runs one by one, or a whole design as an array."""

    class Mine:
        name = "mine"

        def stop(self, log: sbt.Log) -> str | None:
            return "enough" if log.iterations else None

        def propose(self, log: sbt.Log) -> sbt.Batch:
            x = np.array([[0.95, 0.9, 0.99], [0.5, 0.25, 0.75]])
            if many:
                return sbt.Batch(PlannedPoints("mine", x, ("x", "y", "z")))
            return sbt.Batch(tuple(sbt.PlannedRun("mine", dict(zip("xyz", row, strict=True))) for row in x.tolist()))

    scenario = sbt.Scenario("narrow", UNIT, sbt.Requirement("y", high=2.83), evaluate=lambda v, seed: {"y": total(v)})
    said = r"stage mine must propose runs that satisfy 'x \+ y \+ z > 2\.8', but proposed x=0\.5, y=0\.25, z=0\.75"
    with pytest.raises(sbt.InputError, match=said):
        sbt.run(
            campaign=lambda settings: sbt.Campaign((Mine(),), lambda log: (None, None)), scenario=scenario, budget=5,
            constraints=["x + y + z > 2.8"], store=tmp_path / "s", executor="serial", report=False,
        )  # fmt: skip


def corner(u: np.ndarray) -> np.ndarray:
    return np.asarray(u.sum(axis=1) > 2.8)


def test_deflation_leaves_a_part_of_a_narrow_space_and_filling_stays_in_it() -> None:
    search = Search(CriticalInterval(high=0.0), GaussianProcess(), feasible=corner)
    at = fill_uniformly(corner, 400, 3, stream(1, "at"))
    assert corner(at).all()
    free = deflate(search, at[:20], stream(2, "probe"), 3)
    assert free.radius < DEFLATION
    assert 0.02 < free(at[20:]).mean() < 1.0
    nothing = Room(lambda u: np.zeros(len(u), dtype=bool), Room(lambda u: u[:, 0] > 2.0, corner))
    assert corner(fill_uniformly(nothing, 30, 3, stream(3, "fill"))).all()
    assert fill_uniformly(nothing, 0, 3, stream(3, "fill")).shape == (0, 3)
    with pytest.raises(sbt.InputError, match="constraints must admit some of the points looked at, but admitted none"):
        fill_uniformly(lambda u: u[:, 0] > 2.0, 1, 3, stream(3, "fill"))


def test_filling_looks_where_runs_give_a_metric() -> None:
    """Half of the box fails, and all of the rest is critical: what deflation leaves must not be the half that fails."""
    rng = stream(4, "half")
    u = rng.random((60, 2))
    y = np.where(u[:, 0] > 0.5, np.nan, -1.0 + 0.1 * u[:, 1])
    search = Search(CriticalInterval(high=0.0), GaussianProcess())
    seen = search_data(search, u, y, None, rng)
    probe = rng.random((2000, 2))
    assert seen.admissible(probe).any()
    assert (probe[seen.admissible(probe), 0] < 0.6).all()
    filled = fill_uniformly(seen.filling(search, rng), 300, 2, rng)
    assert (filled[:, 0] > 0.5).mean() < 0.2
    fifth = replace(search, learn_success=lambda *_: lambda v: np.log(np.where(v[:, 1] > 0.5, 0.2, 1.0)))
    chance = search_data(fifth, u[:0], y[:0], None, rng)
    assert (fill_uniformly(chance.filling(fifth, rng), 4000, 2, rng)[:, 1] > 0.5).mean() == pytest.approx(1 / 6, abs=0.03)


def test_runs_that_fail_are_left_alone_once_they_are_known(tmp_path: Path) -> None:
    """As many of 100 failed as of random ones (47 of 103): all that is free after deflation was where runs fail."""

    def run(values: Any, seed: int) -> dict[str, float]:
        if values["x"] > 0.5:
            raise sbt.RunError(sbt.Status.CRASHED, "it always does")
        return {"y": min(values["x"] - 0.2, values["y"] - 0.3)}

    scenario = sbt.Scenario("half", UNIT[:2], sbt.Requirement("y", high=0.0), evaluate=run)
    lost, hits = 0, 0
    for seed in (0, 2):
        result = sbt.run(
            campaign="falsification", scenario=scenario, budget=100, seed=seed, store=tmp_path / str(seed), executor="serial",
            report=False,
        )  # fmt: skip
        lost += int((result.frame["status"] != "ok").sum())
        hits += result.conclusion.critical_runs
    assert lost < 60  # of 200; it was 90
    assert hits > 80  # it was 66


def test_rows_of_a_table_outside_of_the_constraints_or_ranges_are_left_out(tmp_path: Path) -> None:
    """165 of 300 rows of a falsification broke the constraints, and 93 lay outside of a narrowed range."""
    rng = stream(5, "table")
    folder = tmp_path / "table"
    folder.mkdir()
    drawn = (rng.random(130).tolist(), rng.random(130).tolist(), rng.choice(["p", "q", "r"], 130).tolist())
    rows = [(a, b, kind, a + b) for a, b, kind in zip(*drawn, strict=True)]
    (folder / "rows.csv").write_text("\n".join(["a,b,kind,m", *(f"{a!r},{b!r},{kind},{m!r}" for a, b, kind, m in rows)]))
    (folder / "config.yml").write_text(
        "inputs: {a: {min: 0, max: 1}, b: {min: 0, max: 1}, kind: {type: categorical, choices: [p, q, r]}}\noutputs: {m: {}}\n"
        "requirement: {metric: m, critical: [null, 1.3]}\n"
    )
    wanted = [row for row in rows if row[0] + row[1] > 1.0 and row[2] != "p" and row[1] >= 0.2]
    for campaign in ("falsification", "boundary", "coverage"):
        result = sbt.run(
            campaign=campaign, scenario=f"table:{folder}", budget=200, constraints=["a + b > 1"], store=tmp_path / campaign,
            inputs={"b": {"min": 0.2}, "kind": {"choices": ["r", "q"]}}, executor="serial", report=False,
        )  # fmt: skip
        f = result.frame
        assert sorted(zip(f["x.a"], f["x.b"], f["x.kind"], f["y.m"], strict=True)) == sorted(wanted), campaign
        assert f"{130 - len(wanted)} of 130 recorded rows lie outside of the inputs' ranges" in " ".join(result.sentences())
    with pytest.raises(sbt.InputError, match="must admit at least two of the 130 recorded rows, but admit 1"):
        sbt.run(campaign="coverage", scenario=f"table:{folder}", budget=9, constraints=["a + b > 1.9"], store=tmp_path / "no")


def test_of_no_candidates_none_is_selected() -> None:
    none, at = np.empty((0, 2)), np.full((1, 2), 0.5)
    assert len(select_diverse(none, np.empty(0), at, 3, np.ones(2))) == 0
    assert len(select_representative(none, np.empty(0), at, 3, np.ones(2))) == 0


def test_combinations_are_few_where_few_are_feasible(tmp_path: Path) -> None:
    """35 of 27,000: 45 of 80 runs were repetitions, one combination was never run, and nothing said that all were."""

    def scenario(rule: str) -> sbt.Scenario:
        holds = (rule, lambda v: v["x"] + v["y"] + v["z"] > float(rule.split()[-1]))
        space = sbt.ParameterSpace(tuple(WHOLE), constraints=(holds,))
        return sbt.Scenario("few", space, sbt.Requirement("y", high=86.5), evaluate=lambda v, seed: {"y": total(v)})

    few = scenario("x + y + z > 85")
    result = sbt.run(campaign="boundary", scenario=few, budget=80, store=tmp_path / "edge", executor="serial", report=False)
    assert len(result.frame[["x.x", "x.y", "x.z"]].drop_duplicates()) == 35
    assert len(result.frame) <= 45  # some are repeated to learn whether there is noise
    assert result.summary["stopped"] == "all combinations"
    summed = sbt.run(campaign="estimation", scenario=few, budget=80, store=tmp_path / "sum", executor="serial", report=False)
    assert summed.conclusion.probability == pytest.approx(15 / 35)
    grid = np.array(np.meshgrid(*[np.arange(1, 31)] * 3, indexing="ij")).reshape(3, -1).T
    for least, known in ((85, True), (62, True), (61, False)):
        space = scenario(f"x + y + z > {least}").space
        if known:
            assert space.combinations is not None
            assert space.from_unit(space.combinations).tolist() == grid[grid.sum(axis=1) > least].tolist()
        else:
            assert space.combinations is None

"""Falsification: what it finds, what it says where it finds nothing, and that the log alone decides."""

from __future__ import annotations

import importlib.util
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from math import log10
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from studies import run_loaded
from typer.testing import CliRunner

import sbt
from sbt.benchmark.compare import compare, table
from sbt.campaigns.falsification import METHODS
from sbt.campaigns.records import CONFIRM
from sbt.cli import app
from sbt.config.load import parse
from sbt.errors import InputError
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.warp import Warp
from sbt.problem.distribution import Distribution
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import CriticalInterval
from sbt.samplers import portfolio
from sbt.samplers.criteria import log_expected_improvement
from sbt.samplers.search import DEFLATION, Search, deflate, fit_warped
from sbt.seeds import stream
from sbt.store.database import Store
from sbt.store.history import VALIDATION
from sbt.testbeds import values

CASES = '''
from dataclasses import replace

import numpy as np
from sbt.errors import RunError
from sbt.testbeds import analytic
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import CriticalInterval, Requirement
from sbt.problem.metric import Metric
from sbt.problem.scenario import LogicalScenario, Pool
from sbt.problem.space import ParameterSpace
from sbt.problem.trace import Trace

BOX = {"a": (0.0, 1.0), "b": (0.0, 1.0)}
LOW = (-np.inf, 0.0)


def two_holes(x):
    """Two discs of radius 0.1."""
    return np.minimum(np.hypot(x[:, 0] - 0.2, x[:, 1] - 0.25), np.hypot(x[:, 0] - 0.8, x[:, 1] - 0.7)) - 0.1


def half(values, seed):
    if values["a"] < 0.5:
        raise RunError("invalid", "a < 0.5 cannot be realised")
    return {"y": values["b"] + 0.01}


def coin(values, seed):
    return {"y": float(np.hypot(values["a"] - 0.5, values["b"] - 0.5) - 0.2 + (seed % 2) * 0.4)}


def own(name, evaluate):
    space = ParameterSpace((Parameter("a", 0.0, 1.0), Parameter("b", 0.0, 1.0)))
    return LogicalScenario(name, space, Requirement("y", high=0.0), evaluate=evaluate, metric_names=("y",))


TWO = analytic(two_holes, inputs=BOX, critical=LOW, name="two holes")
NOTHING = analytic(lambda x: 1.0 + x[:, 0], inputs=BOX, critical=LOW, name="nothing")
EVERYTHING = analytic(lambda x: -1.0 - x[:, 0], inputs=BOX, critical=LOW, name="everything")
BEYOND = analytic(lambda x: np.hypot(x[:, 0], x[:, 1]), inputs=BOX, critical=(5.0, 6.0), name="out of reach")
PLATEAU = analytic(lambda x: np.where((x[:, 0] > 0.9) & (x[:, 1] > 0.8), -1.0, 10.0), inputs=BOX, critical=LOW, name="plateau")
FLAT = analytic(lambda x: np.full(len(x), 3.0), inputs=BOX, critical=LOW, name="flat")
MORE = {**BOX, "c": (0.0, 1.0), "d": (0.0, 1.0)}
IDLE = analytic(lambda x: np.abs(x[:, 0] - 0.62) - 0.01, inputs=MORE, critical=LOW, name="idle")
GRID = np.stack(np.meshgrid(*[np.linspace(0.03, 0.97, 9)] * 2), axis=-1).reshape(-1, 2)
RECORDED = replace(TWO, name="recorded", pool=Pool(GRID, {"y": two_holes(GRID)}))
HALF = own("half fails", half)


def beside(values, seed):
    """The other stands ahead of ego where b < 0.5, on its left elsewhere."""
    x, y = (6.0, 0.0) if values["b"] < 0.5 else (0.0, 3.0)
    still = np.zeros((1, 2))
    at = np.array([[0.0, x]]), np.array([[0.0, y]])
    return Trace(np.zeros(1), ("ego", "co"), *at, still, still + values["a"], still, np.full(2, 4.0), np.full(2, 1.8))


SIDES = LogicalScenario(
    "sides", TWO.space, Requirement("speed", high=2.0), simulate=beside,
    metrics=(Metric("speed", lambda trace: float(trace.speed[0, 0])),),
)
COIN = own("coin", coin)
'''
Run = Callable[..., dict[str, Any]]
SIDE_BY_SIDE = {"ahead of ego, same direction", "left of ego, same direction"}


@pytest.fixture
def falsified(tmp_path: Path) -> Run:
    (tmp_path / "cases.py").write_text(CASES)

    def run(scenario: str, store: str = "s", **keys: Any) -> dict[str, Any]:
        import json

        asked = {"campaign": "falsification", "scenario": scenario if ":" in scenario else f"cases.py:{scenario}", "budget": 50,
                 "seed": 2, "initial": 10, "executor": {"kind": "serial"}, "store": str(tmp_path / store), **keys}  # fmt: skip
        text = "".join(f"{k}: {json.dumps(v)}\n" for k, v in asked.items())
        return run_loaded(parse(text, folder=tmp_path), report=False)

    return run


def rows(result: dict[str, Any]) -> list[Any]:
    with Store.read(Path(result["store"])) as store:
        return [(r.index, r.stage, r.iteration, dict(r.inputs), r.seed, dict(r.metrics)) for r in store.history().records]


def test_both_holes_are_found_confirmed_and_told_apart(falsified: Run):
    result = falsified("TWO", budget=80)
    found = result["conclusion"]
    assert len(found["failure_modes"]) == 2
    assert found["critical_runs"] == sum(mode["size"] for mode in found["failure_modes"])
    kept = rows(result)
    first = next(k for k, row in enumerate(kept) if row[5]["y"] <= 0)
    assert (found["first_critical_run"], found["runs_to_first"]) == (first, first + 1)
    centres = {(0.2, 0.25), (0.8, 0.7)}
    for mode in found["failure_modes"]:
        at = kept[mode["representative"]]
        assert (at[3], at[5]["y"]) == (mode["inputs"], mode["metric"])
        centres -= {c for c in centres if math.hypot(mode["inputs"]["a"] - c[0], mode["inputs"]["b"] - c[1]) < 0.1}
        again = [row for row in kept if row[1] == CONFIRM and row[3] == mode["inputs"]]
        assert (mode["confirmed"], mode["confirmation_runs"], len(again)) == (1.0, 3, 3)
        assert len({row[4] for row in again} | {at[4]}) == 4  # fresh seeds
        safe = mode["nearest_safe"]
        assert kept[safe["run"]][5]["y"] > 0
        assert {k: v + safe["change"].get(k, 0.0) for k, v in mode["inputs"].items()} == pytest.approx(safe["inputs"])
    assert centres == set()
    assert found["links"] == {"runs": 1, "critical": 0, "left": 0}
    assert result["runs"] == 80 + 6 + 1
    assert found["bound"] is None
    assert found["statement"].startswith(f"{found['critical_runs']} of 80 runs of the search were critical, in 2 failure modes.")


def test_what_differs_in_the_traces_is_not_one_mode(falsified: Run):
    result = falsified("SIDES", budget=30, stop={"failures": None})
    kept, modes = rows(result), result["conclusion"]["failure_modes"]
    assert {mode["conflict"].removesuffix(", ego stands") for mode in modes} == SIDE_BY_SIDE
    assert sum(mode["size"] for mode in modes) == 30  # everything is critical, and joined by the metamodel
    assert len(modes) == 2
    for mode in modes:
        assert {kept[run][3]["b"] < 0.5 for run in mode["runs"]} == {mode["conflict"].startswith("ahead")}


def test_a_failure_of_one_seed_is_told_from_one_of_the_scenario(falsified: Run):
    mode = falsified("COIN", budget=40)["conclusion"]["failure_modes"]
    assert any(m["confirmed"] < 1.0 for m in mode)


@pytest.mark.parametrize(("stop", "reason"), [({"failures": 3}, "failures"), ({"modes": 2}, "modes")])
def test_it_stops_where_it_was_told_to(falsified: Run, stop: dict[str, int], reason: str):
    result = falsified("TWO", budget=80, stop=stop)
    found = result["conclusion"]
    assert result["stopped"] == reason
    assert found["critical_runs"] >= stop.get("failures", 1)
    assert len(found["failure_modes"]) >= stop.get("modes", 1)
    kept = [row for row in rows(result) if row[1] != CONFIRM]
    assert (len(kept) < 80) == (reason != "budget")
    last = max(row[2] for row in kept)
    if reason == "failures":
        assert sum(row[5]["y"] <= 0 for row in kept if row[2] < last) < stop["failures"]  # not a batch too late


def test_where_nothing_is_found_only_the_space_filling_runs_bound(falsified: Run):
    for name in ("NOTHING", "BEYOND", "FLAT"):
        result = falsified(name, name)
        found = result["conclusion"]
        assert (found["first_critical_run"], found["critical_runs"], found["failure_modes"]) == (None, 0, [])
        stages = Counter(row[1] for row in rows(result))
        assert stages == {"initial": 10, "search": 34, "repeat": 2, VALIDATION: 4}
        assert found["bound"]["space_filling_runs"] == 14
        assert found["bound"]["box_fraction"] == pytest.approx(1 - 0.05 ** (1 / 14))
        assert found["bound"]["box_fraction_random_runs"] == pytest.approx(1 - 0.05 ** (1 / 4))
        assert "No critical run in 50" in found["statement"]
        assert "14 space-filling" in found["statement"]
    assert found["closest"]["margin"] == 3.0
    sobol = falsified("NOTHING", "sobol", validation={"share": 0})
    assert Counter(row[1] for row in rows(sobol)) == {"initial": 10, "search": 34, "repeat": 2, "even": 4}
    assert sobol["conclusion"]["bound"]["random_runs"] == 0


def test_everything_critical_is_one_mode_and_the_search_spreads(falsified: Run):
    result = falsified("EVERYTHING")
    found = result["conclusion"]
    assert (found["first_critical_run"], found["critical_runs"], len(found["failure_modes"])) == (0, 50, 1)
    assert found["failure_modes"][0]["nearest_safe"] is None
    assert "Every run that gave a metric was critical (50)" in found["statement"]


def test_failed_runs_are_said_and_widen_the_bound(falsified: Run):
    result = falsified("HALF")
    found = result["conclusion"]
    assert result["failed"] > 0
    assert found["first_critical_run"] is None
    assert found["bound"]["failed_runs"] > 0
    assert found["bound"]["box_fraction_failed_as_critical"] > 0.5  # half of the box may hide anything
    assert f"{result['failed']} runs failed" in found["statement"]
    guided = [row for row in rows(result) if row[1] == "search"]
    assert sum(row[3]["a"] >= 0.5 for row in guided) > 0


def test_plateaus_and_idle_inputs(falsified: Run):
    assert falsified("PLATEAU", budget=150, stop={"failures": 1})["conclusion"]["first_critical_run"] is not None
    idle = falsified("IDLE", "idle", budget=60)["conclusion"]
    assert 1 <= len(idle["failure_modes"]) <= 3  # one slab; idle inputs do not split it into many
    assert idle["runs_to_first"] <= 40


def test_recorded_rows_are_chosen_once_each_and_never_repeated(falsified: Run):
    result = falsified("RECORDED", budget=200, batch=30)
    assert result["stopped"] == "no rows left"
    points = [tuple(row[3].values()) for row in rows(result)]
    assert (len(points), len(set(points))) == (81, 81)
    assert [m["confirmed"] for m in result["conclusion"]["failure_modes"]] == [None, None]


def test_constraints_hold_for_every_run(falsified: Run):
    result = falsified("TWO", budget=50, constraints=["a + b < 1.2"])
    assert all(row[3]["a"] + row[3]["b"] < 1.2 for row in rows(result))
    assert len(result["conclusion"]["failure_modes"]) == 1


def test_a_budget_below_the_first_design_is_a_design_alone(falsified: Run):
    result = falsified("TWO", budget=4, initial=4)
    assert (result["stopped"], [row[1] for row in rows(result)][:4]) == ("budget", ["initial"] * 4)
    assert result["conclusion"]["first_critical_run"] is None
    assert result["conclusion"]["bound"]["space_filling_runs"] == 4
    one = falsified("NOTHING", "one", budget=1, initial=1)
    assert one["conclusion"]["bound"]["box_fraction"] == pytest.approx(0.95)
    hit = falsified("EVERYTHING", "hit", budget=1, initial=1)
    assert len(hit["conclusion"]["failure_modes"]) == 1


@pytest.mark.parametrize("method", [m for m in METHODS if m != "portfolio"] + ["even", "boundary"])
def test_every_method_finds_a_hole(falsified: Run, method: str):
    if method == "cma_es" and importlib.util.find_spec("cma") is None:
        with pytest.raises(InputError, match=r"needs the library cma, .* pip install 'sumo-sbt\[compare\]'"):
            falsified("TWO", acquisition={"kind": method})
        return
    result = falsified("TWO", budget=50, acquisition={"kind": method}, stop={"failures": 1})
    assert result["conclusion"]["critical_runs"] > 0
    if method in ("thompson", "cma_es"):
        assert rows(result) == rows(falsified("TWO", "again", budget=50, acquisition={"kind": method}, stop={"failures": 1}))


def test_two_workers_and_a_broken_off_campaign_give_the_same_rows(falsified: Run, monkeypatch: pytest.MonkeyPatch):
    whole = falsified("TWO", "whole", budget=40)
    local = falsified("TWO", "local", budget=40, executor={"kind": "local", "workers": 2})
    assert rows(local) == rows(whole)
    append, done = Store.append_all, 0

    def dies(self: Store, outcomes: Any, *args: Any) -> None:
        nonlocal done
        before, done = done, done + len(outcomes)
        for k in (7, 25, 43):
            if before < k <= done:
                append(self, outcomes[: k - before - 1], *args)
                raise KeyboardInterrupt
        append(self, outcomes, *args)

    monkeypatch.setattr(Store, "append_all", dies)
    for _ in range(3):
        with pytest.raises(KeyboardInterrupt):
            falsified("TWO", "broken", budget=40)
    assert rows(falsified("TWO", "broken", budget=40)) == rows(whole)


def test_a_larger_budget_goes_on(falsified: Run):
    small = rows(falsified("TWO", "grown", budget=40))
    grown = falsified("TWO", "grown", budget=60)
    assert rows(grown)[: len(small)] == small
    at_once = [row[3] for row in rows(falsified("TWO", "at once", budget=60)) if row[1] != CONFIRM]
    assert [row[3] for row in rows(grown) if row[1] != CONFIRM] == at_once


def hartmann(seed: int, n: int) -> tuple[Any, Any]:
    u = stream(seed, "test").random((n, 6))
    return u, values("hartmann6_1e-3", u)


def test_the_picks_depend_on_the_runs_alone_and_avoid_deflated_basins():
    search = Search(CriticalInterval(high=-2.4), GaussianProcess(nu=2.5, input_noise=False))
    u, y = hartmann(1, 40)
    y[7] = -2.6  # a hit
    y[9] = np.nan
    one, two = (portfolio.propose(search, u, y, 9, stream(1, "picks")) for _ in range(2))
    np.testing.assert_array_equal(one.u, two.u)
    assert one.u.shape == (9, 6)
    assert ((one.u >= 0) & (one.u <= 1)).all()
    assert (np.abs(one.u - u[7]).max(axis=1) > DEFLATION).all()
    assert len(np.unique(one.u, axis=0)) == 9
    none = portfolio.propose(search, u[:1], y[:1], 5, stream(1, "picks"))
    assert none.u.shape == (5, 6)


def test_deflation_shrinks_rather_than_take_everything():
    search = Search(CriticalInterval(high=0.0), GaussianProcess())
    hits = stream(1, "hits").random((200, 2))
    free = deflate(search, hits, stream(1, "probe"), 2)
    assert free.radius < DEFLATION
    assert free(stream(2, "probe").random((4000, 2))).mean() > 0.02
    assert deflate(search, hits[:1], stream(1, "probe"), 2).radius == DEFLATION


def test_a_trust_region_lasts_while_it_improves_and_is_halved_where_it_does_not():
    centre = np.full(3, 0.5)
    near = centre + 0.05 * stream(1, "near").standard_normal((60, 3))
    far = stream(1, "far").random((60, 3))
    u, batch = np.vstack([far, near]), np.repeat(np.arange(12.0), 10)
    falling = np.concatenate([np.full(60, 5.0), np.linspace(4.0, 1.0, 60)])
    stuck = np.concatenate([np.full(60, 5.0), [0.5], np.full(59, 4.0)])
    assert portfolio.regions(u, falling, batch)[0].side == 0.8
    region = portfolio.regions(u, stuck, batch)[0]
    assert (region.side < 0.8, region.failures) == (True, 5)
    assert portfolio.regions(u, np.full(120, 5.0), batch) == []  # a plateau


@pytest.mark.parametrize("critical", [CriticalInterval(high=0.3), CriticalInterval(low=2.0), CriticalInterval(0.1, 0.4)])
def test_the_warp_keeps_what_is_critical_and_the_order(critical: CriticalInterval):
    y = np.sort(10.0 ** stream(3, "y").uniform(-3, 6, 300)) - 1.0
    y = np.concatenate([y, [critical.low, critical.high]])
    y = y[np.isfinite(y)]
    warp = Warp.around_edge(y, critical)
    w = warp.values(y)
    np.testing.assert_array_equal(np.argsort(w, kind="stable"), np.argsort(y, kind="stable"))
    np.testing.assert_array_equal(warp.interval(critical).contains(w), critical.contains(y))


def test_log_expected_improvement_is_the_expectation_and_finite_far_away():
    search = Search(CriticalInterval(high=-2.4), GaussianProcess(nu=2.5, input_noise=False))
    u, y = hartmann(2, 30)
    belief = fit_warped(search, u, y, stream(1, "fit"))
    at = stream(3, "at").random((20, 6))
    best = float(belief.critical.margin(belief.warp.values(y)).min())
    told = log_expected_improvement(belief, at, best)
    p = belief(at)
    drawn = p.mu + p.sigma * stream(4, "normal").standard_normal((200_000, 1))
    truth = np.maximum(best - belief.critical.margin(drawn), 0.0).mean(axis=0)
    np.testing.assert_allclose(np.exp(told), truth, rtol=0.1, atol=1e-5)
    assert np.isfinite(log_expected_improvement(belief, at, best - 1e5)).all()


def test_draws_of_a_process_are_its_belief():
    u, y = hartmann(2, 30)
    process = GaussianProcess(nu=2.5, input_noise=False).fit(u, y, stream(1, "fit"))
    at = stream(3, "at").random((5, 6))
    drawn, p = process.sample_paths(at, 40_000, stream(1, "draws")), process(at)
    np.testing.assert_allclose(drawn.mean(axis=0), p.mu, atol=0.02)
    np.testing.assert_allclose(drawn.std(axis=0), p.epistemic, rtol=0.05, atol=0.005)


def test_compare_is_continued_and_tells_the_first_failure(tmp_path: Path):
    text = (
        "campaign: falsification\nscenario: testbed:himmelblau_partx\nbudget: 40\ninitial: 10\nstop: {failures: 1}\n"
        f"executor: {{kind: serial}}\nstore: {tmp_path / 's'}\n"
    )
    loaded = parse(text)
    ran: list[Any] = []
    names = ["portfolio", "random", "sobol"]
    half = compare(loaded, names, 1, tmp_path, ran.append)
    path = tmp_path / "compare.jsonl"
    path.write_text(path.read_text() + '{"scenario": "cut sh')
    path.write_text(path.read_text() + "\n")
    whole = compare(loaded, names, 2, tmp_path, ran.append)
    assert (whole[:3], len(ran), len(whole)) == (half, 6, 6)
    assert {c.sampler for c in whole if c.runs_to_first} == set(names)  # 18 % of the box is critical
    assert all(c.runs <= 40 and c.runs_to_first <= c.runs for c in whole if c.runs_to_first)
    assert table(whole).count("\n") == 4
    (tmp_path / "c.yaml").write_text(text)
    done = CliRunner().invoke(app, ["compare", str(tmp_path / "c.yaml"), "--samplers", "rando", "--into", str(tmp_path)])
    assert done.exit_code == 2
    assert "a sampler must be one of" in done.output


def test_compare_tells_failed_runs_and_what_is_missing_first(tmp_path, monkeypatch):
    file = tmp_path / "fails.py"
    file.write_text(
        "import sbt\ndef evaluate(values, seed):\n    if values['a'] > 0.5:\n        raise RuntimeError('broken')\n"
        "    return {'y': 1.0}\n"
        "SCENARIO = sbt.Scenario('s', [sbt.Parameter('a', 0, 1)], sbt.Requirement('y', high=0.5), evaluate=evaluate)\n"
    )
    loaded = parse(f"campaign: falsification\nscenario: {file}:SCENARIO\nbudget: 10\n")
    cells = compare(loaded, ["sobol", "sobol"], 1, tmp_path / "cells")
    assert [(c.sampler, c.runs, c.failed) for c in cells] == [("sobol", 10, 5)]
    assert table(cells).endswith("| 50 % |")
    assert table([replace(cells[0], failed=None)]).endswith("| not known |")  # of a table that was begun before
    with pytest.raises(InputError, match="a sampler must be one of"):
        compare(loaded, [], 1, tmp_path / "cells")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(InputError, match="needs the library"):
        compare(loaded, ["random", "tpe"], 1, tmp_path / "others")
    assert not (tmp_path / "others").exists()


def test_failures_of_inputs_over_decades_are_found_where_the_inputs_are_usual(tmp_path):
    """3 % of the draws are critical, and 1e-6 of the box: 0 of 6 campaigns of 80 runs met one where the range alone counted."""
    spans = {"a": (1e-9, 1e-3), "b": (1e3, 1e7)}
    laws = {n: Distribution.of("scipy", name="loguniform", a=a, b=b) for n, (a, b) in spans.items()}
    inputs = [Parameter(n, *ends, distribution=laws[n]) for n, ends in spans.items()]
    scenario = sbt.Scenario(
        "scales", [*inputs, Parameter("c", 0.0, 1.0)], sbt.Requirement("y", high=0.0),
        evaluate=lambda v, _: {"y": 2 * (log10(v["a"]) + 7) ** 2 + (log10(v["b"]) - 4) ** 2 / 0.3 + 4 * (v["c"] - 0.5) ** 2 - 1},
    )  # fmt: skip
    found = sbt.run(campaign="falsification", scenario=scenario, budget=30, seed=1, store=tmp_path / "s", executor="serial")
    assert len(found.conclusion.failure_modes) == 1
    assert found.plot.slices(x="a").get_xscale() == "log"

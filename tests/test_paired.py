"""Two egos on common draws: the interval holds, what was fixed and what is new is told."""

from __future__ import annotations

import base64
import gzip
import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom, binomtest
from typer.testing import CliRunner

from sbt.cli import app
from sbt.seeds import stream
from sbt.store.database import Store
from sbt.workflows.paired import Pairs


def test_the_interval_of_the_difference_covers():
    rng, none = stream(1, "pairs"), np.zeros(200, dtype=bool)
    covered = []
    for _ in range(400):
        before = rng.random(200) < 0.2
        after = np.where(before, rng.random(200) < 0.5, rng.random(200) < 0.02)
        low, high = Pairs(before, after, none, none).difference()
        covered.append(low <= 0.2 * 0.5 + 0.8 * 0.02 - 0.2 <= high)
    assert np.mean(covered) >= 0.95


def pairs(new: int, fixed: int, n: int, warm_up: np.ndarray | None = None) -> Pairs:
    at, none = np.arange(n), np.zeros(n, dtype=bool)
    return Pairs((at >= new) & (at < new + fixed), at < new, none, none, warm_up)


def test_the_verdict_is_that_of_the_exact_test_and_of_the_interval():
    """Nine new of 1,500 pairs and none fixed were undecided, from -.0005 to .0122."""
    assert pairs(9, 0, 1500).verdict() == "rose"
    for new in range(0, 26):
        for fixed in range(0, 26 - new):
            found, differ = pairs(new, fixed, 60), new + fixed
            decided = differ > 0 and binomtest(new, differ).pvalue <= 0.05
            assert found.verdict() == ("undecided" if not decided else "rose" if new > fixed else "fell")
            low, high = found.difference()
            assert low <= (new - fixed) / 60 <= high
            assert (low >= 0.0, high <= 0.0) == (decided and new > fixed, decided and new < fixed)


def test_the_interval_that_agrees_with_the_test_holds_by_enumeration():
    """Whatever the shares of new and fixed failures: each end misses at most in 2.5 %."""
    n = 40
    counts = [(new, fixed) for new in range(n + 1) for fixed in range(n + 1 - new)]
    x, y = np.array(counts).T
    low, high = np.array([pairs(*each, n).difference() for each in counts]).T
    low = np.where((low == 0.0) & (x > y), 1e-12, low)  # 0 itself is excluded
    for new in (0.01, 0.05, 0.1, 0.2, 0.3, 0.42):
        for fixed in (0.0, 0.01, 0.05, 0.1, 0.2, 0.3, 0.42):
            mass = binom.pmf(x, n, new) * binom.pmf(y, n - x, fixed / (1.0 - new))
            assert mass[low > new - fixed].sum() <= 0.025
            assert mass[high < new - fixed].sum() <= 0.025


def test_no_failed_run_decides():
    n, rng = 60, stream(3, "failed")
    for _ in range(100):
        before, after, lost, gone = (rng.random(n) < share for share in (0.05, 0.25, 0.08, 0.08))
        told = Pairs(before & ~lost, after & ~gone, lost, gone).verdict()
        for _ in range(10):
            filled = [np.where(failed, rng.random(n) < rng.random(), hits) for hits, failed in ((before, lost), (after, gone))]
            assert told in ("undecided", Pairs(*filled, np.zeros(n, bool), np.zeros(n, bool)).verdict())


def test_failures_of_one_warm_up_do_not_decide():
    warm_up = np.repeat(np.arange(10.0), 20)
    assert pairs(9, 0, 200, warm_up).verdict() == "undecided"
    assert pairs(9, 0, 200, np.tile(np.arange(10.0), 20)).verdict() == "rose"


def test_failed_runs_widen_it_on_both_sides():
    none, half = np.zeros(100, dtype=bool), np.arange(100) < 10
    low, high = Pairs(none, none, none, none).difference()
    wide = Pairs(none, none, half, half).difference()
    assert wide[0] < low < 0 < high < wide[1]


def test_one_number_in_two_units_is_not_compared(configured, tmp_path):
    (tmp_path / "analytic.py").write_text((tmp_path / "analytic.py").read_text() + """

from dataclasses import replace
from sbt.problem.metric import Metric
OTHER = replace(scenario(disc), metrics=tuple(replace(m, unit="km") for m in scenario(disc).metrics))
""")
    command = ["compare-ego", str(configured("a")), str(configured("b", "OTHER")), "--store", str(tmp_path / "both")]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 2
    assert "one requirement, but y is in no unit in" in done.output.replace("\n", " ")


def another_ego(folder, name, y):
    """Add a scenario to the problems of `configured`: what its metric is, in terms of `disc`."""
    path = folder / "analytic.py"
    path.write_text(f'''{path.read_text()}

def {name.lower()}(values, seed):
    return {{"y": {y}, "noise": 0.0}}


{name} = scenario({name.lower()})
''')


def test_one_change_through_the_command(configured, tmp_path):
    """The critical disc shrinks when the metric is shifted: only fixed failures, none new."""
    another_ego(tmp_path, "BETTER", 'disc(values, seed)["y"] + 0.1')
    a, b = configured("a", budget=300), configured("b", "BETTER")
    done = CliRunner().invoke(app, ["compare-ego", str(a), str(b), "--store", str(tmp_path / "both"), "--json"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert (found["verdict"], found["new"], found["pairs"]) == ("fell", [], 300)
    assert len(found["fixed"]) == found["before"]["critical"] - found["after"]["critical"] > 0
    assert found["low"] <= np.pi * (0.2**2 - 0.3**2) <= found["high"] < 0
    back = ["compare-ego", str(b), str(a), "--store", str(tmp_path / "back"), "--runs", "300", "--fail-if-rose"]
    again = CliRunner().invoke(app, back)
    assert again.exit_code == 3
    assert ": rose" in again.stdout


@pytest.mark.slow
def test_rare_failures_are_compared_by_two_estimations(configured, tmp_path):
    """A disc of 2e-3 shrinks to a fourth: crude pairs would need thousands of runs."""
    (tmp_path / "analytic.py").write_text((tmp_path / "analytic.py").read_text() + '''

def rare(values, seed):
    return {"y": disc(values, seed)["y"] + 0.3 - 0.0252, "noise": 0.0}


def better(values, seed):
    return {"y": disc(values, seed)["y"] + 0.3 - 0.0126, "noise": 0.0}


RARE, BETTER = scenario(rare), scenario(better)
''')
    a, b = (configured(*each, budget=150, metamodel={"kind": "gp"}) for each in (("a", "RARE"), ("b", "BETTER")))
    done = CliRunner().invoke(app, ["compare-ego", str(a), str(b), "--rare", "--store", str(tmp_path / "both"), "--json"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    truth = np.pi * np.array([0.0252, 0.0126]) ** 2
    assert all(found[k]["low"] <= p <= found[k]["high"] for k, p in zip(("before", "after"), truth, strict=True))
    assert found["low"] <= truth[1] - truth[0] <= found["high"] < 0
    assert found["verdict"] == "fell"
    assert max(found[k]["runs"] for k in ("before", "after")) <= 150
    assert all(found[k]["precise"] for k in ("before", "after"))


def test_more_pairs_go_on_where_fewer_stopped(configured, tmp_path):
    a, b = configured("a", budget=300), configured("b")

    def compared(store, runs):
        common = ["compare-ego", str(a), str(b), "--json"]
        done = CliRunner().invoke(app, [*common, "--store", str(tmp_path / store), "--runs", runs])
        assert done.exit_code == 0, done.output
        return json.loads(done.stdout)

    assert (compared("grown", "60")["pairs"], compared("grown", "150")["pairs"]) == (60, 150)
    again = compared("grown", "150")
    assert (again["pairs"], again["difference"]) == (150, 0.0)


def test_a_rare_comparison_says_what_it_rests_on():
    from sbt.cli.compare_ego import _rare_lines

    told = {"probability": 0.1, "low": 0.0, "high": 0.5, "runs": 60, "failed": 0}
    result = {"before": told | {"precise": False, "warm_ups": 4}, "after": told | {"precise": True}, "difference": 0.0,
              "low": -0.5, "high": 0.5, "verdict": "undecided", "confidence": 0.95}  # fmt: skip
    _, before, after, _, conditional = _rare_lines(result)
    assert "10 % is not reached: more --runs" in before
    assert "reached" not in after
    assert conditional.strip() == "conditional on the traffic of 4 warm-ups"


def _estimate(p: float, low: float, high: float, **rest: object) -> dict:
    return {"probability": p, "low": low, "high": high, "unmet": 0.0, "gate": None} | rest


def test_what_no_run_has_met_is_in_the_verdict_of_a_rare_comparison():
    """An estimate by transfer does not see a new region: fell was said of a P that was the same, in 4 of 8."""
    from sbt.cli.compare_ego import _rare_lines
    from sbt.workflows.paired import _rare_verdict

    old, new = _estimate(0.01, 0.0098, 0.0102, unmet=0.1), _estimate(0.005, 0.0049, 0.0051)
    assert _rare_verdict(old, new, -0.0053, -0.0047) == {"verdict": "fell", "condition": None, "open": None}
    fell = _rare_verdict(old, new | {"unmet": 0.03, "gate": {"verdict": "pass", "statement": ""}}, -0.0053, -0.0047)
    assert fell["verdict"] == "fell"
    assert fell["condition"].startswith("if the search has met whatever is critical")
    assert "no run of the second" in fell["condition"]
    assert fell["condition"].endswith("0.03")
    assert _rare_verdict(old, new | {"unmet": 0.004}, -0.0053, -0.0047)["condition"] is None, "it could not undo it"
    denied = "a draw was critical where the metamodel denied it"
    surprised = {"verdict": "undecided", "statement": denied, "upper": 0.0051, "probability": 0.01}
    told = _rare_verdict(old, new | {"gate": surprised}, -0.0053, -0.0047)
    assert told == {"verdict": "undecided", "condition": None, "open": f"of the second: {denied}"}
    earlier = surprised | {"probability": 0.005}  # of an estimate with fewer runs, which this one is not below
    assert _rare_verdict(old, new | {"gate": earlier}, -0.0053, -0.0047)["verdict"] == "fell"
    rose = _rare_verdict(old, new, 0.001, 0.002)
    assert rose["verdict"] == "rose"
    assert "no run of the first" in rose["condition"]
    assert _rare_verdict(old, new, -0.001, 0.002)["condition"] is None
    said = {"precise": True, "runs": 60, "failed": 0}
    lines = _rare_lines({"before": old | said, "after": new | said, "difference": -0.005, "low": -0.0053, "high": -0.0047,
                         "confidence": 0.95, **fell})  # fmt: skip
    assert lines[3].endswith(f": fell, {fell['condition']}")


def test_a_rare_comparison_searches_the_second_ego(configured, tmp_path):
    """With what the first one taught alone, its start and search were left out."""
    another_ego(tmp_path, "BETTER", 'disc(values, seed)["y"] + 0.1')
    a, b = (configured(*each, budget=60, metamodel={"kind": "gp"}) for each in (("a",), ("b", "BETTER")))
    command = ["compare-ego", str(a), str(b), "--rare", "--store", str(tmp_path / "both"), "--json"]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    gate = found["after"]["gate"]
    assert gate["probability"] == found["before"]["probability"]
    with Store.read(tmp_path / "both" / "b") as store:
        stages = set(store.history().stage)
    assert "initial" in stages
    again = CliRunner().invoke(app, [*command, "--runs", "70"])
    assert again.exit_code == 0, again.output
    assert json.loads(again.stdout)["after"]["gate"]["probability"] == gate["probability"], "what it began with"


def test_different_questions_are_refused(configured, tmp_path):
    a, b = configured("a"), configured("b", requirement={"critical": [-1.0, -0.1]})
    done = CliRunner().invoke(app, ["compare-ego", str(a), str(b), "--store", str(tmp_path / "both")])
    assert done.exit_code == 2
    assert "one requirement" in done.output + str(done.stderr)


def test_the_page_says_what_was_asked_of_which_egos(configured, tmp_path):
    """It had the intervals only as lines, on an axis with one tick, and neither the requirement nor the metrics of a pair."""
    another_ego(tmp_path, "BETTER", 'float("inf") if values["a"] < 0.5 else disc(values, seed)["y"]')
    a, b = configured("a", budget=200), configured("b", "BETTER")
    done = CliRunner().invoke(app, ["compare-ego", str(a), str(b), "--store", str(tmp_path / "both"), "--json"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert all(pair["before"]["y"] <= 0.0 and pair["infinite"] == {"after.y": "inf"} for pair in found["fixed"])
    page = Path(found["page"]).read_text(encoding="utf-8").replace("\N{NO-BREAK SPACE}", " ")
    assert "A run is critical if y ≤ 0." in page
    for name, path, ego in (("before", "a.yaml", "analytic.py:SCENARIO"), ("after", "b.yaml", "analytic.py:BETTER")):
        s = found[name]
        cells = [name, f"{100 * s['probability']:.3g} %", f"{100 * s['low']:.3g} to {100 * s['high']:.3g} %",
                 f"{s['critical']} of 200", "0", f"that of the scenario {ego}", path]  # fmt: skip
        assert "".join(f"<td>{cell}</td>" for cell in cells) in page
    assert f"<td>{100 * found['low']:+.3g} to {100 * found['high']:+.3g} points</td>" in page
    assert "<th>run</th><th>y before</th><th>y after</th><th>a</th>" in page
    first = found["fixed"][0]
    assert f"<td>{first['run']}</td><td>{first['before']['y']:.4g}</td><td>inf</td>" in page
    svg = page[page.index('<svg class="intervals"') : page.index("</svg>", page.index('<svg class="intervals"'))]
    assert len(re.findall(r'y="138" text-anchor="middle">-?[\d.]+</text>', svg)) >= 3


def test_egos_most_of_whose_runs_fail_are_an_exit_code(configured, tmp_path):
    another_ego(tmp_path, "LOST", 'float("nan") if values["a"] < 0.6 else disc(values, seed)["y"]')
    a, b = configured("a", budget=60), configured("b", "LOST")
    done = CliRunner().invoke(app, ["compare-ego", str(a), str(b), "--store", str(tmp_path / "both")])
    assert done.exit_code == 4, done.output
    assert "of 60 did (after)" in done.stderr
    assert "failed runs" in done.stdout


@pytest.mark.parametrize("ends", [(0.0, 1.0), (-0.73, 0.75), (0.0, 1e-4), (-0.001, 0.002), (0.0, 0.3), (-1.0, 1.0)])
def test_ticks_of_the_intervals_are_few_and_round(ends):
    from sbt.report.versus import _round_values

    low, high = ends
    values = np.array(_round_values(low, high))
    assert 2 <= len(values) <= 7
    assert low - 1e-9 <= values.min() <= values.max() <= high + 1e-9
    assert np.abs(values).min() < 1e-12
    assert all(len(f"{100 * value:.6g}") <= 6 for value in values)


@pytest.mark.sumo
def test_egos_of_sumo(tmp_path):
    def config(name, ego):
        path = tmp_path / f"{name}.yaml"
        keys = {"campaign": "coverage", "scenario": "cut_in", "budget": 60, "executor": {"kind": "serial"}}
        path.write_text(json.dumps(keys | ego))
        return path

    a, b = config("a", {}), config("b", {"ego": {"kind": "acc_aeb", "reaction_time": 1.5}})
    done = CliRunner().invoke(app, ["compare-ego", str(a), str(b), "--store", str(tmp_path / "both"), "--json"])
    found = json.loads(done.stdout)
    assert found["after"]["critical"] > found["before"]["critical"] > 0
    page = Path(found["page"]).read_text(encoding="utf-8")
    packed = re.search(r'id="explorer-data">([^<]*)<', page)
    pairs = json.loads(gzip.decompress(base64.b64decode(packed[1])))["pairs"]
    assert [pair["title"] for pair in pairs] == [f"new: run {each['run']}" for each in found["new"]][:6]
    for pair in pairs:
        assert [said.split(",")[0] for said in pair["said"]] == ["not critical", "critical"]
        assert pair["films"][0]["actors"][0]["v"] != pair["films"][1]["actors"][0]["v"], "the films are of two egos"


def test_the_page_of_a_comparison_says_what_it_is_conditional_on():
    from sbt.report.versus import _sentences

    none = {"failed": 0}
    result = {"before": none, "after": none, "fixed": [], "new": [], "still": 2, "pairs": 60}
    assert "is exact and paired" in " ".join(_sentences(result))
    told = " ".join(_sentences(result | {"warm_ups": 4}))
    assert "conditional on the traffic of 4 warm-ups" in told
    assert "exact" not in told

"""The sentences: the answer with its interval, what it does not tell, what to do next; the same wherever they are read."""

import dataclasses
import html
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

import sbt
from sbt.campaigns.boundary import BoundaryConclusion
from sbt.campaigns.parts import CriticalShare
from sbt.campaigns.place import BoundaryPlace, Cut, Stretch, boundary_place
from sbt.campaigns.telling import tell_boundary
from sbt.campaigns.wording import measured, requirement_words, written_unit
from sbt.cli import app
from sbt.loop.stages import Facts, sentences_of
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.store.history import History
from sbt.workflows.exporting import limits_of
from tests.sided_runs import sided_runs

WEDGE = sbt.Scenario(
    "wedge",
    inputs=[sbt.Parameter("gap", 0, 10, "m"), sbt.Parameter("speed", 0, 40, "m/s"), sbt.Parameter("idle", 0, 1, "m/s^2")],
    evaluate=lambda values, seed: {"room": values["gap"] - 2.0 - 0.1 * values["speed"]},
    requirement=sbt.Requirement("room", high=0.0),
)
"""Critical where gap <= 2 + speed / 10; the third input does nothing."""


def test_the_place_of_a_boundary_is_where_it_is_and_names_what_matters():
    space = ParameterSpace((Parameter("idle", 0, 1), Parameter("a", 0, 10), Parameter("b", -5, 5)))
    scenario = LogicalScenario("s", space, Requirement("y", high=0.0), evaluate=lambda v, s: {"y": 0.0})

    def log_odds(u):
        x = space.from_unit(u)
        return 20 * (4.0 + 0.3 * x[:, 2] - x[:, 1])  # critical where a < 4 + 0.3 b

    found = boundary_place(log_odds, scenario, seed=1)
    assert found.inputs == ("a", "b")
    assert set(found.fixed) == {"idle"}
    assert found.weights["a"] > found.weights["b"] > found.weights["idle"] == 0.0
    for cut in found.cuts:
        (stretch,) = cut.critical
        assert stretch.low == 0.0
        assert stretch.high == pytest.approx(4.0 + 0.3 * cut.at, abs=0.01)
        assert cut.unsure == pytest.approx(np.log(19) / 20, abs=0.03)
    succeeds = boundary_place(log_odds, scenario, 1, lambda u: np.where(u[:, 2] < 0.5, -0.1, -3.0))  # runs fail where b > 0
    assert max(cut.at for cut in succeeds.cuts) <= 0.0 < max(cut.at for cut in found.cuts)
    fails = boundary_place(log_odds, scenario, 1, lambda u: np.where(u[:, 1] > 0.2, -0.1, -3.0))  # runs fail where a < 2
    assert all(cut.critical[0].low == pytest.approx(2.0, abs=0.03) and cut.lost for cut in fails.cuts)
    assert "as far as runs give a metric" in fails.words({})
    assert "as far as runs" not in found.words({})
    assert boundary_place(log_odds, scenario, 1, lambda u: np.full(len(u), -3.0)) is None
    for side in (-np.inf, 50.0):
        assert boundary_place(lambda u, p=side: np.full(len(u), p), scenario, seed=1) is None


def test_the_place_of_a_boundary_is_admissible():
    """Critical where a < 4 + 0.3 b; what constraints exclude is no part of a stretch, and a line critical all along is none."""
    constraints = (("a >= 3", lambda c: c["a"] >= 3.0), ("a - b <= 4", lambda c: c["a"] - c["b"] <= 4.0))
    space = ParameterSpace((Parameter("a", 0, 10), Parameter("b", -5, 5)), constraints=constraints)
    scenario = LogicalScenario("s", space, Requirement("y", high=0.0), evaluate=lambda v, s: {"y": 0.0})

    def log_odds(u):
        x = space.from_unit(u)
        return 20 * (4.0 + 0.3 * x[:, 1] - x[:, 0])

    found = boundary_place(log_odds, scenario, seed=1)
    assert found.cuts
    for cut in found.cuts:
        (stretch,) = cut.critical
        assert stretch.low == pytest.approx(3.0, abs=0.03)
        assert stretch.high == pytest.approx(4.0 + 0.3 * cut.at, abs=0.03)
        assert stretch.high <= 4.0 + cut.at + 0.03, "admissible"


@pytest.mark.parametrize("campaign", ["coverage", "boundary", "falsification", "estimation"])
def test_every_campaign_leads_with_its_answer_and_says_it_the_same_everywhere(tmp_path, campaign):
    kind = {"metamodel": {"kind": "gp"}} if campaign == "boundary" else {}
    result = sbt.run(
        campaign=campaign, scenario=WEDGE, budget=30, seed=1, store=tmp_path / "s", executor="serial", **kind
    )  # fmt: skip
    said = result.sentences()
    answer, silent, following = said[:3]
    for part in ("wedge", "room ≤ 0", "95"):
        assert part in answer.replace("\N{NO-BREAK SPACE}", " "), answer
    assert silent.startswith("This does not tell")
    assert following.startswith("Next: ")
    if campaign == "boundary":
        assert answer.startswith("In wedge, a run is critical (room ≤ 0) where gap is below")
        assert "at speed" in answer
    assert result.summary["sentences"] == said[: len(result.summary["sentences"])]
    page = html.unescape(result.report().read_text(encoding="utf-8"))
    shown = CliRunner().invoke(app, ["status", str(tmp_path / "s")])
    stored = json.loads(CliRunner().invoke(app, ["status", str(tmp_path / "s"), "--json"]).stdout)["conclusion"]["sentences"]
    for sentence in result.summary["sentences"]:
        assert f"<p>{sentence}</p>" in page
        assert " ".join(sentence.split()) in " ".join(shown.stdout.split())
        assert sentence in stored
    assert page.index(answer) < page.index("About this campaign")


def test_units_are_printed_as_people_write_them():
    assert written_unit("kg*m^2/s^-3") == "kg*m²/s⁻³"
    assert measured("a", -9.0, "m/s^2") == "a -9 m/s²"
    assert requirement_words(Requirement("braking", low=6.0), "m/s^2") == "braking ≥ 6 m/s²"


def test_a_boundary_that_is_less_certain_than_it_is_wide_is_no_answer():
    """The first sentence says so, and that held-out runs deny the share; a sharp one is told as before."""
    share = CriticalShare(0.5, 0.4, 0.6, counted=100)
    vague = "Where runs of s are critical (y \N{LESS-THAN OR EQUAL TO} 0 m) is not known sharply yet: "
    for unsure, critical, begins in (
        (0.01, 5, "In s, a run is critical"),
        (0.5, 5, f"{vague}edges are less certain"),
        (0.01, 1, f"{vague}only 1 critical run tells"),
    ):
        facts = Facts(sided_runs(critical, 20), Requirement("y", high=0.0), "m", "s")
        place = BoundaryPlace(("a",), 0.0, 1.0, (Cut(None, (Stretch(0.0, 0.3),), unsure),), {}, {"a": 1.0})
        first = tell_boundary(BoundaryConclusion(0.3, 0.0, 0.0, None, place=place), share, facts)[0]
        assert first.startswith(begins)
        assert first.endswith("The held-out runs deny its figures (below): do not rely on it yet.")


def test_few_combinations_are_advised_to_be_run():
    """Where the budget was smaller than their number."""
    facts = Facts(History.of(("a",)), Requirement("y", high=0.0), "m", "s", {}, 40)
    told = tell_boundary(BoundaryConclusion(0.3, 0.0, 0.0, None), CriticalShare(None, 0.0, 1.0), facts)
    assert told[2].startswith("Next: budget: 40 runs all 40 combinations of the inputs")


def test_a_metric_without_a_unit_is_explained():
    conclusion = SimpleNamespace(sentences=lambda facts: ["8 % is critical (criterion \N{LESS-THAN OR EQUAL TO} -10)."])
    facts = Facts(History.of(("a",)), Requirement("criterion", high=-10.0), meanings={"criterion": "smallest distance (m)"})
    assert sentences_of(conclusion, facts)[1:] == ["criterion: smallest distance (m)."]
    assert sentences_of(conclusion, dataclasses.replace(facts, units={"criterion": "m"}))[1:] == []


def test_an_exported_boundary_says_what_it_rests_on(campaign, tmp_path):
    campaign(campaign="coverage", budget=20, store=str(tmp_path / "s"))
    assert limits_of(tmp_path / "s", "csv") == []
    assert "were not chosen to find the boundary" in limits_of(tmp_path / "s", "boundary")[0]


def test_a_falsification_says_whose_distribution_it_hardly_looks_at(tmp_path: Path):
    """One over decades is searched in its logarithm."""
    decades = sbt.Distribution.of(kind="scipy", name="loguniform", a=1e-6, b=1.0)
    inputs = [
        sbt.Parameter("a", 1e-6, 1.0, "", decades), sbt.Parameter("b", -np.inf, np.inf, "", sbt.Normal(0, 1)),
        sbt.Parameter("c", 0.0, 100.0, "", sbt.Normal(50, 0.5)), sbt.Parameter("d", 0.0, 1.0),
        sbt.Parameter("k", 0, 9, kind="integer"),
    ]  # fmt: skip
    keys = {"campaign": "falsification", "budget": 10, "executor": "serial", "report": False, "judges": []}
    for names, told in (("abcdk", {"c": 0.0067}), ("abdk", None)):
        chosen = [each for each in inputs if each.name in names]
        scenario = sbt.Scenario("s", chosen, sbt.Requirement("y", high=0.0), evaluate=lambda v, seed: {"y": v["d"] - 2.0})
        result = sbt.run(scenario=scenario, store=tmp_path / names, seed=1, **keys)
        crowded = result.conclusion.crowded
        assert crowded is None if told is None else crowded == pytest.approx(told, rel=0.01)
        assert any("Half of the distribution of c lies in 0.67" in said for said in result.sentences()) == (told is not None)

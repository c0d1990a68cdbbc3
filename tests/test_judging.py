"""Failures are judged by reference drivers in the place of the ego: what is said of each is what a run with it gives."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import sbt
from sbt.campaigns.preventable import DRIVERS, describe_judgements, with_judgements
from sbt.cli import app
from sbt.cli.conclusion import conclusion_lines
from sbt.errors import InputError
from sbt.metrics.preventability import applicability, why_not
from sbt.problem.trace import Trace
from sbt.store.database import Store
from sbt.store.records import Judgement
from sbt.workflows import judging

SETTINGS = {
    "scenario": "cut_in", "campaign": "falsification", "metamodel": "et", "executor": "serial", "seed": 1, "budget": 16,
    "stop": {"failures": 3}, "report": False,
}  # fmt: skip
BRAKING = {
    "campaign": "coverage", "scenario": "emergency_braking", "budget": 12, "initial": 12, "seed": 3, "executor": "serial",
    "report": False,
}  # fmt: skip


def trace(*actors: tuple[float, float, float, float], size: float = 4.5, heading_ego: np.ndarray | None = None) -> Trace:
    """Straight motion over 4 s of actors (x, y, heading, speed); the first is the ego."""
    t = np.linspace(0.0, 4.0, 41)
    x0, y0, heading, v = (np.array(column) for column in zip(*actors, strict=True))
    directions = np.tile(heading, (len(t), 1))
    if heading_ego is not None:
        directions[:, 0] = heading_ego
    n, ones = len(actors), np.ones((len(t), 1))
    names = ("ego", *(f"co_{k}" for k in range(1, n)))
    return Trace(
        t, names, x0 + np.outer(t, v * np.cos(heading)), y0 + np.outer(t, v * np.sin(heading)),
        directions, ones * v, 0.0 * ones * v, np.array([4.5, *[size] * (n - 1)]), np.array([1.8, *[min(size, 1.8)] * (n - 1)]),
        "duration",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("found", "reason"),
    [
        (trace((0, 0, 0, 20), (30, 0, 0, 15)), ""),
        (trace((0, 0, 0, 20), (30, 3, 0, 15)), ""),
        (trace((0, 0, 0, 20)), "no other road user"),
        (trace((0, 0, 0, 10), (-30, 0, 0, 15)), "from behind"),
        (trace((0, 0, 0, 10), (20, -30, np.pi / 2, 12)), "crosses"),
        (trace((0, 0, 0, 10), (100, 2.5, np.pi, 12)), "oncoming"),
        (trace((0, 0, 0, 10), (25, -3, np.pi / 2, 1.2), size=0.5), "pedestrian"),
        (trace((0, 0, 0, 10), (45, 0, 0, 5), heading_ego=np.linspace(-1.0, 0.0, 41)), "ego turns"),
    ],
    ids=["ahead", "beside", "alone", "behind", "crossing", "oncoming", "pedestrian", "turning"],
)
def test_what_the_drivers_can_judge(found: Trace, reason: str):
    said = why_not(applicability()(found))
    assert (reason in said) if reason else said == ""


def test_who_runs_into_the_first_vehicle_under_test_is_judged_where_it_is_under_test_too():
    found = trace((0, 0, 0, 10), (-30, 0, 0, 15))
    assert why_not(applicability(also_tested=(found.actors[1],))(found)) == ""


def test_words_and_columns():
    judged = [Judgement(1, "rss", True, False, 2.0), Judgement(1, "fsm", False, True, 0.0),
              Judgement(2, "rss", None, reason="alone")]  # fmt: skip
    assert describe_judgements(judged[:2]) == "by rss; not by fsm (collision)"
    assert describe_judgements(judged[2:]) == "not applicable: alone"
    import pandas as pd

    frame = with_judgements(pd.DataFrame({"index": [0, 1, 2]}), judged)
    assert frame["avoided.rss"].tolist() == [pd.NA, True, pd.NA]
    assert frame["preventable"].tolist() == ["", "by rss; not by fsm (collision)", "not applicable: alone"]
    assert list(with_judgements(frame[["index"]], []).columns) == ["index"]


@pytest.mark.sumo
def test_every_failure_mode_says_who_would_have_avoided_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    told: list[str] = []
    result = sbt.run(**SETTINGS, store=tmp_path / "judged", progress=lambda where: told.append(where.activity))
    assert told[-1] == "judging failures"
    modes = result.conclusion.failure_modes
    assert modes
    for mode in modes:
        assert [each.driver for each in mode.preventable] == list(DRIVERS)
        for each in mode.preventable:
            run = sbt.simulate("cut_in", mode.inputs, seed=int(result.history.seed[each.run]), ego=each.driver)
            assert (each.avoided, each.metric) == (not run.critical, run.metrics["ttc_min"])
            assert each.collision == bool(run.metrics["collision"])
    table = result.preventable()
    assert len(table) == len(DRIVERS) * len(modes)
    assert result.frame["preventable"].iloc[modes[0].representative] == describe_judgements(modes[0].preventable)
    assert "avoided by" in result.report().read_text()
    assert f"avoided {describe_judgements(modes[0].preventable)}" in "\n".join(conclusion_lines(result.summary))
    assert "avoided.rss" in result.export("csv").read_text().splitlines()[0]
    assert "reference drivers" in " ".join(result.sentences())

    plain = sbt.run(**SETTINGS, judges=[], store=tmp_path / "plain")
    drop = ["seconds", "preventable", *(f"avoided.{name}" for name in DRIVERS)]
    assert result.frame.drop(columns=drop).equals(plain.frame.drop(columns=["seconds"]))
    assert plain.conclusion.failure_modes[0].preventable is None

    def never(*_: object) -> list[Judgement]:
        raise AssertionError("judged again")

    with monkeypatch.context() as patch:
        patch.setattr(judging, "_judged", never)
        assert sbt.run(**SETTINGS, store=tmp_path / "judged").judgements == result.judgements
        runner = CliRunner().invoke(app, ["replay", str(tmp_path / "judged"), str(modes[0].representative), "--json"])
        assert [each["driver"] for each in json.loads(runner.stdout)["preventable"]] == list(DRIVERS)
    assert sbt.run(**SETTINGS, store=tmp_path / "plain").judgements == result.judgements, "a campaign may be judged later"


@pytest.mark.sumo
def test_any_run_can_be_judged_by_replay_and_the_store_stays_as_it_is(tmp_path: Path):
    result = sbt.run(**BRAKING, store=tmp_path / "runs")
    assert result.judgements == []
    before = (tmp_path / "runs" / "campaign.sqlite").read_bytes()
    shown = CliRunner().invoke(app, ["replay", str(tmp_path / "runs"), "5", "--judge"])
    assert shown.exit_code == 0
    assert all(f"  {name} " in shown.stdout for name in DRIVERS)
    assert (tmp_path / "runs" / "campaign.sqlite").read_bytes() == before
    assert result.preventable(5, ["fsm"])["driver"].tolist() == ["fsm"]
    film, inputs = result.film(5, driver="fsm"), result.history.inputs(5)
    run = sbt.simulate("emergency_braking", inputs, seed=int(result.history.seed[5]), ego="fsm")
    assert np.array_equal(film.states.x, run.states.x)
    command = ["replay", str(tmp_path / "runs"), "5", "--driver", "rss", "--trace", str(tmp_path / "rss.csv")]
    only = CliRunner().invoke(app, command)
    assert "  rss " in only.stdout
    assert (tmp_path / "rss.csv").is_file()
    with pytest.raises(InputError, match="a run must be a finished one"):
        result.preventable(99)
    explicit = sbt.run(**BRAKING, judges=["fsm"], store=tmp_path / "runs")
    critical = explicit.frame[explicit.frame["critical"]]
    assert {each.run for each in explicit.judgements} == set(critical["index"])


def test_what_cannot_be_judged_says_why_and_costs_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A scenario that names the reason; a testbed by default, and when asked for."""
    disc = {**SETTINGS, "scenario": "testbed:four_branch_7"}
    result = sbt.run(**disc, store=tmp_path / "disc")
    assert result.judgements == []
    asked = sbt.run(**disc, judges=["rss"], store=tmp_path / "asked")
    for each in asked.judgements:
        assert each.avoided is None
        assert "offers no choice of ego" in each.reason
    with pytest.raises(InputError, match=r"judges.*'rrs'.*did you mean 'rss'"):
        sbt.run(**disc, judges=["rrs"], store=tmp_path / "wrong")
    with Store.read(tmp_path / "asked") as store:
        assert all(mode["preventable"] for mode in store.conclusion["conclusion"]["failure_modes"])


@pytest.mark.parametrize(
    "name",
    ["crossing_pedestrian", "highway_merge", "jaywalking", "lane_keeping", "parking", "roundabout_entry",
     "unprotected_left_turn"],
)
def test_scenarios_that_are_none_of_the_models_say_so(name: str):
    from sbt.plugins import load

    assert load("scenarios", name).roles.not_judged

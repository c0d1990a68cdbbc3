"""What is told of values and commands that are unusual: short, and such that it can be typed."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from test_cli import RESULT

import sbt
from sbt.cli.conclusion import conclusion_lines
from sbt.errors import command_of


@pytest.mark.parametrize("value", [10**400, 10**5000, "y" * 1000, [1.0] * 1000, b"x" * 1000], ids=lambda x: type(x).__name__)
def test_the_reason_of_a_run_does_not_repeat_a_long_value(value):
    """Python writes no number of more than 4,300 digits: the reason was that it does not."""
    inputs, asked = [sbt.Parameter("a", 0, 1)], sbt.Requirement("y", high=0.0)
    scenario = sbt.Scenario("s", inputs, asked, evaluate=lambda x, seed: {"y": value})
    run = sbt.simulate(scenario, {"a": 0.5})
    assert run.status == "failed"
    rule = "finite and within 1e+100, inf or -inf" if isinstance(value, int) else "one number"
    assert run.reason.startswith(f"metric y must be {rule}, but got ")
    assert len(run.reason) < 160


@pytest.mark.parametrize("store", ["-dash", "--dash", "a b", "-my runs", "runs/-dash"])
def test_a_command_to_try_names_no_folder_that_is_an_option(store, monkeypatch, tmp_path):
    words = shlex.split(command_of("sumo-sbt", "replay", Path(store), "2", "--film", "x.gif"))
    assert not words[2].startswith("-")
    assert words[3:] == ["2", "--film", "x.gif"]
    monkeypatch.chdir(tmp_path)
    Path(store).mkdir(parents=True)
    assert Path(words[2]).is_dir()


def test_the_command_after_a_campaign_can_be_typed():
    found = conclusion_lines({**RESULT, "store": "-dash", "look_at": 2})
    assert "next: sumo-sbt replay ./-dash 2" in found

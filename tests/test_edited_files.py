"""Files that a user edits within a Python session, and configurations that are run from elsewhere, are those that are meant."""

from __future__ import annotations

import os

import pytest
from test_doors import files_of

import sbt
from sbt.errors import InputError

FUNCTION = """import sbt
SCENARIO = sbt.Scenario('s', [sbt.Parameter('a', 0, 1, 'm')], sbt.Requirement('gap', high=0.0),
    evaluate=lambda values, seed: {{'gap': {0}}})
"""


def test_an_edited_python_file_is_run_as_it_stands(tmp_path):
    file = tmp_path / "mine.py"
    for value in (1.0, 2.0):
        file.write_text(FUNCTION.format(value))
        os.utime(file, (value, value))  # a clock of a file system may be coarse
        assert sbt.simulate(f"{file}:SCENARIO").metrics == {"gap": value}


@pytest.mark.sumo
@pytest.mark.parametrize(("name", "old", "new"), [
    ("cars.rou.xml", 'departSpeed="30"', 'departSpeed="29"'), ("scenario.yaml", "duration: 10", "duration: 02"),
    ("road.net.xml", "length=\"2000.00\" shape=\"0.00,-4.80", "length=\"2100.00\" shape=\"0.00,-4.80"),
])  # fmt: skip
def test_edited_sumo_files_are_run_as_they_stand(tmp_path, name, old, new):
    files_of("own_files", tmp_path)
    before = sbt.simulate(tmp_path / "scenario.yaml").trace
    text = (tmp_path / name).read_text()
    (tmp_path / name).write_text(text.replace(old, new, 1))
    after = sbt.simulate(tmp_path / "scenario.yaml").trace
    assert text != (tmp_path / name).read_text()
    assert not before.equals(after)
    (tmp_path / name).write_text(text)
    assert sbt.simulate(tmp_path / "scenario.yaml").trace.equals(before)


@pytest.mark.parametrize("place", ["", "elsewhere"])
def test_a_resolved_configuration_goes_on_from_any_folder(tmp_path, monkeypatch, place):
    (tmp_path / "mine.py").write_text(FUNCTION.format("values['a']"))
    monkeypatch.chdir(tmp_path)
    first = sbt.run(campaign="coverage", scenario="mine.py:SCENARIO", budget=4, store=tmp_path / "store", executor="serial")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / place)
    again = sbt.run(tmp_path / "store" / "config.resolved.yaml", budget=6)
    assert len(again.history) == 6
    assert (again.history.x[:4] == first.history.x[:4]).all()


def test_a_change_that_only_some_runs_show_is_refused_every_time(tmp_path):
    """The first and the last run do not depend on it; of files that were changed since, more runs are tried."""
    file = tmp_path / "mine.py"
    file.write_text(FUNCTION.format("values['a']"))
    study = {"campaign": "coverage", "scenario": f"{file}:SCENARIO", "store": tmp_path / "store", "executor": "serial"}
    x = sbt.run(budget=12, **study).history.x[:, 0].tolist()
    file.write_text(FUNCTION.format(f"values['a'] + (values['a'] not in ({x[0]!r}, {x[-1]!r}))"))
    later = (tmp_path / "store" / "config.resolved.yaml").stat().st_mtime + 10.0
    os.utime(file, (later, later))
    for _ in range(2):
        with pytest.raises(InputError, match=r"code and files must give the runs of .* again .*changed since: .*mine\.py"):
            sbt.run(budget=14, **study)
    file.write_text(FUNCTION.format("values['a'] * 1.0"))
    os.utime(file, (later, later))
    assert len(sbt.run(budget=14, **study).history) == 14

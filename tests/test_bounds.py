"""Files and values that would take all memory or time, or overflow, are errors in words."""

from __future__ import annotations

import csv
import dataclasses
import gzip
import io
import json
import os
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from sbt.config.asked import Asked
from sbt.config.benchmark import Benchmark
from sbt.config.load import parse
from sbt.config.model import Configuration
from sbt.config.scenario_model import ScenarioModel
from sbt.errors import InputError, UnwritableError
from sbt.execution.worker import run_job
from sbt.files import as_cell, write_atomically
from sbt.metamodels.base import build
from sbt.plugins import load, names
from sbt.problem.distribution import Distribution
from sbt.problem.outcome import Job
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import CriticalInterval, Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.store.connection import _copied
from sbt.sumo.files import SumoFiles
from sbt.workflows.exporting import _cells
from sbt.workflows.study import Study


@pytest.mark.parametrize(
    ("keys", "rule"),
    [
        ({"seed": 10**400}, "seed: must be less than or equal to"),
        ({"inputs": {"d_t": {"min": -1e308, "max": 1e308}}}, "ends must be within 1e\\+100"),
        ({"inputs": {"d_t": {"min": 0, "max": 1e-300}}}, "1e-100 and a 1e\\+12th of themselves apart"),
        ({"inputs": {"d_t": {"min": 1.0, "max": 1.0000000000000002}}}, "apart"),
        ({"requirement": {"metric": "ttc_min", "critical": [-1e308, 0]}}, "critical interval must be within"),
        ({"inputs": {"d_t": {"distribution": {"kind": "lognormal", "mean": 1e-9, "std": 1e300}}}}, "cannot have the parameters"),
        ({"inputs": {"d_t": {"distribution": {"kind": "scipy", "name": "skewnorm", "a": "x"}}}}, "cannot have the parameters"),
        (
            {"inputs": {"d_t": {"distribution": {"kind": "empirical", "file": "/dev/zero", "column": "v"}}}},
            "a table must be a file",
        ),
        ({"inputs": {"d_t": {"distribution": {"kind": "empirical", "file": "a\0", "column": "v"}}}}, "needs a file"),
        ({"simulation": {"step_length": 1e308}}, "step_length <= duration"),
        ({"constraints": ["+".join(["d_t"] * 5000) + " < 1"]}, "at most 4096 characters"),
        ({"store": "\ud800"}, "half of a character"),
    ],
)
def test_values_beyond_what_they_can_mean_are_refused(keys: dict[str, object], rule: str):
    with pytest.raises(InputError, match=rule) as error:
        _ = Study(parse(json.dumps({"campaign": "coverage", "scenario": "cut_in", **keys}))).settings
    assert len(str(error.value)) < 1000


def unbounded(schema: Any, path: str = "") -> list[str]:
    """Return where a JSON schema takes any whole number, or any number of conditions, metrics, judges, ..."""
    if isinstance(schema, list):
        return [each for k, item in enumerate(schema) for each in unbounded(item, f"{path}/{k}")]
    if not isinstance(schema, dict):
        return []
    whole = schema.get("type") == "integer" and not {"maximum", "exclusiveMaximum"} & set(schema)
    return [path] * whole + [each for key, value in schema.items() for each in unbounded(value, f"{path}/{key}")]


def test_every_whole_number_of_a_file_has_an_upper_bound():
    models = (Configuration, ScenarioModel, Benchmark, Asked)
    assert [each for model in models for each in unbounded(model.model_json_schema(), model.__name__)] == []


@pytest.mark.parametrize("name", names("metamodels"))
def test_every_setting_of_a_metamodel_has_a_type_and_a_bound(name: str):
    kind = load("metamodels", name)
    for preset in (None, *getattr(kind, "PRESETS", {})):
        assert build(kind, preset)
    for field in dataclasses.fields(kind):
        wrong = {"int": (10**12, 1e12, True, "1"), "float": (float("nan"), "1", True), "bool": (1, "yes")}
        for value in wrong.get(str(field.type).removesuffix(" | None"), ()):
            with pytest.raises(InputError, match=f"{field.name} must be"):
                build(kind, settings={field.name: value})
    with pytest.raises(InputError, match=r"widths must be a list of at most 100, each a whole number of at most [0-9]+"):
        build(load("metamodels", "bnn"), settings={"widths": [10**9]})


@pytest.mark.parametrize(
    ("keys", "rule"),
    [
        ({"judges": ["fsm"] * 1000}, "judges: must have at most 20 entries, but got 1000"),
        ({"judges": ["fsm", "fsm"]}, "judges: each must be named once, but got 'fsm' again"),
        ({"metrics": ["pet"] * 1000}, "metrics: must have at most 100 entries"),
        ({"constraints": ["d_t < 2"] * 1000}, "constraints: must have at most 100 entries"),
        ({"metamodel": {"kind": "gp", "max_epochs": 1e12}}, "metamodel: max_epochs must be within 10000000"),
        ({"batch": 10**12}, "batch: must be less than or equal to 10000000"),
    ],
)
def test_long_lists_and_large_numbers_are_refused(keys: dict[str, object], rule: str):
    with pytest.raises(InputError, match=rule):
        parse(json.dumps({"campaign": "falsification", "scenario": "cut_in", **keys}))


def test_a_wrong_configuration_waits_for_no_library_of_metamodels(tmp_path: Path):
    """Nor for a scenario's simulator: torch alone takes a second and 200 MB."""
    (tmp_path / "c.yaml").write_text("campaign: falsification\nscenario: cut_in\nbugdet: 3\ninputs: {d_t: {min: 9, max: 1}}\n")
    script = (
        "import sys\nfrom sbt.errors import InputError\nfrom sbt.workflows.study import Study\n"
        f"try: Study.from_file({str(tmp_path / 'c.yaml')!r})\nexcept InputError as error: print(len(error.errors))\n"
        "print({'torch', 'sklearn', 'pandas', 'libsumo', 'scipy.stats', 'matplotlib'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == "2\nset()\n"


@pytest.mark.parametrize("value", ["!!bool maybe", "!!int x", "!!float abc", "!!timestamp 1", "!!binary x", "!own x", "&a [*a]"])
def test_odd_tags_of_yaml_are_errors_in_words(value: str):
    with pytest.raises(InputError, match=r"<text>.*must (be YAML|be a whole number|have at most)"):
        parse(f"campaign: coverage\nscenario: cut_in\nbudget: {value}\n")


def test_a_packed_file_does_not_unpack_to_all_memory(tmp_path: Path):
    (tmp_path / "n.net.xml.gz").write_bytes(gzip.compress(b'<net version="1.20">' + b" " * 2**26 + b"</net>"))
    with pytest.raises(InputError, match="may unpack to 100 times its size"):
        _ = SumoFiles.of({"net-file": "n.net.xml.gz"}, tmp_path, "sumo").templates
    for name, data in (("short", gzip.compress(os.urandom(99))[:50]), ("odd", b"\x1f\x8b" + bytes(range(99)))):
        (tmp_path / f"{name}.net.xml.gz").write_bytes(data)
        with pytest.raises(InputError, match="must be readable"):
            _ = SumoFiles.of({"net-file": f"{name}.net.xml.gz"}, tmp_path, "sumo").templates


def test_a_metric_has_a_square():
    space = ParameterSpace((Parameter("a", 0.0, 1.0),))
    wide = LogicalScenario(
        "wide", space, Requirement("y", high=0.0), evaluate=lambda values, seed: {"y": 1e308}, metric_names=("y",)
    )
    assert run_job(wide, Job(0, {"a": 0.5}, 0)).reason == "metric y must be finite and within 1e+100, inf or -inf, but got 1e+308"


def test_ends_far_apart_are_a_range():
    assert Parameter("a", 1e15, 1e15 + 1e4).high > 1e15
    assert Parameter("a", 0.0, 1e-90).high == 1e-90
    assert CriticalInterval(high=1e99).high == 1e99
    assert Distribution.of("normal", mean=0, std=1e-9).truncated(-1, 1).mass == pytest.approx(1)


def test_what_cannot_be_written_is_said(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(UnwritableError, match=r"a result must be written, but .*runs\.csv cannot be: ") as error:
        write_atomically(tmp_path / "file" / "runs.csv", "x")
    assert error.value.strerror


def test_a_store_where_nothing_may_be_written_is_read_with_its_log(tmp_path: Path):
    """As of a campaign that was killed, on a read-only medium: what was committed last stands in the log alone."""
    db = sqlite3.connect(tmp_path / "c.sqlite", isolation_level=None)
    db.execute("PRAGMA journal_mode = WAL")
    db.execute("CREATE TABLE t (a)")
    db.execute("INSERT INTO t VALUES (7)")
    (tmp_path / "ro").mkdir()
    for name in ("c.sqlite", "c.sqlite-wal"):
        shutil.copyfile(tmp_path / name, tmp_path / "ro" / name)
    copy = _copied(tmp_path / "ro" / "c.sqlite", tmp_path / "ro" / "c.sqlite-wal")
    assert copy.execute("SELECT a FROM t").fetchall() == [(7,)]
    copy.close()
    db.close()
    assert sorted(path.name for path in (tmp_path / "ro").iterdir()) == ["c.sqlite", "c.sqlite-wal"]


def test_no_cell_of_a_table_is_a_formula():
    frame = pd.DataFrame({"x": [-1.5, 2.0], "reason": ["=cmd|'/C calc'!A0", "-2"], "@m": ["+a", "\tb"], "n": [1, -1]})
    cells = _cells(frame)
    assert list(cells.columns) == ["x", "reason", "'@m", "n"]
    assert cells["reason"].tolist() == ["'=cmd|'/C calc'!A0", "-2"]
    assert cells["'@m"].tolist() == ["'+a", "'\tb"]
    assert cells["x"].tolist() == [-1.5, 2.0]
    assert [as_cell(value) for value in (None, 3, "a=b", "-")] == [None, 3, "a=b", "'-"]
    file = io.StringIO()
    _cells(pd.DataFrame({"reason": ["a\r=1+1", "b\r\n=2", "\r=3"]})).to_csv(file, index=False)
    assert list(csv.reader(io.StringIO(file.getvalue()))) == [["reason"], ["a\n=1+1"], ["b\n=2"], ["'\n=3"]]
    assert "\r" not in file.getvalue(), "a reader begins a row at an unquoted carriage return"

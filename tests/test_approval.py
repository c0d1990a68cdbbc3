"""A store that somebody else made runs nothing unsaid, and replays wherever it lies."""

from __future__ import annotations

import importlib.util
import json
import os
import py_compile
import shutil
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import departing
import pytest
from typer.testing import CliRunner

import sbt
from sbt import plugins
from sbt.cli import app, listing
from sbt.plugins import approval
from sbt.plugins.approval import UntrustedError
from sbt.workflows.running import replay_run

LOUD = """
import sys
from pathlib import Path
sys.path.insert(0, str(Path(__file__).parent))
import {helper}
import sbt
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
MARK = Path(__file__).with_name("ran")
MARK.touch()

def odd(values):
    return values["a"] < 2.0

def scenario(*constraints):
    space = ParameterSpace((sbt.Parameter("a", 0.0, 1.0),), constraints=constraints)
    evaluate = lambda v, seed: {{"y": v["a"]}}
    return LogicalScenario("loud", space, sbt.Requirement("y", high=0.1), evaluate=evaluate, metric_names=("y",))

PLAIN, ODD = scenario(), scenario(("odd", odd))
"""


def tried(*command: object) -> tuple[int, str]:
    done = CliRunner().invoke(app, [str(word) for word in command])
    return done.exit_code, done.output


@pytest.fixture
def stranger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Become somebody who has approved nothing."""

    def become() -> None:
        monkeypatch.setattr("sbt.plugins.approval._trusted", set())
        monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / os.urandom(4).hex()))

    become()
    return become


@pytest.fixture
def loud(tmp_path: Path, stranger: Any) -> Callable[[str], Path]:
    """Run a campaign whose file leaves a mark when it is imported, and remove the mark."""

    def run(name: str, **keys: Any) -> Path:
        folder = tmp_path / "own"
        folder.mkdir(exist_ok=True)
        helper = f"helper_{os.urandom(4).hex()}"
        (folder / f"{helper}.py").write_text("X = 1\n")
        (folder / "loud.py").write_text(LOUD.format(helper=helper))
        data = {"campaign": "coverage", "scenario": f"loud.py:{name}", "budget": 12, "executor": {"kind": "serial"}, "store": "s"}
        (folder / "c.yaml").write_text(json.dumps(data | keys))
        sbt.run(folder / "c.yaml", store=folder / "s", report=False)
        approval._trusted.clear()  # as in another process
        (folder / "ran").unlink()
        return folder

    return run


def test_reading_needs_no_code_and_a_replay_without_a_trace_runs_none(loud: Any, stranger: Any, tmp_path: Path):
    own = loud("PLAIN")
    theirs = Path(shutil.copytree(own, tmp_path / "theirs"))
    shutil.rmtree(own)
    assert tried("report", theirs / "s")[0] == 0
    for folder in (theirs, theirs):
        for verb in ("status", "export"):
            assert tried(verb, folder / "s")[0] == 0
        code, said = tried("replay", folder / "s", 3, "--json")
        assert (code, json.loads(said)["identical"]) == (0, None)
        assert not (folder / "ran").exists()
        stranger()
    code, said = tried("replay", theirs / "s", 3, "--json", "--trust")
    assert (code, json.loads(said)["identical"], (theirs / "ran").exists()) == (0, True, True)


def test_a_merge_runs_no_code_that_is_not_approved(loud: Any, stranger: Any, tmp_path: Path):
    """Not to try the runs of shards either, whose files are newer here."""
    own = loud("PLAIN")
    for k in (1, 2):
        assert tried("run", own / "c.yaml", "--shard", f"{k}/2", "--store", own / f"part-{k}")[0] == 0
    theirs = Path(shutil.copytree(own, tmp_path / "theirs"))
    shutil.rmtree(own)
    os.utime(theirs / "loud.py", (4e9, 4e9))
    (theirs / "ran").unlink(missing_ok=True)
    stranger()
    approval._trusted.clear()
    code, said = tried("merge", theirs / "part-1", theirs / "part-2", "--into", theirs / "whole")
    assert code == 0, said
    assert not (theirs / "ran").exists()


def test_code_that_is_needed_is_refused_until_it_is_approved_with_this_content(loud: Any, stranger: Any, tmp_path: Path):
    own = loud("ODD")
    assert tried("export", own / "s")[0] == 0, "one's own store asks for nothing"
    theirs = Path(shutil.copytree(own, tmp_path / "theirs"))
    shutil.rmtree(own)
    assert tried("export", theirs / "s")[0] == 0, "the content is approved, wherever it lies"
    stranger()
    (theirs / "ran").unlink(missing_ok=True)
    for command in (("report", theirs / "s"), ("export", theirs / "s"), ("bundle", theirs / "s")):
        code, said = tried(*command)
        assert code == 2
        assert str(theirs / "loud.py") in said
        assert "--trust" in said
    assert not (theirs / "ran").exists()
    with pytest.raises(sbt.InputError, match="SBT_TRUST"):
        _ = sbt.open(theirs / "s").scenario
    assert tried("export", theirs / "s", "--trust")[0] == 0
    with pytest.MonkeyPatch.context() as patch:  # another process of the same user
        patch.setattr("sbt.plugins.approval._trusted", set())
        assert tried("export", theirs / "s")[0] == 0
        helper = next(theirs.glob("helper_*.py"))
        helper.write_text("X = 2\n")
        assert tried("export", theirs / "s")[0] == 2, "a module that the file imports has changed"
        patch.setenv("SBT_TRUST", f"{tmp_path / 'elsewhere'}{os.pathsep}{theirs}")
        assert tried("export", theirs / "s")[0] == 0
    stranger()
    assert sbt.open(theirs / "s", trust=True).scenario.space.names == ("a",)


def test_what_a_store_names_beside_its_scenario_is_asked_for_too(loud: Any, stranger: Any):
    own = loud("PLAIN")
    stranger()
    with pytest.raises(UntrustedError, match=r"loud\.py"):
        sbt.open(own / "s").study.loaded.scope.load("controllers", "loud.py:PLAIN")
    assert replay_run(own / "s", 0).executed is False


def test_a_bundle_replays_where_it_is_unpacked(loud: Any, stranger: Any, tmp_path: Path):
    own = loud("PLAIN")
    assert tried("bundle", own / "s", "--to", tmp_path / "mail.zip")[0] == 0
    shutil.rmtree(own)
    with zipfile.ZipFile(tmp_path / "mail.zip") as file:
        file.extractall(tmp_path / "other")
    stranger()
    store = tmp_path / "other" / "mail"
    code, said = tried("replay", store, 5, "--trust", "--json")
    assert (code, json.loads(said)["identical"]) == (0, True)
    assert (store / "files" / "ran").exists()
    assert len(list(store.glob("files/*"))) == 3, "what else the process has read is not in it"


@pytest.mark.sumo
def test_own_files_that_are_moved_or_bundled_give_the_same_runs(tmp_path: Path, stranger: Any):
    own = tmp_path / "own"
    own.mkdir()
    (own / "net.net.xml").write_text(departing.NET)
    (own / "cars.rou.xml").write_text(f"{departing.HEAD}\n{departing.car('ego', '${p}')}{departing.car('lead', '550')}</routes>")
    (own / "scenario.yaml").write_text(departing.YAML.format(ego="ego", more="", options=""))
    (own / "c.yaml").write_text(json.dumps({
        "campaign": "coverage", "scenario": str(own / "scenario.yaml"), "budget": 4, "executor": {"kind": "serial"}, "store": "s",
    }))  # fmt: skip
    sbt.run(own / "c.yaml", store=own / "s", report=False)
    assert tried("bundle", own / "s", "--to", tmp_path / "mail.zip")[0] == 0
    shutil.move(own, tmp_path / "moved")
    with zipfile.ZipFile(tmp_path / "mail.zip") as file:
        file.extractall(tmp_path / "other")
    for store in (tmp_path / "moved" / "s", tmp_path / "other" / "mail"):
        code, said = tried("replay", store, 2, "--json")
        assert (code, json.loads(said)["identical"]) == (0, True)


@pytest.mark.parametrize(
    ("said", "file", "inside"),
    [
        ("from PKG import mod", "mod.py", ""),
        ("from PKG.sub import mod", "sub/mod.py", ""),
        ("import PKG.sub.mod", "sub/__init__.py", ""),
        ("from PKG import *", "mod.py", ""),
        ("from PKG import *", "sub/mod.py", "from .sub import mod"),
        ("import PKG.sub.mod", "mod.py", "from .. import mod"),
        ("import PKG.sub.mod", "mod.py", "from PKG.mod import X"),
    ],
)
def test_every_module_that_an_import_can_run_is_approved_and_bundled(tmp_path: Path, said: str, file: str, inside: str):
    package = tmp_path / "pkg"
    (package / "sub").mkdir(parents=True)
    where = "sub/mod.py" if said.endswith("sub.mod") else "__init__.py"
    for name in ("__init__.py", "mod.py", "sub/__init__.py", "sub/mod.py"):
        (package / name).write_text(f"{inside.replace('PKG', 'pkg') if name == where else ''}\nX = 1\n")
    main = tmp_path / "main.py"
    main.write_text(said.replace("PKG", "pkg"))
    before = approval.digest_of(main)
    assert package / file in approval.modules_of(main)
    (package / file).write_text("X = 2\n")
    assert approval.digest_of(main) != before


def test_byte_code_beside_approved_source_never_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stranger: Any):
    monkeypatch.setattr("sys.path", [str(tmp_path), *sys.path])
    evil, helper, alone = (f"{name}_{os.urandom(4).hex()}" for name in ("main", "helper", "alone"))
    (tmp_path / "evil.py").write_text("WHAT = 'byte code'\n")
    (tmp_path / f"{evil}.py").write_text(f"""
from {helper} import WHAT
try:
    import {alone}
except ImportError:
    ALONE = None
def later():
    import {helper}_later
    return {helper}_later.WHAT
""")
    mode = py_compile.PycInvalidationMode.UNCHECKED_HASH
    for name in (helper, f"{helper}_later"):
        (tmp_path / f"{name}.py").write_text("WHAT = 'source'\n")
        cached = importlib.util.cache_from_source(str(tmp_path / f"{name}.py"))
        py_compile.compile(str(tmp_path / "evil.py"), cached, invalidation_mode=mode)
    py_compile.compile(str(tmp_path / "evil.py"), str(tmp_path / f"{alone}.pyc"))
    cached = importlib.util.cache_from_source(str(tmp_path / f"{evil}.py"))
    py_compile.compile(str(tmp_path / "evil.py"), cached, invalidation_mode=mode)
    importlib.util.find_spec(f"{helper}_later")  # the folder has been looked at before
    what = [plugins.load("metrics", f"{evil}.py:{name}", tmp_path) for name in ("WHAT", "ALONE", "later")]
    assert (what[0], what[1], what[2]()) == ("source", None, "source")


@pytest.mark.parametrize("value", ["state", "~/state", "./", ""])
def test_folders_of_the_user_are_not_looked_for_in_the_working_directory(monkeypatch: pytest.MonkeyPatch, value: str):
    """A folder of somebody else's could have brought approvals of its code."""
    for name in ("XDG_STATE_HOME", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, value)
    home = Path.home()
    assert (approval._state_file(), listing._folder()) == (home / ".local/state/sumo-sbt/approved", home / ".cache/sumo-sbt")
    for name in ("XDG_STATE_HOME", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, "/elsewhere")
    assert (approval._state_file(), listing._folder()) == (Path("/elsewhere/sumo-sbt/approved"), Path("/elsewhere/sumo-sbt"))

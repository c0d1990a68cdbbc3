"""Documentation runs: every configuration, the examples in docstrings, and what the README says."""

from __future__ import annotations

import doctest
import importlib
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from sbt.cli import app
from sbt.config.assemble import assemble
from sbt.config.benchmark import load_benchmark
from sbt.config.load import load, parse

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text()
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
BENCHMARKS = sorted((ROOT / "configs").glob("benchmark_*.yaml"))
CONFIGS = sorted(set((ROOT / "configs").glob("*.yaml")) - set(BENCHMARKS))
EXAMPLES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for path in (ROOT / "sbt").rglob("*.py") if re.search(r"^\s*>>> ", path.read_text(), re.MULTILINE)
)  # fmt: skip
SMALL = {"budget": 24, "initial": 12, "batch": 12}


def small(config: Path) -> list[str]:
    """Options that make a campaign end in a second or two."""
    reference = min(20, load(config).config.validation.reference)
    settings = {**SMALL, "validation.reference": reference, "executor.kind": "serial"}
    return [part for key, value in settings.items() for part in ("--set", f"{key}={value}")]


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def test_there_are_configurations_and_examples():
    assert ROOT / "configs" / "cut_in_boundary.yaml" in CONFIGS
    assert len(EXAMPLES) > 5


@pytest.mark.sumo
@pytest.mark.parametrize("config", CONFIGS, ids=lambda path: path.stem)
def test_configurations_run(config: Path, tmp_path: Path):
    assemble(load(config))
    command = [sys.executable, "-m", "sbt", "run", str(config), "--store", str(tmp_path / "s"), "--json", *small(config)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert done.stdout.count("\n") == 1
    assert (result["ok"], result["failed"]) == (result["runs"], 0)
    repeated = sum(mode["confirmation_runs"] for mode in result["conclusion"].get("failure_modes", []))
    assert result["runs"] == 24 + repeated + min(20, load(config).config.validation.reference)
    assert (tmp_path / "s" / "report.html").is_file()


@pytest.mark.parametrize("config", BENCHMARKS, ids=lambda path: path.stem)
def test_benchmarks_load(config: Path):
    """The large ones take hours or weeks; the tiny one is run in test_benchmark.py."""
    assert list(load_benchmark(config).cells())


@pytest.mark.parametrize("module", EXAMPLES)
def test_examples_in_docstrings(module: str):
    failed, tried = doctest.testmod(importlib.import_module(module), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert (failed, tried > 0) == (0, True)


def commands() -> list[list[str]]:
    """The lines of the README's bash blocks, continued lines joined."""
    lines = "\n".join(blocks(README, "bash")).replace("\\\n", " ").splitlines()
    return [words for line in lines if (words := shlex.split(line, comments=True))]


@pytest.mark.sumo
def test_commands_of_the_readme_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """One after the other in an empty folder, campaigns made small."""
    monkeypatch.chdir(tmp_path)
    if not commands():
        pytest.skip("the README has no commands yet")
    for folder in ("configs", "docs", "examples"):
        if (ROOT / folder).is_dir():
            (tmp_path / folder).symlink_to(ROOT / folder)
    for program, *args in commands():
        name = program.rpartition("/")[2]
        if name == "test" or name in ("git", "cd", "pip", "source", "python3", "uv"):
            continue
        if name == "run":
            args = ["run", *(args or ["configs/cut_in_boundary.yaml"])]
        else:
            assert name == "sumo-sbt", f"the README says '{program}', which this test does not know"
        if args[0] == "run":
            args = [*args, *small(tmp_path / args[1]), "--set", "metamodel.kind=et"]
        done = CliRunner().invoke(app, args)
        assert done.exit_code == 0, f"{args}: {done.output}"


def test_python_of_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    if not blocks(README, "python"):
        pytest.skip("the README has no Python")
    monkeypatch.chdir(tmp_path)
    for code in blocks(README, "python"):
        exec(compile(code, "README.md", "exec"), {"__name__": "readme"})


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_configurations_in_the_documentation_load(page: Path):
    found = [text for text in blocks(page.read_text(), "yaml") if re.search(r"^campaign:", text, re.MULTILINE)]
    if not found:
        pytest.skip("no configuration on this page")
    for text in found:
        loaded = parse(text, name=page.name, folder=ROOT)
        if ".py:" not in loaded.config.scenario:
            assemble(loaded)


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_links_of_the_documentation_lead_somewhere(page: Path):
    links = re.findall(r"\]\((?!https?:|#|mailto:)([^)#\s]*[./][^)#\s]*)", page.read_text())
    assert [link for link in links if not (page.parent / link).exists()] == []

"""Documentation runs: every configuration, the examples in docstrings, and what the README says."""

from __future__ import annotations

import doctest
import importlib
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer
from doc_blocks import PAGES, ROOT, Block, blocks_of, commands_of, inline_commands
from pydantic import BaseModel
from typer.testing import CliRunner

from sbt.cli import app
from sbt.config.assemble import assemble
from sbt.config.benchmark import load_benchmark
from sbt.config.load import load, parse
from sbt.config.model import Configuration
from sbt.config.scenario_model import ScenarioModel
from sbt.config.source import read_yaml

BENCHMARKS = sorted((ROOT / "configs").glob("benchmark_*.yaml"))
CONFIGS = sorted(set((ROOT / "configs").glob("*.yaml")) - set(BENCHMARKS))
EXAMPLES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for path in (ROOT / "sbt").rglob("*.py") if re.search(r"^\s*>>> ", path.read_text(), re.MULTILINE)
)  # fmt: skip
SMALL = {"budget": 24, "initial": 12, "batch": 12}


def small(config: Path) -> list[str]:
    """Options that make a campaign end in a second or two."""
    of_file = load(config).config
    learns = {"validation.reference": min(20, of_file.validation.reference)}
    size = {"budget": 8} if of_file.campaign == "coverage" else {**SMALL, **learns}
    settings = {**size, "executor.kind": "serial"}
    return [part for key, value in settings.items() for part in ("--set", f"{key}={value}")]


def test_there_are_configurations_and_examples():
    assert ROOT / "configs" / "high_speed_crash.yaml" in CONFIGS
    assert len(EXAMPLES) > 5


@pytest.mark.sumo
@pytest.mark.parametrize("config", CONFIGS, ids=lambda path: path.stem)
def test_configurations_run(config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    assemble(load(config))
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["run", str(config), "--store", str(tmp_path / "s"), "--json", *small(config)])
    assert done.exit_code == 0, done.output
    result = json.loads(done.stdout)
    assert done.stdout.count("\n") == 1
    assert (result["ok"], result["failed"]) == (result["runs"], 0)
    repeated = sum(mode["confirmation_runs"] for mode in result["conclusion"].get("failure_modes", []))
    of_file = load(config).config
    bought = 8 if of_file.campaign == "coverage" else 24 + min(20, of_file.validation.reference)
    links = result["conclusion"].get("links") or {"runs": 0}
    assert result["runs"] == bought + repeated + links["runs"]
    assert (tmp_path / "s" / "report.html").is_file()


@pytest.mark.parametrize("config", BENCHMARKS, ids=lambda path: path.stem)
def test_benchmarks_load(config: Path):
    """The large ones take hours or weeks; the tiny one is run in test_benchmark.py."""
    assert list(load_benchmark(config).cells())


@pytest.mark.parametrize("module", EXAMPLES)
def test_examples_in_docstrings(module: str):
    failed, tried = doctest.testmod(importlib.import_module(module), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert (failed, tried > 0) == (0, True)


@pytest.mark.sumo
def test_commands_of_the_readme_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """One after the other in an empty folder, campaigns made small."""
    monkeypatch.chdir(tmp_path)
    for folder in ("configs", "docs", "examples"):
        if (ROOT / folder).is_dir():
            (tmp_path / folder).symlink_to(ROOT / folder)
    for (program, *args), _ in (command for block in blocks_of(ROOT / "README.md", "bash") for command in commands_of(block)):
        if program in ("scripts/test", "scripts/run"):  # scripts/run: configs/high_speed_crash.yaml, which runs above
            continue
        assert program == "sumo-sbt", f"the README says '{program}', which this test does not know"
        if args[0] == "run":
            args = [*args, *small(tmp_path / args[1]), "--set", "metamodel.kind=et"]
        done = CliRunner().invoke(app, args)
        assert done.exit_code == 0, f"{args}: {done.output}"


LANGUAGES = {"bash", "console", "python", "text", "toml", "xml", "yaml"}
RUN = {
    "README.md": {"bash", "python", "yaml"}, "docs/benchmark.md": {"bash"}, "docs/boundary.md": {"console"},
    "docs/clusters.md": {"bash", "yaml"}, "docs/configuration.md": {"yaml"}, "docs/estimation.md": {"bash", "yaml"},
    "docs/extending.md": {"python", "toml", "yaml"},
    "docs/falsification.md": {"yaml"}, "docs/measured/metamodels.md": {"bash"},
    "docs/metamodels.md": {"bash", "python", "yaml"}, "docs/metrics.md": {"bash", "python"},
    "docs/python.md": {"python"}, "docs/reference_drivers.md": {"python"}, "docs/requirements.md": {"python", "yaml"},
    "docs/reliability.md": {"bash"}, "docs/scenarios.md": {"python"},
    "docs/testbeds.md": {"console", "python", "yaml"}, "docs/traffic.md": {"python", "yaml"},
    "docs/tutorials/actors.md": {"bash", "python", "yaml"}, "docs/tutorials/own_files.md": {"bash", "xml", "yaml"},
    "docs/tutorials/opendrive.md": {"bash", "xml", "yaml"},
    "docs/tutorials/recorded_traffic.md": {"bash", "python", "xml", "yaml"},
    "docs/tutorials/traci_loop.md": {"bash", "python", "xml", "yaml"},
}  # fmt: skip
"""What each page must show; all of it is run or checked, by this file or (a block that names a file) by test_tutorials.py."""
NOTEBOOKS = ("docs/python.md",)
"""Pages whose Python blocks go on from each other."""
BLOCKS = [block for page in PAGES for block in blocks_of(page)]


def of(*languages: str) -> list[Any]:
    """Return the blocks in these languages that no tutorial writes to a file; those that run SUMO are marked."""
    return [
        pytest.param(block, id=str(block), marks=[pytest.mark.sumo] if re.search(r'sbt\.sumo|"cut_in"', block.text) else [])
        for block in BLOCKS if block.language in languages and not block.name
    ]  # fmt: skip


@pytest.mark.parametrize("page", RUN)
def test_a_page_has_the_blocks_that_it_shall_have(page: str):
    assert {block.language for block in BLOCKS if block.page == page} >= RUN[page]


def test_every_block_says_its_language_and_few_are_not_run():
    assert [str(block) for block in BLOCKS if block.language not in LANGUAGES] == []
    assert [str(block) for block in BLOCKS if block.page not in RUN] == []
    assert {(block.page, block.not_run) for block in BLOCKS if block.not_run} == {
        ("docs/clusters.md", "a job script needs SLURM"), ("docs/reliability.md", "needs a store"),
    }
    assert sum(bool(block.not_run) for block in BLOCKS) <= 4


@pytest.mark.parametrize("block", [each for each in of("python") if each.values[0].page not in NOTEBOOKS])
def test_python_runs(block: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(block.text, str(block), "exec"), {"__name__": "documentation"})


@pytest.mark.sumo
@pytest.mark.parametrize("page", NOTEBOOKS)
def test_notebook_pages_run(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """One block after the other, in one process."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    namespace: dict[str, Any] = {"__name__": "documentation"}
    for block in blocks_of(ROOT / page, "python"):
        exec(compile(block.text, str(block), "exec"), namespace)


RECIPES = {block.name: block for block in BLOCKS if block.page == "docs/extending.md" and block.name}


@pytest.fixture
def recipes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the files of the page."""
    monkeypatch.chdir(tmp_path)
    for name, block in RECIPES.items():
        (tmp_path / name).write_text(block.text)
    return tmp_path


@pytest.mark.sumo
@pytest.mark.parametrize("name", [name for name in RECIPES if name.endswith(".py")])
def test_recipes_pass_their_own_checks(name: str, recipes: Path):
    done = subprocess.run([sys.executable, name], cwd=recipes, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert re.findall(r"from sbt\.(?!campaigns |testing )\S+", RECIPES[name].text) == [], "recipes use public names"


@pytest.mark.parametrize("name", [name for name in RECIPES if name.endswith(".yaml")])
def test_recipes_run_from_a_configuration(name: str, recipes: Path):
    done = CliRunner().invoke(app, ["run", name, "--json", "--set", "executor.kind=serial", "--store", str(recipes / "s")])
    assert done.exit_code in (0, 4), done.output


def test_recipes_are_short():
    def lines(name: str) -> int:
        text = RECIPES[name].text.partition("if __name__")[0]
        return len([line for line in text.splitlines() if line.strip()])

    assert lines("quadratic.py") <= 15
    assert lines("weighted.py") <= 6


@pytest.mark.parametrize("block", of("yaml"))
def test_yaml_fits_the_schema(block: Block):
    """A whole configuration or scenario, or lines that are each a change of a configuration."""
    if re.search(r"^sumo:", block.text, re.MULTILINE):
        ScenarioModel.model_validate(read_yaml(block.text, str(block))[0])
        return
    whole = re.search(r"^campaign:", block.text, re.MULTILINE)
    texts = [block.text] if whole else [f"campaign: boundary\nscenario: cut_in\n{line}" for line in block.text.splitlines()]
    for text in texts:
        loaded = parse(text, name=str(block), folder=ROOT)
        if ".py:" not in loaded.config.scenario:
            assemble(loaded)


def parsed(words: list[str]) -> None:
    """Let the command line parse a command without running it; raises where it would end with code 2."""
    group: Any = typer.main.get_command(app)
    for command in group.commands.values():
        command.callback = None
    group.main(words[1:], prog_name="sumo-sbt", standalone_mode=False)


@pytest.mark.parametrize("block", of("bash", "console"))
def test_commands_fit_the_command_line(block: Block):
    for words, _ in commands_of(block):
        while "=" in words[0] and not block.not_run:  # variables of the environment before a command
            words = words[1:]
        if "sumo-sbt" in words:
            parsed(words[words.index("sumo-sbt") :])
        elif words[0] == "python" and words[1] in {each.name for each in BLOCKS if each.page == block.page}:
            continue  # run by test_tutorials.py
        elif words[0] == "netconvert" and block.page == "docs/tutorials/opendrive.md":
            continue  # likewise
        elif words[0] == "python":
            script = ROOT / words[1]
            assert script.is_file()
            assert [word for word in words if word.startswith("--") and word not in script.read_text()] == []
        else:
            assert block.not_run or words[0] in ("sumo", "scripts/run", "scripts/test"), f"this test does not know '{words[0]}'"


@pytest.mark.parametrize("page", [p for p in PAGES if inline_commands(p)], ids=lambda path: path.stem)
def test_commands_in_the_prose_fit_the_command_line(page: Path):
    for words in inline_commands(page):
        plain = [{"N": "1", "RUN": "1"}.get(word, word) for word in (word.strip("[]") for word in words)]
        parsed(plain if len(plain) > 2 else [*plain, "--help"])  # two words: a verb that is only named


CHEAP = ("list", "schema", "simulate", "check")


@pytest.mark.parametrize("block", of("console"))
def test_cheap_commands_print_what_the_page_shows(block: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    for (_, verb, *args), output in commands_of(block):
        if verb in CHEAP and ("testbed:" in args[0] or verb in ("list", "schema")):
            done = CliRunner().invoke(app, [verb, *args])
            assert done.exit_code == 0, done.output
            if output:
                assert done.stdout == output
        else:
            assert output == "", f"{block}: nobody checks the output of '{verb}'"


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_links_of_the_documentation_lead_somewhere(page: Path):
    links = re.findall(r"\]\((?!https?:|#|mailto:)([^)#\s]*[./][^)#\s]*)", page.read_text())
    assert [link for link in links if not (page.parent / link).exists()] == []


@pytest.mark.parametrize(("page", "model"), [("configuration.md", Configuration), ("tutorials/own_files.md", ScenarioModel)])
def test_tables_of_keys_have_every_key(page: str, model: type[BaseModel]):
    rows = re.findall(r"^\| (`.*?) \|", (ROOT / "docs" / page).read_text(), re.MULTILINE)
    told = {key for row in rows for key in re.findall(r"`(\w+)`", row)}
    assert set(model.model_fields) - told == set()


@pytest.mark.parametrize("name", ["falsification", "estimation", "boundary", "coverage"])
def test_the_page_tells_the_default_sizes(name: str):
    """A tenth of the budget, at least 10; of a falsification at most 10, of an estimation at most 15, which are its batches."""
    page = (ROOT / "docs/configuration.md").read_text()
    rows = {key: re.search(rf"^\| `{key}` \| (.*?) \|", page, re.MULTILINE)[1] for key in ("initial", "batch")}
    most = {kind: int(count) for count, kind in re.findall(r"(\d+) in an? (\w+)", rows["initial"])}
    size = {kind: int(count) for count, kind in re.findall(r"(\d+) in an? (\w+)", rows["batch"])}
    assert "at least 10" in rows["initial"]
    for budget in (50, 100, 150, 500, 2000):
        found = parse(f"campaign: {name}\nscenario: cut_in\nbudget: {budget}\n").config
        assert found.initial == min(max(10, budget // 10), most.get(name, budget))
        assert found.batch == size.get(name, found.initial)

"""The tutorials run: their blocks are files, and their commands work in the folder of those files."""

from __future__ import annotations

import json
import runpy
import subprocess
from pathlib import Path

import pytest
from doc_blocks import ROOT, blocks_of, commands_of
from own_scenarios import program as sumo_program
from typer.testing import CliRunner

from sbt.cli import app

PAGES = sorted((ROOT / "docs" / "tutorials").glob("*.md"))


def extract(page: Path, folder: Path) -> list[list[str]]:
    """Write the blocks with a file's name beside the language (`+name` goes on with it), and return the commands."""
    for block in blocks_of(page):
        if block.name:
            path = folder / block.name.removeprefix("+")
            before = path.read_text() + "\n\n" if block.name.startswith("+") else ""
            path.write_text(before + block.text)
    return [words for block in blocks_of(page, "bash") for words, _ in commands_of(block)]


def test_there_is_a_page_for_every_door():
    assert {"own_files", "traci_loop", "actors", "recorded_traffic", "opendrive"} <= {page.stem for page in PAGES}


@pytest.mark.sumo
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_tutorials_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    commands = extract(page, tmp_path)
    if any(words[0] == "netconvert" for words in commands) and sumo_program("netconvert") is None:
        pytest.skip("netconvert is not installed (pip install 'sumo-sbt[tools]')")
    monkeypatch.chdir(tmp_path)
    assert {"check", "run"} <= {words[1] for words in commands}
    for program, *args in commands:
        if program == "python":
            runpy.run_path(args[0])
            continue
        if program == "netconvert":
            subprocess.run([str(sumo_program(program)), *args], check=True, capture_output=True)
            continue
        assert program == "sumo-sbt"
        extra = ["--set", "executor.kind=serial", "--json"] if args[0] == "run" else []
        done = CliRunner().invoke(app, [*args, *extra])
        assert done.exit_code == 0, f"{args}: {done.output}"
        if args[0] == "run":
            result = json.loads(done.stdout)
            assert result["ok"] == result["runs"] > 0
            assert 0 < result["critical"] < result["runs"], f"{args}: a tutorial shows both sides"

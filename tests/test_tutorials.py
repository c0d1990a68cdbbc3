"""The tutorials run: their blocks are files, and their commands work in the folder of those files."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from sbt.cli import app

pytestmark = pytest.mark.sumo

PAGES = sorted((Path(__file__).resolve().parent.parent / "docs" / "tutorials").glob("*.md"))


def extract(page: Path, folder: Path) -> list[str]:
    """Write the blocks with a file's name beside the language (`+name` goes on with it), and return the commands."""
    text = page.read_text()
    for name, content in re.findall(r"^```\w+ (\S+)\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        path = folder / name.removeprefix("+")
        before = path.read_text() + "\n\n" if name.startswith("+") else ""
        path.write_text(before + content)
    return [line for block in re.findall(r"^```bash\n(.*?)^```", text, re.MULTILINE | re.DOTALL) for line in block.splitlines()]


def test_there_is_a_page_for_every_door():
    assert {"own_files", "traci_loop", "actors"} <= {page.stem for page in PAGES}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_tutorials_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    commands = extract(page, tmp_path)
    monkeypatch.chdir(tmp_path)
    assert any("check" in c for c in commands)
    assert any(" run " in c for c in commands)
    for line in commands:
        program, *args = shlex.split(line)
        assert program == "sumo-sbt"
        extra = ["--set", "executor.kind=serial", "--json"] if args[0] == "run" else []
        done = CliRunner().invoke(app, [*args, *extra])
        assert done.exit_code == 0, f"{line}: {done.output}"
        if args[0] == "run":
            result = json.loads(done.stdout)
            assert result["ok"] == result["runs"] > 0
            assert 0 < result["critical"] < result["runs"], f"{line}: a tutorial shows both sides"

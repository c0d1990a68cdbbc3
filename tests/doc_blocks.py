"""The fenced blocks of the documentation, for the tests that run or check them."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

__all__ = ["PAGES", "ROOT", "Block", "blocks_of", "commands_of", "inline_commands"]

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
_BLOCK = re.compile(
    r"(?:^<!-- not run: (?P<reason>[^\n]+) -->\n)?^```(?P<language>\S*)(?: (?P<name>\S+))?\n(?P<text>.*?)^```",
    re.MULTILINE | re.DOTALL,
)


@dataclass(frozen=True)
class Block:
    """A fenced block.

    Args:
        page: relative to the root of the repository.
        line: of its fence.
        language: beside the fence.
        name: of the file that it is, beside the language; `+name` goes on with that file.
        text: what is in it.
        not_run: why it is not run, from `<!-- not run: reason -->` before it.
    """

    page: str
    line: int
    language: str
    name: str
    text: str
    not_run: str

    def __str__(self) -> str:
        """Return where it is."""
        return f"{self.page}:{self.line}"


def blocks_of(page: Path, *languages: str) -> list[Block]:
    """Return the blocks of a page, those in these languages where any are named."""
    text, found = page.read_text(), []
    for match in _BLOCK.finditer(text):
        line = text[: match.start("text")].count("\n")
        part = match.groupdict(default="")
        block = Block(str(page.relative_to(ROOT)), line, part["language"], part["name"], part["text"], part["reason"])
        if not languages or block.language in languages:
            found.append(block)
    return found


def commands_of(block: Block) -> list[tuple[list[str], str]]:
    """Return the commands of a `bash` or `console` block as words, each with the output that a console shows after it."""
    prompt = "$ " if block.language == "console" else ""
    found: list[tuple[list[str], str]] = []
    for line in block.text.replace("\\\n", " ").splitlines():
        if line.startswith(prompt):
            if words := shlex.split(line.removeprefix(prompt), comments=True):
                found.append((words, ""))
        else:
            words, output = found.pop()
            found.append((words, output + line + "\n"))
    return found


def inline_commands(page: Path) -> list[list[str]]:
    """Return the commands of this package that stand in the prose of a page."""
    prose = _BLOCK.sub("", page.read_text())
    return [shlex.split(code) for code in re.findall(r"`(sumo-sbt [^`]+)`", prose.replace("\n", " "))]

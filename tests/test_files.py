"""Laws of the files that are written whole or not at all."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from sbt.files import write_atomically


@pytest.mark.parametrize("content", ["text: ä", "text: ä".encode(), lambda part: part.write_text("text: ä", encoding="utf-8")])
def test_every_kind_of_content_is_written_into_a_new_folder(tmp_path: Path, content):
    target = tmp_path / "new" / "folder" / "file.txt"
    assert write_atomically(target, content) == target
    assert target.read_text(encoding="utf-8") == "text: ä"
    assert list(target.parent.iterdir()) == [target]


def test_a_reader_keeps_the_file_that_it_has_open(tmp_path: Path):
    target = tmp_path / "file.txt"
    write_atomically(target, "old and long")
    with target.open() as file:
        assert file.read(3) == "old"
        write_atomically(target, "new")
        assert file.read() == " and long"
    assert target.read_text() == "new"


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path: Path):
    target = tmp_path / "file.txt"
    write_atomically(target, "old")

    def fail(part: Path) -> None:
        part.write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomically(target, fail)
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o077, 0o600), (0o000, 0o644)])
def test_the_mode_follows_the_umask(tmp_path: Path, umask: int, mode: int):
    before = os.umask(umask)
    try:
        write_atomically(tmp_path / "file.txt", "text")
        write_atomically(tmp_path / "other.txt", lambda part: part.write_text("text"))
    finally:
        os.umask(before)
    assert [path.stat().st_mode & 0o777 for path in tmp_path.iterdir()] == [mode, mode]


def test_writers_at_once_leave_one_whole_file(tmp_path: Path):
    target = tmp_path / "file.txt"
    texts = [str(k) * 100_000 for k in range(8)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda text: write_atomically(target, text), texts))
    assert target.read_text() in texts
    assert list(tmp_path.iterdir()) == [target]

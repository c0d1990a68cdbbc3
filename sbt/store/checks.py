"""Rows of a store against the checksums that were written with them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sbt.store.layout import checksum_of, checksums_of, damaged

__all__ = ["check_row", "check_rows"]


def check_row(folder: Path, what: str, stored: int, *parts: Any) -> None:
    """Refuse a row of a store that is not what was written."""
    if stored != checksum_of(*parts):
        raise damaged(folder, f"{what} has a wrong checksum")


def check_rows(folder: Path, what: str, rows: Sequence[tuple[Any, ...]], stored: Sequence[int]) -> None:
    """Refuse rows, of which the first field says which run they are of, that are not what was written."""
    now = checksums_of(rows)
    if now != list(stored):
        wrong = next(row for row, then, found in zip(rows, stored, now, strict=True) if then != found)
        raise damaged(folder, f"{what} {wrong[0]} has a wrong checksum")

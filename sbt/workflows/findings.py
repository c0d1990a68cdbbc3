"""What a check of a scenario finds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

__all__ = ["Finding"]


@dataclass(frozen=True)
class Finding:
    """One rule of the contract, whether it holds, what was seen, and the same as numbers by name."""

    rule: str
    ok: bool
    detail: str = ""
    numbers: Mapping[str, float] = field(default_factory=dict)

    @property
    def is_rule(self) -> bool:
        """Whether it can be broken; else it only informs."""
        return not self.rule.startswith("for information")

    def __str__(self) -> str:
        """Return a line: whether the rule holds, or that it only informs."""
        mark = "ok  " if self.is_rule else "note"
        return f"{mark if self.ok else 'FAIL'}  {self.rule}{': ' if self.detail else ''}{self.detail}"

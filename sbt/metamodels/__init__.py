"""Metamodels and their predictions; the only place with torch and scikit-learn."""

from __future__ import annotations

from typing import Any

from sbt import plugins


def __getattr__(name: str) -> Any:
    """Return an installed one by the name of `sbt.list("metamodels")` (PEP 562)."""
    if name.startswith("_") or name not in plugins.names("metamodels"):
        known = ", ".join(plugins.names("metamodels"))
        raise AttributeError(f"module 'sbt.metamodels' has no attribute '{name}'; installed: {known}")
    return plugins.load("metamodels", name)


def __dir__() -> list[str]:
    """Return the names of those that are installed."""
    return plugins.names("metamodels")

"""Metamodels and their predictions; the only place with torch and scikit-learn."""

from __future__ import annotations

from typing import Any

from sbt import plugins


def __getattr__(name: str) -> Any:
    """Return an installed one by the name of `sbt.list("metamodels")` (PEP 562)."""
    installed = plugins.names("metamodels")
    if name.startswith("_") or name not in installed:
        raise AttributeError(f"module 'sbt.metamodels' has no attribute '{name}'; installed: {', '.join(installed)}")
    return plugins.load("metamodels", name)

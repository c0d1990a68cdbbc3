"""Safety metrics: functions of a trace, computed after the run."""

from __future__ import annotations

from typing import Any

from sbt import plugins


def __getattr__(name: str) -> Any:
    """Return an installed one by the name of `sbt.list("metrics")` (PEP 562)."""
    if name.startswith("_") or name not in plugins.names("metrics"):
        raise AttributeError(f"module 'sbt.metrics' has no attribute '{name}'; installed: {', '.join(plugins.names('metrics'))}")
    return plugins.load("metrics", name)


def __dir__() -> list[str]:
    """Return the names of those that are installed."""
    return plugins.names("metrics")

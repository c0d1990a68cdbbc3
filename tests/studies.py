"""Campaigns of the tests: a checked configuration, run; what is printed as JSON comes back."""

from __future__ import annotations

from typing import Any

from sbt.campaigns.settings import Settings
from sbt.config.load import Loaded
from sbt.workflows.running import run_study
from sbt.workflows.study import Study


def run_loaded(loaded: Loaded, **more: Any) -> dict[str, Any]:
    """Run a campaign and return its JSON."""
    return run_study(Study(loaded), **more).to_dict()


def settings_of(loaded: Loaded) -> Settings:
    """Return what the campaign is built from."""
    return Study(loaded).settings

"""Runs and campaigns of the tests: rows by their index, and a checked configuration run to its JSON."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from sbt.campaigns.settings import Settings
from sbt.config.load import Loaded
from sbt.problem.outcome import Outcome
from sbt.workflows.running import run_study
from sbt.workflows.study import Study


def by_index(outcomes: Iterable[Outcome]) -> dict[int, Outcome]:
    """Return rows by their index, in whatever order they arrived, without the seconds they took."""
    found = list(outcomes)
    assert len({o.index for o in found}) == len(found), "a run was reported twice"
    return {o.index: replace(o, seconds=0.0) for o in found}


def run_loaded(loaded: Loaded, **more: Any) -> dict[str, Any]:
    """Run a campaign and return its JSON."""
    return run_study(Study(loaded), **more).to_dict()


def settings_of(loaded: Loaded) -> Settings:
    """Return what the campaign is built from."""
    return Study(loaded).settings

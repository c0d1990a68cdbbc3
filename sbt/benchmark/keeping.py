"""The stores of a benchmark: campaigns like any other, so that `status`, `report` and `export` read them."""

from __future__ import annotations

from pathlib import Path

from sbt.config.load import Loaded, differences, dump, fingerprint
from sbt.errors import InputError
from sbt.problem.scenario import LogicalScenario
from sbt.store.database import Store

__all__ = ["opened"]

_IDENTITY = ("campaign", "scenario", "requirement", "inputs", "ego", "simulation", "seed", "batch", "metamodel", "acquisition")
"""What must stay the same of a configuration; other keys may come and go with versions."""


def opened(folder: Path, loaded: Loaded, scenario: LogicalScenario, **more: object) -> Store:
    """Open a store for this configuration: a new one, or the one that is there.

    Args:
        folder: of the store.
        loaded: configuration of the campaign.
        scenario: the configured one.
        more: what else must not change between runs.

    Raises:
        InputError: the store was made with other settings.
        StoreError: it cannot be written.
    """
    kept = {
        **fingerprint(loaded.config), "budget": loaded.config.budget, "names": list(scenario.space.names),
        "folder": str(loaded.folder.resolve()), "yaml": dump(loaded.config), **more,
    }  # fmt: skip
    store = Store.open(folder, kept)
    if told := differences(store.configuration, kept, (*_IDENTITY, *more)):
        store.close()
        raise InputError(f"a cell belongs to one configuration, but {folder} was made with another ({told})")
    store.update_configuration(kept)
    return store

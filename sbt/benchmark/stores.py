"""The stores of a benchmark: campaigns like any other, so that `status`, `report` and `export` read them."""

from __future__ import annotations

from pathlib import Path

from sbt.config.load import Loaded, differences, dump, fingerprint
from sbt.errors import InputError
from sbt.problem.description import describe_scenario
from sbt.problem.scenario import LogicalScenario
from sbt.store.database import Store

__all__ = ["open_store"]

_IDENTITY = ("campaign", "scenario", "requirement", "inputs", "ego", "simulation", "seed", "batch", "metamodel", "acquisition")
"""What must stay the same of a configuration; other keys may come and go with versions."""


def open_store(folder: Path, loaded: Loaded, scenario: LogicalScenario, **more: object) -> Store:
    """Open the store of this configuration, a new one where there is none.

    Args:
        folder: of the store.
        loaded: configuration of the campaign.
        scenario: the configured one.
        more: further settings that must not change between runs.

    Raises:
        InputError: the store was made with other settings.
        StoreError: it cannot be written.
    """
    snapshot = {
        **fingerprint(loaded.config), "budget": loaded.config.budget, "names": list(scenario.space.names),
        "folder": str(loaded.folder.resolve()), "yaml": dump(loaded.config), **more,
        **({"described": describe_scenario(scenario)} if scenario.space.choices else {}),
    }  # fmt: skip
    store = Store.open(folder, snapshot)
    if changes := differences(store.configuration, snapshot, (*_IDENTITY, *more)):
        store.close()
        raise InputError(f"a cell belongs to one configuration, but {folder} was made with another ({changes})")
    store.update_configuration(snapshot)
    return store

"""The stores of a benchmark: campaigns like any other, so that `status`, `report` and `export` read them."""

from __future__ import annotations

from pathlib import Path

from sbt.config.load import Loaded, differences, dump, fingerprint
from sbt.errors import InputError
from sbt.problem.description import describe_scenario
from sbt.problem.plain import Json, JsonMapping
from sbt.problem.scenario import LogicalScenario
from sbt.store.database import Store

__all__ = ["SIMULATED", "changes_in", "open_store"]

_FILES, _LEARNER = "files", "learner"
SIMULATED = ("scenario", "requirement", "inputs", "ego", "simulation", _FILES)
"""What the outcome of a run depends on, beside its inputs and seed."""
_IDENTITY = (*SIMULATED, _LEARNER, "campaign", "seed", "batch", "metamodel", "acquisition")
"""What must stay the same of a configuration; other keys may come and go with versions."""


def changes_in(store: Store, loaded: Loaded, more: JsonMapping, keys: tuple[str, ...] = _IDENTITY) -> str:
    """Return in words how a store was made otherwise than this configuration says; "" where it was not.

    Args:
        store: of a cell, or of reference runs.
        loaded: configuration of the campaign.
        more: further settings that must not change between runs.
        keys: of the configuration.
    """
    before, now = store.configuration, fingerprint(loaded.config) | _own_files(loaded) | dict(more)
    return differences(before, now, {*keys, *more} - ({_FILES, _LEARNER} - set(before)))


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
        **fingerprint(loaded.config), **_own_files(loaded), "budget": loaded.config.budget, "names": list(scenario.space.names),
        "folder": str(loaded.folder.resolve()), "yaml": dump(loaded.config), **more,
        **({"described": describe_scenario(scenario)} if scenario.space.choices else {}),
    }  # fmt: skip
    store = Store.open(folder, snapshot)
    if changes := changes_in(store, loaded, more):
        store.close()
        raise InputError(f"a cell belongs to one configuration, but {folder} was made with another ({changes})")
    store.update_configuration(snapshot)
    return store


def _own_files(loaded: Loaded) -> Json:
    """Return prints of the user's own files that a configuration names, of the scenario and of what learns."""
    config = loaded.config
    runs = [config.scenario, *config.metrics, *([] if config.ego is None else [config.ego.kind])]
    learns = [] if config.metamodel is None else [config.metamodel.kind]
    found = {_FILES: loaded.scope.prints(runs), _LEARNER: loaded.scope.prints(learns)}
    return {key: prints for key, prints in found.items() if prints}

"""The configuration of a benchmark: scenarios x metamodels x acquisitions x seeds, every key checked.

Each cell of the benchmark is a campaign; here its configuration is put together, so that a mistake in
the benchmark's file is reported where it stands.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, JsonValue, model_validator

from sbt.config.executor_model import Folder
from sbt.config.load import Loaded, checked, read_text
from sbt.config.model import (
    Choice,
    Configuration,
    InputChange,
    MetamodelChoice,
    Name,
    RequirementChange,
    SimulationChoice,
)
from sbt.config.requirement_model import MOST_RUNS
from sbt.config.source import ConfigError, Key, Place, SourceMap
from sbt.plugins import Scope

__all__ = ["ACQUISITIONS", "Benchmark", "Cell", "LoadedBenchmark", "load_benchmark"]

ACQUISITIONS: tuple[Literal["even", "boundary"], ...] = ("even", "boundary")
_LABEL = r"^[\w.+ -]+$"


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class ScenarioEntry(_Strict):
    """A scenario of the benchmark, and how many runs it gets."""

    scenario: Name = Field(description="An installed scenario, table:FOLDER, or file.py:NAME.")
    name: str | None = Field(default=None, pattern=_LABEL, description="Name in tables and folders; default: the scenario's.")
    batch: int = Field(default=1000, ge=2, le=MOST_RUNS, description="Runs per iteration.")
    iterations: int | None = Field(default=None, ge=1, le=MOST_RUNS, description="Iterations; null: those of the benchmark.")
    reference: int | None = Field(default=None, ge=2, le=MOST_RUNS, description="Reference runs; null: those of the benchmark.")
    requirement: RequirementChange = Field(default=RequirementChange(), description="What is critical; default: the own.")
    inputs: dict[str, InputChange] = Field(default={}, description="Changes to the scenario's inputs, by name.")
    ego: Choice | None = Field(default=None, description="The AV under test; null: the scenario's own.")
    simulation: SimulationChoice = Field(default=SimulationChoice(), description="How SUMO simulates.")

    @property
    def label(self) -> str:
        """Name in tables and folders."""
        if self.scenario.startswith("testbed:"):
            return self.name or self.scenario.removeprefix("testbed:").replace(":", " ")
        path = Path(self.scenario.removesuffix(":SCENARIO"))
        return self.name or (path.stem if path.suffix else path.name).rpartition(":")[2]


class MetamodelEntry(MetamodelChoice):
    """A metamodel of the benchmark; further keys are its settings."""

    name: str | None = Field(default=None, pattern=_LABEL, description="Name in tables and folders; default: kind and preset.")

    @property
    def label(self) -> str:
        """Name in tables and folders."""
        kind = self.kind.rpartition(":")[2].rpartition("/")[2]
        return self.name or (kind if self.preset is None else f"{kind} {self.preset}")


def _several(value: Any) -> Any:
    """Let a number of seeds n stand for the seeds 1 to n."""
    if isinstance(value, int) and not isinstance(value, bool):
        if not 1 <= value <= _SEEDS:
            raise ValueError(f"must be a number of seeds of 1 to {_SEEDS} or a list of seeds, but got {value}")
        return list(range(1, value + 1))
    return value


_SEEDS = 10_000
"""Most seeds of a benchmark."""
Seed = Annotated[int, Field(ge=0, le=2**64 - 1)]


class Benchmark(_Strict):
    """The paper's experiment: every metamodel on every scenario, with even samples and with a_BI."""

    scenarios: Annotated[tuple[ScenarioEntry, ...], Field(strict=False, min_length=1)] = Field(description="The scenarios.")
    metamodels: Annotated[tuple[MetamodelEntry, ...], Field(strict=False, min_length=1)] = Field(
        description="The metamodels; cells run in this order."
    )
    acquisitions: Annotated[tuple[Literal["even", "boundary"], ...], Field(strict=False, min_length=1)] = Field(
        default=ACQUISITIONS, description="even: Sobol points only; boundary: a_BI after an even first batch."
    )
    seeds: Annotated[tuple[Seed, ...], BeforeValidator(_several), Field(strict=False, min_length=1)] = Field(
        default=(1, 2), description="Seeds of the cells: a list, or a number n for 1 to n."
    )
    iterations: int = Field(default=10, ge=1, le=MOST_RUNS, description="Batches of a cell, the even first one included.")
    reference: int = Field(default=100_000, ge=2, le=MOST_RUNS, description="Random runs a scenario that score all its cells.")
    reference_seed: int = Field(default=1_000_000, ge=0, le=2**64 - 1, description="Seed of the reference runs; none of `seeds`.")
    references: Folder | None = Field(
        default=None, description="Folder of the reference runs, shared by benchmarks; default: <store>/reference."
    )
    max_candidates: int = Field(
        default=2**19, ge=1024, le=2**24, description="Most candidates a batch; beyond, the best of them are taken (method pool)."
    )
    workers: int = Field(default=1, ge=1, le=4096, description="Cells that run at the same time.")
    timeout: float = Field(default=60.0, gt=0, description="Wall-clock time (s) after which a run is stopped.")
    store: Folder = Field(default="runs/benchmark", description="Folder of the results.")

    @model_validator(mode="after")
    def _distinct(self) -> Benchmark:
        named: dict[str, list[Any]] = {
            "scenarios": [s.label for s in self.scenarios], "metamodels": [m.label for m in self.metamodels],
            "acquisitions": list(self.acquisitions), "seeds": list(self.seeds),
        }  # fmt: skip
        for what, values in named.items():
            twice = next((v for v in values if values.count(v) > 1), None)
            if twice is not None:
                raise ValueError(f"{what} must be distinct (give them a name), but got '{twice}' twice")
        if self.reference_seed in self.seeds:
            raise ValueError(f"reference_seed must be none of the seeds, but got {self.reference_seed}")
        return self

    @property
    def reference_folder(self) -> Path:
        """Where the reference runs are."""
        return Path(self.references) if self.references is not None else Path(self.store) / "reference"


@dataclass(frozen=True)
class Cell:
    """One campaign of a benchmark.

    Attributes:
        scenario, metamodel, acquisition, seed: which one; names as in the table.
        loaded: its configuration; the places of its keys are those in the benchmark's file.
        batch, iterations: runs an iteration, and how many.
        max_candidates: most candidates a batch.
        folder: of its store.
        reference, reference_runs: folder of the scenario's reference runs, and how many of them score.
    """

    scenario: str
    metamodel: str
    acquisition: str
    seed: int
    loaded: Loaded
    batch: int
    iterations: int
    max_candidates: int
    folder: Path
    reference: Path
    reference_runs: int

    @property
    def name(self) -> str:
        """One line for people."""
        return f"{self.scenario} / {self.metamodel} / {self.acquisition} / seed {self.seed}"


@dataclass(frozen=True)
class LoadedBenchmark:
    """A benchmark's configuration, where its keys stand, and the folder that relative files start from."""

    config: Benchmark
    source: SourceMap
    folder: Path

    def cells(self) -> Iterator[Cell]:
        """Yield all cells: by seed, then scenario, metamodel, acquisition, so that early results compare metamodels."""
        c = self.config
        for seed in c.seeds:
            for i, scenario in enumerate(c.scenarios):
                for j, metamodel in enumerate(c.metamodels):
                    for acquisition in c.acquisitions:
                        batch, iterations = scenario.batch, scenario.iterations or c.iterations
                        folder = Path(c.store) / "cells" / "/".join(
                            part.replace(" ", "_") for part in (scenario.label, metamodel.label, acquisition, str(seed))
                        )  # fmt: skip
                        data = {
                            "campaign": "boundary" if acquisition == "boundary" else "coverage", "seed": seed,
                            "acquisition": {"kind": acquisition},
                            "budget": batch * iterations, "initial": batch, "batch": batch, "validation": {"share": 0.0},
                            "metamodel": metamodel.model_dump(exclude={"name"}, exclude_none=True), "store": str(folder),
                        }  # fmt: skip
                        roots: list[tuple[Key, Key]] = [((), ("scenarios", i)), (("metamodel",), ("metamodels", j))]
                        yield Cell(
                            scenario.label, metamodel.label, acquisition, seed, self._loaded(scenario, data, roots), batch,
                            iterations, c.max_candidates, folder, self.reference_of(scenario), scenario.reference or c.reference,
                        )  # fmt: skip

    def references(self) -> Iterator[tuple[str, Loaded]]:
        """Yield name of each scenario and the campaign of its reference runs, in its own folder."""
        c = self.config
        for i, scenario in enumerate(c.scenarios):
            n = scenario.reference or c.reference
            folder = str(self.reference_of(scenario))
            data = {"campaign": "coverage", "seed": c.reference_seed, "budget": n, "initial": 2, "batch": 2, "store": folder}
            yield scenario.label, self._loaded(scenario, data, [((), ("scenarios", i))])

    def reference_of(self, scenario: ScenarioEntry) -> Path:
        """Return the folder of the scenario's reference runs."""
        return self.config.reference_folder / scenario.label.replace(" ", "_")

    def _loaded(self, scenario: ScenarioEntry, data: dict[str, Any], roots: Sequence[tuple[Key, Key]]) -> Loaded:
        """Return a cell's configuration, its keys placed where the benchmark's file has them."""
        own: dict[str, JsonValue] = scenario.model_dump(
            include={"scenario", "requirement", "inputs", "ego", "simulation"}, exclude_none=True
        )
        executor = {"kind": "serial", "timeout": self.config.timeout}
        config = Configuration.model_validate({**own, **data, "executor": executor})
        places: dict[Key, Place] = {}
        for new, old in roots:
            places |= {(*new, *path[len(old) :]): p for path, p in self.source.places.items() if path[: len(old)] == old}
        return Loaded(config, SourceMap(self.source.name, places), Scope(self.folder))


def load_benchmark(path: str | Path, overrides: Sequence[str] = ()) -> LoadedBenchmark:
    """Read and check a benchmark's configuration file, its scenarios and metamodels included.

    Args:
        path: a YAML file.
        overrides: `key.path=value` texts that replace or add single values.

    Raises:
        ConfigError: the file cannot be read, or anything in it breaks a rule; all at once.
    """
    from sbt.config.assemble import assemble

    path = Path(path)
    config, source = checked(Benchmark, read_text(path), overrides, str(path))
    loaded = LoadedBenchmark(config, source, path.resolve().parent)
    wrong: list[str] = []
    for cell in loaded.cells():
        try:
            if cell.seed == config.seeds[0]:
                assemble(cell.loaded)
        except ConfigError as error:
            wrong += error.errors
    if wrong:
        raise ConfigError(list(dict.fromkeys(wrong)))
    return loaded

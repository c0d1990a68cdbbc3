"""A study: a campaign as it is configured, and everything that is built from its configuration, once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from sbt.campaigns.settings import CampaignKind, Gate, Settings
from sbt.config.assemble import Assembly, assemble, metamodel_of, scenario_of, spec_of
from sbt.config.load import Loaded, dump, fingerprint, from_mapping, load, parse, read_text, resumed
from sbt.config.model import Configuration
from sbt.config.source import ConfigError
from sbt.errors import InputError, PluginError, StoreError
from sbt.execution.dask import DaskExecutor
from sbt.execution.local import LocalExecutor
from sbt.execution.protocol import Executor, SerialExecutor
from sbt.execution.spec import ScenarioSpec
from sbt.loop.drawn_traffic import OVER_TRAFFIC, DrawnTraffic
from sbt.loop.earlier import EarlierRuns
from sbt.loop.learner import FittedMetamodel, Learner
from sbt.loop.running import ahead_of
from sbt.loop.stages import Campaign, Conclusion, Shard
from sbt.plugins import Objects, Scope
from sbt.problem.covariates import Covariates, telling_all
from sbt.problem.description import describe_scenario, is_complete, rebuild_scenario
from sbt.problem.isolation import Isolation, Warmable, warm_ups
from sbt.problem.plain import Json, JsonMapping
from sbt.problem.scenario import LogicalScenario
from sbt.store.database import Store
from sbt.store.history import History
from sbt.workflows.earlier import EarlierCampaign
from sbt.workflows.fidelity import COARSE_COST, stated_cost
from sbt.workflows.mistakes import further_mistakes
from sbt.workflows.own_campaign import checked
from sbt.workflows.portable import place_of, where_it_is

__all__ = ["PACKAGE", "RESOLVED", "Study"]

STATES = "snapshots"
"""Folder of the warmed states in that of a store."""
COVARIATES, EARLIER = "covariate_names", "earlier"
"""Keys under which a store remembers that seeds are looked at, and the runs of an earlier campaign that it learns from."""
RESOLVED = "config.resolved.yaml"
"""The configuration with its defaults, in a store's folder."""
PACKAGE = "package"
"""Key under which a store remembers a print of this package (`sbt.workflows.changes`); stores of before have none."""


@dataclass(frozen=True, eq=False)
class Study:
    """A campaign as it is configured.

    Args:
        loaded: the checked configuration.
        kept: what the store remembers of it; empty where there is no store yet.
        live: the scenario's code is loaded, so that it can be run; False: its description in the store is enough, where that
            is complete.
        place: the folder of the store; None: as configured.
    """

    loaded: Loaded
    kept: JsonMapping = field(default_factory=dict)
    live: bool = True
    place: Path | None = None

    @classmethod
    def from_file(cls, path: str | Path, overrides: Sequence[str] = (), **more: Any) -> Study:
        """Return the study of a configuration file; as `sbt.config.load.load`.

        Relative names start from its folder; in the resolved configuration of a store from where they were written.
        """
        place = Path(path)
        if place.name == RESOLVED and Store.begun(place.parent):
            with Store.read(place.parent) as store:
                folder, _ = place_of(store.configuration, store.folder)
            return cls(parse(read_text(place), overrides, name=str(path), folder=folder, **more))
        try:
            return cls(load(path, overrides, **more))
        except ConfigError as error:
            raise ConfigError([*error.errors, *further_mistakes(place, overrides, error)]) from None

    @classmethod
    def from_mapping(cls, data: JsonMapping, *, name: str, scope: Scope) -> Study:
        """Return the study of a configuration given as plain data."""
        return cls(from_mapping(data, name=name, scope=scope))

    @classmethod
    def from_store(cls, store: Store, *, objects: Objects | None = None, live: bool = False) -> Study:
        """Return the study that a store was made with.

        Args:
            store: open for reading or writing; the code that it names runs only where the user has approved it.
            objects: what was given in Python when it was made, where that is needed.
            live: load the scenario's code, to run it.
        """
        kept, given = store.configuration, dict(objects or {})
        folder, text = place_of(kept, store.folder)
        name = kept["campaign"]
        try:
            Scope(folder, given, store.folder).load("campaigns", name)
        except PluginError:
            if "kind" in kept:
                given["campaigns", name] = CampaignKind.absent(name, kept["kind"])
        loaded = parse(text, name=str(store.folder / RESOLVED), folder=folder, objects=given, store=store.folder)
        fits = store.fits() if COVARIATES in kept and not live else []
        return cls(loaded, {**kept, OVER_TRAFFIC: fits[-1].over_traffic} if fits else kept, live, store.folder)

    def stored_in(self, store: Store) -> Study:
        """Return the study with the defaults that its store was begun with."""
        kept = store.configuration
        if not kept:
            return self
        return replace(self, loaded=replace(self.loaded, config=resumed(self.config, kept, store.end)), kept=kept)

    def with_store(self, folder: Path) -> Study:
        """Return the study with another store."""
        return replace(self, loaded=replace(self.loaded, config=self.config.model_copy(update={"store": str(folder)})))

    def sharded(self, text: str, *, apart: bool) -> tuple[Study, Shard]:
        """Return the study of one share of the runs, and which it is.

        Args:
            text: I/N, as on the command line.
            apart: in a store of its own, in the folder of the study's.

        Raises:
            InputError: the text is no share.
        """
        shard = Shard.parse(text)
        folder = Path(self.config.store) / f"shard-{shard.number}-of-{shard.of}"
        return self.with_store(folder) if apart else self, shard

    @property
    def config(self) -> Configuration:
        """The checked configuration."""
        return self.loaded.config

    @cached_property
    def kind(self) -> CampaignKind:
        """The kind of campaign."""
        return self.loaded.kind

    @cached_property
    def _assembly(self) -> Assembly:
        return assemble(self.loaded)

    @cached_property
    def scenario(self) -> LogicalScenario:
        """The scenario with the configured inputs, requirement, ego, step and isolation.

        Raises:
            ConfigError: all problems of the configuration at once.
        """
        described = self.kept.get("described")
        if not self.live and described is not None and is_complete(described):
            return rebuild_scenario(described)
        return self._assembly.scenario if self.live else scenario_of(self.loaded)

    @cached_property
    def spec(self) -> ScenarioSpec:
        """The scenario for other processes, at the isolation level of the campaign."""
        spec = self._assembly.spec if self.live else spec_of(self.loaded)
        return replace(spec, isolated=self.isolation)

    @property
    def own_code(self) -> bool:
        """Whether files of Python give the metrics: the scenario's, those of the metrics, the ego."""
        config = self.config
        names = [config.scenario, *config.metrics, *([] if config.ego is None else [config.ego.kind])]
        return any(".py:" in name or name.endswith((".yaml", ".yml")) for name in names)

    @cached_property
    def runnable(self) -> LogicalScenario:
        """The scenario with its code, whatever else of the campaign is at hand.

        Raises:
            ConfigError: its code is not at hand, or it does not offer what is configured.
        """
        scenario, isolation = scenario_of(self.loaded), self.isolation
        if isolation is None or not isinstance(scenario.simulate, Warmable):
            return scenario
        return replace(scenario, simulate=scenario.simulate.isolated(isolation))

    @cached_property
    def isolation(self) -> Isolation | None:
        """The isolation level: that of the store where there is one, else what the scenario's conditions allow.

        None where the scenario has no traffic to warm up. A store that says nothing of it was made without.

        Raises:
            InputError: a warm-up is asked for, but impossible.
        """
        states = str((self.place or Path(self.config.store)).resolve() / STATES)
        before, asked = self.kept.get("isolation", Isolation().described()), self.config.executor.isolation
        if self.kept and asked in ("auto", before["level"]):
            return Isolation.read(before, states)
        simulate = self.scenario.simulate
        if not isinstance(simulate, Warmable):
            return None
        decided = simulate.isolation_in(self.scenario.space, warm_ups(self.config.budget, estimating=self.kind.takes_gate))
        return replace(decided, states=states)

    @cached_property
    def covariates(self) -> Covariates | None:
        """What the seed draws, known before the run; None: seeds are not looked at.

        A store that was begun without goes on without.

        Raises:
            InputError: covariates are asked for, but the scenario cannot tell any.
        """
        asked = self.config.covariates
        if asked is False or (self.kept and COVARIATES not in self.kept):
            return None
        found = Covariates.of(telling_all(self.scenario) if asked else self.scenario) if self.live else None
        if asked and found is None and self.live:
            raise InputError(
                f"covariates: true needs a scenario whose traffic is drawn before the run (a scene of SumoSimulation), but"
                f" {self.scenario.name} has none"
            )
        return found

    @cached_property
    def coarse_cost(self) -> float | None:
        """What a coarse run costs, in runs: as configured, as the store remembers, or measured now; None: there are none.

        Raises:
            InputError: coarse runs fail where those of the scenario do not.
        """
        if self.config.fidelity is None or COARSE_COST in self.kept:
            return self.kept.get(COARSE_COST)
        return stated_cost(self.config, self.spec, self.scenario) if self.live else None

    @property
    def learns(self) -> bool:
        """Whether there is a metamodel, and its code is at hand."""
        choice = self.config.metamodel
        try:
            return choice is not None and self.loaded.scope.load("metamodels", choice.kind) is not None
        except PluginError:
            return False

    @cached_property
    def learner(self) -> Learner | None:
        """Fits and scores the metamodel; None where the campaign learns nothing.

        Raises:
            InputError: `warm_start` names no finished campaign, or none that it could learn from.
        """
        config = self.config
        metamodel = self._assembly.metamodel if self.live else metamodel_of(self.loaded)
        if metamodel is None or config.acquisition.kind in self.kind.metamodel_free:
            return None
        traffic = DrawnTraffic.of(self.scenario, config.seed, self.covariates, self.kept) if self.kind.over_traffic else None
        learner = Learner(self.scenario, metamodel, config.seed, self.kind.target_aware, traffic=traffic)
        if config.warm_start is None or not self.kind.takes_earlier:
            return learner
        kept = self.kept.get(EARLIER)
        known = self.earlier_campaign().pooled(learner, config) if kept is None else EarlierRuns.from_json(kept)
        return replace(learner, earlier=known)

    def earlier_campaign(self) -> EarlierCampaign:
        """Return the campaign that `warm_start` names.

        Raises:
            InputError: it has not concluded, or has another scenario, ego or step and is no transfer.
            StoreError: there is none.
        """
        choice = self.config.warm_start
        if choice is None:
            raise InputError("there is no earlier campaign: warm_start names none")
        folder = self.loaded.folder / Path(choice.store).expanduser()
        try:
            with Store.read(folder) as store:
                before, history, finished = Study.from_store(store), store.history(), store.conclusion is not None
                package = store.configuration.get(PACKAGE, "")
        except StoreError as error:
            raise StoreError(f"warm_start.store: {error}") from None
        if not finished:
            raise InputError(f"warm_start.store must be a finished campaign, but the one in {folder} has not concluded")
        if not choice.transfer and before._simulator != self._simulator:
            names = f"{before.config.scenario} there, {self.config.scenario} here"
            rule = f"warm_start.store must have the same scenario, ego and step, but {folder} has another ({names})"
            raise InputError(f"{rule}; transfer: true takes it as another setup")
        return EarlierCampaign(folder, before.scenario, history, choice, package)

    def _taught(self) -> dict[str, Any]:
        """Return what an earlier campaign gives the settings; nothing where its runs are learned beside the campaign's own.

        Raises:
            InputError: it has no input or metric in common with this one, or there is no metamodel to learn it with.
        """
        choice = self.config.warm_start
        if choice is None or self.kind.takes_earlier:
            return {}
        if not choice.transfer:
            return {"prior_runs": self.earlier_campaign().same_runs(self.scenario)}
        if self.learner is None:
            raise InputError(f"warm_start.transfer needs a metamodel, but {self.config.acquisition.kind} uses none")
        return {"transfer": self.earlier_campaign().trend(self.learner, self.config)}

    @cached_property
    def settings(self) -> Settings:
        """What the campaign is built from."""
        config, recorded = self.config, self.scenario.pool is not None
        return Settings(
            scenario=self.scenario, seed=config.seed, budget=config.budget, initial=config.initial, batch=config.batch_size,
            holdout_fraction=config.validation.share if self.learner is not None and not recorded else 0.0,
            reference=0 if recorded else config.validation.reference, learner=self.learner,
            acquisition=self._assembly.acquisition if self.live else None, method=config.acquisition.kind,
            stop=config.stop.model_dump(), gate=None if config.gate is None else Gate(**config.gate.model_dump()),
            ahead=config.ahead, **self._taught(),
            covariates=self.covariates, coarse_cost=self.coarse_cost,
            warm_ups=0 if self.isolation is None else self.isolation.seeds,
        )  # fmt: skip

    @cached_property
    def campaign(self) -> Campaign:
        """The campaign itself: its stages, and what it concludes.

        Raises:
            InputError: its batches are to be chosen ahead, but each needs all results before it.
        """
        own = not getattr(self.kind.recipe, "__module__", "").startswith("sbt.")
        found = checked(self.kind.recipe, self.settings) if own else self.kind.recipe(self.settings)
        if self.config.ahead and not any(ahead_of(stage) for stage in found.stages):
            kind, how = self.config.campaign, self.config.acquisition.kind
            raise InputError(f"batch.ahead must be 0 where each batch needs all results before it, as in {kind} by {how}")
        return replace(found, recorded=self.scenario.pool, space=self.scenario.space)

    @property
    def budget(self) -> int:
        """Number of runs, those included that only score."""
        return self.config.budget + self.config.validation.reference

    @property
    def workers(self) -> int | None:
        """Number of processes that make the runs; None: those of a cluster, which come and go."""
        choice = self.config.executor
        return 1 if choice.kind == "serial" else None if choice.kind == "dask" and choice.address else choice.workers

    def executor(self, spec: ScenarioSpec | None = None, *, workers: int | None = None) -> Executor:
        """Return what executes the runs, as configured.

        Args:
            spec: of the scenario; None: the study's own.
            workers: processes; None: as configured.
        """
        choice, scenario = self.config.executor, self.spec if spec is None else spec
        limit = None if choice.timeout == float("inf") else choice.timeout
        if choice.kind == "serial":
            return SerialExecutor(scenario, limit)
        of_worker = {"memory": choice.memory, "recycle": choice.recycle}
        if choice.kind == "dask":
            return DaskExecutor(scenario, choice.address, choice.workers, limit, **of_worker)
        return LocalExecutor(scenario, choice.workers if workers is None else workers, limit, **of_worker)

    def snapshot(self, shard: Shard | None = None) -> Json:
        """Return what the store remembers of the configuration: plain JSON, and the YAML to read back."""
        config, described, known = self.config, self.kept.get("described"), None if self.learner is None else self.learner.earlier
        if self.live or described is None:  # otherwise the scenario itself may be made from its description
            described = describe_scenario(self.scenario)
        return {
            **fingerprint(config), "budget": config.budget, "names": list(self.scenario.space.names),
            "described": described, **where_it_is(self.loaded.folder, Path(config.store)),
            "yaml": dump(config), "kind": self.kind.described(),
            **({} if shard is None else {"shard": {"number": shard.number, "of": shard.of}}),
            **self._told_names(), **({} if self.coarse_cost is None else {COARSE_COST: self.coarse_cost}),
            **({EARLIER: known.to_json()} if known is not None else {}),
            **({"isolation": self.isolation.described()} if self.isolation is not None and self.isolation.warm else {}),
        }  # fmt: skip

    def _told_names(self) -> Json:
        """Return the names of the covariates as the store remembers them; empty where seeds are not looked at."""
        if not self.live:
            return {COVARIATES: self.kept[COVARIATES]} if COVARIATES in self.kept else {}
        return {} if self.covariates is None else {COVARIATES: list(self.covariates.names)}

    def conclusion(self, data: JsonMapping) -> Conclusion:
        """Return a conclusion from the JSON in the store; values by name where the campaign's own type is not at hand."""
        return self.kind.read(data)

    def fit(self, history: History) -> FittedMetamodel | None:
        """Return the metamodel fitted to the runs that teach it, and scored; None where there is none."""
        return None if self.learner is None else self.learner.telling(history).fit(history)

    @property
    def _simulator(self) -> tuple[Any, ...]:
        """What decides the outcome of a concrete scenario: its code, the ego and the step."""
        config = self.config
        own = ".py:" in config.scenario or Path(config.scenario).suffix == ".yaml"
        name = str((self.loaded.folder / config.scenario).resolve()) if own else config.scenario
        ego = None if config.ego is None else config.ego.model_dump()
        friction = config.simulation.friction
        return (name, ego, config.simulation.step_length, *(() if friction is None else (friction.min, friction.max)))

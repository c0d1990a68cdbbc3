"""What every campaign is built from, and what a kind of campaign declares."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from sbt.errors import InputError
from sbt.estimators.transfer import Transfer
from sbt.loop.learner import Learner
from sbt.loop.stages import Campaign, Conclusion, Facts
from sbt.metamodels.prediction import Prediction
from sbt.problem.arrays import Vector
from sbt.problem.covariates import Covariates
from sbt.problem.plain import Json, JsonMapping
from sbt.problem.requirement import CriticalInterval
from sbt.problem.scenario import LogicalScenario
from sbt.store.history import History
from sbt.store.records import from_json, to_json

__all__ = ["Acquisition", "CampaignKind", "Gate", "PlainConclusion", "Settings"]

Acquisition = Callable[[Prediction, CriticalInterval, Vector], Vector]


@dataclass(frozen=True)
class Gate:
    """The largest probability of a critical run that passes, and the confidence of the verdict."""

    probability: float
    confidence: float = 0.95


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What every campaign is built from.

    Args:
        scenario: with the campaign's own space and requirement.
        seed: of the campaign.
        budget: runs, the held-out share included.
        initial, batch: runs of the first and of each further iteration.
        ahead: number of batches in flight that a proposal does not wait for.
        holdout_fraction: share of every batch that is drawn at random and held out.
        reference: further held-out runs beyond the budget.
        learner: fits and scores the metamodel; None: no metamodel.
        acquisition: log score of candidates; None where the campaign chooses by a method of its own.
        method: name of the acquisition or method, as configured.
        stop: rules by name, None where one is off.
        gate: what an estimation has to show; None: no verdict.
        prior_runs: runs of another campaign to learn from, never to count.
        transfer: what a campaign of another setup tells, as a trend.
        covariates: what the seed draws, known before the run; None: seeds are not looked at.
        warm_ups: number of those that runs begin with, by their seed; 0: they simulate their traffic.
        coarse_cost: of a run at the coarse level of fidelity, in runs; None: there is no such level.
    """

    scenario: LogicalScenario
    seed: int
    budget: int
    initial: int
    batch: int
    holdout_fraction: float = 0.0
    reference: int = 0
    learner: Learner | None = None
    acquisition: Acquisition | None = None
    method: str = ""
    stop: Mapping[str, float | int | None] = field(default_factory=dict)
    gate: Gate | None = None
    prior_runs: History | None = None
    transfer: Transfer | None = None
    ahead: int = 0
    covariates: Covariates | None = None
    warm_ups: int = 0
    coarse_cost: float | None = None


@dataclass(frozen=True)
class PlainConclusion:
    """The conclusion of a campaign that declares no type of its own: values by name."""

    values: JsonMapping

    @classmethod
    def from_dict(cls, data: JsonMapping) -> PlainConclusion:
        """Return the conclusion from its JSON."""
        return cls(dict(data))

    def to_dict(self) -> Json:
        """Return the JSON of the command line."""
        return dict(self.values)

    def sentences(self, facts: Facts) -> list[str]:
        """Return the values as sentences."""
        del facts
        return [f"{name.replace('_', ' ')}: {value}." for name, value in self.values.items()]


@dataclass(frozen=True)
class CampaignKind:
    """A kind of campaign: what a configuration may say of it, and how it is built.

    Args:
        description: for people, one line.
        recipe: settings to the campaign.
        conclusion: its type: a dataclass with `to_dict` and `sentences`.
        acquisition: the default of `acquisition.kind`.
        methods: values of `acquisition.kind` that are the campaign's own ways to choose a batch, beside
            the installed acquisition functions.
        stop: its stop rules with their defaults; None: off unless asked for.
        adaptive: it needs a metamodel.
        metamodel: the default one with its settings.
        metamodel_free: methods that look at no metamodel.
        target_aware: the metamodel may be told where the critical edge is; otherwise all of y counts.
        most_initial: the most runs that the default of `initial` takes.
        batch: default runs per iteration; None: as many as initial.
        takes_gate: it takes the keys `gate` and `warm_start`.
        takes_transfer: it takes the key `warm_start` with `transfer: true`.
        takes_fidelity: it takes the key `fidelity`.
        takes_earlier: its metamodel learns from the runs of an earlier campaign beside its own: it takes the key `warm_start`,
            with `transfer: true` or without.
        over_traffic: its metamodel takes P(critical) as the mean over the traffic that seeds draw.
    """

    description: str
    recipe: Callable[[Settings], Campaign]
    conclusion: type[Any] = PlainConclusion
    acquisition: str = "even"
    methods: tuple[str, ...] = ()
    stop: Mapping[str, float | int | None] = field(default_factory=dict)
    adaptive: bool = True
    metamodel: JsonMapping = field(default_factory=lambda: {"kind": "gp", "nu": 2.5, "input_noise": False})
    metamodel_free: tuple[str, ...] = ()
    target_aware: bool = True
    most_initial: int | None = None
    batch: int | None = None
    takes_gate: bool = False
    takes_transfer: bool = False
    takes_fidelity: bool = False
    takes_earlier: bool = False
    over_traffic: bool = False

    @classmethod
    def of(cls, found: Any, name: str) -> CampaignKind:
        """Return what a plug-in offers as a kind of campaign: itself, or a recipe with the defaults.

        Raises:
            InputError: it is neither.
        """
        if isinstance(found, CampaignKind):
            return found
        if not callable(found):
            raise InputError(f"a campaign must be a CampaignKind or a recipe (settings) -> Campaign, but '{name}' is neither")
        lines = (getattr(found, "__doc__", None) or "").strip().splitlines()
        return cls(lines[0] if lines else "", found)

    @property
    def name(self) -> str:
        """Name of the recipe, by which a campaign goes that was given as an object."""
        return str(getattr(self.recipe, "__name__", type(self.recipe).__name__))

    def described(self) -> Json:
        """Return what it declares as JSON data, so that a store can be read where its code is not at hand."""
        code = ("recipe", "conclusion")
        found: Json = to_json({f.name: getattr(self, f.name) for f in fields(self) if f.name not in code})
        return found

    @classmethod
    def absent(cls, name: str, described: JsonMapping) -> CampaignKind:
        """Return a kind of this declaration that cannot be run, and whose conclusion is values by name."""

        def recipe(settings: Settings) -> Campaign:
            raise InputError(f"campaign '{name}' is known by its description only: its code must be at hand to run it")

        known = {f.name for f in fields(cls)}
        given: Json = {key: tuple(v) if isinstance(v, list) else v for key, v in described.items() if key in known}
        given["recipe"] = recipe
        return cls(**given)

    def read(self, data: JsonMapping) -> Conclusion:
        """Return a conclusion from its JSON."""
        read = getattr(self.conclusion, "from_dict", None)
        made: Conclusion = read(data) if read is not None else from_json(self.conclusion, dict(data))
        return made

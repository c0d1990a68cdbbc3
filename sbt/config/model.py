"""The configuration of a campaign: every key with its type, rule, default and meaning.

The descriptions are the JSON schema's (`sumo-sbt schema`). Rules that need the scenario (an input's
name, low < high) are checked in `sbt.config.assemble`, everything else here.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    JsonValue,
    Tag,
    ValidationInfo,
    WithJsonSchema,
    field_validator,
    model_validator,
)

from sbt.config.executor_model import ExecutorChoice, Folder
from sbt.config.fidelity_model import FidelityChoice
from sbt.config.kinds import kind_of
from sbt.config.requirement_model import MOST, MOST_RUNS, Interval, Name, RequirementChange, check_numbers, each_once, two_values
from sbt.config.simulation_model import SimulationChoice
from sbt.plugins import OBJECT
from sbt.problem.expression import Expression
from sbt.problem.plain import Json

__all__ = [
    "AcquisitionChoice", "BatchChoice", "Choice", "ChoicesGiven", "Configuration",
    "CorrelationEntry", "GateChoice", "InputChange", "Interval", "MetamodelChoice", "Name", "RequirementChange",
    "SimulationChoice", "StopRules", "ValidationChoice", "WarmStart",
]  # fmt: skip

_LONGEST_FORMULA = 4096


def _formula(*, condition: bool) -> Callable[[str], str]:
    """Return a check that the text is a formula, and one that gives a truth value or a number as wanted."""

    def check(text: str) -> str:
        if len(text) > _LONGEST_FORMULA:
            raise ValueError(f"must be a formula of at most {_LONGEST_FORMULA} characters, but got {len(text)}")
        try:
            with np.errstate(all="ignore"):
                rule = Expression(text)
                value = np.asarray(rule(rule.example()))
        except (ArithmeticError, TypeError) as error:
            raise ValueError(f"must be a formula that can be computed, but got '{text}' ({error})") from None
        if not rule.names():
            raise ValueError(f"must use at least one input, but got '{text}'")
        if (value.dtype == np.bool_) is not condition:
            wanted = "a condition such as 'a < b'" if condition else "a number such as 'a / b', not a condition"
            raise ValueError(f"must be {wanted}, but got '{text}'")
        return text

    return check


def _campaign(name: str) -> str:
    kind_of(name)  # raises where there is none
    return name


CampaignName = Annotated[str, AfterValidator(_campaign)]
Condition = Annotated[str, AfterValidator(_formula(condition=True))]
Formula = Annotated[str, AfterValidator(_formula(condition=False))]


class _Strict(BaseModel):
    """Frozen; unknown keys are errors; a string is no number and a boolean no integer."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class Choice(_Strict):
    """A kind by name (`file.py:NAME` for one's own); the other keys are its settings."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, JsonValue]

    kind: Name = Field(description="An installed name, or file.py:NAME (relative to the configuration file).")

    @property
    def settings(self) -> Json:
        """The keys beside the declared ones."""
        return dict(self.__pydantic_extra__)


class MetamodelChoice(Choice):
    """The metamodel; further keys are its settings, and `recalibrate: true` scales its sigma on held-out rows."""

    kind: Name = Field(default="auto", description="An installed name, or file.py:NAME.")
    preset: Name | None = Field(
        default=None, description="Named settings of the metamodel, such as paper; further keys override it."
    )

    @model_validator(mode="after")
    def _within_reason(self) -> MetamodelChoice:
        if not (".py:" in self.kind or self.kind.startswith(OBJECT)):
            check_numbers(self.settings)
        return self


class AcquisitionChoice(_Strict):
    """How runs are chosen: an acquisition function, or a method of the campaign."""

    kind: Name = Field(description="An installed acquisition function, file.py:NAME, or a method of the campaign.")


ChoicesGiven = Annotated[
    JsonValue,  # checked by `Parameter`, which knows the input
    WithJsonSchema({"anyOf": [
        {"type": "array", "items": {"type": "string"}, "minItems": 2},
        {"type": "object", "additionalProperties": {"type": "number", "exclusiveMinimum": 0, "exclusiveMaximum": 1}},
        {"type": "null"},
    ]}),
]  # fmt: skip


class InputChange(_Strict):
    """Changes one input of the scenario; what is not given stays as it is."""

    min: float | None = Field(default=None, description="Lower end of the range, in the input's unit.")
    max: float | None = Field(default=None, description="Upper end of the range, in the input's unit.")
    distribution: Choice | None = Field(
        default=None, description="Distribution, truncated to the range: {kind: normal, mean: 40, std: 15}, "
        "or uniform, lognormal, exponential, gumbel, weibull, beta, triangular, scipy, empirical.",
    )  # fmt: skip
    choices: ChoicesGiven = Field(
        default=None, description="Of an input with choices, those of the scenario's that the campaign uses: [car, truck], or "
        "{car: 0.7, truck: 0.3} with probabilities.",
    )  # fmt: skip


class CorrelationEntry(_Strict):
    """Correlation of two inputs' normal scores (Gaussian copula)."""

    inputs: Annotated[tuple[Name, Name], BeforeValidator(two_values), Field(strict=False)] = Field(description="Two inputs.")
    value: float = Field(gt=-1, lt=1, description="Correlation of their normal scores, between -1 and 1.")


class BatchChoice(_Strict):
    """Runs per iteration, and whether the next ones are chosen while they run."""

    size: int | None = Field(default=None, ge=1, le=MOST_RUNS, description="Runs per iteration; default: that of the campaign.")
    ahead: int = Field(
        default=0, ge=0, le=4,
        description="Batches in flight that the choice of the next one does not wait for: 1 keeps the workers busy; more "
        "bridge batches whose times vary.",
    )  # fmt: skip


Batch = Annotated[
    Annotated[BatchChoice, Tag("[keys]")] | Annotated[Annotated[int, Field(ge=1, le=MOST_RUNS)], Tag("[number]")],
    Discriminator(lambda given: "[keys]" if isinstance(given, BatchChoice | Mapping) else "[number]"),
]


class ValidationChoice(_Strict):
    """Runs that score the metamodel and never train it."""

    share: float = Field(default=0.1, ge=0, lt=1, description="Share of every batch that is drawn at random and held out.")
    reference: int = Field(default=0, ge=0, le=MOST_RUNS, description="Extra random runs beyond the budget, only for scoring.")


class StopRules(_Strict):
    """When to stop before the budget is used up; null switches a rule off."""

    failures: int | None = Field(default=None, ge=1, le=MOST_RUNS, description="Falsification: different critical inputs.")
    modes: int | None = Field(default=None, ge=1, le=MOST_RUNS, description="Falsification: number of distinct failure modes.")
    stable: float | None = Field(default=None, gt=0, lt=1, description="Boundary: share of the space that still changes sides.")
    misclassified: float | None = Field(
        default=None, gt=0, lt=1,
        description="Boundary: expected share of the space on the wrong side, not denied by runs that fill it.",
    )  # fmt: skip
    cov: float | None = Field(default=None, gt=0, allow_inf_nan=False, description="Estimation: coefficient of variation.")


class GateChoice(_Strict):
    """When an estimation passes: the probability of a critical run is at most this, with this confidence."""

    probability: float = Field(gt=0, lt=1, description="Largest probability of a critical run that passes.")
    confidence: float = Field(default=0.95, gt=0.5, lt=1, description="Confidence of the verdict, pass or fail.")


_TRANSFERRED = 10
"""Runs of a batch where an earlier campaign tells where to look: the first ones only have to correct it."""


def _tenth(data: Json) -> int:
    most = (_learns(data) and kind_of(data["campaign"]).most_initial) or data["budget"]
    return int(min(max(10, data["budget"] // 10), data["budget"], most))


def _batch(data: Json) -> int:
    warm = data.get("warm_start")
    kind = kind_of(data["campaign"])
    if warm is not None and (kind.takes_earlier or (warm.transfer and kind.takes_gate)):
        return min(_TRANSFERRED, int(data["initial"]))
    return (_learns(data) and kind.batch) or int(data["initial"])


def _learns(data: Json) -> bool:
    """Return whether a metamodel looks at the results between batches: without one, small batches serve nothing."""
    chosen = data.get("acquisition")  # absent where it is not valid
    return chosen is None or chosen.kind not in kind_of(data["campaign"]).metamodel_free


def _store(data: Json) -> str:
    path = Path(data["scenario"].removesuffix(":SCENARIO").removeprefix(OBJECT))
    path = path.parent if path.name in ("scenario.yaml", "scenario.yml") and path.parent.name else path
    name = re.sub(r"[^\w-]+", "_", path.stem if path.suffix in (".py", ".yaml") else path.name)
    campaign = data["campaign"].removeprefix(OBJECT).rpartition(":")[2]
    return f"runs/{campaign}_{name}"


def _metamodel(data: Json) -> MetamodelChoice | None:
    kind = kind_of(data["campaign"])
    return MetamodelChoice.model_validate(dict(kind.metamodel)) if kind.adaptive else None


def _acquisition(data: Json) -> AcquisitionChoice:
    return AcquisitionChoice(kind=kind_of(data["campaign"]).acquisition)


class WarmStart(_Strict):
    """An earlier campaign to learn from: its runs teach the metamodel, they are never counted."""

    store: Folder = Field(description="Store of a finished campaign of the same scenario, ego, step and inputs.")
    transfer: bool = Field(
        default=False, description="It had another ego, step, net, version or other inputs: it is told apart from this one."
    )
    fixed: dict[str, float | str] = Field(
        default={}, description="With transfer: values of inputs that only the earlier campaign has; the others are integrated."
    )

    @field_validator("fixed")
    @classmethod
    def _with_transfer(cls, value: dict[str, float | str], info: ValidationInfo) -> dict[str, float | str]:
        if value and not info.data.get("transfer"):
            raise ValueError(f"inputs are fixed with transfer: true only, but got {', '.join(value)}")
        return value


def _or_auto(value: Any) -> Any:
    if not (value is None or isinstance(value, bool) or value == "auto"):
        raise ValueError(f"must be auto, true or false, but got {value!r}")
    return None if value == "auto" else value


class Configuration(_Strict):
    """A campaign: what is asked, of which scenario, with how many runs."""

    campaign: CampaignName = Field(description="What is asked: an installed campaign, or file.py:NAME.")
    scenario: Name = Field(
        description="An installed scenario, or file.py:NAME or scenario.yaml (relative to the configuration file)."
    )
    requirement: RequirementChange = Field(
        default=RequirementChange(), description="What is critical; default: the scenario's own."
    )
    inputs: dict[str, InputChange] = Field(default={}, description="Changes to the scenario's inputs, by name.")
    correlation: Annotated[tuple[CorrelationEntry, ...], Field(strict=False, max_length=1000)] = Field(
        default=(), description="Correlated pairs of inputs; the others stay as the scenario has them."
    )
    constraints: Annotated[tuple[Condition, ...], Field(strict=False, max_length=MOST)] = Field(
        default=(),
        description="Conditions on inputs that every concrete scenario meets, such as 'v_ego - v_co < 30'.",
    )
    features: dict[str, Formula] = Field(
        default={}, max_length=MOST, description="Derived inputs for the metamodel, name: formula."
    )
    metrics: Annotated[tuple[Name, ...], Field(strict=False, max_length=MOST)] = Field(
        default=(), description="Further safety metrics: installed names, or file.py:NAME (a Metric or a function of a trace)."
    )
    ego: Choice | None = Field(
        default=None,
        description="The AV: a controller or SUMO's models; a setting {min, max} is an input; null: the scenario's own.",
    )
    simulation: SimulationChoice = Field(default=SimulationChoice(), description="How SUMO simulates; default: the scenario's.")
    seed: int = Field(default=0, ge=0, le=2**64 - 1, description="Seed of everything random in the campaign.")
    budget: int = Field(default=500, ge=1, le=MOST_RUNS, description="Runs, the initial ones included.")
    acquisition: AcquisitionChoice = Field(
        default_factory=_acquisition,
        description="How runs are chosen; default: that of the campaign.",
    )
    warm_start: WarmStart | None = Field(default=None, description="An earlier campaign to learn from; null: none.")
    initial: int = Field(
        default_factory=_tenth, ge=1, le=MOST_RUNS,
        description="Evenly distributed runs before the first fit; default: budget / 10, at least 10; at most 10 in a "
        "falsification and 15 in an estimation with a metamodel.",
    )  # fmt: skip
    batch: Batch = Field(
        default_factory=_batch,
        description="Runs per iteration, or {size: 50, ahead: 1}; default: as many as initial; falsification 10, estimation "
        "with a metamodel 15, at most the larger of 15 and an eighth of the budget.",
    )  # fmt: skip
    validation: ValidationChoice = Field(default=ValidationChoice(), description="Held-out runs that score the metamodel.")
    metamodel: MetamodelChoice | None = Field(
        default_factory=_metamodel,
        description="What learns the safety metric; default: that of the campaign.",
    )
    stop: StopRules = Field(
        default_factory=StopRules, validate_default=True, description="When to stop before the budget is used up."
    )
    gate: GateChoice | None = Field(
        default=None, description="Estimation: pass, fail or undecided about a largest probability; null: no verdict."
    )
    covariates: Annotated[bool | None, BeforeValidator(_or_auto, json_schema_input_type=bool | Literal["auto"] | None)] = Field(
        default=None, description="Look at what the seed draws, before the run: auto (null), where the scenario tells it; "
        "true: also by a general set, an error where nothing can be told; false: never.",
    )  # fmt: skip
    fidelity: FidelityChoice | None = Field(
        default=None, description="Estimation, falsification: cheaper runs of the same inputs and seeds that teach; null: none."
    )
    judges: Annotated[tuple[Name, ...], Field(strict=False, max_length=20), AfterValidator(each_once)] | None = Field(
        default=None, description="Egos to run failures again with; default: falsification, the four reference drivers.",
    )  # fmt: skip
    executor: ExecutorChoice = Field(default_factory=ExecutorChoice, description="Where runs are executed.")
    store: Folder = Field(default_factory=_store, description="Folder of the results; default: runs/<campaign>_<scenario>.")

    @field_validator("initial")
    @classmethod
    def _within_budget(cls, value: int, info: ValidationInfo) -> int:
        if value > info.data.get("budget", value):
            raise ValueError(f"initial <= budget must hold, but got initial {value}, budget {info.data['budget']}")
        return value

    @property
    def batch_size(self) -> int:
        """Runs per iteration."""
        size = self.batch.size if isinstance(self.batch, BatchChoice) else self.batch
        return _batch(vars(self)) if size is None else size

    @property
    def ahead(self) -> int:
        """Number of batches in flight that the choice of the next one does not wait for."""
        return self.batch.ahead if isinstance(self.batch, BatchChoice) else 0

    @field_validator("metamodel")
    @classmethod
    def _learns(cls, value: MetamodelChoice | None, info: ValidationInfo) -> MetamodelChoice | None:
        name = info.data.get("campaign")
        if value is None and name is not None and kind_of(name).adaptive:
            raise ValueError(f"a {name} campaign needs a metamodel, but got null")
        return value

    @field_validator("acquisition")
    @classmethod
    def _fits_campaign(cls, value: AcquisitionChoice, info: ValidationInfo) -> AcquisitionChoice:
        name = info.data.get("campaign")
        if name is not None and not kind_of(name).adaptive and value.kind != kind_of(name).acquisition:
            raise ValueError(f"a {name} campaign draws by {kind_of(name).acquisition}, but got '{value.kind}'")
        return value

    @field_validator("gate", "warm_start")
    @classmethod
    def _of_estimation(cls, value: Any, info: ValidationInfo) -> Any:
        name = info.data.get("campaign")
        kind, warm = None if name is None or value is None else kind_of(name), isinstance(value, WarmStart)
        if kind is None or kind.takes_gate or (warm and (kind.takes_earlier or (value.transfer and kind.takes_transfer))):
            return value
        less = " without transfer: true" if warm and kind.takes_transfer else ""
        raise ValueError(f"a campaign {name} does not take it{less}")

    @field_validator("fidelity")
    @classmethod
    def _learns_from_coarse(cls, value: FidelityChoice | None, info: ValidationInfo) -> FidelityChoice | None:
        name = info.data.get("campaign")
        if value is not None and name is not None and not kind_of(name).takes_fidelity:
            other = "; warm_start learns from a coarse campaign" if kind_of(name).takes_earlier else ""
            raise ValueError(f"only estimation and falsification run coarse ones between, but the campaign is {name}{other}")
        batch = info.data.get("batch")
        if value is not None and isinstance(batch, BatchChoice) and batch.ahead:
            raise ValueError("coarse runs choose those that follow them: batch.ahead must be 0")
        return value

    @field_validator("stop")
    @classmethod
    def _rules_fit_campaign(cls, value: StopRules, info: ValidationInfo) -> StopRules:
        """Refuse another campaign's rules; what is not given has the campaign's default."""
        name = info.data.get("campaign")
        if name is None:
            return value
        default = kind_of(name).stop
        surplus = [rule for rule, limit in value.model_dump().items() if limit is not None and rule not in default]
        if surplus:
            known = ", ".join(default) or "none"
            raise ValueError(f"a {name} campaign has the stop rules: {known}; but got {', '.join(surplus)}")
        return value.model_copy(update={k: v for k, v in default.items() if k not in value.model_fields_set})

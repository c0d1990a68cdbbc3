"""The keys of a `scenario.yaml`: the user's own SUMO files or TraCI loop as a logical scenario."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, JsonValue, ValidationInfo, field_validator

from sbt.config.model import Choice, ChoicesGiven, Condition, CorrelationEntry, Formula, Interval, Name, RequirementChange
from sbt.config.requirement_model import MOST
from sbt.problem.plain import Json

__all__ = [
    "ActorEntry", "EgoEntry", "InputEntry", "MetricEntry", "OthersEntry", "ProfileEntry", "RecordedEntry", "ScenarioModel",
    "SumoEntry", "schema",
]  # fmt: skip


def _under(key: str) -> BeforeValidator:
    """Return what reads a bare text as the mapping `{key: text}`."""
    return BeforeValidator(lambda value: {key: value} if isinstance(value, str) else value)


class _Strict(BaseModel):
    """Frozen; unknown keys are errors; a string is no number and a boolean no integer."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class _Open(_Strict):
    """The same, but further keys are settings."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, JsonValue]

    @property
    def settings(self) -> Json:
        """The keys beside the declared ones."""
        return dict(self.__pydantic_extra__)


_Whole = Annotated[int, Field(ge=-(2**63), le=2**63 - 1)]
Names = Annotated[
    tuple[Name, ...], BeforeValidator(lambda value: [value] if isinstance(value, str) else value), Field(strict=False)
]


class SumoEntry(_Strict):
    """The user's files, relative to the scenario file."""

    config: Name | None = Field(default=None, description="A .sumocfg.")
    net: Name | None = Field(default=None, description="The network (.net.xml, .net.xml.gz); default: the configuration's.")
    routes: Names = Field(default=(), description="Route files; default: the configuration's.")
    additional: Names = Field(default=(), description="Additional files; default: the configuration's.")
    options: dict[str, str | float | _Whole | bool] = Field(default={}, description="Further SUMO options, name: value.")


class DeformationEntry(_Strict):
    """An input that deforms a recorded profile."""

    min: float = Field(description="Lower end of the range.")
    max: float = Field(description="Upper end of the range.")
    distribution: Choice | None = Field(default=None, description="Law on the range.")


def _as_text(value: object) -> object:
    """Return an id that YAML reads as a number as text."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _as_texts(value: object) -> object:
    return [_as_text(one) for one in value] if isinstance(value, list) else [_as_text(value)]


Ids = Annotated[tuple[Name, ...], BeforeValidator(_as_texts), Field(strict=False)]
Point = Annotated[tuple[float, float], Field(strict=False)]


class RoadEntry(_Strict):
    """A road of one lane in a network that is made of a recording."""

    along: Annotated[Name | Annotated[tuple[Point, ...], Field(strict=False)], BeforeValidator(_as_text)] = Field(
        description="A recorded road user whose path it follows, or [[x, y], ...] (m)."
    )
    width: float = Field(default=3.2, gt=0, allow_inf_nan=False, description="Of its lane (m).")
    speed: float | None = Field(default=None, gt=0, allow_inf_nan=False, description="Allowed on it (m/s); null: not limited.")


class RecordedEntry(_Strict):
    """Recorded road users as traffic: they are moved as recorded, and do not react."""

    file: Name = Field(description="SUMO's FCD, or NN_tracks.csv in the columns of highD or inD.")
    begin: float | Name = Field(default=0.0, description="Time of the recording at SUMO's time 0 (s), or a placeholder \"${t}\".")
    without: Ids = Field(default=(), description="Ids of road users that are left out.")
    offset: Point = Field(default=(0.0, 0.0), description="Added to recorded positions, [x, y] (m).")
    roads: dict[str, Annotated[RoadEntry, BeforeValidator(lambda v: v if isinstance(v, dict) else {"along": v})]] = Field(
        default={}, description="Without sumo.net: the edges of the network; default: a motorway by its lane markings."
    )


class ProfileEntry(_Strict):
    """A curve over time that several inputs shape: by its values at knots, or a recorded one that is deformed."""

    knots: Annotated[tuple[float, ...], Field(strict=False, max_length=1000)] | None = Field(
        default=None, description="Times (s); the values there are the inputs NAME_0, NAME_1, ... (range beside the profile)."
    )
    interpolate: Literal["linear", "pchip"] = Field(default="linear", description="Between knots; pchip: smooth, no overshoot.")
    rate: Interval | None = Field(default=None, description="Lowest and highest mean change between two knots (unit/s).")
    file: Name | None = Field(default=None, description="A recorded curve instead: a CSV file with a header.")
    time: Name = Field(default="t", description="Its column of times (s), counted from the first.")
    value: Name = Field(default="v", description="Its column of values.")
    scale: DeformationEntry | None = Field(default=None, description="Input NAME_scale: factor of the values.")
    offset: DeformationEntry | None = Field(default=None, description="Input NAME_offset: added to the values.")
    shift: DeformationEntry | None = Field(default=None, description="Input NAME_shift: the curve begins so much later (s).")
    stretch: DeformationEntry | None = Field(default=None, description="Input NAME_stretch: factor of the times.")


class ActorEntry(_Strict):
    """A vehicle of the files, not the ego, that follows a profile from the ego's departure on."""

    speed: Name | None = Field(default=None, description="The input, a profile, that is its speed (m/s).")
    acceleration: Name | None = Field(default=None, description="The input, a profile, that is its acceleration (m/s^2).")


class InputEntry(_Strict):
    """One input: its range, unit and distribution; or its choices; or a profile, which is several."""

    min: float | None = Field(default=None, description="Lower end of the range.")
    max: float | None = Field(default=None, description="Upper end of the range.")
    choices: ChoicesGiven = Field(
        default=None, description="Instead of a range: [car, truck], equally likely, or {car: 0.7, truck: 0.3}."
    )
    unit: str = Field(default="", description="As printed.")
    distribution: Choice | None = Field(default=None, description="Law on the range, such as {kind: normal, mean: 4, std: 1}.")
    kind: Literal["continuous", "integer"] | None = Field(default=None, description="integer: whole numbers only.")
    description: str = Field(default="", description="One line for reports.")
    profile: ProfileEntry | None = Field(default=None, description="The input is a curve over time.")


class EgoEntry(_Open):
    """The vehicle under test; further keys are settings of its driver."""

    id: Name = Field(description="Its id in SUMO.")
    kind: Name | None = Field(
        default=None,
        description="A controller (file.py:NAME for one's own), or sumo with model: IDM; null: the files' own.",
    )
    set_speed: float | None = Field(default=None, gt=0, description="What a controller keeps (m/s); null: the allowed speed.")
    lights: bool = Field(default=True, description="To a controller a red light is an obstacle at its stop line.")
    may_leave: bool = Field(default=False, description="Arriving before the duration is over is no failure.")
    delay: float | None = Field(
        default=None, ge=0, allow_inf_nan=False, description="How much later than its depart it may enter (s); null: not at all."
    )


class OthersEntry(_Strict):
    """Who is recorded beside the ego."""

    within: float = Field(default=100.0, gt=0, description="Radius around the ego's body (m).")
    named: Names = Field(default=(), description="Ids recorded at any distance, on the ego's level.")


class MetricEntry(_Open):
    """One metric; further keys are its settings, such as margin."""

    kind: Name | None = Field(default=None, description="An installed metric, or file.py:NAME.")
    stl: Name | None = Field(default=None, description="A formula instead; its robustness is the metric.")
    name: Name | None = Field(default=None, description="As written in the requirement and the store; default: the kind.")
    other: Name | None = Field(default=None, description="Id of the one that counts; null: all others, the worst.")

    @field_validator("stl")
    @classmethod
    def _one_of_two(cls, value: str | None, info: ValidationInfo) -> str | None:
        if value is not None and info.data.get("kind") is not None:
            raise ValueError(f"a metric has a kind or a formula (stl), not both, but got kind {info.data['kind']}")
        return value


class WarmUpEntry(_Strict):
    """Traffic that is warmed up once for many runs."""

    until: Annotated[float, Field(gt=0, allow_inf_nan=False)] | Literal["auto"] = Field(
        default="auto", description="Time (s) at which runs begin; auto: shortly before the ego and all that inputs change."
    )
    seeds: int | None = Field(
        default=None, ge=1, le=10_000, description="Number of warm-ups; null: one for 50 runs, at most 8; of an estimation 20."
    )

    @property
    def end(self) -> float | None:
        """The time, None for auto."""
        return None if self.until == "auto" else float(self.until)


class InsertEntry(_Strict):
    """A vehicle that the scenario inserts beside the traffic of the files; numbers may be placeholders."""

    edge: Name = Field(description="Where it starts.")
    lane: Annotated[int, Field(ge=0, le=1000)] | Name = Field(default=0, description="Index of its lane, from the right.")
    position: float | Name = Field(description="Of its front bumper on the lane (m).")
    speed: float | Name = Field(description="At its start (m/s).")
    at: float | Name | None = Field(default=None, description="When it starts (s); null: at warm_up.until.")
    to: Name | None = Field(default=None, description="Edge that it drives to by the fastest way.")
    route: Annotated[tuple[Name, ...], Field(strict=False)] = Field(
        default=(), description="Or all edges that it drives, the first included; neither: its own edge."
    )
    type: Name | None = Field(default=None, description="Vehicle type of the files; null: SUMO's default.")


class ScenarioModel(_Strict):
    """A logical scenario of the user's own files or loop."""

    name: Name | None = Field(default=None, description="Default: the folder's name.")
    description: str = Field(default="", description="The first line is a title.")
    sumo: Annotated[SumoEntry, _under("config")] | None = Field(default=None, description="The files, or just a .sumocfg.")
    simulate: Name | None = Field(default=None, description="file.py:NAME of a loop simulate(sumo, values, rng).")
    covariates: Name | None = Field(
        default=None, description="file.py:NAME of covariates(values, rng): what the run's seed draws, by name, before the run; "
        "auto: the function covariates in the file of the loop."
    )
    inputs: dict[str, InputEntry] = Field(min_length=1, description="By name; ${name} in the files.")
    correlation: Annotated[tuple[CorrelationEntry, ...], Field(strict=False, max_length=1000)] = Field(
        default=(), description="Correlated pairs."
    )
    constraints: Annotated[tuple[Condition, ...], Field(strict=False, max_length=MOST)] = Field(
        default=(), description="Conditions on inputs."
    )
    features: dict[str, Formula] = Field(default={}, max_length=MOST, description="Derived inputs for the metamodel.")
    ego: Annotated[EgoEntry, _under("id")] = Field(description="The vehicle under test, or just its id.")
    egos: Annotated[tuple[Annotated[EgoEntry, _under("id")], ...], Field(strict=False, max_length=MOST)] = Field(
        default=(), description="Further vehicles under test: the worst counts. ego: [a, b] is short for ego: a, egos: [b]."
    )
    actors: dict[str, ActorEntry] = Field(default={}, description="By id: who follows a profile.")
    recorded: Annotated[RecordedEntry, _under("file")] | None = Field(
        default=None, description="Recorded road users as traffic, or just the file."
    )
    friction: float | Name | None = Field(
        default=None, description="Of all roads, also a placeholder; bounds every acceleration by mu g; null: that of the lanes."
    )
    others: OthersEntry = Field(default=OthersEntry(), description="Who is recorded.")
    duration: float = Field(gt=0, allow_inf_nan=False, description="From the ego's departure on (s).")
    wait: float = Field(
        default=3600.0, gt=0, allow_inf_nan=False, description="Longest time from the ego's depart until it departs (s)."
    )
    step_length: float | None = Field(
        default=None, gt=0, allow_inf_nan=False, description="SUMO's step (s); null: the files', or 0.1."
    )
    insert: dict[str, InsertEntry] = Field(
        default={}, description="By id: vehicles that start beside the traffic of the files, such as the ego."
    )
    warm_up: WarmUpEntry | None = Field(
        default=None, description="Traffic is warmed up once; null: where that spares much and changes no input's effect."
    )
    metrics: Annotated[tuple[Annotated[MetricEntry, _under("kind")], ...], Field(strict=False, max_length=MOST)] = Field(
        default=(), description="What is measured."
    )
    requirement: RequirementChange = Field(description="{metric, critical}, {stl}, or {any: [...]} or {all: [...]} of such.")

    @field_validator("simulate")
    @classmethod
    def _something_to_run(cls, value: str | None, info: ValidationInfo) -> str | None:
        if value is not None and ".py:" not in value:
            raise ValueError(f"a loop must be file.py:NAME, but got '{value}'")
        return value

    @field_validator("covariates")
    @classmethod
    def _known_before(cls, value: str | None) -> str | None:
        if value is not None and value != "auto" and ".py:" not in value:
            rule = "covariates must be auto or file.py:NAME (what SUMO itself draws from files is not known before the run)"
            raise ValueError(f"{rule}, but got '{value}'")
        return value


def schema() -> Json:
    """Return the JSON schema of a `scenario.yaml`."""
    found = {k: v for k, v in ScenarioModel.model_json_schema().items() if k != "title"}
    for name in ("sumo", "ego", "recorded"):  # a bare text stands for {config: text}, {id: text} and {file: text}
        found["properties"][name] = {"anyOf": [{"type": "string"}, found["properties"][name]]}
    items = found["properties"]["metrics"]
    items["items"] = {"anyOf": [{"type": "string"}, items["items"]]}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "sumo-sbt scenario", **found}

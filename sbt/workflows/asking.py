"""A finished estimation asked again: other distributions, another requirement, the sensitivities; its store stays as it is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from sbt.campaigns.again import reused
from sbt.campaigns.asking import Sensitivity, answer, sensitivities
from sbt.campaigns.estimation import EstimationConclusion, conclude_sum, on_warm_ups
from sbt.campaigns.settings import Settings
from sbt.campaigns.summing import took_sum
from sbt.campaigns.warmed import warmed_traffic
from sbt.config.asked import asked_space
from sbt.errors import InputError
from sbt.loop.stages import Facts, Log
from sbt.plugins import Objects
from sbt.problem.combination import to_plain
from sbt.problem.plain import Json, JsonMapping
from sbt.problem.requirement import Requirement
from sbt.problem.space import ParameterSpace
from sbt.store.database import Store
from sbt.store.history import History
from sbt.store.records import to_json
from sbt.workflows.study import Study

__all__ = ["Answer", "estimate_again", "sensitivities_in"]


@dataclass(frozen=True, eq=False)
class Answer:
    """What a campaign's runs say of another question.

    Attributes:
        store: the folder.
        requirement: that was asked for.
        space: the inputs as they were asked for.
        history: the campaign's runs.
        conclusion: the probability with its interval.
        sensitivity: of the probability to every parameter of these distributions.
    """

    store: Path
    requirement: Requirement
    space: ParameterSpace
    history: History
    conclusion: EstimationConclusion
    sensitivity: tuple[Sensitivity, ...]

    def sentences(self) -> list[str]:
        """Return the probability in plain words."""
        return self.conclusion.sentences(Facts(self.history, self.requirement))

    def to_dict(self) -> Json:
        """Return what `estimate-again --json` prints."""
        asked = {"metric": self.requirement.metric, "critical": to_json([self.requirement.low, self.requirement.high])}
        asked = to_plain(self.requirement) if self.requirement.combined else asked
        found: Json = {"store": str(self.store), "requirement": asked, **self.conclusion.to_dict()}
        return {**found, "sensitivity": to_json(self.sensitivity)}


def estimate_again(
    folder: Path, inputs: Path | JsonMapping | None = None, *, critical: tuple[float, float] | None = None,
    metric: str | None = None, objects: Objects | None = None,
) -> Answer:  # fmt: skip
    """Return the probability of a critical run from the runs there are, under other distributions or another requirement.

    Args:
        folder: store of an estimation.
        inputs: changes to the campaign's inputs, as the key of a configuration, or a YAML file with them; None: its own.
        critical: interval of critical values; None: the campaign's.
        metric: one that the runs measured, or a requirement of the campaign's by its name; None: the campaign's. A metric that
            it does not require needs its critical interval.
        objects: what was given in Python when the store was made.

    Raises:
        InputError: the runs cannot tell: no known densities, other inputs, no runs where the distributions have mass.
        StoreError: the folder holds no campaign.
    """
    with Store.read(folder) as store:
        study, log = Study.from_store(store, objects=objects), Log(store.history(), tuple(store.iterations()), ())
    scenario = study.scenario
    requirement = _requirement(scenario.requirement, metric, critical)
    space = asked_space(inputs or {}, scenario.space)
    settings = _settings(study, requirement)
    found = reused(log, settings, space, scenario.requirement)
    if took_sum(log):
        said, limits = conclude_sum(log, replace(settings, scenario=replace(settings.scenario, space=space)))
        said, _ = on_warm_ups(said, limits, warmed_traffic(log, settings))
    else:
        said = answer(found)
    return Answer(folder, requirement, space, log.history, said, sensitivities(found))


def sensitivities_in(study: Study, log: Log) -> tuple[Sensitivity, ...]:
    """Return the sensitivities of an estimation to the parameters of its own distributions; none where nothing counts."""
    try:
        own = study.scenario.requirement
        return sensitivities(reused(log, _settings(study, own), study.scenario.space, own))
    except InputError:
        return ()


def _settings(study: Study, requirement: Requirement) -> Settings:
    """Return the campaign's settings with a requirement; without what another campaign taught it, which need not be there."""
    config = study.config
    return Settings(
        scenario=replace(study.scenario, requirement=requirement), seed=config.seed, budget=config.budget,
        initial=config.initial, batch=config.batch_size, learner=study.learner if study.learns else None,
        method=config.acquisition.kind,
    )  # fmt: skip


def _requirement(old: Requirement, metric: str | None, critical: tuple[float, float] | None) -> Requirement:
    of_metric = [part for part in old.parts if metric == part.metric]
    named = next((part for part in old.parts if metric == part.label), of_metric[0] if len(of_metric) == 1 else None)
    if named is not None:
        return named if critical is None else replace(named, low=critical[0], high=critical[1])
    if metric is not None and metric != old.metric and critical is None:
        raise InputError(f"another metric needs its critical interval (critical), but got only the metric '{metric}'")
    if critical is None:
        return old
    if metric is None and old.combined:
        raise InputError(f"a critical interval needs its metric (metric), as the campaign's requirement is {old.metric}")
    return Requirement(old.metric if metric is None else metric, *critical)

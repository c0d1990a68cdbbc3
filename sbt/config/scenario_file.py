"""`scenario.yaml` to a logical scenario: every mistake at once, each with file, line and column."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from sbt.config.inserted import insertion_file
from sbt.config.load import located, read_text
from sbt.config.own_metrics import actors_of, metric_of, metrics_of_several
from sbt.config.profiles import guided_vehicles, profile_of
from sbt.config.recorded import is_number, net_of_recording, recorded_traffic
from sbt.config.scenario_model import EgoEntry, InputEntry, MetricEntry, ScenarioModel, SumoEntry
from sbt.config.several import combined_requirement
from sbt.config.source import ConfigError, Key, Problems, SourceMap, must_be_measured, must_be_one_of, read_yaml
from sbt.config.space import SpaceChanges, configured_space, distribution_of
from sbt.errors import InputError, did_you_mean
from sbt.plugins import load, noted
from sbt.problem.metric import Metric
from sbt.problem.parameter import Parameter
from sbt.problem.profile import KnotProfile, Profile
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario, Roles
from sbt.problem.space import ParameterSpace
from sbt.sumo.ego import Ego
from sbt.sumo.ego_vehicle import EgoVehicle
from sbt.sumo.elements import person
from sbt.sumo.files import SumoFiles, options_of_config
from sbt.sumo.friction import Friction, has_friction
from sbt.sumo.guided import Participant
from sbt.sumo.recorded import RecordedTraffic
from sbt.sumo.recorder import RecordingSettings
from sbt.sumo.snapshot import WarmUp
from sbt.sumo.template import placeholders
from sbt.sumo.user_simulation import Covariates, Loop, UserSimulation, step_until_over

__all__ = ["from_file", "is_scenario"]


def is_scenario(path: Path) -> bool:
    """Return whether a YAML file describes a scenario, not a campaign."""
    data = read_yaml(read_text(path), str(path))[0]
    return isinstance(data, dict) and "campaign" not in data and bool({"sumo", "simulate", "ego"} & set(data))


def from_file(name: str, folder: Path) -> LogicalScenario:
    """Return the scenario of a `scenario.yaml`.

    Args:
        name: the file; what it names is relative to it.
        folder: where a relative `name` is looked up.

    Raises:
        ConfigError: everything that is wrong with it and with the files it names.
    """
    path = (folder / Path(name).expanduser()).resolve()
    data, source, wrong = read_yaml(read_text(noted(path)), name)
    problems = Problems(source)
    try:
        data, source = _with_one_ego(data, source)
        problems = Problems(source)
        model = ScenarioModel.model_validate(_with_ids(data, source))
    except ValidationError as error:
        raise located(source, error, ScenarioModel, wrong) from None
    if wrong:
        raise ConfigError(wrong)
    return _Builder(model, path.parent, problems).scenario(path)


def _with_one_ego(data: Any, source: SourceMap) -> tuple[Any, SourceMap]:
    """Return the data with a list under `ego` as its first entry, the others under `egos`, and where the keys then stand."""
    egos = data.get("ego") if isinstance(data, dict) else None
    if not isinstance(egos, list) or not egos or data.get("egos"):
        return data, source

    def moved(path: Key) -> Key:
        match path:
            case ("ego", 0, *rest):
                return ("ego", *rest)
            case ("ego", int(k), *rest):
                return ("egos", k - 1, *rest)
        return path

    places = {moved(path): place for path, place in source.places.items() if path != ("ego",)}
    texts = {moved(path): text for path, text in source.texts.items()}
    return {**data, "ego": egos[0], "egos": egos[1:]}, replace(source, places=places, texts=texts)


def _with_ids(data: Any, source: SourceMap) -> Any:
    """Return the data with every id of SUMO as it is written: randomTrips counts 0, 1, ..., which YAML reads as numbers."""

    def walk(value: Any, path: Key) -> Any:
        if isinstance(value, dict):
            return {key: walk(entry, (*path, key)) for key, entry in value.items()}
        if isinstance(value, list):
            return [walk(entry, (*path, k)) for k, entry in enumerate(value)]
        return source.texts.get(path, value) if value is not None and _is_id(path) else value

    return walk(data, ())


def _is_id(path: Key) -> bool:
    match path:
        case ("egos", int()) | ("egos", int(), "id"):
            return True
        case ("ego",) | ("ego", "id") | ("others", "named") | ("others", "named", int()) | ("metrics", int(), "other"):
            return True
    return False


def _read(files: SumoFiles) -> SumoFiles:
    """Return files that were read.

    Raises:
        InputError: one of them is not as required.
    """
    files.templates  # noqa: B018  (reads and checks)
    return files


class _Builder:
    """Makes the parts, collecting what is wrong with each."""

    def __init__(self, model: ScenarioModel, folder: Path, problems: Problems):
        self._model, self._folder, self._problems = model, folder, problems
        self._profiles: dict[str, Profile] = {}
        self._inserted: Path | None = None

    def scenario(self, path: Path) -> LogicalScenario:
        model, problems = self._model, self._problems
        space = self._space()
        files, loop = self._files(), self._loop()
        ego = self._ego(model.ego, files, ("ego",))
        further = [self._ego(one, files, ("egos", k)) for k, one in enumerate(model.egos)]
        if len({one.id for one in (model.ego, *model.egos)}) <= len(model.egos):
            ids = ", ".join((model.ego.id, *(one.id for one in model.egos)))
            problems.add(("egos",), f"vehicles under test must have different ids, but got {ids}")
        metrics = self._metrics()
        requirement = self._requirement(metrics)
        guided = guided_vehicles(model.actors, self._profiles, files, model.ego.id, problems)
        moved: tuple[Participant, ...] = (*self._friction(files), *guided, *self._recorded())
        if files is not None:
            self._check_inputs(files, space)
        if model.sumo is None and model.simulate is None:
            problems.add(("inputs",), "a scenario needs files (sumo) or a loop (simulate), but has neither")
        problems.check()
        named = tuple(dict.fromkeys((*model.others.named, *(n for m in model.metrics for n in actors_of(m)))))
        named = tuple(n for n in named if n != model.ego.id)
        simulation = problems.attempt(("step_length",), lambda: UserSimulation(
            RecordingSettings(
                ego or EgoVehicle(model.ego.id), model.duration, model.others.within, named, model.wait,
                tuple(one.further() for one in further if one is not None),
            ),
            files, loop, self._folder, model.step_length, profiles=tuple(self._profiles.values()), participants=moved,
            warm=self._warm_up(), space=space or ParameterSpace(()), covariates=self._covariates(),
        ))  # fmt: skip
        problems.check()
        own = space or ParameterSpace(())
        whole = problems.attempt(("ego",), lambda: own if simulation is None else own.extended(simulation.inputs)) or own
        problems.check()
        name = model.name or (path.parent.name if path.stem == "scenario" else path.stem)
        return LogicalScenario(
            name, whole, requirement or Requirement("", high=0.0), simulation, metrics,
            model.description, roles=Roles(model.ego.id, None, also_tested=tuple(one.id for one in model.egos)),
        )  # fmt: skip

    def _warm_up(self) -> WarmUp | None:
        entry = self._model.warm_up
        return None if entry is None else WarmUp(entry.end, entry.seeds)

    def _space(self) -> ParameterSpace | None:
        """Return the inputs with their correlation, constraints and features."""
        parameters: list[Parameter] = []
        before = len(self._problems.found)
        for name, entry in self._model.inputs.items():
            if entry.profile is not None and entry.choices is None:
                profile = profile_of(name, entry, self._folder, self._problems)
                if profile is not None:
                    self._profiles[name] = profile
                    parameters.extend(profile.parameters)
                continue
            made = self._parameter(name, entry)
            if made is not None:
                parameters.append(made)
        if len(self._problems.found) > before:
            return None
        model = self._model
        limits = (rule for p in self._profiles.values() if isinstance(p, KnotProfile) for rule in p.constraints)
        changes = SpaceChanges({}, model.correlation, (*model.constraints, *limits), model.features)
        space = self._problems.attempt(("inputs",), lambda: ParameterSpace(tuple(parameters)))
        return None if space is None else configured_space(changes, space, self._problems)

    def _parameter(self, name: str, entry: InputEntry) -> Parameter | None:
        """Return the input of an entry with a range or choices."""
        path, choice, given = ("inputs", name), entry.distribution, entry.choices
        there = [k for k in ("min", "max", "distribution", "kind", "profile") if getattr(entry, k) is not None]
        if given is not None and there:
            rule = "an input must have a range, choices, or a profile"
            self._problems.add(path, f"{rule}, one of them, but got choices and {', '.join(there)}")
            return None
        if given is None and (entry.min is None or entry.max is None):
            self._problems.add(path, "an input must have min and max, choices, or a profile")
            return None
        distribution = None
        if choice is not None:
            distribution = self._problems.attempt((*path, "distribution"), partial(distribution_of, choice, self._folder))
        choices: Any = () if given is None else given
        return self._problems.attempt(path, partial(
            Parameter, name, entry.min, entry.max, entry.unit, distribution, entry.kind, entry.description, choices
        ))  # fmt: skip

    def _files(self) -> SumoFiles | None:
        if self._model.sumo is None:
            return None
        entry = self._model.sumo
        files = self._problems.attempt(("sumo",), lambda: _read(SumoFiles.of(self._options(entry), self._folder, "sumo")))
        inserted = None if files is None else insertion_file(self._model, files, self._problems)
        if files is None or inserted is None:
            return files
        self._inserted = inserted
        more = replace(files, routes=(*files.routes, inserted), compared=tuple(self._model.insert))
        return self._problems.attempt(("insert",), lambda: _read(more))

    def _recorded(self) -> tuple[RecordedTraffic, ...]:
        """Return the recorded traffic, if there is any."""
        entry = self._model.recorded
        if entry is None:
            return ()
        found = self._problems.attempt(("recorded",), lambda: recorded_traffic(entry, self._folder))
        return () if found is None else (found,)

    def _friction(self, files: SumoFiles | None) -> tuple[Friction, ...]:
        """Return the friction of the roads, where it is given or the network has it."""
        given = self._model.friction
        if isinstance(given, str) and not (given.startswith("${") and is_number(given)):
            rule = 'friction must be a number, or a placeholder such as "${mu}"'
            self._problems.add(("friction",), f"{rule}, but got '{given}'")
        elif given is not None and not isinstance(given, str) and not 0 < given < math.inf:
            self._problems.add(("friction",), f"friction must be > 0, but got {given:g}")
        elif given is not None:
            return (Friction(str(given)),)
        elif files is None or has_friction(files.net):
            return (Friction(),)
        return ()

    def _options(self, entry: SumoEntry) -> dict[str, str]:
        """Return the options of the configuration with what the scenario file says on top."""
        options = {} if entry.config is None else options_of_config(self._folder / entry.config)
        for name, value in (("net-file", entry.net), ("route-files", ",".join(entry.routes)),
                            ("additional-files", ",".join(entry.additional))):  # fmt: skip
            if value:
                options[name] = value
        recorded = self._model.recorded
        if "net-file" not in options and recorded is not None:
            options["net-file"] = str(net_of_recording(recorded, self._folder))
        written = {k: str(v).lower() if isinstance(v, bool) else str(v) for k, v in entry.options.items()}
        return {**options, **written}

    def _loop(self) -> Loop:
        name = self._model.simulate
        if name is None:
            return step_until_over
        found = self._problems.attempt(("simulate",), lambda: load("scenarios", name, self._folder))
        if found is not None and not callable(found):
            self._problems.add(("simulate",), f"a loop must be a function simulate(sumo, values, rng), but '{name}' is not")
        loop: Loop = found if found is not None else step_until_over
        return loop

    def _covariates(self) -> Covariates | None:
        """Return the function of what a seed draws, if there is one."""
        name = self._model.covariates
        if name is None:
            return None
        if name == "auto":
            if self._model.simulate is None:
                rule = "what SUMO itself draws from files is not known before the run: covariates: auto needs a loop"
                self._problems.add(("covariates",), f"{rule} (simulate), but there is none")
                return None
            name = f"{self._model.simulate.rpartition(':')[0]}:covariates"
        found: Covariates | None = self._problems.attempt(("covariates",), lambda: load("scenarios", name, self._folder))
        if found is not None and not callable(found):
            self._problems.add(("covariates",), f"covariates must be a function covariates(values, rng), but '{name}' is not")
        return found

    def _ego(self, entry: EgoEntry, files: SumoFiles | None, path: Key) -> EgoVehicle | None:
        there = files is None or self._model.simulate is not None or files.vehicle(entry.id) is not None
        walks = files is not None and not there and person(files.templates, entry.id) is not None
        if walks and entry.kind is not None:
            self._problems.add((*path, "kind"), f"a person as the ego is moved by SUMO and has no kind, but got '{entry.kind}'")
        if files is not None and not there and not walks:
            names = files.names()
            known = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "") if names else "none"
            rule = f"the ego must be a vehicle, trip, flow or person of the files ({known})"
            self._problems.add(path, f"{rule}, but got '{entry.id}'{did_you_mean(entry.id, names)}")
        kind = entry.kind
        if kind is None:
            if entry.settings:
                self._problems.add(path, f"settings need a kind (a controller, or sumo), but got {', '.join(entry.settings)}")
            return EgoVehicle(entry.id, None, entry.set_speed, entry.lights, entry.may_leave, entry.delay)
        if ".py:" in kind:
            kind = str(self._folder / Path(kind).expanduser())
        driver = self._problems.attempt(path, lambda: Ego.of(kind, **entry.settings))
        return EgoVehicle(entry.id, driver, entry.set_speed, entry.lights, entry.may_leave, entry.delay)

    def _metrics(self) -> tuple[Metric, ...]:
        made: dict[str, Metric] = {}
        need = self._model.requirement
        formulas = need.formulas if need.stl is None else (("stl", need.stl),)
        key: tuple[str, ...] = ("requirement",) if need.stl is None else ("requirement", "stl")
        entries = [*self._model.metrics, *(MetricEntry.model_validate({"stl": text, "name": name}) for name, text in formulas)]
        if not entries:
            such = f"; that of its requirement is metrics: [{need.metric}]" if need.metric is not None else ""
            self._problems.add(("metrics",), f"a scenario needs at least one metric, but has none{such}")
        for k, entry in enumerate(entries):
            path = ("metrics", k) if k < len(self._model.metrics) else key
            for metric in self._problems.attempt(path, partial(self._metrics_of, entry)) or ():
                if metric.name in made:
                    self._problems.add(path, f"metrics need different names (name: ...), but got '{metric.name}' twice")
                made[metric.name] = metric
        return tuple(made.values())

    def _metrics_of(self, entry: MetricEntry) -> tuple[Metric, ...]:
        """Return the metrics of an entry: with several vehicles under test the worst one and that of each."""
        egos = [self._model.ego.id, *(one.id for one in self._model.egos)]
        if len(egos) == 1 or ".py:" in (entry.kind or ""):  # one's own metrics get the whole trace
            return (metric_of(entry, self._folder, egos[0]),)
        return metrics_of_several({ego: metric_of(entry, self._folder, ego) for ego in egos})

    def _requirement(self, metrics: tuple[Metric, ...]) -> Requirement | None:
        """Return the requirement, on a metric or on a formula that is one of them."""
        wanted, problems = self._model.requirement, self._problems
        names = [m.name for m in metrics]
        if wanted.combined is not None:
            return combined_requirement(wanted, names, None, problems) if names else None  # which has been said
        if wanted.stl is not None:
            return Requirement("stl", *(wanted.critical or (-math.inf, 0.0)))
        if wanted.metric is None or wanted.critical is None:
            problems.add(("requirement",), "a requirement must have a metric and critical: [low, high]")
            return None
        if names and wanted.metric not in names and len(names) >= len(self._model.metrics):
            problems.add(("requirement", "metric"), must_be_measured(wanted.metric, names))
        return Requirement(wanted.metric, *wanted.critical)

    def _check_inputs(self, files: SumoFiles, space: ParameterSpace | None) -> None:
        """Compare placeholders and inputs."""
        shaped = {name for name, entry in self._model.inputs.items() if entry.profile is not None}
        if len(self._profiles) < len(shaped):  # their inputs are not known
            return
        of_profile = {p.name: name for name, profile in self._profiles.items() for p in profile.parameters}
        known = [*(name for name in self._model.inputs if name not in shaped), *of_profile]
        followed = {name for entry in self._model.actors.values() for name in (entry.speed, entry.acceleration)}
        used = {name for name, profile in of_profile.items() if profile in followed}
        try:
            holes = list(files.placeholders())
            if self._model.recorded is not None:
                holes += placeholders(str(self._model.recorded.begin), "recorded.begin")
            holes += placeholders(str(self._model.friction), "friction")
        except InputError as error:
            self._problems.add(("sumo",), str(error))
            return
        for hole in holes:
            for name in hole.formula.names():
                used.add(name)
                if name not in known:
                    used.update(one for one in known if did_you_mean(name, known).endswith(f"'{one}'?)"))  # told by this
                    rule = must_be_one_of(f"${{{hole.formula.text}}}: a placeholder", name, known)
                    self._problems.add(("inputs",), f"{hole.place}: {rule}")
            if space is not None and not hole.formula.is_name:
                try:
                    space.check_formula(hole.formula)
                except InputError as error:
                    self._problems.add(("inputs",), f"{hole.place}: {error}")
        for name in known:
            if name not in used and self._model.simulate is None:
                read_files = ", ".join("insert" if t.path == self._inserted else t.path.name for t in files.templates)
                rule = f"an input must stand as a placeholder ${{{name}}} in the files ({read_files}), but does not"
                if name in of_profile:
                    rule += f"; a profile may be followed instead: actors: {{ID: {{speed: {of_profile[name]}}}}}"
                self._problems.add(("inputs", of_profile.get(name, name)), rule, at_key=True)

"""What `sumo-sbt new` writes: a scenario.yaml and a campaign.yaml for a user's own SUMO files, tried out."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from sbt.config.scenario_file import from_file
from sbt.errors import InputError, RunError, did_you_mean
from sbt.files import write_atomically
from sbt.plugins import forget_changed
from sbt.sumo.departures import HELD_BACK
from sbt.sumo.files import SumoFiles, options_of_config
from sbt.sumo.observing import Observed, Traffic, candidates, observe
from sbt.sumo.own_ego import Suggestion, own_ego
from sbt.sumo.session import session
from sbt.sumo.suggesting import suggested

__all__ = ["Written", "write_scenario"]

_SAID = 3  # lines of SUMO that an error quotes at most
_TRIED = 4
"""Vehicles that are tried at most, until one departs as asked at every end of the inputs."""
_STEP = 0.1
"""Step of the simulation where the files set none (s); SUMO's own default is 1 s."""
_DURATION, _SHORTEST, _LONGEST = 30.0, 10.0, 120.0
"""Time that is usually recorded, at least of a vehicle that leaves earlier, and at most of one that meets others later (s)."""
_AFTER = 15.0
"""Time that is recorded after the moment with most others around (s)."""

_BUDGET, _MINUTE = (12, 40), 60.0
"""Fewest and most runs of the first campaign, which is to take about so long (s), as long as a vehicle is tried at most."""

_SCENARIO = """\
# A logical scenario of your own SUMO files, which stay as they are. Try it: sumo-sbt check {folder}/scenario.yaml
# A placeholder such as ${{{first}}}, or a formula such as ${{2 * {first}}}, may stand in every attribute of the files
# below and in every option; every input must stand in one.

sumo:                       # or just: sumo: my.sumocfg
  config: {config}
{files}  options: {{}}               # further SUMO options, such as {{scale: 1.2, eager-insert: true}}

inputs:                     # min, max, and if you like: unit, distribution, kind: integer, description
{inputs}
# The vehicle under test: {why}
ego:
  id: {ego}
  may_leave: true           # arriving early is no failure
{delay}  # kind: acc_aeb           # drive it by a controller, file.py:NAME for your own; or {{kind: sumo, model: IDM, tau: 1.2}}

others: {{within: 100}}       # record everybody who comes this near (m); named: [lead] records lead wherever it is
duration: {duration:g}                # from the ego's departure on (s)
{step}
metrics:                    # of ego and each of the others, the worst counts; other: lead asks for that one
  - ttc_path_min            # time to collision along the paths driven: right in bends and at crossings, too
  - distance_min
  - collision
  - deceleration_max
  - {{stl: "G(distance > 0.5)", name: keeps_clear}}

requirement: {{metric: ttc_path_min, critical: [-.inf, 1.0]}}   # less than 1 s to a collision
"""
_DELAY = """\
  delay: 10                 # how much later than its depart it may enter, where the traffic leaves no gap (s)
"""
_CAMPAIGN = """\
# Run it: sumo-sbt run {folder}/campaign.yaml
campaign: falsification     # find critical runs; or coverage (spread evenly), boundary, estimation
scenario: scenario.yaml
seed: 1
budget: {budget}                  # runs
initial: {initial}                 # spread evenly at first; the others where failures are likely
stop: {{failures: null}}      # failures: 1 ends with the first one
"""


@dataclass(frozen=True)
class Written:
    """What was written.

    Args:
        paths: of the files.
        notes: what was chosen and tried, a line each.
    """

    paths: tuple[Path, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Trial:
    """What came of the runs at the centre and at both ends of every input.

    Args:
        problems: what went wrong, a line each.
        required: the values of the metric of the requirement.
        without: its value where nobody comes near.
        unit: of the metric.
        seconds: that a run took, on average.
    """

    problems: tuple[str, ...]
    required: tuple[float, ...]
    without: float
    unit: str
    seconds: float

    @property
    def fine(self) -> bool:
        """Whether all runs are right, and the ego meets somebody in one of them."""
        return not self.problems and any(value != self.without for value in self.required)

    @property
    def rank(self) -> tuple[int, bool]:
        """Smaller is better."""
        return len(self.problems), all(value == self.without for value in self.required)

    def said(self) -> Iterator[str]:
        """Yield what a user wants to know, a line each."""
        runs = len(self.problems) + len(self.required)
        low, high = (f"{end(self.required):.2g}" for end in (min, max)) if self.required else ("", "")
        seen = f"{low} {self.unit}" if low == high else f"{low} to {high} {self.unit}"
        span = f", ttc_path_min {seen} in them (elsewhere it may be less or more)" if self.required else ""
        if self.required and all(value == self.without for value in self.required):
            span = f", ttc_path_min {seen}: it meets nobody; --ego ID takes another vehicle"
        yield f"tried at the ends of its inputs: {len(self.required)} of {runs} runs are right, {self.seconds:.2g} s each{span}"
        yield from self.problems


@dataclass(frozen=True)
class _Draft:
    """A scenario before it is written: the texts of its files, why it has this ego, and the one in which the ego may wait."""

    texts: Mapping[Path, str | bytes]
    scenario: str
    why: str
    patient: str = ""


def write_scenario(folder: Path, config: Path, ego: str | None = None) -> Written:
    """Write scenario.yaml, campaign.yaml and what they need into a folder.

    Where the files have no placeholders yet, the traffic is watched once, the vehicle called ego or one from its midst is
    chosen (`ego` names another), and it gets a type of its own with inputs in it; the first of some choices that runs at
    every end of every input is taken. Where they have placeholders, those are the inputs.

    Raises:
        InputError: the configuration cannot be read or run, has no such vehicle, or there is a scenario already.
    """
    if (folder / "scenario.yaml").exists():
        raise InputError(f"FOLDER must not have a scenario.yaml yet, but '{folder}' has")
    if config.suffix in (".yaml", ".yml"):
        rule = "--from must be a SUMO configuration (.sumocfg), from which a scenario.yaml is made"
        raise InputError(f"{rule}, but got '{config}': sumo-sbt check {config} tries a scenario.yaml that is there")
    files = SumoFiles.of(options_of_config(config), config.resolve().parent, str(config))
    if ego is not None and files.vehicle(ego) is None:
        names = files.names()
        known = ", ".join(names[:8]) or "none"
        raise InputError(f"--ego must be a vehicle of the files ({known}), but got '{ego}'{did_you_mean(ego, names)}")
    best: tuple[_Trial, _Draft] | None = None
    made: set[Path] = set()
    for each in _drafts(files, config, folder, ego):
        trial, draft = _settled(each, folder, made)
        if best is None or trial.rank < best[0].rank:
            best = trial, draft
        if trial.fine:
            break
    if best is None:
        none = f"none did while the traffic was watched{_warned()}"
        raise InputError(f"{config}: a road vehicle must depart, but {none}; name one: --ego ID")
    _write(best[1], folder, made)
    budget = max(_BUDGET[0], min(_BUDGET[1], int(_MINUTE / max(best[0].seconds, 1e-3))))
    campaign = _CAMPAIGN.format(folder=folder, budget=budget, initial=budget // 2)
    made.add(write_atomically(folder / "campaign.yaml", campaign))
    return Written(tuple(sorted(made)), (f"the vehicle under test: {best[1].why}", *best[0].said()))


def _warned() -> str:
    """Return what SUMO said of the files, such as that it ignores what is not sorted; "" if nothing."""
    said = [line for line in dict.fromkeys(session().messages()) if line.startswith(("Warning:", "Error:"))]
    return f" ({'; '.join(said[:_SAID])})" if said else ""


def _drafts(files: SumoFiles, config: Path, folder: Path, ego: str | None) -> Iterator[_Draft]:
    """Yield scenarios that could be written, the best ones first."""
    step = files.step_length() or _STEP
    holes = list(files.placeholders())
    inputs = suggested(files)
    if holes:
        yield _with_placeholders(files, config, folder, ego, inputs)
        return
    traffic = observe(files, {}, ego)
    if ego is not None:
        chosen = traffic.get(ego) or next((v for v in traffic.vehicles if v.id.rpartition(".")[0] == ego), None)
        if chosen is None:
            raise InputError(f"--ego must depart, but '{ego}' did not while the traffic was watched{_warned()}")
        choice = [chosen]
    else:
        named = [v for v in traffic.vehicles if v.id.lower() == "ego"]
        choice = named[:1] or candidates(traffic)[:_TRIED]
    for one in choice:
        yield _draft(files, config, folder, traffic, one, step)


def _draft(files: SumoFiles, config: Path, folder: Path, traffic: Traffic, chosen: Observed, step: float) -> _Draft:
    own = own_ego(files, traffic, chosen, folder.resolve(), step)
    new = folder / "ego.rou.xml"
    copies = dict(zip(own.copies, _new_names(own.copies, folder), strict=True))
    routes = [*(copies.get(path, path) for path in files.routes), new]
    named = f"  routes: [{', '.join(_shown(p, folder) for p in routes)}]\n"
    if any(path in own.copies for path in files.additional):
        named += f"  additional: [{', '.join(_shown(copies.get(p, p), folder) for p in files.additional)}]\n"
    why = (
        f"{own.how}.\n# '{chosen.id}' departs at {chosen.depart:g} s, when {chosen.running} of at most {traffic.most} vehicles"
        f" are on the road, and has {chosen.neighbours:.1f} others within 50 m on average"
    )
    scenario = _scenario(files, config, folder, own.id, own.inputs, why, named, chosen)
    texts: dict[Path, str | bytes] = {new: own.xml, **{copies[path]: data for path, data in own.copies.items()}}
    return _Draft(texts, scenario, why.replace("\n#", ""))


def _new_names(paths: Iterable[Path], folder: Path) -> Iterator[Path]:
    """Yield a name in the folder for the copy of each file; files of different folders may have the same name."""
    taken: list[str] = []
    for path in paths:
        taken.append(path.name)
        number = taken.count(path.name)
        yield folder / f"copy{'' if number == 1 else number}_of.{path.name}"


def _with_placeholders(
    files: SumoFiles, config: Path, folder: Path, ego: str | None, inputs: tuple[Suggestion, ...]
) -> _Draft:
    """Return a scenario of files whose inputs are there already."""
    vehicles = [name for t in files.templates for name, v in t.vehicles.items() if v.tag != "flow"]
    varying = [name for t in files.templates for name in t.varying if name in vehicles]
    named = [name for name in vehicles if name.lower() == "ego"]
    ego = ego or next(iter([*named, *varying, *vehicles, *(f"{name}.0" for name in files.names())]), None)
    if ego is None:
        raise InputError(f"{config}: the files must have a vehicle, trip or flow, but have none")
    at_once, patient = (
        _scenario(files, config, folder, ego, inputs, "choose another one here, where it is not yours", "", None, delay=delay)
        for delay in ("", _DELAY)
    )
    return _Draft({}, at_once, f"'{ego}'; the inputs are the placeholders of the files", patient)


def _scenario(
    files: SumoFiles, config: Path, folder: Path, ego: str, inputs: tuple[Suggestion, ...], why: str, named: str,
    chosen: Observed | None, *, delay: str = _DELAY,
) -> str:  # fmt: skip
    duration = _DURATION
    if chosen is not None:
        duration = round(max(_SHORTEST, min(max(_DURATION, chosen.busiest + _AFTER), chosen.stay, _LONGEST)))
    return _SCENARIO.format(
        folder=folder, config=_shown(config, folder), files=named, ego=json.dumps(ego, ensure_ascii=False), why=why,
        duration=duration, delay=delay, first=inputs[0].name if inputs else "name",
        step="" if files.step_length() is not None else f"step_length: {_STEP}            # SUMO's own default is 1 s\n",
        inputs="".join(f"  {s.name}: {_entry(s)}\n" for s in inputs),
    )  # fmt: skip


def _entry(s: Suggestion) -> str:
    unit = f", unit: {json.dumps(s.unit)}" if s.unit else ""
    kind = ", kind: integer" if s.integer else ""
    return f"{{min: {s.low:g}, max: {s.high:g}{unit}{kind}, description: {json.dumps(s.description, ensure_ascii=False)}}}"


def _shown(path: Path, folder: Path) -> str:
    return json.dumps(os.path.relpath(path.resolve(), folder.resolve()), ensure_ascii=False)


def _write(draft: _Draft, folder: Path, made: set[Path]) -> None:
    """Write the files of a draft; none of an earlier draft is left, and none of the user's is overwritten.

    Raises:
        InputError: a file of that name is there already.
    """
    wanted = {**draft.texts, folder / "scenario.yaml": draft.scenario}
    for path in made - set(wanted):
        path.unlink()
    made.intersection_update(wanted)
    for path, text in wanted.items():
        if path not in made and path.exists():
            raise InputError(f"FOLDER must not have a {path.name} yet, but '{folder}' has: choose another folder")
        made.add(write_atomically(path, text))
    forget_changed()


def _settled(draft: _Draft, folder: Path, made: set[Path]) -> tuple[_Trial, _Draft]:
    """Write and try a draft; where SUMO holds the ego back, with a delay, which stays if more runs are right with it."""
    _write(draft, folder, made)
    trial = _tried(folder / "scenario.yaml")
    if not draft.patient or not any(HELD_BACK in problem for problem in trial.problems):
        return trial, draft
    waits = replace(draft, scenario=draft.patient)
    _write(waits, folder, made)
    later = _tried(folder / "scenario.yaml")
    return (later, waits) if later.rank < trial.rank else (trial, draft)


def _tried(path: Path) -> _Trial:
    """Return what comes of the runs at the centre and at both ends of every input, of as many as a minute allows."""
    scenario = from_file(str(path), Path.cwd())
    space, metric = scenario.space, scenario.metrics[0]
    centre = {p.name: p.centre for p in space.parameters}
    points = [centre, *({**centre, p.name: end} for p in space.parameters for end in p.bounds)]
    problems, required, begin = [], [], time.perf_counter()
    for seed, values in enumerate(points):
        if time.perf_counter() - begin > _MINUTE:
            break
        try:
            required.append(scenario.run(values, seed)[scenario.requirement.metric])
        except RunError as error:
            problems.append(f"at {', '.join(f'{k}={v:g}' for k, v in values.items())}: {error}")
    seconds = (time.perf_counter() - begin) / max(len(problems) + len(required), 1)
    return _Trial(tuple(problems), tuple(required), metric.without, metric.unit, seconds)

"""Runs that share a simulation: each is what it is alone, to the last bit, and one that fails costs no other."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sbt import plugins
from sbt.errors import InputError, RunError
from sbt.execution import local
from sbt.execution.local import LocalExecutor
from sbt.execution.protocol import SerialExecutor
from sbt.execution.spec import ScenarioSpec
from sbt.problem.outcome import Job, Status
from sbt.problem.scenario import LogicalScenario
from sbt.problem.trace import Trace
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import run_seed, stream
from sbt.sumo.actors import Action, Actor, Scene, State, VehicleType
from sbt.sumo.ego import Ego
from sbt.sumo.nets import net_file
from sbt.sumo.replicas import replicated_net
from sbt.sumo.session import libsumo, session
from sbt.sumo.simulation import CLOCK_STEPS, SumoSimulation

pytestmark = pytest.mark.sumo

Work = list[tuple[dict[str, float], int]]


def work_of(scenario: LogicalScenario, n: int, seed: int = 0) -> Work:
    """Even points, each with a seed; of the time gap the lower third, where something happens."""
    u = SobolSequence(scenario.space.dimension, seed).points(0, n)
    if "d_t" in scenario.space.names:
        u[:, scenario.space.names.index("d_t")] *= 0.3
    rows = scenario.space.from_unit(u)
    return [(dict(zip(scenario.space.names, row.tolist(), strict=True)), run_seed(seed, k)) for k, row in enumerate(rows)]


def simulation_of(name: str, isolation: str) -> SumoSimulation:
    simulate = ScenarioSpec(name, isolation=isolation).resolve().simulate
    assert isinstance(simulate, SumoSimulation)
    return simulate


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Counts the runs that are done alone: their seeds."""
    seeds: list[int] = []
    real = SumoSimulation.__call__

    def counted(self: SumoSimulation, values: Mapping[str, float], seed: int) -> Trace:
        seeds.append(seed)
        return real(self, values, seed)

    monkeypatch.setattr(SumoSimulation, "__call__", counted)
    return seeds


@pytest.mark.parametrize("name", ["cut_in", "emergency_braking", "following"])
def test_replicas_are_fresh_runs_bit_by_bit_in_any_company(name: str, alone: list[int]):
    work = work_of(plugins.load("scenarios", name), 12 if name == "following" else 40)
    together = simulation_of(name, "replicas")
    assert together.batched
    first = together.simulate_many(work)
    order = stream(3).permutation(len(work)).tolist()
    second = together.simulate_many([work[k] for k in order])
    assert alone == []
    fresh = simulation_of(name, "fresh")
    for k, position in enumerate(order):
        one, two, expected = first[position], second[k], fresh(*work[position])
        assert isinstance(one, Trace)
        assert isinstance(two, Trace)
        assert one.identical(expected)
        assert two.identical(expected)
    assert len({(t.ended, len(t.time)) for t in first if isinstance(t, Trace)}) > 3
    assert name == "following" or any(t.reported for t in first if isinstance(t, Trace))


class Awkward:
    """Does what the inputs say: fails, asks for the impossible, or drives on."""

    def __init__(self, kind: float):
        self.kind = kind

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        if self.kind == 1 and t > 0.2:
            raise LookupError("no map here")
        if self.kind == 2 and t > 0.2:
            return Action(speed=math.nan)
        if self.kind == 3:
            time.sleep(0.005)
        if self.kind == 4 and t > 0.2:
            os._exit(3)
        if self.kind == 5 and t > 0.2:
            time.sleep(1e6)
        return Action(speed=own.speed)


def scene(values: Mapping[str, float], ego: Ego, rng: np.random.Generator) -> Scene:
    if values["kind"] == 6:
        raise KeyError("no such thing")
    position = 5000.0 if values["kind"] == 7 else 3980.0 if values["kind"] == 8 else 100.0
    pose = (50.0, -5.25, 0.0) if values["kind"] == 9 else None
    driver: Any = Awkward(values["kind"])
    car = VehicleType(5.0, 1.8)
    actors = [Actor("ego", ("road",), 1, position, values["v"], driver, car)]
    if pose:
        actors.append(Actor("co", ("road",), 0, 10.0, 0.0, Posed(), car, pose))
    return Scene(tuple(actors))


class Posed:
    """Stands on its pose."""

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        return Action(speed=0.0, pose=(own.x, own.y, own.heading))


AWKWARD = SumoSimulation("straight", scene, 1.5, isolations=("fresh", "reuse", "replicas"))


def awkward(kinds: list[int]) -> Work:
    return [({"kind": float(kind), "v": 20.0 + k}, k) for k, kind in enumerate(kinds)]


def same(one: Trace | Exception, two: Trace | Exception) -> bool:
    if isinstance(one, Trace):
        return isinstance(two, Trace) and one.identical(two)
    return type(one) is type(two) and str(one) == str(two)


@pytest.mark.parametrize("kind", [1, 2, 6, 7, 8, 9], ids=["raises", "nan", "no scene", "not inserted", "gone", "by pose"])
def test_a_run_that_cannot_share_costs_no_other_and_ends_as_it_does_alone(kind: int, alone: list[int]):
    work = awkward([0, 0, kind, 0, 0, kind, 0])
    found = AWKWARD.simulate_many(work)
    assert alone  # it was run again alone
    expected = []
    for values, seed in work:
        try:
            expected.append(replace(AWKWARD, isolation="reuse")(values, seed))
        except Exception as error:
            expected.append(error)
    assert [same(a, b) for a, b in zip(found, expected, strict=True)] == [True] * len(work)
    assert isinstance(found[2], Trace) == (kind == 9)
    again = AWKWARD.simulate_many(awkward([0] * 20))
    assert all(isinstance(trace, Trace) for trace in again)


def test_a_run_that_is_too_slow_is_a_timeout_and_its_company_is_not(alone: list[int]):
    long = replace(AWKWARD, duration=0.05 * (CLOCK_STEPS + 50), step_length=0.05)
    found = long.limited(0.2).simulate_many(awkward([0, 3, 0, 0]))
    assert [isinstance(t, Trace) for t in found] == [True, False, True, True]
    assert isinstance(found[1], RunError)
    assert found[1].status == Status.TIMEOUT


AWKWARD_FILE = """
import tests_of_replicas as tests
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import CriticalInterval, Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.metrics.longitudinal import collision

SCENARIO = LogicalScenario(
    "awkward", ParameterSpace((Parameter("kind", 0.0, 9.0), Parameter("v", 1.0, 90.0))),
    Requirement("collision", low=1.0), tests.AWKWARD, (collision(),),
)
"""


@pytest.mark.parametrize(
    ("kind", "status"),
    [(4.0, Status.CRASHED), pytest.param(5.0, Status.TIMEOUT, marks=pytest.mark.slow)],
    ids=["dies", "hangs"],
)
def test_a_death_or_a_hang_among_runs_at_once_costs_itself_only(
    kind: float, status: Status, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("sbt.execution.local._GRACE", 0.3)
    (tmp_path / "tests_of_replicas.py").write_text(Path(__file__).read_text())
    (tmp_path / "awkward.py").write_text(f"import sys\nsys.path.insert(0, {str(tmp_path)!r})\n" + AWKWARD_FILE)
    jobs = [Job(k, {"kind": kind if k == 4 else 0.0, "v": 20.0 + k}, k) for k in range(12)]
    spec = ScenarioSpec("awkward.py:SCENARIO", str(tmp_path))
    monkeypatch.setattr(local, "chunk_of", lambda queue, *_: [queue.popleft() for _ in range(min(6, len(queue)))])
    with LocalExecutor(spec, 1, timeout=1.5) as executor:
        found = {o.index: o for o in executor.run(jobs)}
    assert sorted(found) == list(range(12))
    assert {k: o.status for k, o in found.items() if o.status != Status.OK} == {4: status}


def test_rows_do_not_depend_on_the_isolation():
    work = work_of(plugins.load("scenarios", "cut_in"), 70)
    jobs = [Job(k, values, seed) for k, (values, seed) in enumerate(work)]
    rows = {}
    for isolation in ("auto", "reuse", "fresh"):
        with SerialExecutor(ScenarioSpec("cut_in", isolation=isolation)) as executor:
            rows[isolation] = [replace(o, seconds=0.0) for o in executor.run(jobs if isolation != "fresh" else jobs[:20])]
    assert rows["auto"] == rows["reuse"]
    assert rows["auto"][:20] == rows["fresh"]


def test_replicas_share_no_id_and_have_the_same_coordinates(tmp_path: Path):
    (tmp_path / "copies.net.xml").write_text(replicated_net(net_file("street"), 3))
    simulation = replace(AWKWARD, net=str(tmp_path / "copies.net.xml"))
    with session().run(simulation.setup(Scene(())), 0, "fresh"):
        lanes = libsumo().lane.getIDList()
        assert sorted(lanes) == sorted(f"r{k}.{edge}_{i}" for k in range(3) for edge in ("road", "oncoming") for i in (0, 1))
        assert len({libsumo().lane.getShape(f"r{k}.road_1") for k in range(3)}) == 1
        assert all(link[0].startswith("r1.") for link in libsumo().lane.getLinks("r1.road_0"))


def test_a_network_with_a_state_of_its_own_is_not_copied(tmp_path: Path):
    net = net_file("straight").read_text().replace("</net>", '<tlLogic id="a" type="static" programID="0" offset="0"/></net>')
    (tmp_path / "lights.net.xml").write_text(net)
    with pytest.raises(InputError, match=r"needs a network of edges and junctions alone, but lights.net.xml has <tlLogic>"):
        replicated_net(tmp_path / "lights.net.xml", 2)

"""A run in a simulation in which others ran is the one after a load, whatever SUMO keeps of a network, an option or a driver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import libsumo
import numpy as np
import pytest

from sbt.execution.spec import ScenarioSpec
from sbt.metrics.longitudinal import ttc_min
from sbt.problem.parameter import Parameter
from sbt.problem.plain import Values
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.sumo.actors import Action, Actor, Controller, Obstacle, Scene, State, VehicleType
from sbt.sumo.ego import Ego
from sbt.sumo.nets import net_file
from sbt.sumo.resetting import changes_of, why_fresh
from sbt.sumo.simulation import SumoSimulation
from sbt.workflows.front import check_target
from tests.own_networks import run_program

pytestmark = pytest.mark.sumo

ARMS = "wesn"


@pytest.fixture(scope="module")
def net_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], str]:
    """Networks with a junction of four arms, by its type."""

    def made(kind: str) -> str:
        folder = tmp_path_factory.mktemp(kind)
        places = {"c": (0, 0), "w": (-200, 0), "e": (200, 0), "s": (0, -200), "n": (0, 200)}
        kinds = {**dict.fromkeys(places, "priority"), "c": kind}
        nodes = "".join(f'<node id="{k}" x="{x}" y="{y}" type="{kinds[k]}"/>' for k, (x, y) in places.items())
        edges = "".join(
            f'<edge id="{a}i" from="{a}" to="c" speed="20" priority="{1 + (a in "we")}"/>'
            f'<edge id="{a}o" from="c" to="{a}" speed="20" priority="{1 + (a in "we")}"/>'
            for a in ARMS
        )
        (folder / "n.nod.xml").write_text(f"<nodes>{nodes}</nodes>")
        (folder / "e.edg.xml").write_text(f"<edges>{edges}</edges>")
        run_program(folder, "netconvert", "-n", "n.nod.xml", "-e", "e.edg.xml", "-o", "net.net.xml", "--no-turnarounds")
        return str(folder / "net.net.xml")

    known: dict[str, str] = {}
    return lambda kind: known[kind] if kind in known else known.setdefault(kind, made(kind))


class Calm:
    """Keeps its speed, and may do something else at 2 s."""

    def __init__(self, also: Callable[[], None] = lambda: None):
        self.also = also

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        if abs(t - 2.0) < 0.01:
            self.also()
        return Action(acceleration=0.0)


def meeting(net: str, driver: Controller | None = None, more: tuple[Actor, ...] = (), **attributes: str) -> SumoSimulation:
    """Four vehicles arrive at a junction at once; one of them has a controller, if any."""
    kind = VehicleType(attributes=tuple(attributes.items()))

    def scene(values: Values, ego: Ego, rng: np.random.Generator) -> Scene:
        drivers = (None, driver, None, None)
        cars = [
            Actor(name, (f"{a}i", f"{b}o"), 0, 60.0, 9.0, d, kind)
            for a, b, d, name in zip(ARMS, "ewns", drivers, ("ego", "co", "south", "north"), strict=True)
        ]
        return Scene((*cars, *more))

    return SumoSimulation(net, scene, 14.0, 0.1, isolations=("fresh", "reuse", "replicas"))


WALKER = Actor("p", ("wo",), 0, 2.0, 1.2, person=True)
"""Walks on a road."""
DRAWS = "SUMO draws who goes first"
FRESH = {"right_before_left": DRAWS, "allway_stop": DRAWS, "traffic_light": "<tlLogic>"}


def same_as_loaded(simulation: SumoSimulation, level: str) -> bool:
    """Whether six runs at a level, with seeds of their own, are what they are after a load."""
    work = [({"x": 0.0}, seed) for seed in range(6)]
    loaded = [replace(simulation, isolation="fresh")(*one) for one in work]
    runs = replace(simulation, isolation=level).simulate_many(work)
    return all(not isinstance(run, BaseException) and run.identical(one) for run, one in zip(runs, loaded, strict=True))


@pytest.mark.parametrize("level", ["reuse", "replicas"])
@pytest.mark.parametrize(("kind", "why"), FRESH.items())
def test_junctions_with_a_state_or_draws_are_loaded_for_every_run(net_of, kind: str, why: str, level: str):
    simulation = replace(meeting(net_of(kind)), isolation=level)
    assert same_as_loaded(simulation, level)
    assert why in simulation.why_fresh({"x": 0.0}, 0)
    assert replace(simulation, isolation="fresh").why_fresh({"x": 0.0}, 0) == ""


@pytest.mark.parametrize(
    "attributes",
    [{"sigma": "0.5"}, {"speedDev": ".1"}, {"jmSigmaMinor": "0.5"}, {"carFollowModel": "EIDM"}],
)
def test_drivers_for_whom_sumo_draws_are_loaded_for_every_run(net_of, attributes: dict[str, str]):
    simulation = meeting(net_of("priority"), **attributes)
    assert same_as_loaded(simulation, "reuse")
    assert "draws random numbers for 'ego'" in simulation.why_fresh({"x": 0.0}, 0)


def test_walkers_are_loaded_for_every_run(net_of):
    simulation = meeting(net_of("priority"), more=(WALKER,))
    assert same_as_loaded(simulation, "reuse")
    assert "'p', who walks" in simulation.why_fresh({"x": 0.0}, 0)


@pytest.mark.parametrize("level", ["reuse", "replicas"])
@pytest.mark.parametrize("attributes", [{}, {"carFollowModel": "IDM", "actionStepLength": "0.7"}, {"sigma": "0"}])
def test_what_leaves_nothing_is_kept(net_of, attributes: dict[str, str], level: str):
    simulation = meeting(net_of("priority"), Calm(), **attributes)
    assert simulation.why_fresh({"x": 0.0}, 0) == ""
    assert same_as_loaded(simulation, level)


def test_of_controllers_sumo_draws_nothing(net_of):
    driven = [Actor(a, (f"{a}i", f"{b}o"), 0, 150.0, 9.0, Calm()) for a, b in zip(ARMS, "ewns", strict=True)]
    assert why_fresh(net_of("right_before_left"), (), driven) == ""
    assert "<tlLogic>" in why_fresh(net_of("traffic_light"), (), driven)  # a controller may look at the lights


@pytest.mark.parametrize(
    ("options", "kept"),
    [((), True), (("--lateral-resolution", "0.4"), True), (("--fcd-output", "x.xml", "--precision=6"), True),
     (("--collision.stoptime", "-1"), True), (("--route-files", "x.rou.xml"), False), (("-a", "x.add.xml"), False),
     (("--device.rerouting.probability=1",), False)],
)  # fmt: skip
def test_options_that_may_keep_something(options: tuple[str, ...], kept: bool):
    why = why_fresh(str(net_file("straight")), options, ())
    assert why == "" if kept else f"option {options[0].partition('=')[0]} may keep something" in why


def limit() -> None:
    libsumo.lane.setMaxSpeed("wi_0", 4.0)
    libsumo.lane.setMaxSpeed("wo_0", 4.0)


def close() -> None:
    libsumo.edge.setDisallowed("no", ["passenger"])


def insert() -> None:
    libsumo.route.add("r", ["wi", "eo"])
    libsumo.vehicle.add("unasked", "r")


def reroute() -> None:
    libsumo.route.add("mine", ["ei", "no"])
    libsumo.vehicle.setRouteID("co", "mine")


def draw() -> None:
    libsumo.polygon.add("drawn", [(0.0, 0.0), (1.0, 1.0), (1.0, 0.0)], (1, 1, 1, 1))
    libsumo.poi.add("marked", 0.0, 0.0, (1, 1, 1, 1))


@pytest.mark.parametrize("change", [limit, close, insert, reroute, draw])
def test_a_run_that_changes_more_than_its_actors_is_the_last_of_its_simulation(net_of, change: Callable[[], None]):
    assert same_as_loaded(meeting(net_of("priority"), Calm(change)), "reuse")


def test_what_this_package_adds_and_removes_is_no_change_of_the_runs_code(net_of):
    """Routes, vehicles and polygons of a scene; those of the run's code, in any domain of SUMO, are."""
    simulation = meeting(net_of("priority"), Calm())
    wall = Obstacle("wall", (300.0, 50.0, 0.0), 1.0, 1.0)
    walled = replace(simulation, scene=lambda *given: replace(simulation.scene(*given), obstacles=(wall,)), isolation="reuse")
    changes = changes_of(libsumo)
    for _ in range(2):
        walled({"x": 0.0}, 0)
        assert not changes
    for domain in libsumo.DOMAINS:
        assert hasattr(domain.add if domain in (libsumo.vehicle, libsumo.person) else domain.setParameter, "__wrapped__")


def test_built_in_scenarios_are_kept():
    for name in ("cut_in", "following", "emergency_braking", "jaywalking", "lane_keeping", "parking"):
        scenario = ScenarioSpec(name).resolve()
        assert isinstance(scenario.simulate, SumoSimulation)
        assert scenario.simulate.isolation_level != "fresh"
        values = {p.name: 0.5 * (p.low + p.high) for p in scenario.space.parameters}
        assert scenario.simulate.why_fresh(values, 0) == ""


def test_check_says_that_runs_are_loaded(net_of):
    space = ParameterSpace((Parameter("x", 0.0, 1.0),))
    simulate = replace(meeting(net_of("traffic_light")), isolations=("fresh", "reuse"))
    need = Requirement("ttc_min", high=1.0)
    scenario = LogicalScenario("lights", space=space, simulate=simulate, metrics=(ttc_min(),), requirement=need)
    findings = {finding.rule: finding for finding in check_target(scenario).findings}
    assert "fresh: SUMO is loaded for every run: the network has <tlLogic>" in findings["for information: isolation"].detail
    assert findings["isolation reuse = fresh"].ok

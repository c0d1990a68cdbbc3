"""The body of a long vehicle that has not been seen to drive, or was moved, is on the lanes behind its front."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from own_networks import run_program
from test_evidence import deaf, simulation, vehicle

from sbt.problem.trace import ActorTrace, Trace
from sbt.sumo.trailing import TrailingBody
from sbt.sumo.user_simulation import Loop, step_until_over

pytestmark = pytest.mark.sumo
NODES = "".join(f'<node id="{n}" x="{x}" y="{y}"/>' for n, x, y in (("w", -200, 0), ("e", 200, 0), ("s", 0, -200), ("n", 0, 200)))
ENDS = [(f"{a}m", a, "m") for a in "wesn"] + [(f"m{a}", "m", a) for a in "wesn"]
EDGES = "".join(f'<edge id="{name}" from="{a}" to="{b}" numLanes="2" speed="14"/>' for name, a, b in ENDS)
BEFORE, AFTER = "sm", {"right": "me", "left": "mw", "straight": "mn"}


@pytest.fixture(scope="module")
def crossing(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A crossing with internal lanes, two lanes on each road."""
    folder = tmp_path_factory.mktemp("crossing")
    (folder / "n.nod.xml").write_text(f'<nodes>{NODES}<node id="m" x="0" y="0"/></nodes>')
    (folder / "e.edg.xml").write_text(f"<edges>{EDGES}</edges>")
    run_program(folder, "netconvert", "-n", "n.nod.xml", "-e", "e.edg.xml", "-o", "net.net.xml")
    return (folder / "net.net.xml").read_text()


def driven(
    folder: Path, network: str, turn: str, length: float, depart: float, loop: Loop = step_until_over, step: str = "0.1"
) -> Trace:
    """A bus that turns; the ego, which stands on the other side, sees it from its departure on."""
    lane = {"right": 0, "straight": 0, "left": 1}[turn]
    vehicles = f'<vType id="longer" length="{length}" width="2.5" sigma="0" maxSpeed="8"/>'
    vehicles += vehicle("o", f"{BEFORE} {AFTER[turn]}", "longer", departPos=150, departSpeed=8, departLane=lane)
    vehicles += '<vType id="slow" maxSpeed="0.01"/>'
    vehicles += vehicle("ego", "nm ms", "slow", depart=depart, departPos=150, departSpeed=0)
    (own := folder / f"{depart:g}").mkdir()
    return simulation(own, network, vehicles, loop, 20.0, step_length=step)({}, 1)


def body(actor: ActorTrace, k: int) -> np.ndarray:
    """Return the (parts, 2) middles of the parts at an instant."""
    return np.array([(part.x[k], part.y[k]) for part in actor.parts])


@pytest.mark.parametrize("turn", AFTER)
@pytest.mark.parametrize("length", [12.0, 18.0, 30.0])
def test_a_body_in_a_turn_is_where_it_is_whenever_it_is_first_seen(tmp_path: Path, crossing: str, turn: str, length: float):
    """It was straight beyond the begin of the lane that its front is on, as long as its own length."""
    seen = driven(tmp_path, crossing, turn, length, 0.0)
    worst = []
    for depart in np.arange(3.0, 11.0, 0.5):
        late = driven(tmp_path, crossing, turn, length, float(depart))
        a, b = seen.actor("o"), late.actor("o")
        first = int(np.flatnonzero(np.isfinite(b.x))[0])
        k = int(np.nanargmin(np.hypot(a.x - b.x[first], a.y - b.y[first])))
        assert (a.x[k], a.y[k]) == pytest.approx((b.x[first], b.y[first]), abs=1e-9)
        worst.append(np.hypot(*(body(a, k) - body(b, first)).T).max())
    assert max(worst) < 0.5


def middle(crossing_file: str, lanes: list[str]) -> np.ndarray:
    """Return the middle of some lanes as one line."""
    shapes = [crossing_file.split(f'<lane id="{lane}"')[1].split('shape="')[1].split('"')[0] for lane in lanes]
    return np.array([[float(v) for v in point.split(",")[:2]] for shape in shapes for point in shape.split()])


def beside(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Return how far points are from a line (m)."""
    found = []
    for a, b in pairwise(line):
        along = np.clip((points - a) @ (b - a) / max((b - a) @ (b - a), 1e-9), 0.0, 1.0)
        found.append(np.hypot(*(points - a - along[:, None] * (b - a)).T))
    return np.min(found, axis=0)


@pytest.mark.parametrize("position", [1.0, 4.0, 8.0])
def test_a_body_that_was_moved_is_on_the_lanes_behind_it(tmp_path: Path, crossing: str, position: float):
    def loop(sumo, values, rng):
        for k in range(100):
            if k == 20:
                sumo.vehicle.moveTo("o", "me_0", position)
            sumo.simulationStep()

    trace = driven(tmp_path, crossing, "right", 18.0, 0.0, loop)
    bus = trace.actor("o")
    back = int(np.flatnonzero(np.isnan(bus.x))[-1]) + 1
    inside = crossing.split('from="sm" to="me" fromLane="0"')[1].split('via="')[1].split('"')[0]
    line = middle(crossing, ["sm_0", inside, "me_0"])
    assert 15 < back < 30
    for k in range(back, back + 5):
        assert beside(body(bus, k), line).max() < 0.6, "parts are chords of the turn"


@pytest.mark.parametrize("step", ["0.5", "1"])
@pytest.mark.parametrize("turn", AFTER)
def test_a_body_is_on_the_lanes_however_long_the_step(tmp_path: Path, crossing: str, turn: str, step: str):
    """It followed the chords between its fronts, a metre beside its lane in a turn."""
    bus = driven(tmp_path, crossing, turn, 18.0, 0.0, step=step).actor("o")
    lane, after = {"right": 0, "straight": 0, "left": 1}[turn], AFTER[turn]
    inside, lanes = crossing.split(f'from="{BEFORE}" to="{after}" fromLane="{lane}"')[1].split('via="')[1].split('"')[0], []
    while inside:
        lanes.append(inside)
        onwards = crossing.split(f'from="{inside.rpartition("_")[0]}" to="{after}"')[1].split("/>")[0]
        inside = onwards.split('via="')[1].split('"')[0] if "via" in onwards else ""
    turned = middle(crossing, [f"{BEFORE}_{lane}", *lanes, f"{after}_{lane}"])
    changed = middle(crossing, [f"{after}_{1 - lane}"])  # it may change lanes behind the turn
    for part in bus.parts:
        along = 0.5 * part.length * np.stack([np.cos(part.heading), np.sin(part.heading)], axis=-1)
        joints = np.stack([part.x, part.y], axis=-1) - along
        joints = joints[np.isfinite(joints[:, 0])]
        assert np.minimum(beside(joints, turned), beside(joints, changed)).max() < 0.3


def test_beyond_the_begin_of_its_route_a_body_is_straight(tmp_path: Path, crossing: str):
    vehicles = '<vType id="longer" length="18" width="2.5"/>' + vehicle("o", "me", "longer", departPos=3, departSpeed=0)
    vehicles += vehicle("ego", "nm ms", departPos=150, departSpeed=0)
    parts = simulation(tmp_path, crossing, vehicles, deaf("o", "ego"), 1.0, step_length="0.1")({}, 1).actor("o").parts
    assert [part.heading[0] for part in parts] == [0.0] * 4


def test_a_body_that_overtakes_on_an_opposite_lane_is_behind_its_front(tmp_path: Path):
    """What is before it on that lane is ahead of it: the oncoming ego was taken to depart within it."""
    (tmp_path / "n.nod.xml").write_text('<nodes><node id="a" x="0" y="0"/><node id="b" x="600" y="0"/></nodes>')
    edges = "".join(f'<edge id="{a}{b}" from="{a}" to="{b}" numLanes="1" speed="25"/>' for a, b in ("ab", "ba"))
    (tmp_path / "e.edg.xml").write_text(f"<edges>{edges}</edges>")
    run_program(tmp_path, "netconvert", "-n", "n.nod.xml", "-e", "e.edg.xml", "--opposites.guess", "-o", "net.net.xml")
    vehicles = '<vType id="truck" length="16" sigma="0" lcOpposite="10" vClass="truck"/><vType id="slow" maxSpeed="5" sigma="0"/>'
    vehicles += vehicle("lead", "ab", "slow", departPos=60, departSpeed=5)
    vehicles += vehicle("o", "ab", "truck", departPos=30, departSpeed=8)
    vehicles += vehicle("ego", "ba", "slow", depart=4, departPos=505, departSpeed=3)
    trace = simulation(tmp_path, (tmp_path / "net.net.xml").read_text(), vehicles, step_until_over, 0.5, step_length="0.1")({}, 1)
    truck = trace.actor("o")
    assert truck.y[0] > 0.0, "it is on the opposite lane"
    assert body(truck, 0)[:, 0] == pytest.approx([truck.x[0] + dx for dx in (6.0, 2.0, -2.0, -6.0)], abs=0.3)
    assert [part.heading[0] for part in truck.parts] == pytest.approx([0.0] * 4, abs=0.1)


def test_a_body_that_moves_sideways_on_its_lane_does_so_evenly_however_long_the_step():
    """Its tail jumped to the new lateral place at the begin of a step of a second, and was kinked by 19 degrees."""

    def aside(t: float) -> float:
        return float(np.interp(t, [2.0, 5.0], [0.0, 3.2]))

    def driven_on(step: float) -> dict[int, np.ndarray]:
        def lane(front: tuple[float, float]) -> list[tuple[float, float]]:
            return [(float(x), front[1]) for x in np.arange(np.ceil(front[0]) - 1.0, front[0] - 18.0, -1.0)]

        truck = TrailingBody(16.5, lane)
        at = {round(t, 6): truck.move((10.0 * t, aside(t)), 1.0, 0.0, "e_0", 10.0 * step) for t in np.arange(0.0, 8.01, step)}
        return {k: truck.poses([at[float(k)]])[0] for k in range(3, 8)}

    fine, coarse = driven_on(0.05), driven_on(1.0)
    for k, poses in fine.items():
        np.testing.assert_allclose(coarse[k], poses, atol=0.01)

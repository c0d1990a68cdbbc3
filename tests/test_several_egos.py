"""Several vehicles under test in one run: each is watched, the worst counts, and its metric says which one it was."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_doors import check, files_of
from test_evidence import deaf, net, simulation, vehicle

import sbt
from sbt.config.own_metrics import metrics_of_several
from sbt.errors import InputError, RunError
from sbt.execution.spec import ScenarioSpec
from sbt.metrics.conflict_types import conflict
from sbt.metrics.traffic import any_collision, nearest_distance, ttc_path_min
from sbt.report.contacts import contacts_of
from sbt.sumo.ego_vehicle import EgoVehicle
from sbt.workflows.judging import judge_run

ROUTES = """<routes>
<vType id="car" length="5" width="1.8" sigma="0" maxSpeed="60"/>
<route id="ahead" edges="road"/>
<vehicle id="av1" type="car" route="ahead" depart="0" departLane="0" departPos="100" departSpeed="20" insertionChecks="none"/>
<vehicle id="slow" type="car" route="ahead" depart="0.5" departLane="1" departPos="${400 + gap}" departSpeed="15"
    insertionChecks="none"/>
<vehicle id="av2" type="car" route="ahead" depart="DEPART" departLane="1" departPos="400" departSpeed="20"
    insertionChecks="none"/>
</routes>"""
SCENARIO = """
sumo: {net: road.net.xml, routes: several.rou.xml}
inputs: {gap: {min: 20, max: 60}, v: {profile: {knots: [0, 1]}, min: -6, max: 0}}
ego: EGO
others: {within: 50}
actors: {slow: {acceleration: v}}
duration: 6
metrics: [ttc_min, collision, {stl: "G[0,5](gap > 5)", name: clear}]
requirement: {metric: ttc_min, critical: [-.inf, 1.0]}
"""


def written(folder: Path, ego: str = "[av1, {id: av2, kind: acc_aeb}]", depart: str = "0.5") -> Path:
    files_of("own_files", folder)
    (folder / "several.rou.xml").write_text(ROUTES.replace("DEPART", depart))
    (folder / "several.yaml").write_text(SCENARIO.replace("EGO", ego))
    return folder / "several.yaml"


@pytest.mark.sumo
def test_the_worst_counts_and_is_named(tmp_path):
    path = written(tmp_path)
    scenario = ScenarioSpec(str(path)).resolve()
    names = [m.name for m in scenario.metrics]
    assert names == [f"{m}{ego}" for m in ("ttc_min", "collision", "clear") for ego in ("", "_av1", "_av2")]
    trace = scenario.simulate(scenario.space.values({"gap": 20.0}), 0)
    assert trace.actors[0] == "av1"
    metrics = scenario.measure(trace)
    assert metrics["ttc_min"] == metrics["ttc_min_av2"] < metrics["ttc_min_av1"]
    assert metrics["clear"] == min(metrics["clear_av1"], metrics["clear_av2"])
    assert metrics["collision"] == max(metrics["collision_av1"], metrics["collision_av2"])


@pytest.mark.sumo
def test_the_trace_is_that_of_both(tmp_path):
    scenario = ScenarioSpec(str(written(tmp_path))).resolve()
    trace = scenario.simulate(scenario.space.values({"gap": 45.0}), 0)
    av1, av2, slow = (trace.actor(name) for name in ("av1", "av2", "slow"))
    assert np.isfinite(av1.x).all()
    assert np.isnan(av2.x[:5]).all()
    assert np.isfinite(av2.x[5:]).all()
    assert (float(av1.x[0]), float(av2.x[5])) == (97.5, 397.5)
    assert np.isfinite(slow.x[5:]).all()  # near av2, and far from av1
    assert np.nanmin(slow.x - av1.x) > 50


@pytest.mark.sumo
def test_a_contact_of_any_of_them_ends_the_run(tmp_path):
    path = written(tmp_path, "[av1, {id: av2, kind: 'blind.py:Blind'}]")
    (tmp_path / "blind.py").write_text(
        "class Blind:\n    def __init__(self, rng, set_speed):\n        pass\n\n    def act(self, t, own, others):\n"
        "        from sbt.sumo.actors import Action\n        return Action(speed=25.0)\n"
    )
    scenario = ScenarioSpec(str(path)).resolve()
    trace = scenario.simulate(scenario.space.values({"gap": 20.0, "v_0": -6.0, "v_1": -6.0}), 0)
    metrics = scenario.measure(trace)
    assert (trace.ended, metrics["collision_av1"], metrics["collision_av2"], metrics["collision"]) == ("collision", 0, 1, 1)
    assert trace.unconfirmed == ()


@pytest.mark.sumo
def test_all_of_them_must_depart_and_runs_repeat(tmp_path):
    code, output = check(written(tmp_path))
    assert code == 0, output
    (tmp_path / "late").mkdir()
    scenario = ScenarioSpec(str(written(tmp_path / "late", depart="50"))).resolve()
    with pytest.raises(RunError, match="'av2' is under test and must depart while 'av1' is, but did not"):
        scenario.simulate(scenario.space.values({}), 0)


@pytest.mark.parametrize(
    ("ego", "words"),
    [("[av1, av3]", r"several\.yaml:4:12: egos\.0: the ego must be a vehicle.*'av3'"), ("[av1, av1]", "different ids"),
     ("[av1, {id: av2, kind: nobody}]", r"several\.yaml:4:12: egos\.0: ")],
)  # fmt: skip
def test_mistakes_are_named(tmp_path, ego, words):
    with pytest.raises(InputError, match=words):
        ScenarioSpec(str(written(tmp_path, ego))).resolve()


@pytest.mark.sumo
def test_reference_drivers_take_the_places_of_all_vehicles_under_test(tmp_path):
    scenario, store = str(written(tmp_path)), tmp_path / "store"
    sbt.run(campaign="coverage", scenario=scenario, budget=4, seed=1, store=store, executor="serial", report=False)
    frame = sbt.open(store).frame
    row = frame.sort_values("y.ttc_min").iloc[0]
    assert row["y.ttc_min"] == row["y.ttc_min_av2"] < 1.0 < row["y.ttc_min_av1"], "the second one fails"
    (judged,) = judge_run(store, int(row["index"]), ["cc_human"])
    assert judged.avoided is not None


@pytest.mark.sumo
def test_each_has_a_level_of_its_own(tmp_path):
    """In the plane ego, b on the bridge and c below b all meet; what c is to b, ego's recorder brought into one trace."""
    below = [(-100.0, 0.0, 0.0), (100.0, 0.0, 0.0)]
    bridge = [(0.0, -100.0, 6.0), (0.0, 100.0, 6.0)]
    starts = (("b", "over", 20), ("ego", "we", 20), ("c", "we", 33))
    vehicles = "".join(vehicle(name, road, departPos=at) for name, road, at in starts)
    one = simulation(tmp_path, net({"we": below, "over": bridge}, z=True), vehicles, deaf("ego", "b", "c"), 6.0)
    alone = one({}, 1)
    both = replace(one, recording=replace(one.recording, further=(EgoVehicle("b", may_leave=True),)))({}, 1)
    assert (both.ended, both.actors) == ("duration", ("ego", "c", "b"))
    assert both.seen_by("ego").identical(alone)
    assert both.seen_by("b").actors == ("b",)
    for kind in (nearest_distance, any_collision, ttc_path_min):
        worst, *each = metrics_of_several({ego: kind(ego) for ego in ("ego", "b")})
        assert [m.value(both) for m in each] == [kind("ego").value(alone), kind("b").without]
        assert worst.value(both) == each[0].value(both)
    assert conflict(both, "ego", ())[0] == "c"
    assert conflict(both, "b", ()) is None
    assert contacts_of(both) == ()
    last = both.select(slice(10, 40))
    assert [len(last.seen_by(ego).time) for ego in ("ego", "b")] == [30, 30]
    assert last.seen_by("b").time[0] == both.time[10]


@pytest.mark.sumo
def test_a_contact_of_two_of_them_is_that_of_both(tmp_path):
    vehicles = vehicle("av1", "we", departPos=40, departSpeed=5) + vehicle("av2", "we", departPos=20, departSpeed=15)
    one = simulation(tmp_path, net({"we": [(-100.0, 0.0), (100.0, 0.0)]}), vehicles, deaf("av1", "av2"), 6.0)
    egos = [EgoVehicle(name, may_leave=True) for name in ("av1", "av2")]
    for first, second in (egos, egos[::-1]):
        trace = replace(one, recording=replace(one.recording, ego=first, further=(second,)))({}, 1)
        assert trace.ended == "collision"
        assert [m.value(trace) for m in metrics_of_several({e.id: any_collision(e.id) for e in egos})] == [1, 1, 1]

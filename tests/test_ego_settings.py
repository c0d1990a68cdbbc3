"""Settings of the AV under test reach it, or are refused; and who is stopped dead by the network is no outcome."""

from __future__ import annotations

import numpy as np
import pytest
from test_doors import files_of

import sbt
from sbt.errors import InputError
from sbt.execution.spec import ScenarioSpec
from sbt.metrics.longitudinal import ttc_min
from sbt.problem.outcome import Status
from sbt.sumo.actors import Action, Actor, Scene, VehicleType
from sbt.sumo.simulation import SumoSimulation

GAP = (sbt.Parameter("gap", 20.0, 40.0, "m"),)


class Steady:
    """Keeps its speed."""

    def act(self, t, own, others):
        return Action(acceleration=0.0)


def _scenario(scene, net="straight", duration=4.0) -> sbt.Scenario:
    simulate = SumoSimulation(net=net, scene=scene, duration=duration)
    return sbt.Scenario("own", GAP, sbt.Requirement("ttc_min", high=1.0), simulate=simulate, metrics=(ttc_min(),))


@pytest.mark.sumo
@pytest.mark.parametrize("ego", [
    "{kind: sumo, model: IDM, tau: {min: 0.5, max: 3.0}}", "{kind: sumo, model: {choices: [IDM, Krauss]}, tau: 1.0}",
    "{kind: acc_aeb, reaction_time: {min: 0.1, max: 0.6}}",
])  # fmt: skip
def test_ranges_of_settings_are_inputs_of_ones_own_files(tmp_path, ego):
    """From the configuration and from the scenario file: the input is there, its values reach the driver, runs replay."""
    files_of("own_files", tmp_path)
    written = (tmp_path / "scenario.yaml").read_text()
    name = "ego_tau" if "tau: {" in ego else "ego_model" if "choices" in ego else "ego_reaction_time"
    study = tmp_path / "study.yaml"
    study.write_text(
        "campaign: coverage\nscenario: scenario.yaml\nbudget: 4\ninitial: 4\nexecutor: {kind: serial}\n"
        f"ego: {ego}\nstore: {tmp_path / 'store'}\n"
    )
    result = sbt.run(study)
    assert set(result.frame["status"]) == {"ok"}
    assert result.frame[f"x.{name}"].nunique() > 1
    line = next(line for line in written.splitlines() if line.startswith("ego:"))
    with_settings = f"{line.replace('ego: ', 'ego: {id: ')}, {ego.removeprefix('{')}"
    (tmp_path / "inside.yaml").write_text(written.replace(line, with_settings))
    inside = ScenarioSpec(str(tmp_path / "inside.yaml")).resolve()
    assert name in inside.space.names
    space = inside.space
    ends = space.from_unit(np.array([[0.5] * (space.dimension - 1) + [at] for at in (0.01, 0.99)]))
    slow, fast = (inside.simulate(space.named(x), 1) for x in ends)
    assert not slow.identical(fast)


@pytest.mark.sumo
def test_settings_that_a_scene_leaves_out_are_refused():
    def without(values, ego, rng):
        return Scene((
            Actor("ego", ("road",), 1, 50.0, 20.0, ego.driver(rng, 20.0)),
            Actor("co", ("road",), 1, 55.0 + values["gap"], 15.0, Steady()),
        ))  # fmt: skip

    def given(values, ego, rng):
        return Scene((
            Actor("ego", ("road",), 1, 50.0, 20.0, ego.driver(rng, 20.0), ego.vehicle_type(VehicleType(), 20.0)),
            Actor("co", ("road",), 1, 55.0 + values["gap"], 15.0, Steady()),
        ))  # fmt: skip

    ego = {"kind": "sumo", "model": "IDM", "tau": 1.2}
    with pytest.raises(InputError, match=r"ego.vehicle_type.*but ego lacks carFollowModel.*tau"):
        _scenario(without).configured(ego).simulate({"gap": 30.0}, 1)
    near, far = (_scenario(given).configured({**ego, "tau": tau}).simulate({"gap": 30.0}, 1) for tau in (0.3, 3.0))
    assert not near.identical(far)
    assert _scenario(without).configured({"kind": "acc_aeb"}).simulate({"gap": 30.0}, 1).ended


@pytest.mark.sumo
def test_a_vehicle_that_the_network_stops_dead_is_no_outcome():
    """The acceleration lane ends, and a car that nothing makes change lanes stands still within a step."""

    def scene(values, ego, rng):
        return Scene((
            Actor("ego", ("merge", "after"), 1, 10.0, 20.0, ego.driver(rng, 20.0)),
            Actor("co", ("merge", "after"), 0, 80.0 + values["gap"], 20.0, Steady()),
        ))  # fmt: skip

    outcome = sbt.simulate(_scenario(scene, "on_ramp", duration=12.0), {"gap": 30.0}, seed=1)
    assert outcome.status == Status.FAILED
    assert outcome.reason.startswith("co must drive on along its route, but SUMO stopped it within a step, from 20 m/s, at t = ")
    assert "at the end of lane merge_0, from which its route (merge after) does not go on" in outcome.reason
    before = sbt.simulate(_scenario(scene, "on_ramp", duration=5.0), {"gap": 30.0}, seed=1)
    assert before.status == Status.OK

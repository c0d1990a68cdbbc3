"""Inputs that are profiles over time: curves, the inputs they stand for, and the vehicles that follow them."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from test_doors import files_of

from sbt.errors import InputError, RunError
from sbt.execution.spec import ScenarioSpec
from sbt.problem.outcome import Status
from sbt.problem.profile import KnotProfile, RecordedProfile, read_curve
from sbt.sumo.actors import State
from sbt.sumo.drivers import GivenSpeed

KNOTS = (0.0, 1.0, 4.0, 6.0)


@pytest.mark.parametrize("interpolate", ["linear", "pchip"])
def test_a_curve_goes_through_its_knots_without_overshoot(interpolate):
    rng = np.random.default_rng(5)
    profile = KnotProfile.of("v", KNOTS, 0, 30, "m/s", interpolate=interpolate)
    for _ in range(20):
        values = dict(zip([p.name for p in profile.parameters], rng.uniform(0, 30, 4).tolist(), strict=True))
        curve, at = profile.curve(values), np.linspace(-1, 8, 181)
        assert curve.at(np.array(KNOTS)) == pytest.approx(list(values.values()))
        assert curve.at(at[at < 0]) == pytest.approx(values["v_0"])
        assert curve.at(at[at > 6]) == pytest.approx(values["v_3"])
        for k, (a, b) in enumerate(pairwise(KNOTS)):
            ends = sorted((values[f"v_{k}"], values[f"v_{k + 1}"]))
            between = curve.at(at[(at >= a) & (at <= b)])
            assert between.min() >= ends[0] - 1e-9
            assert between.max() <= ends[1] + 1e-9


def test_a_rate_is_a_constraint_on_neighbours():
    from sbt.problem.expression import Expression

    profile = KnotProfile.of("v", (0, 2, 3), 0, 30, rate=(-8, 3))
    rules = [Expression(text) for text in profile.constraints]
    values = np.random.default_rng(1).uniform(0, 30, (500, 3))
    columns = {f"v_{k}": values[:, k] for k in range(3)}
    rate = np.diff(values, axis=1) / [2, 1]
    allowed = ((rate >= -8) & (rate <= 3)).all(axis=1)
    assert 0 < allowed.sum() < 500
    assert np.logical_and.reduce([rule(columns) for rule in rules]).tolist() == allowed.tolist()


def test_a_recorded_curve_is_deformed(tmp_path):
    path = tmp_path / "lead.csv"
    path.write_text("t;v\n10;20\n12;10\n14;16\n")
    curve = read_curve(path, "t", "v")
    make = {what: KnotProfile.of(what, (0, 1), 0.5, 2).parameters[0] for what in ("scale", "offset", "shift", "stretch")}
    profile = RecordedProfile("v", curve, tuple(make.items()))
    values = dict(zip([p.name for p in profile.parameters], (2.0, -1.0, 3.0, 0.5), strict=True))
    t = np.linspace(0, 8, 33)
    assert profile.curve(values).at(t) == pytest.approx(2.0 * curve.at((t - 3.0) / 0.5) - 1.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [("a,b\n1,2\n", "must be one of a, b"), ("t,v\n1,2\n", "two rows"), ("t,v\n1,2\n1,3\n", ":3: t must increase"),
     ("t,v\n1,2\n2,x\n", ":3: t and v must be numbers"), ("t,v\n1,2\n2,nan\n", ":3: t must increase and both be finite")],
)  # fmt: skip
def test_a_bad_recording_is_refused(tmp_path, text, words):
    (tmp_path / "lead.csv").write_text(text)
    with pytest.raises(InputError, match=words):
        read_curve(tmp_path / "lead.csv", "t", "v")


def test_a_driver_drives_the_curve():
    curve = KnotProfile.of("v", (0, 10), -10, 30).curve({"v_0": 10.0, "v_1": -10.0})
    driver, own = GivenSpeed(curve), State("co", 5.0, 1.8, 0.1)
    assert driver.act(1.9, own, ()).speed == pytest.approx(6.0)
    assert driver.act(9.0, own, ()).speed == 0.0


@pytest.fixture
def files(tmp_path: Path) -> Path:
    files_of("own_files", tmp_path)
    return tmp_path / "profile.yaml"


def traced(path: Path, **values: float):
    scenario = ScenarioSpec(str(path)).resolve()
    return scenario.simulate(scenario.space.values(values), 0)


@pytest.mark.sumo
def test_the_vehicle_has_the_speed_of_the_profile(files):
    trace = traced(files, gap=40, v_lead_0=25, v_lead_1=20, v_lead_2=8, v_lead_3=12)
    knots = np.interp(trace.time, [0, 2, 4, 8], [25, 20, 8, 12])
    lead = trace.actor("lead")
    assert lead.speed == pytest.approx(knots, abs=1e-9)
    assert np.diff(lead.x) == pytest.approx(0.1 * lead.speed[1:], abs=1e-6)  # SUMO's Euler steps


@pytest.mark.sumo
def test_an_acceleration_begins_from_the_speed_that_is_there(files):
    text = files.read_text().replace("actors: {lead: {speed: v_lead}}", "actors: {lead: {acceleration: v_lead}}")
    files.write_text(text.replace("rate: [-8, 3]", "interpolate: linear").replace("min: 0, max: 30", "min: -8, max: 3"))
    routes = files.with_name("follow.rou.xml")
    routes.write_text(routes.read_text().replace("${v_lead_0}", "25"))
    trace = traced(files, gap=40, v_lead_0=0, v_lead_1=-6, v_lead_2=0, v_lead_3=2)
    t = trace.time
    speed = np.concatenate([[25.0], 25.0 + np.cumsum(0.1 * np.interp(t[:-1] + 0.05, [0, 2, 4, 8], [0, -6, 0, 2]))])
    assert trace.actor("lead").speed == pytest.approx(speed, abs=1e-9)


@pytest.mark.sumo
def test_a_vehicle_that_drives_another_speed_is_no_data(files):
    routes = files.with_name("follow.rou.xml")
    routes.write_text(routes.read_text().replace('departSpeed="${v_lead_0}"', 'departSpeed="5"'))
    words = "'lead' must begin with the speed of the profile v_lead, 25 m/s, but it drives 5"
    with pytest.raises(RunError, match=words) as failed:
        traced(files, v_lead_0=25)
    assert failed.value.status is Status.INVALID


@pytest.mark.sumo
def test_a_loop_finds_the_curve(tmp_path):
    files_of("traci_loop", tmp_path)
    loop, path = tmp_path / "loop.py", tmp_path / "scenario.yaml"
    loop.write_text(loop.read_text().replace("reaction =", 'sumo.vehicle.setSpeed("lead", values["v"](1.0))\n    reaction ='))
    path.write_text(path.read_text().replace("ego: ego", "  v: {profile: {knots: [0, 2]}, min: 5, max: 30}\nego: ego"))
    trace = traced(path, v_0=24, v_1=26.5)
    assert trace.actor("lead").speed[1] == pytest.approx(25.25)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("knots: [0, 2, 4, 8]", "knots: [0]", "profile.yaml:4:11: inputs.v_lead: profile v_lead: knots must be two or more"),
        ("knots: [0, 2, 4, 8]", "file: no.csv", "inputs.v_lead.profile.rate: rate is for a profile without a file"),
        ("rate: [-8, 3]", "scale: {min: 0, max: 1}", "scale deforms a recorded profile"),
        ("min: 0, max: 30, ", "", "must have knots: .* with min and max"),
        ("speed: v_lead", "speed: v_led", "a profile must be one of v_lead, but got 'v_led' .did you mean 'v_lead'"),
        ("lead: {speed", "leed: {speed", "an actor must be one of lead, ego, but got 'leed'"),
        ("lead: {speed", "ego: {speed", "the ego has a driver"),
        ("{speed: v_lead}", "{}", "an actor must have a speed or an acceleration"),
        ("actors: {lead: {speed: v_lead}}", "", r"a profile may be followed instead: actors: {ID: {speed: v_lead}}"),
    ],
)
def test_mistakes_are_reported_with_their_place(files, old, new, words):
    text = files.read_text()
    assert old in text
    files.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=words):
        ScenarioSpec(str(files)).resolve()

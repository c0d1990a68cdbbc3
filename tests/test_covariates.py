"""What the seed draws is known before the run: projections, pairs of inputs and seed, and what stays honest."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sbt
from sbt.config.scenario_file import from_file
from sbt.errors import InputError
from sbt.plugins import Scope, load
from sbt.problem.covariates import Covariates, telling_all
from sbt.seeds import stream
from sbt.sumo.actors import Actor, VehicleType
from sbt.sumo.projecting import Arrivals, arrivals_at, crossing_of, driver_value, first_gap, gaps, taken_gap, time_to_reach
from sbt.workflows.drawn import covariates_first
from sbt.workflows.study import Study

NAMES = ("crossing_pedestrian", "highway_merge", "roundabout_entry", "unprotected_left_turn")


def car(k: int, position: float, speed: float, **attributes: float | str) -> Actor:
    kind = VehicleType(attributes=tuple((name, str(value)) for name, value in attributes.items()))
    return Actor(f"car_{k}", ("a",), 0, position, speed, type=kind)


def test_time_to_reach_solves_the_motion() -> None:
    for d in (0.0, 5.0, 40.0, 300.0):
        t = float(time_to_reach(d, 8.0, 20.0, 2.0))
        rise = min(t, 6.0)
        assert 8.0 * rise + rise**2 + 20.0 * (t - rise) == pytest.approx(d)
    assert float(time_to_reach(100.0, 20.0, 10.0, 2.0)) == 10.0, "a lower speed is taken at once"
    assert float(time_to_reach(-20.0, 10.0, 20.0, 2.0)) == -2.0


def test_who_is_faster_queues_behind_who_is_slower_and_leaves_the_foremost_alone() -> None:
    slow, fast = car(0, 100.0, 10.0, speedFactor=0.7, sigma=0), car(1, 60.0, 20.0, speedFactor=1.5, sigma=0, tau=1)
    alone = arrivals_at(900.0, [slow], 14.0)
    both = arrivals_at(900.0, [slow, fast], 14.0)
    assert both.time[0] == alone.time[0]
    assert both.time[1] - both.time[0] >= 1.0
    assert both.speed[1] == both.speed[0]


@pytest.mark.parametrize("text", ["norm(1,0.3)", "norm(1.1)", "normc(1,0.3,0.2,2)", "normc(1,1,0.9,2)", "normc(1,1,0.9)", "1.2"])
def test_what_sumo_draws_of_a_type_counts_with_its_mean(text: str) -> None:
    mean, deviation, low, high = (*map(float, text.strip("normc()").split(",")), *(0.0, -9.0, 9.0)[text.count(",") :])
    drawn = mean + deviation * stream(1, "factors").standard_normal(400_000)
    drawn = drawn[(drawn >= low) & (drawn <= high)]
    given = driver_value(car(0, 0.0, 10.0, speedFactor=text), "speedFactor", 7.0)
    assert given == pytest.approx(drawn.mean(), abs=5e-3)
    there, same = (arrivals_at(300.0, [car(0, 10.0, 10.0, speedFactor=each)], 14.0) for each in (text, given))
    assert (there.time, there.speed) == (same.time, same.speed)


@pytest.mark.parametrize("text", ["off", "nan", "inf", "-inf", "", "norm(inf,1)", "normc(1,0.1,3,4)", "normc(1,0,1,1)", "norm(1"])
def test_no_text_of_an_attribute_stops_a_projection(text: str) -> None:
    assert math.isfinite(driver_value(car(0, 0.0, 10.0, impatience=text), "impatience", 0.0))
    queue = [car(k, 100.0 - 20.0 * k, 10.0, **{name: text}) for k, name in enumerate(("sigma", "accel", "tau", "minGap"))]
    there = arrivals_at(300.0, queue, 14.0, fastest=50.0)
    assert np.isfinite([there.time, there.speed]).all()


def test_the_first_gap_is_the_first_one_that_is_long_enough() -> None:
    rng = stream(3, "gaps")
    for _ in range(50):
        arrivals = Arrivals(np.sort(rng.uniform(-10.0, 40.0, 8)), rng.uniform(5.0, 20.0, 8))
        ready, length = rng.uniform(-5.0, 20.0), rng.uniform(1.0, 9.0)
        found = first_gap(arrivals, ready, length)
        begin = ready + found["wait"]
        inside = (arrivals.time > begin + 1e-9) & (arrivals.time < begin + min(found["gap"], length) - 1e-9)
        assert not inside.any()
        assert begin == pytest.approx(ready) or np.isclose(arrivals.time, begin).any()
        earlier = [ready, *arrivals.time[(arrivals.time > ready) & (arrivals.time < begin - 1e-9)]]
        ends = [min(t for t in arrivals.time if t > s + 1e-12) for s in earlier] if found["wait"] > 0 else []
        assert all(end - start <= length + 1e-9 for start, end in zip(earlier, ends, strict=False))
        assert found["closing"] in (0.0, *arrivals.speed)
    assert gaps(Arrivals(np.empty(0), np.empty(0)), 5.0)["since"] == 30.0, "nobody comes"


def test_the_gap_that_is_taken_is_the_first_that_suits_once_nobody_is_in_the_way() -> None:
    rng = stream(4, "taken")
    for _ in range(50):
        n = int(rng.integers(0, 9))
        arrivals = Arrivals(np.cumsum(rng.uniform(1.6, 9.0, n)) - 10.0, np.full(n, 12.0))
        ready, need = rng.uniform(-5.0, 20.0), np.full(n, rng.uniform(1.0, 7.0))
        found = taken_gap(arrivals, ready, need, -12.0, 6.0)
        go = ready + found["wait"]
        in_the_way = (arrivals.time + 0.5 > go + 1e-9) & (arrivals.time - 1.0 < go - 1e-9)
        assert not (in_the_way & (arrivals.time - 1.0 < go + need - 1e-9)).any()
        later = arrivals.time[arrivals.time + 0.5 > go + 1e-9]
        assert found["until"] == pytest.approx(min(later[0] - go, 12.0) if len(later) else 12.0)
        assert found["missed"] == -12.0 if found["wait"] == 0.0 else found["missed"] <= 0.0
        assert found["slack"] > 0.0


def test_a_left_turn_knows_its_pet_roughly() -> None:
    scenario = load("scenarios", "unprotected_left_turn")
    covariates = Covariates.of(scenario)
    assert covariates is not None
    x = scenario.space.from_unit(stream(5, "left").random((60, scenario.space.dimension)))
    told = covariates.at(x, range(60))[:, covariates.names.index("likely_pet")]
    found = [scenario.measure(scenario.simulate(scenario.space.named(row), k))["pet_ego_first"] for k, row in enumerate(x)]
    assert np.corrcoef(told, found)[0, 1] > 0.6


def test_paths_cross_where_they_come_near_and_oncoming_lanes_do_not() -> None:
    s = np.arange(0.0, 100.0)
    east, north = np.column_stack([s, 0 * s]), np.column_stack([0 * s + 40.0, s - 50.0])
    west = np.column_stack([100.0 - s, 0 * s + 3.5])
    found = crossing_of(east, north, lambda cosine: 2.5)
    assert found is not None
    assert found == pytest.approx((38.0, 50.0), abs=3.0)
    assert crossing_of(east, west, lambda cosine: 1.5 if cosine < 0 else 4.5) is None


@pytest.mark.parametrize("name", NAMES)
def test_covariates_are_finite_numbers_of_the_pair_alone(name: str) -> None:
    scenario = load("scenarios", name)
    x = scenario.space.from_unit(stream(1, name).random((12, scenario.space.dimension)))
    general = telling_all(replace(scenario, simulate=replace(scenario.simulate, covariates=None)))
    for told in (scenario, general):
        found, again = Covariates.of(told), Covariates.of(told)
        assert found is not None
        assert again is not None
        here = found.at(x, range(12))
        assert np.array_equal(here, again.at(x[::-1], range(12)[::-1])[::-1])
        assert (here.std(axis=0) > 0).any()
        assert (found.at(x[[0] * 8], range(8)).std(axis=0) > 0).any(), "the seed draws something"


class Crossing:
    """Critical where `a` is near 0.7 and the one car that the seed draws comes within a tenth of the time."""

    def __call__(self, values: dict[str, float], seed: int) -> dict[str, float]:
        late, noise = stream(seed, "car").random(), 0.02 * stream(seed, "driver").standard_normal()
        return {"gap": 4.0 * abs(values["a"] - 0.7) + 3.0 * abs(late - 0.5) + noise - 0.2}

    def known_before(self, values: dict[str, float], seed: int) -> dict[str, float]:
        return {"late": stream(seed, "car").random()}


def scenario_of(source: object) -> sbt.Scenario:
    inputs = [sbt.Parameter("a", 0, 1), sbt.Parameter("b", 0, 1)]
    return sbt.Scenario("one_car", inputs, sbt.Requirement("gap", high=0.0), evaluate=source)


def run(folder: Path, **keys: object) -> sbt.Result:
    given = {"campaign": "falsification", "scenario": scenario_of(Crossing()), "seed": 1, "budget": 80, "report": False}
    return sbt.run(**{**given, "executor": "serial", "metamodel": "et", "store": folder, **keys})


def test_pairs_find_more_distinct_traffic_and_only_drawn_seeds_tell_rates(tmp_path: Path) -> None:
    whole = run(tmp_path / "whole", budget=40)
    pairs, history = whole.frame, whole.history
    searched = pairs[pairs.stage != "confirm"]
    random = [Crossing()({"a": stream(5, k).random(), "b": 0.0}, k)["gap"] <= 0.0 for k in range(2000)]
    assert int(searched.critical.sum()) >= 5 * max(40 * np.mean(random), 1.0)
    assert searched.seed.is_unique
    assert set(pairs[pairs.seed_chosen].stage) == {"search"}
    assert not history.training.columns["seed_chosen"].any()
    assert whole.conclusion.simulator_noise.noisy
    run(tmp_path / "parts", budget=20)
    parts = run(tmp_path / "parts", budget=40).frame
    early = (frame[(frame.iteration < 2) & (frame.stage != "confirm")] for frame in (parts, pairs))
    first, same = (frame[["x.a", "seed", "y.gap", "seed_chosen"]] for frame in early)
    assert first.equals(same), "a search that stopped and went on has the same pairs"


def test_seeds_are_not_looked_at_where_that_is_switched_off_or_a_store_was_begun_without(tmp_path: Path) -> None:
    off = run(tmp_path / "off", budget=20, covariates=False)
    assert not off.frame.seed_chosen.any()
    found = Study.from_mapping({"campaign": "falsification", "scenario": "unprotected_left_turn"}, name="", scope=Scope(tmp_path))
    assert found.covariates is not None
    assert replace(found, kept={"names": []}).covariates is None
    assert replace(found, kept={"covariate_names": list(found.covariates.names)}).covariates is not None


def test_what_cannot_be_told_is_said(tmp_path: Path) -> None:
    plain = scenario_of(lambda values, seed: {"gap": values["a"]})
    with pytest.raises(InputError, match="covariates: true needs a scenario whose traffic is drawn before the run"):
        run(tmp_path / "plain", scenario=plain, covariates=True)
    endless = Crossing()
    endless.known_before = lambda values, seed: {"late": float("inf")}  # type: ignore[method-assign]
    with pytest.raises(InputError, match="covariate late must be finite, but is inf at a="):
        run(tmp_path / "endless", scenario=scenario_of(endless))
    endless.known_before = lambda values, seed: {"late": -1e31}  # type: ignore[method-assign]
    with pytest.raises(InputError, match=r"covariate late must be within ±1e\+30, .* but is -1e\+31 at a="):
        run(tmp_path / "large", scenario=scenario_of(endless))
    text, rows = {"late": "a"}, [1.0]
    for told, said in ((text, "covariate late must be a number, but is 'a' at a="), (rows, "must return numbers by name")):
        endless.known_before = lambda values, seed, told=told: told  # type: ignore
        with pytest.raises(InputError, match=said):
            Covariates.of(scenario_of(endless))


def test_check_finds_covariates_that_depend_on_what_was_run() -> None:
    jobs = [({"a": 0.1 * k, "b": 0.5}, k) for k in range(4)]
    good, seen = Crossing(), Crossing()
    ran: list[int] = []
    seen.known_before = lambda values, seed: {"late": float(seed in ran)}  # type: ignore[method-assign]
    for source, ok in ((good, True), (seen, False)):
        ran.clear()
        again = covariates_first(scenario_of(source), jobs)
        ran.extend(seed for _, seed in jobs)
        (finding,) = again()
        assert finding.ok is ok
    assert "late of the same pairs differ" in finding.detail
    seen.known_before = lambda values, seed: {"late": math.nan if seed == 150 else 1.0}  # type: ignore[method-assign]
    (finding,) = covariates_first(scenario_of(seen), jobs)()
    assert not finding.ok
    assert "must be finite, but is nan" in finding.detail
    assert "seed 150" in finding.detail


def test_a_coverage_states_what_inputs_and_traffic_explain(tmp_path: Path) -> None:
    found = run(tmp_path / "even", campaign="coverage", budget=150).conclusion.explained
    assert found.inputs + found.traffic + found.rest == pytest.approx(1.0)
    assert 0.2 < found.traffic < 0.7
    assert found.rest < 0.1


LOOP = """
def traffic(rng):
    return rng.exponential(6.0, 3).cumsum()

def simulate(sumo, values, rng):
    arrivals = traffic(rng)
    sumo.start(["sumo", "-n", "my.net.xml"])

def covariates(values, rng):
    return {"first": traffic(rng)[0] - values["gap"]}

LENGTH = 3.0
"""
SCENARIO = """
simulate: loop.py:simulate
covariates: {covariates}
ego: ego
inputs: {{gap: {{min: 1, max: 3}}}}
duration: 10
metrics: [ttc_path_min]
requirement: {{metric: ttc_path_min, critical: [-.inf, 1.0]}}
"""


def test_a_scenario_file_names_the_covariates_of_its_loop(tmp_path: Path) -> None:
    (tmp_path / "loop.py").write_text(LOOP)
    path = tmp_path / "scenario.yaml"
    drawn = stream(7, "loop").exponential(6.0, 3).cumsum()[0]
    for right in ("loop.py:covariates", "auto"):
        path.write_text(SCENARIO.format(covariates=right))
        found = Covariates.of(from_file(str(path), tmp_path))
        assert found is not None
        assert found.names == ("first",)
        assert found.at(np.array([[2.0]]), [7])[0, 0] == drawn - 2.0, "what the loop's generator draws first"
    for wrong, said in (
        ("own", "covariates must be auto or file.py:NAME"),
        ("loop.py:LENGTH", "must be a function covariates"),
        ("loop.py:covariate", "covariates"),
    ):
        path.write_text(SCENARIO.format(covariates=wrong))
        with pytest.raises(InputError, match=f"scenario.yaml:3:.*{said}"):
            from_file(str(path), tmp_path)


def test_the_general_set_knows_when_a_person_crosses_the_way_of_ego() -> None:
    scenario = load("scenarios", "crossing_pedestrian")
    general = Covariates.of(telling_all(replace(scenario, simulate=replace(scenario.simulate, covariates=None))))
    own = Covariates.of(scenario)
    assert general is not None
    assert own is not None
    x = scenario.space.from_unit(stream(2, "persons").random((60, scenario.space.dimension)))
    here, lane = general.at(x, range(60)), own.at(x, range(60))[:, own.names.index("lane")]
    past, coming = (here[:, general.names.index(name)] for name in ("person_since", "person_next_1"))
    told = np.where(lane <= 0.0, -past, coming)
    assert np.median(np.abs(told - lane)) < 1.5, "the time between ego and the pedestrian at the lane"
    assert np.corrcoef(told, lane)[0, 1] > 0.8


class Counting:
    """Its covariates depend on how often they were computed."""

    calls = 0

    def __call__(self, values: dict[str, float], seed: int) -> dict[str, float]:
        return {"y": values["a"] + stream(seed, "y").random()}

    def known_before(self, values: dict[str, float], seed: int) -> dict[str, float]:
        self.calls += 1
        return {"late": stream(seed, "y").random() + 0.01 * self.calls}


def test_covariates_that_change_stop_the_campaign(tmp_path: Path) -> None:
    scenario = sbt.Scenario("counting", [sbt.Parameter("a", 0, 1)], sbt.Requirement("y", high=0.1), evaluate=Counting())
    with pytest.raises(InputError, match="the same whenever they are computed, but late of seed"):
        sbt.run(
            campaign="falsification", scenario=scenario, budget=40, seed=1, executor="serial", report=False, store=tmp_path / "s"
        )


DRAWN = """
import sbt
from sbt.sumo.actors import Actor, Scene, VehicleType
from sbt.sumo.simulation import SumoSimulation

INPUTS, NEED = [sbt.Parameter("v", 10, 24, "m/s")], sbt.Requirement("ttc_min", high=1.0)

def scene(values, ego, rng):
    kind = VehicleType(attributes=(("speedFactor", "normc(1,0.1,0.8,1.2)"),))
    return Scene((
        Actor("ego", ("road",), 1, 50.0, values["v"], ego.driver(rng, values["v"]), ego.vehicle_type(VehicleType(), values["v"])),
        Actor("co", ("road",), 1, 90.0 + rng.uniform(0.0, 20.0), 20.0, type=kind),
    ))

def raising(values, scene):
    raise LookupError("no such car")

def scenario(covariates=None):
    simulate = SumoSimulation(net="straight", scene=scene, duration=0.5, step_length=0.1, covariates=covariates)
    return sbt.Scenario("drawn", INPUTS, NEED, simulate=simulate, metrics=["ttc_min"])

def evaluate(values, seed):
    return {"ttc_min": values["v"]}

PLAIN, OWN = scenario(), scenario(raising)
TELLS_NONE = sbt.Scenario("none", INPUTS, NEED, evaluate=evaluate, metrics=["ttc_min"])
"""


@pytest.mark.sumo
@pytest.mark.parametrize(
    ("scenario", "asked", "said"),
    [
        ("PLAIN", "true", "covariates of 3 pairs, the same before and after them"),
        ("OWN", "auto", "no such car"),
        ("OWN", "false", None),
        ("TELLS_NONE", "true", "covariates: true needs a scenario whose traffic is drawn before the run"),
    ],
)
def test_check_of_a_configuration_proves_what_the_campaign_looks_at(tmp_path: Path, scenario: str, asked: str, said: str | None):
    (tmp_path / "drawn.py").write_text(DRAWN)
    (tmp_path / "c.yaml").write_text(f"campaign: falsification\nscenario: drawn.py:{scenario}\nbudget: 30\ncovariates: {asked}\n")
    found = [f for f in sbt.check(tmp_path / "c.yaml").findings if f.rule == "covariates are known before the run"]
    assert [f.ok for f in found] == ([] if said is None else [scenario == "PLAIN"])
    assert said is None or said in found[0].detail

"""What `sbt.run` and `sbt.simulate` return goes through a pickle, as a pool of processes needs it, and answers as before."""

from __future__ import annotations

import pickle
import threading
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sbt


def again(value: Any) -> Any:
    """Return what a pickle makes of a value, twice, as results are passed on."""
    return pickle.loads(pickle.dumps(pickle.loads(pickle.dumps(value))))


def gap_of(values: dict[str, Any], seed: int) -> dict[str, float]:
    return {"gap": values["a"] - 2.0 if values["kind"] == "car" else values["a"]}


def scenario_of(requirement: Any = None, **more: Any) -> sbt.Scenario:
    """Return a scenario with code that no other process can import."""
    offset = 0.0
    inputs = [sbt.Parameter("a", 0, 10, "m", sbt.Normal(5, 2)), sbt.Parameter("kind", choices=["car", "truck"])]
    space = sbt.ParameterSpace(inputs, constraints=(("mine", lambda x: x["a"] >= offset),))
    need = sbt.Requirement("gap", high=1.0) if requirement is None else requirement
    return sbt.Scenario("mine", space, need, evaluate=lambda v, s: {"gap": gap_of(v, s)["gap"] + offset}, **more)


def told(run: sbt.Run) -> tuple[Any, ...]:
    return run.to_dict(), run.margin, repr(run), run.concrete, run.unconfirmed, run.status, dict(run.inputs)


def test_a_run_is_the_same_behind_a_pickle() -> None:
    run = sbt.simulate(scenario_of(), {"a": 2.5, "kind": "car"}, seed=3)
    assert told(again(run)) == told(run)
    assert again(run).critical is True
    with pytest.raises(sbt.InputError, match="gives its metrics directly") as before:
        _ = run.trace
    with pytest.raises(sbt.InputError) as after:
        _ = again(run).trace
    assert str(after.value) == str(before.value)
    either = sbt.any_of(sbt.Requirement("gap", high=1.0, name="near"), sbt.Requirement("far", low=3.0))
    other = sbt.Scenario("two", [sbt.Parameter("a", 0, 1)], either, evaluate=lambda v, s: {"gap": 0.5, "far": np.inf})
    run = sbt.simulate(other, {"a": 0.5})
    assert told(again(run)) == told(run)
    bad = sbt.Scenario("bad", [sbt.Parameter("a", 0, 1)], sbt.Requirement("y", high=0.0), evaluate=lambda v, s: {})
    failed = sbt.simulate(bad)
    assert told(again(failed)) == told(failed)
    assert (again(failed).critical, again(failed).reason) == (None, failed.reason)


@pytest.mark.sumo
def test_a_run_of_a_pool_has_its_trace() -> None:
    here = sbt.simulate("cut_in", {"d_v": 60.0}, seed=1)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        there = pool.submit(sbt.simulate, "cut_in", {"d_v": 60.0}, seed=1).result()
    seconds = {"seconds": 0.0}
    assert there.to_dict() | seconds == here.to_dict() | seconds
    assert there.trace.equals(here.trace)


def test_a_result_is_its_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    keys = {"executor": "serial", "report": False, "seed": 1, "budget": 30, "metamodel": "et"}
    result = sbt.run(campaign="coverage", scenario=scenario_of(), store="s", **keys)
    at = {"a": [1.0, 4.0], "kind": ["car", "truck"]}
    predicted = result.predict(at)
    assert result.fitted is not None
    monkeypatch.chdir("/")
    found = again(result)
    assert Path(found.store) == tmp_path / "s"
    assert found.frame.equals(result.frame)
    assert found.conclusion == result.conclusion
    assert found.sentences() == result.sentences()
    assert found.predict(at).equals(predicted)
    with pytest.raises(sbt.InputError, match="trace"):
        found.trace(3)


def test_of_a_result_stays_behind_what_cannot_travel(tmp_path: Path) -> None:
    lock = threading.Lock()

    def evaluate(values: dict[str, Any], seed: int) -> dict[str, float]:
        with lock:
            return {"y": values["a"]}

    scenario = sbt.Scenario("locked", [sbt.Parameter("a", 0, 1)], sbt.Requirement("y", high=0.1), evaluate=evaluate)
    result = sbt.run(campaign="coverage", scenario=scenario, budget=8, executor="serial", report=False, store=tmp_path / "s")
    assert again(result).frame.equals(result.frame)

"""Scenarios by value: what a script defines runs in workers as it does in the script."""

from __future__ import annotations

import pickle
import subprocess
import sys
import textwrap
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from studies import by_index

from sbt.errors import InputError
from sbt.execution.carrying import carry
from sbt.execution.local import LocalExecutor
from sbt.execution.protocol import SerialExecutor
from sbt.execution.spec import ScenarioSpec
from sbt.plugins import load
from sbt.problem.outcome import Job
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace

SCRIPT = '''
import numpy as np
import beside
from sbt.execution.carrying import carry
from sbt.execution.local import LocalExecutor
from sbt.execution.protocol import SerialExecutor
from sbt.execution.spec import ScenarioSpec
from sbt.problem.outcome import Job
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import CriticalInterval, Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace

shift, table = 0.25, np.arange(10.0)

class Model:
    def __init__(self, factor):
        self.factor = factor

    def __call__(self, a):
        return beside.half(a) * self.factor + shift

def make(factor):
    model = Model(factor)
    space, need = ParameterSpace((Parameter("a", 0.0, 1.0),)), Requirement("y", high=0.0)
    evaluate = lambda values, seed: {"y": model(values["a"]) + float(table[seed % 10])}
    return LogicalScenario("mine", space, need, evaluate=evaluate, metric_names=("y",))

data = carry(make(3.0))
spec, jobs = ScenarioSpec("mine", carried=data), [Job(k, {"a": k / 20}, k) for k in range(20)]
assert spec.resolve() is spec.resolve()

def run(executor):
    with executor:
        return {o.index: (str(o.status), dict(o.metrics), o.reason) for o in executor.run(jobs)}

expected = {k: ("ok", {"y": k / 20 / 2 * 3.0 + 0.25 + float(k % 10)}, "") for k in range(20)}
assert run(SerialExecutor(spec)) == run(LocalExecutor(spec, 2)) == expected
print(len(data))
'''


def in_process(folder: Path, *arguments: str, text: str | None = None) -> str:
    done = subprocess.run([sys.executable, *arguments], input=text, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("how", ["file", "stdin"])
def test_a_script_carries_closures_lambdas_and_the_modules_beside_it(tmp_path: Path, how: str):
    """And without `if __name__ == "__main__"`, as in a notebook."""
    (tmp_path / "beside.py").write_text("def half(a):\n    return a / 2\n")
    (tmp_path / "script.py").write_text(SCRIPT)
    out = in_process(tmp_path, "script.py") if how == "file" else in_process(tmp_path, "-", text=SCRIPT)
    assert int(out) < 20_000


def scenario(evaluate: Callable[..., Any]) -> LogicalScenario:
    space, need = ParameterSpace((Parameter("a", 0.0, 1.0),)), Requirement("y", high=0.0)
    return LogicalScenario("mine", space, need, evaluate=evaluate, metric_names=("y",))


class Controller:
    def __init__(self, part: Any):
        self.parts = {"deep": [1, part]}


OWN_FILE = """
import threading
FILE = open(__file__)

def uses_a_global(values, seed):
    return {"y": float(len(FILE.name))}

def has_a_default(values, seed, lock=threading.Lock()):
    return {"y": 1.0}
"""


def closures(folder: Path) -> list[tuple[Callable[..., Any], str]]:
    """Return functions that cannot leave this process, and what the error says of each."""
    import libsumo

    (folder / "own.py").write_text(OWN_FILE)
    lock, controller, log = threading.Lock(), Controller(threading.Lock()), (folder / "own.py").open()

    handle = libsumo.TraCIException("a handle of SUMO")
    return [
        (lambda values, seed: {"y": float(lock.locked())}, r"variable 'lock' of \S+ \(\S+:\d+\) is a lock"),
        (
            lambda values, seed: {"y": float(len(controller.parts))},
            r"item 1 of item 'deep' of attribute 'parts' of Controller \(variable 'controller' of \S+ \(\S+\)\) is a lock",
        ),
        (lambda values, seed: {"y": float(log.closed)}, r"variable 'log' of .* is a TextIOWrapper .*an open file belongs to its"),
        (lambda values, seed: {"y": float(handle is None)}, r"attribute 'this' of TraCIException .* is a SwigPyObject"),
        (
            load("scenarios", f"{folder}/own.py:uses_a_global"),
            r"variable 'FILE' of uses_a_global \(\S+own.py:5\) is a TextIOWrapper",
        ),
        (load("scenarios", f"{folder}/own.py:has_a_default"), r"default 0 of has_a_default \(\S+own.py:8\) is a lock"),
    ]


@pytest.mark.sumo
@pytest.mark.parametrize("case", range(6))
def test_what_cannot_leave_the_process_is_named(case: int, tmp_path: Path):
    evaluate, what = closures(tmp_path)[case]
    rule = "a scenario must be made of plain data and code to reach its workers, but in scenario mine "
    with pytest.raises(InputError, match=rule + what + r".*; make such an object inside the function that uses it"):
        carry(scenario(evaluate))


def test_modules_are_carried_by_name_again_afterwards(analytic: Path):
    from sbt.execution.carrying import _cloudpickle

    before = _cloudpickle().list_registry_pickle_by_value()
    data = carry(load("scenarios", f"{analytic}:SCENARIO"))
    assert _cloudpickle().list_registry_pickle_by_value() == before
    analytic.unlink()
    name = ScenarioSpec("disc", carried=data)
    jobs = [Job(k, {"a": k / 4, "b": 0.5}, k) for k in range(4)]
    with LocalExecutor(name, 1) as local, SerialExecutor(name) as serial:
        assert by_index(local.run(jobs)) == by_index(serial.run(jobs))


@pytest.mark.sumo
def test_choices_apply_to_what_is_carried_as_to_what_is_named(tmp_path: Path):
    (tmp_path / "mine.py").write_text("def farthest(trace):\n    return float(trace.x.max())\n")
    choices = ({"kind": "acc_aeb"}, "fresh", 0.1, "G[0,20](gap > 2)", (), ("mine.py:farthest",))
    named = ScenarioSpec("cut_in", str(tmp_path), *choices)
    carried = replace(named, name="of a script", carried=carry(load("scenarios", "cut_in")))
    jobs = [Job(k, {"d_v": 10.0 + 20 * k, "d_t": 1.0}, k) for k in range(4)]
    with SerialExecutor(named) as one, SerialExecutor(carried) as other:
        first, second = (by_index(executor.run(jobs)) for executor in (one, other))
    assert first == second
    assert {o.status for o in first.values()} == {"ok"}
    assert {"stl", "farthest", "conflict_type"} <= set(first[0].metrics)


def test_what_arrives_broken_is_told():
    with pytest.raises(InputError, match="scenario mine must be loadable in its worker, but loading it raised"):
        ScenarioSpec("mine", carried=b"no pickle").resolve()
    with pytest.raises(InputError, match="a scenario must be a LogicalScenario, but 'mine' is a int"):
        ScenarioSpec("mine", carried=pickle.dumps(3)).resolve()


def test_a_large_scenario_goes_to_each_worker_once(tmp_path: Path):
    """Not with every chunk: the tasks of a pool name a folder and hold jobs."""
    text = textwrap.dedent(
        """
        import numpy as np, pickle
        from sbt.execution import local
        from tests_scenario import make
        from sbt.execution.carrying import carry
        from sbt.execution.spec import ScenarioSpec
        from sbt.problem.outcome import Job

        spec = ScenarioSpec("large", carried=carry(make()))
        sizes = []
        with local.LocalExecutor(spec, 2) as executor:
            submit = executor._pool.submit
            def counted(*task):
                sizes.append(len(pickle.dumps(task)))
                return submit(*task)
            executor._pool.submit = counted
            assert {o.status for o in executor.run([Job(k, {"a": 0.5}, k) for k in range(100)])} == {"ok"}
        print(len(spec.carried), max(sizes))
        """
    )
    (tmp_path / "tests_scenario.py").write_text(
        "import numpy as np\nfrom sbt.problem.parameter import Parameter\nfrom sbt.problem.requirement import *\n"
        "from sbt.problem.scenario import LogicalScenario\nfrom sbt.problem.space import ParameterSpace\n\n\n"
        "def make():\n    table, space = np.arange(1e6), ParameterSpace((Parameter('a', 0.0, 1.0),))\n"
        "    return LogicalScenario('large', space, Requirement('y', high=0.0),\n"
        "        evaluate=lambda v, s: {'y': float(table[s])}, metric_names=('y',))\n"
    )
    (tmp_path / "script.py").write_text(text)
    carried, largest = map(int, in_process(tmp_path, "script.py").split())
    assert carried > 8e6
    assert largest < 10_000

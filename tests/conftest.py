"""What several tests share: an analytic scenario in a file of its own, and campaigns of it."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

settings.register_profile("fixed", derandomize=True, deadline=None)  # the same examples every time
settings.load_profile("fixed")

NO_SUMO = Path(__file__).resolve().parent / "no_sumo"
"""A folder with a libsumo that cannot be imported."""
NO_SUMO_LOG = "SBT_NO_SUMO_LOG"
"""Environment variable: the file to which that libsumo adds a byte whenever somebody tries."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--no-sumo", action="store_true", help="only tests that do not run SUMO; libsumo cannot be imported")


def pytest_configure(config: pytest.Config) -> None:
    """Let programs that tests start be interrupted, and hide libsumo from them and from this process where it is asked for."""
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT):  # background jobs and nohup ignore them, and pass that on
        if signal.getsignal(number) == signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    if config.getoption("--no-sumo"):
        sys.path.insert(0, str(NO_SUMO))
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(NO_SUMO), os.environ.get("PYTHONPATH")]))
        handle, os.environ[NO_SUMO_LOG] = tempfile.mkstemp(prefix="no_sumo_")
        os.close(handle)


def pytest_unconfigure(config: pytest.Config) -> None:
    if config.getoption("--no-sumo"):
        Path(os.environ.pop(NO_SUMO_LOG)).unlink()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--no-sumo"):
        of_sumo = [item for item in items if item.get_closest_marker("sumo")]
        config.hook.pytest_deselected(items=of_sumo)
        items[:] = [item for item in items if item not in of_sumo]


@pytest.fixture(autouse=True, scope="session")
def _approvals(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep approvals of code out of the folder of who runs the tests, and theirs out of the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        patch.delenv("SBT_TRUST", raising=False)
        yield


@pytest.fixture(autouse=True)
def _without_sumo() -> Iterator[None]:
    """Fail a test that wanted SUMO under `--no-sumo`, also where it took the failed runs for granted."""
    log = Path(os.environ.get(NO_SUMO_LOG, os.devnull))
    before = log.stat().st_size
    yield
    if log.stat().st_size > before:
        pytest.fail("this test runs SUMO and must be marked with @pytest.mark.sumo")

ANALYTIC = '''
"""A disc of radius 0.3 in the unit square (pi 0.09 of it is critical), a line, and things that go wrong."""

import dataclasses
import os
import time
from pathlib import Path

import numpy as np

from sbt.errors import RunError
from sbt.metamodels.prediction import Prediction
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import CriticalInterval, Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace

SQUARE = ParameterSpace((Parameter("a", 0.0, 1.0), Parameter("b", 0.0, 1.0)))


def disc(values, seed):
    return {"y": float(np.hypot(values["a"] - 0.5, values["b"] - 0.5)) - 0.3, "noise": (seed % 1000) / 1000}


def line(values, seed):
    return {"y": values["a"] - 0.25, "noise": 0.0}


def slow(values, seed):
    time.sleep(0.004)
    return disc(values, seed)


def some_fail(values, seed):
    if values["a"] < 0.3:
        raise RunError("invalid", "a < 0.3 cannot be realised")
    return disc(values, seed)


def all_fail(values, seed):
    return {"y": 1 / 0}


def awkward(values, seed):
    """a is a number that says what goes wrong."""
    kind = round(values["a"] * 100)
    if kind == 1:
        os._exit(7)
    if kind == 2:
        while True:
            pass
    if kind == 3:
        raise KeyError("no such thing")  # marked
    if kind == 4:
        return {"y": float("nan"), "noise": 0.0}
    if kind == 5:
        time.sleep(0.1)
    return disc(values, seed)


def scenario(evaluate, space=SQUARE):
    requirement = Requirement("y", high=0.0)
    return LogicalScenario(evaluate.__name__, space, requirement, evaluate=evaluate, metric_names=("y", "noise"))


SCENARIO, SLOW, SOME_FAIL, ALL_FAIL, AWKWARD = map(scenario, (disc, slow, some_fail, all_fail, awkward))
LINE = scenario(line, ParameterSpace((Parameter("a", 0.0, 1.0),)))


@dataclasses.dataclass(frozen=True)
class Nearest:
    """Believes the value of the nearest row, more doubtful far away; writes down what it was taught."""

    log: str = ""

    def fit(self, u, y, rng):
        if self.log:
            with Path(self.log).open("a") as file:
                file.write(" ".join(repr(float(v)) for v in y) + "\\n")

        def predict(asked):
            if len(asked) == 0:
                return Prediction.gaussian(np.zeros(0), np.ones(0))
            distance = np.linalg.norm(asked[:, None, :] - u[None], axis=2)
            near = distance.argmin(axis=1)
            return Prediction.gaussian(y[near], 0.02 + distance[np.arange(len(asked)), near])

        return predict


@dataclasses.dataclass(frozen=True)
class Shifting:
    """Another belief at each of the rounds: everything critical, then nothing, then always half of it."""

    rounds: str = "cnhhhhhhhhhhhhhhhhhhhh"
    first: int = 8
    batch: int = 4

    def fit(self, u, y, rng):
        kind = self.rounds[(len(y) - self.first) // self.batch]

        def predict(asked):
            mean = {"c": 0 * asked[:, 0] - 0.05, "n": 0 * asked[:, 0] + 0.05, "h": asked[:, 0] - 0.5}[kind]
            return Prediction.gaussian(mean, np.full(len(asked), 0.1))

        return predict


@dataclasses.dataclass(frozen=True)
class Raising:
    """Learns once and then no more."""

    rows: int = 20

    def fit(self, u, y, rng):
        if len(y) > self.rows:
            raise RuntimeError("the matrix is singular")  # marked
        return Nearest().fit(u, y, rng)
'''


@pytest.fixture
def analytic(tmp_path: Path) -> Path:
    """A file with analytic scenarios and quick metamodels; the folder is the test's own."""
    path = tmp_path / "analytic.py"
    path.write_text(ANALYTIC)
    return path


@pytest.fixture
def configured(analytic: Path) -> Callable[..., Path]:
    """Write a configuration of an analytic scenario; keyword arguments replace its keys."""

    def write(name: str = "c", scenario: str = "SCENARIO", **keys: Any) -> Path:
        settings = {
            "campaign": "boundary", "scenario": f"analytic.py:{scenario}", "seed": 3, "budget": 60, "initial": 20, "batch": 20,
            "metamodel": {"kind": "analytic.py:Nearest"}, "executor": {"kind": "serial"}, "store": str(analytic.parent / name),
        }  # fmt: skip
        path = analytic.parent / f"{name}.yaml"
        path.write_text(json.dumps(settings | keys))  # JSON is YAML
        return path

    return write


@pytest.fixture
def campaign(configured: Callable[..., Path]) -> Callable[..., dict[str, Any]]:
    """Run a campaign of an analytic scenario in this process; no report unless it is asked for."""
    from sbt.workflows.running import run_study
    from sbt.workflows.study import Study

    def run(name: str = "c", scenario: str = "SCENARIO", *, report: bool = False, **keys: Any) -> dict[str, Any]:
        return run_study(Study.from_file(configured(name, scenario, **keys)), report=report).to_dict()

    return run


@pytest.fixture
def rows() -> Callable[[Path | str], dict[str, list[Any]]]:
    """Read what a store must hold bit by bit, however it came about: everything but seconds and versions."""
    from sbt.store.database import Store

    def read(folder: Path | str) -> dict[str, list[Any]]:
        with Store.read(Path(folder)) as store:
            return {
                "runs": [dataclasses.replace(record, seconds=0.0, versions="") for record in store.history().records],
                "planned": store.unfinished(), "iterations": store.iterations(), "fits": store.fits(),
            }  # fmt: skip

    return read

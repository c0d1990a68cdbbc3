"""What happens around a campaign while it runs: code is edited, shards differ, a run signals its group."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from test_evidence import net, vehicle

import sbt
from sbt.config.load import load
from sbt.errors import InputError
from sbt.loop.stages import Shard
from sbt.plugins import forget_changed
from sbt.workflows.merging import merge_shards
from sbt.workflows.running import rebuild_report, run_study
from sbt.workflows.study import Study

SCENARIO = """import os, signal
import pathlib, time
import sbt
{imports}
K = {k}
def f(values, seed):
    {first}
    time.sleep({seconds})
    return {{"y": values["a"] * K}}
S = sbt.Scenario("own", [sbt.Parameter("a", 0, 1)], sbt.Requirement("y", high=0.1), evaluate=f)
"""


def write(folder: Path, *, k: str = "1.0", first: str = "", imports: str = "", seconds: float = 0.0) -> Path:
    """Write a scenario of one's own, and the configuration of a coverage."""
    (folder / "own.py").write_text(SCENARIO.format(k=k, first=first or "pass", imports=imports, seconds=seconds))
    path = folder / "c.yaml"
    path.write_text("campaign: coverage\nscenario: own.py:S\nbudget: 24\nbatch: 6\nseed: 5\nexecutor: {kind: serial}\nstore: s\n")
    return path


def study(path: Path, *overrides: str) -> Study:
    return Study(load(path, [f"store={path.parent / 's'}", *overrides]))


RECYCLED = ("executor.kind=local", "executor.workers=1", "executor.recycle=6")


def test_no_row_is_of_code_that_was_edited_while_the_campaign_ran(tmp_path: Path):
    """Workers that are replaced would load it: what was run is kept, and goes on to the same rows with the code as it was."""
    edit = 'p = pathlib.Path(__file__); seed % 5 == 0 and p.write_text(p.read_text().replace("K = 1.0", "K = 2.0"))'
    path = write(tmp_path, first=edit)
    before = (tmp_path / "own.py").read_text()
    with pytest.raises(InputError, match=r"new workers must load .* began with, but changed: .*own.py; put it back"):
        run_study(study(path, *RECYCLED), report=False)
    kept = sbt.open(tmp_path / "s", trust=True).frame
    assert 0 < len(kept) < 24
    assert (kept["y.y"] == kept["x.a"]).all()
    (tmp_path / "own.py").write_text(before.replace("seed % 5 == 0 and ", "False and "))
    forget_changed()  # as where a command begins
    run_study(study(path, *RECYCLED), report=False)
    frame = sbt.open(tmp_path / "s", trust=True).frame
    assert len(frame) == 24
    assert (frame["y.y"] == frame["x.a"]).all()


def test_a_file_that_is_written_again_as_it_was_stops_nothing(tmp_path: Path):
    path = write(tmp_path, first="p = pathlib.Path(__file__); p.write_text(p.read_text())")
    assert run_study(study(path, *RECYCLED), report=False).runs == 24


def test_shards_of_code_that_was_edited_between_them_are_not_merged(tmp_path: Path):
    path = write(tmp_path)
    folders = [tmp_path / f"shard-{k}" for k in (1, 2)]
    run_study(study(path, f"store={folders[0]}"), report=False, shard=Shard(1, 2))
    later = time.time() + 5.0
    write(tmp_path, k="2.0")
    os.utime(tmp_path / "own.py", (later, later))
    forget_changed()  # as where a command begins
    run_study(study(path, f"store={folders[1]}"), report=False, shard=Shard(2, 2))
    with pytest.raises(InputError, match=r"must give the runs of .*shard-1 again"):
        merge_shards(folders, tmp_path / "whole", report=False)
    assert not (tmp_path / "whole" / "campaign.sqlite").exists()


@pytest.mark.parametrize("signal", ["SIGKILL", "SIGINT", "SIGTERM"])
def test_a_run_that_signals_its_process_group_costs_itself_only(tmp_path: Path, signal: str):
    path = write(tmp_path, first=f'values["a"] > 0.9 and os.killpg(0, signal.{signal})')
    found = run_study(study(path, "executor.kind=local", "executor.workers=2", "executor.timeout=20"), report=False)
    assert found.runs == 24
    frame = sbt.open(tmp_path / "s", trust=True).frame
    assert (frame.loc[frame["x.a"] <= 0.9, "status"] == "ok").all()


def test_own_code_imports_the_modules_beside_it_and_no_others_of_their_name(tmp_path: Path):
    """Also in workers, and as they are when a command begins."""
    folders = [tmp_path / name for name in "ab"]
    for k, folder in enumerate(folders, 2):
        folder.mkdir()
        (folder / "beside_it.py").write_text(f"k = {k}.0\n")
        write(folder, imports="from beside_it import k", k="k")
    for k, folder in enumerate(folders, 2):
        run_study(study(folder / "c.yaml"), report=False)
        frame = sbt.open(folder / "s", trust=True).frame
        assert (frame["y.y"] == k * frame["x.a"]).all()
    (folders[1] / "beside_it.py").write_text("k = 50.0\n")
    forget_changed()
    for executor in (("executor.kind=serial",), ("executor.kind=local", "executor.workers=1")):
        store = tmp_path / executor[0][-6:]
        run_study(study(folders[1] / "c.yaml", f"store={store}", *executor), report=False)
        frame = sbt.open(store, trust=True).frame
        assert (frame["y.y"] == 50.0 * frame["x.a"]).all()


def _in_a_pool(folder: str) -> str:
    try:
        run_study(study(Path(folder) / "c.yaml", "executor.kind=local", "executor.workers=1"), report=False)
    except InputError as error:
        return str(error)
    return ""


def test_a_daemonic_process_is_told_that_it_starts_none(tmp_path: Path):
    write(tmp_path)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert "worker processes need a process that may start some" in pool.map(_in_a_pool, [str(tmp_path)])[0]


METAMODEL = """import numpy as np
from sbt.metamodels.prediction import Prediction

class Nearest:
    def fit(self, u, y, rng):
        def predict(points):
            distance = np.linalg.norm(points[:, None] - u, axis=2)
            return Prediction.gaussian(y[distance.argmin(axis=1)], 0.1 + distance.min(axis=1))
        return predict
"""


def test_a_report_says_what_it_leaves_out_and_leaves_no_old_figures(tmp_path: Path):
    path = write(tmp_path)
    (tmp_path / "mine.py").write_text(METAMODEL)
    path.write_text(path.read_text() + "metamodel: {kind: 'mine.py:Nearest'}\n")
    run_study(study(path, "campaign=boundary", "initial=10"))
    page, figure = tmp_path / "s" / "report.html", tmp_path / "s" / "figures" / "probability.svg"
    assert figure.is_file()
    (figure.parent / "mine.svg").write_text("<svg/>")
    assert "metamodel are left out" not in page.read_text()
    (tmp_path / "mine.py").unlink()
    forget_changed()
    told: list[str] = []
    rebuild_report(tmp_path / "s", told=told.append)
    assert told[0].startswith("The figures of the metamodel are left out: a plug-in file must exist")
    assert "The figures of the metamodel are left out" in page.read_text()
    assert not figure.exists()
    assert (figure.parent / "mine.svg").exists(), "not one of its figures"


EXECUTORS = [{"kind": "serial"}, {"kind": "local", "workers": 1}]


def write_traffic(folder: Path, more: str = "") -> Path:
    """Write a scenario of a vehicle that nears a slower one, and return the file of the slower one."""
    (folder / "a.net.xml").write_text(net({"road": [(0.0, 0.0), (900.0, 0.0)]}))
    traffic = folder / "traffic.rou.xml"
    lead = vehicle("lead", "road", "slow", departPos=100, departSpeed=5)
    traffic.write_text(f'<routes><vType id="slow" sigma="0" maxSpeed="5"/>{lead}{more}</routes>')
    ego = vehicle("ego", "road", "own", departPos=20, departSpeed="${v}")
    (folder / "ego.rou.xml").write_text(f'<routes><vType id="own" sigma="0" maxSpeed="30"/>{ego}</routes>')
    (folder / "scenario.yaml").write_text(ROAD)
    return traffic


@pytest.mark.sumo
@pytest.mark.parametrize("executor", EXECUTORS)
@pytest.mark.parametrize("gone", [False, True])
def test_no_row_is_of_traffic_that_was_edited_while_the_campaign_ran(tmp_path: Path, executor: dict[str, object], gone: bool):
    """Runs load SUMO's files anew: what was run before is kept, and the rows are the same once the file is put back."""
    traffic = write_traffic(tmp_path)
    before = traffic.read_text()

    def edit(progress: sbt.Progress) -> None:
        if progress.done >= 8:
            traffic.unlink(missing_ok=True) if gone else traffic.write_text(before.replace("100", "90"))

    asked = {"campaign": "coverage", "budget": 24, "batch": 6, "seed": 5, "executor": executor, "report": False}
    with pytest.raises(InputError, match=r"SUMO's files must stay .* but changed: .*traffic.rou.xml; put it back"):
        sbt.run(scenario=tmp_path / "scenario.yaml", store=tmp_path / "s", progress=edit, **asked)
    assert 0 < len(sbt.open(tmp_path / "s").frame) < 24
    traffic.write_text(before)
    whole = sbt.run(scenario=tmp_path / "scenario.yaml", store=tmp_path / "s", **asked)
    undisturbed = sbt.run(scenario=tmp_path / "scenario.yaml", store=tmp_path / "t", **asked)
    assert (whole.frame["status"] == "ok").all()
    assert whole.frame["y.distance_min"].between(1.0, 100.0).all()
    columns = [name for name in whole.frame if name != "seconds"]
    assert whole.frame[columns].equals(undisturbed.frame[columns])


def rows_with(scenario: str, executor: dict[str, object], change: Callable[[], object]) -> int:
    """Return how many rows a campaign has during which something is changed."""

    def at_work(progress: sbt.Progress) -> None:
        if progress.done >= 8:
            change()

    asked = {"campaign": "coverage", "budget": 24, "batch": 6, "seed": 5, "executor": executor, "report": False}
    path = Path(scenario.removesuffix(":S"))
    return len(sbt.run(scenario=scenario, store=path.parent / "s", progress=at_work, **asked).frame)


@pytest.mark.sumo
@pytest.mark.parametrize("executor", EXECUTORS)
def test_the_network_of_a_scene_in_python_is_a_file_that_runs_load_anew(tmp_path: Path, executor: dict[str, object]):
    write_traffic(tmp_path)
    network = tmp_path / "a.net.xml"
    (tmp_path / "own.py").write_text(SCENE.format(network=network))
    shorter = network.read_text().replace("900", "800")
    with pytest.raises(InputError, match=r"SUMO's files must stay .* but changed: .*a.net.xml; put it back"):
        rows_with(f"{tmp_path / 'own.py'}:S", executor, lambda: network.write_text(shorter))


@pytest.mark.sumo
def test_files_of_other_scenarios_of_the_session_end_no_campaign(tmp_path: Path):
    folders = [tmp_path / name for name in "ab"]
    for folder in folders:
        folder.mkdir()
    _, other = map(write_traffic, folders)
    sbt.simulate(str(folders[1] / "scenario.yaml"), {"v": 10.0})
    assert rows_with(str(folders[0] / "scenario.yaml"), {"kind": "serial"}, lambda: other.write_text("<routes/>")) == 24


@pytest.mark.sumo
def test_networks_that_runs_write_themselves_end_no_campaign(tmp_path: Path):
    write_traffic(tmp_path)
    (tmp_path / "own.py").write_text(WRITTEN)
    assert rows_with(f"{tmp_path / 'own.py'}:S", {"kind": "serial"}, lambda: None) == 24


@pytest.mark.sumo
@pytest.mark.parametrize("executor", EXECUTORS)
@pytest.mark.parametrize("moved", [False, True])
def test_a_link_is_what_it_leads_to(tmp_path: Path, executor: dict[str, object], moved: bool):
    """Whatever the file there is called, and also where the link is changed."""
    link, stored = write_traffic(tmp_path), [tmp_path / "3f2a", tmp_path / "77c0"]
    stored[1].write_text(link.read_text().replace("100", "90"))
    link.rename(stored[0])
    link.symlink_to(stored[0])

    def change() -> None:
        if moved:
            link.unlink()
            link.symlink_to(stored[1])
        else:
            stored[0].write_text(stored[1].read_text())

    with pytest.raises(InputError, match=r"SUMO's files must stay .* but changed: \S*/traffic.rou.xml; put it back"):
        rows_with(str(tmp_path / "scenario.yaml"), executor, change)


@pytest.mark.sumo
@pytest.mark.parametrize("executor", EXECUTORS)
@pytest.mark.parametrize("edited", [False, True])
def test_a_large_file_is_what_is_in_it(tmp_path: Path, executor: dict[str, object], edited: bool):
    """Not when it was written."""
    traffic = write_traffic(tmp_path, "<!-- x -->\n" * 400_000)
    text = traffic.read_text()
    if edited:
        with pytest.raises(InputError, match=r"SUMO's files must stay .* but changed: .*traffic.rou.xml; put it back"):
            rows_with(str(tmp_path / "scenario.yaml"), executor, lambda: traffic.write_text(text.replace("100", "90")))
    else:
        assert rows_with(str(tmp_path / "scenario.yaml"), executor, traffic.touch) == 24


WRITTEN = """import pathlib
import sbt
from sbt.sumo.nets import net_file


def evaluate(values, seed):
    path = pathlib.Path(__file__).with_name("built.net.xml")
    path.write_text(path.with_name("a.net.xml").read_text().replace("900", str(800 + values["a"])))
    return {"y": float(len(net_file(str(path)).read_text()))}


S = sbt.Scenario("own", [sbt.Parameter("a", 0, 99, kind="integer")], sbt.Requirement("y", high=0.1), evaluate=evaluate)
"""
SCENE = """import sbt
from sbt.metrics.planar import distance_min
from sbt.problem.scenario import LogicalScenario
from sbt.sumo.actors import Action, Actor, Scene
from sbt.sumo.simulation import SumoSimulation

class Steady:
    def act(self, t, own, others):
        return Action(acceleration=0.0)

def scene(values, ego, rng):
    cars = (("ego", 50.0, values["v"]), ("co", 300.0, 5.0))
    return Scene(tuple(Actor(name, ("road",), 0, at, speed, Steady()) for name, at, speed in cars))

S = LogicalScenario(
    "own", sbt.ParameterSpace((sbt.Parameter("v", 5, 20),)), simulate=SumoSimulation("{network}", scene, 3.0),
    metrics=(distance_min(),), requirement=sbt.Requirement("distance_min", high=200.0),
)
"""
ROAD = """sumo: {net: a.net.xml, routes: [traffic.rou.xml, ego.rou.xml]}
inputs: {v: {min: 5, max: 20}}
ego: {id: ego, may_leave: true}
duration: 3
metrics: [distance_min]
requirement: {metric: distance_min, critical: [-.inf, 200]}
"""

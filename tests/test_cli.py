"""The command line: verbs, exit codes, JSON, and what is never imported too early."""

from __future__ import annotations

import csv
import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from sbt.campaigns.settings import PlainConclusion
from sbt.cli import app, console, listing, progress
from sbt.cli.completion import complete_scenarios, complete_stores
from sbt.cli.conclusion import conclusion_lines
from sbt.errors import InputError, StoreError
from sbt.loop.stages import Progress
from sbt.problem.outcome import Outcome, Status
from sbt.store.database import PlannedRun, Store
from sbt.store.records import FitRecord, Validation
from sbt.workflows import running as sbt_run
from sbt.workflows.running import Summary
from sbt.workflows.study import Study

SBT = [sys.executable, "-m", "sbt"]
PLUGIN = """
import os, sys
from sbt.errors import RunError
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import CriticalInterval, Requirement


def margin(values, seed):
    print("noise on stdout")
    os.write(1, b"noise from C\\n")
    return {"margin": values["gap"] - values["speed"] / 2 + 1e-3 * (seed % 7)}


def refused(values, seed):
    raise RunError("invalid", "the start is not the one asked for")


def broken(values, seed):
    return {"margin": 1 / 0}


calls = []


def unsteady(values, seed):
    calls.append(seed)
    return {"margin": float(len(calls))}


def elsewhere(values, seed):
    return {"margin": float(os.getpid())}


def scenario(evaluate):
    space = ParameterSpace((Parameter("speed", 0.0, 10.0, "m/s"), Parameter("gap", 1.0, 5.0, "m")))
    requirement = Requirement("margin", high=0.0)
    return LogicalScenario("plane", space, requirement, evaluate=evaluate, metric_names=("margin",))


SCENARIO, REFUSED, BROKEN, UNSTEADY, ELSEWHERE = map(scenario, (margin, refused, broken, unsteady, elsewhere))
"""
RESULT: dict[str, Any] = {
    "campaign": "boundary", "scenario": "plane", "store": "there", "runs": 10, "ok": 9, "failed": 1, "critical": 2,
    "iterations": 2, "stopped": "budget", "unconfirmed": 0, "seconds": {"simulate": 1.0, "fit": 0.0, "propose": 0.0},
    "struck": 0, "other_level": 0, "sentences": ["A fifth is critical."], "metric": "margin", "units": {"gap": "m"},
    "conclusion": {"critical_fraction": 0.2222222, "validation": {"log_likelihood": -1.25, "rmse": None}},
}  # fmt: skip

ENDS = """
import sbt

ENDS = sbt.Scenario("ends", [sbt.Parameter("a", 0, 1)], sbt.Requirement("g", high=0.0), metrics=["g", "h"],
                    evaluate=lambda values, seed: {"g": float("VALUE"), "h": 1.0})
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "plane.py").write_text(PLUGIN)
    (tmp_path / "c.yaml").write_text("campaign: boundary\nscenario: plane.py:SCENARIO\nbudget: 20\nmetamodel: {kind: et}\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def campaign(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Replace the campaign by one that returns RESULT at once, and keep what it was given."""
    given: list[Any] = []

    def run_study(study: Study, *, progress: Any, shard: Any) -> Summary:
        given.append(study)
        print("noise on stdout")
        for done in (5, 10):
            progress(Progress(done, 10, 1, 2, done // 5 - 1, "simulating"))
        return Summary(**{**RESULT, "conclusion": PlainConclusion(RESULT["conclusion"])})

    monkeypatch.setattr(sbt_run, "run_study", run_study)
    return given


def call(*args: str) -> Any:
    return CliRunner().invoke(app, args)


def process(*args: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*SBT, *args], capture_output=True, text=True, timeout=120, env={**os.environ, **environment})


def store(folder: Path, *, concluded: bool = False) -> Path:
    """Write a store of three runs, one of them failed, and one more planned."""
    with Store.open(folder, Study.from_file(folder.parent / "c.yaml").snapshot()) as made:
        planned = [PlannedRun("initial", {"speed": k / 3, "gap": 2.0}) for k in range(4)]
        made.plan(0, "initial", planned, [1, 2, 3, 4], {"kind": "even"})
        for k in range(2):
            made.append(Outcome(k, Status.OK, {"margin": 0.1 * k}))
        made.append(Outcome(2, Status.TIMEOUT, reason="too long, 60 s"))
        made.add_fit(FitRecord(2, 0.5, 0.1, 0.2, "", Validation(rmse=0.5), runs=2))
        if concluded:
            made.conclude(RESULT)
    return folder


def test_help_is_quick_and_imports_nothing_heavy():
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, "-X", "importtime", "-m", "sbt", "--help"], capture_output=True, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 0.7, "processor time, on a busy machine too"
    assert done.returncode == 0
    imported = {line.split("|")[-1].strip().split(".")[0] for line in done.stderr.splitlines() if "|" in line}
    heavy = {"torch", "pandas", "libsumo", "scipy", "sklearn", "matplotlib", "pydantic", "numpy", "ruamel", "joblib"}
    assert "sbt" in imported
    assert imported & heavy == set()


def test_version():
    assert call("--version").stdout.startswith("sumo-sbt ")


@pytest.mark.parametrize("args", [["bogus"], ["run"], ["run", "c.yaml", "--bogus"], ["run", "c.yaml", "--workers", "0"]])
def test_wrong_usage_ends_with_2(args: list[str]):
    assert call(*args).exit_code == 2


def test_wrong_configuration_is_told_with_its_place(folder: Path):
    (folder / "bad.yaml").write_text("campaign: boundary\nscenario: plane.py:SCENARIO\nbugdet: 10\nbatch: two\n")
    done = process("run", "bad.yaml", "--json")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.splitlines() == [
        "bad.yaml:3:1: bugdet: unknown key (did you mean 'budget'?)",
        "bad.yaml:4:8: batch: must be a whole number, but got 'two'",
    ]


@pytest.mark.parametrize(
    ("store", "said"), [("\udcc3s", r"printable characters, but got 2 of them: '\udcc3s'"), (" ", "must not be empty")]
)
def test_a_wrong_option_is_named_as_it_was_given(folder: Path, store: str, said: str):
    done = call("run", "c.yaml", "--store", store)
    assert (done.exit_code, done.output.count("--store: "), said in done.output) == (2, 1, True), done.output
    assert "--set" not in done.output


def test_what_only_the_scenario_tells_is_reported_with_the_wrong_keys(folder: Path):
    text = "campaign: boundary\nscenario: plane.py:SCENARIO\nbugdet: 10\ninputs: {gab: {max: 2.0}}\n"
    text += "requirement: {metric: margni}\n"
    (folder / "bad.yaml").write_text(text)
    done = call("run", "bad.yaml")
    lines = done.stderr.splitlines()
    assert done.exit_code == 2
    assert len(lines) == 3, lines
    for line, part in zip(lines, ("bugdet: unknown key", "gab", "margni"), strict=True):
        assert part in line, lines


def test_run_prints_one_json_object_and_nothing_else(folder: Path, campaign: list[Any]):
    done = call("run", "c.yaml", "--json", "--store", "a b: c", "--set", "seed=3", "--workers", "2")
    assert done.exit_code == 0
    assert json.loads(done.stdout) == RESULT
    assert "5/10" not in done.stderr
    config = campaign[0].config
    assert (config.store, config.seed, config.executor.workers, campaign[0].loaded.folder) == ("a b: c", 3, 2, folder)


def test_run_tells_people_the_conclusion(folder: Path, campaign: list[Any]):
    done = call("run", "c.yaml")
    assert done.exit_code == 0
    assert "5/10 runs, iteration 0, 2 critical, 1 failed, simulating" in done.stderr
    assert done.stdout.splitlines()[2:] == ["  A fifth is critical.", "store: there"]
    done = call("run", "c.yaml", "--verbose")
    assert re.search(r"critical_fraction +0\.2222", done.stdout)
    assert re.search(r"log_likelihood +-1\.25", done.stdout)
    assert "noise" not in done.stdout
    assert call("run", "c.yaml", "--quiet").stderr.strip() == "noise on stdout"


def test_failure_modes_are_told_by_names_and_units_and_what_to_try_next():
    mode = {
        "representative": 7, "inputs": {"gap": 1.23456, "kind": "bus"}, "metric": -0.5, "size": 3, "conflict": "rear end",
        "confirmed": 0.5, "confirmation_runs": 4, "unconfirmed": 1, "violates": {"near": 3, "fast": 1},
    }  # fmt: skip
    found = conclusion_lines({**RESULT, "store": "a b", "conclusion": {"failure_modes": [mode], "warnings": ["few runs"]}})
    told = "run 7, margin -0.5, at gap 1.23 m, kind bus; rear end; 3 critical runs, violating near, fast in 1;"
    told += " critical again in 2 of 4 repetitions; 1 with"
    assert found[3:] == [
        f"  mode 1: {told} a contact that SUMO does not list", "  warning: few runs", "store: a b",
        "next: sumo-sbt replay 'a b' 7",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("change", "args", "code"),
    [
        ({}, ["--fail-on-critical"], 3),
        ({"critical": 0}, ["--fail-on-critical"], 0),
        ({"failed": 5, "ok": 5}, [], 0),
        ({"failed": 6, "ok": 4}, [], 4),
        ({"runs": 0, "failed": 0, "critical": 0}, ["--fail-on-critical"], 0),
    ],
)
def test_exit_codes_of_run(
    folder: Path, campaign: list[Any], monkeypatch: pytest.MonkeyPatch, change: dict[str, int], args: list[str], code: int
):
    for key, value in change.items():
        monkeypatch.setitem(RESULT, key, value)
    done = call("run", "c.yaml", "--json", *args)
    assert done.exit_code == code
    assert json.loads(done.stdout) == RESULT


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (InputError("budget must fit"), 2, "budget must fit\n"),
        (StoreError("the disk is full"), 1, "the disk is full\n"),
        (KeyboardInterrupt(), 130, "interrupted, nothing was run yet\n"),
        (ZeroDivisionError("oh"), 1, "internal error: ZeroDivisionError: oh (SBT_DEBUG=1 shows where)\n"),
    ],
)
def test_errors_become_exit_codes(folder: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, code: int, text: str):
    def run_study(study: Study, *, progress: Any, shard: Any) -> Summary:
        raise error

    monkeypatch.setattr(sbt_run, "run_study", run_study)
    done = call("run", "c.yaml", "--json")
    assert (done.exit_code, done.stdout, done.stderr) == (code, "", text)
    monkeypatch.setenv("SBT_DEBUG", "1")
    assert ("Traceback" in call("run", "c.yaml").stderr) is isinstance(error, Exception)


def test_an_interrupted_campaign_can_be_resumed(folder: Path, monkeypatch: pytest.MonkeyPatch):
    def run_study(study: Study, *, progress: Any, shard: Any) -> Summary:
        with Store.open(Path(study.config.store)):
            raise KeyboardInterrupt

    monkeypatch.setattr(sbt_run, "run_study", run_study)
    done = call("run", "c.yaml", "--json")
    assert (done.exit_code, done.stdout, done.stderr) == (130, "", "interrupted, run again to resume\n")


def test_sigterm_is_an_interruption(folder: Path):
    (folder / "slow.py").write_text(
        PLUGIN + "\n\ndef slow(values, seed):\n    import time\n    time.sleep(60)\n\n\nSLOW = scenario(slow)\n"
    )
    running = subprocess.Popen([*SBT, "simulate", "slow.py:SLOW"], stderr=subprocess.PIPE, text=True)
    time.sleep(3.0)
    running.send_signal(signal.SIGTERM)
    _, told = running.communicate(timeout=20)
    assert (running.returncode, told) == (130, "interrupted\n")


SIGNALLED = """
import os, signal, sys

module = sys.argv.pop()

class Signals:
    def find_spec(self, name, path=None, target=None):
        global module
        if name == module:
            module = None
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Signals())
from sbt.cli import main
main()
"""


@pytest.mark.parametrize(
    "module",
    ["typer", "sbt.cli.console", "sbt.cli.verbs", "sbt.cli.serve", "numpy", "scipy.special", "sbt.scenarios.cut_in"],
)
def test_ctrl_c_while_anything_is_imported_is_one_sentence(folder: Path, module: str):
    done = subprocess.run(
        [sys.executable, "-c", SIGNALLED, "simulate", "cut_in", module], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr in ("interrupted, nothing was run yet\n", "interrupted\n")


IN_EXEC = """
import signal, sys, threading, time
import typer
from sbt.cli import console

@console.verb
def go():
    exec("signal.raise_signal(signal.SIGINT)")

threading.Thread(target=time.sleep, args=(60,), daemon=True).start()
with console.process():
    try:
        go()
    except typer.Exit as end:
        sys.exit(end.exit_code)
"""


def test_ctrl_c_in_the_making_of_a_class_ends_with_the_code_as_well(folder: Path):
    (folder / "in_exec.py").write_text(IN_EXEC)
    done = subprocess.run([sys.executable, "-m", "in_exec"], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (130, "interrupted\n")


@pytest.mark.parametrize("seconds", [0.25, 0.5, 1.0])
def test_ctrl_c_at_any_moment_is_told_without_a_traceback(folder: Path, seconds: float):
    running = subprocess.Popen([*SBT, "run", "c.yaml"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    time.sleep(seconds)
    running.send_signal(signal.SIGINT)
    _, told = running.communicate(timeout=30)
    assert running.returncode in (130, 0)  # it may have been done
    assert "Traceback" not in told


def test_simulate_prints_one_json_object_and_nothing_else(folder: Path):
    done = process("simulate", "plane.py:SCENARIO", "speed=8", "--seed", "3", "--json")
    assert done.returncode == 0
    assert done.stdout.count("\n") == 1
    found = json.loads(done.stdout)
    assert list(found) == ["scenario", "seed", "inputs", "status", "metrics", "critical", "reason", "seconds"]
    assert (found["seed"], found["inputs"], found["critical"]) == (3, {"speed": 8.0, "gap": 3.0}, True)
    assert found["metrics"] == {"margin": 3.0 - 4.0 + 1e-3 * 3}
    assert "noise from C" in done.stderr


@pytest.mark.parametrize(("value", "critical"), [("inf", False), ("-inf", True)])
def test_json_tells_one_infinity_from_the_other(folder: Path, value: str, critical: bool):
    """A critical run and one that is not had null both, without a word."""
    (folder / "ends.py").write_text(ENDS.replace("VALUE", value))
    simulated = json.loads(call("simulate", "ends.py:ENDS", "--json").stdout)
    assert (simulated["metrics"], simulated["infinite"]) == ({"g": None, "h": 1.0}, {"g": value})
    assert simulated["critical"] is critical
    (folder / "e.yaml").write_text("campaign: coverage\nscenario: ends.py:ENDS\nbudget: 2\nexecutor: {kind: serial}\nstore: e\n")
    call("run", "e.yaml", "--quiet")
    replayed = json.loads(call("replay", "e", "0", "--json", "--trust").stdout)
    assert (replayed["metrics"], replayed["infinite"]) == ({"g": None, "h": 1.0}, {"g": value})


@pytest.mark.parametrize(
    ("name", "status", "reason"),
    [
        ("REFUSED", "invalid", "the start is not the one asked for"),
        ("BROKEN", "failed", "ZeroDivisionError: division by zero (plane.py:{line})"),
    ],
)
def test_a_failed_run_is_told_and_ends_with_4(folder: Path, name: str, status: str, reason: str):
    line = 1 + (folder / "plane.py").read_text().splitlines().index('    return {"margin": 1 / 0}')
    reason = reason.replace("plane.py:{line}", f"{folder}/plane.py:{line}")
    done = call("simulate", f"plane.py:{name}", "--json")
    found = json.loads(done.stdout)
    assert done.exit_code == 4
    assert (found["status"], found["reason"], found["metrics"], found["critical"]) == (status, reason, {}, None)
    assert f"{status}: {reason}" in call("simulate", f"plane.py:{name}").stdout


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        (["sped=3"], "an input must be one of speed, gap, but got 'sped' (did you mean 'speed'?)"),
        (["speed=11"], "input speed must be in [0, 10] m/s, but got 11"),
        (["speed=x"], "input speed must be a number, but got 'x'"),
        (["speed"], "input must be name=value, but got 'speed'"),
        (["speed=1", "speed=2"], "input speed must be given once, but got it twice"),
        (["--ego", "gain=2"], "--ego needs kind=NAME, but got gain"),
        (["--ego", "kind=acc"], "scenario plane offers no choice of ego or step length"),
        (["--step", "0"], "--step must be > 0 s, but got 0.0"),
        (["--isolation", "none"], "--isolation must be auto, fresh, reuse, replicas or snapshot, but got 'none'"),
        (["--trace", "t.csv"], "a trace needs a scenario that is simulated, but plane gives its metrics directly"),
    ],
)
def test_wrong_input_of_simulate_ends_with_2(folder: Path, args: list[str], expected: str):
    done = call("simulate", "plane.py:SCENARIO", *args)
    assert (done.exit_code, done.stdout) == (2, "")
    assert done.stderr.strip() == expected


@pytest.mark.sumo
def test_simulate_writes_the_trace(folder: Path):
    done = call("simulate", "cut_in", "d_v=60", "d_t=1.2", "--seed", "3", "--json", "--trace", "t.csv")
    assert json.loads(done.stdout)["status"] == "ok"
    with (folder / "t.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["actor"] for row in rows} == {"ego", "co"}
    assert float(rows[0]["time"]) == 0.0


@pytest.mark.parametrize("target", ["plane.py:SCENARIO", "c.yaml"])
def test_check_of_a_sound_scenario(folder: Path, target: str):
    done = call("check", target)
    assert done.exit_code == 0
    assert [line[:4] for line in done.stdout.splitlines()] == ["ok  "] * 4 + ["note"]
    assert "critical by margin" in done.stdout.splitlines()[-1]


@pytest.mark.parametrize(("name", "ok", "code"), [("SCENARIO", True, 0), ("REFUSED", False, 2)])
def test_check_prints_one_json_object(folder: Path, name: str, ok: bool, code: int):
    done = process("check", f"plane.py:{name}", "--json")
    found = json.loads(done.stdout)
    assert (done.returncode, found["target"], found["ok"]) == (code, f"plane.py:{name}", ok)
    assert all(f["ok"] for f in found["findings"]) is ok
    assert {"rule", "ok", "detail", "numbers"} == set(found["findings"][0])


@pytest.mark.parametrize(
    ("name", "rule"),
    [
        ("REFUSED", "centre and corners run: 5 of 5 invalid; at speed=5, gap=3: invalid: the start is not"),
        ("UNSTEADY", "same seed, same trace: at speed=5, gap=3: margin 1.0 and 10.0"),
        ("ELSEWHERE", "same seed, same trace in a worker process: at speed=5, gap=3: margin "),
    ],
)
def test_check_of_an_unsound_scenario(folder: Path, name: str, rule: str):
    done = call("check", f"plane.py:{name}")
    assert done.exit_code == 2
    assert f"FAIL  {rule}" in done.stdout


@pytest.mark.sumo
def test_check_compares_the_isolation_levels():
    done = call("check", "cut_in")
    assert done.exit_code == 0
    assert "ok    isolation reuse = fresh: 10 runs bit-equal" in done.stdout


def test_list_shows_what_is_installed():
    found = json.loads(call("list", "--json").stdout)
    assert {"scenarios", "metamodels", "acquisitions", "metrics", "campaigns"} <= set(found)
    assert all(entry["summary"] for entries in found.values() for entry in entries)
    assert "boundary" in {entry["name"] for entry in found["campaigns"]}
    assert {"table:FOLDER", "testbed:NAME", "testbed:four_branch_7"} <= {entry["name"] for entry in found["sources"]}
    assert call("list", "acquisitions").stdout.startswith("acquisitions:\n")
    wrong = call("list", "metrcs")
    assert (wrong.exit_code, "did you mean 'metrics'?" in wrong.stderr) == (2, True)


def test_schema_is_json():
    assert json.loads(call("schema").stdout)["properties"]["scenario"]["type"] == "string"


@pytest.mark.sumo
def test_doctor_finds_this_environment_sound(folder: Path):
    done = process("doctor", "--json", "--store", str(folder / "not" / "yet"))
    found = json.loads(done.stdout)
    assert (done.returncode, found["ok"]) == (0, True)
    states = {check["name"]: check["state"] for check in found["checks"]}
    assert {states[name] for name in ("python", "libsumo", "torch", "sumo", "sumo_nets", "cores", "sqlite")} == {"ok"}
    assert list(folder.glob(".sbt-doctor*")) == []


@pytest.mark.sumo
def test_doctor_warns_of_a_strange_sumo_home(folder: Path):
    done = process("doctor", SUMO_HOME=str(folder / "old"))
    assert re.search(r"warning +SUMO_HOME +'.*old' is no folder; unset SUMO_HOME", done.stdout)


def test_status_of_a_store(folder: Path):
    found = json.loads(call("status", str(store(folder / "s")), "--json").stdout)
    assert found["runs"] == {"ok": 2, "timeout": 1, "planned": 1}
    assert (found["iterations"], found["validation"]["rmse"], found["conclusion"]) == (1, 0.5, None)
    assert "not finished" in call("status", str(folder / "s")).stdout
    done = call("status", str(store(folder / "d", concluded=True)), "--watch")
    assert "A fifth is critical." in done.stdout


def test_export_writes_a_table(folder: Path):
    done = call("export", str(store(folder / "s")))
    path = Path(done.stdout.strip())
    assert (done.exit_code, path) == (0, folder / "s" / "exports" / "runs.csv")
    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["ok", "ok", "timeout"]
    assert float(rows[1]["x.speed"]) == 1 / 3
    assert rows[2]["y.margin"] == ""
    assert not list(path.parent.glob("*.part"))


def test_other_forms_of_export_are_refused(folder: Path):
    done = call("export", str(store(folder / "s")), "--format", "xls")
    assert (done.exit_code, done.stderr.strip()) == (2, "the format must be csv, parquet, dsiod, boundary, but got 'xls'")


@pytest.mark.parametrize("verb", ["status", "report", "export"])
def test_a_folder_without_a_campaign_is_refused(folder: Path, verb: str):
    done = call(verb, str(folder))
    assert (done.exit_code, done.stdout) == (2, "")
    assert "must be the folder of a campaign" in done.stderr


def test_report_writes_the_same_page_again_and_prints_its_path(folder: Path):
    assert call("run", "c.yaml", "--quiet", "--store", str(folder / "s")).exit_code == 0
    page = folder / "s" / "report.html"
    before = page.read_bytes()
    page.unlink()
    assert call("report", str(folder / "s")).stdout.strip() == str(page)
    assert page.read_bytes() == before


def test_progress_without_a_terminal_is_a_line_an_iteration(capsys: pytest.CaptureFixture[str]):
    with console.ProgressDisplay() as show:
        for done in range(1, 7):
            show(Progress(done, 6, 0, 0, (done - 1) // 3, "simulating"))
    assert [line.split()[0] for line in capsys.readouterr().err.splitlines()] == ["1/6", "4/6", "6/6"]


def test_progress_on_a_terminal_is_a_bar(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with console.ProgressDisplay() as show:
        show(Progress(3, 6, 1, 2, 0, "simulating"))
        show(Progress(6, 6, 1, 2, 0, "fitting"))
    assert "6/6" in capsys.readouterr().err


def test_numbers_of_numpy_and_infinities_become_json(capsys: pytest.CaptureFixture[str]):
    import numpy as np

    console.print_json({"a": np.float64(1.5), "b": [np.int64(2), float("inf")], "c": (np.nan, None, True), "d": Path("x")})
    assert json.loads(capsys.readouterr().out) == {"a": 1.5, "b": [2, None], "c": [None, None, True], "d": "x"}


def test_progress_never_goes_beyond_its_total_and_tells_what_a_person_asks(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "120")
    clock = iter(range(0, 1000, 2))
    monkeypatch.setattr(progress.time, "monotonic", lambda: float(next(clock)))
    with console.ProgressDisplay() as show:
        for done in (0, 4, 8):
            show(Progress(done, 8, 1, 2, 0, "simulating"))
            assert show._bar.tasks[0].completed <= show._bar.tasks[0].total == 8
        show(Progress(10, 8, 1, 2, 1, "confirm: choosing"))
        assert show._bar.tasks[0].completed == 8
    said = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", capsys.readouterr().err)
    for part in ("4/8", "/s", "2 critical", "1 failed", "s left", "confirm: choosing", "8 + 2"):
        assert part in said, said


def test_a_list_is_remembered_until_something_is_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    first = call("list", "acquisitions").stdout
    assert "boundary" in first
    (kept,) = (tmp_path / "sumo-sbt").glob("acquisitions.*.json")
    kept.write_text(json.dumps({"remembered": "a line"}))
    assert "a line" in call("list", "acquisitions").stdout
    monkeypatch.setattr(listing, "__version__", "another")
    assert call("list", "acquisitions").stdout == first
    assert call("list", "acquisition").exit_code == 2


def test_help_names_no_type_of_a_flag(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", "80")
    for verb in ("run", "simulate", "status", "pin", "list"):
        assert "bool" not in call(verb, "--help").stdout.lower()
    assert "bool" not in call("--help").stdout.lower()


def test_a_shell_completes_scenarios_and_stores(folder: Path):
    store(folder / "first")
    (folder / "deep").mkdir()
    (folder / "first").rename(folder / "deep" / "first")
    assert complete_scenarios("cut") == ["cut_in"]
    assert complete_scenarios("c.") == ["c.yaml"]
    assert complete_stores("") == ["deep/first"]
    assert complete_stores("deep/f") == ["deep/first"]
    assert complete_stores("other") == []


def test_watching_waits_for_a_campaign_that_may_just_be_starting(folder: Path, monkeypatch: pytest.MonkeyPatch):
    states = iter(["dead", "dead", "running", "finished"])
    about = {"store": "s", "runs": {}, "done": 1, "budget": 3, "rate": None, "remaining": None, "iterations": 1}
    told = {**about, "validation": None, "conclusion": None}
    monkeypatch.setattr("sbt.cli.campaign._status", lambda folder: {**told, "state": next(states)})
    monkeypatch.setattr("sbt.cli.campaign._EVERY", 0.0)
    lines = call("status", str(folder), "--watch").stdout.splitlines()
    assert [line.split(",")[0] for line in lines[:3]] == ["s: dead", "s: running", "s: finished"]


def test_status_says_how_far_a_campaign_is_and_watching_one_that_nobody_runs_ends(folder: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("sbt.cli.campaign._STARTING", 0.0)
    said = call("status", str(store(folder / "s")), "--watch").stdout
    assert re.search(r"/s: interrupted, 3 of \d+ runs$", said.splitlines()[0]), said
    assert "not finished: it was interrupted; run it again to go on" in said

"""Configurations: what is read, what is refused and where, and what it is assembled to."""

# ruff: noqa: E501  (a line of a table is a case)

from __future__ import annotations

import json
import math
import pickle
import re
from itertools import pairwise
from pathlib import Path

import pytest

from sbt.config.assemble import assemble, metamodel_of, scenario_of, spec_of
from sbt.config.executor_model import EXECUTORS
from sbt.config.kinds import kinds
from sbt.config.load import ConfigError, dump, fingerprint, load, parse, resolve, resumed, schema
from sbt.config.source import read_value
from sbt.metamodels.extra_trees import ExtraTrees

BASE = "campaign: boundary\nscenario: plugin.py:SCENARIO\n"
PLUGIN = """
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import CriticalInterval, Requirement

SCENARIO = LogicalScenario(
    name="plane",
    space=ParameterSpace((Parameter("speed", 0.0, 10.0, "m/s"), Parameter("gap", 1.0, 5.0, "m"), Parameter("n", 0, 4, kind="integer"))),
    requirement=Requirement("margin", high=0.0),
    evaluate=lambda values, seed: {"margin": values["gap"] - values["speed"] / 2, "other": 1.0},
    metric_names=("margin", "other"),
)
NOT_A_SCENARIO = 3


def my_acquisition(prediction, critical, log_density):
    return log_density
"""
FULL = """
requirement: {metric: other, critical: [-.inf, 0.5]}
inputs:
  speed: {max: 8, distribution: {kind: normal, mean: 4, std: 1}}
correlation: [{inputs: [speed, gap], value: 0.3}]
constraints: [speed < 3 * gap]
features: {time: gap / (speed + 1)}
seed: 7
budget: 40
batch: 5
metamodel: {kind: et, trees: 7}
acquisition: {kind: "plugin.py:my_acquisition"}
stop: {stable: 0.01}
executor: {kind: serial, timeout: .inf}
store: here
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "plugin.py").write_text(PLUGIN)
    return tmp_path


def errors(text: str, *overrides: str, folder: Path | None = None, assembled: bool = False) -> list[str]:
    """Return the lines of the error that a configuration raises."""

    def read() -> object:
        loaded = parse(text, overrides, name="f.yaml", folder=folder)
        return assemble(loaded) if assembled else loaded

    with pytest.raises(ConfigError) as caught:
        read()
    assert str(caught.value) == "\n".join(caught.value.errors)
    return list(caught.value.errors)


def test_every_key_has_a_default_but_campaign_and_scenario():
    config = parse(BASE).config
    assert (config.budget, config.initial, config.batch, config.seed) == (500, 50, 50, 0)
    assert config.metamodel is not None
    assert (config.metamodel.kind, config.metamodel.preset, config.acquisition.kind) == ("auto", "quick", "mix")
    assert config.store == "runs/boundary_plugin"
    assert config.executor.workers >= 1


def test_coverage_learns_nothing_unless_asked():
    text = "campaign: coverage\nscenario: cut_in\n"
    assert parse(text).config.metamodel is None
    assert parse(text).config.acquisition.kind == "even"
    assert parse(text + "metamodel: {kind: et}\n").config.metamodel is not None
    asked = parse(text + "metamodel: {}\n").config.metamodel
    assert asked is not None
    assert asked.kind == "auto"


@pytest.mark.parametrize(("budget", "initial"), [(1, 1), (9, 9), (40, 10), (500, 50), (2000, 200)])
def test_initial_follows_the_budget(budget: int, initial: int):
    config = parse(BASE, [f"budget={budget}"]).config
    assert (config.initial, config.batch) == (initial, initial)


@pytest.mark.parametrize("text", [BASE, BASE + FULL, "campaign: coverage\nscenario: 'table:my data'\n"])
def test_resolved_configuration_reads_back_equal(text: str):
    config = parse(text).config
    assert parse(dump(config)).config == config
    assert resolve(parse(dump(config)).config) == resolve(config)


def test_fingerprint_is_json_and_leaves_out_what_may_change():
    one = parse(BASE + FULL).config
    other = parse(BASE + FULL, ["store=there", "executor.workers=7", "budget=41", "initial=10"]).config
    assert fingerprint(one) == fingerprint(other) == json.loads(json.dumps(fingerprint(one), allow_nan=False))
    assert fingerprint(one) != fingerprint(parse(BASE + FULL, ["seed=8"]).config)


def test_a_larger_budget_keeps_the_batches_of_the_store():
    first = parse(BASE).config
    larger = parse(BASE, ["budget=1000"]).config
    assert larger.initial == 100
    assert fingerprint(resumed(larger, fingerprint(first))) == fingerprint(first)
    stated = parse(BASE, ["budget=1000", "initial=80"]).config
    assert resumed(stated, fingerprint(first)).initial == 80


def test_all_errors_at_once_each_at_its_place():
    assert errors(BASE + "bugdet: 10\nbatch: two\n") == [
        "f.yaml:3:1: bugdet: unknown key (did you mean 'budget'?)",
        "f.yaml:4:8: batch: must be a whole number, but got 'two'",
    ]


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("qqq: 1", "f.yaml:3:1: qqq: unknown key; the keys here are campaign, scenario"),
        ("budget: true", "f.yaml:3:9: budget: must be a whole number, but got true"),
        ("budget: 1.5", "budget: must be a whole number, but got 1.5"),
        ("budget: 0", "budget: must be greater than or equal to 1, but got 0"),
        ("seed: -1", "seed: must be greater than or equal to 0, but got -1"),
        ("initial: 501", "initial: initial <= budget must hold, but got initial 501, budget 500"),
        ("validation: {share: 1.0}", "f.yaml:3:21: validation.share: must be less than 1, but got 1.0"),
        ("executor: {workers: '2'}", "executor.workers: must be a whole number, but got '2'"),
        ("executor: {kind: daks}", "executor.kind: must be serial or local or dask, but got 'daks' (did you mean 'dask'?)"),
        ("executor: {address: 'tcp://a:1'}", "executor.address: only the executor dask takes it, but the executor is local"),
        ("executor: {kind: dask, address: a}", "executor.address: must be a scheduler's address such as tcp://host:8786, but got"),
        ("executor: {isolation: none}", "executor.isolation: must be 'auto', 'fresh', 'reuse', 'replicas' or 'snapshot', but got 'none'"),
        ("requirement: {critical: [1, 0.5]}", "requirement.critical: a critical interval needs low <= high, but got [1.0, 0.5]"),
        ("requirement: {critical: [-.inf, .inf]}", "requirement.critical: a critical interval needs at least one finite end"),
        ("requirement: {critical: [.nan, 1]}", "requirement.critical: a critical interval needs low <= high"),
        ("requirement: {critical: 0.5}", "requirement.critical: must be a list of two values, but got 0.5"),
        ("requirement: {critical: [a, 1]}", "f.yaml:3:26: requirement.critical.0: must be a number, but got 'a'"),
        ("inputs: {d: {mx: 4}}", "f.yaml:3:14: inputs.d.mx: unknown key (did you mean 'max'?)"),
        ("inputs: {d: {distribution: {mean: 1}}}", "inputs.d.distribution.kind: is required"),
        ("inputs: [d]", "f.yaml:3:9: inputs: must be a mapping (key: value), but got ['d']"),
        ("correlation: [{inputs: [a, b], value: 1}]", "correlation.0.value: must be less than 1, but got 1"),
        ("correlation: [{inputs: [a], value: 0}]", "correlation.0.inputs: must be a list of two values, but got ['a']"),
        ("correlation: [{inputs: [a, b], value: 0, vale: 0}]", "correlation.0.vale: unknown key (did you mean 'value'?)"),
        ("constraints: [a - b]", "f.yaml:3:15: constraints.0: must be a condition such as 'a < b', but got 'a - b'"),
        ("constraints: ['1 < 2']", "constraints.0: must use at least one input, but got '1 < 2'"),
        ("constraints: ['import os']", "constraints.0: an expression must be a formula"),
        ("features: {r: a < b}", "features.r: must be a number such as 'a / b', not a condition, but got 'a < b'"),
        ("features: {r: a + 1 / 0}", "features.r: a constant in 'a + 1 / 0' must be finite, but got 1 / 0"),
        ("features: {r: min(a)}", "features.r: min() in 'min(a)' takes 2 arguments, but got 1"),
        ("features: {r: a.b}", "features.r: an expression may use numbers"),
        ("ego: {model: IDM}", "ego.kind: is required"),
        ("ego: {kind: x, day: 2020-01-01}", "ego.day: must be plain data"),
        ("simulation: {step_length: 0}", "simulation.step_length: must be greater than 0, but got 0"),
        ("simulation: {step_length: .inf}", "simulation.step_length: must be a finite number"),
        ("metamodel: null", "metamodel: a boundary campaign needs a metamodel, but got null"),
        ("metamodel: gp", "metamodel: must be a mapping (key: value), but got 'gp'"),
        ("stop: {failures: 3}", "stop: a boundary campaign has the stop rules: stable, misclassified; but got failures"),
        ("store: ' '", "store: must not be empty"),
        ("seed: 1\nseed: 2", "f.yaml:4:1: seed: a key must stand once in its mapping, but 'seed' stands already in line 3"),
        ("covariates: yes", "f.yaml:3:13: covariates: must be auto, true or false, but got 'yes'"),
        ("warm_start: {store: s, transfer: yes}", "f.yaml:3:34: warm_start.transfer: must be true or false, but got 'yes'"),
        ("=: 2", "f.yaml:3:1: =: unknown key"),
        ("1: 2", "f.yaml:3:1: 1: keys must be text, but got 1"),
        ("seed: 1\nnull: 2", "f.yaml:4:1: None: keys must be text, but got null"),
        ("seed: 1\n0x10: 2", "f.yaml:4:1: 16: keys must be text, but got 16"),
        ("seed: 1\n? [a, b]\n: 2", "f.yaml:4:3: ('a', 'b'): keys must be text, but got ('a', 'b')"),
        ("inputs:\n  d_t:\n    true: 2", "f.yaml:5:5: inputs.d_t.1: keys must be text, but got true"),
        ("\t- x", "f.yaml:3:1: the file must be YAML, but while scanning"),
        ("budget: [1", "the file must be YAML"),
        ("budget: *x", "f.yaml:3:9: the file must be YAML, but found undefined alias 'x'"),
        ("budget: !!python/object:os.system x", "the file must be YAML, but could not determine a constructor"),
        ("store: a\x00b", "f.yaml:3:1: the file must be YAML, but unacceptable character"),
    ],
)
def test_a_wrong_line_is_refused(line: str, expected: str):
    found = errors(BASE + line + "\n")
    assert len(found) == 1
    assert expected in found[0]
    assert found[0].startswith("f.yaml:")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "f.yaml:1:1: a configuration needs at least campaign and scenario, but it is empty"),
        ("# nothing\n", "it is empty"),
        ("- a\n", "f.yaml:1:1: a configuration must be a mapping (key: value), but got ['a']"),
        ("scenario: x\n", "f.yaml:1:1: campaign: is required"),
        (
            "campaign: coverge\nscenario: x\n",
            "campaign: campaigns must be one of boundary, coverage, estimation, falsification, or file.py:NAME, but got 'coverge' (did you mean 'coverage'?)",
        ),
        (
            "campaign: coverage\nscenario: x\nacquisition: {kind: boundary}\n",
            "a coverage campaign draws by even, but got 'boundary'",
        ),
        (
            "campaign: coverage\nscenario: x\nstop: {stable: 0.1}\n",
            "a coverage campaign has the stop rules: none; but got stable",
        ),
    ],
)
def test_a_wrong_file_is_refused(text: str, expected: str):
    assert any(expected in line for line in errors(text))


def test_files_that_cannot_be_read(tmp_path: Path):
    (tmp_path / "latin.yaml").write_bytes(b"campaign: \xff\n")
    cases = {"none.yaml": "No such file", "": "this is a folder", "latin.yaml": "must be UTF-8 text, but byte 10"}
    for name, expected in cases.items():
        with pytest.raises(ConfigError, match=expected):
            load(tmp_path / name)


def test_set_replaces_and_adds_values(tmp_path: Path):
    path = tmp_path / "f.yaml"
    path.write_text(BASE + "inputs: {d_t: {min: 1}}\n")
    loaded = load(path, ["inputs.d_t.max=4.0", "budget=7", "executor.kind=serial", "requirement.critical=[-.inf, 2]"])
    assert (loaded.config.inputs["d_t"].min, loaded.config.inputs["d_t"].max, loaded.config.budget) == (1.0, 4.0, 7)
    assert loaded.config.requirement.critical == (-math.inf, 2.0)
    assert loaded.folder == tmp_path


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("budget=two", "--set budget: must be a whole number, but got 'two'"),
        ("bugdet=3", "--set bugdet: unknown key (did you mean 'budget'?)"),
        ("metamodel={kind: 3}", "--set metamodel: metamodel.kind: must be text, but got 3"),
        ("inputs.kind.choices={true: 0.5, a: 0.5}", "--set inputs.kind.choices: inputs.kind.choices.1: must be text, but got true"),
        ("budget", "--set budget: must be key.path=value, but got 'budget'"),
        ("a..b=3", "--set a..b=3: must be key.path=value"),
        ("scenario.b=2", "--set scenario.b: --set reaches into mappings only, but 'b' would be inside 'plugin.py:SCENARIO'"),
        ("budget=[1", "--set budget: the value must be YAML, but got '[1'"),
        (
            "inputs={d_t: {min: 1}, d_v: {min: 1}, d_t: {max: 2}}",
            "--set inputs:1:32: d_t: a key must stand once in its mapping, but 'd_t' stands already in line 1",
        ),
        ("a.b.c=1", "--set a.b.c: a: unknown key"),
        ("inputs.d_t.mxa=4", "--set inputs.d_t.mxa: unknown key (did you mean 'max'?)"),
        ("fidelity.cost=auto", "--set fidelity.cost: fidelity: must have step_length"),
        ("requirement.any=[]", "--set requirement.any: "),
        ("ego={kind: acc_aeb, settings: {a: 1, a: 2}}", "--set ego:1:34: settings.a: a key must stand once in its mapping"),
    ],
)
def test_a_wrong_set_is_refused(override: str, expected: str):
    found = errors(BASE, override)
    assert len(found) == 1
    assert found[0].startswith(expected)


def test_a_key_stands_once_in_a_value_of_the_command_line():
    assert read_value("{a: 1, b: {a: 2}}", "--ego params") == {"a": 1, "b": {"a": 2}}
    with pytest.raises(ConfigError, match=r"^--ego params:1:8: a: a key must stand once in its mapping"):
        read_value("{a: 1, a: 1}", "--ego params")


def test_yaml_traps_of_the_domain():
    config = parse(BASE + "simulation: {step_length: 1e-2}\ninputs: {d: {min: 010}}\nego: {kind: no, at: 12:30:00}\n").config
    assert config.simulation.step_length == 0.01
    assert config.inputs["d"].min == 10.0
    assert config.ego is not None
    assert (config.ego.kind, config.ego.settings) == ("no", {"at": "12:30:00"})


def test_errors_survive_pickling():
    error = ConfigError(["a", "b"])
    assert pickle.loads(pickle.dumps(error)).errors == ("a", "b")


def test_schema_describes_every_key():
    found = schema()
    assert found["required"] == ["campaign", "scenario"]
    campaign = found["properties"]["campaign"]
    assert campaign["examples"] == list(kinds())
    assert all(f"{name}: {kind.description}" in campaign["description"] for name, kind in kinds().items())
    assert found["$defs"]["ExecutorChoice"]["properties"]["kind"]["enum"] == list(EXECUTORS)
    models = [found, *(d for d in found["$defs"].values() if "properties" in d)]
    assert all("description" in key for model in models for key in model["properties"].values())


@pytest.mark.parametrize("campaign", kinds())
@pytest.mark.parametrize("key", ["metamodel", "acquisition"])
def test_schema_says_the_defaults_of_each_campaign(campaign: str, key: str):
    default = parse(f"campaign: {campaign}\nscenario: cut_in\n").config.model_dump(exclude_none=True).get(key)
    described = schema()["properties"][key]["description"]
    written = f"{campaign}: none" if default is None else f"{campaign}: {default['kind']}"
    if key == "metamodel" and default is not None:
        written = f"{campaign}: {{" + ", ".join(f"{k}: {json.dumps(v)}" for k, v in default.items()).replace('"', "") + "}"
    assert written in described


def test_a_full_configuration_is_assembled(folder: Path):
    loaded = parse(BASE + FULL, name="f.yaml", folder=folder)
    made = assemble(loaded)
    space = made.scenario.space
    assert space.parameters[0].high == 8.0
    assert space.parameters[0].distribution is not None
    assert space.correlation is not None
    assert space.correlation[0][1] == space.correlation[1][0] == 0.3
    assert [text for text, _ in space.constraints] == ["speed < 3 * gap"]
    assert [name for name, _ in space.features] == ["time"]
    assert (made.scenario.requirement.metric, made.scenario.requirement.critical.high) == ("other", 0.5)
    assert made.metamodel == ExtraTrees(trees=7)
    assert made.acquisition.__name__ == "my_acquisition"
    assert pickle.loads(pickle.dumps(made.spec)).resolve().name == "plane"
    assert scenario_of(loaded).requirement == made.scenario.requirement
    assert metamodel_of(loaded) == made.metamodel


def test_preset_and_settings_of_a_metamodel(folder: Path):
    loaded = parse(BASE, ["metamodel={kind: et, preset: paper, trees: 9}"], folder=folder)
    assert metamodel_of(loaded) == ExtraTrees(**{**ExtraTrees.PRESETS["paper"], "trees": 9})


def test_without_changes_the_scenario_is_the_plugins_own(folder: Path):
    loaded = parse(BASE, folder=folder)
    scenario = spec_of(loaded).resolve()
    assert scenario_of(loaded) == scenario
    assert spec_of(loaded).resolve() is scenario


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        ("inputs: {sped: {max: 3}}", "f.yaml:3:10: inputs.sped: an input must be one of speed, gap, n, but got 'sped' (did you mean 'speed'?)"),
        ("inputs: {speed: {max: -3}}", "inputs.speed: input speed: low < high must hold, but got low 0.0, high -3.0"),
        ("inputs: {n: {max: 2.5}}", "inputs.n: input n: an integer range needs whole ends"),
        ("inputs: {speed: {max: .inf}}", "inputs.speed: input speed: an infinite range needs a distribution"),
        ("inputs: {speed: {distribution: {kind: norml, mean: 1, std: 1}}}", "inputs.speed.distribution: a distribution's kind must be one of"),
        ("inputs: {speed: {distribution: {kind: normal, mean: 1}}}", "inputs.speed.distribution: distribution 'normal' takes mean, std"),
        ("inputs: {speed: {distribution: {kind: normal, mean: 1, std: a}}}", "inputs.speed.distribution: "),
        ("inputs: {speed: {distribution: {kind: normal, mean: 1, std: [2]}}}", "a distribution's parameters must be numbers, but got std: [2]"),
        ("inputs: {speed: {distribution: {kind: normal, mean: 900, std: 1}}}", "inputs.speed: a distribution must have mass in its range"),
        ("requirement: {metric: margn}", "f.yaml:3:23: requirement.metric: a metric must be one of margin, other, but got 'margn' (did you mean 'margin'?)"),
        ("requirement: {metric: other}", "requirement: critical: [low, high] is required with the metric other"),
        ("correlation: [{inputs: [speed, gp], value: 0.1}]", "f.yaml:3:24: correlation.0.inputs: an input must be one of speed, gap, n, but got 'gp' (did you mean 'gap'?)"),
        ("correlation: [{inputs: [gap, gap], value: 0.1}]", "a correlation needs two inputs, each pair once, but got gap, gap"),
        (
            "correlation: [{inputs: [speed, gap], value: 0.9}, {inputs: [gap, n], value: 0.9}, {inputs: [speed, n], value: -0.9}]",
            "f.yaml:3:14: correlation: correlation must be positive definite, but it is not",
        ),
        ("constraints: [sped < 3]", "f.yaml:3:15: constraints.0: a formula's name must be one of speed, gap, n, but got 'sped'"),
        ("constraints: [speed > 20]", "f.yaml:3:14: constraints: constraints must leave at least 0.001 of the box"),
        ("constraints: [speed == 3]", "two numbers are equal is written as abs(a - b) < 0.5"),
        ("features: {gap: speed / 2}", "f.yaml:3:12: features.gap: a feature must not have the name of an input, but got 'gap'"),
        ("features: {r: 1 / (speed - speed)}", "f.yaml:3:11: features: a derived feature must be finite and vary over the box, but 'r' does not"),
        ("simulation: {step_length: 0.1}", "f.yaml:3:27: simulation.step_length: scenario plane offers no choice of ego or step length"),
        ("ego: {kind: acc_aeb}", "f.yaml:3:6: ego: scenario plane offers no choice of ego or step length"),
        ("metamodel: {kind: gq}", "f.yaml:3:19: metamodel.kind: metamodels must be one of"),
        ("metamodel: {kind: et, tres: 3}", "f.yaml:3:12: metamodel: ExtraTrees takes a setting of"),
        ("metamodel: {kind: et, preset: papr}", "f.yaml:3:12: metamodel: ExtraTrees takes a preset of paper, but got 'papr'"),
        ("metamodel: {kind: 'plugin.py:my_acquisition'}", "metamodel.kind: a metamodel must be a class (or an object) with fit(u, y, rng)"),
        ("acquisition: {kind: bondary}", "f.yaml:3:21: acquisition.kind: acquisitions must be one of"),
        ("acquisition: {kind: mixx}", "or file.py:NAME, but got 'mixx' (did you mean 'mix'?)"),
        ("acquisition: {kind: 'plugin.py:NOT_A_SCENARIO'}", "acquisition.kind: an acquisition must be a function"),
    ],
)  # fmt: skip
def test_what_does_not_fit_the_scenario_is_refused_at_its_place(folder: Path, lines: str, expected: str):
    found = errors(BASE + lines + "\n", folder=folder, assembled=True)
    assert len(found) == 1
    assert expected in found[0]
    assert found[0].startswith("f.yaml:3:")


def test_problems_of_all_parts_are_raised_together(folder: Path):
    text = BASE + "inputs: {sped: {max: 3}}\nmetamodel: {kind: gq}\nacquisition: {kind: bondary}\n"
    assert [line.split(":")[1] for line in errors(text, folder=folder, assembled=True)] == ["3", "4", "5"]


@pytest.mark.parametrize(
    ("scenario", "expected"),
    [
        ("no_such", "scenario: scenarios must be one of"),
        ("none.py:SCENARIO", "scenario: a plug-in file must exist, but got"),
        ("plugin.py:SCENRIO", "must define SCENRIO, but it defines"),
        ("plugin.py:NOT_A_SCENARIO", "scenario: a scenario must be a LogicalScenario, but 'plugin.py:NOT_A_SCENARIO' is a int"),
        ("broken.py:SCENARIO", "broken.py:2 raised on import: ZeroDivisionError: division by zero"),
        ("syntax.py:SCENARIO", "syntax.py:1 raised on import: SyntaxError"),
    ],
)
def test_an_unusable_scenario_is_refused(folder: Path, scenario: str, expected: str):
    (folder / "broken.py").write_text("x = 1\ny = 1 / 0\n")
    (folder / "syntax.py").write_text("x = = 1\n")
    found = errors(f"campaign: boundary\nscenario: {scenario}\n", folder=folder, assembled=True)
    assert len(found) == 1
    assert found[0].startswith("f.yaml:2:11: scenario: ")
    assert expected in found[0]


def test_relative_controller_files_become_absolute(folder: Path):
    spec = spec_of(parse(BASE + "ego: {kind: 'ego.py:Ego', gain: 2}\n", folder=folder))
    assert spec.ego == {"kind": f"{folder}/ego.py:Ego", "gain": 2}


BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in pairwise("abcdefgh"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BOMB, "at most 100000 values, those that aliases"),
        ("a: &a [*a]\n", "at most 100000 values"),
        (f"store: {'x' * 2**20}\n", "at most 1048576 bytes"),
        ("budget: 1000000000000\n", "budget: must be less than or equal to 10000000"),
        ('scenario: "a\\0b.py:X"\n', "at most 4096 printable characters, but got 8 of them: 'a\\x00b.py:X'"),
        ("executor: {memory: 2 cats}\n", "must be bytes such as 2 GiB"),
        ("executor: {memory: 1 KiB}\n", "greater than or equal to 268435456"),
        ("executor: {kind: serial, recycle: 5}\n", "worker processes have it, but the executor is serial"),
    ],
    ids=["bomb", "endless", "long", "budget", "NUL", "cats", "little", "serial"],
)
def test_what_would_take_all_memory_or_time_is_refused_at_once(text: str, message: str):
    base = "campaign: coverage\n" + ("" if text.startswith("scenario") else "scenario: cut_in\n")
    with pytest.raises(ConfigError, match=re.escape(message)):
        parse(base + text)

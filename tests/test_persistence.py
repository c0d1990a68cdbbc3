"""Saved metamodels predict the same bits, are read without executing code, and bad files are refused."""

from __future__ import annotations

import dataclasses
import importlib
import io
import json
import pkgutil
import zipfile

import numpy as np
import pytest

import sbt.metamodels
from sbt.errors import InputError
from sbt.metamodels import persistence
from sbt.metamodels.automatic import Auto, MixturePredictor, ModelComparison
from sbt.metamodels.bayesian_network import BayesianNetwork
from sbt.metamodels.deep_ensemble import Ensemble
from sbt.metamodels.deep_gp import DeepGaussianProcess
from sbt.metamodels.extra_trees import ExtraTrees
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.persistence import load, read_info, save
from sbt.metamodels.saturation import Opened
from sbt.metamodels.sigma_point import DeepSigmaPointProcess
from sbt.metamodels.sparse_gp import SparseGaussianProcess
from sbt.plugins import names
from sbt.problem.requirement import CriticalInterval

KINDS = {
    "auto": Auto(folds=2),
    "bnn": BayesianNetwork(widths=(16, 16), max_steps=40, samples=5),
    "dgp": DeepGaussianProcess(inducing=8, samples=5, max_epochs=4),
    "dspp": DeepSigmaPointProcess(inducing=8, max_epochs=4),
    "ensemble": Ensemble(members=3, width=16, steps=40),
    "et": ExtraTrees(trees=20),
    "gp": GaussianProcess(student_t=True),
    "svgp": SparseGaussianProcess(inducing=10, steps=5),
}
U = np.random.default_rng(0).random((40, 3))
Y = np.sin(5 * U[:, 0]) + U[:, 1]


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "et.sbtmodel"
    save(ExtraTrees(trees=3).fit(U, Y, np.random.default_rng(0)), path, {"inputs": ["a", "b", "c"], "low": [0.0, 0.1, 1e-300]})
    return path


def rewritten(path, change=None, arrays=None):
    """Write the file again with another head or other arrays."""
    with zipfile.ZipFile(path) as file:
        parts = {name: file.read(name) for name in file.namelist()}
    head = json.loads(parts["model.json"])
    if change is not None:
        change(head)
    parts["model.json"] = json.dumps(head).encode()
    for name, array in (arrays or {}).items():
        buffer = io.BytesIO()
        np.save(buffer, array, allow_pickle=True)
        parts[name] = buffer.getvalue()
    with zipfile.ZipFile(path, "w") as file:
        for name, part in parts.items():
            file.writestr(name, part)
    return path


def test_every_built_in_metamodel_is_covered():
    assert set(KINDS) == set(names("metamodels"))


@pytest.mark.parametrize("name", KINDS)
def test_loaded_predictors_predict_the_same_bits(name, tmp_path):
    predictor = KINDS[name].fit(U, Y, np.random.default_rng(1))
    path = tmp_path / "model.sbtmodel"
    save(predictor, path)
    asked = np.random.default_rng(2).random((300, 3))
    before, after = predictor(asked), load(path)(asked)
    for field in ("mean", "std", "weight", "noise"):
        np.testing.assert_array_equal(getattr(before, field), getattr(after, field))
    again = tmp_path / "again.sbtmodel"
    save(load(path), again)
    assert again.read_bytes() == path.read_bytes()
    with zipfile.ZipFile(path) as file:
        assert not any(b"pickle" in file.read(n)[:200] or file.read(n)[:1] == b"\x80" for n in file.namelist())


@pytest.mark.parametrize(
    ("y", "critical"),
    [
        (np.maximum(Y - 0.3, 0.0), CriticalInterval(high=0.0)),  # ends at the edge: it is known of some rows that they lie below
        (np.maximum(Y - 0.3, 0.0), CriticalInterval(0.0, 0.4)),  # ends at an end of M_c
        ((Y > 0.5) * 1.0, CriticalInterval(low=1.0)),
    ],
)
def test_what_is_learned_of_a_metric_that_ends_is_loaded_as_it_was(y, critical, tmp_path):
    predictor = Opened(Auto(), critical).fit(U, y, np.random.default_rng(1))
    save(predictor, tmp_path / "model")
    before, after = predictor(U + 0.01), load(tmp_path / "model")(U + 0.01)
    np.testing.assert_array_equal(before.probability(critical), after.probability(critical))


def test_every_predictor_of_this_package_can_be_saved():
    found = {
        kind
        for module in pkgutil.iter_modules(sbt.metamodels.__path__, "sbt.metamodels.")
        for name, kind in vars(importlib.import_module(module.name)).items()
        if name.endswith(("Predictor", "Ending")) and dataclasses.is_dataclass(kind)
    }
    assert len(found) > 10
    assert found <= set(persistence._KINDS.values())


def test_auto_with_its_ensemble_keeps_its_choice(tmp_path):
    rng = np.random.default_rng(0)
    comparison = ModelComparison({"et": 0.25, "ensemble": 0.75}, {"et": -1.0, "ensemble": -0.5, "mixture": -0.4}, "because")
    parts = tuple(KINDS[name].fit(U, Y, rng) for name in comparison.weights)
    predictor = MixturePredictor(parts, np.array([0.25, 0.75]), comparison)
    save(predictor, tmp_path / "auto")
    loaded = load(tmp_path / "auto")
    assert loaded.comparison == comparison
    np.testing.assert_array_equal(loaded(U).mean, predictor(U).mean)


def test_info_is_kept(saved):
    assert read_info(saved) == {"inputs": ["a", "b", "c"], "low": [0.0, 0.1, 1e-300]}
    assert not list(saved.parent.glob("*.part"))


def test_what_cannot_be_saved_is_refused(tmp_path):
    with pytest.raises(InputError, match="own metamodels"):
        save(lambda u: None, tmp_path / "x")
    with pytest.raises(InputError, match="JSON"):
        save(ExtraTrees(trees=2).fit(U, Y, np.random.default_rng(0)), tmp_path / "x", {"low": float("nan")})
    assert not list(tmp_path.iterdir())


def test_files_that_are_no_models_are_refused(tmp_path, saved):
    with pytest.raises(InputError, match="there is no"):
        load(tmp_path / "absent")
    (tmp_path / "text").write_text("hello")
    np.savez(tmp_path / "other.npz", a=np.ones(2))
    (tmp_path / "cut").write_bytes(saved.read_bytes()[:-200])
    for name in ("text", "other.npz", "cut"):
        with pytest.raises(InputError, match="must be a saved model"):
            load(tmp_path / name)
    damaged = bytearray(saved.read_bytes())
    damaged[len(damaged) // 2] ^= 0xFF
    (tmp_path / "damaged").write_bytes(damaged)
    with pytest.raises(InputError, match="saved model"):
        load(tmp_path / "damaged")


def test_other_versions_are_refused(saved):
    with pytest.raises(InputError, match=rf"format {persistence.FORMAT}, but .* has 99"):
        load(rewritten(saved, lambda head: head.update(format=99)))


def test_no_code_is_executed(saved):
    def name_another_class(head):
        head["predictor"]["kind"] = "Popen"

    with pytest.raises(InputError, match="undamaged"):
        load(rewritten(saved, name_another_class))
    with pytest.raises(InputError, match="pickle"):
        load(rewritten(saved, lambda head: head["predictor"].update(kind="ForestPredictor"), {"0.npy": np.array([{}])}))


def test_trees_that_lead_out_of_memory_are_refused(saved):
    with zipfile.ZipFile(saved) as file:
        left = np.load(io.BytesIO(file.read("0.npy")))
        feature = np.load(io.BytesIO(file.read("2.npy")))
    for array, name in ((np.where(left >= 0, left + 10**6, left), "0.npy"), (np.where(left >= 0, 0, left), "0.npy"),
                        (np.where(feature >= 0, 77, feature), "2.npy")):  # fmt: skip
        with pytest.raises(InputError, match="a node"):
            load(rewritten(saved, arrays={name: array}))


def test_other_fields_are_refused(saved):
    with pytest.raises(InputError, match="undamaged"):
        load(rewritten(saved, lambda head: head["predictor"]["fields"].pop("floor")))
    with pytest.raises(InputError, match="must hold a predictor"):
        load(rewritten(saved, lambda head: head.update(predictor=3)))

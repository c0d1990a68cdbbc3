"""Fitted metamodels as files, without pickle: a zip of one JSON text and NumPy arrays.

Reading executes no code: the JSON names classes of a fixed list, whose fields are numbers, texts and
arrays. `numpy.load` and `unzip` can read the file too.
"""

from __future__ import annotations

import dataclasses
import io
import json
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbt.errors import InputError
from sbt.files import write_atomically
from sbt.metamodels import automatic as auto
from sbt.metamodels import bayesian_network as bnn
from sbt.metamodels import (
    classifier,
    expectation_propagation,
    flags,
    gp_algebra,
    gp_predictor,
    joint,
    labelled,
    noise_shape,
    over_traffic,
    prediction,
    recalibrated,
    rounded,
    saturation,
    sided,
    sparse,
    stepped,
    warp,
    warped,
)
from sbt.metamodels import deep_ensemble as ensemble
from sbt.metamodels import extra_trees as et
from sbt.metamodels.base import Predictor
from sbt.metamodels.torch_tools import device_of
from sbt.problem.combination import CombinedInterval
from sbt.problem.requirement import CriticalInterval

__all__ = ["FORMAT", "load", "read_info", "save"]

FORMAT = 2
"""Version of the file; a file of another version is refused."""

_HEAD = "model.json"
_KINDS: dict[str, Any] = {
    kind.__name__.lstrip("_"): kind
    for kind in (
        auto.ModelComparison,
        auto.MixturePredictor,
        bnn.BayesianNetworkPredictor,
        ensemble.EnsemblePredictor,
        et.ForestPredictor,
        CombinedInterval,
        CriticalInterval,
        gp_algebra.Hyperparameters,
        gp_predictor.GaussianProcessPredictor,
        gp_predictor.NoiseSpread,
        joint.JointPredictor,
        expectation_propagation.Belief,
        expectation_propagation.Hyper,
        classifier.Classifier,
        labelled.LabelledPredictor,
        flags.FlagPredictor,
        rounded.RoundedPredictor,
        recalibrated.RecalibratedPredictor,
        saturation.Ending,
        prediction.Scale,
        sparse.SparseLayer,
        sparse.SparseMixture,
        sparse.SparsePredictor,
        noise_shape.ShapedPredictor,
        over_traffic.MeanOverTraffic,
        over_traffic.OverTrafficPredictor,
        sided.SidedPredictor,
        stepped.Step,
        stepped.SteppedPredictor,
        warp.Warp,
        warp.LogWarp,
        warped.WarpedPredictor,
    )
}


def save(predictor: Predictor, path: Path | str, info: Mapping[str, Any] | None = None) -> None:
    """Write a predictor of this package to one file; an existing file is replaced at once or not at all.

    Args:
        predictor: what `fit` of a built-in metamodel returned.
        path: file to write, by custom `*.sbtmodel`.
        info: a description of the predictor, as JSON: names and ranges of its inputs, the metric.

    Raises:
        InputError: a predictor of another package, or `info` that JSON cannot hold.
    """
    target, arrays = Path(path), []  # type: tuple[Path, list[NDArray[Any]]]
    head = {"format": FORMAT, "info": dict(info or {}), "predictor": _encode(predictor, arrays)}
    try:
        text = json.dumps(head, allow_nan=False, indent=1)
    except (TypeError, ValueError) as error:
        raise InputError(f"a saved model and its info must be JSON without NaN, but got: {error}") from error
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr(zipfile.ZipInfo(_HEAD), text)  # ZipInfo: no date, the same model gives the same file
        for i, array in enumerate(arrays):
            buffer = io.BytesIO()
            np.save(buffer, array, allow_pickle=False)
            file.writestr(zipfile.ZipInfo(f"{i}.npy"), buffer.getvalue(), zipfile.ZIP_DEFLATED, 1)
    write_atomically(target, content.getvalue())


def load(path: Path | str, device: str | None = None) -> Predictor:
    """Return the predictor of a file; on the same device it predicts the same bits as the one that was saved.

    Args:
        path: what `save` wrote.
        device: where it will predict: auto, cpu or cuda; None: where it was fitted.

    Raises:
        InputError: no such file, not a saved model, damaged, of another version, or no such device.
    """
    if device is not None:
        device_of(device)  # refuses one that is not available
    head, file = _open(path)
    with file:
        try:
            predictor = _decode(head["predictor"], file, device)
        except (KeyError, ValueError, TypeError, AttributeError, EOFError, zipfile.BadZipFile) as error:
            raise InputError(f"{path} must be an undamaged saved model, but got {type(error).__name__}: {error}") from error
    if not callable(predictor):
        raise InputError(f"{path} must hold a predictor, but got {type(predictor).__name__}")
    return predictor


def read_info(path: Path | str) -> dict[str, Any]:
    """Return the `info` that `save` was given; the errors are those of `load`."""
    head, file = _open(path)
    file.close()
    return dict(head["info"])


def _open(path: Path | str) -> tuple[dict[str, Any], zipfile.ZipFile]:
    """Return the checked head of a file, and the open file."""
    try:
        file = zipfile.ZipFile(path)
    except FileNotFoundError as error:
        raise InputError(f"a saved model must exist, but there is no {path}") from error
    except (OSError, zipfile.BadZipFile) as error:
        raise InputError(f"{path} must be a saved model, but it cannot be read: {error}") from error
    try:
        head = json.loads(file.read(_HEAD))
        version = head["format"]
        if not isinstance(head["info"], dict):
            raise TypeError("info is not a mapping")
    except (KeyError, ValueError, TypeError, zipfile.BadZipFile) as error:
        file.close()
        raise InputError(f"{path} must be a saved model, but got {type(error).__name__}: {error}") from error
    if version != FORMAT:
        file.close()
        raise InputError(f"a saved model must have format {FORMAT}, but {path} has {version}: save it again")
    return head, file


def _encode(value: Any, arrays: list[NDArray[Any]]) -> Any:
    """Return JSON for a value; its arrays are appended to `arrays`."""
    if isinstance(value, float) and math.isinf(value):
        return {"infinite": value > 0}
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        arrays.append(value)
        return {"array": len(arrays) - 1}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, tuple):
        return {"tuple": [_encode(v, arrays) for v in value]}
    if isinstance(value, Mapping):
        return {"map": {str(k): _encode(v, arrays) for k, v in value.items()}}
    name = type(value).__name__.lstrip("_")
    if _KINDS.get(name) is type(value):
        names = [f.name for f in dataclasses.fields(value)]
        return {"kind": name, "fields": {n: _encode(getattr(value, n), arrays) for n in names}}
    if name == "Tree" and type(value).__module__ == "sklearn.tree._tree":
        return {"tree": {"inputs": value.n_features, "depth": value.max_depth, **{
            n: _encode(getattr(value, n), arrays) for n in ("children_left", "children_right", "feature", "threshold")
        }}}  # fmt: skip
    raise InputError(f"only predictors of sbt's own metamodels can be saved, but got a {type(value).__qualname__}")


def _decode(value: Any, file: zipfile.ZipFile, device: str | None) -> Any:
    """Return the value that `_encode` was given, but with this device."""
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return np.load(io.BytesIO(file.read(f"{int(value['array'])}.npy")), allow_pickle=False)
    if "infinite" in value:
        return math.inf if value["infinite"] else -math.inf
    if "tuple" in value:
        return tuple(_decode(v, file, device) for v in value["tuple"])
    if "map" in value:
        return {k: _decode(v, file, device) for k, v in value["map"].items()}
    if "tree" in value:
        return _tree(**{k: _decode(v, file, device) for k, v in value["tree"].items()})
    fields = {k: _decode(v, file, device) for k, v in value["fields"].items()}
    if device is not None and "device" in fields:
        fields["device"] = device
    return _KINDS[value["kind"]](**fields)


def _tree(
    inputs: int,
    depth: int,
    children_left: NDArray[np.int64],
    children_right: NDArray[np.int64],
    feature: NDArray[np.int64],
    threshold: NDArray[np.float64],
) -> Any:
    """Return scikit-learn's tree with these nodes, for finding leaves only.

    Raises:
        ValueError: nodes that are not a tree; scikit-learn would follow them out of its memory.
    """
    from sklearn.tree._tree import Tree

    count, inner = len(feature), children_left >= 0
    own = np.arange(count)
    for child in (children_left, children_right):
        if not ((child[inner] > own[inner]) & (child[inner] < count)).all() or not (child[~inner] == -1).all():
            raise ValueError("children of a node must come after it")
    if count == 0 or not ((feature[inner] >= 0) & (feature[inner] < inputs)).all():
        raise ValueError("a node must split one of the inputs")
    tree = Tree(inputs, np.array([1], dtype=np.intp), 1)
    empty = np.zeros(1, dtype=_node_dtype())
    nodes = np.repeat(empty, count)
    nodes["left_child"], nodes["right_child"] = children_left, children_right
    nodes["feature"], nodes["threshold"] = feature, threshold
    tree.__setstate__({"max_depth": depth, "node_count": count, "nodes": nodes, "values": np.zeros((count, 1, 1))})
    return tree


def _node_dtype() -> np.dtype[Any]:
    """Return the layout of a node in the scikit-learn that is installed."""
    from sklearn.tree import DecisionTreeRegressor

    state = DecisionTreeRegressor().fit(np.zeros((1, 1)), np.zeros(1)).tree_.__getstate__()
    layout: np.dtype[Any] = state["nodes"].dtype
    return layout

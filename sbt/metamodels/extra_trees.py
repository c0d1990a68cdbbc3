"""Extremely randomised trees: fast, no tuning, graceful in the tails; one Gaussian per tree.

Trees are grown by scikit-learn; what they predict (mean and variance of each leaf) is kept in tables.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from sbt.errors import InputError
from sbt.metamodels.base import check_rows, split_validation, standardise
from sbt.metamodels.prediction import Prediction
from sbt.problem.arrays import Points, Vector

__all__ = ["ExtraTrees", "ForestPredictor"]


@dataclass(frozen=True)
class ExtraTrees:
    """Settings of extra-trees (ET).

    A tree predicts the Gaussian of its leaf; the forest the mixture of its trees. The paper's
    preset learns from the last 80 % of the rows and predicts the one Gaussian that has the
    mixture's mean and variance (law of total variance).

    Args:
        trees: number of trees k, 1 to 10,000.
        min_samples_split: rows a node must hold to be split, >= 2.
        max_features: share of the inputs tried at a split, in (0, 1].
        sigma_floor: smallest sigma of a leaf, as a share > 0 of the standard deviation of y.
        mixture: predict the mixture of the trees; otherwise one moment-matched Gaussian.
        hold_out: leave out the first 20 % of the rows, as the paper does.

    Raises:
        InputError: a value outside its range.

    Source:
        Geurts et al. (2006); settings: Winkelmann et al. (2022), table of hyperparameters; total
        variance: Hutter et al. (2014), section 4.3.2.
    """

    trees: int = 100
    min_samples_split: int = 4
    max_features: float = 1.0
    sigma_floor: float = 0.01
    mixture: bool = True
    hold_out: bool = False

    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {
            "trees": 100,
            "min_samples_split": 4,
            "max_features": 1.0,
            "mixture": False,
            "hold_out": True,
        }
    }

    def __post_init__(self) -> None:
        if not (1 <= self.trees <= 10_000 and self.min_samples_split >= 2):
            raise InputError(
                "ExtraTrees needs trees in [1, 10000] and min_samples_split >= 2, "
                f"but got {self.trees} and {self.min_samples_split}"
            )
        if not 0.0 < self.max_features <= 1.0:
            raise InputError(f"max_features must be in (0, 1], but got {self.max_features}")
        if not self.sigma_floor > 0.0:
            raise InputError(f"sigma_floor must be > 0, but got {self.sigma_floor}")

    def fit(self, u: Points, y: Vector, rng: np.random.Generator) -> ForestPredictor:
        """Return the forest grown on u (n, d) and y (n,); see `Metamodel.fit`."""
        from sklearn.ensemble import ExtraTreesRegressor

        u, y = check_rows(u, y)
        if self.hold_out:
            _, training = split_validation(len(y))
            u, y = u[training], y[training]
        z, shift, scale = standardise(y)
        forest = ExtraTreesRegressor(
            n_estimators=self.trees,
            min_samples_split=self.min_samples_split,
            max_features=self.max_features,
            random_state=int(rng.integers(2**31)),
            n_jobs=1,
        ).fit(u.astype(np.float32), z)
        trees = tuple(tree.tree_ for tree in forest.estimators_)
        return ForestPredictor(
            trees=trees,
            offset=np.cumsum([0, *(tree.node_count for tree in trees)])[:-1],
            mean=shift + scale * np.concatenate([tree.value[:, 0, 0] for tree in trees]),
            variance=scale**2 * np.concatenate([np.maximum(tree.impurity, 0.0) for tree in trees]),
            floor=scale * self.sigma_floor,
            mixture=self.mixture,
        )


@dataclass(frozen=True, eq=False)
class ForestPredictor:
    """A grown forest: the trees find the leaf, the tables of all trees' nodes hold its mean and variance.

    Args:
        trees: k scikit-learn trees, used to find leaves only.
        offset: (k,) where the nodes of a tree begin in the tables.
        mean: (nodes,) mean of y in a node.
        variance: (nodes,) variance of y in a node.
        floor: smallest standard deviation of a leaf.
        mixture: predict the mixture of the trees; otherwise one moment-matched Gaussian.
    """

    trees: tuple[Any, ...]
    offset: NDArray[np.int64]
    mean: Vector
    variance: Vector
    floor: float
    mixture: bool

    def __call__(self, u: Points) -> Prediction:
        """Return the prediction at u (n, d)."""
        node = self._nodes(u)
        mean, variance = self.mean[node], self.variance[node] + self.floor**2  # (k, n)
        noise = np.sqrt(variance.mean(axis=0))
        k = len(self.trees)
        mixture = Prediction(mean, np.sqrt(variance), np.full(k, 1.0 / k), noise)
        return mixture if self.mixture else Prediction.gaussian(mixture.mu, mixture.sigma, noise)

    def mu(self, u: Points) -> Vector:
        """Return the (n,) mean of the trees, without their variance."""
        return np.asarray(self.mean[self._nodes(u)].mean(axis=0))

    @property
    def largest_mu(self) -> float:
        """Upper bound of `mu`: the mean of the trees' largest leaves."""
        return float(np.mean([part.max() for part in np.split(self.mean, self.offset[1:])]))

    def _nodes(self, u: Points) -> NDArray[np.int64]:
        """Return (k, n) rows of the tables: the leaves that the points fall into."""
        points = np.ascontiguousarray(u, dtype=np.float32)
        node = np.empty((len(self.trees), len(points)), dtype=np.int64)
        for row, tree, offset in zip(node, self.trees, self.offset, strict=True):
            np.add(tree.apply(points), offset, out=row)
        return node

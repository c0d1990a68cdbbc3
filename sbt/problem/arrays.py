"""Array roles and the checks at every seam: NumPy float64, shapes stated, no silent broadcasting."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["FARTHEST", "NEAREST", "Mask", "Points", "Vector", "as_points", "as_vector"]

Vector = NDArray[np.float64]
"""(n,) numbers, one a point."""
Points = NDArray[np.float64]
"""(n, d) coordinates, one row a point."""
Mask = NDArray[np.bool_]
"""(n,) booleans, one a point."""
FARTHEST, NEAREST = 1e100, 1e-100
"""Largest magnitude of a number that means something, and smallest distance of two: beyond, squares and figures overflow."""


def as_points(values: ArrayLike, dimension: int | None = None) -> Points:
    """Return `values` as a finite float64 array of shape (n, d).

    Raises:
        ValueError: not two-dimensional, not `dimension` columns, or not finite.
    """
    points = np.ascontiguousarray(values, dtype=np.float64)
    if points.ndim != 2:
        raise ValueError(f"points must have shape (n, d), but got shape {points.shape}")
    if dimension is not None and points.shape[1] != dimension:
        raise ValueError(f"points must have {dimension} columns, but got {points.shape[1]}")
    if not np.isfinite(points).all():
        raise ValueError("points must be finite, but got NaN or infinity")
    return points


def as_vector(values: ArrayLike | Sequence[float], length: int | None = None) -> Vector:
    """Return `values` as a float64 array of shape (n,).

    Raises:
        ValueError: not one-dimensional or not of the given length.
    """
    vector = np.ascontiguousarray(values, dtype=np.float64)
    if vector.ndim != 1:
        raise ValueError(f"a vector must have shape (n,), but got shape {vector.shape}")
    if length is not None and vector.shape[0] != length:
        raise ValueError(f"a vector must have {length} entries, but got {vector.shape[0]}")
    return vector

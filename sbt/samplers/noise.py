"""How much noise hides: scores of ranks, and what runs of equal inputs tell of the simulator."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sbt.problem.arrays import Points, Vector

__all__ = ["by_chance", "hidden_by_noise", "more_repeats", "scores"]

_HIDDEN = 0.1  # share of the noise in the variance of the scores, from which on values of single runs mislead
_PERMUTATIONS, _MOST_ROWS = 199, 400  # of a test; runs that it looks at, the last ones
_REPEATS = 4  # of any inputs: two tell whether there is noise, four whether it is large


def scores(margin: Vector) -> Vector:
    """Return (n,) minus the squared logarithm of the rank's share: what is learned of margins (n,); smaller is nearer.

    Only the order counts, and most at the low end. If P(margin <= t | x) is a power a of its mean over all runs, the mean score
    at x is -2 / a^2: its order is that of P(critical), however rare it is. Squared, since inputs often move the low end alone.

    Source:
        Savage (1956), Annals of Mathematical Statistics 27: scores for Lehmann's alternatives; the square was measured.

    >>> scores(np.array([2.0, 0.1, np.inf])).round(2).tolist()
    [-0.48, -1.92, -0.08]
    """
    from scipy.stats import rankdata  # half of the time in which a command starts

    return -(np.log(rankdata(margin) / (len(margin) + 1.0)) ** 2)


def hidden_by_noise(u: Points, margin: Vector) -> bool:
    """Say whether noise makes up a tenth or more of the variance of the scores, by runs of equal u (n, d)."""
    score = scores(margin)
    group, count = _groups(u)
    again = int((count - 1).sum())
    if again == 0 or score.var() == 0.0:
        return False
    mean = np.bincount(group, score) / count
    return float(((score - mean[group]) ** 2).sum()) / again >= _HIDDEN * float(score.var())


def by_chance(inputs: Points, score: Vector, rng: np.random.Generator) -> float:
    """Return how often scores (n,) that were shuffled depend as much on the inputs (n, k) as these do.

    A permutation test of the Hilbert-Schmidt independence criterion, with the sum of a linear and a Gaussian kernel: trends, and
    hollows of about half of the median distance. Of the last 400 runs.

    Source:
        Gretton et al. (2008), A kernel statistical test of independence, NIPS 20.
    """
    from scipy.spatial.distance import pdist, squareform  # as in `scores`

    inputs, score = inputs[-_MOST_ROWS:], score[-_MOST_ROWS:] - score[-_MOST_ROWS:].mean()
    square = pdist(inputs, "sqeuclidean")
    if not square.any() or not score.any():
        return 1.0
    width = np.median(square[square > 0.0]) / 4.0
    kernel = sum(_centred(each) for each in (np.exp(-squareform(square) / width), inputs @ inputs.T))
    shuffled = np.vstack([score, rng.permuted(np.tile(score, (_PERMUTATIONS, 1)), axis=1)])
    found = ((shuffled @ kernel) * shuffled).sum(axis=1)
    return float((found[1:] >= found[0]).mean())


def _centred(kernel: Points) -> Points:
    """Return a kernel (n, n) without what is the same for all, of unit size."""
    kernel = kernel - kernel.mean(axis=0) - kernel.mean(axis=1)[:, None] + kernel.mean()
    return kernel / max(float(np.linalg.norm(kernel)), 1e-300)


def more_repeats(u: Points, margin: Vector) -> tuple[int, ...]:
    """Return rows to run again, those of the smallest margin, until four runs of u (n, d) repeat others."""
    group, count = _groups(u)
    rows = [int(k) for k in np.argsort(margin, kind="stable") if count[group[k]] == 1 and np.isfinite(margin[k])]
    return tuple(rows[: max(_REPEATS - int((count - 1).sum()), 0)])


def _groups(u: Points) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return (n,) numbers, equal for equal rows of u (n, d), and how many rows each number has."""
    _, group, count = np.unique(u, axis=0, return_inverse=True, return_counts=True)
    return group.reshape(-1), count

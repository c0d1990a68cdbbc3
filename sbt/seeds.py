"""The only source of randomness: named streams that are functions of one campaign seed.

A stream depends on nothing but the seed and its path, so that a resumed campaign, another executor
or another number of workers draws the same numbers.

>>> a = stream(7, "propose", 3).random()
>>> b = stream(7, "propose", 3).random()
>>> a == b, a == stream(7, "propose", 4).random()
(True, False)
"""

from __future__ import annotations

import hashlib

import numpy as np

__all__ = ["run_seed", "stream"]


def stream(seed: int, *path: int | str) -> np.random.Generator:
    """Return the generator that belongs to `path` under `seed`.

    Args:
        seed: campaign or run seed, any integer >= 0.
        path: names and numbers that say what the numbers are for.

    Raises:
        ValueError: the seed is negative.
    """
    if seed < 0:
        raise ValueError(f"a seed must be an integer >= 0, but got {seed}")
    key = "/".join(f"{type(part).__name__}:{part}" for part in path).encode()
    words = np.frombuffer(hashlib.blake2b(key, digest_size=16).digest(), dtype=np.uint32)
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, *words.tolist()])))


def run_seed(seed: int, index: int) -> int:
    """Return the seed of run `index`: a 31-bit integer, as SUMO's `--seed` takes."""
    return int(stream(seed, "run", index).integers(0, 2**31 - 1))

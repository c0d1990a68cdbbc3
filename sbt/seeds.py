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
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["SEED_END", "run_seed", "run_seeds", "stream"]

SEED_END = 2**31 - 1
"""Seeds of runs are integers from 0, below this: what SUMO's `--seed` takes."""
_HASHED, _MIXED, _OUT = (0x43B0D7E5, 0x931E8875), (0xCA01F9DD, 0x4973F715), (0x8B51F9DD, 0x58F38DED)
"""Constants of NumPy's `SeedSequence`."""
_POOL, _WORDS = 4, 8
_PCG, _MASK_32, _MASK_64, _MASK_128 = 0x2360ED051FC65DA44385DF649FCCF645, 2**32 - 1, 2**64 - 1, 2**128 - 1
_LEAST_AT_ONCE, _MOST_AT_ONCE = 16, 4096
_REJECTED = (2**31 + 1) % SEED_END


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
    words = np.frombuffer(_digest("/".join(f"{type(part).__name__}:{part}" for part in path)), dtype=np.uint32)
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, *words.tolist()])))


def _digest(key: str) -> bytes:
    return hashlib.blake2b(key.encode(), digest_size=16).digest()


def run_seed(seed: int, index: int) -> int:
    """Return the seed of run `index`: a 31-bit integer, as SUMO's `--seed` takes."""
    return int(stream(seed, "run", index).integers(0, SEED_END))


def run_seeds(seed: int, indices: Sequence[int]) -> list[int]:
    """Return `run_seed` of many runs, in a tenth of the time: NumPy's own arithmetic, on all runs at once.

    Source:
        `numpy.random.SeedSequence` and `PCG64`, whose streams NumPy guarantees to stay; O'Neill (2014), PCG; Lemire (2019),
        doi 10.1145/3230636.

    >>> run_seeds(7, range(20)) == [run_seed(7, k) for k in range(20)]
    True
    """
    if len(indices) > _MOST_AT_ONCE:
        return [k for at in range(0, len(indices), _MOST_AT_ONCE) for k in run_seeds(seed, indices[at : at + _MOST_AT_ONCE])]
    if len(indices) < _LEAST_AT_ONCE or not 0 <= seed <= _MASK_32:
        return [run_seed(seed, index) for index in indices]
    digests = b"".join([_digest(f"str:run/int:{int(index)}") for index in indices])
    words = np.frombuffer(digests, dtype=np.uint32).reshape(-1, 4).T
    states = _pcg_states(np.vstack([np.full((1, words.shape[1]), seed, np.uint32), words])).tolist()
    found = [_first_below(a << 64 | b, c << 64 | d) for a, b, c, d in states]
    return [run_seed(seed, index) if value is None else value for value, index in zip(found, indices, strict=True)]


def _pcg_states(entropy: NDArray[np.uint32]) -> NDArray[np.uint64]:
    """Return (n, 4) `SeedSequence(words).generate_state(4, np.uint64)` of each column of entropy (k, n), k >= 4 words."""
    constant = _HASHED[0]

    def hashed(value: NDArray[np.uint32]) -> NDArray[np.uint32]:
        nonlocal constant
        value = value ^ np.uint32(constant)
        constant = constant * _HASHED[1] & _MASK_32
        return _folded(value * np.uint32(constant))

    pool = [hashed(word) for word in entropy[:_POOL]]
    pairs = [(source, k) for source in range(_POOL) for k in range(_POOL) if k != source]
    for source, k in pairs:
        pool[k] = _mixed(pool[k], hashed(pool[source]))
    for word in entropy[_POOL:]:
        pool = [_mixed(each, hashed(word)) for each in pool]
    constants = [_OUT[0] * pow(_OUT[1], k, 2**32) & _MASK_32 for k in range(_WORDS + 1)]
    words = [_folded((pool[k % _POOL] ^ np.uint32(constants[k])) * np.uint32(constants[k + 1])) for k in range(_WORDS)]
    return np.stack(words, axis=1).astype("<u4").view("<u8")


def _folded(value: NDArray[np.uint32]) -> NDArray[np.uint32]:
    return value ^ (value >> np.uint32(16))


def _mixed(x: NDArray[np.uint32], y: NDArray[np.uint32]) -> NDArray[np.uint32]:
    return _folded(np.uint32(_MIXED[0]) * x - np.uint32(_MIXED[1]) * y)


def _first_below(state: int, increment: int) -> int | None:
    """Return the first `integers(0, SEED_END)` of `PCG64` begun with these two; None where its first draw is rejected."""
    step = (increment << 1 | 1) & _MASK_128
    state = ((state + step) * _PCG + step) & _MASK_128  # as seeded
    state = (state * _PCG + step) & _MASK_128
    turn, value = state >> 122, (state >> 64 ^ state) & _MASK_64
    low = (value >> turn | value << (64 - turn)) & _MASK_32
    product = low * SEED_END
    return None if product & _MASK_32 < _REJECTED else product >> 32

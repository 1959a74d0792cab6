"""Numbers drawn by particle id: each depends on its id alone, so that they are the same on any number of ranks."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mpipic.arrays import FloatArray, IntArray

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
"""Fractional part of the golden ratio in units of 2⁻⁶⁴."""


def uniform(seed: int, ids: IntArray, columns: int) -> FloatArray:
    """Return uniform numbers in [0, 1), shape (n, columns <= 4), that depend on seed and id only.

    Row j is the block of four that NumPy's Philox generator with key `seed` gives at counter ids[j]; `ids` must be
    consecutive, so that one jump ahead reaches them all. Local; O(n).
    """
    if len(ids) == 0:
        return np.empty((0, columns))
    if ids[-1] - ids[0] + 1 != len(ids):
        raise ValueError("ids must be consecutive")
    stream = np.random.Philox(key=seed)
    stream.advance(int(ids[0]))
    return np.random.Generator(stream).random((len(ids), 4))[:, :columns]


def noise(ids: IntArray) -> FloatArray:
    """Return white noise, uniform in [-1, 1), shape of `ids`, which may be any (SplitMix64). Local; O(n)."""
    z = golden_turns(ids) + GOLDEN
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return np.asarray((z >> np.uint64(11)).astype(np.float64) * 2.0**-52 - 1.0)


def golden_turns(ids: IntArray) -> npt.NDArray[np.uint64]:
    """Return the fractional parts of golden ratio × id, in units of 2⁻⁶⁴: evenly spread for any run of ids. Local.

    The product wraps on purpose.
    """
    return ids.astype(np.uint64) * GOLDEN

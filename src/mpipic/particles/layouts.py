"""Where particles start: layouts, drawn by global id, so that they are the same on any number of ranks."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from mpipic.arrays import FloatArray, IntArray
from mpipic.draws import uniform
from mpipic.mesh.grid import Grid

Layout = Callable[[Grid, Sequence[int], float, int, IntArray], FloatArray]


def _lattice(grid: Grid, per_cell: Sequence[int], jitter: float, seed: int, ids: IntArray) -> FloatArray:
    """Return a cell-centred lattice: (j + 1/2) / per_cell cells along each axis, ids counting x fastest."""
    points = [n * k for n, k in zip(grid.cells, per_cell, strict=True)]
    index = np.unravel_index(ids, points[::-1])[::-1]
    return np.stack([(j + 0.5) / k for j, k in zip(index, per_cell, strict=True)], axis=1)


def _jittered(grid: Grid, per_cell: Sequence[int], jitter: float, seed: int, ids: IntArray) -> FloatArray:
    """Return the lattice, every particle moved by up to `jitter` particle spacings along every axis."""
    offset = (2.0 * uniform(seed, ids, grid.dim) - 1.0) * jitter / np.array(per_cell)
    return _lattice(grid, per_cell, jitter, seed, ids) + offset


def _random(grid: Grid, per_cell: Sequence[int], jitter: float, seed: int, ids: IntArray) -> FloatArray:
    """Independent, uniform in the box."""
    return uniform(seed, ids, grid.dim) * np.array(grid.cells)


LAYOUTS: dict[str, Layout] = {"lattice": _lattice, "jittered": _jittered, "random": _random}
"""Name to function (grid, per_cell, jitter, seed, ids) -> coordinates (n, d), in cells, of those ids."""


def share(total: int, grid: Grid) -> IntArray:
    """This rank's contiguous part of the ids 0 to total - 1. Local."""
    edges = [total * r // grid.size for r in (grid.rank, grid.rank + 1)]
    return np.arange(*edges, dtype=np.int64)

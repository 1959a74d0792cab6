"""Axis by axis, a block of particles at a time, in any dimension: where they are, where they go, who leaves.

These loops run over particles without touching nodes, and the compiler turns them into vector code. A block and
what is found of it fit the first cache. Arguments as in `kernels.advance`.
"""

import numpy as np

from mpipic.kernels.common import cell_and_fraction, exactly, inlined, inner, inner_exactly

BLOCK = 256


@inner_exactly
def _place_first(x, tolerance, first, origin, node, cell, fraction):
    """Find node and cell indices from the first axis, and the local coordinate along it."""
    for p in range(x.size):
        c, fraction[p] = cell_and_fraction(x[p], tolerance)
        cell[p] = c - first
        node[p] = c - first + origin


@inner_exactly
def _place_next(x, tolerance, first, node_stride, cell_stride, node, cell, fraction):
    """Add another axis' part to the node and cell indices, and find the local coordinate along it."""
    for p in range(x.size):
        c, fraction[p] = cell_and_fraction(x[p], tolerance)
        node[p] += node_stride * (c - first)
        cell[p] += cell_stride * (c - first)


@exactly
def mark_outside(x, tolerance, first, size, outside):
    """Set `outside` where the cell along this axis is not one of `size` from `first`."""
    for p in range(x.size):
        c = np.int32(x[p] + tolerance) - first
        outside[p] |= np.int32(c < 0) | np.int32(c >= size)


@exactly
def move(x, shift, period, tolerance):
    """Move by less than one period and wrap into [-tolerance, period - tolerance): what is on node 0 is in cell 0."""
    for p in range(x.size):
        t = x[p] + shift
        t -= period * np.float64(t >= period - tolerance)
        x[p] = t + period * np.float64(t < -tolerance)


@exactly
def move_each(x, shifts, period, tolerance):
    """Move every particle by its own shift, and wrap, as `move` does."""
    for p in range(x.size):
        t = x[p] + shifts[p]
        t -= period * np.float64(t >= period - tolerance)
        x[p] = t + period * np.float64(t < -tolerance)


@inner
def find(axes, p0, count, geometry, shape, layout, node, cell, fraction):
    """Find nodes, cells and local coordinates of a block."""
    strides, cell_stride = (1, layout[1], layout[2]), 1
    for a in range(axes.shape[0]):
        x = axes[a, p0 : p0 + count]
        tolerance, first = geometry[1][a], np.int32(geometry[4][a])
        if a == 0:
            _place_first(x, tolerance, first, np.int32(layout[0]), node, cell, fraction[a])
        else:
            _place_next(x, tolerance, first, np.int32(strides[a]), np.int32(cell_stride), node, cell, fraction[a])
        cell_stride *= shape[a]


@inner
def move_block(axes, p0, count, geometry):
    """Move a block by the displacement of this step."""
    for a in range(axes.shape[0]):
        move(axes[a, p0 : p0 + count], geometry[3][a], geometry[2][a], geometry[1][a])


@inner
def find_leavers(axes, p0, count, geometry, shape, outside, leaving, left):
    """Mark who is outside, append to `leaving`, and return how many have left so far."""
    outside[:count] = 0
    for a in range(axes.shape[0]):
        x = axes[a, p0 : p0 + count]
        mark_outside(x, geometry[1][a], np.int32(geometry[4][a]), np.int32(shape[a]), outside)
    for p in range(count):
        if outside[p]:
            if left < leaving.size:
                leaving[left] = p0 + p
            left += 1
    return left


@inner
def breaks_of(cell, next_cell, before):
    """Return how many cells differ from that of the particle before; next_cell is `cell` without its first entry."""
    total = np.int32(cell[0] != before)
    for p in range(next_cell.size):
        total += np.int32(next_cell[p] != cell[p])
    return total


@inlined
def scratch(dim):
    """Return room for node, cell, outside (3, BLOCK) and local coordinates (d, BLOCK) of a block."""
    return np.zeros((3, BLOCK), np.int32), np.empty((dim, BLOCK))

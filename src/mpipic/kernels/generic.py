"""Loops that serve any number of columns and any dimension: mapping of single fields, sorting.

Coordinates are (n, d), in cells, values (n, k), nodal arrays (nodes, k), all C-contiguous. `locate` finds the cell of
every particle once; the mapping loops then use its answer.
"""

import numpy as np

from mpipic.kernels.common import cell_and_fraction, hot, inner


@hot
def locate(coordinate, tolerance, first, shape, cell, fraction):
    """Find the local cell index (x fastest) and the local coordinates of every particle.

    `tolerance`, `first`, `shape` : arrays (d,). Returns the index of the first particle outside
    this rank's cells, or -1; `cell` is -1 for such particles.
    """
    stray = -1
    for p in range(coordinate.shape[0]):
        index, stride, inside = 0, 1, True
        for a in range(coordinate.shape[1]):
            c, fraction[p, a] = cell_and_fraction(coordinate[p, a], tolerance[a])
            c -= first[a]
            inside = inside and coordinate[p, a] >= -tolerance[a] and 0 <= c < shape[a]
            index += c * stride
            stride *= shape[a]
        cell[p] = index if inside else -1
        if not inside and stray < 0:
            stray = p
    return stray


@inner
def node_of(cell, shape, layout):
    """Return the lowest node of a local cell: shape (3,) padded with 1, layout = (first node, strides of y and z)."""
    rest, i = divmod(cell, shape[0])
    k, j = divmod(rest, shape[1])
    return layout[0] + i + j * layout[1] + k * layout[2]


@hot
def add_moments(cell, fraction, weight, out):
    """Add to `out` (cells, 3^d) the pair moments of every particle times its weight (see `kernels.cells`)."""
    dim, width = fraction.shape[1], out.shape[1]
    for p in range(cell.size):
        for q in range(width):
            product, rest = weight[p], q
            for a in range(dim):
                rest, pair = divmod(rest, 3)
                upper = fraction[p, a]
                lower = 1.0 - upper
                product *= lower * lower if pair == 0 else lower * upper if pair == 1 else upper * upper
            out[cell[p], q] += product


@hot
def invert(weights, out):
    """Set out = 1 / weights; 0 where the weight is 0 (a node that no particle sees)."""
    for n in range(out.size):
        w = weights[n]
        out[n] = 1.0 / w if w > 0.0 else 0.0


@hot
def scale_rows(values, factors, out):
    """Set `out` to values times one factor a row."""
    if values.shape[1] == 1:
        for n in range(out.shape[0]):
            out[n, 0] = values[n, 0] * factors[n]
    else:
        for n in range(out.shape[0]):
            for k in range(out.shape[1]):
                out[n, k] = values[n, k] * factors[n]


@hot
def scale_changed(values, rate, change, factors, out):
    """Set `out` to (values + rate change) times one factor a row."""
    if values.shape[1] == 1:
        for n in range(out.shape[0]):
            out[n, 0] = (values[n, 0] + rate * change[n, 0]) * factors[n]
    else:
        for n in range(out.shape[0]):
            for k in range(out.shape[1]):
                out[n, k] = (values[n, k] + rate * change[n, k]) * factors[n]


@hot
def sort_order(cell, cells, order):
    """Sort by counting, stably: order[j] becomes the index of the particle that comes j-th by cell."""
    start = np.zeros(cells + 1, dtype=np.int64)
    for p in range(cell.size):
        start[cell[p] + 1] += 1
    for c in range(cells):
        start[c + 1] += start[c]
    for p in range(cell.size):
        order[start[cell[p]]] = p
        start[cell[p]] += 1

"""Loops that serve any number of columns and any dimension: mapping of single fields, sorting, packing.

Coordinates are (n, d), in cells, values (n, k), nodal arrays (nodes, k), all C-contiguous. `locate` finds the cell of
every particle once; the mapping loops then use its answer.
"""

import numpy as np

from mpipic.kernels.common import U, cell_and_fraction, hot


@hot
def locate(coordinate, tolerance, first, shape, cell, fraction):
    """Local cell index (x fastest) and local coordinates of every particle.

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


@hot
def node_of(cell, shape, layout):
    """The lowest node of a local cell: shape (3,) padded with 1, layout = (first node, strides of y and z)."""
    rest, i = divmod(cell, shape[0])
    k, j = divmod(rest, shape[1])
    return layout[0] + i + j * layout[1] + k * layout[2]


@hot
def _corner(corner, dim, layout):
    """Offset of corner 0 to 2^d - 1 (bit a: upper node along axis a) from the lowest node of its cell."""
    offset = corner & 1
    for a in range(1, dim):
        offset += ((corner >> a) & 1) * layout[a]
    return offset


@hot
def _weight(corner, fraction, p):
    w = 1.0
    for a in range(fraction.shape[1]):
        w *= fraction[p, a] if (corner >> a) & 1 else 1.0 - fraction[p, a]
    return w


@hot
def _slope_weight(corner, axis, fraction, p, inverse_h):
    """Derivative along `axis` of the corner's shape function."""
    w = inverse_h[axis]
    for a in range(fraction.shape[1]):
        upper = (corner >> a) & 1
        if a == axis:
            w *= 1.0 if upper else -1.0
        else:
            w *= fraction[p, a] if upper else 1.0 - fraction[p, a]
    return w


@hot
def add_sums(cell, fraction, values, shape, layout, out):
    """out += Φᵀ values, column by column."""
    dim, columns = fraction.shape[1], values.shape[1]
    for p in range(cell.size):
        node = node_of(cell[p], shape, layout)
        for corner in range(1 << dim):
            n = U(node + _corner(corner, dim, layout))
            w = _weight(corner, fraction, p)
            for k in range(columns):
                out[n, U(k)] += w * values[p, k]


@hot
def shape_functions(cell, fraction, shape, layout, node, value):
    """The nodes that each particle touches and its weights there, (n, 2^d)."""
    dim = fraction.shape[1]
    for p in range(cell.size):
        first = node_of(cell[p], shape, layout)
        for corner in range(1 << dim):
            node[p, corner] = first + _corner(corner, dim, layout)
            value[p, corner] = _weight(corner, fraction, p)


@hot
def add_moments(cell, fraction, weight, out):
    """out (cells, 3^d) += the pair moments of every particle times its weight (see `kernels.cells`)."""
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
def add_interpolated(cell, fraction, nodal, shape, layout, out):
    """out += Φ nodal, column by column."""
    dim, columns = fraction.shape[1], nodal.shape[1]
    for p in range(cell.size):
        node = node_of(cell[p], shape, layout)
        for corner in range(1 << dim):
            n = U(node + _corner(corner, dim, layout))
            w = _weight(corner, fraction, p)
            for k in range(columns):
                out[p, k] += w * nodal[n, U(k)]


@hot
def add_gradient(cell, fraction, nodal, inverse_h, shape, layout, out):
    """out[:, a] += D^a nodal, for one column."""
    dim = fraction.shape[1]
    for p in range(cell.size):
        node = node_of(cell[p], shape, layout)
        for corner in range(1 << dim):
            value = nodal[U(node + _corner(corner, dim, layout))]
            for a in range(dim):
                out[p, a] += _slope_weight(corner, a, fraction, p, inverse_h) * value


@hot
def add_divergence(cell, fraction, nodal, inverse_h, shape, layout, out):
    """out += sum over the axes of D^a nodal[:, a]."""
    dim = fraction.shape[1]
    for p in range(cell.size):
        node = node_of(cell[p], shape, layout)
        for corner in range(1 << dim):
            n = U(node + _corner(corner, dim, layout))
            for a in range(dim):
                out[p] += _slope_weight(corner, a, fraction, p, inverse_h) * nodal[n, U(a)]


@hot
def invert(weights, out):
    """out = 1 / weights; 0 where the weight is 0 (a node that no particle sees)."""
    for n in range(out.size):
        w = weights[n]
        out[n] = 1.0 / w if w > 0.0 else 0.0


@hot
def scale_rows(values, factors, out):
    """out = values times one factor a row."""
    if values.shape[1] == 1:
        for n in range(out.shape[0]):
            out[n, 0] = values[n, 0] * factors[n]
    else:
        for n in range(out.shape[0]):
            for k in range(out.shape[1]):
                out[n, k] = values[n, k] * factors[n]


@hot
def scale_changed(values, rate, change, factors, out):
    """out = (values + rate change) times one factor a row, column 0."""
    for n in range(out.shape[0]):
        out[n, 0] = (values[n, 0] + rate * change[n, 0]) * factors[n]


@hot
def sort_order(cell, cells, order):
    """Stable counting sort: order[j] = index of the particle that comes j-th by cell."""
    start = np.zeros(cells + 1, dtype=np.int64)
    for p in range(cell.size):
        start[cell[p] + 1] += 1
    for c in range(cells):
        start[c + 1] += start[c]
    for p in range(cell.size):
        order[start[cell[p]]] = p
        start[cell[p]] += 1


@hot
def close_gaps(gaps, count, rows):
    """Overwrite rows at the sorted indices `gaps` by rows from the end, so that the first count - gaps.size stay."""
    keep = count - gaps.size
    last = count - 1
    upper = gaps.size - 1
    for g in gaps:
        if g >= keep:
            break
        while upper >= 0 and gaps[upper] == last:
            last -= 1
            upper -= 1
        for k in range(rows.shape[1]):
            rows[g, k] = rows[last, k]
        last -= 1

"""Sums over particles of B-spline shape functions of degree 1, 2 or 3, in one, two or three dimensions.

Splines are centred on nodes. `cell` is a particle's local cell, `fraction` its local coordinates in it. Along an axis
it touches degree + 1 nodes, the first `offset` nodes from the one that opens its cell: 0 for linear; for quadratic -1
in the lower half of the cell and 0 in the upper; -1 for cubic. Nodal arrays are padded by the reach, `shape` is the
own cells per axis, padded with 1, `layout` = (first own node, strides of y and z). The loops of every step have a short
form in one dimension.
"""

import numpy as np

from mpipic.kernels.common import U, hot, inlined, inner
from mpipic.kernels.generic import node_of

ON_BREAK = 1e-10


@hot
def weights(degree, x, w):
    """Fill w[: degree + 1] with the weights at local coordinate x, and return the offset of the first node."""
    if degree == 1:
        w[0], w[1] = 1.0 - x, x
        return 0
    if degree == 2:
        upper = x >= 0.5 - ON_BREAK
        t = x - 1.0 if upper else x
        w[0], w[1], w[2] = 0.5 * (0.5 - t) ** 2, 0.75 - t * t, 0.5 * (0.5 + t) ** 2
        return 0 if upper else -1
    y = 1.0 - x
    w[0], w[3] = y * y * y / 6.0, x * x * x / 6.0
    w[1], w[2] = 2.0 / 3.0 - x * x * (1.0 - 0.5 * x), 2.0 / 3.0 - y * y * (1.0 - 0.5 * y)
    return -1


@hot
def slopes(degree, x, inverse_h, s):
    """Fill s[: degree + 1] with the derivatives at local coordinate x; right-hand ones where there are two."""
    if degree == 1:
        s[0], s[1] = -inverse_h, inverse_h
    elif degree == 2:
        t = x - 1.0 if x >= 0.5 - ON_BREAK else x
        s[0], s[1], s[2] = (t - 0.5) * inverse_h, -2.0 * t * inverse_h, (t + 0.5) * inverse_h
    else:
        y = 1.0 - x
        s[0], s[3] = -0.5 * y * y * inverse_h, 0.5 * x * x * inverse_h
        s[1], s[2] = -x * (2.0 - 1.5 * x) * inverse_h, y * (2.0 - 1.5 * y) * inverse_h


@inlined
def _scratch():
    """Return room for weights and slopes per axis, and nodes per axis; an axis that there is not has one weight, 1."""
    return np.ones((3, 4)), np.ones((3, 4)), np.ones(3, np.int64)


@inner
def _find(degree, cell, fraction, p, shape, layout, w, count):
    """Find the weights of particle p per axis, and return its first node."""
    node = node_of(cell[p], shape, layout)
    for a in range(fraction.shape[1]):
        offset = weights(degree, fraction[p, a], w[a])
        node += offset if a == 0 else offset * layout[a]
        count[a] = degree + 1
    return node


@hot
def add_sums(degree, cell, fraction, values, shape, layout, out):
    """Add Φᵀ values to `out`, column by column."""
    w, _, count = _scratch()
    columns = values.shape[1]
    if fraction.shape[1] == 1:
        v = w[0]
        for p in range(cell.size):
            first = layout[0] + cell[p] + weights(degree, fraction[p, 0], v)
            for i in range(degree + 1):
                n = U(first + i)
                for c in range(columns):
                    out[n, U(c)] += v[i] * values[p, c]
        return
    for p in range(cell.size):
        first = _find(degree, cell, fraction, p, shape, layout, w, count)
        for k in range(count[2]):
            for j in range(count[1]):
                row, wjk = first + j * layout[1] + k * layout[2], w[2, k] * w[1, j]
                for i in range(count[0]):
                    n, wijk = U(row + i), wjk * w[0, i]
                    for c in range(columns):
                        out[n, U(c)] += wijk * values[p, c]


@hot
def add_interpolated(degree, cell, fraction, nodal, rate, shape, layout, out):
    """Add rate[column] Φ nodal to `out`, column by column."""
    w, _, count = _scratch()
    columns = nodal.shape[1]
    total = np.empty(columns)
    if fraction.shape[1] == 1:
        v = w[0]
        for p in range(cell.size):
            first = layout[0] + cell[p] + weights(degree, fraction[p, 0], v)
            for c in range(columns):
                value = 0.0
                for i in range(degree + 1):
                    value += v[i] * nodal[U(first + i), U(c)]
                out[p, c] += rate[c] * value
        return
    for p in range(cell.size):
        first = _find(degree, cell, fraction, p, shape, layout, w, count)
        total[:] = 0.0
        for k in range(count[2]):
            for j in range(count[1]):
                row, wjk = first + j * layout[1] + k * layout[2], w[2, k] * w[1, j]
                for i in range(count[0]):
                    n, wijk = U(row + i), wjk * w[0, i]
                    for c in range(columns):
                        total[c] += wijk * nodal[n, U(c)]
        for c in range(columns):
            out[p, c] += rate[c] * total[c]


@inner
def _along(axis, w, s, i, j, k):
    """Return the shape function of corner (i, j, k), differentiated along `axis`."""
    x = s[0, i] if axis == 0 else w[0, i]
    y = s[1, j] if axis == 1 else w[1, j]
    z = s[2, k] if axis == 2 else w[2, k]
    return x * y * z


@inner
def _find_slopes(degree, fraction, p, inverse_h, s):
    for a in range(fraction.shape[1]):
        slopes(degree, fraction[p, a], inverse_h[a], s[a])


@hot
def add_gradient(degree, cell, fraction, nodal, rate, inverse_h, shape, layout, out):
    """Add rate D^a nodal, for one column, to out[:, a]."""
    w, s, count = _scratch()
    dim = fraction.shape[1]
    total = np.empty(dim)
    for p in range(cell.size):
        first = _find(degree, cell, fraction, p, shape, layout, w, count)
        _find_slopes(degree, fraction, p, inverse_h, s)
        total[:] = 0.0
        for k in range(count[2]):
            for j in range(count[1]):
                row = first + j * layout[1] + k * layout[2]
                for i in range(count[0]):
                    value = nodal[U(row + i)]
                    for a in range(dim):
                        total[a] += _along(a, w, s, i, j, k) * value
        for a in range(dim):
            out[p, a] += rate * total[a]


@hot
def add_divergence(degree, cell, fraction, nodal, rate, inverse_h, shape, layout, out):
    """Add rate Σ_a D^a nodal[:, a] to `out`."""
    w, s, count = _scratch()
    dim = fraction.shape[1]
    for p in range(cell.size):
        first = _find(degree, cell, fraction, p, shape, layout, w, count)
        _find_slopes(degree, fraction, p, inverse_h, s)
        total = 0.0
        for k in range(count[2]):
            for j in range(count[1]):
                row = first + j * layout[1] + k * layout[2]
                for i in range(count[0]):
                    for a in range(dim):
                        total += _along(a, w, s, i, j, k) * nodal[U(row + i), U(a)]
        out[p] += rate * total


@hot
def add_gradient_sums(degree, cell, fraction, values, inverse_h, shape, layout, out):
    """Add (D^a)ᵀ values, for one column of particle values, to out[:, a]."""
    w, s, count = _scratch()
    dim = fraction.shape[1]
    for p in range(cell.size):
        first = _find(degree, cell, fraction, p, shape, layout, w, count)
        _find_slopes(degree, fraction, p, inverse_h, s)
        for k in range(count[2]):
            for j in range(count[1]):
                row = first + j * layout[1] + k * layout[2]
                for i in range(count[0]):
                    for a in range(dim):
                        out[U(row + i), U(a)] += _along(a, w, s, i, j, k) * values[p]


@hot
def add_divergence_sums(degree, cell, fraction, values, inverse_h, shape, layout, out):
    """Add Σ_a (D^a)ᵀ values[:, a] to `out`."""
    w, s, count = _scratch()
    dim = fraction.shape[1]
    for p in range(cell.size):
        first = _find(degree, cell, fraction, p, shape, layout, w, count)
        _find_slopes(degree, fraction, p, inverse_h, s)
        for k in range(count[2]):
            for j in range(count[1]):
                row = first + j * layout[1] + k * layout[2]
                for i in range(count[0]):
                    total = 0.0
                    for a in range(dim):
                        total += _along(a, w, s, i, j, k) * values[p, a]
                    out[U(row + i)] += total


@inner
def _pair_places(degree, dim, layout, diagonals, place):
    """Find where the product of every two nodes a <= b of a particle goes, relative to the first node's row.

    Nodes count x fastest, so b never precedes a: its offset from a is in the half stencil.
    """
    width, side = degree + 1, 2 * degree + 1
    nodes, pair = width**dim, 0
    for a in range(nodes):
        i, j, k = a % width, a // width % width, a // width**2
        node = i + j * layout[1] + k * layout[2]
        for b in range(a, nodes):
            diagonal = b % width - i + side * (b // width % width - j + side * (b // width**2 - k))
            place[pair] = node * diagonals + diagonal
            pair += 1


@inner
def _move(total, place, first, out):
    """Add `total` to out[first + place], and set it to 0."""
    for pair in range(total.size):
        out[U(first + place[pair])] += total[pair]
        total[pair] = 0.0


@hot
def add_gram_entries(degree, cell, fraction, weight, shape, layout, entries):
    """Add Σ_p V_p φ_n φ_m to entries[n, h], m the node of offset h of the half stencil from n (see `stencil`).

    Products of particles that touch the same nodes, one after the other in memory, are added up before they go there.
    """
    w, _, count = _scratch()
    dim, diagonals = fraction.shape[1], entries.shape[1]
    if dim == 1:
        v = w[0]
        for p in range(cell.size):
            first = layout[0] + cell[p] + weights(degree, fraction[p, 0], v)
            for i in range(degree + 1):
                n, vi = U(first + i), weight[p] * v[i]
                for h in range(degree + 1 - i):
                    entries[n, U(h)] += vi * v[i + h]
        return
    nodes = (degree + 1) ** dim
    place = np.empty(nodes * (nodes + 1) // 2, np.int64)
    _pair_places(degree, dim, layout, diagonals, place)
    total, value, out = np.zeros(place.size), np.empty(nodes), entries.reshape(-1)
    before = -1
    for p in range(cell.size):
        first = _find(degree, cell, fraction, p, shape, layout, w, count)
        if first != before and before >= 0:
            _move(total, place, before * diagonals, out)
        before, c = first, 0
        for k in range(count[2]):
            for j in range(count[1]):
                wjk = w[2, k] * w[1, j]
                for i in range(count[0]):
                    value[c] = wjk * w[0, i]
                    c += 1
        begin = 0
        for a in range(nodes):
            va, row, others = weight[p] * value[a], total[begin : begin + nodes - a], value[a:nodes]
            for b in range(row.size):
                row[b] += va * others[b]
            begin += nodes - a
    if before >= 0:
        _move(total, place, before * diagonals, out)


@hot
def shape_functions(degree, cell, fraction, shape, layout, node, value):
    """Find the nodes that each particle touches and its weights there, (n, (degree + 1)^d)."""
    w, _, count = _scratch()
    for p in range(cell.size):
        first, c = _find(degree, cell, fraction, p, shape, layout, w, count), 0
        for k in range(count[2]):
            for j in range(count[1]):
                for i in range(count[0]):
                    node[p, c] = first + i + j * layout[1] + k * layout[2]
                    value[p, c] = w[0, i] * w[1, j] * w[2, k]
                    c += 1

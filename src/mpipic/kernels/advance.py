"""The sweep over particles that a time step makes, on the linear basis: update, move and map in one pass over memory.

`advance_*d` adds to every particle an increment from its nodes, moves it, and adds it to the sums at the nodes of its
new place: Φᵀ of the state columns, Φᵀ1 in the last column of `sums`, and the pair moments of its cell
(`kernels.cells`). A particle that left this rank's cells is updated and moved, but not summed: its index goes to
`leaving`, and whoever receives it sums it with `deposit_*d`.

Particles are taken in blocks that fit the first cache. What goes axis by axis (`kernels.blocks`) is done for a
block at a time by loops that the compiler turns into vector code over particles; what reads nodes and adds to
them goes particle by particle, with the columns of a particle in one vector.

There is one function for each dimension, near twins, so that a scene compiles its own only.

Arguments
---------
axes (d, room) : coordinates in cells, one row per axis; modified.
state (n, 1 + d) : modified. The first column is the scalar, the others the vector.
nodal (nodes, 1 + d), rates (two floats) : what to add. The scalar gets rates[0] Φ times column 0, the vector rates[1]
    Φ times columns 1 to d; or, if `direct` (the scheme without a filter), the scalar gets rates[0] times the divergence
    of columns 1 to d, the vector rates[1] times the gradient of column 0.
sums (nodes, d + 2), moments (cells, 3^d) : added to; moments and, in 1D and 2D, the last column of sums only if `weigh`
    (in 3D that column is `kernels.cells.row_sums_3d`'s).
start, stop : the range of particles.
geometry : tuple (inverse_h, tolerance, period, shift, first), each a tuple of one entry per axis: cells per unit
    length, and in cells the width of "on a node", the period, the displacement of this step, and the first cell of
    this rank.
shape, layout : as in `kernels.cells`.
bounded : whether a particle can leave this rank's cells at all.

`advance_*d` returns the largest |scalar| (NaN if any is not finite), how many particles lie in another cell than their
predecessor, and how many left (which may exceed the length of `leaving`: then the list is incomplete); `deposit_*d`
returns the largest |scalar|.
"""

import numpy as np

from mpipic.kernels.blocks import BLOCK, breaks_of, find, find_leavers, move_block, scratch
from mpipic.kernels.common import U, hot, inlined, inner


@inlined
def _lerp(a, b, f):
    return a + f * (b - a)


@inner
def _update_1d(s, g, p0, count, node, f_, inverse_h, rates, direct):
    ra, rb = rates
    sx, tx = ra * inverse_h[0], rb * inverse_h[0]
    peak, infinite = 0.0, 0.0
    for p in range(count):
        b, q, f = U(node[p]) * U(2), U(2 * (p0 + p)), f_[p]
        g0, g1, g2, g3 = g[b], g[b + U(1)], g[b + U(2)], g[b + U(3)]
        if direct:
            r, u = s[q] + sx * (g3 - g1), s[q + U(1)] + tx * (g2 - g0)
        else:
            r, u = s[q] + ra * _lerp(g0, g2, f), s[q + U(1)] + rb * _lerp(g1, g3, f)
        s[q], s[q + U(1)] = r, u
        if abs(r) > peak:
            peak = abs(r)
        infinite += r - r
    return peak if infinite == 0.0 else np.nan


@inner
def _deposit_1d(s, o, m, p0, count, outside, node, cell, f_, weigh):
    """Add a block to the sums; runs of particles in one cell are summed in registers."""
    a0, a1, b0, b1, m0, m1, m2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    run_cell, run_node = -1, U(0)
    for p in range(count):
        if outside[p]:
            continue
        if cell[p] != run_cell:
            if run_cell >= 0:
                _flush_1d(o, m, run_node, U(3 * run_cell), a0, a1, b0, b1, m0, m1, m2, weigh)
            a0, a1, b0, b1, m0, m1, m2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            run_cell, run_node = np.int64(cell[p]), U(node[p]) * U(3)
        f = f_[p]
        w = 1.0 - f
        q = U(2 * (p0 + p))
        r, u = s[q], s[q + U(1)]
        a0 += w * r
        a1 += w * u
        b0 += f * r
        b1 += f * u
        m0 += w * w
        m1 += w * f
        m2 += f * f
    if run_cell >= 0:
        _flush_1d(o, m, run_node, U(3 * run_cell), a0, a1, b0, b1, m0, m1, m2, weigh)


@inlined
def _flush_1d(o, m, n, c, a0, a1, b0, b1, m0, m1, m2, weigh):
    o[n] += a0
    o[n + U(1)] += a1
    o[n + U(3)] += b0
    o[n + U(4)] += b1
    if weigh:
        o[n + U(2)] += m0 + m1
        o[n + U(5)] += m1 + m2
        m[c] += m0
        m[c + U(1)] += m1
        m[c + U(2)] += m2


@hot
def deposit_1d(axes, state, sums, moments, start, stop, geometry, shape, layout, weigh):
    """Add particles start to stop to the sums and moments."""
    s, o, m = state.reshape(-1), sums.reshape(-1), moments.reshape(-1)
    index, fraction = scratch(1)
    for p0 in range(start, stop, BLOCK):
        count = min(BLOCK, stop - p0)
        find(axes, p0, count, geometry, shape, layout, index[0], index[1], fraction)
        _deposit_1d(s, o, m, p0, count, index[2], index[0], index[1], fraction[0], weigh)
    return _largest(state, start, stop)


@hot
def advance_1d(
    axes, state, nodal, rates, sums, moments, start, stop, geometry, shape, layout, direct, weigh, bounded, leaving
):
    """Update and move particles start to stop, and add them to the sums; see the module's docstring."""
    s, g, o, m = state.reshape(-1), nodal.reshape(-1), sums.reshape(-1), moments.reshape(-1)
    index, fraction = scratch(1)
    node, cell, outside, f = index[0], index[1], index[2], fraction[0]
    peak, breaks, left, before = 0.0, 0, np.int64(0), np.int64(-1)  # typed: a bare 0 would compile its callees twice
    for p0 in range(start, stop, BLOCK):
        count = min(BLOCK, stop - p0)
        find(axes, p0, count, geometry, shape, layout, node, cell, fraction)
        peak = _worse(peak, _update_1d(s, g, p0, count, node, f, geometry[0], rates, direct))
        if weigh:
            # what was read from the nodes was read at the old places; what follows is at the new ones
            move_block(axes, p0, count, geometry)
            find(axes, p0, count, geometry, shape, layout, node, cell, fraction)
            if bounded:
                left = find_leavers(axes, p0, count, geometry, shape, outside, leaving, left)
            breaks += breaks_of(cell, cell[1:count], before)
            before = np.int64(cell[count - 1])
        _deposit_1d(s, o, m, p0, count, outside, node, cell, f, weigh)
    return peak, breaks, left


@inlined
def _worse(peak, other):
    """Return the larger, NaN larger than all."""
    return peak if peak >= other or peak != peak else other


@inner
def _largest(state, start, stop):
    peak, infinite = 0.0, 0.0
    for p in range(start, stop):
        r = abs(state[U(p), U(0)])
        infinite += r - r
        if r > peak:
            peak = r
    return peak if infinite == 0.0 else np.nan


@inlined
def _add4(g, b, w, r, u, v, t):
    """Add w (r, u, v, t) to four neighbours: all are read, then all written, so that they go through one register."""
    a0, a1, a2, a3 = g[b] + w * r, g[b + U(1)] + w * u, g[b + U(2)] + w * v, g[b + U(3)] + w * t
    g[b], g[b + U(1)], g[b + U(2)], g[b + U(3)] = a0, a1, a2, a3


@inlined
def _add9(m, b, w, p0, p1, p2, p3, p4, p5, p6, p7, p8):
    """Add w (p0, ..., p8) to nine neighbours, in the order of `_add4`."""
    a0, a1, a2, a3 = m[b] + w * p0, m[b + U(1)] + w * p1, m[b + U(2)] + w * p2, m[b + U(3)] + w * p3
    a4, a5, a6, a7 = m[b + U(4)] + w * p4, m[b + U(5)] + w * p5, m[b + U(6)] + w * p6, m[b + U(7)] + w * p7
    a8 = m[b + U(8)] + w * p8
    m[b], m[b + U(1)], m[b + U(2)], m[b + U(3)] = a0, a1, a2, a3
    m[b + U(4)], m[b + U(5)], m[b + U(6)], m[b + U(7)] = a4, a5, a6, a7
    m[b + U(8)] = a8


@inner
def _update_2d(s, g, p0, count, node, fx_, fy_, row, inverse_h, rates, direct):
    ra, rb = rates
    sx, sy, tx, ty = ra * inverse_h[0], ra * inverse_h[1], rb * inverse_h[0], rb * inverse_h[1]
    peak, infinite = 0.0, 0.0
    for p in range(count):
        # b: entries of the lower left node, three a node, so that b + 3 is its right neighbour's; t: those above
        b, q, fx, fy = U(node[p]) * U(3), U(3 * (p0 + p)), fx_[p], fy_[p]
        t = b + U(3 * row)
        b0, b1, b2, b3, b4, b5 = g[b], g[b + U(1)], g[b + U(2)], g[b + U(3)], g[b + U(4)], g[b + U(5)]
        t0, t1, t2, t3, t4, t5 = g[t], g[t + U(1)], g[t + U(2)], g[t + U(3)], g[t + U(4)], g[t + U(5)]
        if direct:  # the derivative along an axis is a difference along it, interpolated along the other
            r = s[q] + sx * _lerp(b4 - b1, t4 - t1, fy) + sy * _lerp(t2 - b2, t5 - b5, fx)
            u = s[q + U(1)] + tx * _lerp(b3 - b0, t3 - t0, fy)
            v = s[q + U(2)] + ty * _lerp(t0 - b0, t3 - b3, fx)
        else:
            r = s[q] + ra * _lerp(_lerp(b0, t0, fy), _lerp(b3, t3, fy), fx)
            u = s[q + U(1)] + rb * _lerp(_lerp(b1, t1, fy), _lerp(b4, t4, fy), fx)
            v = s[q + U(2)] + rb * _lerp(_lerp(b2, t2, fy), _lerp(b5, t5, fy), fx)
        s[q], s[q + U(1)], s[q + U(2)] = r, u, v
        if abs(r) > peak:
            peak = abs(r)
        infinite += r - r
    return peak if infinite == 0.0 else np.nan


@inner
def _deposit_2d(s, o, m, p0, count, outside, node, cell, fx_, fy_, row, weigh):
    # the fourth entry of a node is its row sum: a particle adds w times 1 there, or 0 where the sums are known
    one = 1.0 if weigh else 0.0
    for p in range(count):
        if outside[p]:
            continue
        b, q, fx, fy = U(node[p]) * U(4), U(3 * (p0 + p)), fx_[p], fy_[p]
        t = b + U(4 * row)
        wx, wy = 1.0 - fx, 1.0 - fy
        r, u, v = s[q], s[q + U(1)], s[q + U(2)]
        _add4(o, b, wx * wy, r, u, v, one)
        _add4(o, b + U(4), fx * wy, r, u, v, one)
        _add4(o, t, wx * fy, r, u, v, one)
        _add4(o, t + U(4), fx * fy, r, u, v, one)
        if weigh:  # pair moments: every product of a pair of x weights and a pair of y weights, x fastest
            x0, x1, x2 = wx * wx, wx * fx, fx * fx
            y0, y1, y2 = wy * wy, wy * fy, fy * fy
            c = U(cell[p]) * U(9)
            _add9(m, c, 1.0, x0 * y0, x1 * y0, x2 * y0, x0 * y1, x1 * y1, x2 * y1, x0 * y2, x1 * y2, x2 * y2)


@hot
def deposit_2d(axes, state, sums, moments, start, stop, geometry, shape, layout, weigh):
    """Add particles start to stop to the sums and moments."""
    s, o, m = state.reshape(-1), sums.reshape(-1), moments.reshape(-1)
    index, fraction = scratch(2)
    node, cell, outside, fx, fy = index[0], index[1], index[2], fraction[0], fraction[1]
    for p0 in range(start, stop, BLOCK):
        count = min(BLOCK, stop - p0)
        find(axes, p0, count, geometry, shape, layout, node, cell, fraction)
        _deposit_2d(s, o, m, p0, count, outside, node, cell, fx, fy, layout[1], weigh)
    return _largest(state, start, stop)


@hot
def advance_2d(
    axes, state, nodal, rates, sums, moments, start, stop, geometry, shape, layout, direct, weigh, bounded, leaving
):
    """Update and move particles start to stop, and add them to the sums; see the module's docstring."""
    s, g, o, m = state.reshape(-1), nodal.reshape(-1), sums.reshape(-1), moments.reshape(-1)
    index, fraction = scratch(2)
    node, cell, outside, fx, fy = index[0], index[1], index[2], fraction[0], fraction[1]
    peak, breaks, left, before = 0.0, 0, np.int64(0), np.int64(-1)  # typed: a bare 0 would compile its callees twice
    for p0 in range(start, stop, BLOCK):
        count = min(BLOCK, stop - p0)
        find(axes, p0, count, geometry, shape, layout, node, cell, fraction)
        peak = _worse(peak, _update_2d(s, g, p0, count, node, fx, fy, layout[1], geometry[0], rates, direct))
        if weigh:
            # what was read from the nodes was read at the old places; what follows is at the new ones
            move_block(axes, p0, count, geometry)
            find(axes, p0, count, geometry, shape, layout, node, cell, fraction)
            if bounded:
                left = find_leavers(axes, p0, count, geometry, shape, outside, leaving, left)
            breaks += breaks_of(cell, cell[1:count], before)
            before = np.int64(cell[count - 1])
        _deposit_2d(s, o, m, p0, count, outside, node, cell, fx, fy, layout[1], weigh)
    return peak, breaks, left


@inlined
def _slope(a0, a1, b0, b1, c0, c1, d0, d1, f, h):
    """Return the difference along one axis (x1 - x0), interpolated along the two others with f and h."""
    return _lerp(_lerp(a1 - a0, b1 - b0, f), _lerp(c1 - c0, d1 - d0, f), h)


@inlined
def _gradient_3d(g, b, c, t, e, fx, fy, fz):
    """Return differences of one column along x, y, z; b, c, t, e: its entries at (0,0), (y,0), (0,z), (y,z), x low."""
    k = U(4)
    b0, b1, c0, c1, t0, t1, e0, e1 = g[b], g[b + k], g[c], g[c + k], g[t], g[t + k], g[e], g[e + k]
    return (
        _slope(b0, b1, c0, c1, t0, t1, e0, e1, fy, fz),
        _slope(b0, c0, b1, c1, t0, e0, t1, e1, fx, fz),
        _slope(b0, t0, b1, t1, c0, e0, c1, e1, fx, fy),
    )


@inlined
def _trilinear(g, b, c, t, e, fx, fy, fz):
    low = _lerp(_lerp(g[b], g[b + U(4)], fx), _lerp(g[c], g[c + U(4)], fx), fy)
    high = _lerp(_lerp(g[t], g[t + U(4)], fx), _lerp(g[e], g[e + U(4)], fx), fy)
    return _lerp(low, high, fz)


@inner
def _update_3d(s, g, p0, count, node, fx_, fy_, fz_, row, plane, inverse_h, rates, direct):
    ra, rb = rates
    hx, hy, hz = inverse_h
    peak, infinite = 0.0, 0.0
    for p in range(count):
        # four entries a node; b, c, t, e: entries of the nodes at (0,0), (y,0), (0,z), (y,z), x low, as in _gradient_3d
        b, q, fx, fy, fz = U(node[p]) * U(4), U(4 * (p0 + p)), fx_[p], fy_[p], fz_[p]
        c, t = b + U(4 * row), b + U(4 * plane)
        e = t + U(4 * row)
        if direct:
            rx, ry, rz = _gradient_3d(g, b, c, t, e, fx, fy, fz)
            # one derivative of each is used; the compiler drops what makes the two others
            ux, _, _ = _gradient_3d(g, b + U(1), c + U(1), t + U(1), e + U(1), fx, fy, fz)
            _, vy, _ = _gradient_3d(g, b + U(2), c + U(2), t + U(2), e + U(2), fx, fy, fz)
            _, _, wz = _gradient_3d(g, b + U(3), c + U(3), t + U(3), e + U(3), fx, fy, fz)
            r = s[q] + ra * (hx * ux + hy * vy + hz * wz)
            u, v, w = s[q + U(1)] + rb * hx * rx, s[q + U(2)] + rb * hy * ry, s[q + U(3)] + rb * hz * rz
        else:
            r = s[q] + ra * _trilinear(g, b, c, t, e, fx, fy, fz)
            u = s[q + U(1)] + rb * _trilinear(g, b + U(1), c + U(1), t + U(1), e + U(1), fx, fy, fz)
            v = s[q + U(2)] + rb * _trilinear(g, b + U(2), c + U(2), t + U(2), e + U(2), fx, fy, fz)
            w = s[q + U(3)] + rb * _trilinear(g, b + U(3), c + U(3), t + U(3), e + U(3), fx, fy, fz)
        s[q], s[q + U(1)], s[q + U(2)], s[q + U(3)] = r, u, v, w
        if abs(r) > peak:
            peak = abs(r)
        infinite += r - r
    return peak if infinite == 0.0 else np.nan


@inner
def _deposit_3d(s, o, m, p0, count, outside, node, cell, fx_, fy_, fz_, row, plane, weigh):
    for p in range(count):
        if outside[p]:
            continue
        # five entries a node; the last, its row sum, comes from the moments afterwards: the others fill one register
        b0, q, fx, fy, fz = U(node[p]) * U(5), U(4 * (p0 + p)), fx_[p], fy_[p], fz_[p]
        b1, b2 = b0 + U(5 * row), b0 + U(5 * plane)
        b3 = b2 + U(5 * row)
        wx, wy, wz = 1.0 - fx, 1.0 - fy, 1.0 - fz
        a0, a1, a2, a3 = wy * wz, fy * wz, wy * fz, fy * fz
        r, u, v, t = s[q], s[q + U(1)], s[q + U(2)], s[q + U(3)]
        _add4(o, b0, a0 * wx, r, u, v, t)
        _add4(o, b0 + U(5), a0 * fx, r, u, v, t)
        _add4(o, b1, a1 * wx, r, u, v, t)
        _add4(o, b1 + U(5), a1 * fx, r, u, v, t)
        _add4(o, b2, a2 * wx, r, u, v, t)
        _add4(o, b2 + U(5), a2 * fx, r, u, v, t)
        _add4(o, b3, a3 * wx, r, u, v, t)
        _add4(o, b3 + U(5), a3 * fx, r, u, v, t)
        if weigh:
            c = U(cell[p]) * U(27)
            x0, x1, x2 = wx * wx, wx * fx, fx * fx
            y0, y1, y2 = wy * wy, wy * fy, fy * fy
            # the nine products of x and y pairs, then one layer of the 27 for each pair of z weights
            k0, k1, k2, k3, k4 = x0 * y0, x1 * y0, x2 * y0, x0 * y1, x1 * y1
            k5, k6, k7, k8 = x2 * y1, x0 * y2, x1 * y2, x2 * y2
            _add9(m, c, wz * wz, k0, k1, k2, k3, k4, k5, k6, k7, k8)
            _add9(m, c + U(9), wz * fz, k0, k1, k2, k3, k4, k5, k6, k7, k8)
            _add9(m, c + U(18), fz * fz, k0, k1, k2, k3, k4, k5, k6, k7, k8)


@hot
def deposit_3d(axes, state, sums, moments, start, stop, geometry, shape, layout, weigh):
    """Add particles start to stop to the sums and moments."""
    s, o, m = state.reshape(-1), sums.reshape(-1), moments.reshape(-1)
    index, f = scratch(3)
    node, cell, outside = index[0], index[1], index[2]
    for p0 in range(start, stop, BLOCK):
        count = min(BLOCK, stop - p0)
        find(axes, p0, count, geometry, shape, layout, node, cell, f)
        _deposit_3d(s, o, m, p0, count, outside, node, cell, f[0], f[1], f[2], layout[1], layout[2], weigh)
    return _largest(state, start, stop)


@hot
def advance_3d(
    axes, state, nodal, rates, sums, moments, start, stop, geometry, shape, layout, direct, weigh, bounded, leaving
):
    """Update and move particles start to stop, and add them to the sums; see the module's docstring."""
    s, g, o, m = state.reshape(-1), nodal.reshape(-1), sums.reshape(-1), moments.reshape(-1)
    index, f = scratch(3)
    node, cell, outside = index[0], index[1], index[2]
    row, plane = layout[1], layout[2]
    peak, breaks, left, before = 0.0, 0, np.int64(0), np.int64(-1)  # typed: a bare 0 would compile its callees twice
    for p0 in range(start, stop, BLOCK):
        count = min(BLOCK, stop - p0)
        find(axes, p0, count, geometry, shape, layout, node, cell, f)
        other = _update_3d(s, g, p0, count, node, f[0], f[1], f[2], row, plane, geometry[0], rates, direct)
        peak = _worse(peak, other)
        if weigh:
            # what was read from the nodes was read at the old places; what follows is at the new ones
            move_block(axes, p0, count, geometry)
            find(axes, p0, count, geometry, shape, layout, node, cell, f)
            if bounded:
                left = find_leavers(axes, p0, count, geometry, shape, outside, leaving, left)
            breaks += breaks_of(cell, cell[1:count], before)
            before = np.int64(cell[count - 1])
        _deposit_3d(s, o, m, p0, count, outside, node, cell, f[0], f[1], f[2], row, plane, weigh)
    return peak, breaks, left

"""Sums over particles of products of linear shape functions, applied cell by cell.

On the linear basis the sums over the particles of one cell of products of two shape functions depend on 3^d numbers
only, the pair moments: for each cell the sums of the products over the axes of (w0 w0, w0 w1, w1 w1), where
w0 = 1 - xi and w1 = xi are the two weights along an axis (x fastest). The row sums d = Φᵀ1, the Gram matrix G = ΦᵀΦ
and the cross matrices ΦᵀD^a are sums of them. All terms are positive and none is a difference, so that even a node
which sees one particle with weight 1e-12 gets its row to full relative accuracy.

With them whatever a time step needs between two sweeps over particles costs O(cells). Every function adds into `out`;
what lands on nodes of the upper faces belongs to a neighbour until `Grid.sum_halo`.

Arguments: `moments` (cells, 3^d); `shape` cells per axis, padded with 1; `layout` = (node of the first cell, node
strides along y and z); `values` and `out` nodal arrays (nodes, columns).
"""

from mpipic.kernels.common import U, hot, inlined, inner


@inlined
def _pair(a, b, c, x, y):
    """Multiply the symmetric matrix [[a, b], [b, c]] with (x, y)."""
    return a * x + b * y, b * x + c * y


@inlined
def _pair2(a0, b0, c0, a1, b1, c1, a2, b2, c2, x00, x10, x01, x11):
    """Multiply [[M0, M1], [M1, M2]], blocks Mi = [[ai, bi], [bi, ci]] of two axes, with (x00, x10, x01, x11)."""
    p0, p1 = _pair(a0, b0, c0, x00, x10)
    q0, q1 = _pair(a1, b1, c1, x01, x11)
    r0, r1 = _pair(a1, b1, c1, x00, x10)
    s0, s1 = _pair(a2, b2, c2, x01, x11)
    return p0 + q0, p1 + q1, r0 + s0, r1 + s1


@inlined
def _plane(m, q, x00, x10, x01, x11):
    """Multiply the matrix of two axes, made of the nine moments that start at m[q], with (x00, x10, x01, x11)."""
    return _pair2(
        m[q], m[q + U(1)], m[q + U(2)], m[q + U(3)], m[q + U(4)], m[q + U(5)], m[q + U(6)], m[q + U(7)], m[q + U(8)],
        x00, x10, x01, x11,
    )  # fmt: skip


@inlined
def _gram_cell_3d(m, q, x0, x1, x2, x3, x4, x5, x6, x7):
    a0, a1, a2, a3 = _plane(m, q, x0, x1, x2, x3)
    b0, b1, b2, b3 = _plane(m, q + U(9), x4, x5, x6, x7)
    c0, c1, c2, c3 = _plane(m, q + U(9), x0, x1, x2, x3)
    d0, d1, d2, d3 = _plane(m, q + U(18), x4, x5, x6, x7)
    return a0 + b0, a1 + b1, a2 + b2, a3 + b3, c0 + d0, c1 + d1, c2 + d2, c3 + d3


@inlined
def _cross_cell_2d(m, q, x0, x1, y0, y1):
    """Return a cell's rows of ΦᵀD^x and ΦᵀD^y; x0, x1 are x differences at low and high y, y0, y1 y differences."""
    gx00, gx01 = _pair(m[q] + m[q + U(1)], m[q + U(3)] + m[q + U(4)], m[q + U(6)] + m[q + U(7)], x0, x1)
    gx10, gx11 = _pair(m[q + U(1)] + m[q + U(2)], m[q + U(4)] + m[q + U(5)], m[q + U(7)] + m[q + U(8)], x0, x1)
    gy00, gy10 = _pair(m[q] + m[q + U(3)], m[q + U(1)] + m[q + U(4)], m[q + U(2)] + m[q + U(5)], y0, y1)
    gy01, gy11 = _pair(m[q + U(3)] + m[q + U(6)], m[q + U(4)] + m[q + U(7)], m[q + U(5)] + m[q + U(8)], y0, y1)
    return gx00, gx10, gx01, gx11, gy00, gy10, gy01, gy11


@inlined
def _along_x(m, q, x0, x1, x2, x3):
    """Return half a row block of ΦᵀD^x in 3D: moments at x pairs q and q + 1 added up, four (y, z) test functions."""
    return _pair2(
        m[q] + m[q + U(1)], m[q + U(3)] + m[q + U(4)], m[q + U(6)] + m[q + U(7)],
        m[q + U(9)] + m[q + U(10)], m[q + U(12)] + m[q + U(13)], m[q + U(15)] + m[q + U(16)],
        m[q + U(18)] + m[q + U(19)], m[q + U(21)] + m[q + U(22)], m[q + U(24)] + m[q + U(25)],
        x0, x1, x2, x3,
    )  # fmt: skip


@inlined
def _along_y(m, q, y0, y1, y2, y3):
    """Return the same for ΦᵀD^y: y pairs q and q + 3 added up, four (x, z) test functions."""
    return _pair2(
        m[q] + m[q + U(3)], m[q + U(1)] + m[q + U(4)], m[q + U(2)] + m[q + U(5)],
        m[q + U(9)] + m[q + U(12)], m[q + U(10)] + m[q + U(13)], m[q + U(11)] + m[q + U(14)],
        m[q + U(18)] + m[q + U(21)], m[q + U(19)] + m[q + U(22)], m[q + U(20)] + m[q + U(23)],
        y0, y1, y2, y3,
    )  # fmt: skip


@inlined
def _along_z(m, q, z0, z1, z2, z3):
    """Return the same for ΦᵀD^z: z pairs q and q + 9 added up, four (x, y) test functions."""
    return _pair2(
        m[q] + m[q + U(9)], m[q + U(1)] + m[q + U(10)], m[q + U(2)] + m[q + U(11)],
        m[q + U(3)] + m[q + U(12)], m[q + U(4)] + m[q + U(13)], m[q + U(5)] + m[q + U(14)],
        m[q + U(6)] + m[q + U(15)], m[q + U(7)] + m[q + U(16)], m[q + U(8)] + m[q + U(17)],
        z0, z1, z2, z3,
    )  # fmt: skip


@hot
def row_sums_3d(moments, shape, layout, out, column):
    """Add the row sums Φᵀ1 to out[:, column]."""
    m, z, row, plane = moments.reshape(-1), U(column), U(layout[1]), U(layout[2])
    for k in range(shape[2]):
        for j in range(shape[1]):
            n = U(layout[0] + k * layout[2] + j * layout[1])
            r0, r1, r2, r3 = 0.0, 0.0, 0.0, 0.0
            for i in range(shape[0]):
                q = U(27 * ((k * shape[1] + j) * shape[0] + i))
                a0, a1, a2, a3, a4, a5, a6, a7 = _gram_cell_3d(m, q, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
                _add_edge_3d(out, z, n, row, plane, r0 + a0, r1 + a2, r2 + a4, r3 + a6)
                r0, r1, r2, r3 = a1, a3, a5, a7
                n += U(1)
            _add_edge_3d(out, z, n, row, plane, r0, r1, r2, r3)


@inlined
def _add_edge_3d(out, k, n, row, plane, a0, a1, a2, a3):
    """Add to column k of the four nodes at low and high y and z."""
    t = n + plane
    out[n, k] += a0
    out[n + row, k] += a1
    out[t, k] += a2
    out[t + row, k] += a3


@hot
def gram_1d(moments, shape, layout, values, out, column):
    """Add G values to `out`, one column of both."""
    m, e, z = moments.reshape(-1), U(1), U(column)
    right, v0 = 0.0, values[U(layout[0]), z]
    for i in range(shape[0]):
        q, n = U(3 * i), U(layout[0] + i)
        v1 = values[n + e, z]
        a0, a1 = _pair(m[q], m[q + e], m[q + U(2)], v0, v1)
        out[n, z] += right + a0
        right, v0 = a1, v1
    out[U(layout[0] + shape[0]), z] += right


@hot
def gram_2d(moments, shape, layout, values, out, column):
    """Add G values to `out`, one column of both."""
    m, v, row, e, z = moments.reshape(-1), values, U(layout[1]), U(1), U(column)
    for j in range(shape[1]):
        n = U(layout[0] + j * layout[1])
        r0, r1, v0, v2 = 0.0, 0.0, v[n, z], v[n + row, z]
        for i in range(shape[0]):
            v1, v3 = v[n + e, z], v[n + row + e, z]
            a0, a1, a2, a3 = _plane(m, U(9 * (j * shape[0] + i)), v0, v1, v2, v3)
            out[n, z] += r0 + a0
            out[n + row, z] += r1 + a2
            r0, r1, v0, v2 = a1, a3, v1, v3
            n += e
        out[n, z] += r0
        out[n + row, z] += r1


@hot
def gram_3d(moments, shape, layout, values, out, column):
    """Add G values to `out`, one column of both."""
    m, v, row, plane, e, z = moments.reshape(-1), values, U(layout[1]), U(layout[2]), U(1), U(column)
    for k in range(shape[2]):
        for j in range(shape[1]):
            n = U(layout[0] + k * layout[2] + j * layout[1])
            t = n + plane
            r0, r1, r2, r3 = 0.0, 0.0, 0.0, 0.0
            v0, v2, v4, v6 = v[n, z], v[n + row, z], v[t, z], v[t + row, z]
            for i in range(shape[0]):
                t = n + plane
                v1, v3, v5, v7 = v[n + e, z], v[n + row + e, z], v[t + e, z], v[t + row + e, z]
                q = U(27 * ((k * shape[1] + j) * shape[0] + i))
                a0, a1, a2, a3, a4, a5, a6, a7 = _gram_cell_3d(m, q, v0, v1, v2, v3, v4, v5, v6, v7)
                _add_edge_3d(out, z, n, row, plane, r0 + a0, r1 + a2, r2 + a4, r3 + a6)
                r0, r1, r2, r3 = a1, a3, a5, a7
                v0, v2, v4, v6 = v1, v3, v5, v7
                n += e
            _add_edge_3d(out, z, n, row, plane, r0, r1, r2, r3)


@hot
def cross_1d(moments, shape, layout, inverse_h, values, out, divergence):
    """Add ΦᵀD values to `out`: the gradient of one column, which in 1D is the divergence too."""
    m, e, z = moments.reshape(-1), U(1), U(0)
    right, v0 = 0.0, values[U(layout[0]), z]
    for i in range(shape[0]):
        q, n = U(3 * i), U(layout[0] + i)
        v1 = values[n + e, z]
        x = inverse_h[0] * (v1 - v0)
        out[n, z] += right + (m[q] + m[q + e]) * x
        right, v0 = (m[q + e] + m[q + U(2)]) * x, v1
    out[U(layout[0] + shape[0]), z] += right


@hot
def cross_2d(moments, shape, layout, inverse_h, values, out, divergence):
    """Add ΦᵀD^a values to `out`: the gradient of one column (out has two), or the divergence of two (out has one)."""
    m, v, row, e, z = moments.reshape(-1), values, U(layout[1]), U(1), U(0)
    rx, ry = inverse_h[0], inverse_h[1]
    ky = e if divergence else z
    for j in range(shape[1]):
        n = U(layout[0] + j * layout[1])
        # r: what the cell before adds to the two nodes that it shares; v0, v2: x part at them; y0: y difference
        r0, r1, r2, r3 = 0.0, 0.0, 0.0, 0.0
        v0, v2, y0 = v[n, z], v[n + row, z], ry * (v[n + row, ky] - v[n, ky])
        for i in range(shape[0]):
            t = n + row
            v1, v3, y1 = v[n + e, z], v[t + e, z], ry * (v[t + e, ky] - v[n + e, ky])
            g0, g1, g2, g3, f0, f1, f2, f3 = _cross_cell_2d(
                m, U(9 * (j * shape[0] + i)), rx * (v1 - v0), rx * (v3 - v2), y0, y1
            )
            if divergence:
                out[n, z] += r0 + (g0 + f0)
                out[t, z] += r1 + (g2 + f2)
                r0, r1 = g1 + f1, g3 + f3
            else:
                out[n, z] += r0 + g0
                out[n, e] += r2 + f0
                out[t, z] += r1 + g2
                out[t, e] += r3 + f2
                r0, r1, r2, r3 = g1, g3, f1, f3
            v0, v2, y0 = v1, v3, y1
            n += e
        out[n, z] += r0
        out[n + row, z] += r1
        if not divergence:
            out[n, e] += r2
            out[n + row, e] += r3


@inlined
def _cross_cell_3d(m, q, v, n, row, plane, rx, ry, rz, kx, ky, kz):
    """Return a cell's rows of ΦᵀD^x, ΦᵀD^y and ΦᵀD^z, corners 0 to 7, x fastest: g along x, f along y, d along z."""
    e = U(1)
    c, t = n + row, n + plane
    u = t + row
    x0, x1 = rx * (v[n + e, kx] - v[n, kx]), rx * (v[c + e, kx] - v[c, kx])
    x2, x3 = rx * (v[t + e, kx] - v[t, kx]), rx * (v[u + e, kx] - v[u, kx])
    y0, y1 = ry * (v[c, ky] - v[n, ky]), ry * (v[c + e, ky] - v[n + e, ky])
    y2, y3 = ry * (v[u, ky] - v[t, ky]), ry * (v[u + e, ky] - v[t + e, ky])
    z0, z1 = rz * (v[t, kz] - v[n, kz]), rz * (v[t + e, kz] - v[n + e, kz])
    z2, z3 = rz * (v[u, kz] - v[c, kz]), rz * (v[u + e, kz] - v[c + e, kz])
    g0, g2, g4, g6 = _along_x(m, q, x0, x1, x2, x3)
    g1, g3, g5, g7 = _along_x(m, q + e, x0, x1, x2, x3)
    f0, f1, f4, f5 = _along_y(m, q, y0, y1, y2, y3)
    f2, f3, f6, f7 = _along_y(m, q + U(3), y0, y1, y2, y3)
    d0, d1, d2, d3 = _along_z(m, q, z0, z1, z2, z3)
    d4, d5, d6, d7 = _along_z(m, q + U(9), z0, z1, z2, z3)
    return (g0, g1, g2, g3, g4, g5, g6, g7, f0, f1, f2, f3, f4, f5, f6, f7, d0, d1, d2, d3, d4, d5, d6, d7)


@inner
def _divergence_3d(m, shape, layout, inverse_h, v, out):
    row, plane, e, z = U(layout[1]), U(layout[2]), U(1), U(0)
    rx, ry, rz = inverse_h[0], inverse_h[1], inverse_h[2]
    for k in range(shape[2]):
        for j in range(shape[1]):
            n = U(layout[0] + k * layout[2] + j * layout[1])
            r0, r1, r2, r3 = 0.0, 0.0, 0.0, 0.0
            for i in range(shape[0]):
                q = U(27 * ((k * shape[1] + j) * shape[0] + i))
                (g0, g1, g2, g3, g4, g5, g6, g7, f0, f1, f2, f3, f4, f5, f6, f7, d0, d1, d2, d3, d4, d5, d6, d7) = (
                    _cross_cell_3d(m, q, v, n, row, plane, rx, ry, rz, z, e, U(2))
                )
                _add_edge_3d(
                    out, z, n, row, plane, r0 + (g0 + f0 + d0), r1 + (g2 + f2 + d2), r2 + (g4 + f4 + d4),
                    r3 + (g6 + f6 + d6),
                )  # fmt: skip
                r0, r1, r2, r3 = g1 + f1 + d1, g3 + f3 + d3, g5 + f5 + d5, g7 + f7 + d7
                n += e
            _add_edge_3d(out, z, n, row, plane, r0, r1, r2, r3)


@inner
def _gradient_3d(m, shape, layout, inverse_h, v, out):
    row, plane, e, z, k2 = U(layout[1]), U(layout[2]), U(1), U(0), U(2)
    rx, ry, rz = inverse_h[0], inverse_h[1], inverse_h[2]
    for k in range(shape[2]):
        for j in range(shape[1]):
            n = U(layout[0] + k * layout[2] + j * layout[1])
            r0, r1, r2, r3, s0, s1, s2, s3, t0, t1, t2, t3 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(shape[0]):
                q = U(27 * ((k * shape[1] + j) * shape[0] + i))
                (g0, g1, g2, g3, g4, g5, g6, g7, f0, f1, f2, f3, f4, f5, f6, f7, d0, d1, d2, d3, d4, d5, d6, d7) = (
                    _cross_cell_3d(m, q, v, n, row, plane, rx, ry, rz, z, z, z)
                )
                _add_edge_3d(out, z, n, row, plane, r0 + g0, r1 + g2, r2 + g4, r3 + g6)
                _add_edge_3d(out, e, n, row, plane, s0 + f0, s1 + f2, s2 + f4, s3 + f6)
                _add_edge_3d(out, k2, n, row, plane, t0 + d0, t1 + d2, t2 + d4, t3 + d6)
                r0, r1, r2, r3, s0, s1, s2, s3, t0, t1, t2, t3 = g1, g3, g5, g7, f1, f3, f5, f7, d1, d3, d5, d7
                n += e
            _add_edge_3d(out, z, n, row, plane, r0, r1, r2, r3)
            _add_edge_3d(out, e, n, row, plane, s0, s1, s2, s3)
            _add_edge_3d(out, k2, n, row, plane, t0, t1, t2, t3)


@hot
def cross_3d(moments, shape, layout, inverse_h, values, out, divergence):
    """Add ΦᵀD^a values to `out`: the gradient of one column (out has three) or the divergence of three (it has one)."""
    if divergence:
        _divergence_3d(moments.reshape(-1), shape, layout, inverse_h, values, out)
    else:
        _gradient_3d(moments.reshape(-1), shape, layout, inverse_h, values, out)

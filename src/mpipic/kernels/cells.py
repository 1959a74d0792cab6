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

from mpipic.kernels.common import U, hot, inlined


@inlined
def _pair(a, b, c, x, y):
    """The symmetric matrix [[a, b], [b, c]] times (x, y)."""
    return a * x + b * y, b * x + c * y


@inlined
def _pair2(a0, b0, c0, a1, b1, c1, a2, b2, c2, x00, x10, x01, x11):
    """Two axes: [[M0, M1], [M1, M2]] with blocks Mi = [[ai, bi], [bi, ci]], times (x00, x10, x01, x11)."""
    p0, p1 = _pair(a0, b0, c0, x00, x10)
    q0, q1 = _pair(a1, b1, c1, x01, x11)
    r0, r1 = _pair(a1, b1, c1, x00, x10)
    s0, s1 = _pair(a2, b2, c2, x01, x11)
    return p0 + q0, p1 + q1, r0 + s0, r1 + s1


@inlined
def _plane(m, q, x00, x10, x01, x11):
    """Two axes with the nine moments that start at m[q]."""
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
    """Rows of ΦᵀD^x and ΦᵀD^y: x0, x1 are the x differences at low and high y, y0, y1 the y differences."""
    gx00, gx01 = _pair(m[q] + m[q + U(1)], m[q + U(3)] + m[q + U(4)], m[q + U(6)] + m[q + U(7)], x0, x1)
    gx10, gx11 = _pair(m[q + U(1)] + m[q + U(2)], m[q + U(4)] + m[q + U(5)], m[q + U(7)] + m[q + U(8)], x0, x1)
    gy00, gy10 = _pair(m[q] + m[q + U(3)], m[q + U(1)] + m[q + U(4)], m[q + U(2)] + m[q + U(5)], y0, y1)
    gy01, gy11 = _pair(m[q + U(3)] + m[q + U(6)], m[q + U(4)] + m[q + U(7)], m[q + U(5)] + m[q + U(8)], y0, y1)
    return gx00, gx10, gx01, gx11, gy00, gy10, gy01, gy11


@inlined
def _along_x(m, q, x0, x1, x2, x3):
    """Half a row block of ΦᵀD^x in 3D, the moments at x pair q and q + 1 added up: four (y, z) test functions."""
    return _pair2(
        m[q] + m[q + U(1)], m[q + U(3)] + m[q + U(4)], m[q + U(6)] + m[q + U(7)],
        m[q + U(9)] + m[q + U(10)], m[q + U(12)] + m[q + U(13)], m[q + U(15)] + m[q + U(16)],
        m[q + U(18)] + m[q + U(19)], m[q + U(21)] + m[q + U(22)], m[q + U(24)] + m[q + U(25)],
        x0, x1, x2, x3,
    )  # fmt: skip


@inlined
def _along_y(m, q, y0, y1, y2, y3):
    """The same for ΦᵀD^y: y pairs q and q + 3 added up, four (x, z) test functions."""
    return _pair2(
        m[q] + m[q + U(3)], m[q + U(1)] + m[q + U(4)], m[q + U(2)] + m[q + U(5)],
        m[q + U(9)] + m[q + U(12)], m[q + U(10)] + m[q + U(13)], m[q + U(11)] + m[q + U(14)],
        m[q + U(18)] + m[q + U(21)], m[q + U(19)] + m[q + U(22)], m[q + U(20)] + m[q + U(23)],
        y0, y1, y2, y3,
    )  # fmt: skip


@inlined
def _along_z(m, q, z0, z1, z2, z3):
    """The same for ΦᵀD^z: z pairs q and q + 9 added up, four (x, y) test functions."""
    return _pair2(
        m[q] + m[q + U(9)], m[q + U(1)] + m[q + U(10)], m[q + U(2)] + m[q + U(11)],
        m[q + U(3)] + m[q + U(12)], m[q + U(4)] + m[q + U(13)], m[q + U(5)] + m[q + U(14)],
        m[q + U(6)] + m[q + U(15)], m[q + U(7)] + m[q + U(16)], m[q + U(8)] + m[q + U(17)],
        z0, z1, z2, z3,
    )  # fmt: skip


@inlined
def _add4(o, k, n, row, a0, a1, a2, a3):
    """Add to column k of the four corners of a cell, n the lowest."""
    o[n, k] += a0
    o[n + U(1), k] += a1
    o[n + row, k] += a2
    o[n + row + U(1), k] += a3


@hot
def row_sums_1d(moments, shape, layout, out, column):
    """out[:, column] += Φᵀ1."""
    m, k = moments.reshape(-1), U(column)
    for i in range(shape[0]):
        q, n = U(3 * i), U(layout[0] + i)
        out[n, k] += m[q] + m[q + U(1)]
        out[n + U(1), k] += m[q + U(1)] + m[q + U(2)]


@hot
def row_sums_2d(moments, shape, layout, out, column):
    """out[:, column] += Φᵀ1."""
    m, k, row = moments.reshape(-1), U(column), U(layout[1])
    for j in range(shape[1]):
        for i in range(shape[0]):
            a0, a1, a2, a3 = _plane(m, U(9 * (j * shape[0] + i)), 1.0, 1.0, 1.0, 1.0)
            _add4(out, k, U(layout[0] + j * layout[1] + i), row, a0, a1, a2, a3)


@hot
def row_sums_3d(moments, shape, layout, out, column):
    """out[:, column] += Φᵀ1."""
    m, c, row, plane = moments.reshape(-1), U(column), U(layout[1]), U(layout[2])
    for k in range(shape[2]):
        for j in range(shape[1]):
            for i in range(shape[0]):
                n = U(layout[0] + k * layout[2] + j * layout[1] + i)
                q = U(27 * ((k * shape[1] + j) * shape[0] + i))
                a0, a1, a2, a3, a4, a5, a6, a7 = _gram_cell_3d(m, q, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
                _add4(out, c, n, row, a0, a1, a2, a3)
                _add4(out, c, n + plane, row, a4, a5, a6, a7)


@hot
def gram_1d(moments, shape, layout, values, out):
    """out += G values, column 0."""
    m, e, z = moments.reshape(-1), U(1), U(0)
    for i in range(shape[0]):
        q, n = U(3 * i), U(layout[0] + i)
        a0, a1 = _pair(m[q], m[q + e], m[q + U(2)], values[n, z], values[n + e, z])
        out[n, z] += a0
        out[n + e, z] += a1


@hot
def gram_2d(moments, shape, layout, values, out):
    """out += G values, column 0."""
    m, row, e, z = moments.reshape(-1), U(layout[1]), U(1), U(0)
    for j in range(shape[1]):
        for i in range(shape[0]):
            n = U(layout[0] + j * layout[1] + i)
            t = n + row
            a0, a1, a2, a3 = _plane(
                m, U(9 * (j * shape[0] + i)), values[n, z], values[n + e, z], values[t, z], values[t + e, z]
            )
            _add4(out, z, n, row, a0, a1, a2, a3)


@hot
def gram_3d(moments, shape, layout, values, out):
    """out += G values, column 0."""
    m, v, row, plane, e, z = moments.reshape(-1), values, U(layout[1]), U(layout[2]), U(1), U(0)
    for k in range(shape[2]):
        for j in range(shape[1]):
            for i in range(shape[0]):
                n = U(layout[0] + k * layout[2] + j * layout[1] + i)
                t = n + plane
                a0, a1, a2, a3, a4, a5, a6, a7 = _gram_cell_3d(
                    m, U(27 * ((k * shape[1] + j) * shape[0] + i)),
                    v[n, z], v[n + e, z], v[n + row, z], v[n + row + e, z],
                    v[t, z], v[t + e, z], v[t + row, z], v[t + row + e, z],
                )  # fmt: skip
                _add4(out, z, n, row, a0, a1, a2, a3)
                _add4(out, z, t, row, a4, a5, a6, a7)


@hot
def cross_1d(moments, shape, layout, inverse_h, values, out, divergence):
    """out += ΦᵀD values: the gradient of one column, which in 1D is the divergence too."""
    m, e, z = moments.reshape(-1), U(1), U(0)
    for i in range(shape[0]):
        q, n = U(3 * i), U(layout[0] + i)
        x = inverse_h[0] * (values[n + e, z] - values[n, z])
        out[n, z] += (m[q] + m[q + e]) * x
        out[n + e, z] += (m[q + e] + m[q + U(2)]) * x


@hot
def cross_2d(moments, shape, layout, inverse_h, values, out, divergence):
    """out += ΦᵀD^a values: the gradient of one column (out has two), or the divergence of two columns (out has one)."""
    m, v, row, e, z = moments.reshape(-1), values, U(layout[1]), U(1), U(0)
    rx, ry = inverse_h[0], inverse_h[1]
    ky = U(1) if divergence else z
    for j in range(shape[1]):
        for i in range(shape[0]):
            n = U(layout[0] + j * layout[1] + i)
            t = n + row
            x0, x1 = rx * (v[n + e, z] - v[n, z]), rx * (v[t + e, z] - v[t, z])
            y0, y1 = ry * (v[t, ky] - v[n, ky]), ry * (v[t + e, ky] - v[n + e, ky])
            g0, g1, g2, g3, f0, f1, f2, f3 = _cross_cell_2d(m, U(9 * (j * shape[0] + i)), x0, x1, y0, y1)
            if divergence:
                _add4(out, z, n, row, g0 + f0, g1 + f1, g2 + f2, g3 + f3)
            else:
                _add4(out, z, n, row, g0, g1, g2, g3)
                _add4(out, e, n, row, f0, f1, f2, f3)


@hot
def cross_3d(moments, shape, layout, inverse_h, values, out, divergence):
    """out += ΦᵀD^a values: the gradient of one column (out has three), or the divergence of three (out has one)."""
    m, v, row, plane, e, z = moments.reshape(-1), values, U(layout[1]), U(layout[2]), U(1), U(0)
    rx, ry, rz = inverse_h[0], inverse_h[1], inverse_h[2]
    ky, kz = (U(1), U(2)) if divergence else (z, z)
    for k in range(shape[2]):
        for j in range(shape[1]):
            for i in range(shape[0]):
                n = U(layout[0] + k * layout[2] + j * layout[1] + i)
                q = U(27 * ((k * shape[1] + j) * shape[0] + i))
                c, t = n + row, n + plane
                u = t + row
                x0, x1 = rx * (v[n + e, z] - v[n, z]), rx * (v[c + e, z] - v[c, z])
                x2, x3 = rx * (v[t + e, z] - v[t, z]), rx * (v[u + e, z] - v[u, z])
                y0, y1 = ry * (v[c, ky] - v[n, ky]), ry * (v[c + e, ky] - v[n + e, ky])
                y2, y3 = ry * (v[u, ky] - v[t, ky]), ry * (v[u + e, ky] - v[t + e, ky])
                z0, z1 = rz * (v[t, kz] - v[n, kz]), rz * (v[t + e, kz] - v[n + e, kz])
                z2, z3 = rz * (v[u, kz] - v[c, kz]), rz * (v[u + e, kz] - v[c + e, kz])
                # test function at corner 0 to 7, x fastest: g along x, f along y, d along z
                g0, g2, g4, g6 = _along_x(m, q, x0, x1, x2, x3)
                g1, g3, g5, g7 = _along_x(m, q + e, x0, x1, x2, x3)
                f0, f1, f4, f5 = _along_y(m, q, y0, y1, y2, y3)
                f2, f3, f6, f7 = _along_y(m, q + U(3), y0, y1, y2, y3)
                d0, d1, d2, d3 = _along_z(m, q, z0, z1, z2, z3)
                d4, d5, d6, d7 = _along_z(m, q + U(9), z0, z1, z2, z3)
                if divergence:
                    _add4(out, z, n, row, g0 + f0 + d0, g1 + f1 + d1, g2 + f2 + d2, g3 + f3 + d3)
                    _add4(out, z, t, row, g4 + f4 + d4, g5 + f5 + d5, g6 + f6 + d6, g7 + f7 + d7)
                else:
                    _add4(out, z, n, row, g0, g1, g2, g3)
                    _add4(out, z, t, row, g4, g5, g6, g7)
                    _add4(out, e, n, row, f0, f1, f2, f3)
                    _add4(out, e, t, row, f4, f5, f6, f7)
                    _add4(out, U(2), n, row, d0, d1, d2, d3)
                    _add4(out, U(2), t, row, d4, d5, d6, d7)

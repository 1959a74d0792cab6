"""The sweep over particles that a time step makes, on the linear basis: update, move and map in one pass over memory.

`advance_*d` adds to every particle an increment from its nodes, moves it, and adds it to the sums at the nodes
of its new place: Φᵀ of the state columns, Φᵀ1 in the last column of `sums`, and the pair moments of its cell
(`kernels.cells`). A particle that left this rank's cells is updated and moved, but not summed: its index goes to
`leaving`, and whoever receives it sums it with `deposit_*d`.

Arguments
---------
coordinate (n, d), in cells, state (n, 1 + d) : modified. The first column of `state` is the scalar, the others the vector.
nodal (nodes, 1 + d), rates (two floats) : what to add. The scalar gets rates[0] Φ times column 0, the vector rates[1] Φ
    times columns 1 to d; or, if `direct` (the scheme without a filter), the scalar gets rates[0] times the divergence of
    columns 1 to d, the vector rates[1] times the gradient of column 0.
sums (nodes, d + 2), moments (cells, 3^d) : added to; moments and the last column of sums only if `weigh`.
start, stop : the range of particles.
geometry : tuple (inverse_h, tolerance, period, top, shift, first), each a tuple of one entry per axis: cells per unit
    length, and in cells the width of "on a node", the period, the coordinate from which a particle counts as back at
    0, the displacement of this step, and the first cell of this rank.
shape, layout : as in `kernels.cells`.

Returns the largest |scalar| (NaN if any is), how many particles lie in another cell than their predecessor, and how
many left (which may exceed the length of `leaving`: then the list is incomplete).
"""

from mpipic.kernels.common import U, cell_and_fraction, hot, inlined, moved


@inlined
def _lerp(a, b, f):
    return a + f * (b - a)


@inlined
def _larger(peak, value):
    """Running maximum of |value| that a NaN enters and never leaves."""
    value = abs(value)
    return peak if peak >= value else (value if peak == peak else peak)


@inlined
def _add2(g, b, w, r, u):
    a0, a1 = g[b] + w * r, g[b + U(1)] + w * u
    g[b], g[b + U(1)] = a0, a1


@inlined
def _add3(g, b, w, r, u, v):
    a0, a1, a2 = g[b] + w * r, g[b + U(1)] + w * u, g[b + U(2)] + w * v
    g[b], g[b + U(1)], g[b + U(2)] = a0, a1, a2


@inlined
def _add4(g, b, w, r, u, v, t):
    a0, a1, a2, a3 = g[b] + w * r, g[b + U(1)] + w * u, g[b + U(2)] + w * v, g[b + U(3)] + w * t
    g[b], g[b + U(1)], g[b + U(2)], g[b + U(3)] = a0, a1, a2, a3


@inlined
def _deposit_1d(sums, moments, node, cell, f, r, u, weigh):
    w = 1.0 - f
    b = U(3 * node)
    if weigh:
        _add3(sums, b, w, r, u, 1.0)
        _add3(sums, b + U(3), f, r, u, 1.0)
        m = U(3 * cell)
        m0, m1, m2 = moments[m] + w * w, moments[m + U(1)] + w * f, moments[m + U(2)] + f * f
        moments[m], moments[m + U(1)], moments[m + U(2)] = m0, m1, m2
    else:
        _add2(sums, b, w, r, u)
        _add2(sums, b + U(3), f, r, u)


@inlined
def _add9(m, b, w, p0, p1, p2, p3, p4, p5, p6, p7, p8):
    a0, a1, a2, a3 = m[b] + w * p0, m[b + U(1)] + w * p1, m[b + U(2)] + w * p2, m[b + U(3)] + w * p3
    a4, a5, a6, a7 = m[b + U(4)] + w * p4, m[b + U(5)] + w * p5, m[b + U(6)] + w * p6, m[b + U(7)] + w * p7
    a8 = m[b + U(8)] + w * p8
    m[b], m[b + U(1)], m[b + U(2)], m[b + U(3)] = a0, a1, a2, a3
    m[b + U(4)], m[b + U(5)], m[b + U(6)], m[b + U(7)] = a4, a5, a6, a7
    m[b + U(8)] = a8


@inlined
def _deposit_2d(sums, moments, node, row, cell, fx, fy, r, u, v, weigh):
    wx, wy = 1.0 - fx, 1.0 - fy
    b, t = U(4 * node), U(4 * (node + row))
    if weigh:
        _add4(sums, b, wx * wy, r, u, v, 1.0)
        _add4(sums, b + U(4), fx * wy, r, u, v, 1.0)
        _add4(sums, t, wx * fy, r, u, v, 1.0)
        _add4(sums, t + U(4), fx * fy, r, u, v, 1.0)
        x0, x1, x2 = wx * wx, wx * fx, fx * fx
        y0, y1, y2 = wy * wy, wy * fy, fy * fy
        _add9(moments, U(9 * cell), 1.0, x0 * y0, x1 * y0, x2 * y0, x0 * y1, x1 * y1, x2 * y1, x0 * y2, x1 * y2, x2 * y2)
    else:
        _add3(sums, b, wx * wy, r, u, v)
        _add3(sums, b + U(4), fx * wy, r, u, v)
        _add3(sums, t, wx * fy, r, u, v)
        _add3(sums, t + U(4), fx * fy, r, u, v)


@inlined
def _deposit_3d(sums, moments, node, row, plane, cell, fx, fy, fz, r, u, v, t, weigh):
    wx, wy, wz = 1.0 - fx, 1.0 - fy, 1.0 - fz
    b0, b1 = U(5 * node), U(5 * (node + row))
    b2, b3 = U(5 * (node + plane)), U(5 * (node + plane + row))
    a0, a1, a2, a3 = wy * wz, fy * wz, wy * fz, fy * fz
    _add4(sums, b0, a0 * wx, r, u, v, t)
    _add4(sums, b0 + U(5), a0 * fx, r, u, v, t)
    _add4(sums, b1, a1 * wx, r, u, v, t)
    _add4(sums, b1 + U(5), a1 * fx, r, u, v, t)
    _add4(sums, b2, a2 * wx, r, u, v, t)
    _add4(sums, b2 + U(5), a2 * fx, r, u, v, t)
    _add4(sums, b3, a3 * wx, r, u, v, t)
    _add4(sums, b3 + U(5), a3 * fx, r, u, v, t)
    if weigh:
        m = U(27 * cell)
        x0, x1, x2 = wx * wx, wx * fx, fx * fx
        y0, y1, y2 = wy * wy, wy * fy, fy * fy
        p0, p1, p2, p3, p4, p5, p6, p7, p8 = (
            x0 * y0, x1 * y0, x2 * y0, x0 * y1, x1 * y1, x2 * y1, x0 * y2, x1 * y2, x2 * y2
        )  # fmt: skip
        _add9(moments, m, wz * wz, p0, p1, p2, p3, p4, p5, p6, p7, p8)
        _add9(moments, m + U(9), wz * fz, p0, p1, p2, p3, p4, p5, p6, p7, p8)
        _add9(moments, m + U(18), fz * fz, p0, p1, p2, p3, p4, p5, p6, p7, p8)


@hot
def deposit_1d(coordinate, state, sums, moments, start, stop, geometry, shape, layout, weigh):
    """Add particles start to stop to the sums and moments; returns the largest |scalar|."""
    _, (tolx,), _, _, _, (cx0,) = geometry
    x, s, o, m = coordinate.reshape(-1), state.reshape(-1), sums.reshape(-1), moments.reshape(-1)
    peak = 0.0
    for p in range(start, stop):
        q = U(2 * p)
        r, u = s[q], s[q + U(1)]
        peak = _larger(peak, r)
        c, f = cell_and_fraction(x[p], tolx)
        c -= cx0
        _deposit_1d(o, m, layout[0] + c, c, f, r, u, weigh)
    return peak


@hot
def deposit_2d(coordinate, state, sums, moments, start, stop, geometry, shape, layout, weigh):
    """Add particles start to stop to the sums and moments; returns the largest |scalar|."""
    _, (tolx, toly), _, _, _, (cx0, cy0) = geometry
    x, s, o, m = coordinate.reshape(-1), state.reshape(-1), sums.reshape(-1), moments.reshape(-1)
    peak = 0.0
    for p in range(start, stop):
        q = U(3 * p)
        r, u, v = s[q], s[q + U(1)], s[q + U(2)]
        peak = _larger(peak, r)
        cx, fx = cell_and_fraction(x[U(2 * p)], tolx)
        cy, fy = cell_and_fraction(x[U(2 * p + 1)], toly)
        cx -= cx0
        cy -= cy0
        node = layout[0] + cy * layout[1] + cx
        _deposit_2d(o, m, node, layout[1], cy * shape[0] + cx, fx, fy, r, u, v, weigh)
    return peak


@hot
def deposit_3d(coordinate, state, sums, moments, start, stop, geometry, shape, layout, weigh):
    """Add particles start to stop to the sums and moments; returns the largest |scalar|."""
    _, (tolx, toly, tolz), _, _, _, (cx0, cy0, cz0) = geometry
    x, s, o, m = coordinate.reshape(-1), state.reshape(-1), sums.reshape(-1), moments.reshape(-1)
    peak = 0.0
    for p in range(start, stop):
        q = U(4 * p)
        r, u, v, t = s[q], s[q + U(1)], s[q + U(2)], s[q + U(3)]
        peak = _larger(peak, r)
        cx, fx = cell_and_fraction(x[U(3 * p)], tolx)
        cy, fy = cell_and_fraction(x[U(3 * p + 1)], toly)
        cz, fz = cell_and_fraction(x[U(3 * p + 2)], tolz)
        cx -= cx0
        cy -= cy0
        cz -= cz0
        node = layout[0] + cz * layout[2] + cy * layout[1] + cx
        cell = (cz * shape[1] + cy) * shape[0] + cx
        _deposit_3d(o, m, node, layout[1], layout[2], cell, fx, fy, fz, r, u, v, t, weigh)
    return peak


@hot
def advance_1d(
    coordinate, state, nodal, rates, sums, moments, start, stop, geometry, shape, layout, direct, weigh, leaving
):
    """See the module's docstring."""
    (ihx,), (tolx,), (lx,), (topx,), (dx,), (cx0,) = geometry
    x, s, g = coordinate.reshape(-1), state.reshape(-1), nodal.reshape(-1)
    o, m = sums.reshape(-1), moments.reshape(-1)
    base = layout[0] - cx0
    ra, rb = rates
    sx, tx = ra * ihx, rb * ihx
    peak, breaks, left, before = 0.0, 0, 0, -1
    for p in range(start, stop):
        xp = x[p]
        c, f = cell_and_fraction(xp, tolx)
        b = U(2 * (c + base))
        g0, g1, g2, g3 = g[b], g[b + U(1)], g[b + U(2)], g[b + U(3)]
        q = U(2 * p)
        if direct:
            r, u = s[q] + sx * (g3 - g1), s[q + U(1)] + tx * (g2 - g0)
        else:
            r, u = s[q] + ra * _lerp(g0, g2, f), s[q + U(1)] + rb * _lerp(g1, g3, f)
        s[q], s[q + U(1)] = r, u
        peak = _larger(peak, r)
        xp = moved(xp, dx, lx, topx)
        x[p] = xp
        c, f = cell_and_fraction(xp, tolx)
        c -= cx0
        if U(c) >= U(shape[0]):
            if left < leaving.size:
                leaving[left] = p
            left += 1
        else:
            _deposit_1d(o, m, layout[0] + c, c, f, r, u, weigh)
            breaks += c != before
            before = c
    return peak, breaks, left


@inlined
def _bilinear(g, b, t, fx, fy):
    return _lerp(_lerp(g[b], g[b + U(3)], fx), _lerp(g[t], g[t + U(3)], fx), fy)


@hot
def advance_2d(
    coordinate, state, nodal, rates, sums, moments, start, stop, geometry, shape, layout, direct, weigh, leaving
):
    """See the module's docstring."""
    (ihx, ihy), (tolx, toly), (lx, ly), (topx, topy), (dx, dy), (cx0, cy0) = geometry
    x, s, g = coordinate.reshape(-1), state.reshape(-1), nodal.reshape(-1)
    o, m = sums.reshape(-1), moments.reshape(-1)
    base = layout[0] - cy0 * layout[1] - cx0
    ra, rb = rates
    sx, sy, tx, ty = ra * ihx, ra * ihy, rb * ihx, rb * ihy
    peak, breaks, left, before = 0.0, 0, 0, -1
    for p in range(start, stop):
        xp, yp = x[U(2 * p)], x[U(2 * p + 1)]
        cx, fx = cell_and_fraction(xp, tolx)
        cy, fy = cell_and_fraction(yp, toly)
        b = U(3 * (base + cy * layout[1] + cx))
        t = b + U(3 * layout[1])
        q = U(3 * p)
        if direct:
            r = s[q]
            r += sx * _lerp(g[b + U(4)] - g[b + U(1)], g[t + U(4)] - g[t + U(1)], fy)
            r += sy * _lerp(g[t + U(2)] - g[b + U(2)], g[t + U(5)] - g[b + U(5)], fx)
            u = s[q + U(1)] + tx * _lerp(g[b + U(3)] - g[b], g[t + U(3)] - g[t], fy)
            v = s[q + U(2)] + ty * _lerp(g[t] - g[b], g[t + U(3)] - g[b + U(3)], fx)
        else:
            r = s[q] + ra * _bilinear(g, b, t, fx, fy)
            u = s[q + U(1)] + rb * _bilinear(g, b + U(1), t + U(1), fx, fy)
            v = s[q + U(2)] + rb * _bilinear(g, b + U(2), t + U(2), fx, fy)
        s[q], s[q + U(1)], s[q + U(2)] = r, u, v
        peak = _larger(peak, r)
        xp, yp = moved(xp, dx, lx, topx), moved(yp, dy, ly, topy)
        x[U(2 * p)], x[U(2 * p + 1)] = xp, yp
        cx, fx = cell_and_fraction(xp, tolx)
        cy, fy = cell_and_fraction(yp, toly)
        cx -= cx0
        cy -= cy0
        if U(cx) >= U(shape[0]) or U(cy) >= U(shape[1]):
            if left < leaving.size:
                leaving[left] = p
            left += 1
        else:
            cell = cy * shape[0] + cx
            node = layout[0] + cy * layout[1] + cx
            _deposit_2d(o, m, node, layout[1], cell, fx, fy, r, u, v, weigh)
            breaks += cell != before
            before = cell
    return peak, breaks, left


@inlined
def _trilinear(g, b, c, t, e, fx, fy, fz):
    low = _lerp(_lerp(g[b], g[b + U(4)], fx), _lerp(g[c], g[c + U(4)], fx), fy)
    high = _lerp(_lerp(g[t], g[t + U(4)], fx), _lerp(g[e], g[e + U(4)], fx), fy)
    return _lerp(low, high, fz)


@inlined
def _slope(g, a0, a1, b0, b1, c0, c1, d0, d1, f, h):
    """Difference along one axis (x1 - x0), interpolated along the two others with f and h."""
    return _lerp(_lerp(g[a1] - g[a0], g[b1] - g[b0], f), _lerp(g[c1] - g[c0], g[d1] - g[d0], f), h)


@hot
def advance_3d(
    coordinate, state, nodal, rates, sums, moments, start, stop, geometry, shape, layout, direct, weigh, leaving
):
    """See the module's docstring."""
    (ihx, ihy, ihz), (tolx, toly, tolz), (lx, ly, lz), (topx, topy, topz), (dx, dy, dz), (cx0, cy0, cz0) = geometry
    x, s, g = coordinate.reshape(-1), state.reshape(-1), nodal.reshape(-1)
    o, m = sums.reshape(-1), moments.reshape(-1)
    base = layout[0] - cz0 * layout[2] - cy0 * layout[1] - cx0
    ra, rb = rates
    sx, sy, sz, tx, ty, tz = ra * ihx, ra * ihy, ra * ihz, rb * ihx, rb * ihy, rb * ihz
    k = U(4)
    peak, breaks, left, before = 0.0, 0, 0, -1
    for p in range(start, stop):
        i = U(3 * p)
        xp, yp, zp = x[i], x[i + U(1)], x[i + U(2)]
        cx, fx = cell_and_fraction(xp, tolx)
        cy, fy = cell_and_fraction(yp, toly)
        cz, fz = cell_and_fraction(zp, tolz)
        b = U(4 * (base + cz * layout[2] + cy * layout[1] + cx))
        c = b + U(4 * layout[1])
        t = b + U(4 * layout[2])
        e = t + U(4 * layout[1])
        q = U(4 * p)
        if direct:
            r = s[q]
            j = U(1)
            r += sx * _slope(g, b + j, b + j + k, c + j, c + j + k, t + j, t + j + k, e + j, e + j + k, fy, fz)
            j = U(2)
            r += sy * _slope(g, b + j, c + j, b + j + k, c + j + k, t + j, e + j, t + j + k, e + j + k, fx, fz)
            j = U(3)
            r += sz * _slope(g, b + j, t + j, b + j + k, t + j + k, c + j, e + j, c + j + k, e + j + k, fx, fy)
            u = s[q + U(1)] + tx * _slope(g, b, b + k, c, c + k, t, t + k, e, e + k, fy, fz)
            v = s[q + U(2)] + ty * _slope(g, b, c, b + k, c + k, t, e, t + k, e + k, fx, fz)
            w = s[q + U(3)] + tz * _slope(g, b, t, b + k, t + k, c, e, c + k, e + k, fx, fy)
        else:
            r = s[q] + ra * _trilinear(g, b, c, t, e, fx, fy, fz)
            u = s[q + U(1)] + rb * _trilinear(g, b + U(1), c + U(1), t + U(1), e + U(1), fx, fy, fz)
            v = s[q + U(2)] + rb * _trilinear(g, b + U(2), c + U(2), t + U(2), e + U(2), fx, fy, fz)
            w = s[q + U(3)] + rb * _trilinear(g, b + U(3), c + U(3), t + U(3), e + U(3), fx, fy, fz)
        s[q], s[q + U(1)], s[q + U(2)], s[q + U(3)] = r, u, v, w
        peak = _larger(peak, r)
        xp, yp, zp = moved(xp, dx, lx, topx), moved(yp, dy, ly, topy), moved(zp, dz, lz, topz)
        x[i], x[i + U(1)], x[i + U(2)] = xp, yp, zp
        cx, fx = cell_and_fraction(xp, tolx)
        cy, fy = cell_and_fraction(yp, toly)
        cz, fz = cell_and_fraction(zp, tolz)
        cx -= cx0
        cy -= cy0
        cz -= cz0
        if U(cx) >= U(shape[0]) or U(cy) >= U(shape[1]) or U(cz) >= U(shape[2]):
            if left < leaving.size:
                leaving[left] = p
            left += 1
        else:
            cell = (cz * shape[1] + cy) * shape[0] + cx
            node = layout[0] + cz * layout[2] + cy * layout[1] + cx
            _deposit_3d(o, m, node, layout[1], layout[2], cell, fx, fy, fz, r, u, v, w, weigh)
            breaks += cell != before
            before = cell
    return peak, breaks, left

"""The Gram matrix as a stencil on nodes: assembled from pair moments, applied, and the stencil that nearly inverts it.

G is symmetric, so of its (2 k + 1)^d diagonals on splines of degree k those with a positive offset and the main one are
kept. They are added up and exchanged row by row, entries[n, h] (a particle touches few rows), and applied diagonal by
diagonal, diagonals[h, n]: both couple node n to node n + offsets[h]. Arrays are padded (see `mesh.halo`) but where
compact is said: own nodes only. `layout` is the padded arrays', `shape` the own nodes per axis. Inner loops run along
x, over contiguous memory.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mpipic.kernels.common import U, hot, inlined, inner

NODES_AT_ONCE = 2048
ROWS_AT_ONCE = 64


def half_stencil(dim: int, reach: int = 1) -> npt.NDArray[np.int64]:
    """Return offsets (h, 3) of half of the (2 reach + 1)^d nodes around one, x first: itself, then those after it."""
    spans = [range(-reach, reach + 1) if a < dim else (0,) for a in range(3)]
    every = [(i, j, k) for k in spans[2] for j in spans[1] for i in spans[0]]
    return np.array(every[len(every) // 2 :], dtype=np.int64)


def moment_terms(dim: int) -> npt.NDArray[np.int64]:
    """Return where the pair moments of a cell go, rows (moment, diagonal, i, j, k): to the diagonal of node (i, j, k).

    Along an axis, pairs 0 and 2 belong to the lower and upper node alone, pair 1 couples the two.
    """
    number = {tuple(offset): h for h, offset in enumerate(half_stencil(dim).tolist())}
    terms = []
    for moment in range(3**dim):
        pairs = [moment // 3**a % 3 for a in range(dim)] + [0] * (3 - dim)
        coupled = [a for a in range(3) if pairs[a] == 1]
        node = [int(pair == 2) for pair in pairs]
        for ends in range(2 ** max(0, len(coupled) - 1)):
            # the last coupled axis, the slowest, leads upwards; along the others both ways occur
            start, offset = list(node), [0, 0, 0]
            for bit, a in enumerate(coupled):
                down = (ends >> bit) & 1
                start[a], offset[a] = down, 1 - 2 * down
            terms.append((moment, number[tuple(offset)], *start))
    return np.array(terms, dtype=np.int64)


@hot
def add_moments(moments, terms, shape, layout, entries):
    """Add G's entries from the moments of all own cells (cells, 3^d) to entries[n, h]; ghosts above get their share."""
    width, diagonals = moments.shape[1], entries.shape[1]
    m, out = moments.reshape(-1), entries.reshape(-1)
    place = np.empty(terms.shape[0], np.int64)
    for t in range(place.size):
        node = terms[t, 2] + terms[t, 3] * layout[1] + terms[t, 4] * layout[2]
        place[t] = node * diagonals + terms[t, 1]
    q = 0
    for k in range(shape[2]):
        for j in range(shape[1]):
            first = (layout[0] + j * layout[1] + k * layout[2]) * diagonals
            for _ in range(shape[0]):
                for t in range(place.size):
                    out[U(first + place[t])] += m[U(q + terms[t, 0])]
                q += width
                first += diagonals


@hot
def root_and_scale(diagonal, root, scale):
    """Set root = sqrt(diagonal), scale = 1 / root; both 0 where the diagonal is 0 (a node that no particle sees)."""
    for n in range(diagonal.size):
        r = np.sqrt(diagonal[n])
        root[n] = r
        scale[n] = 1.0 / r if r > 0.0 else 0.0


@hot
def scale_diagonals(entries, constants, offsets, scale, diagonals):
    """Set diagonals[h, n] = (entries[n, h] + constants[h]) scale[n] scale[n + offsets[h]], h > 0.

    Beyond the array's end they are 0, and constant where `entries` has no column. The main one, 1 then, is left alone.
    """
    nodes, stored = entries.shape
    for n in range(0, nodes, ROWS_AT_ONCE):
        for h in range(1, offsets.size):
            row = diagonals[h, n : min(n + ROWS_AT_ONCE, nodes)]
            whole = max(0, min(row.size, nodes - offsets[h] - n))
            here, there = scale[n : n + whole], scale[n + offsets[h] : n + offsets[h] + whole]
            if h < stored:
                for i in range(whole):
                    row[i] = (entries[n + i, h] + constants[h]) * here[i] * there[i]
            else:
                for i in range(whole):
                    row[i] = constants[h] * here[i] * there[i]
            for i in range(whole, row.size):
                row[i] = 0.0


@hot
def multiply(diagonals, offsets, main, values, shape, layout, out):
    """Set out[c] = G values[c] on own nodes, padded arrays, ghosts of `values` filled; junk on ghosts between.

    G has the same number all along its main diagonal: diagonals[0] is not read. A block of nodes of one z layer stays
    in the first caches while the other diagonals pass, two at a time, for all columns.
    """
    for k in range(shape[2]):
        n = layout[0] + k * layout[2]
        stop = n + (shape[1] - 1) * layout[1] + shape[0]
        while n < stop:
            m = min(NODES_AT_ONCE, stop - n)
            _multiply_block(diagonals, offsets, main, values, n, m, out)
            n += m


@inlined
def _multiply_block(diagonals, offsets, main, values, n, m, out):
    for c in range(values.shape[0]):
        row, here = out[c, n : n + m], values[c, n : n + m]
        for i in range(m):
            row[i] = main * here[i]
    h = 1
    while h + 1 < offsets.size:
        o, p = offsets[h], offsets[h + 1]
        for c in range(values.shape[0]):
            v = values[c]
            _add_two(
                out[c, n : n + m],
                diagonals[h, n : n + m], v[n + o : n + o + m],
                diagonals[h, n - o : n - o + m], v[n - o : n - o + m],
                diagonals[h + 1, n : n + m], v[n + p : n + p + m],
                diagonals[h + 1, n - p : n - p + m], v[n - p : n - p + m],
            )  # fmt: skip
        h += 2
    if h < offsets.size:
        o = offsets[h]
        for c in range(values.shape[0]):
            _add_one(
                out[c, n : n + m],
                diagonals[h, n : n + m], values[c, n + o : n + o + m],
                diagonals[h, n - o : n - o + m], values[c, n - o : n - o + m],
            )  # fmt: skip


@inner
def _add_one(row, a0, v0, a1, v1):
    for i in range(row.size):
        row[i] += a0[i] * v0[i] + a1[i] * v1[i]


@inner
def _add_two(row, a0, v0, a1, v1, a2, v2, a3, v3):
    for i in range(row.size):
        row[i] += (a0[i] * v0[i] + a1[i] * v1[i]) + (a2[i] * v2[i] + a3[i] * v3[i])


@hot
def extrapolate(earlier, weights, factors, out):
    """Set out = Σ_j weights[j] earlier[j] times one factor a node; all compact."""
    n = 0
    while n < out.size:
        m = min(NODES_AT_ONCE, out.size - n)
        row, factor = out[n : n + m], factors[n : n + m]
        row[:] = 0.0
        for j in range(weights.size):
            values, w = earlier[j, n : n + m], weights[j]
            for i in range(m):
                row[i] += w * values[i]
        for i in range(m):
            row[i] *= factor[i]
        n += m


@hot
def convolve(values, weights, shape, layout, plane, line, out):
    """Apply the product of one symmetric stencil per axis to `values` (padded, ghosts filled), into `out`, compact.

    weights : (3, reach + 1)
        Per axis the middle weight and those to either side; (1, 0, ...) along an axis that there is not.
    plane, line : work arrays: one padded plane (as many numbers as a padded z layer), one padded line.
    """
    reach = weights.shape[1] - 1
    sides = np.zeros(3, np.int64)
    for a in range(3):
        for r in range(1, reach + 1):
            if weights[a, r] != 0.0:
                sides[a] = reach
    begin = layout[0] - sides[0]
    length = shape[0] + 2 * sides[0]
    for k in range(shape[2]):
        source, stride, start = values, layout[1], begin + k * layout[2]
        if sides[2]:
            for j in range(-sides[1], shape[1] + sides[1]):
                r = (j + sides[1]) * length
                _combine(values, weights[2], sides[2], start + j * layout[1], layout[2], length, plane[r : r + length])
            source, stride, start = plane, length, sides[1] * length
        for j in range(shape[1]):
            _combine(source, weights[1], sides[1], start + j * stride, stride, length, line)
            first = (k * shape[1] + j) * shape[0]
            _combine(line, weights[0], sides[0], sides[0], np.int64(1), shape[0], out[first : first + shape[0]])


@inner
def _combine(values, weights, reach, start, stride, count, out):
    """Set out[i] = Σ_s weights[|s|] values[start + s stride + i], |s| <= reach."""
    here = values[start : start + count]
    row = out[:count]
    w = weights[0]
    for i in range(row.size):
        row[i] = w * here[i]
    for s in range(1, reach + 1):
        up = values[start + s * stride : start + s * stride + count]
        down = values[start - s * stride : start - s * stride + count]
        w = weights[s]
        for i in range(row.size):
            row[i] += w * (up[i] + down[i])


@hot
def difference(values, weights, stride, shape, layout, out):
    """Set out[n] = Σ_s weights[s] (values[n + s stride] - values[n - s stride]), s > 0; values padded, out compact."""
    for k in range(shape[2]):
        for j in range(shape[1]):
            n, first = layout[0] + j * layout[1] + k * layout[2], (k * shape[1] + j) * shape[0]
            row = out[first : first + shape[0]]
            row[:] = 0.0
            for s in range(1, weights.size):
                up, down = n + s * stride, n - s * stride
                after, before, w = values[up : up + shape[0]], values[down : down + shape[0]], weights[s]
                for i in range(row.size):
                    row[i] += w * (after[i] - before[i])

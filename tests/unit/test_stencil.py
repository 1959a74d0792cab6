"""The compiled loops over stencils on nodes, against NumPy."""

from functools import reduce
from itertools import product

import numpy as np
import pytest
from mpi4py import MPI

from dense_helpers import GRIDS, close, few_cases, pattern
from mpipic.kernels import stencil
from mpipic.mapping.mapping import Mapping
from mpipic.mesh.halo import Halo
from serial_helpers import grid_of, sweep_of

every_dimension = pytest.mark.parametrize("dim", [1, 2, 3])
SHAPES = [(1,), (2,), (9,), (1, 1), (2, 1), (7, 5), (1, 2, 3), (2, 2, 2), (5, 4, 6)]
every_shape = pytest.mark.parametrize("cells", SHAPES, ids=str)


def halo_of(cells, width):
    return Halo(MPI.COMM_SELF, cells, [np.zeros(1, dtype=np.int64)] * len(cells), width)


def padded(cells):
    return (*cells, 1, 1)[:3]


@every_dimension
@pytest.mark.parametrize("reach", [1, 2, 3])
def test_half_a_stencil_is_the_node_itself_and_one_of_each_two_opposite_neighbours(dim, reach):
    half = [tuple(offset) for offset in stencil.half_stencil(dim, reach).tolist()]
    assert half[0] == (0, 0, 0)
    opposite = [tuple(-i for i in offset) for offset in half[1:]]
    every = [offset + (0,) * (3 - dim) for offset in product(range(-reach, reach + 1), repeat=dim)]
    assert sorted(half + opposite) == sorted(every)
    strides = np.array([1, 100, 10_000])
    assert all(offset @ strides > 0 for offset in np.array(half[1:]))


def half_diagonals(cells, length, position, weight):
    """Σ_p V_p φ_n φ_(n + offset) by half_stencil's offsets, (h, z, y, x): unwrapped φ, n wrapped, pair by pair."""
    dim = len(cells)
    coordinate = position / (np.array(length) / np.array(cells))
    cell = np.floor(coordinate).astype(int)
    fraction = coordinate - cell
    offsets = [tuple(offset) for offset in stencil.half_stencil(dim)[:, :dim].tolist()]
    out = np.zeros((len(offsets), *cells[::-1]))
    for one, other in product(product((0, 1), repeat=dim), repeat=2):
        offset = tuple(np.subtract(other, one).tolist())
        if offset in offsets:
            weights = [np.prod(np.where(corner, fraction, 1.0 - fraction), axis=1) for corner in (one, other)]
            node = np.mod(cell + one, cells)
            where = (np.full(len(node), offsets.index(offset)), *node.T[::-1])
            np.add.at(out, where, weight * weights[0] * weights[1])
    return out


@pytest.mark.parametrize(("width", "box", "name"), few_cases((1, 2, 3)))
def test_entries_from_moments_are_half_the_diagonals_of_the_gram_matrix(box, name, width):
    cells, length = GRIDS[box]
    grid, position = grid_of(cells, length), pattern(name, cells, length)
    weight = np.random.default_rng(6).random(len(position)) + 0.1
    wanted = half_diagonals(cells, length, position, weight)
    halo = halo_of(cells, width)
    entries = np.zeros((halo.local_nodes, len(wanted)))
    Mapping(grid, position, weight).add_gram_entries(halo.layout, entries)
    halo.add(entries)
    close(np.moveaxis(halo.own(entries), -1, 0), wanted)


def test_entries_from_moments_are_added_to_what_is_there():
    cells, length = GRIDS["2D"]
    sweep, halo = sweep_of(grid_of(cells, length), pattern("random", cells, length)), halo_of(cells, 2)
    once, twice = np.zeros((2, halo.local_nodes, 5))
    sweep.add_gram_entries(halo.layout, once)
    for _ in range(2):
        sweep.add_gram_entries(halo.layout, twice)
    assert once.any()
    close(twice, 2 * once, 1e-15)


def test_scales_are_inverse_roots_and_zero_where_the_diagonal_is():
    diagonal = np.array([4.0, 0.0, 1e-24, 9.0, 1e300])
    root, scale = np.full((2, 5), np.nan)
    stencil.root_and_scale(diagonal, root, scale)
    assert np.array_equal(root, [2.0, 0.0, np.sqrt(1e-24), 3.0, np.sqrt(1e300)])
    close(scale[[0, 2, 3, 4]] * root[[0, 2, 3, 4]], np.ones(4), 1e-15)
    assert scale[1] == 0.0


@every_shape
@pytest.mark.parametrize("stored", [1, 2, 99])
def test_rows_become_scaled_diagonals_and_those_beyond_them_are_constant(cells, stored):
    """On all nodes whose neighbour is in the array; zero on the others."""
    halo = halo_of(cells, 1)
    offsets = stencil.half_stencil(len(cells)) @ np.array([1, *halo.layout[1:]])
    rng = np.random.default_rng(2)
    scale, constants = rng.random(halo.local_nodes), rng.random(len(offsets))
    entries = rng.random((halo.local_nodes, len(offsets)))[:, :stored]
    diagonals = np.full((len(offsets), halo.local_nodes), np.nan)
    stencil.scale_diagonals(np.ascontiguousarray(entries), constants, offsets, scale, diagonals)
    assert np.all(np.isnan(diagonals[0]))
    for h, offset in enumerate(offsets[1:], start=1):
        there = np.append(scale[offset:], np.zeros(offset))[: len(scale)]
        row = constants[h] + (entries[:, h] if h < stored else 0.0)
        close(diagonals[h], row * scale * there, 1e-15)


@pytest.mark.parametrize("cells", [*SHAPES, (2 * stencil.NODES_AT_ONCE + 7,), (90, 50)], ids=str)
def test_multiplying_takes_every_diagonal_both_ways_and_one_number_on_the_main_one(cells):
    """An even number of them, an odd one and none; for every column. diagonals[0] is not read."""
    halo = halo_of(cells, 1)
    for columns, count in product((1, 3), (1, 2, 3, 4, 14)):
        offsets = stencil.half_stencil(len(cells))[:count] @ np.array([1, *halo.layout[1:]])
        rng = np.random.default_rng(3)
        diagonals = rng.standard_normal((len(offsets), halo.local_nodes))
        values = rng.standard_normal((columns, halo.local_nodes))
        diagonals[0] = np.nan
        nodes = halo.own(np.arange(halo.local_nodes)).ravel()
        wanted = 1.5 * values[:, nodes]
        for row, offset in zip(diagonals[1:], offsets[1:]):
            wanted += row[nodes] * values[:, nodes + offset] + row[nodes - offset] * values[:, nodes - offset]
        out = np.full(values.shape, np.nan)
        stencil.multiply(diagonals, offsets, 1.5, values, padded(cells), halo.layout, out)
        close(halo.own_rows(out).reshape(columns, -1), wanted, 1e-14)


def convolved(own, weights):
    """The product of one symmetric stencil per axis x, y, z applied to own values (z, y, x), round the period."""
    for axis, row in enumerate(weights[: own.ndim]):
        terms = [np.roll(own, s, own.ndim - 1 - axis) * row[abs(s)] for s in range(1 - len(row), len(row))]
        own = reduce(np.add, terms)
    return own


def convolve(halo, cells, weights, own):
    values = np.zeros(halo.local_nodes)
    halo.own(values)[...] = own
    halo.fill(values)
    plane, line = np.full(int(np.prod(halo.ghost_shape[:2])), np.nan), np.full(halo.ghost_shape[0], np.nan)
    out = np.full(own.size, np.nan)
    stencil.convolve(values, weights, padded(cells), halo.layout, plane, line, out)
    return out.reshape(own.shape)


@every_shape
def test_convolving_is_the_product_of_one_stencil_per_axis(cells):
    """`idle` are axes whose stencil is the middle weight alone; on blocks smaller than the stencil too."""
    rng = np.random.default_rng(4)
    for reach, idle in product((1, 2, 5), ((), (0,), (1,), (2,), (0, 1, 2))):
        weights = rng.standard_normal((3, reach + 1))
        for axis in {*idle, *range(len(cells), 3)}:
            weights[axis] = np.eye(1, reach + 1)[0]
        own = rng.standard_normal(cells[::-1])
        close(convolve(halo_of(cells, reach), cells, weights, own), convolved(own, weights), 1e-13)


@pytest.mark.parametrize("j", [0, 1, 2])
def test_the_stencil_along_x_acts_along_x(j):
    """Guard of the reference above: a single value, spread along one axis only."""
    cells, weights = (7, 6, 5), np.eye(1, 3).repeat(3, axis=0)
    weights[j] = (4.0, 2.0, 1.0)
    own = np.zeros(cells[::-1])
    own[2, 2, 2] = 1.0
    result = convolve(halo_of(cells, 2), cells, weights, own)
    line = [2, 2, 2]
    line[2 - j] = slice(0, 5)
    assert result[tuple(line)].tolist() == [1.0, 2.0, 4.0, 2.0, 1.0] and result.sum() == 10.0


@pytest.mark.parametrize("n", [1, 10, 2 * stencil.NODES_AT_ONCE + 1])
@pytest.mark.parametrize("k", [0, 1, 2, 3])
def test_extrapolating_adds_weighted_rows_times_one_factor_a_node(n, k):
    rng = np.random.default_rng(5)
    earlier, weights, factors = rng.random((k, n)), rng.random(k), rng.random(n)
    out = np.full(n, np.nan)
    stencil.extrapolate(earlier, weights, factors, out)
    close(out, factors * (weights @ earlier), 1e-14)

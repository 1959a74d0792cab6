"""Halos on one rank, where every ghost is a node of the same block, round the period, any number of times.

Values are whole numbers, so that sums are exact in any order.
"""

import gc
from itertools import product

import numpy as np
import pytest
from mpi4py import MPI

from mpipic.mesh.grid import Grid
from mpipic.mesh.halo import Halo, PaddedColumns

CELLS = [(1,), (2,), (3,), (7,), (1, 1), (1, 2), (5, 2), (4, 6), (1, 2, 3), (2, 2, 2), (4, 3, 5)]
every_block = pytest.mark.parametrize("cells", CELLS, ids=str)
SOME = [(1,), (7,), (1, 2), (4, 6), (1, 2, 3), (4, 3, 5)]
some_blocks = pytest.mark.parametrize("cells", SOME, ids=str)
every_width = pytest.mark.parametrize(
    ("cells", "width"),
    [*((cells, 3) for cells in CELLS), *((cells, width) for cells in SOME for width in (1, 2))],
    ids=str,
)
some_reaches = pytest.mark.parametrize("reach", [(0, 1), (1, 2), (2, 0), (0, 0), (2, 2)])


def halo_of(cells, width, reach=None):
    return Halo(MPI.COMM_SELF, cells, [np.zeros(1, dtype=np.int64)] * len(cells), width, reach)


def images(halo, reach):
    """Indices of the own nodes and of `reach` around them, per axis z to x: of the padded array, and of what they are.

    Both as `np.ix_` takes them.
    """
    along = [np.arange(-reach[0], n + reach[1]) for n in halo.owned_shape[::-1]]
    own = [np.mod(i, n) for i, n in zip(along, halo.owned_shape[::-1])]
    return np.ix_(*(i + halo.width for i in along)), np.ix_(*own)


def whole_numbers(*shape, seed=1):
    return np.random.default_rng(seed).integers(-99, 100, shape).astype(float)


def padded_shape(halo):
    return halo.ghost_shape[::-1]


@every_width
def test_filled_ghosts_are_the_block_repeated_round_the_period(cells, width):
    halo = halo_of(cells, width)
    own = whole_numbers(*cells[::-1])
    padded = np.full(halo.local_nodes, np.nan)
    halo.own(padded)[...] = own
    halo.fill(padded)
    padded = padded.reshape(padded_shape(halo))
    assert np.array_equal(padded, own[images(halo, (width, width))[1]])
    if width <= min(cells):  # beyond, NumPy before 1.25 wrapped otherwise
        assert np.array_equal(padded, np.pad(own, width, mode="wrap"))


@every_width
def test_adding_gives_every_node_what_all_its_ghosts_hold_and_leaves_them_their_share(cells, width):
    halo = halo_of(cells, width)
    padded = whole_numbers(halo.local_nodes)
    before = padded.copy()
    wanted = np.zeros(cells[::-1])
    np.add.at(wanted, images(halo, (width, width))[1], before.reshape(padded_shape(halo)))
    halo.add(padded)
    assert np.array_equal(halo.own(padded), wanted)
    ghosts = np.ones(padded_shape(halo), dtype=bool)
    halo.block(ghosts)[...] = False
    assert np.array_equal(padded[ghosts.ravel()], before[ghosts.ravel()])


@every_block
def test_adding_is_the_transpose_of_filling(cells):
    """<fill x, y> = <x, add y>, for every x on own nodes and every y on all."""
    for width, columns in product((1, 2, 3), ((), (1,), (4,))):
        halo = halo_of(cells, width)
        x, y = np.zeros((halo.local_nodes, *columns)), whole_numbers(halo.local_nodes, *columns, seed=2)
        halo.own(x)[...] = whole_numbers(*cells[::-1], *columns)
        filled, added = x.copy(), y.copy()
        halo.fill(filled)
        halo.add(added)
        assert np.sum(filled * y) == np.sum(halo.own(x) * halo.own(added)), (width, columns)
        assert np.sum(filled * filled) > np.sum(x * x)


@some_blocks
@pytest.mark.parametrize("verb", ["add", "fill"])
def test_columns_are_exchanged_one_by_one(cells, verb):
    halo = halo_of(cells, 2)
    columns = whole_numbers(halo.local_nodes, 3)
    alone = [columns[:, k].copy() for k in range(3)]
    getattr(halo, verb)(columns)
    for k in range(3):
        getattr(halo, verb)(alone[k])
        assert np.array_equal(columns[:, k], alone[k])


@some_blocks
@pytest.mark.parametrize("verb", ["add", "fill"])
def test_several_arrays_at_once_are_exchanged_as_one_after_the_other(cells, verb):
    """Of different numbers of columns; and the rows of one array, each a column by itself."""
    halo = halo_of(cells, 2)
    n = halo.local_nodes
    together = [whole_numbers(n), whole_numbers(n, 2, seed=2), whole_numbers(n, 1, seed=3)]
    alone = [array.copy() for array in together]
    getattr(halo, verb)(*together)
    for array in alone:
        getattr(halo, verb)(array)
    assert all(np.array_equal(one, other) for one, other in zip(together, alone))
    assert halo.exchanges == 6
    rows = whole_numbers(2, n)
    columns = np.ascontiguousarray(rows.T)
    getattr(halo, verb)(*rows)
    getattr(halo, verb)(columns)
    assert np.array_equal(rows.T, columns)


@some_blocks
@pytest.mark.parametrize("count", [1, 3])
def test_columns_kept_apart_are_filled_in_one_exchange_and_loaded_from_own_values(cells, count):
    halo = halo_of(cells, 2)
    padded = PaddedColumns(halo)
    for seed in (1, 2):  # the second time, over what is there
        own = whole_numbers(count, *cells[::-1], seed=seed)
        wanted = np.zeros((count, halo.local_nodes))
        halo.own_rows(wanted)[...] = own
        halo.fill(*wanted)
        before = halo.exchanges
        rows = padded.load(own)
        assert halo.exchanges == before + 1
        assert np.array_equal(rows, wanted) and np.array_equal(halo.own_rows(rows), own)
        assert np.array_equal(padded.load(own.reshape(count, -1)), wanted)
    assert padded.nbytes == rows.nbytes


@some_blocks
@some_reaches
def test_ghosts_out_of_reach_are_neither_read_nor_written(cells, reach):
    """They hold NaN, which would show."""
    halo = halo_of(cells, 2, reach)
    within, own = images(halo, reach)
    inside = np.zeros(padded_shape(halo), dtype=bool)
    inside[within] = True
    values = whole_numbers(*inside[within].shape)
    padded = np.full(padded_shape(halo), np.nan)
    padded[within] = values
    wanted = np.zeros(cells[::-1])
    np.add.at(wanted, own, values)
    flat = padded.reshape(-1)
    halo.add(flat)
    assert np.array_equal(halo.own(flat), wanted)
    halo.fill(flat)
    assert np.array_equal(flat.reshape(padded.shape)[within], wanted[own])
    assert np.all(np.isnan(flat.reshape(padded.shape)[~inside]))


@every_width
def test_own_nodes_are_a_view_with_axes_z_y_x_and_columns_last(cells, width):
    halo = halo_of(cells, width)
    padded = np.arange(halo.local_nodes * 3.0).reshape(-1, 3)
    own = halo.own(padded)
    assert own.shape == (*cells[::-1], 3) and np.shares_memory(own, padded)
    first, row, plane = halo.layout
    for node in np.ndindex(*cells[::-1]):
        offset = np.dot(node[::-1], (1, row, plane)[: len(cells)])
        assert own[node][0] == 3 * (first + offset)
    assert np.array_equal(halo.own(padded[:, 1].copy()), own[..., 1])


@every_block
def test_a_block_may_be_seen_with_more_ghosts_below_than_above(cells):
    halo = halo_of(cells, 3)
    padded = whole_numbers(*padded_shape(halo))
    seen = halo.block(padded, (2, 1))
    assert seen.shape == tuple(n + 3 for n in cells[::-1])
    assert np.shares_memory(seen, padded) and np.array_equal(seen, padded[images(halo, (2, 1))[0]])


def test_a_halo_on_one_rank_has_no_neighbours_and_knows_its_sizes():
    halo = halo_of((2, 3, 4), 3)
    assert halo.neighbours == 0 and halo.exchanges == 0
    assert (halo.owned_start, halo.owned_shape) == ((0, 0, 0), (2, 3, 4))
    assert halo.ghost_shape == (8, 9, 10) and halo.local_nodes == 720
    assert halo.layout == (3 + 3 * 8 + 3 * 72, 8, 72)


@every_block
def test_the_nodes_of_a_grid_are_such_a_halo_and_owned_turns_its_axes(cells):
    grid = Grid(cells, (1.0,) * len(cells), MPI.COMM_SELF)
    assert isinstance(grid.nodes, Halo) and grid.nodes.ghost_shape == tuple(n + 2 for n in cells)
    nodal = whole_numbers(grid.local_nodes, 2)
    axes = (*reversed(range(grid.dim)), grid.dim)
    assert np.array_equal(grid.nodes.own(nodal), grid.owned(nodal).transpose(axes))
    exchanges = grid.nodes.exchanges
    grid.sum_halo(nodal)
    grid.fill_halo(nodal)
    assert grid.nodes.exchanges == exchanges + 2


def test_a_halo_that_is_dropped_gives_its_mpi_types_back():
    grid = Grid((6, 5), (1.0, 1.0), MPI.COMM_SELF)
    types = grid.nodes._units
    grid.fill_halo(grid.zeros(3))
    assert list(types) == [3] and types[3] != MPI.DATATYPE_NULL
    item = types[3]
    del grid
    gc.collect()
    assert types == {} and item == MPI.DATATYPE_NULL

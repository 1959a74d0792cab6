"""The node grid: halos around the period, coordinates in cells, and their rounding."""

import numpy as np
import pytest
from mpi4py import MPI

from dense_helpers import GRIDS, close
from mpipic.mesh.grid import Grid
from mpipic.particles.store import locate
from serial_helpers import ghosted, grid_of, on_nodes, sweep_of

every_grid = pytest.mark.parametrize("box", GRIDS)


@every_grid
def test_sizes_and_spacings_are_those_asked_for(box):
    cells, length = GRIDS[box]
    grid = grid_of(cells, length)
    assert grid.node_count == grid.local_cells == np.prod(cells)
    assert grid.owned_start == (0,) * len(cells) and grid.owned_shape == cells
    close(grid.h, np.array(length) / np.array(cells), 1e-15)
    close(np.array(grid.inverse_h) * grid.h, np.ones(len(cells)), 1e-15)


@every_grid
def test_own_nodes_are_seen_with_axes_in_the_order_x_y_z(box):
    cells, length = GRIDS[box]
    grid = grid_of(cells, length)
    nodal = np.arange(grid.local_nodes * 3, dtype=float).reshape(-1, 3)
    own = grid.owned(nodal)
    assert own.shape == (*cells, 3) and np.shares_memory(own, nodal)
    assert np.array_equal(grid.owned(nodal[:, 1].copy()), own[..., 1])
    origin, row, plane = grid.layout
    for axis, stride in enumerate((1, row, plane)[: grid.dim]):
        if cells[axis] > 1:
            neighbour = tuple(int(a == axis) for a in range(grid.dim))
            assert own[neighbour][0] == 3 * (origin + stride)


@pytest.mark.parametrize(("box", "columns"), [(box, (1, 2, 5)[count % 3]) for count, box in enumerate(GRIDS)])
def test_summing_the_halo_conserves_the_sum_and_filling_it_changes_no_owner(box, columns):
    """All nodes that the basis touches in a cell of this rank count; the ghosts below are nobody's."""
    cells, length = GRIDS[box]
    grid = grid_of(cells, length)
    origin, row, plane = grid.layout
    strides = (1, row, plane)[: grid.dim]
    corners = np.stack(np.meshgrid(*(np.arange(n + 1) for n in cells), indexing="ij"), axis=-1).reshape(-1, grid.dim)
    touched = origin + corners @ np.array(strides)
    nodal = grid.zeros(columns)
    nodal[touched] = np.random.default_rng(2).standard_normal((len(touched), columns))
    wanted = np.zeros((*cells, columns))
    np.add.at(wanted, tuple((corners % cells).T), nodal[touched])
    grid.sum_halo(nodal)
    close(grid.owned(nodal), wanted, 1e-15 * 16)
    grid.fill_halo(nodal)
    close(grid.owned(nodal), wanted, 1e-15 * 16)
    assert np.array_equal(nodal[touched], grid.owned(nodal)[tuple((corners % cells).T)])


def test_numbers_are_combined_in_place_and_every_reduction_is_counted():
    grid = Grid((4,), (1.0,), MPI.COMM_SELF)
    numbers = np.array([3.0, -1.0])
    assert grid.reductions == 0
    assert grid.reduce(numbers) is numbers and grid.reduce(numbers, MPI.MAX) is numbers
    assert numbers.tolist() == [3.0, -1.0] and grid.reductions == 2


@pytest.mark.parametrize(
    ("numbers", "size"),
    [
        ([], 1.0),
        ([0.0, -0.0], 1.0),
        ([1.0, 0.5], 1.0),
        ([1.0, -7.9], 4.0),
        ([3e-300, -1e-301], 2.0**-995),
        ([5e-324], 5e-324),
        ([1.7e308, -1.0], 2.0**1023),
        ([1.0, np.nan], np.inf),
        ([np.nan, 1.0], np.inf),
        ([-np.inf, 0.0], np.inf),
        ([np.inf], np.inf),
    ],
    ids=str,
)
def test_the_size_of_numbers_is_the_power_of_two_at_or_below_the_largest(numbers, size):
    grid = Grid((4,), (1.0,), MPI.COMM_SELF)
    assert grid.size_of(np.array(numbers)) == size
    assert grid.reductions == 1
    rows = np.array([numbers, np.zeros(len(numbers)), np.full(len(numbers), -3.0)])
    assert grid.sizes_of(rows).tolist() == [size, 1.0, 2.0 if numbers else 1.0]
    assert grid.reductions == 2


def test_ghosted_and_on_nodes_undo_each_other():
    """The tests' own helpers."""
    grid = grid_of((3, 4, 5), (1.0, 1.0, 1.0))
    values = np.random.default_rng(0).random((60, 2))
    assert np.array_equal(on_nodes(grid, ghosted(grid, values)), values)


@pytest.mark.parametrize("cells, length", [((), ()), ((1, 1, 1, 1), (1.0,) * 4), ((4,), (1.0, 1.0)), ((4, 4), (1.0,))])
def test_a_grid_of_no_or_four_axes_or_of_too_few_lengths_is_refused(cells, length):
    with pytest.raises(ValueError, match="one to three"):
        Grid(cells, length, MPI.COMM_SELF)


@pytest.mark.parametrize("n", [1, 3, 100, 1000, 100_000])
def test_coordinates_are_positions_over_the_spacing_to_a_quantum(n):
    grid = grid_of((n,), (0.3,))
    position = np.random.default_rng(1).random((500, 1)) * 0.3
    coordinate = grid.coordinate_of(position)
    (quantum,) = grid.quantum
    assert np.all((coordinate >= 0) & (coordinate < n))
    assert np.all(np.rint(coordinate / quantum) * quantum == coordinate)
    assert np.abs(coordinate - position * n / 0.3).max() <= 1e-15 * n
    assert quantum <= 2.0**-51 * n


def test_sums_of_coordinates_and_displacements_are_exact():
    grid = grid_of((100,), (1.0,))
    rng = np.random.default_rng(3)
    x = grid.rounded(rng.random(1000) * 99)
    shift = grid.rounded(rng.random(1000))
    assert np.array_equal((x + shift) - x, shift)
    assert np.array_equal((x + shift) - shift, x)


@pytest.mark.parametrize("periods", [-2, -1, 0, 1, 7])
def test_whole_periods_do_not_matter(periods):
    grid = grid_of((8, 4), (1.0, 2.0))
    position = np.random.default_rng(4).random((100, 2)) * grid.length
    close(grid.coordinate_of(position + periods * np.array(grid.length)), grid.coordinate_of(position), 1e-14)


@pytest.mark.parametrize("position", [0.0, -0.0, 1.0, np.nextafter(1.0, 0.0), -1e-13, -5e-324, 2.0, 3.0 - 1e-15])
def test_the_box_is_periodic_and_its_upper_face_is_the_lower_one(position):
    grid = grid_of((10,), (1.0,))
    coordinate = grid.coordinate_of(np.array([[position]]))
    assert abs(coordinate[0, 0]) < 1e-11
    cell, fraction = locate(grid, coordinate)
    assert cell[0] == 0 and fraction[0, 0] == 0.0


def test_the_cell_of_a_particle_on_a_node_is_the_right_hand_one():
    grid = grid_of((10, 10), (1.0, 1.0))
    coordinate = np.array([[3.0, 2.5], [3.0 - 5e-11, 2.5], [3.0 - 2e-10, 2.5], [3.0 + 1e-12, 9.99]])
    assert grid.cell_of(coordinate).tolist() == [[3, 2], [3, 2], [2, 2], [3, 9]]


EDGES = [1, 2, 3, 5, 7, 8, 31, 33, 50, 63, 64, 100, 129, 1000, 4096, 99_999, 1_000_000]


def around(x, quantum):
    """The multiples of the quantum next to x."""
    return (np.rint(x / quantum) + np.arange(-5, 6)) * quantum


@pytest.mark.parametrize("n", EDGES)
def test_no_coordinate_next_to_where_the_last_cell_ends_is_lost(n):
    """The upper face, less the width of "on a node", is where rounding could put a particle in a cell that is not."""
    grid = Grid((n,), (float(n),), MPI.COMM_SELF)
    quantum, tolerance = grid.quantum[0], grid.tolerance[0]
    x = np.concatenate([around(edge, quantum) for edge in (-tolerance, 0.0, n - tolerance, n)])[:, None]
    cell, fraction = locate(grid, grid.coordinate_of(x))
    assert np.array_equal(cell, grid.cell_of(grid.coordinate_of(x))[:, 0])
    on_the_seam = np.abs(x[:, 0] - np.rint(x[:, 0] / n) * n) < tolerance - 2 * quantum
    assert np.all(cell[on_the_seam] == 0) and np.all((cell == 0) | (cell == n - 1))
    assert np.all((fraction >= 0) & (fraction < 1))


@pytest.mark.parametrize(("n", "move"), [(n, (0.25, -0.25)[count % 2]) for count, n in enumerate(EDGES)])
def test_no_particle_that_moves_next_to_where_the_last_cell_ends_is_lost(n, move):
    grid = Grid((n,), (float(n),), MPI.COMM_SELF)
    quantum, tolerance = grid.quantum[0], grid.tolerance[0]
    assert (tolerance / quantum).is_integer(), "inexact: the loops below would write past the last cell"
    x = np.concatenate([around(edge, quantum) for edge in (-tolerance, 0.0, n - tolerance)])[:, None]
    sweep = sweep_of(grid, grid.coordinate_of(x - move), displacement=(move,))
    for _ in range(2):
        sweep.advance(grid.zeros(2), (1.0, 1.0))
        cell = grid.cell_of(sweep.particles.coordinate)
        assert np.all((cell >= 0) & (cell < n)) and np.all(sweep.particles.coordinate >= -tolerance)
        assert grid.owned(sweep.row_sums).sum() == pytest.approx(len(x), rel=1e-13)


def test_on_one_rank_all_is_its_own():
    grid = grid_of((5, 4), (1.0, 1.0))
    assert not grid.owner_of(np.random.default_rng(0).random((50, 2)) * (5, 4)).any()


def test_on_an_axis_of_a_million_cells_on_a_node_is_never_narrower_than_rounding():
    grid = grid_of((1_000_000,), (1.0,))
    (tolerance,), (quantum,) = grid.tolerance, grid.quantum
    assert tolerance >= 2 * quantum
    nodes = np.arange(0, 1_000_000, 997)
    position = nodes[:, None] * grid.h[0]
    assert np.array_equal(grid.cell_of(grid.coordinate_of(position))[:, 0], nodes)

"""Particles as columns, their order by cell, and where layouts put them."""

from itertools import pairwise

import numpy as np
import pytest

from mpipic.draws import uniform
from mpipic.particles.layouts import LAYOUTS, share
from mpipic.particles.store import Particles, locate
from serial_helpers import grid_of

BOXES = {1: ((10,), (1.0,)), 2: ((4, 5), (1.0, 2.0)), 3: ((3, 2, 4), (1.0, 2.0, 0.5))}
every_dimension = pytest.mark.parametrize("dim", [1, 2, 3])


def some_particles(grid, n, first=0, seed=1):
    """Fields are functions of the id, so that rows can be told apart."""
    particles = Particles(grid.h, {"density": (), "velocity": (grid.dim,)})
    add_particles(particles, grid, n, first, seed)
    return particles


def add_particles(particles, grid, n, first, seed=1):
    ids = np.arange(first, first + n)
    coordinate = grid.wrapped(np.random.default_rng(seed).random((n, grid.dim)) * grid.cells)
    particles.append(coordinate, ids[:, None] + 0.1 * np.arange(1 + grid.dim), ids)


def rows_are_whole(particles):
    """Every row still holds the state that belongs to its id."""
    return np.array_equal(particles.state, particles.ids[:, None] + 0.1 * np.arange(1 + particles.dim))


# ---------------------------------------------------------------- columns


@every_dimension
def test_fields_are_views_of_the_state(dim):
    particles = some_particles(grid_of(*BOXES[dim]), 20)
    particles["density"][:] = 7.0
    particles["velocity"][:, -1] = 8.0
    assert np.all(particles.state[:, 0] == 7.0) and np.all(particles.state[:, -1] == 8.0)
    assert {name: array.shape for name, array in particles.fields.items()} == {"density": (20,), "velocity": (20, dim)}
    assert all(np.shares_memory(array, particles.state) for array in particles.fields.values())


def test_fields_may_have_any_names_and_shapes():
    particles = Particles((1.0, 1.0), {"stress": (2, 2), "mass": (), "colour": (1,)})
    particles.append(np.zeros((2, 2)), np.arange(12.0).reshape(2, 6), np.arange(2))
    assert particles["stress"].tolist() == [[[0.0, 1.0], [2.0, 3.0]], [[6.0, 7.0], [8.0, 9.0]]]
    assert particles["mass"].tolist() == [4.0, 10.0]
    assert particles["colour"].tolist() == [[5.0], [11.0]]
    assert particles.bytes_per_particle == 8 * (2 + 6 + 1)


def test_a_field_can_be_assigned_to_and_changed_in_place():
    particles = Particles((1.0, 1.0), {"mass": (), "stress": (2, 2)})
    particles.append(np.zeros((3, 2)), np.zeros((3, 5)), np.arange(3))
    particles["mass"] = 2.0
    particles["stress"] = np.eye(2)
    particles["stress"] += particles["stress"]
    assert np.array_equal(particles.state, [[2.0, 2.0, 0.0, 0.0, 2.0]] * 3)
    wanted = particles.state_of({"stress": np.full((4, 2, 2), 7.0)}, 4)
    assert np.array_equal(wanted, [[0.0, 7.0, 7.0, 7.0, 7.0]] * 4)


@every_dimension
def test_position_is_the_coordinate_in_units_of_length(dim):
    grid = grid_of(*BOXES[dim])
    particles = some_particles(grid, 30)
    assert np.allclose(particles.position, particles.coordinate * np.array(grid.length) / grid.cells, rtol=1e-15)
    particles.position[:] = 0.0
    assert particles.coordinate.any()


@every_dimension
def test_appended_particles_come_last_and_leave_the_others_as_they_are(dim):
    grid = grid_of(*BOXES[dim])
    particles = some_particles(grid, 5)
    before = particles.coordinate.copy()
    for k in range(1, 40):
        add_particles(particles, grid, 3 * k, particles.count, seed=k)
    assert np.array_equal(particles.ids, np.arange(particles.count))
    assert rows_are_whole(particles) and np.array_equal(particles.coordinate[:5], before)


@pytest.mark.parametrize("taken", [[], [0], [9], [0, 9], [3, 4, 5], [7, 8, 9], [0, 2, 4, 6, 8], list(range(10))])
def test_taking_particles_out_leaves_exactly_the_others(taken):
    grid = grid_of(*BOXES[2])
    particles = some_particles(grid, 10)
    where = dict(zip(particles.ids.tolist(), particles.coordinate.tolist()))
    coordinate, state, ids = particles.take(np.array(taken, dtype=np.int64))
    assert ids.tolist() == taken and np.array_equal(coordinate, np.array([where[i] for i in taken]).reshape(-1, 2))
    assert np.array_equal(state, ids[:, None] + 0.1 * np.arange(3))
    assert sorted(particles.ids.tolist()) == sorted(set(range(10)) - set(taken))
    assert rows_are_whole(particles)
    assert all(where[i] == x for i, x in zip(particles.ids.tolist(), particles.coordinate.tolist()))


def test_taking_any_particles_out_leaves_exactly_the_others():
    grid, rng = grid_of(*BOXES[1]), np.random.default_rng(6)
    for _ in range(200):
        n = rng.integers(1, 30)
        particles = some_particles(grid, n)
        index = np.flatnonzero(rng.random(n) < rng.random())
        *_, ids = particles.take(index)
        assert sorted([*ids, *particles.ids]) == list(range(n)) and rows_are_whole(particles)
        add_particles(particles, grid, 4, 100)
        assert rows_are_whole(particles)


# ---------------------------------------------------------------- order by cell


@every_dimension
def test_sorting_orders_by_cell_x_fastest_and_keeps_rows_whole(dim):
    grid = grid_of(*BOXES[dim])
    particles = some_particles(grid, 300)
    where = dict(zip(particles.ids.tolist(), particles.coordinate.tolist()))
    particles.sort_by_cell(grid)
    cell = particles.coordinate.astype(int)
    key = np.ravel_multi_index(cell.T[::-1], grid.cells[::-1])
    assert np.all(np.diff(key) >= 0) and np.any(np.diff(particles.ids) < 0)
    assert sorted(particles.ids) == list(range(300)) and rows_are_whole(particles)
    assert all(where[i] == x for i, x in zip(particles.ids.tolist(), particles.coordinate.tolist()))


@every_dimension
def test_sorting_keeps_the_order_within_a_cell(dim):
    grid = grid_of(*BOXES[dim])
    particles = some_particles(grid, 300)
    particles.sort_by_cell(grid)
    cell, _ = locate(grid, particles.coordinate)
    same = np.diff(cell) == 0
    assert same.sum() > 100 and np.all(np.diff(particles.ids)[same] > 0)
    before = particles.ids.copy()
    particles.sort_by_cell(grid)
    assert np.array_equal(particles.ids, before)


@every_dimension
def test_locating_gives_the_cell_and_the_place_in_it(dim):
    grid = grid_of(*BOXES[dim])
    coordinate = some_particles(grid, 200).coordinate
    cell, fraction = locate(grid, coordinate)
    corner = np.floor(coordinate)
    assert np.array_equal(fraction, coordinate - corner)
    assert np.array_equal(cell, np.ravel_multi_index(corner.astype(int).T[::-1], grid.cells[::-1]))


@every_dimension
@pytest.mark.parametrize("outside", [-0.5, 1000.0])
def test_a_particle_outside_the_cells_is_named(dim, outside):
    grid = grid_of(*BOXES[dim])
    coordinate = some_particles(grid, 20).coordinate.copy()
    coordinate[13, -1] = outside
    with pytest.raises(ValueError, match=r"particle 13 at .* is not in the cells"):
        locate(grid, coordinate)


# ---------------------------------------------------------------- layouts


def laid_out(layout, dim, per_cell, jitter=0.0, seed=0):
    grid = grid_of(*BOXES[dim])
    count = int(np.prod(grid.cells)) * int(np.prod(per_cell))
    return grid, LAYOUTS[layout].coordinates(grid, np.arange(count), per_cell=per_cell, jitter=jitter, seed=seed)


def counts_per_cell(grid, coordinate):
    cell = np.floor(np.mod(coordinate, grid.cells)).astype(int)
    return np.bincount(np.ravel_multi_index(cell.T, grid.cells), minlength=grid.node_count)


@every_dimension
@pytest.mark.parametrize("per_cell", [(2, 2, 2), (1, 3, 2)])
def test_a_lattice_has_so_many_particles_in_every_cell_evenly_spaced(dim, per_cell):
    per_cell = per_cell[:dim]
    grid, coordinate = laid_out("lattice", dim, per_cell)
    assert np.all(counts_per_cell(grid, coordinate) == np.prod(per_cell))
    for axis, k in enumerate(per_cell):
        places = np.unique(coordinate[:, axis])
        assert np.allclose(places, (np.arange(grid.cells[axis] * k) + 0.5) / k, rtol=1e-15)
    assert len(np.unique(coordinate, axis=0)) == len(coordinate)


def test_ids_of_a_lattice_count_along_x_first():
    grid, coordinate = laid_out("lattice", 2, (2, 1))
    assert coordinate[:3].tolist() == [[0.25, 0.5], [0.75, 0.5], [1.25, 0.5]]
    assert coordinate[2 * grid.cells[0]].tolist() == [0.25, 1.5]


@every_dimension
@pytest.mark.parametrize("jitter", [0.1, 0.5, 2.0])
def test_jitter_moves_by_up_to_so_many_spacings_both_ways_along_every_axis(dim, jitter):
    per_cell = (4, 3, 2)[:dim]
    _, lattice = laid_out("lattice", dim, per_cell)
    _, jittered = laid_out("jittered", dim, per_cell, jitter)
    moved = (jittered - lattice) * per_cell
    assert np.all(np.abs(moved) <= jitter * (1 + 1e-12))
    assert np.all(moved.max(axis=0) > 0.7 * jitter) and np.all(moved.min(axis=0) < -0.7 * jitter)


@every_dimension
def test_jitter_zero_is_the_lattice(dim):
    per_cell = (2, 2, 2)[:dim]
    assert np.array_equal(laid_out("jittered", dim, per_cell)[1], laid_out("lattice", dim, per_cell)[1])


@every_dimension
def test_random_particles_fill_the_box_evenly(dim):
    grid, coordinate = laid_out("random", dim, (200,))
    assert np.all((coordinate >= 0) & (coordinate < grid.cells))
    expected = 200
    assert np.abs(counts_per_cell(grid, coordinate) - expected).max() < 5 * np.sqrt(expected)


@every_dimension
@pytest.mark.parametrize("layout", ["jittered", "lattice", "random"])
def test_where_a_particle_starts_depends_on_its_id_and_the_seed_alone(dim, layout):
    """Any split of the ids into blocks gives the same particles."""
    grid = grid_of(*BOXES[dim])
    per_cell, count = (2,) * dim, 2**dim * grid.node_count

    def drawn(ids):
        return LAYOUTS[layout].coordinates(grid, ids, per_cell=per_cell, jitter=0.4, seed=3)

    whole = drawn(np.arange(count))
    cuts = [0, 1, count // 3, count // 3, count]
    blocks = [drawn(np.arange(a, b)) for a, b in pairwise(cuts)]
    assert whole.shape == (count, dim) and np.array_equal(np.concatenate(blocks), whole)


@pytest.mark.parametrize("layout", ["jittered", "random"])
def test_another_seed_gives_other_particles_and_the_same_seed_the_same(layout):
    one, other = (laid_out(layout, 2, (2, 2), 0.4, seed)[1] for seed in (1, 2))
    assert not np.any(one == other)
    assert np.array_equal(one, laid_out(layout, 2, (2, 2), 0.4, 1)[1])


def test_one_rank_makes_all_particles():
    assert np.array_equal(share(17, grid_of(*BOXES[1])), np.arange(17))
    assert share(0, grid_of(*BOXES[1])).size == 0


# ---------------------------------------------------------------- random numbers


@pytest.mark.parametrize("start, stop", [(0, 1), (0, 7), (3, 4), (5, 103), (999, 1000)])
@pytest.mark.parametrize("columns", [1, 2, 3, 4])
def test_a_block_of_random_numbers_is_a_slice_of_the_whole(start, stop, columns):
    whole = uniform(11, np.arange(1000), 4)
    assert np.array_equal(uniform(11, np.arange(start, stop), columns), whole[start:stop, :columns])


def test_random_numbers_far_along_are_as_random_as_near():
    far = uniform(0, np.arange(2**52, 2**52 + 20_000), 4)
    assert abs(far.mean() - 0.5) < 0.01
    assert not np.array_equal(far, uniform(0, np.arange(20_000), 4))


@pytest.mark.parametrize("seed", [0, 1, 2**63 - 1])
def test_random_numbers_have_the_mean_variance_and_independence_of_uniform_ones(seed):
    n = 40_000
    u = uniform(seed, np.arange(n), 4)
    assert u.min() >= 0 and u.max() < 1 and len(np.unique(u)) == u.size
    spread = 5 / np.sqrt(n)
    assert np.all(np.abs(u.mean(axis=0) - 1 / 2) < spread * np.sqrt(1 / 12))
    assert np.all(np.abs(u.var(axis=0) - 1 / 12) < spread * np.sqrt(1 / 180))
    assert np.abs(np.corrcoef(u.T) - np.eye(4)).max() < spread
    assert abs(np.corrcoef(u[1:, 0], u[:-1, 0])[0, 1]) < spread


def test_seeds_give_unrelated_numbers():
    a, b = (uniform(seed, np.arange(10_000), 1)[:, 0] for seed in (0, 1))
    assert not np.any(a == b) and abs(np.corrcoef(a, b)[0, 1]) < 0.05


def test_ids_with_gaps_are_refused_and_none_give_none():
    with pytest.raises(ValueError, match="consecutive"):
        uniform(0, np.array([0, 1, 3]), 2)
    assert uniform(0, np.arange(0), 3).shape == (0, 3)

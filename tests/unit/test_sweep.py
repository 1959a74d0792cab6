"""Sweep against the dense matrices and Mapping: what it knows where it is, and what `advance` makes of it."""

import numpy as np
import pytest

from covering_helpers import covering
from dense_helpers import Dense, close, few_cases, pattern
from mpipic.mapping.linear_sweep import LinearSweep
from mpipic.mapping.mapping import Mapping
from serial_helpers import (
    EXACT,
    by_id,
    case,
    divergence_sums,
    ghosted,
    gradient_sums,
    gram_matrix,
    gram_times,
    grid_of,
    on_nodes,
    particles_of,
    sweep_of,
    values,
)

any_case = pytest.mark.parametrize(("box", "name"), few_cases())
every_dimension = pytest.mark.parametrize("dim", [1, 2, 3])


def random_state(position, dim, seed=8):
    rng = np.random.default_rng(seed)
    return rng.standard_normal(len(position)), rng.standard_normal((len(position), dim))


@any_case
def test_a_sweep_sums_the_state_as_the_dense_matrices_do(box, name):
    grid, position, dense = case(box, name)
    density, velocity = random_state(position, grid.dim)
    sweep = sweep_of(grid, position, density, velocity)
    rho, u = sweep.state_sums
    scale = dense.d.max() * max(np.abs(density).max(), np.abs(velocity).max())
    close(on_nodes(grid, rho)[:, 0], dense.phi.T @ density, scale=scale)
    close(on_nodes(grid, u), dense.phi.T @ velocity, scale=scale)
    close(on_nodes(grid, sweep.row_sums), dense.d)
    means = on_nodes(grid, sweep.divide(u))
    close(means, dense.S @ velocity, scale=np.abs(velocity).max())
    assert np.all(means[~dense.seen] == 0.0)


@any_case
def test_a_sweep_knows_the_gram_matrix(box, name):
    grid, position, dense = case(box, name)
    gram = gram_matrix(sweep_of(grid, position))
    close(gram, dense.G)
    close(gram, gram.T, 1e-15)
    close(gram.sum(axis=1), dense.d)


@any_case
def test_a_sweep_knows_the_sums_of_gradients(box, name):
    grid, position, dense = case(box, name)
    sweep, nodal = sweep_of(grid, position), values(grid.node_count)
    sums = gradient_sums(sweep, nodal)
    for axis in range(grid.dim):
        wanted = dense.phi.T @ (dense.D[axis] @ nodal)
        close(sums[:, axis], wanted, scale=dense.d.max() * np.abs(nodal).max() / grid.h[axis])


@any_case
def test_a_sweep_knows_the_sums_of_divergences(box, name):
    grid, position, dense = case(box, name)
    nodal = values(grid.node_count, grid.dim) * grid.h
    sums = divergence_sums(sweep_of(grid, position), nodal)
    close(sums, dense.phi.T @ dense.divergence(nodal), scale=dense.d.max() * grid.dim)


def test_nodal_operators_of_a_sweep_add_to_what_is_there():
    grid, position, dense = case("2D", "random")
    sweep, nodal = sweep_of(grid, position), values(grid.node_count, grid.dim) * grid.h
    once = sweep.divergence_sums(ghosted(grid, nodal), out=grid.zeros(1))
    out = np.ones((grid.local_nodes, 1))
    assert sweep.divergence_sums(ghosted(grid, nodal), out=out) is out
    close(out - 1.0, once, scale=dense.d.max() * grid.dim)


FAINT = {"right of a node": 2.0**-40 + 2.0**-47, "left of a node": 1 - 2.0**-33 - 2.0**-45}
"""Places in a cell that give its far nodes weights of 1e-12, or 1e-10, along an axis; sums of few powers of two."""


def faint_case(dim, side, crowd):
    cells, length = (4, 5, 6)[:dim], (4.0, 5.0, 6.0)[:dim]
    position = np.full((crowd, dim), 2.0 + FAINT[side])
    dense = Dense(cells, length, position)
    assert dense.d[dense.seen].min() < 1e-9**dim * crowd
    return grid_of(cells, length), position, dense


@every_dimension
@pytest.mark.parametrize("side", FAINT)
@pytest.mark.parametrize("crowd", [1, 50])
def test_rows_of_nodes_that_hardly_see_a_particle_are_right_relative_to_themselves(dim, side, crowd):
    """Rows are divided by their weight, so it is each row's own largest entry that its errors count against."""
    grid, position, dense = faint_case(dim, side, crowd)
    seen, q = dense.seen, values(crowd)
    mapping, sweep = Mapping(grid, position), sweep_of(grid, position, q)
    for weights in (mapping.row_sums, sweep.row_sums):
        weights = on_nodes(grid, weights)
        close(weights[seen] / dense.d[seen], np.ones(seen.sum()))
        assert np.all(weights[~seen] == 0.0)
    gram = gram_matrix(sweep)
    largest = dense.G[seen].max(axis=1)[:, None]
    close(gram[seen] / largest, dense.G[seen] / largest)
    assert not gram[~seen].any() and not gram[:, ~seen].any()
    for means in (mapping.p2g(q), sweep.divide(sweep.held_sums)[:, 0]):
        close(on_nodes(grid, means)[seen], np.full(seen.sum(), q.mean()), scale=np.abs(q).max())


@every_dimension
@pytest.mark.parametrize("side", FAINT)
def test_sums_of_gradients_are_right_relative_to_the_row_they_are_divided_by(dim, side):
    grid, position, dense = faint_case(dim, side, 3)
    nodal = values(grid.node_count, dim)
    slopes = gradient_sums(sweep_of(grid, position), nodal[:, 0])[dense.seen] / dense.d[dense.seen, None]
    close(slopes, (dense.S @ dense.gradient(nodal[:, 0]))[dense.seen])
    divergence = divergence_sums(sweep_of(grid, position), nodal)[dense.seen] / dense.d[dense.seen]
    close(divergence, (dense.S @ dense.divergence(nodal))[dense.seen])


# ---------------------------------------------------------------- advance


MOVES = {
    "at rest": (0.0, 0.0, 0.0),
    "slow": (0.375, 0.0625, -0.21875),
    "backwards": (-0.40625, -1.625, 0.0),
    "several cells": (3.3125, -2.75, 1.15625),
    "more than a period": (17.40625, -29.71875, 23.1875),
}
"""Cells a step; multiples of 2^-40, so that no move is rounded."""


def moving_case(dim, name, move):
    cells, length = EXACT[dim]
    grid, position = grid_of(cells, length), pattern(name, cells, length)
    density, velocity = random_state(position, dim)
    displacement = np.array(MOVES[move][:dim]) * grid.h
    return grid, position, density, velocity, displacement


def agrees_with_a_new_one(sweep, tolerance=1e-12):
    """Everything a sweep knows is what one built from scratch at its particles' positions knows."""
    grid = sweep.grid
    position, density, velocity = by_id(sweep.particles)
    fresh = sweep_of(grid, position, density, velocity)
    close(sweep.held_sums, fresh.held_sums, tolerance)
    close(sweep.row_sums, fresh.row_sums, tolerance)
    nodal = values(grid.node_count, grid.dim)
    close(gram_times(sweep, nodal), gram_times(fresh, nodal), tolerance)
    close(gradient_sums(sweep, nodal[:, 0]), gradient_sums(fresh, nodal[:, 0]), tolerance)
    close(divergence_sums(sweep, nodal), divergence_sums(fresh, nodal), tolerance)
    assert sweep.peak == np.abs(density).max()


@pytest.mark.parametrize(
    ("dim", "direct", "move", "name"),
    covering(2, (1, 2, 3), (False, True), MOVES, ("random", "lattice", "on nodes", "few")),
)
def test_advance_adds_to_the_particles_what_the_nodes_say_and_moves_them(dim, move, name, direct):
    grid, position, density, velocity, displacement = moving_case(dim, name, move)
    sweep = sweep_of(grid, position, density, velocity, displacement)
    dense, nodal, rates = Dense(grid.cells, grid.length, position), values(grid.node_count, 1 + dim), (0.7, -1.3)
    sweep.advance(ghosted(grid, nodal), rates, direct=direct)
    if direct:
        increments = dense.divergence(nodal[:, 1:]), dense.gradient(nodal[:, 0])
    else:
        increments = dense.phi @ nodal[:, 0], dense.phi @ nodal[:, 1:]
    new_position, new_density, new_velocity = by_id(sweep.particles)
    assert np.array_equal(new_position, np.mod(position + displacement, grid.length))
    close(new_density, density + rates[0] * increments[0], 1e-13, scale=10 * max(1.0, *grid.inverse_h))
    close(new_velocity, velocity + rates[1] * increments[1], 1e-13, scale=10 * max(1.0, *grid.inverse_h))
    agrees_with_a_new_one(sweep)


@pytest.mark.parametrize(
    ("dim", "move", "name"), covering(2, (1, 2, 3), MOVES, ("random", "jittered", "lattice", "few", "one"))
)
def test_after_many_steps_a_sweep_is_still_that_of_its_particles(dim, move, name):
    grid, position, density, velocity, displacement = moving_case(dim, name, move)
    sweep = sweep_of(grid, position, density, velocity, displacement)
    for step in range(60):
        nodal = ghosted(grid, values(grid.node_count, 1 + dim, seed=step))
        sweep.advance(nodal, (0.1, 0.1), direct=step % 3 == 0)
    new_position, new_density, _ = by_id(sweep.particles)
    assert np.array_equal(new_position, np.mod(position + 60 * displacement, grid.length))
    assert not np.allclose(new_density, density)
    coordinate = sweep.particles.coordinate
    assert np.all((coordinate >= -1e-9) & (coordinate < grid.cells))
    agrees_with_a_new_one(sweep)


@every_dimension
def test_particles_at_rest_are_weighed_and_sorted_once(dim):
    grid, position, density, velocity, _ = moving_case(dim, "random", "at rest")
    sweep = sweep_of(grid, position, density, velocity)
    weights, gram = sweep.row_sums.copy(), gram_matrix(sweep)
    assert not sweep.moving
    for step in range(30):
        sweep.advance(ghosted(grid, values(grid.node_count, 1 + dim, seed=step)), (0.1, 0.1))
    assert np.array_equal(sweep.row_sums, weights) and np.array_equal(gram_matrix(sweep), gram)
    assert sweep.sorts == 1
    agrees_with_a_new_one(sweep)


@every_dimension
def test_a_displacement_of_whole_periods_is_none(dim):
    grid, position, *_ = moving_case(dim, "random", "at rest")
    sweep = sweep_of(grid, position, displacement=[3 * box for box in grid.length])
    assert not sweep.moving
    sweep.advance(grid.zeros(1 + dim), (1.0, 1.0))
    assert np.array_equal(by_id(sweep.particles)[0], position)


@every_dimension
def test_the_order_of_the_particles_does_not_matter(dim):
    grid, position, density, velocity, displacement = moving_case(dim, "random", "slow")
    order = np.random.default_rng(4).permutation(len(position))
    results = []
    for rows in (np.arange(len(position)), order):
        particles = particles_of(grid, position[rows], density[rows], velocity[rows])
        particles.ids[:] = rows
        sweep = LinearSweep(grid, particles, displacement)
        for step in range(5):
            sweep.advance(ghosted(grid, values(grid.node_count, 1 + dim, seed=step)), (0.1, 0.1))
        nodal = values(grid.node_count, 1)
        results.append([*by_id(sweep.particles), sweep.held_sums, gram_times(sweep, nodal)])
    for one, other in zip(*results):
        close(one, other, 1e-13)


@every_dimension
def test_ids_stay_with_their_particles_through_moves_and_sorts(dim):
    """Density holds a function of the id that nothing changes."""
    grid, position, _, velocity, displacement = moving_case(dim, "random", "slow")
    tags = np.arange(len(position)) + 0.25
    sweep = sweep_of(grid, position, tags, velocity, displacement)
    steps = 0
    while sweep.sorts < 3 and steps < 2000:
        sweep.advance(grid.zeros(1 + dim), (1.0, 1.0))
        steps += 1
    assert sweep.sorts == 3
    new_position, new_tags, new_velocity = by_id(sweep.particles)
    assert np.array_equal(new_tags, tags) and np.array_equal(new_velocity, velocity)
    assert np.array_equal(new_position, np.mod(position + steps * displacement, grid.length))
    assert not np.array_equal(sweep.particles.ids, np.arange(len(position)))


@pytest.mark.parametrize(
    ("dim", "moving", "bad", "where"), covering(2, (1, 2, 3), (True, False), (np.nan, np.inf, -np.inf), (0, 17, -1))
)
def test_a_value_that_is_no_number_shows_in_the_peak(dim, moving, bad, where):
    """Whichever block of particles it is in."""
    grid, position, density, velocity, displacement = moving_case(dim, "crowd", "slow")
    density[where] = bad
    sweep = sweep_of(grid, position, density, velocity, displacement if moving else None)
    assert not np.isfinite(sweep.peak)
    sweep.advance(grid.zeros(1 + dim), (1.0, 1.0))
    assert not np.isfinite(sweep.peak)


@every_dimension
@pytest.mark.parametrize("direct", [True, False])
def test_a_nodal_value_that_is_no_number_shows_in_the_peak(dim, direct):
    grid, position, density, velocity, displacement = moving_case(dim, "random", "slow")
    sweep = sweep_of(grid, position, density, velocity, displacement)
    nodal = values(grid.node_count, 1 + dim)
    nodal[3] = np.nan
    sweep.advance(ghosted(grid, nodal), (1.0, 1.0), direct=direct)
    assert np.isnan(sweep.peak)


@every_dimension
@pytest.mark.parametrize("sign", [1, -1])
def test_the_peak_is_the_largest_size_of_the_scalar_and_not_of_the_vector(dim, sign):
    grid, position, density, velocity, displacement = moving_case(dim, "random", "slow")
    density[11], velocity[5] = sign * 9.0, 1e3
    sweep = sweep_of(grid, position, density, velocity, displacement)
    assert sweep.peak == 9.0
    sweep.advance(ghosted(grid, np.full((grid.node_count, 1 + dim), sign * 1.0)), (1.0, 0.0))
    assert sweep.peak == pytest.approx(10.0, rel=1e-14)


def test_particles_that_move_together_keep_their_distances_to_the_last_bit():
    """A lattice stays one, round the period too: else the rounding of positions feeds what the filters must remove."""
    grid = grid_of((100,), (1.0,))
    position = (np.arange(200)[:, None] + 0.5) / 200
    sweep = sweep_of(grid, position, displacement=(0.05 * 1.25e-3,))
    for _ in range(1000):
        sweep.advance(grid.zeros(2), (1.0, 1.0))
    coordinate = sweep.particles.coordinate[np.argsort(sweep.particles.ids), 0]
    assert coordinate[0] == pytest.approx(6.5, abs=1e-9)
    distances = np.diff(coordinate)
    assert np.array_equal(np.where(distances < 0, distances + 100.0, distances), np.full(199, 0.5))


@every_dimension
def test_a_sweep_without_particles_holds_zeros(dim):
    grid = grid_of(*EXACT[dim])
    sweep = sweep_of(grid, np.empty((0, dim)), displacement=(0.1,) * dim)
    sweep.advance(grid.zeros(1 + dim), (1.0, 1.0))
    assert not sweep.held_sums.any() and sweep.peak == 0.0

"""Motion on one rank: one displacement for all, or one for each, around the period, exact in quanta of the grid."""

import numpy as np
import pytest

from dense_helpers import pattern
from mpipic.particles.motion import Motion
from serial_helpers import grid_of, particles_of

BOXES = {1: ((8,), (1.0,)), 2: ((6, 4), (1.5, 2.0)), 3: ((3, 4, 2), (0.75, 2.0, 2.0))}
every_dimension = pytest.mark.parametrize("dim", [1, 2, 3])


def case(dim):
    grid = grid_of(*BOXES[dim])
    particles = particles_of(grid, pattern("random", *BOXES[dim]))
    return grid, particles, Motion(grid, particles)


@every_dimension
@pytest.mark.parametrize("size", [1e-9, 0.3, 1.0, 7.25, -40.5])
def test_all_move_by_one_displacement_as_each_by_the_same(dim, size):
    grid, together, motion = case(dim)
    _, alone, own_motion = case(dim)
    displacement = size * np.array([1.0, -0.5, 0.25])[:dim] * np.array(grid.h)
    motion.move(displacement)
    own_motion.move(np.tile(displacement, (alone.count, 1)))
    assert np.array_equal(together.coordinate, alone.coordinate)
    away = np.mod(together.position - pattern("random", *BOXES[dim]) - displacement, grid.length)
    assert np.minimum(away, np.array(grid.length) - away).max() < 1e-12 * max(grid.length)


@every_dimension
def test_each_moves_by_its_own_displacement_and_stays_in_the_box(dim):
    grid, particles, motion = case(dim)
    rng, start = np.random.default_rng(0), particles.position
    total = np.zeros_like(start)
    for _ in range(20):
        steps = rng.standard_normal(start.shape) * np.array(grid.h)
        motion.move(steps)
        total += steps
    position = particles.position
    assert np.all((position >= 0.0) & (position < grid.length)) and np.abs(total / grid.h).max() > 5.0
    away = np.mod(position - start - total, grid.length)
    assert np.minimum(away, np.array(grid.length) - away).max() < 1e-12 * max(grid.length)


@every_dimension
def test_a_particle_that_goes_there_and_back_is_where_it_was_to_the_last_bit(dim):
    grid, particles, motion = case(dim)
    start = particles.coordinate.copy()
    steps = np.random.default_rng(1).standard_normal(start.shape) * np.array(grid.length) / 3.0
    motion.move(steps)
    assert np.abs(particles.coordinate - start).max() > 0.1
    motion.move(-steps)
    assert np.array_equal(particles.coordinate, start)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("each", [True, False])
def test_a_displacement_that_is_not_finite_is_refused_and_nothing_moves(bad, each):
    _, particles, motion = case(2)
    start = particles.coordinate.copy()
    displacement = np.zeros((particles.count, 2)) if each else np.zeros(2)
    displacement[..., 1] = bad
    with pytest.raises(ValueError, match="not finite"):
        motion.move(displacement)
    assert np.array_equal(particles.coordinate, start)


def test_no_particles_can_be_moved():
    grid = grid_of(*BOXES[2])
    motion = Motion(grid, particles_of(grid, np.empty((0, 2))))
    assert motion.move(np.empty((0, 2))) == motion.move(np.array([0.1, 0.2])) == 0

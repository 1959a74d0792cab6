"""Migration and placement as far as one rank can tell; several ranks are tested elsewhere."""

import re
from operator import attrgetter

import numpy as np
import pytest
from mpi4py import MPI

import mpipic
from dense_helpers import Dense, close, pattern
from mpipic.particles.migration import Reach, Routes, migrate
from mpipic.particles.placement import Placement
from serial_helpers import by_id, grid_of, on_nodes, particles_of

BOXES = {1: ((6,), (1.2,)), 2: ((4, 5), (1.0, 2.0)), 3: ((3, 2, 4), (1.0, 2.0, 0.5))}
every_dimension = pytest.mark.parametrize("dim", [1, 2, 3])


def placed(dim, name="random"):
    cells, length = BOXES[dim]
    position = pattern(name, cells, length)
    grid = grid_of(cells, length)
    return grid, position, Placement(grid, position)


@every_dimension
@pytest.mark.parametrize("displacement", [None, (0.3, -0.7, 0.0), (50.0, -50.0, 3.0)])
def test_particles_sent_away_come_back_whole_when_there_is_one_rank(dim, displacement):
    cells, length = BOXES[dim]
    grid, position = grid_of(cells, length), pattern("random", cells, length)
    rng = np.random.default_rng(2)
    density, velocity = rng.random(len(position)), rng.random((len(position), dim))
    particles = particles_of(grid, position, density, velocity)
    before = by_id(particles)
    routes = Routes(grid, Reach.of_one(displacement[:dim]) if displacement else None)
    leaving = np.array([0, 3, len(position) - 1])
    assert migrate(particles, routes, leaving) == 3
    assert particles.ids[-3:].tolist() == leaving.tolist()
    for one, other in zip(by_id(particles), before):
        assert np.array_equal(one, other)
    assert migrate(particles, routes, np.array([], dtype=np.int64)) == 0
    routes.free()


@every_dimension
@pytest.mark.parametrize("name", ["random", "on nodes", "one"])
def test_values_go_to_the_owners_and_back_unchanged(dim, name):
    _, position, placement = placed(dim, name)
    tags = np.arange(len(position)) + 0.5
    for values in (tags, tags[:, None] * [1.0, -2.0, 3.0]):
        there = placement.to_owners(values)
        assert there.shape == values.shape
        assert np.array_equal(placement.to_callers(there), values)
    assert np.array_equal(placement.to_callers(placement.position), position)
    assert np.array_equal(placement.to_owners(position), placement.position)


@every_dimension
def test_values_of_any_memory_layout_are_placed(dim):
    _, position, placement = placed(dim)
    values = np.random.default_rng(1).random((len(position), 3))
    strided = np.asfortranarray(np.repeat(values, 2, axis=0))[::2]
    assert np.array_equal(placement.to_callers(placement.to_owners(strided)), values)


def test_a_rank_without_particles_takes_part_in_a_placement():
    grid = grid_of(*BOXES[2])
    placement = Placement(grid, np.empty((0, 2)))
    assert placement.position.shape == (0, 2)
    for shape in ((0,), (0, 2)):
        there = placement.to_owners(np.empty(shape))
        assert there.shape == shape and placement.to_callers(there).shape == shape


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300, -1e17])
@pytest.mark.parametrize("row", [0, 4])
def test_a_position_that_tells_no_cell_is_refused_by_number_and_value(bad, row):
    grid = grid_of(*BOXES[2])
    position = np.full((5, 2), 0.5)
    position[row:, 1] = bad
    rule = "is so far away" if np.isfinite(bad) else "is not finite"
    with pytest.raises(ValueError, match=rf"^rank 0: position {row} = \[0\.5, {re.escape(repr(bad))}\] {rule}"):
        Placement(grid, position)


@every_dimension
def test_positions_at_the_very_edges_of_the_box_are_placed(dim):
    grid = grid_of(*BOXES[dim])
    length = np.array(grid.length)
    edges = np.array([np.zeros(dim), np.nextafter(length, 0.0), np.full(dim, 5e-324), -np.zeros(dim)])
    placement = Placement(grid, edges)
    mapping = mpipic.Mapping(grid, placement.position)
    weights = grid.owned(mapping.row_sums)
    assert weights.flat[0] == pytest.approx(4.0, rel=1e-12) and weights.sum() == pytest.approx(4.0, rel=1e-12)


@every_dimension
def test_another_code_filters_its_own_particle_values_with_four_names(dim):
    """The library's door: Grid, Placement, Mapping, LocalFilter on plain arrays."""
    cells, length = BOXES[dim]
    position = pattern("random", cells, length)
    q = np.random.default_rng(7).standard_normal((len(position), 2))
    kept = q.copy()

    grid = mpipic.Grid(cells, length, MPI.COMM_SELF)
    placement = mpipic.Placement(grid, position)
    mapping = mpipic.Mapping(grid, placement.position)
    there = placement.to_owners(q)
    filtered = placement.to_callers(mpipic.LocalFilter(mapping).apply(there))
    nodal = mapping.p2g(there)

    dense = Dense(cells, length, position)
    assert np.array_equal(q, kept)
    close(filtered, dense.phi @ dense.S @ q)
    close(on_nodes(grid, nodal), dense.S @ q)


def test_every_name_at_the_door_opens_and_no_other_does():
    for name in mpipic.__all__:
        assert getattr(mpipic, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'Nonsense'"):
        attrgetter("Nonsense")(mpipic)

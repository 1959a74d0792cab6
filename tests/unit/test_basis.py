"""What makes the basis a basis, by `Mapping` alone, and which cell a particle on a node belongs to."""

import numpy as np
import pytest

from covering_helpers import covering
from dense_helpers import close, pattern
from mpipic.mapping.mapping import Mapping
from serial_helpers import ghosted, grid_of, on_nodes

BOXES = {1: ((7,), (1.3,)), 2: ((6, 5), (1.0, 2.5)), 3: ((4, 5, 6), (1.0, 0.8, 1.7))}
every_dimension = pytest.mark.parametrize("dim", [1, 2, 3])
every_pattern = pytest.mark.parametrize("name", ["random", "jittered", "lattice", "on nodes"])


def mapping_at(dim, name):
    cells, length = BOXES[dim]
    position = pattern(name, cells, length)
    grid = grid_of(cells, length)
    return grid, position, Mapping(grid, position)


def node_positions(grid):
    axes = np.meshgrid(*(np.arange(n) * h for n, h in zip(grid.cells, grid.h)), indexing="ij")
    return np.stack([x.ravel() for x in axes], axis=1)


def linear(x, slopes):
    return x @ slopes + 0.3


def inside(grid, position):
    """Particles whose cell has all its nodes in the box, away from the seam where a linear function jumps."""
    return (position < np.array(grid.length) - np.array(grid.h) * (1 + 1e-9)).all(axis=1)


@every_dimension
@every_pattern
def test_the_shape_functions_add_up_to_one(dim, name):
    grid, position, mapping = mapping_at(dim, name)
    ones = ghosted(grid, np.ones(grid.node_count))
    close(mapping.g2p(ones), np.ones(len(position)), 1e-15 * 4)
    assert on_nodes(grid, mapping.row_sums).sum() == pytest.approx(len(position), rel=1e-14)


@every_dimension
@every_pattern
def test_constants_have_no_gradient(dim, name):
    grid, position, mapping = mapping_at(dim, name)
    ones = ghosted(grid, np.ones(grid.node_count))
    steepest = max(grid.inverse_h)
    close(mapping.gradient(ones), np.zeros((len(position), dim)), 1e-14, scale=steepest)
    close(mapping.divergence(np.repeat(ones[:, None], dim, axis=1)), np.zeros(len(position)), 1e-14, scale=steepest)


@every_dimension
@every_pattern
def test_linear_functions_are_interpolated_exactly_and_so_are_their_slopes(dim, name):
    grid, position, mapping = mapping_at(dim, name)
    slopes = np.array([1.7, -0.4, 2.3])[:dim]
    nodal = ghosted(grid, linear(node_positions(grid), slopes))
    use = inside(grid, position)
    assert use.sum() > 10
    close(mapping.g2p(nodal)[use], linear(position, slopes)[use], 1e-13)
    close(mapping.gradient(nodal)[use], np.broadcast_to(slopes, (use.sum(), dim)), 1e-13)


@every_dimension
def test_the_divergence_of_a_linear_field_is_the_trace_of_its_slopes(dim):
    grid, position, mapping = mapping_at(dim, "random")
    slopes = np.random.default_rng(3).standard_normal((dim, dim))
    nodal = ghosted(grid, node_positions(grid) @ slopes)
    use = inside(grid, position)
    close(mapping.divergence(nodal)[use], np.full(use.sum(), np.trace(slopes)), 1e-13, scale=np.abs(slopes).sum())


@every_dimension
def test_products_of_linear_functions_are_interpolated_exactly(dim):
    """Off the diagonal of a cell only a tensor product does so."""
    grid, position, mapping = mapping_at(dim, "random")
    product = np.prod(node_positions(grid) + 0.2, axis=1)
    use = inside(grid, position)
    close(mapping.g2p(ghosted(grid, product))[use], np.prod(position + 0.2, axis=1)[use], 1e-13)


SIDES = {0.0: "right", -1e-11: "right", -9e-11: "right", 1e-11: "right", -1.1e-10: "left", -1e-9: "left", -1e-6: "left"}


@pytest.mark.parametrize(("dim", "offset", "node"), covering(2, (1, 2, 3), SIDES, (0, 1, 3)))
def test_a_particle_on_a_node_or_just_left_of_it_takes_the_slope_of_the_right_hand_cell(dim, offset, node):
    """Every axis in turn: the particle lies in the middle of a cell along the others. Node 0 is the seam."""
    cells, length = (4, 5, 8)[:dim], (4.0, 10.0, 2.0)[:dim]
    grid = grid_of(cells, length)
    values = np.random.default_rng(1).standard_normal(cells)
    for axis in range(dim):
        coordinate = np.full((1, dim), 1.5)
        coordinate[0, axis] = (node + offset) % cells[axis]
        mapping = Mapping(grid, coordinate * grid.h)
        line = values
        for other in reversed(range(dim)):
            if other != axis:
                line = 0.5 * (line.take(1, axis=other) + line.take(2, axis=other))
        right, here, left = line[(node + 1) % cells[axis]], line[node], line[node - 1]
        expected = (right - here if SIDES[offset] == "right" else here - left) / grid.h[axis]
        slope = mapping.gradient(ghosted(grid, values.ravel()))[0, axis]
        assert slope == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("offset", [0.0, -1e-11, -1e-9, 1e-9])
def test_values_are_continuous_across_a_node(offset):
    grid = grid_of((4,), (4.0,))
    nodal = ghosted(grid, np.array([3.0, -1.0, 4.0, 1.0]))
    assert Mapping(grid, np.array([[2.0 + offset]])).g2p(nodal)[0] == pytest.approx(4.0, abs=1e-8)

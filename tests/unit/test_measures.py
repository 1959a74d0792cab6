"""The share of a state that no node sees, against the dense projection."""

import numpy as np
import pytest
from petsc4py import PETSc

from covering_helpers import covering
from dense_helpers import GRIDS, Dense, close, pattern
from mpipic.filters.measures import null_space_fraction, share_unseen
from mpipic.mapping.mapping import Mapping
from serial_helpers import grid_of, particles_of, values


def case(box, name):
    """Grid, particles with noise as their density, and q = D S ρ of them as dense matrices say."""
    cells, length = GRIDS[box]
    position = pattern(name, cells, length)
    density = values(len(position))
    dense = Dense(cells, length, position)
    return grid_of(cells, length), particles_of(grid_of(cells, length), position, density), dense


@pytest.mark.parametrize(("box", "name"), covering(2, ("1D", "2D", "2D, aspect 1e6", "3D"), ("random", "lattice")))
@pytest.mark.parametrize("size", [1.0, 1e-200])
def test_the_share_of_the_unfiltered_gradient_is_that_of_the_dense_projection(box, name, size):
    grid, particles, dense = case(box, name)
    q = dense.gradient(dense.S @ particles["density"])
    wanted = np.linalg.norm(q - dense.projection() @ q) / np.linalg.norm(q)
    assert 0.3 < wanted < 0.99, "there is something to see and something not to"
    assert null_space_fraction(grid, particles, size * particles["density"]) == pytest.approx(wanted, rel=1e-8)


@pytest.mark.parametrize("shape", [(), (2,), (2, 2)])
def test_values_of_any_shape_have_one_share_and_are_kept(shape):
    grid, particles, dense = case("2D", "random")
    q = values(particles.count, *shape)
    flat, before = q.reshape(len(q), -1), q.copy()
    wanted = np.linalg.norm(flat - dense.projection() @ flat) / np.linalg.norm(flat)
    assert share_unseen(Mapping.at(grid, particles), q) == pytest.approx(wanted, rel=1e-8)
    close(q, before, 0.0)


def test_a_gradient_that_vanishes_has_no_share_and_one_that_is_no_number_an_unknown_one():
    grid, particles, _ = case("2D", "random")
    mapping = Mapping.at(grid, particles)
    assert share_unseen(mapping, np.zeros((particles.count, 2))) == 0.0
    for bad in (np.nan, np.inf):
        q = values(particles.count, 2)
        q[3, 1] = bad
        assert share_unseen(mapping, q) is None


def test_where_the_projection_is_not_found_the_share_is_unknown():
    grid, particles, _ = case("2D", "random")
    options = PETSc.Options("report_")
    options["ksp_max_it"] = 1
    try:
        assert null_space_fraction(grid, particles, particles["density"]) is None
    finally:
        options.delValue("ksp_max_it")

"""`SplineSweep` against the dense matrices and, on the linear basis, `Sweep`, as particles move and are sorted."""

import numpy as np
import pytest
from mpi4py import MPI

from covering_helpers import covering
from dense_helpers import close, pattern
from mpipic.mapping import sweeps
from mpipic.mapping.linear_sweep import LinearSweep
from mpipic.mapping.spline_sweep import SplineSweep
from mpipic.mesh.grid import Grid
from scheme_helpers import matrix_of
from serial_helpers import by_id, divergence_sums, ghosted, gradient_sums, gram_matrix, on_nodes, particles_of, values
from spline_helpers import DEGREES, Splines

# h is a power of two: moves are exact, in the reference too
BOXES = {1: ((8,), (1.0,)), 2: ((4, 6), (1.0, 3.0)), 3: ((4, 3, 5), (8.0, 3.0, 0.625))}
SMALL = {1: ((2,), (1.0,)), 2: ((1, 3), (0.5, 3.0)), 3: ((2, 1, 2), (8.0, 1.0, 0.25))}
FLOWS = {
    "at rest": (0.0, 0.0, 0.0),
    "slow": (0.0625, 0.03125, -0.125),
    "to the next node": (1.0, -1.0, 1.0),
    "cells a step": (2.3125, -1.6875, 1.125),
    "more than a period": (-35.40625, 9.28125, 13.0),
}
"""Cells a step."""

every_basis = pytest.mark.parametrize("basis", DEGREES)
every_dimension = pytest.mark.parametrize("dim", [1, 2, 3])


def spline_sweep(basis, boxes, dim, name, flow, cls=SplineSweep):
    cells, length = boxes[dim]
    position = pattern(name, cells, length)
    state = values(len(position), 1 + dim, seed=3)
    grid = Grid(cells, length, MPI.COMM_SELF, basis)
    displacement = np.array(FLOWS[flow][:dim]) * grid.h
    return cls(grid, particles_of(grid, position, state[:, 0], state[:, 1:]), displacement)


def transposed_sums(sweep, nodal):
    """(D^a)ᵀΦ of nodal (m,): (m, d), or Σ_a (D^a)ᵀΦ nodal_a of (m, d): (m,)."""
    grid = sweep.grid
    if nodal.ndim == 1:
        out = sweep.transposed_gradient_sums(ghosted(grid, nodal[:, None]), out=grid.zeros(grid.dim))
        return on_nodes(grid, sweep.complete(out))
    out = sweep.transposed_divergence_sums(ghosted(grid, nodal), out=grid.zeros(1))
    return on_nodes(grid, sweep.complete(out))[:, 0]


def agrees_with_the_dense_matrices(sweep, tolerance=1e-12):
    """All that a sweep knows is what follows from its particles as they now are."""
    grid = sweep.grid
    position, density, velocity = by_id(sweep.particles)
    basis = {degree: name for name, degree in DEGREES.items()}[grid.degree]
    dense = Splines(basis, grid.cells, grid.length, position)
    state = np.column_stack([density, velocity])
    sums = np.concatenate(sweep.state_sums, axis=1)
    scale = dense.d.max() * np.abs(state).max()
    close(on_nodes(grid, sums), dense.phi.T @ state, tolerance, scale=scale)
    close(on_nodes(grid, sweep.row_sums), dense.d, tolerance)
    close(gram_matrix(sweep), dense.G, tolerance)
    close(matrix_of(grid, sweep), dense.G, tolerance)
    nodal = values(grid.node_count, grid.dim) * grid.h
    scale = dense.d.max() * 4.0
    steep = scale * np.abs(nodal).max() * max(grid.inverse_h)
    for axis, C in enumerate(dense.C):
        close(
            gradient_sums(sweep, nodal[:, 0])[:, axis],
            C @ nodal[:, 0],
            tolerance,
            scale=steep,
        )
    close(divergence_sums(sweep, nodal), sum(C @ u for C, u in zip(dense.C, nodal.T)), tolerance, scale=scale)
    if isinstance(sweep, SplineSweep):
        close(transposed_sums(sweep, nodal), sum(C.T @ u for C, u in zip(dense.C, nodal.T)), tolerance, scale=scale)
        back = transposed_sums(sweep, nodal[:, 0])
        for axis, C in enumerate(dense.C):
            close(back[:, axis], C.T @ nodal[:, 0], tolerance, scale=steep)
    assert sweep.peak == np.abs(density).max(initial=0.0)


@pytest.mark.parametrize(
    ("basis", "dim", "small", "name"),
    covering(2, DEGREES, (1, 2, 3), (False, True), ("random", "on nodes", "few", "one", "coincident")),
)
def test_a_new_sweep_is_that_of_the_dense_matrices(basis, dim, small, name):
    agrees_with_the_dense_matrices(spline_sweep(basis, SMALL if small else BOXES, dim, name, "at rest"))


@pytest.mark.parametrize(("basis", "dim", "direct", "flow"), covering(2, DEGREES, (1, 2, 3), (False, True), FLOWS))
def test_a_step_gives_particles_what_the_dense_matrices_say_and_moves_them(basis, dim, flow, direct):
    sweep = spline_sweep(basis, BOXES, dim, "random", flow)
    grid = sweep.grid
    position, density, velocity = by_id(sweep.particles)
    dense = Splines(basis, grid.cells, grid.length, position)
    nodal = values(grid.node_count, 1 + dim)
    sweep.advance(ghosted(grid, nodal), (0.3, -0.7), direct=direct)
    if direct:
        density = density + 0.3 * sum(D @ u for D, u in zip(dense.D, nodal[:, 1:].T))
        velocity = velocity - 0.7 * np.stack([D @ nodal[:, 0] for D in dense.D], axis=1)
    else:
        density = density + 0.3 * dense.phi @ nodal[:, 0]
        velocity = velocity - 0.7 * dense.phi @ nodal[:, 1:]
    found = by_id(sweep.particles)
    assert np.array_equal(found[0], np.mod(position + np.array(FLOWS[flow][:dim]) * grid.h, grid.length))
    close(found[1], density)
    close(found[2], velocity)
    agrees_with_the_dense_matrices(sweep)


def sort_at_every_step(sweep, monkeypatch):
    monkeypatch.setattr(sweep, "sort_when_due", lambda breaks: sweep.sort())


@pytest.mark.parametrize(("basis", "dim", "name", "flow"), covering(2, DEGREES, (1, 2, 3), ("random", "few"), FLOWS))
def test_after_many_steps_a_sweep_is_still_that_of_its_particles_sorted_or_not(basis, dim, flow, name, monkeypatch):
    """Sorted after every step, particles get the same increments: cells stay with them."""
    found = []
    for sorting in (False, True):
        sweep = spline_sweep(basis, BOXES, dim, name, flow)
        grid, start = sweep.grid, by_id(sweep.particles)
        if sorting:
            sort_at_every_step(sweep, monkeypatch)
        for step in range(8):
            nodal = ghosted(grid, values(grid.node_count, 1 + dim, seed=step))
            sweep.advance(nodal, (0.1, 0.1), direct=step % 3 == 0)
        assert sweep.sorts == (9 if sorting and sweep.moving else 1)
        agrees_with_the_dense_matrices(sweep)
        found.append(by_id(sweep.particles))
    assert np.array_equal(found[0][0], np.mod(start[0] + 8 * np.array(FLOWS[flow][:dim]) * grid.h, grid.length))
    assert np.abs(found[0][1] - start[1]).max() > 0.05
    for one, other in zip(*found):
        close(other, one, 1e-13)


@every_basis
@every_dimension
def test_sorting_in_its_own_time_keeps_cells_and_particles_together(basis, dim):
    sweep = spline_sweep(basis, BOXES, dim, "random", "slow")
    grid, steps = sweep.grid, 0
    nodal = ghosted(grid, values(grid.node_count, 1 + dim))
    while sweep.sorts < 3 and steps < 2000:
        sweep.advance(nodal, (1e-3, 1e-3))
        steps += 1
    assert sweep.sorts == 3, "the last step has sorted"
    assert not np.array_equal(sweep.particles.ids, np.arange(sweep.particles.count))
    agrees_with_the_dense_matrices(sweep)
    sweep.advance(nodal, (1e-3, 1e-3))
    agrees_with_the_dense_matrices(sweep)


@pytest.mark.parametrize(("dim", "name", "flow"), covering(2, (1, 2, 3), ("random", "on nodes", "few"), FLOWS))
def test_on_the_linear_basis_it_does_what_the_linear_sweep_does(dim, flow, name):
    one, other = (spline_sweep("linear", BOXES, dim, name, flow, cls) for cls in (LinearSweep, SplineSweep))
    grid = one.grid
    for step in range(40):
        close(other.held_sums, one.held_sums, 1e-13)
        nodal = values(grid.node_count, 1 + dim, seed=step)
        scale = one.row_sums.max() * max(grid.inverse_h) * 4.0
        difference = gradient_sums(other, nodal[:, 0]) - gradient_sums(one, nodal[:, 0])
        close(difference, np.zeros_like(difference), 1e-13, scale=scale)
        difference = divergence_sums(other, nodal[:, 1:]) - divergence_sums(one, nodal[:, 1:])
        close(difference, np.zeros_like(difference), 1e-13, scale=scale)
        for sweep in (one, other):
            sweep.advance(ghosted(grid, nodal), (0.1, 0.05), direct=step % 2 == 0)
        assert one.peak == pytest.approx(other.peak, rel=1e-13)
    assert one.version == other.version and (one.version > 1) == one.moving
    for expected, found in zip(by_id(one.particles), by_id(other.particles)):
        close(found, expected, 1e-13)


@every_basis
@every_dimension
def test_transposed_sums_are_the_transposes_of_the_sums(basis, dim):
    """(y, C^a x) = ((C^a)ᵀ y, x), after moves and sorts too."""
    sweep = spline_sweep(basis, BOXES, dim, "random", "slow")
    grid = sweep.grid
    for step in range(3):
        x, y = values(grid.node_count, seed=step), values(grid.node_count, dim, seed=10 + step)
        forth, back = np.sum(y * gradient_sums(sweep, x)), x @ transposed_sums(sweep, y)
        assert forth == pytest.approx(back, rel=1e-11) and abs(forth) > 1e-3
        forth, back = x @ divergence_sums(sweep, y), np.sum(y * transposed_sums(sweep, x))
        assert forth == pytest.approx(back, rel=1e-11) and abs(forth) > 1e-3
        sweep.advance(grid.zeros(1 + dim), (1.0, 1.0))
        sweep.sort()


@every_basis
@every_dimension
def test_sums_add_to_what_is_there(basis, dim):
    sweep = spline_sweep(basis, BOXES, dim, "random", "at rest")
    grid = sweep.grid
    scalar, vector = ghosted(grid, values(grid.node_count, 1)), ghosted(grid, values(grid.node_count, dim))
    for verb, nodal, columns in (
        (sweep.gradient_sums, scalar, dim),
        (sweep.divergence_sums, vector, 1),
        (sweep.transposed_gradient_sums, scalar, dim),
        (sweep.transposed_divergence_sums, vector, 1),
    ):
        once = verb(nodal, out=grid.zeros(columns))
        out = np.ones_like(once)
        assert verb(nodal, out=out) is out
        close(out - 1.0, once, 1e-13, scale=np.abs(once).max() + 1.0)


@every_basis
@every_dimension
def test_particles_at_rest_are_weighed_and_sorted_once(basis, dim):
    sweep = spline_sweep(basis, BOXES, dim, "random", "at rest")
    weights, version = sweep.row_sums.copy(), sweep.version
    for step in range(20):
        sweep.advance(ghosted(sweep.grid, values(sweep.grid.node_count, 1 + dim, seed=step)), (0.1, 0.1))
    assert not sweep.moving and sweep.sorts == 1 and sweep.version == version
    assert np.array_equal(sweep.row_sums, weights)
    agrees_with_the_dense_matrices(sweep)


@every_basis
@every_dimension
@pytest.mark.parametrize("flow", ["at rest", "slow"])
def test_without_particles_all_sums_are_zero(basis, dim, flow):
    cells, length = BOXES[dim]
    grid = Grid(cells, length, MPI.COMM_SELF, basis)
    sweep = SplineSweep(grid, particles_of(grid, np.empty((0, dim))), np.array(FLOWS[flow][:dim]) * grid.h)
    sweep.advance(ghosted(grid, values(grid.node_count, 1 + dim)), (1.0, 1.0))
    nodal = ghosted(grid, values(grid.node_count, dim))
    assert not sweep.held_sums.any() and not sweep.divergence_sums(nodal, out=grid.zeros(1)).any() and sweep.peak == 0.0


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@every_basis
@every_dimension
def test_a_value_that_is_no_number_shows_in_the_peak(basis, dim, bad):
    sweep = spline_sweep(basis, BOXES, dim, "random", "slow")
    sweep.particles["density"][7] = bad
    sweep.advance(sweep.grid.zeros(1 + dim), (1.0, 1.0))
    assert not np.isfinite(sweep.peak)


@every_basis
@pytest.mark.parametrize("transposed", [False, True])
def test_only_the_linear_basis_without_transposes_has_the_sweep_of_one_pass(basis, transposed):
    grid = Grid((8,), (1.0,), MPI.COMM_SELF, basis)
    sweep = sweeps.create(grid, particles_of(grid, np.array([[0.3]])), (0.1,), transposed=transposed)
    assert type(sweep) is (LinearSweep if basis == "linear" and not transposed else SplineSweep)

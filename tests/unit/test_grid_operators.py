"""Central differences and the grid-scale low-pass on nodal arrays, against dense periodic matrices and symbols."""

from fractions import Fraction
from itertools import product
from math import factorial

import numpy as np
import pytest
from mpi4py import MPI

from covering_helpers import cover
from dense_helpers import GRIDS, close
from mpipic.mesh import differences as grid_operators
from mpipic.mesh.differences import CentralDifference, LowPass
from mpipic.mesh.grid import Grid
from serial_helpers import ghosted, on_nodes, values
from spline_helpers import central_difference, difference_weights, low_pass

ORDERS = (2, 4, 6, 8, 10, 12)
every_grid = pytest.mark.parametrize("box", GRIDS)
every_order = pytest.mark.parametrize("order", ORDERS)
every_basis = pytest.mark.parametrize("basis", ["linear", "quadratic", "cubic"])
every_dimension = pytest.mark.parametrize("dim", [1, 2, 3])
BOXES = {1: ((12,), (1.3,)), 2: ((7, 6), (1.0, 2.5)), 3: ((4, 5, 6), (1.0, 0.8, 1.7))}


def in_turn(orders):
    """Every order in every dimension, and every grid."""
    return cover(list(product(GRIDS, orders)), lambda row: [row[0], (len(GRIDS[row[0]][0]), row[1])])


def box_of(box, basis="linear"):
    cells, length = GRIDS[box]
    return Grid(cells, length, MPI.COMM_SELF, basis), cells, length


def applied(verb, grid, nodal):
    """A verb on own nodes (nodes, k), after a look that ghosts are what their owners hold."""
    out = verb(ghosted(grid, nodal))
    filled = out.copy()
    grid.fill_halo(filled)
    assert np.array_equal(filled, out), "ghosts are filled"
    return on_nodes(grid, out)


# ---------------------------------------------------------------- central differences


@every_order
def test_differences_have_the_weights_of_the_polynomial_through_the_values(order):
    weights = grid_operators.difference_weights(order)
    assert len(weights) == order // 2 + 1 and weights[0] == 0.0
    wanted = difference_weights(order)
    close(weights, [wanted[j] for j in range(order // 2 + 1)], 1e-15)


@every_order
def test_differences_are_exact_on_monomials_up_to_their_order_and_no_further(order):
    weights = grid_operators.difference_weights(order)
    j = np.arange(len(weights))

    def slope(power):
        return float(np.sum(weights * (j**power - (-j) ** power)))

    for power in range(order + 1):
        size = max(1.0, float(np.abs(weights * j**power).max()))
        assert slope(power) == pytest.approx(float(power == 1), abs=1e-14 * size)
    assert abs(slope(order + 1)) == pytest.approx(factorial(order // 2) ** 2, rel=1e-10)


@every_order
@pytest.mark.parametrize("theta", [0.1, 0.3])
def test_a_wave_s_slope_is_wrong_by_the_leading_term_of_the_order(order, theta):
    """2 Σ_j w_j sin jθ = θ - (q!)²/(2q + 1)! θ^(2q + 1) ..., q = order/2; in fractions, for the error is small."""
    q = order // 2
    x = Fraction(theta)
    sines = [sum((-1) ** k * (j * x) ** (2 * k + 1) / factorial(2 * k + 1) for k in range(20)) for j in range(1, q + 1)]
    exact = [Fraction(w).limit_denominator(10**7) for w in grid_operators.difference_weights(order)[1:]]
    error = x - 2 * sum(w * s for w, s in zip(exact, sines))
    leading = Fraction(factorial(q) ** 2, factorial(2 * q + 1)) * x ** (2 * q + 1)
    assert float(error / leading) == pytest.approx(1.0, abs=2 * theta**2)


@pytest.mark.parametrize(("box", "order"), in_turn(ORDERS))
def test_gradients_are_those_of_the_dense_matrices(box, order):
    grid, cells, length = box_of(box)
    nodal = values(grid.node_count, 1)
    found = applied(CentralDifference(grid, order).gradient, grid, nodal)
    for axis, matrix in enumerate(central_difference(cells, length, order)):
        close(found[:, axis], matrix @ nodal[:, 0], 1e-14, scale=4.0 * np.abs(nodal).max() * grid.inverse_h[axis])


@pytest.mark.parametrize(("box", "order"), in_turn(ORDERS))
def test_divergences_are_those_of_the_dense_matrices(box, order):
    grid, cells, length = box_of(box)
    nodal = values(grid.node_count, grid.dim) * grid.h
    found = applied(CentralDifference(grid, order).divergence, grid, nodal)
    wanted = sum(matrix @ u for matrix, u in zip(central_difference(cells, length, order), nodal.T))
    close(found[:, 0], wanted, 1e-14, scale=12.0 * np.abs(nodal / grid.h).max())


@every_basis
@every_dimension
def test_on_arrays_of_any_basis_derivatives_and_low_pass_are_the_same(basis, dim):
    cells, length = BOXES[dim]
    grid = Grid(cells, length, MPI.COMM_SELF, basis)
    nodal = values(grid.node_count, dim)
    difference, strengths = CentralDifference(grid, 6), np.array([0.3, 0.9, 0.5])[:dim]
    matrices = central_difference(cells, length, 6)
    close(
        applied(difference.gradient, grid, nodal[:, :1]), np.stack([m @ nodal[:, 0] for m in matrices], axis=1), 1e-14
    )
    wanted = sum(m @ u for m, u in zip(matrices, nodal.T))
    close(applied(difference.divergence, grid, nodal)[:, 0], wanted, 1e-14)
    H = low_pass(cells, 3, strengths)
    close(applied(LowPass(grid, 3, strengths).change, grid, nodal), H @ nodal - nodal, 1e-14)


@every_dimension
def test_differences_are_skew_symmetric_and_keep_sums_at_zero(dim):
    grid = Grid(*BOXES[dim], MPI.COMM_SELF)
    x, y = values(grid.node_count, 1, seed=1), values(grid.node_count, dim, seed=2)
    for order in ORDERS:
        difference = CentralDifference(grid, order)
        gradient, divergence = applied(difference.gradient, grid, x), applied(difference.divergence, grid, y)
        forth, back = np.sum(y * gradient), np.sum(x * divergence)
        assert forth == pytest.approx(-back, rel=1e-11) and abs(forth) > 0.1, order
        close(gradient.sum(axis=0), np.zeros(dim), 1e-13, scale=np.abs(gradient).sum())
        assert abs(divergence.sum()) < 1e-13 * np.abs(divergence).sum()


@every_dimension
def test_constants_have_no_derivatives(dim):
    grid = Grid(*BOXES[dim], MPI.COMM_SELF)
    for order in ORDERS:
        difference = CentralDifference(grid, order)
        assert not applied(difference.gradient, grid, np.full((grid.node_count, 1), 3.7)).any(), order
        assert not applied(difference.divergence, grid, np.full((grid.node_count, dim), 3.7)).any(), order


def test_its_argument_is_not_changed():
    grid = Grid(*BOXES[2], MPI.COMM_SELF)
    nodal = ghosted(grid, values(grid.node_count, 2))
    kept = nodal.copy()
    difference = CentralDifference(grid, 4)
    difference.divergence(nodal)
    difference.gradient(np.ascontiguousarray(nodal[:, :1]))
    LowPass(grid, 2, np.array([0.5, 0.5])).change(nodal)
    assert np.array_equal(nodal, kept)


# ---------------------------------------------------------------- low-pass


@pytest.mark.parametrize("order", range(1, 9))
def test_the_weights_of_the_low_pass_have_its_symbol(order):
    strength = (0.3, 1.0)[order % 2]
    weights = grid_operators.low_pass_weights(order, strength)
    theta = np.linspace(0.0, np.pi, 50)
    symbol = weights[0] + 2.0 * np.cos(theta[:, None] * np.arange(1, order + 1)) @ weights[1:]
    close(symbol, 1.0 - strength * np.sin(theta / 2) ** (2 * order), 1e-14)


@every_dimension
@pytest.mark.parametrize("order", [1, 2, 4, 8])
def test_the_low_pass_multiplies_every_wave_by_its_symbol(dim, order):
    """Applied to one node, its transform is the symbol at all waves of the grid."""
    cells, length = BOXES[dim]
    grid = Grid(cells, length, MPI.COMM_SELF)
    strengths = np.array([0.8, 1.0, 0.25])[:dim]
    nodal = np.zeros((grid.node_count, 1))
    nodal[0] = 1.0
    change = applied(LowPass(grid, order, strengths).change, grid, nodal)
    symbol = np.fft.fftn((nodal + change).reshape(cells))
    factors = [1.0 - s * np.sin(np.pi * np.arange(n) / n) ** (2 * order) for n, s in zip(cells, strengths)]
    wanted = factors[0]
    for factor in factors[1:]:
        wanted = np.multiply.outer(wanted, factor)
    close(symbol.real, wanted, 1e-14)
    close(symbol.imag, np.zeros(cells), 1e-14, scale=1.0)
    assert np.all((symbol.real > -1e-14) & (symbol.real < 1 + 1e-14)), "nothing grows"


@pytest.mark.parametrize(("box", "order"), in_turn((1, 2, 3, 4, 8)))
def test_the_low_pass_is_the_dense_one(box, order):
    grid, cells, _ = box_of(box)
    strengths = np.array([0.9, 0.4, 1.0])[: grid.dim]
    nodal = values(grid.node_count, 1 + grid.dim)
    H = low_pass(cells, order, strengths)
    close(applied(LowPass(grid, order, strengths).change, grid, nodal), H @ nodal - nodal, 1e-13, scale=4.0)


@every_grid
@pytest.mark.parametrize("order", [1, 8])
def test_the_low_pass_keeps_constants_and_sums(box, order):
    grid, *_ = box_of(box)
    change = LowPass(grid, order, np.ones(grid.dim)).change
    ones = applied(change, grid, np.full((grid.node_count, 2), 3.7))
    close(ones, np.zeros_like(ones), 1e-14, scale=3.7)
    nodal = values(grid.node_count, 2)
    close(applied(change, grid, nodal).sum(axis=0), np.zeros(2), 1e-13, scale=np.abs(nodal).sum())


@pytest.mark.parametrize("order", [1, 4, 8])
def test_at_full_strength_nothing_is_left_of_the_shortest_wave_and_without_any_all_of_it(order):
    grid = Grid((8, 6), (1.0, 1.0), MPI.COMM_SELF)
    i, j = np.indices(grid.cells)
    for wave, strengths in (((-1.0) ** i, [1.0, 0.0]), ((-1.0) ** j, [0.0, 1.0]), ((-1.0) ** (i + j), [1.0, 0.2])):
        nodal = wave.reshape(-1, 1)
        close(applied(LowPass(grid, order, np.array(strengths)).change, grid, nodal), -nodal, 1e-14)
    nodal = values(grid.node_count, 1)
    assert not applied(LowPass(grid, order, np.zeros(2)).change, grid, nodal).any()


@every_dimension
def test_a_higher_order_leaves_long_waves_more_of_themselves(dim):
    cells, length = {1: (24,), 2: (24, 3), 3: (24, 2, 3)}[dim], (1.0, 1.0, 1.0)[:dim]
    grid = Grid(cells, length, MPI.COMM_SELF)
    wave = np.broadcast_to(np.sin(2 * np.pi * np.arange(24) / 24).reshape(-1, *[1] * (dim - 1)), cells)
    losses = [
        np.abs(applied(LowPass(grid, p, np.ones(dim)).change, grid, wave.reshape(-1, 1).copy())).max()
        for p in (1, 2, 4)
    ]
    close(losses, [np.sin(np.pi / 24) ** (2 * p) for p in (1, 2, 4)], 1e-10)
    assert losses[2] < 1e-4 * losses[0]

"""B-splines of every degree by `Mapping` and its loops, against the recursion of Cox and de Boor as dense matrices."""

from functools import cache

import numpy as np
import pytest
from mpi4py import MPI

from dense_helpers import GRIDS, close, few_cases, pattern
from mpipic.kernels import spline
from mpipic.mapping.mapping import Mapping
from mpipic.mesh.grid import Grid
from scheme_helpers import matrix_of
from serial_helpers import ghosted, on_nodes, values
from spline_helpers import DEGREES, Splines, cardinal, cardinal_slope

BREAKS = {"at": 0.0, "left of": -9e-11, "farther left of": -1.1e-10, "right of": 9e-11, "far left of": -1e-6}
"""Places near a breakpoint, in cells; those within 1e-10 to its left count as on it."""


def _near_breaks(cells, rng):
    """Every node and every middle between two, from a little to the left to a little to the right of it."""
    count = len(BREAKS) * 6 * int(np.prod(cells))
    offsets = rng.choice(list(BREAKS.values()), (count, len(cells)))
    return np.mod(0.5 * rng.integers(0, 2 * np.array(cells), (count, len(cells))) + offsets, cells)


def place(name, cells, length):
    """Positions (n, d) of a pattern; near breakpoints not rounded to multiples of 2^-40 cells, as the others are."""
    if name != "near breaks":
        return pattern(name, cells, length)
    return _near_breaks(np.array(cells), np.random.default_rng(2)) * (np.array(length) / np.array(cells))


NAMES = ["random", "on nodes", "near breaks", "few", "one", "all in one cell"]

every_basis = pytest.mark.parametrize("basis", DEGREES)
any_case = pytest.mark.parametrize(("basis", "box", "name"), few_cases(DEGREES, names=NAMES))
every_dimension = pytest.mark.parametrize("dim", [1, 2, 3])


@cache
def case(basis, box, name, weighted=False):
    cells, length = GRIDS[box]
    position = place(name, cells, length)
    weight = np.random.default_rng(4).uniform(0.1, 3.0, len(position)) if weighted else None
    grid = Grid(cells, length, MPI.COMM_SELF, basis)
    return grid, Splines(basis, cells, length, position, weight), Mapping(grid, position, weight)


# ---------------------------------------------------------------- one axis

PLACES = [*(base + offset for base in (0.0, 0.5, 1.0) for offset in BREAKS.values()), 0.25, 1 / 3, 0.7, 2.0**-60]
PLACES = [x for x in PLACES if 0 <= x < 1] + [1.0 - 2.0**-53]


def weights_at(degree, x, inverse_h=2.5):
    """The nodes that a particle at local coordinate x touches, as offsets, its weights there, and its slopes."""
    w, s = np.full(4, np.nan), np.full(4, np.nan)
    offset = spline.weights(degree, x, w)
    spline.slopes(degree, x, inverse_h, s)
    assert np.isnan(w[degree + 1 :]).all() and np.isnan(s[degree + 1 :]).all()
    return offset + np.arange(degree + 1), w[: degree + 1], s[: degree + 1]


@every_basis
def test_weights_and_slopes_along_an_axis_are_those_of_the_recursion(basis):
    degree = DEGREES[basis]
    half = 0.5 * (degree + 1)
    for x in PLACES:
        nodes, w, s = weights_at(degree, x)
        piece = (1.0 if x < 0.5 - 1e-10 else 2.0) if degree == 2 else half
        close(w, cardinal(degree, x - nodes + half, piece - nodes), 1e-14)
        close(s, cardinal_slope(degree, x - nodes + half, piece - nodes) * 2.5, 1e-14)
        beyond = np.array([nodes[0] - 1, nodes[-1] + 1])
        close(cardinal(degree, x - beyond + half, piece - beyond), np.zeros(2), scale=1.0)


@every_basis
def test_weights_add_up_to_one_and_have_the_place_as_their_mean(basis):
    for x in PLACES:
        nodes, w, s = weights_at(DEGREES[basis], x)
        assert w.sum() == pytest.approx(1.0, abs=4e-16) and np.all(w >= 0.0), x
        assert w @ nodes == pytest.approx(x, abs=4e-16)
        assert s.sum() == pytest.approx(0.0, abs=1e-15) and s @ nodes == pytest.approx(2.5, abs=4e-15), x


@pytest.mark.parametrize("offset, side", {0.0: 0, -9e-11: 0, 1e-6: 0, -1.1e-10: -1, -1e-6: -1}.items())
def test_halfway_between_nodes_a_quadratic_turns_to_the_node_on_the_right(offset, side):
    """Within 1e-10 to the left as well, so that rounding does not decide."""
    assert spline.weights(2, 0.5 + offset, np.empty(4)) == side


# ---------------------------------------------------------------- in any dimension


@any_case
def test_sums_and_means_are_the_dense_ones(basis, box, name):
    grid, dense, mapping = case(basis, box, name)
    q = values(mapping.count, 2)
    close(on_nodes(grid, mapping.row_sums), dense.d)
    close(on_nodes(grid, mapping.sums(q)), dense.phi.T @ q, scale=dense.d.max() * np.abs(q).max())
    means = on_nodes(grid, mapping.p2g(q[:, 0]))
    weighty = dense.d > 1e-3 * dense.d.max()
    close(means[weighty], (dense.S @ q[:, 0])[weighty], scale=np.abs(q).max())
    assert np.all(means[~dense.seen] == 0.0)


@any_case
def test_particles_see_nodal_values_and_slopes_as_the_dense_matrices_say(basis, box, name):
    grid, dense, mapping = case(basis, box, name)
    nodal = values(grid.node_count, grid.dim) * grid.h
    close(mapping.g2p(ghosted(grid, nodal)), dense.phi @ nodal)
    close(mapping.g2p(ghosted(grid, nodal[:, 0])), dense.phi @ nodal[:, 0])
    divergence = sum(D @ column for D, column in zip(dense.D, nodal.T))
    close(mapping.divergence(ghosted(grid, nodal)), divergence, scale=grid.dim * 4.0)
    slopes = mapping.gradient(ghosted(grid, nodal[:, 0]))
    for axis, D in enumerate(dense.D):
        close(slopes[:, axis], D @ nodal[:, 0], scale=np.abs(nodal).max() * grid.inverse_h[axis])


@any_case
def test_the_gram_matrix_is_the_dense_one(basis, box, name):
    grid, dense, mapping = case(basis, box, name)
    nodal = values(grid.node_count, 2)
    close(on_nodes(grid, mapping.gram.apply(ghosted(grid, nodal))), dense.G @ nodal, scale=dense.d.max() * 4.0)
    close(matrix_of(grid, mapping), dense.G)


@every_basis
@pytest.mark.parametrize("box", ["1D", "2D, one cell across", "2D, aspect 1e6", "3D"])
def test_what_particles_count_weighs_sums_means_and_the_gram_matrix(basis, box):
    grid, dense, mapping = case(basis, box, "random", weighted=True)
    q, nodal = values(mapping.count, 2), values(grid.node_count, 1)
    close(on_nodes(grid, mapping.row_sums), dense.d)
    close(on_nodes(grid, mapping.sums(q)), dense.transposed @ q, scale=dense.d.max() * 4.0)
    close(on_nodes(grid, mapping.p2g(q)), dense.S @ q, 1e-10, scale=4.0)
    close(on_nodes(grid, mapping.gram.apply(ghosted(grid, nodal))), dense.G @ nodal, scale=dense.d.max() * 4.0)
    close(matrix_of(grid, mapping), dense.G)
    plain = case(basis, box, "random")[1]
    assert np.abs(plain.G - dense.G).max() > 0.1


BOXES = {1: ((9,), (1.3,)), 2: ((7, 8), (1.0, 2.5)), 3: ((6, 5, 7), (1.0, 0.8, 1.7))}


@every_basis
@every_dimension
@pytest.mark.parametrize("name", ["random", "near breaks"])
def test_products_of_linear_functions_are_reproduced_with_their_slopes(basis, dim, name):
    """Away from the seam of the period, where such a function jumps."""
    cells, length = BOXES[dim]
    grid = Grid(cells, length, MPI.COMM_SELF, basis)
    position = place(name, cells, length)
    mapping = Mapping(grid, position)
    h = np.array(grid.h)
    away = ((position > 1.5 * h) & (position < np.array(length) - 2.5 * h)).all(axis=1)
    assert away.sum() > 5
    axes = np.meshgrid(*(np.arange(n) * step for n, step in zip(cells, h)), indexing="ij")
    nodal = ghosted(grid, np.prod(np.stack(axes) + 0.2, axis=0).ravel())
    factors = position + 0.2
    close(mapping.g2p(nodal)[away], np.prod(factors, axis=1)[away], 1e-9 if name == "near breaks" else 1e-13)
    slopes = mapping.gradient(nodal)
    for axis in range(dim):
        wanted = np.prod(np.delete(factors, axis, axis=1), axis=1)
        close(slopes[away, axis], wanted[away], 1e-9 if name == "near breaks" else 1e-13)


@every_basis
@pytest.mark.parametrize("box", ["1D, two cells", "2D, aspect 1e6", "3D"])
@pytest.mark.parametrize("name", ["near breaks", "few"])
def test_constants_have_themselves_as_values_and_no_slopes(basis, box, name):
    grid, _, mapping = case(basis, box, name)
    ones = ghosted(grid, np.ones(grid.node_count))
    close(mapping.g2p(ones), np.ones(mapping.count), 1e-14)
    slopes = mapping.gradient(ones) * grid.h
    close(slopes, np.zeros_like(slopes), 1e-14, scale=1.0)
    assert on_nodes(grid, mapping.row_sums).sum() == pytest.approx(mapping.count, rel=1e-13)

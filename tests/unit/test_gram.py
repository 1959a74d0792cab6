"""The Gram matrix as PETSc sees it, the stencils that precondition it, and first guesses."""

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from dense_helpers import GRIDS, Dense, close, few_cases, pattern
from mpipic.filters import ExactFilter
from mpipic.mapping.gram_stencil import GramStencil, Penalty
from mpipic.mapping.mapping import Mapping
from mpipic.mapping.mass import LeastSquaresMass
from mpipic.mapping.preconditioner import TensorPreconditioner, inverse_stencil
from mpipic.mapping.solver import Series
from mpipic.mesh.grid import Grid
from serial_helpers import case, ghosted, grid_of, on_nodes, values
from spline_helpers import Splines

any_case = pytest.mark.parametrize(("box", "name"), few_cases())
roomy = pytest.mark.parametrize("box", ["1D", "2D", "3D"])


def mapped(box, name):
    grid, position, dense = case(box, name)
    return Mapping(grid, position), dense


def to_petsc(grid):
    """Own nodes x fastest, as PETSc numbers them, by their number in `dense_helpers`."""
    return np.arange(grid.node_count).reshape(grid.cells).T.ravel()


def times(operation, vectors):
    """A PETSc shell's operation on the columns of `vectors`."""
    x, y = PETSc.Vec().createSeq(len(vectors)), PETSc.Vec().createSeq(len(vectors))
    result = np.empty_like(vectors)
    for k, column in enumerate(vectors.T):
        x.setArray(column)
        operation(None, x, y)
        result[:, k] = y.getArray()
    return result


def scaled_gram(matrix, dense):
    """r⁻¹ G r⁻¹ in PETSc's numbering, and ones on the diagonal of nodes that no particle sees."""
    order = to_petsc(matrix.grid)
    return matrix.scale[:, None] * dense.G[np.ix_(order, order)] * matrix.scale + np.diag(~dense.seen[order] * 1.0)


# ---------------------------------------------------------------- the matrix


@any_case
def test_the_stencil_times_a_vector_is_the_scaled_gram_matrix_times_it(box, name):
    mapping, dense = mapped(box, name)
    matrix = GramStencil(mapping)
    assert matrix.refresh()
    n = mapping.grid.node_count
    close(times(matrix.mult, np.eye(n)), scaled_gram(matrix, dense), scale=1.0)


@pytest.mark.parametrize(("box", "name"), few_cases(names=("random", "few", "on nodes")))
def test_assembled_entries_are_those_of_the_stencil(box, name):
    mapping, dense = mapped(box, name)
    matrix, n = GramStencil(mapping), mapping.grid.node_count
    matrix.refresh()
    assembled = PETSc.Mat().createAIJ((n, n), nnz=n, comm=PETSc.COMM_SELF)
    for _ in range(2):  # the second time, over what is there
        matrix.assemble(assembled)
        close(assembled.getValues(range(n), range(n)), scaled_gram(matrix, dense), scale=1.0)


@pytest.mark.parametrize("box", ["1D", "2D, aspect 1e6", "3D"])
@pytest.mark.parametrize("name", ["random", "few", "one", "on nodes"])
def test_the_scale_is_the_root_of_the_diagonal_and_zero_where_no_particle_is(box, name):
    """On grids of three cells an axis and more, where no node is its own neighbour."""
    mapping, dense = mapped(box, name)
    matrix, order = GramStencil(mapping), to_petsc(mapping.grid)
    matrix.refresh()
    close(matrix.root, np.sqrt(np.diag(dense.G)[order]))
    seen = dense.seen[order]
    close(matrix.scale[seen] * matrix.root[seen], np.ones(seen.sum()))
    assert not matrix.scale[~seen].any() and np.array_equal(matrix.unseen, np.flatnonzero(~seen))


@roomy
def test_the_stencil_follows_its_mapping_and_only_where_it_has_moved(box):
    mapping, _ = mapped(box, "random")
    matrix, n = GramStencil(mapping), mapping.grid.node_count
    matrix.refresh()
    first = times(matrix.mult, np.eye(n))
    matrix.diagonals[1:] = 0.0
    assert not matrix.refresh() and not matrix.diagonals[1:].any()
    cells, length = GRIDS[box]
    position = pattern("random", cells, length, seed=9)
    mapping.update(position)
    assert matrix.refresh()
    moved = times(matrix.mult, np.eye(n))
    close(moved, scaled_gram(matrix, Dense(cells, length, position)), scale=1.0)
    assert np.abs(moved - first).max() > 0.1


def test_a_matrix_larger_than_what_is_taken_at_once_is_applied_whole():
    cells, length = (90, 50), (1.0, 1.0)
    grid = grid_of(cells, length)
    mapping = Mapping(grid, pattern("random", cells, length))
    matrix = GramStencil(mapping)
    matrix.refresh()
    nodal = values(grid.node_count)
    order = to_petsc(grid)
    wanted = on_nodes(grid, mapping.gram.apply(ghosted(grid, nodal)))
    result = times(matrix.mult, (nodal[order] * matrix.root)[:, None])[:, 0]
    close(result * matrix.root, wanted[order], 1e-13)


# ---------------------------------------------------------------- one product, three forms


def spline_mapping(basis, dim, per_cell=4, weight=False):
    """A mapping of random particles, its dense matrices, and nodal values."""
    cells, length = {1: ((12,), (1.0,)), 2: ((6, 5), (1.5, 1.0)), 3: ((4, 3, 4), (1.0, 1.5, 1.0))}[dim]
    rng = np.random.default_rng(3)
    position = rng.random((per_cell * int(np.prod(cells)), dim)) * length
    weights = 0.5 + rng.random(len(position)) if weight else None
    mapping = Mapping(Grid(cells, length, MPI.COMM_SELF, basis), position, weights)
    return mapping, Splines(basis, cells, length, position, weights)


@pytest.mark.parametrize("weight", [False, True])
@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("basis", ["linear", "quadratic", "cubic"])
def test_the_product_is_the_gram_matrix_s_in_every_form(basis, dim, weight):
    mapping, dense = spline_mapping(basis, dim, weight=weight)
    nodal, grid = values(mapping.grid.node_count, 2, 3), mapping.grid
    assembled = []
    for _ in range(3):  # six columns each time
        product = on_nodes(grid, mapping.gram.apply(ghosted(grid, nodal)))
        wanted = (dense.G @ nodal.reshape(len(nodal), -1)).reshape(nodal.shape)
        close(product, wanted, 1e-13)
        assembled.append(mapping.gram.assembled)
    assert assembled[-1] == (basis != "linear")


def test_the_stencil_is_assembled_when_columns_enough_follow_and_then_at_once_at_every_position():
    mapping, _ = spline_mapping("cubic", 3)
    column = ghosted(mapping.grid, values(mapping.grid.node_count, 1))
    forms = []
    for _ in range(12):
        mapping.gram.apply(column)
        forms.append(mapping.gram.assembled)
    assert not forms[0] and forms[-1] and forms == sorted(forms), "passes first, then the stencil"
    mapping.update(np.random.default_rng(8).random((192, 3)))
    mapping.gram.apply(column)
    assert mapping.gram.assembled
    mapping.update(np.random.default_rng(9).random((192, 3)))
    mapping.gram.apply(column)
    assert not mapping.gram.assembled, "there was one column at the positions before"


def test_all_who_solve_with_the_matrix_share_its_stencil():
    mapping, _ = spline_mapping("quadratic", 2)
    filter_, mass = ExactFilter(mapping, 1e-12), LeastSquaresMass(mapping, 1e-9)
    assert filter_.solver.krylov.matrix is mass.solver.matrix is mapping.gram.stencil
    assert (filter_.solver.prefix, mass.solver.prefix) == ("filter_", "mass_")
    assert (filter_.solver.tolerance, mass.solver.tolerance) == (1e-12, 1e-9)
    penalised = LeastSquaresMass(mapping, 1e-9, Penalty(0.1, 2))
    assert penalised.solver.matrix is not mapping.gram.stencil


# ---------------------------------------------------------------- the preconditioner


@any_case
def test_the_preconditioner_is_symmetric_and_positive_definite_on_every_pattern(box, name):
    """But on nodes that no particle sees, which it leaves at zero."""
    mapping, dense = mapped(box, name)
    matrix = GramStencil(mapping)
    matrix.refresh()
    preconditioner = TensorPreconditioner(matrix)
    preconditioner.refresh()
    applied = times(preconditioner.apply, np.eye(mapping.grid.node_count))
    seen = dense.seen[to_petsc(mapping.grid)]
    assert not applied[~seen].any()
    inner = applied[np.ix_(seen, seen)]
    close(inner, inner.T, 1e-14)
    assert np.linalg.eigvalsh(inner).min() > 0.01


@roomy
@pytest.mark.parametrize("name", ["lattice", "jittered", "random", "crowd"])
def test_the_preconditioner_brings_the_spectrum_together(box, name):
    cells, length, spread = {
        "1D": ((16,), (1.0,), 3.0), "2D": ((8, 9), (1.0, 2.0), 5.0), "3D": ((5, 4, 6), (1.0, 1.0, 1.0), 7.0)
    }[box]  # fmt: skip
    mapping = Mapping(grid_of(cells, length), pattern(name, cells, length))
    matrix = GramStencil(mapping)
    matrix.refresh()
    preconditioner = TensorPreconditioner(matrix)
    preconditioner.refresh()
    gram = times(matrix.mult, np.eye(mapping.grid.node_count))
    eigenvalues = np.linalg.eigvals(times(preconditioner.apply, gram)).real
    assert eigenvalues.max() / eigenvalues.min() < min(spread, 0.7 * np.linalg.cond(gram))


def symbols(coupling):
    """λ(θ) of tridiag(s, 1, s), and the symbol of the stencil that nearly inverts it, at points round the circle."""
    weights = inverse_stencil(np.array([coupling]), 2)
    assert weights.shape == (3,)
    theta = 2.0 * np.pi * np.arange(256) / 256
    cosines = np.cos(theta[:, None] * np.arange(3))
    return 1.0 + 2.0 * coupling * cosines[:, 1], cosines @ (weights * (1.0, 2.0, 2.0)), cosines


COUPLINGS = [0.0, 1e-12, 0.01, 0.1, 0.2, 0.25, 0.3, 0.4, 0.45]


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_the_short_inverse_is_nearly_as_good_as_the_best_polynomial(coupling):
    """Of degree 2, by Chebyshev: |1 - λ p(λ)| <= 1 / T₃(1 / 2s). Least squares are within a factor 1.5 of that."""
    spectrum, inverse, _ = symbols(coupling)
    best = 1.0 / np.polynomial.chebyshev.Chebyshev.basis(3)(1.0 / (2.0 * coupling)) if coupling else 0.0
    assert np.abs(1.0 - spectrum * inverse).max() <= 1.5 * best + 1e-14


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_the_short_inverse_is_the_best_of_its_reach_in_the_mean_square(coupling):
    """What is left is orthogonal to every change."""
    spectrum, inverse, cosines = symbols(coupling)
    assert np.abs(((1.0 - spectrum * inverse) * spectrum) @ cosines).max() < 1e-12 * len(spectrum)


@pytest.mark.parametrize("coupling", [*COUPLINGS, 0.49, 0.4999, 0.5, 0.51, 0.6, -0.1])
def test_the_short_inverse_is_positive_definite_whatever_the_coupling(coupling):
    assert symbols(coupling)[1].min() > 0.1


@pytest.mark.parametrize("reach", [2, 5, 8])
@pytest.mark.parametrize("far", [1, 3, 8])
def test_it_is_so_for_any_reach_and_couplings_that_no_matrix_of_particles_has(reach, far):
    theta = 2.0 * np.pi * np.arange(512) / 512
    cosines = 2.0 * np.cos(theta[:, None] * np.arange(9))
    cosines[:, 0] = 1.0
    for couplings in np.random.default_rng(far).uniform(-1.0, 1.0, (50, far)):
        inverse = cosines[:, : reach + 1] @ inverse_stencil(couplings, reach)
        largest = (cosines[:, : far + 1] @ np.concatenate([[1.0], couplings])).max()
        assert inverse.min() > 0.05 / largest


def test_the_short_inverse_of_nothing_coupled_is_the_identity():
    close(inverse_stencil(np.zeros(1), 2), [1.0, 0.0, 0.0], 1e-15)


# ---------------------------------------------------------------- guesses


def test_the_next_of_a_series_is_extrapolated_from_up_to_two_earlier():
    """Zeros from none, the same from one, a straight line through two; then times the factors."""
    earlier, out, factors = Series(3), np.full(3, np.nan), np.array([1.0, 2.0, -1.0])
    a, b, c = (np.array(row) for row in ([1.0, 2.0, 3.0], [5.0, -1.0, 0.5], [0.25, 7.0, 7.0]))
    for newest, wanted in ((None, np.zeros(3)), (a, a), (b, 2 * b - a), (c, 2 * c - b), (c, c), (a, 2 * a - c)):
        if newest is not None:
            earlier.append(newest)
        earlier.extrapolate(factors, 0.5, out)
        assert np.array_equal(out, 0.5 * factors * wanted)

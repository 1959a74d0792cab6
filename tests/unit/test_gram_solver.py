"""What the solver with the Gram matrix promises: options, sizes, series, and singular matrices."""

from itertools import product

import numpy as np
import pytest
from petsc4py import PETSc

from covering_helpers import covering
from dense_helpers import GRIDS, Dense, close, few_cases, pattern
from mpipic.errors import NotConverged
from mpipic.filters import ExactFilter
from mpipic.mapping.mapping import Mapping
from mpipic.mapping.solver import GramSolver
from serial_helpers import case, ghosted, grid_of, on_nodes, values

ONCE = ("none", "cholesky", "ilu", "icc", "gamg", "sor")
PRECONDITIONED = [*product(("jacobi", "lu"), ("1D", "2D", "3D")), *product(ONCE, ("2D",))]
roomy = pytest.mark.parametrize("box", ["1D", "2D", "3D"])


def mapped(box, name):
    grid, position, dense = case(box, name)
    return Mapping(grid, position), dense


@pytest.fixture
def options():
    """A function that sets PETSc options of the solver by name; they are gone after the test."""
    chosen, names = PETSc.Options("filter_"), []

    def choose(**settings):
        for name, value in settings.items():
            chosen[name] = value
            names.append(name)

    yield choose
    for name in names:
        chosen.delValue(name)


def noise(dense, *shape, seed=4):
    return values(len(dense.phi), *shape, seed=seed)


@roomy
def test_a_solver_that_runs_out_of_iterations_says_how_far_it_came(options, box):
    mapping, dense = mapped(box, "random")
    options(ksp_max_it=1)
    with pytest.raises(NotConverged, match=r"residual \d\.\d*(e-\d+)? after 1 iterations .*asked for is 1e-10 of"):
        ExactFilter(mapping).apply(noise(dense))


def test_options_are_read_when_a_filter_is_first_used(options):
    """And so the fixture of these tests leaves nothing behind."""
    mapping, dense = mapped("2D", "random")
    options(ksp_max_it=1)
    limited = ExactFilter(mapping)
    with pytest.raises(NotConverged):
        limited.apply(noise(dense))
    PETSc.Options("filter_").delValue("ksp_max_it")
    with pytest.raises(NotConverged):
        limited.apply(noise(dense))
    close(ExactFilter(mapping).apply(noise(dense)), dense.projection() @ noise(dense), 1e-9)


@pytest.mark.parametrize(("pc", "box"), PRECONDITIONED)
def test_any_preconditioner_of_petsc_gives_the_same_answer(options, box, pc):
    """Those that need matrix entries get them, anew where particles have moved."""
    mapping, _ = mapped(box, "jittered")
    options(pc_type=pc)
    filter_ = ExactFilter(mapping, tolerance=1e-12)
    cells, length = GRIDS[box]
    for seed in (0, 7):
        position = pattern("jittered", cells, length, seed=seed)
        mapping.update(position)
        dense = Dense(cells, length, position)
        q = noise(dense, 2)
        close(filter_.apply(q), dense.projection() @ q, 1e-9)
        assert filter_.solver.krylov.system(1).ksp.getPC().getType() == pc
        assert filter_.iterations <= (2 if pc in ("lu", "cholesky") else 60)


@pytest.mark.parametrize("box", GRIDS)
def test_entries_for_preconditioners_are_right_on_one_and_two_cells_too(options, box):
    """With a factorisation of the right matrix there is nothing left to iterate."""
    mapping, dense = mapped(box, "jittered")
    options(pc_type="lu")
    filter_ = ExactFilter(mapping, tolerance=1e-12)
    close(filter_.apply(noise(dense)), dense.projection() @ noise(dense), 1e-9)
    assert filter_.iterations <= 2


@pytest.mark.parametrize(
    ("box", "pc", "name"), covering(2, ("1D", "2D", "3D"), ("jacobi", "none"), ("few", "one", "all in one cell"))
)
def test_preconditioners_without_entries_serve_singular_matrices_too(options, box, pc, name):
    mapping, dense = mapped(box, name)
    options(pc_type=pc)
    close(ExactFilter(mapping, tolerance=1e-12).apply(noise(dense)), dense.projection() @ noise(dense), 1e-9)


def test_other_krylov_methods_can_be_chosen(options):
    mapping, dense = mapped("2D", "random")
    options(ksp_type="gmres", ksp_norm_type="preconditioned")
    filter_ = ExactFilter(mapping, tolerance=1e-12)
    close(filter_.apply(noise(dense)), dense.projection() @ noise(dense), 1e-9)
    assert filter_.solver.krylov.system(1).ksp.getType() == "gmres"


@pytest.mark.parametrize(("box", "name"), few_cases())
def test_zero_gives_zero_at_no_cost(box, name):
    mapping, dense = mapped(box, name)
    filter_ = ExactFilter(mapping)
    assert np.array_equal(filter_.apply(np.zeros((len(dense.phi), 2))), np.zeros((len(dense.phi), 2)))
    assert filter_.iterations == 0


@pytest.mark.parametrize(
    ("box", "name", "factor"),
    covering(2, ("1D", "2D", "3D"), ("random", "lattice", "few"), (1e-307, 1e-300, 1e-170, 1e-30, 1e150, 1e250, 1e300)),
)
def test_values_of_any_size_are_filtered_alike(box, name, factor):
    """Products of two such values under- or overflow."""
    mapping, dense = mapped(box, name)
    q = noise(dense)
    filter_ = ExactFilter(mapping)
    plain = filter_.apply(q)
    with np.errstate(over="raise", divide="raise", invalid="raise"):
        scaled = filter_.apply(q * factor)
    close(scaled / factor, plain, 1e-9)
    assert np.abs(plain).max() > 0.1


@pytest.mark.parametrize("factor", [1e-300, 1e300])
def test_a_series_may_change_its_size_by_any_factor(factor):
    mapping, dense = mapped("2D", "random")
    filter_ = ExactFilter(mapping)
    sums = ghosted(mapping.grid, dense.phi.T @ noise(dense))
    wanted = on_nodes(mapping.grid, filter_.coefficients(sums))
    for size in (1.0, factor, 1.0, 1.0 / factor, 1.0):
        answer = on_nodes(mapping.grid, filter_.coefficients(sums * size, series="any")) / size
        close(answer, wanted, 1e-9)


@pytest.mark.parametrize(
    ("box", "bad", "where"), covering(2, ("1D", "2D", "3D"), (np.nan, np.inf, -np.inf), (0, 13, -1))
)
def test_what_is_no_number_makes_its_column_nan_and_no_other(box, bad, where):
    mapping, dense = mapped(box, "random")
    q = noise(dense, 3)
    q[where, 1] = bad
    filter_ = ExactFilter(mapping)
    filtered = filter_.apply(q)
    assert np.all(np.isnan(filtered[:, 1]))
    close(filtered[:, [0, 2]], dense.projection() @ q[:, [0, 2]], 1e-9)


def test_a_value_that_is_no_number_is_not_remembered_in_a_series():
    mapping, dense = mapped("2D", "random")
    filter_, grid = ExactFilter(mapping), mapping.grid
    sums = ghosted(grid, dense.phi.T @ noise(dense))
    wanted = on_nodes(grid, filter_.coefficients(sums))
    for _ in range(2):
        assert np.all(np.isnan(on_nodes(grid, filter_.coefficients(sums * np.nan, series="any"))))
        close(on_nodes(grid, filter_.coefficients(sums, series="any")), wanted, 1e-9)


@roomy
def test_without_a_series_equal_arguments_give_equal_results(box):
    mapping, dense = mapped(box, "random")
    filter_, grid = ExactFilter(mapping), mapping.grid
    q = noise(dense)
    first, iterations = filter_.apply(q), filter_.iterations
    for series in ("any", None):
        filter_.coefficients(ghosted(grid, dense.phi.T @ q), series=series)
    assert np.array_equal(filter_.apply(q), first) and filter_.iterations == iterations
    assert np.array_equal(ExactFilter(mapping).apply(q), first)


@roomy
def test_in_a_series_what_has_been_solved_before_costs_next_to_nothing(box):
    """The same again; then values on a straight line in time. Each column, and each series, is guessed by itself."""
    mapping, dense = mapped(box, "random")
    filter_, grid = ExactFilter(mapping), mapping.grid
    sums, change = (ghosted(grid, dense.phi.T @ noise(dense, 2, seed=seed)) for seed in (1, 2))
    filter_.coefficients(sums, series="any")
    first = filter_.iterations
    assert first > 4
    filter_.coefficients(sums, series="any")
    assert filter_.iterations <= 1
    filter_.coefficients(sums, series="other")
    assert filter_.iterations == first
    for time in (1, 2, 3):
        filter_.coefficients(sums + time * change, series="line")
    assert filter_.iterations <= 1
    answer = on_nodes(grid, filter_.coefficients(sums + 9 * change, series="line"))
    close(answer, on_nodes(grid, ExactFilter(mapping).coefficients(sums + 9 * change)), 1e-9)


@roomy
def test_a_series_goes_on_where_particles_move(box):
    mapping, dense = mapped(box, "jittered")
    filter_, grid = ExactFilter(mapping), mapping.grid
    cells, length = GRIDS[box]
    position = pattern("jittered", cells, length)
    for step in range(6):
        mapping.update(position + 0.03 * step * np.array(grid.h))
        dense = Dense(cells, length, np.mod(position + 0.03 * step * np.array(grid.h), length))
        q = np.cos(0.1 * step + np.arange(len(position)))
        answer = on_nodes(grid, filter_.coefficients(ghosted(grid, dense.phi.T @ q), series="any"))
        close(dense.phi @ answer, dense.projection() @ q, 1e-9, scale=1.0)


@pytest.mark.parametrize("name", ["few", "one", "coincident"])
@roomy
def test_a_series_may_be_long_and_fade_where_the_matrix_is_singular(box, name):
    """What G does not see of a guess stays in the answer: it must not outgrow what there is to solve."""
    mapping, _ = mapped(box, name)
    filter_, grid = ExactFilter(mapping), mapping.grid
    cells, length = GRIDS[box]
    position = pattern(name, cells, length)
    for step in range(300):
        moved = np.mod(position + 0.002 * step * np.array(grid.h), length)
        mapping.update(moved)
        q = 0.92**step * np.cos(0.01 * step + np.arange(len(position)))
        nodal = filter_.coefficients(mapping.sums(q), series="any")
        if step % 50 == 49:
            close(mapping.g2p(nodal), Dense(cells, length, moved).projection() @ q, 1e-8, scale=0.92**step)


@pytest.mark.parametrize("fraction", [1e-12, 1e-9, 3e-9, 1e-6, 1e-3, 1 - 1e-9])
def test_a_guess_that_positions_have_made_worthless_does_no_harm(fraction):
    """A node sees a particle with next to no weight, then with all of it, and so forth: its value is huge, then not."""
    cells, length = (1, 3), (1.0, 1.0)
    start = np.zeros((6, 2))
    start[5, 1] = 1.0 + fraction
    mapping = Mapping(grid_of(cells, length), start)
    filter_, q = ExactFilter(mapping), values(6)
    for step in range(12):
        position = np.mod(start + (0.0, 2.0 * step), 3.0) / (1.0, 3.0)
        mapping.update(position)
        answer = mapping.g2p(filter_.coefficients(mapping.sums(q + 0.1 * step), series="any"))
        close(answer, Dense(cells, length, position).projection() @ (q + 0.1 * step), 1e-9)


@pytest.mark.parametrize("centre", [0.5, 0.25, 1.5])
@pytest.mark.parametrize("box", [((2,), (1.0,)), ((2, 1), (1.0, 1.0)), ((4,), (1.0,))], ids=str)
def test_in_a_run_values_that_nodes_tell_apart_by_rounding_alone_are_neither_refused_nor_enlarged(box, centre):
    """Two places next to each other, and a difference between them: in G the distance is squared."""
    cells, length = box
    q = np.array([1.0, 1.0, 1.0, 1.0, 1.0, -5.0])
    for apart in (0.0, 1e-13, 1e-11, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6):
        coordinate = np.zeros((6, len(cells)))
        coordinate[:, 0] = centre
        coordinate[5, 0] += apart
        filter_ = ExactFilter(Mapping(grid_of(cells, length), coordinate / cells * length))
        filter_.strict = False
        assert np.linalg.norm(filter_.apply(q)) <= np.linalg.norm(q) * (1 + 1e-6), apart


def relative_errors(solver, dense, grid, right, **how):
    answer = on_nodes(grid, solver.solve(ghosted(grid, right), **how))
    wanted = np.linalg.pinv(dense.G) @ right
    return np.linalg.norm(dense.phi @ (answer - wanted), axis=0) / np.linalg.norm(dense.phi @ wanted, axis=0)


@roomy
def test_columns_of_any_size_and_shape_are_solved_together_each_to_its_own_tolerance(box):
    """Smooth and large beside a spike, beside nothing, beside noise that is small; in the iterations of the slowest."""
    mapping, dense = mapped(box, "random")
    nodes, tolerance = mapping.grid.node_count, 1e-6
    smooth = dense.G @ np.ones(nodes)
    right = np.stack([1e9 * smooth, np.eye(nodes)[3], np.zeros(nodes), 1e-9 * dense.phi.T @ noise(dense)], axis=1)
    solver = GramSolver(mapping, tolerance)
    alone = []
    for column in range(4):
        solver.solve(ghosted(mapping.grid, right[:, column]))
        alone.append(solver.iterations)
    with np.errstate(invalid="ignore"):
        errors = relative_errors(solver, dense, mapping.grid, right)
    assert solver.iterations <= max(alone) + 2 and min(alone) < max(alone)
    assert np.all(errors[[0, 1, 3]] < 3 * tolerance)
    assert not solver.solve(ghosted(mapping.grid, right))[:, 2].any()


@roomy
def test_the_components_of_a_vector_are_solved_relative_to_all_of_it(box):
    """Rounding in a component that is zero but for that is not iterated on; the other takes one iteration here."""
    mapping, dense = mapped(box, "lattice")
    smooth = dense.G @ np.ones(mapping.grid.node_count)
    right = np.stack([smooth, 1e-14 * dense.phi.T @ noise(dense)], axis=1)
    solver = GramSolver(mapping, 1e-9)
    apart = relative_errors(solver, dense, mapping.grid, right)
    slow = solver.iterations
    together = relative_errors(solver, dense, mapping.grid, right, quantities=(2,))
    assert solver.iterations <= 2 < slow
    assert apart.max() < 1e-8 and together[0] < 1e-8 < together[1]


@roomy
def test_a_column_that_is_no_number_leaves_the_rest_of_its_vector_alone(box):
    mapping, dense = mapped(box, "random")
    grid, right = mapping.grid, dense.phi.T @ noise(dense, 2)
    solver = GramSolver(mapping, 1e-12)
    wanted = on_nodes(grid, solver.solve(ghosted(grid, right), quantities=(2,)))
    right[0, 1] = np.nan
    answer = on_nodes(grid, solver.solve(ghosted(grid, right), quantities=(2,)))
    assert np.all(np.isnan(answer[:, 1]))
    close(answer[:, 0], wanted[:, 0], 1e-11)

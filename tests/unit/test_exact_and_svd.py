"""The two filters that are the orthogonal projection on what the nodes see: by a solve on nodes, and by SLEPc."""

from functools import cache
from itertools import product

import numpy as np
import pytest

from covering_helpers import covering
from dense_helpers import GRIDS, Dense, close, few_cases, pattern
from mpipic.filters import ExactFilter, LocalFilter, OrderFilter, SvdFilter
from mpipic.mapping.mapping import Mapping
from serial_helpers import case, grid_of, make, on_nodes, values

ROOMY = {"1D": ((24,), (1.3,)), **{box: GRIDS[box] for box in ("2D", "2D, aspect 1e6", "3D")}}
roomy = pytest.mark.parametrize("box", ROOMY)
KINDS, SPREAD = ("exact", "svd"), ("random", "jittered", "lattice")
spread = pytest.mark.parametrize("name", SPREAD)
both = pytest.mark.parametrize("kind", KINDS)


def projection_of(kind, mapping):
    return ExactFilter(mapping, tolerance=1e-12) if kind == "exact" else SvdFilter(mapping)


def roomy_case(box, name):
    cells, length = ROOMY[box]
    position = pattern(name, cells, length)
    return Mapping(grid_of(cells, length), position), Dense(cells, length, position)


@cache
def matrix_case(kind, box, name):
    """The filter as a matrix, filled column by column from the identity, and the dense matrices."""
    mapping, dense = roomy_case(box, name)
    return projection_of(kind, mapping).apply(np.eye(mapping.count)), dense


def noisy(dense, *shape, seed=4):
    """Noise on the particles, of which the nodes do not see more than half."""
    q = values(len(dense.phi), *shape, seed=seed)
    shares = [dense.null_space_share(column) for column in q.reshape(len(q), -1).T]
    assert min(shares) > 0.5, shares
    return q


# ---------------------------------------------------------------- one operator, three ways


@roomy
@spread
def test_exact_svd_and_a_dense_decomposition_are_one_operator(box, name):
    mapping, dense = roomy_case(box, name)
    q = noisy(dense, 2)
    exact, svd = ExactFilter(mapping).apply(q), SvdFilter(mapping).apply(q)
    size = np.abs(q).max()
    close(exact, svd, 1e-9, scale=size)
    close(exact, dense.projection() @ q, 1e-9, scale=size)
    close(svd, dense.projection() @ q, 1e-12, scale=size)
    assert np.abs(svd - q).max() > 0.1 and np.abs(svd - LocalFilter(mapping).apply(q)).max() > 0.1


@pytest.mark.parametrize(("kind", "box", "name"), covering(2, KINDS, ROOMY, SPREAD))
def test_the_operator_is_a_symmetric_projection(kind, box, name):
    projection, dense = matrix_case(kind, box, name)
    noisy(dense)
    close(projection, projection.T, 1e-10, scale=1.0)
    close(projection @ projection, projection, 1e-10, scale=1.0)
    assert np.trace(projection) == pytest.approx(np.linalg.matrix_rank(dense.phi), abs=1e-8)


@pytest.mark.parametrize(("kind", "box", "name"), covering(2, KINDS, ROOMY, SPREAD))
def test_what_the_nodes_see_stays_and_so_do_constants(kind, box, name):
    """S P = S, Φ survives, P 1 = 1."""
    projection, dense = matrix_case(kind, box, name)
    noisy(dense)
    close(dense.S @ projection, dense.S, 1e-10)
    close(projection @ dense.phi, dense.phi, 1e-10)
    close(projection.sum(axis=1), np.ones(len(projection)), 1e-10)


@pytest.mark.parametrize(("kind", "box", "name"), covering(2, KINDS, ROOMY, SPREAD))
def test_filtering_twice_is_filtering_once(kind, box, name):
    mapping, dense = roomy_case(box, name)
    filter_, q = projection_of(kind, mapping), noisy(dense)
    once = filter_.apply(q)
    close(filter_.apply(once), once, 1e-10)
    assert dense.null_space_share(once) < 1e-10
    assert np.linalg.norm(once) == pytest.approx(np.linalg.norm(q) * np.sqrt(1 - dense.null_space_share(q) ** 2))


# ---------------------------------------------------------------- any pattern


@pytest.mark.parametrize(("kind", "box", "name"), few_cases(KINDS))
def test_fewer_particles_than_nodes_coincident_ones_and_empty_cells_are_projected_too(kind, box, name):
    grid, position, dense = case(box, name)
    q = values(len(position), 2)
    filtered = projection_of(kind, Mapping(grid, position)).apply(q)
    close(filtered, dense.projection() @ q, 1e-9, scale=np.abs(q).max())


@both
@pytest.mark.parametrize("box", ["1D", "2D", "3D"])
def test_of_coincident_particles_the_mean_is_left(kind, box):
    grid, position, _ = case(box, "coincident")
    q = values(len(position))
    close(projection_of(kind, Mapping(grid, position)).apply(q), np.full(len(q), q.mean()), 1e-11, scale=1.0)


@both
@pytest.mark.parametrize("box", ["1D", "2D", "3D"])
def test_a_single_particle_keeps_its_value(kind, box):
    grid, position, _ = case(box, "one")
    close(projection_of(kind, Mapping(grid, position)).apply(np.array([3.7])), [3.7], 1e-11)


@both
def test_no_particles_at_all_are_nothing_to_filter(kind):
    mapping = Mapping(grid_of(*GRIDS["2D"]), np.empty((0, 2)))
    assert projection_of(kind, mapping).apply(np.empty(0)).shape == (0,)
    assert projection_of(kind, mapping).apply(np.empty((0, 3))).shape == (0, 3)


@pytest.mark.parametrize(("box", "name"), few_cases(names=("few", "one", "coincident", "all in one cell", "random")))
def test_nodes_that_no_particle_sees_get_exactly_zero(box, name):
    grid, position, dense = case(box, name)
    mapping = Mapping(grid, position)
    filter_ = ExactFilter(mapping)
    coefficients = on_nodes(grid, filter_.coefficients(mapping.sums(values(len(position), 2))))
    assert np.all(coefficients[~dense.seen] == 0.0)
    assert np.all(np.isfinite(coefficients)) and np.all(coefficients[dense.seen] != 0.0)


FRACTIONS = (0.0, 1e-16, 5e-11, 1e-9, 0.25, 0.5, 1 - 1e-9, 1 - 5e-11, 1 - 1e-12)


@pytest.mark.parametrize("kind", ["exact", "svd"])
def test_three_particles_of_which_two_coincide_are_projected_wherever_they_are(kind):
    """Nodes that see a particle with hardly any weight, and rows of S that are all but the same."""
    cells, length = (1, 6), (1.0, 1.0)
    for fraction, move in product(FRACTIONS, np.arange(12) / 2):
        position = np.zeros((3, 2))
        position[:, 1] = np.mod(np.array([0.0, 0.0, 1.0 + fraction]) + move, 6.0) / 6.0
        projection = projection_of(kind, Mapping(grid_of(cells, length), position)).apply(np.eye(3))
        close(projection, Dense(cells, length, position).projection(), 1e-9, scale=1.0)


# ---------------------------------------------------------------- against the series


@pytest.mark.parametrize("box", ["1D", "2D", "3D"])
@pytest.mark.parametrize("name", ["lattice", "jittered"])
def test_a_series_of_order_k_converges_to_exact(box, name):
    mapping, dense = roomy_case(box, name)
    q = noisy(dense)
    exact = make("exact", mapping).apply(q)
    away = [np.abs(OrderFilter(mapping, order=k).apply(q) - exact).max() for k in (1, 8, 64, 512)]
    assert away[0] > 0.1 and away[1] < away[0] and away[2] < away[1] and away[3] < 1e-5


# ---------------------------------------------------------------- particles of different weight


def weights_of(position, seed=2):
    """From 0.1 to 10, most of them near neither end."""
    return 10.0 ** np.random.default_rng(seed).uniform(-1.0, 1.0, len(position))


@pytest.mark.parametrize(("kind", "box", "name"), covering(2, KINDS, ("1D", "2D", "3D"), SPREAD))
def test_with_weights_the_projection_is_orthogonal_in_their_inner_product(kind, box, name):
    cells, length = ROOMY[box]
    position = pattern(name, cells, length)
    weight = weights_of(position)
    dense = Dense(cells, length, position, weight)
    noisy(dense)
    projection = projection_of(kind, Mapping(grid_of(cells, length), position, weight)).apply(np.eye(len(position)))
    close(projection, dense.projection(), 1e-9, scale=10.0)
    close(projection @ projection, projection, 1e-9, scale=10.0)
    close(weight[:, None] * projection, (weight[:, None] * projection).T, 1e-9, scale=10.0)
    close(dense.S @ projection, dense.S, 1e-9)
    assert np.abs(projection - Dense(cells, length, position).projection()).max() > 0.1


@pytest.mark.parametrize(
    ("kind", "box", "name"),
    covering(2, KINDS, ("1D", "2D", "3D"), ("few", "one", "coincident", "all in one cell", "crowd", "on nodes")),
)
def test_with_weights_any_pattern_is_projected_too(kind, box, name):
    cells, length = GRIDS[box]
    position = pattern(name, cells, length)
    weight, q = weights_of(position), values(len(position))
    filtered = projection_of(kind, Mapping(grid_of(cells, length), position, weight)).apply(q)
    close(filtered, Dense(cells, length, position, weight).projection() @ q, 1e-9, scale=10.0 * np.abs(q).max())


# ---------------------------------------------------------------- what it costs


def iterations_of(cells, position):
    """Of one application to noise, at the default tolerance."""
    filter_ = ExactFilter(Mapping(grid_of(cells, (1.0,) * len(cells)), position))
    filter_.apply(values(len(position)))
    assert filter_.tolerance == 1e-10 and filter_.facts()["iterations"] == filter_.iterations
    return filter_.iterations


@pytest.mark.parametrize("cells", [(64,), (32, 32), (10, 10, 10)], ids=str)
@pytest.mark.parametrize("per_axis", [2, 3])
@pytest.mark.parametrize("offset", [0.5, 0.3])
def test_a_lattice_takes_at_most_16_iterations(cells, per_axis, offset):
    axes = [(np.arange(per_axis * n) + offset) / (per_axis * n) for n in cells]
    position = np.stack([x.ravel() for x in np.meshgrid(*axes)], axis=1)
    assert 1 <= iterations_of(cells, position) <= 16


@pytest.mark.parametrize("cells", [(48, 48), (12, 12, 12)], ids=str)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_random_particles_take_at_most_40_iterations(cells, seed):
    dim = len(cells)
    position = np.random.default_rng(seed).random((2**dim * int(np.prod(cells)), dim))
    assert 1 <= iterations_of(cells, position) <= 40


def test_svd_keeps_its_basis_until_particles_move_and_exact_its_tolerance():
    grid, position, dense = case("2D", "random")
    mapping = Mapping(grid, position)
    svd, exact = SvdFilter(mapping), ExactFilter(mapping, tolerance=1e-4)
    rows = svd.rows
    q = noisy(dense)
    svd.apply(q)
    assert svd.rows is rows and svd.nbytes == rows.basis.nbytes and svd.facts() == rows.facts
    mapping.update(pattern("random", *GRIDS["2D"], seed=5))
    assert svd.rows is not rows
    mapping.update(position)
    rough = exact.apply(q)
    assert exact.facts() == {"iterations": exact.iterations, "tolerance": 1e-4, "factorised": False}
    assert exact.nbytes > 0
    assert 1e-9 < np.abs(rough - dense.projection() @ q).max() < 1e-2


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_shows_in_its_column_of_svd_and_in_no_other(bad):
    grid, position, dense = case("2D", "random")
    q = noisy(dense, 3)
    q[7, 1] = bad
    with np.errstate(invalid="ignore"):
        filtered = SvdFilter(Mapping(grid, position)).apply(q)
    assert not np.isfinite(filtered[:, 1]).any()
    close(filtered[:, [0, 2]], dense.projection() @ q[:, [0, 2]])

"""Mapping against the dense matrices, on every grid and pattern of particles."""

import numpy as np
import pytest
from mpi4py import MPI

from covering_helpers import covering
from dense_helpers import GRIDS, Dense, close, few_cases, pattern
from mpipic.mapping.mapping import Mapping
from mpipic.mesh.grid import Grid
from serial_helpers import EXACT, case, ghosted, grid_of, on_nodes, values

some_case = pytest.mark.parametrize(
    ("box", "name"), covering(2, ("1D", "2D, aspect 1e6", "3D"), ("random", "few", "on nodes"))
)
any_case = pytest.mark.parametrize(("box", "name"), few_cases())
every_dimension = pytest.mark.parametrize("dim", [1, 2, 3])


@any_case
def test_interpolation_is_the_matrix_phi(box, name):
    grid, position, dense = case(box, name)
    nodal = values(grid.node_count, 3)
    close(Mapping(grid, position).g2p(ghosted(grid, nodal)), dense.phi @ nodal, scale=np.abs(nodal).max())


@any_case
def test_sums_and_row_sums_are_the_transpose_of_phi(box, name):
    grid, position, dense = case(box, name)
    mapping, q = Mapping(grid, position), values(len(position), 2)
    close(on_nodes(grid, mapping.sums(q)), dense.phi.T @ q, scale=np.abs(q).max() * dense.d.max())
    close(on_nodes(grid, mapping.row_sums), dense.d)


@any_case
def test_nodal_means_are_the_matrix_s_and_zero_where_no_particle_is(box, name):
    grid, position, dense = case(box, name)
    q = values(len(position), 2)
    means = on_nodes(grid, Mapping(grid, position).p2g(q))
    close(means, dense.S @ q, scale=np.abs(q).max())
    assert np.all(means[~dense.seen] == 0.0)


@any_case
def test_gradients_are_the_matrices_d(box, name):
    grid, position, dense = case(box, name)
    nodal = values(grid.node_count)
    gradient = Mapping(grid, position).gradient(ghosted(grid, nodal))
    for axis in range(grid.dim):
        close(gradient[:, axis], dense.D[axis] @ nodal, scale=np.abs(nodal).max() / grid.h[axis])


@any_case
def test_the_divergence_is_the_sum_of_the_matrices_d(box, name):
    """On cells of aspect 1e6 too: the field along each axis is as large as the spacing, so that all axes count."""
    grid, position, dense = case(box, name)
    nodal = values(grid.node_count, grid.dim) * grid.h
    close(Mapping(grid, position).divergence(ghosted(grid, nodal)), dense.divergence(nodal), scale=grid.dim)


def test_few_particles_leave_nodes_empty_and_the_patterns_are_what_they_say():
    """Guards of the tests above."""
    _, _, few = case("3D", "few")
    assert 0 < few.seen.sum() < few.seen.size
    _, _, one = case("2D", "one")
    assert one.seen.sum() == 4
    _, position, _ = case("2D, aspect 1e6", "coincident")
    assert len(position) == 7 and len(np.unique(position, axis=0)) == 1


@some_case
def test_p2g_conserves_the_weighted_sum(box, name):
    grid, position, _ = case(box, name)
    mapping, q = Mapping(grid, position), values(len(position))
    total = np.sum(on_nodes(grid, mapping.row_sums) * on_nodes(grid, mapping.p2g(q)))
    assert total == pytest.approx(q.sum(), abs=1e-13 * np.abs(q).sum())


@some_case
def test_p2g_keeps_constants_where_particles_are(box, name):
    grid, position, dense = case(box, name)
    means = on_nodes(grid, Mapping(grid, position).p2g(np.full(len(position), 3.0)))
    close(means[dense.seen], np.full(dense.seen.sum(), 3.0), 1e-14)


@every_dimension
def test_one_column_and_many_are_mapped_alike(dim):
    cells, length = EXACT[dim]
    grid, position = grid_of(cells, length), pattern("random", cells, length)
    mapping, q = Mapping(grid, position), values(len(position), 4)
    nodal = mapping.p2g(q)
    assert nodal.shape == (grid.local_nodes, 4)
    for k in range(4):
        alone = mapping.p2g(q[:, k])
        assert alone.shape == (grid.local_nodes,)
        close(nodal[:, k], alone, 1e-15)
        close(mapping.g2p(nodal)[:, k], mapping.g2p(alone), 1e-15)


@every_dimension
def test_values_may_lie_in_memory_in_any_order_and_are_not_changed(dim):
    cells, length = EXACT[dim]
    grid, position = grid_of(cells, length), pattern("random", cells, length)
    mapping, q = Mapping(grid, np.asfortranarray(position)), values(len(position), 3)
    twisted = np.asfortranarray(np.repeat(q, 2, axis=0))[::2]
    before = twisted.copy()
    assert np.array_equal(mapping.p2g(twisted), mapping.p2g(q))
    assert np.array_equal(twisted, before)
    reverse = Mapping(grid, position[::-1])
    close(reverse.p2g(q[::-1]), mapping.p2g(q), 1e-13)


def test_whole_numbers_are_mapped_as_the_real_numbers_they_are():
    grid = grid_of(*EXACT[1])
    mapping = Mapping(grid, np.array([[0.3], [0.31]]))
    close(mapping.p2g(np.array([1, 2])), mapping.p2g(np.array([1.0, 2.0])), 0.0)


@every_dimension
def test_an_updated_mapping_is_that_of_the_new_positions(dim):
    cells, length = EXACT[dim]
    grid = grid_of(cells, length)
    first, second = (pattern("random", cells, length, seed) for seed in (1, 2))
    moved, fresh = Mapping(grid, first), Mapping(grid, second)
    q = values(len(second))
    assert not np.allclose(moved.p2g(q), fresh.p2g(q))
    moved.update(second)
    assert np.array_equal(moved.p2g(q), fresh.p2g(q))
    assert np.array_equal(moved.row_sums, fresh.row_sums)


@every_dimension
def test_positions_off_the_box_by_whole_periods_are_brought_into_it(dim):
    cells, length = EXACT[dim]
    grid, position = grid_of(cells, length), pattern("random", cells, length)
    q = values(len(position))
    close(Mapping(grid, position - 3 * np.array(length)).p2g(q), Mapping(grid, position).p2g(q), 1e-12)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_position_that_is_no_number_is_refused_by_name(bad):
    grid = grid_of(*EXACT[2])
    position = np.full((5, 2), 0.25)
    position[3, 1] = bad
    with pytest.raises(ValueError, match="position 3"):
        Mapping(grid, position)


def test_a_rank_without_particles_maps_zeros():
    grid = grid_of(*EXACT[2])
    mapping = Mapping(grid, np.empty((0, 2)))
    for shape in ((0,), (0, 3)):
        assert mapping.p2g(np.empty(shape)).shape == (grid.local_nodes, *shape[1:])
        assert not mapping.p2g(np.empty(shape)).any()
    assert mapping.g2p(grid.zeros(2)).shape == (0, 2)
    assert mapping.gradient(grid.zeros(3)).shape == (0, 3, 2)
    assert mapping.divergence(grid.zeros(2)).shape == (0,)


# ---------------------------------------------------------------- particles of different weight


def weighted_case(box, name):
    cells, length = GRIDS[box]
    position = pattern(name, cells, length)
    weight = 10.0 ** np.random.default_rng(2).uniform(-1.0, 1.0, len(position))
    return grid_of(cells, length), position, weight, Dense(cells, length, position, weight)


@some_case
def test_with_weights_sums_row_sums_and_means_are_the_weighted_matrices(box, name):
    grid, position, weight, dense = weighted_case(box, name)
    mapping, q = Mapping(grid, position, weight), values(len(position), 2)
    sums = on_nodes(grid, mapping.sums(q))
    close(sums, dense.phi.T @ (weight[:, None] * q), scale=np.abs(q).max() * dense.d.max())
    close(on_nodes(grid, mapping.row_sums), dense.d)
    means = on_nodes(grid, mapping.p2g(q))
    wanted = [np.average(q, axis=0, weights=weight * phi) for phi in dense.phi.T[dense.seen]]
    close(means[dense.seen], wanted, scale=np.abs(q).max())
    assert np.all(means[~dense.seen] == 0.0)
    close(mapping.p2g(q[:, 0]), mapping.p2g(q)[:, 0], 1e-15)


@some_case
def test_with_weights_the_gram_matrix_is_the_weighted_one(box, name):
    grid, position, weight, dense = weighted_case(box, name)
    mapping, nodal = Mapping(grid, position, weight), values(grid.node_count, 2)
    close(on_nodes(grid, mapping.gram.apply(ghosted(grid, nodal))), dense.G @ nodal, scale=dense.d.max())


@every_dimension
def test_what_nodes_give_to_particles_does_not_depend_on_weights(dim):
    cells, length = EXACT[dim]
    grid, position = grid_of(cells, length), pattern("random", cells, length)
    nodal = ghosted(grid, values(grid.node_count, dim))
    plain, weighted = Mapping(grid, position), Mapping(grid, position, np.full(len(position), 7.0))
    assert np.array_equal(weighted.g2p(nodal), plain.g2p(nodal))
    assert np.array_equal(weighted.gradient(nodal[:, 0].copy()), plain.gradient(nodal[:, 0].copy()))
    assert np.array_equal(weighted.divergence(nodal), plain.divergence(nodal))


@every_dimension
def test_equal_weights_are_as_good_as_none(dim):
    cells, length = EXACT[dim]
    grid, position = grid_of(cells, length), pattern("random", cells, length)
    q, plain = values(len(position)), Mapping(grid, position)
    assert plain.weight is None
    ones, others = (Mapping(grid, position, np.full(len(position), w)) for w in (1.0, 2.5))
    assert np.array_equal(ones.p2g(q), plain.p2g(q)) and np.array_equal(ones.row_sums, plain.row_sums)
    close(others.p2g(q), plain.p2g(q), 1e-14)
    close(others.row_sums, 2.5 * plain.row_sums, 1e-14)


@every_dimension
def test_an_update_takes_new_weights_and_without_them_forgets_the_old(dim):
    cells, length = EXACT[dim]
    grid, position = grid_of(cells, length), pattern("random", cells, length)
    first, second = np.random.default_rng(1).random((2, len(position))) + 0.1
    q, mapping, versions = values(len(position)), Mapping(grid, position, first), []
    mapping.gram.apply(grid.zeros(1))
    for weight in (second, None, first):
        versions.append(mapping.version)
        mapping.update(position, weight)
        fresh = Mapping(grid, position, weight)
        assert np.array_equal(mapping.p2g(q), fresh.p2g(q))
        assert np.array_equal(mapping.moments, fresh.moments)
    assert len({*versions, mapping.version}) == 4


def test_weights_are_copied_and_may_be_whole_numbers():
    grid, position, weight, _ = weighted_case("2D", "random")
    mapping, q = Mapping(grid, position, weight), values(len(position))
    before = mapping.p2g(q)
    weight[:] = 1.0
    assert np.array_equal(mapping.p2g(q), before)
    whole = np.arange(1, len(position) + 1)
    assert np.array_equal(Mapping(grid, position, whole).p2g(q), Mapping(grid, position, 1.0 * whole).p2g(q))


@pytest.mark.parametrize("bad", [0.0, -0.0, -2.5, np.nan, np.inf, -np.inf])
def test_a_weight_that_is_no_finite_number_above_0_is_refused_by_name(bad):
    """The first of them, on building and on an update."""
    grid, position, weight, _ = weighted_case("1D", "random")
    wrong = weight.copy()
    wrong[[5, 9]] = bad
    message = rf"^rank 0: weight 5 must be a finite number above 0, not {bad}$"
    with pytest.raises(ValueError, match=message):
        Mapping(grid, position, wrong)
    mapping = Mapping(grid, position, weight)
    with pytest.raises(ValueError, match=message):
        mapping.update(position, wrong)


@pytest.mark.parametrize("shape", [(), (27,), (29,), (28, 1), (1, 28), (0,)])
def test_weights_of_the_wrong_shape_are_refused(shape):
    grid, position, *_ = weighted_case("1D", "random")
    assert len(position) == 28
    with pytest.raises(ValueError, match=r"^rank 0: weight must have shape \(28,\), one number a particle, not \("):
        Mapping(grid, position, np.ones(shape))


@pytest.mark.parametrize("wrong", ["position", "weight"])
def test_a_refused_update_leaves_the_mapping_as_it_was(wrong):
    grid, position, weight, _ = weighted_case("2D", "random")
    mapping, q = Mapping(grid, position, weight), values(len(position))
    before = mapping.p2g(q), mapping.g2p(mapping.row_sums), mapping.version
    moved, weight = position[::-1].copy(), weight.copy()
    (weight if wrong == "weight" else moved)[3] = np.nan
    with np.errstate(invalid="ignore"), pytest.raises(ValueError, match="rank 0: "):
        mapping.update(moved, weight)
    after = mapping.p2g(q), mapping.g2p(mapping.row_sums), mapping.version
    assert all(np.array_equal(one, other) for one, other in zip(before, after))


# ---------------------------------------------------------------- values of any shape


@pytest.mark.parametrize("shape", [(), (2,), (2, 2), (3, 1, 2)])
def test_values_of_any_shape_are_mapped_component_by_component(shape):
    cells, length = EXACT[2]
    position = pattern("random", cells, length)
    mapping, q = Mapping(grid_of(cells, length), position), values(len(position), *shape)
    nodal = mapping.p2g(q)
    back, slopes = mapping.g2p(nodal), mapping.gradient(nodal)
    assert nodal.shape[1:] == shape and back.shape == q.shape and slopes.shape == (*q.shape, 2)
    for index in np.ndindex(shape):
        component = (slice(None), *index)
        alone = mapping.p2g(np.ascontiguousarray(q[component]))
        assert np.array_equal(nodal[component], alone)
        assert np.array_equal(back[component], mapping.g2p(alone))
        assert np.array_equal(slopes[component], mapping.gradient(alone))


@pytest.mark.parametrize(
    ("basis", "dim", "shape"), covering(2, ("linear", "quadratic", "cubic"), (1, 2, 3), ((), (2,)))
)
def test_the_adjoint_gradient_is_that_of_the_gradient_and_the_divergence_is_its_trace(basis, dim, shape):
    cells, length = EXACT[dim]
    grid = Grid(cells, length, MPI.COMM_SELF, basis)
    position = pattern("random", cells, length)
    mapping = Mapping(grid, position)
    q, w = values(len(position), *shape, dim), values(grid.node_count, *shape, seed=6)
    nodal = ghosted(grid, w)
    there = np.sum(mapping.gradient(nodal) * q)
    back = np.sum(w * on_nodes(grid, mapping.adjoint_gradient(q)))
    assert there == pytest.approx(back, rel=1e-11, abs=1e-11 * np.abs(q).sum() * np.abs(w).max() / min(grid.h))
    field = ghosted(grid, values(grid.node_count, *shape, dim, seed=7))
    slopes = mapping.gradient(field)
    close(mapping.divergence(field), np.trace(slopes, axis1=-2, axis2=-1), 1e-12)

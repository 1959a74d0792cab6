"""Claims that hold for every filter of the registry, against dense matrices."""

import numpy as np
import pytest

from covering_helpers import covering
from dense_helpers import GRIDS, Dense, close, few_cases, pattern
from mpipic.filters import FILTERS, Filter, LocalFilter, NodalFilter
from mpipic.mapping.mapping import Mapping
from serial_helpers import allowed, ghosted, grid_of, make, on_nodes, sweep_of

every_kind = pytest.mark.parametrize("kind", sorted(FILTERS))
every_nodal_kind = pytest.mark.parametrize("kind", [k for k in sorted(FILTERS) if issubclass(FILTERS[k], NodalFilter)])
covered = pytest.mark.parametrize(("kind", "box", "name"), few_cases(sorted(FILTERS)))
ROOMY = ["1D", "2D", "2D, aspect 1e6", "3D"]
some = pytest.mark.parametrize(
    ("kind", "box", "name"), covering(2, sorted(FILTERS), ROOMY, ("random", "lattice", "few", "coincident"))
)
roomy = pytest.mark.parametrize("box", ROOMY)


def case(box, name, kind):
    cells, length = GRIDS[box]
    position = pattern(name, cells, length)
    mapping = Mapping(grid_of(cells, length), position)
    return make(kind, mapping), Dense(cells, length, position)


def touched(grid, nodal):
    """Own nodes and the ghosts that the cells of this rank touch; the ghosts below are nobody's."""
    return grid.nodes.block(nodal.reshape(grid.nodes.ghost_shape[::-1] + nodal.shape[1:]), (0, 1))


def noise(n, *shape, seed=4):
    return np.random.default_rng(seed).standard_normal((n, *shape))


def test_the_registry_holds_every_filter_under_its_kind():
    assert FILTERS["local"] is LocalFilter
    assert all(kind == cls.kind and issubclass(cls, Filter) for kind, cls in FILTERS.items())
    assert {kind for kind, cls in FILTERS.items() if not issubclass(cls, NodalFilter)} == {"svd"}


@covered
def test_a_filter_is_its_formula(kind, box, name):
    filter_, dense = case(box, name, kind)
    q = noise(len(dense.phi))
    close(filter_.apply(q), dense.filter(kind) @ q, allowed(kind, 1e-12), scale=np.abs(q).max())


@some
def test_a_filter_keeps_constants(kind, box, name):
    filter_, dense = case(box, name, kind)
    ones = np.ones(len(dense.phi))
    close(filter_.apply(ones), ones, allowed(kind, 1e-13))


@some
def test_a_filter_conserves_the_sum(kind, box, name):
    filter_, dense = case(box, name, kind)
    q = noise(len(dense.phi), 2) + 0.1
    assert filter_.apply(q).sum(axis=0) == pytest.approx(q.sum(axis=0), abs=allowed(kind, 1e-13) * np.abs(q).sum())


@every_kind
@roomy
def test_a_filter_is_linear(kind, box):
    filter_, dense = case(box, "random", kind)
    a, b = noise(len(dense.phi), 2, seed=1).T
    close(filter_.apply(2.0 * a - 3.0 * b), 2.0 * filter_.apply(a) - 3.0 * filter_.apply(b), allowed(kind, 1e-12))


@pytest.mark.parametrize(
    ("kind", "box", "name"), covering(2, sorted(FILTERS), ROOMY, ("random", "jittered", "lattice"))
)
def test_a_filter_removes_what_no_node_sees(kind, box, name):
    """First that there is much to remove: of noise, more than half."""
    filter_, dense = case(box, name, kind)
    q = noise(len(dense.phi))
    assert dense.null_space_share(q) > 0.5
    assert dense.null_space_share(filter_.apply(q)) < 1e-12


@every_kind
@roomy
def test_a_value_in_the_null_space_becomes_zero(kind, box):
    filter_, dense = case(box, "random", kind)
    q = noise(len(dense.phi))
    hidden = q - dense.projection() @ q
    assert np.abs(hidden).max() > 0.1 and np.abs(dense.S @ hidden).max() < 1e-12
    close(filter_.apply(hidden), np.zeros_like(q), allowed(kind, 1e-12), scale=1.0)


@every_kind
@roomy
def test_a_filter_does_not_remove_all_that_the_nodes_see(kind, box):
    """A wave of one period along the longest axis of the grid keeps most of itself."""
    cells, length = GRIDS[box]
    axis = int(np.argmax(cells))
    filter_, _ = case(box, "lattice", kind)
    position = pattern("lattice", cells, length)
    wave = np.sin(2 * np.pi * position[:, axis] / length[axis])
    assert np.linalg.norm(filter_.apply(wave)) > 0.4 * np.linalg.norm(wave)


@every_kind
@roomy
def test_a_filter_never_enlarges(kind, box):
    filter_, dense = case(box, "jittered", kind)
    for seed in range(5):
        q = noise(len(dense.phi), seed=seed)
        assert np.linalg.norm(filter_.apply(q)) <= np.linalg.norm(q) * (1 + allowed(kind, 1e-12))


@every_kind
@pytest.mark.parametrize("k", [1, 2, 5])
def test_columns_are_filtered_one_by_one_and_the_argument_is_kept(kind, k):
    filter_, dense = case("2D", "random", kind)
    q = noise(len(dense.phi), k)
    before = q.copy()
    filtered = filter_.apply(q)
    assert filtered.shape == q.shape and np.array_equal(q, before)
    for column in range(k):
        alone = filter_(q[:, column])
        assert alone.shape == (len(q),)
        close(filtered[:, column], alone, allowed(kind, 1e-14))


@every_nodal_kind
def test_nodal_coefficients_give_the_filtered_values_by_interpolation(kind):
    filter_, dense = case("2D", "random", kind)
    grid, q = filter_.mapping.grid, noise(len(dense.phi), 3)
    sums = ghosted(grid, dense.phi.T @ q)
    coefficients = on_nodes(grid, filter_.coefficients(sums))
    close(dense.phi @ coefficients, dense.filter(kind) @ q, allowed(kind, 1e-12))
    out = np.full(sums.shape, 9.0)
    assert filter_.coefficients(sums, out=out) is out
    close(on_nodes(grid, out), coefficients, 1e-14)


@every_kind
def test_a_filter_moves_with_its_mapping(kind):
    filter_, dense = case("2D", "random", kind)
    cells, length = GRIDS["2D"]
    position = pattern("random", cells, length, seed=9)
    filter_.mapping.update(position)
    q, moved = noise(len(position)), Dense(cells, length, position)
    close(filter_.apply(q), moved.filter(kind) @ q, allowed(kind, 1e-12))
    assert np.abs(dense.filter(kind) @ q - moved.filter(kind) @ q).max() > 0.1


@every_kind
def test_on_a_sweep_a_filter_takes_any_particle_values_too(kind):
    cells, length = GRIDS["2D"]
    position = pattern("random", cells, length)
    sweep = sweep_of(grid_of(cells, length), position)
    q = noise(len(position), 2)[sweep.particles.ids]
    wanted = Dense(cells, length, position[sweep.particles.ids]).filter(kind) @ q
    close(make(kind, sweep).apply(q), wanted, allowed(kind, 1e-12))


@every_kind
def test_tensors_are_filtered_component_by_component(kind):
    filter_, dense = case("2D", "random", kind)
    q = noise(len(dense.phi), 2, 2)
    filtered = filter_.apply(q)
    assert filtered.shape == q.shape
    for i, j in np.ndindex(2, 2):
        close(filtered[:, i, j], dense.filter(kind) @ q[:, i, j], allowed(kind, 1e-12), scale=np.abs(q).max())


@every_nodal_kind
def test_on_a_sweep_a_filter_has_the_coefficients_that_it_has_on_a_mapping(kind):
    cells, length = GRIDS["2D"]
    grid, position = grid_of(cells, length), pattern("random", cells, length)
    sums = ghosted(grid, noise(grid.node_count, 2))
    on_sweep, on_mapping = (
        touched(grid, make(kind, mapping).coefficients(sums))
        for mapping in (sweep_of(grid, position), Mapping(grid, position))
    )
    close(on_sweep, on_mapping, allowed(kind, 1e-13))


# ---------------------------------------------------------------- particles of different weight


def weighted_case(box, name, kind, uniform=None):
    """Weights from 0.1 to 10, or one for all."""
    cells, length = GRIDS[box]
    position = pattern(name, cells, length)
    weight = 10.0 ** np.random.default_rng(2).uniform(-1.0, 1.0, len(position))
    if uniform is not None:
        weight = np.full(len(position), uniform)
    mapping = Mapping(grid_of(cells, length), position, weight)
    return make(kind, mapping), Dense(cells, length, position, weight), weight


@some
def test_with_weights_a_filter_is_its_weighted_formula(kind, box, name):
    filter_, dense, weight = weighted_case(box, name, kind)
    q = noise(len(weight))
    scale = np.abs(q).max() * np.sqrt(weight.max() / weight.min())
    close(filter_.apply(q), dense.filter(kind) @ q, allowed(kind, 1e-12), scale=scale)


@some
def test_with_weights_a_filter_conserves_the_weighted_sum_and_keeps_constants(kind, box, name):
    filter_, _, weight = weighted_case(box, name, kind)
    q = noise(len(weight), 2) + 0.1
    kept = weight @ filter_.apply(q)
    assert kept == pytest.approx(weight @ q, abs=allowed(kind, 1e-13) * (weight @ np.abs(q)).max())
    close(filter_.apply(np.ones(len(weight))), np.ones(len(weight)), allowed(kind, 1e-13), scale=10.0)


@pytest.mark.parametrize(("kind", "box", "uniform"), covering(2, sorted(FILTERS), ("1D", "2D", "3D"), (1.0, 2.5)))
def test_equal_weights_are_as_good_as_none_and_different_ones_are_not(kind, box, uniform):
    filter_, _, weight = weighted_case(box, "random", kind, uniform)
    plain = make(kind, Mapping(filter_.mapping.grid, pattern("random", *GRIDS[box])))
    q = noise(len(weight))
    close(filter_.apply(q), plain.apply(q), allowed(kind, 1e-13))
    different = weighted_case(box, "random", kind)[0]
    assert np.abs(different.apply(q) - plain.apply(q)).max() > 0.05


@every_kind
def test_a_filter_follows_weights_that_change(kind):
    cells, length = GRIDS["2D"]
    filter_, _, weight = weighted_case("2D", "random", kind)
    position = pattern("random", cells, length)
    q = noise(len(weight))
    filter_.apply(q)
    for weights in (weight[::-1].copy(), None):
        filter_.mapping.update(position, weights)
        wanted = Dense(cells, length, position, weights).filter(kind) @ q
        close(filter_.apply(q), wanted, allowed(kind, 1e-12), scale=10.0)

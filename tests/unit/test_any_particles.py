"""Particles anywhere in the box: nothing is divided by zero, and all is what the definitions say."""

import numpy as np
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from dense_helpers import Dense, close
from mpipic.filters import FILTERS
from mpipic.mapping.mapping import Mapping
from serial_helpers import (
    by_id,
    divergence_sums,
    euler_step,
    ghosted,
    gradient_sums,
    gram_matrix,
    grid_of,
    moving_reference,
    on_nodes,
    sweep_of,
)

LENGTHS = (1.0, 0.3, 7.0, 1e-6, 1e6)
SPECIAL = (0.0, 5e-324, 1e-308, 1e-300, 1e-16, 5e-11, 1e-9, 0.25, 0.5, 1 - 1e-9, 1 - 5e-11, 1 - 1e-12, 1 - 2**-53)
"""Places in a cell."""

place = st.sampled_from(SPECIAL) | st.floats(0.0, 1.0, exclude_max=True)


@st.composite
def boxes(draw):
    dim = draw(st.integers(1, 3))
    cells = tuple(draw(st.integers(1, 6 if dim < 3 else 4)) for _ in range(dim))
    return cells, tuple(draw(st.sampled_from(LENGTHS)) for _ in cells)


@st.composite
def particles_in_boxes(draw):
    """(cells, length, position) with 1 to 12 particles; edges, nodes and coincident ones included."""
    cells, length = draw(boxes())
    one = st.tuples(*(st.tuples(st.integers(0, n - 1), place) for n in cells))
    rows = draw(st.lists(one, min_size=1, max_size=12))
    coordinate = np.array([[cell + inside for cell, inside in row] for row in rows])
    position = np.minimum(coordinate * (np.array(length) / cells), np.nextafter(length, 0.0))
    # where the right-hand cell begins only rounding decides
    beyond = np.mod(position / (np.array(length) / cells) + 1e-10, 1.0)
    assume(np.minimum(beyond, 1 - beyond).min() > 1e-13)
    return cells, length, position


kinds = st.sampled_from(["none", *sorted(FILTERS)])
flows = st.tuples(*3 * [st.floats(-3.0, 3.0)])
numbers = np.random.default_rng(0).standard_normal((500, 4))
lone = ((3,), (1.0,), np.array([[np.nextafter(1.0, 0.0)]]))
corner = ((1, 2, 1), (1.0, 1e6, 0.3), np.zeros((2, 3)))
nearly_one = ((1, 1, 2), (1.0, 1.0, 1.0), np.array([[0.0, 0.0, 0.5 * (k == 8)] for k in range(9)]))


@settings(max_examples=400)
@given(particles_in_boxes())
@example(lone)
@example(corner)
def test_a_mapping_of_any_particles_is_that_of_the_dense_matrices(case):
    cells, length, position = case
    grid, dense = grid_of(cells, length), Dense(cells, length, position)
    mapping, n = Mapping(grid, position), len(position)
    q, nodal = numbers[:n, :2], numbers[: grid.node_count, : grid.dim] * grid.h
    ghosts = ghosted(grid, nodal)
    weights = on_nodes(grid, mapping.row_sums)
    assert np.all(weights >= 0.0) and abs(weights.sum() - n) <= 1e-14 * n
    close(weights, dense.d)
    sums = on_nodes(grid, mapping.sums(q))
    close(sums, dense.phi.T @ q, scale=np.abs(q).sum())
    means = on_nodes(grid, mapping.p2g(q))
    assert np.all(np.isfinite(means)) and np.all(np.abs(means) <= np.abs(q).max() * (1 + 1e-9))
    well_seen = weights > 1e-6
    close(means[well_seen], (dense.S @ q)[well_seen], 1e-6, scale=np.abs(q).max())
    close(mapping.g2p(ghosts), dense.phi @ nodal, scale=np.abs(nodal).max())
    close(mapping.divergence(ghosts), dense.divergence(nodal), 1e-11, scale=np.abs(nodal / grid.h).max() * grid.dim)
    gradient = mapping.gradient(ghosts[:, 0].copy()) * grid.h
    close(gradient, dense.gradient(nodal[:, 0]) * grid.h, 1e-11, scale=np.abs(nodal).max())


@settings(max_examples=400)
@given(particles_in_boxes())
@example(lone)
@example(corner)
def test_a_sweep_of_any_particles_is_that_of_the_dense_matrices(case):
    cells, length, position = case
    grid, dense, n = grid_of(cells, length), Dense(cells, length, position), len(position)
    state, nodal = numbers[:n, : 1 + grid.dim], numbers[: grid.node_count, : grid.dim] * grid.h
    sweep = sweep_of(grid, position, state[:, 0], state[:, 1:])
    close(on_nodes(grid, sweep.held_sums[:, :-1].copy()), dense.phi.T @ state, scale=np.abs(state).sum())
    weights = on_nodes(grid, sweep.row_sums)
    assert np.all(weights >= 0.0) and abs(weights.sum() - n) <= 1e-14 * n
    close(weights, dense.d)
    gram = gram_matrix(sweep)
    close(gram, dense.G)
    close(gram, gram.T, 1e-15)
    assert np.linalg.eigvalsh((gram + gram.T) / 2).min() >= -1e-14 * n
    close(gram.sum(axis=1), dense.d)
    slopes = np.stack([dense.phi.T @ (D @ nodal[:, 0]) for D in dense.D], axis=1) * grid.h
    close(gradient_sums(sweep, nodal[:, 0]) * grid.h, slopes, 1e-11, scale=n * np.abs(nodal).max())
    wanted = dense.phi.T @ dense.divergence(nodal)
    close(divergence_sums(sweep, nodal), wanted, 1e-11, scale=n * grid.dim * np.abs(nodal / grid.h).max())


@settings(max_examples=200)
@given(particles_in_boxes(), kinds, flows)
@example(lone, "local", (0.5, 0.0, 0.0))
@example(corner, "none", (1.0, -1.0, 1e-11))
@example(nearly_one, "exact", (0.0, 0.0, 0.5))
def test_steps_of_any_particles_stay_finite_and_in_the_box(case, kind, flow):
    """Steps so short that no scheme can grow: values stay near where they started."""
    cells, length, position = case
    grid, n = grid_of(cells, length), len(position)
    state = numbers[:n, : 1 + grid.dim]
    sweep = sweep_of(grid, position, state[:, 0], state[:, 1:], np.array(flow[: grid.dim]) * grid.h)
    rates = 2 * [1e-3 * min(grid.h)]
    if kind == "svd":
        step = moving_reference(kind, grid, sweep.particles, rates, np.array(flow[: grid.dim]) * grid.h)
    else:
        step = euler_step(kind, sweep, rates)
    for _ in range(6):
        step.step()
    moved, density, velocity = by_id(sweep.particles)
    assert np.all((moved >= -1e-9 * np.array(grid.h)) & (moved < length))
    assert np.abs(density - state[:, 0]).max() < 1.0 and np.abs(velocity - state[:, 1:]).max() < 1.0
    assert np.isfinite(sweep.held_sums).all() and step.peak == np.abs(density).max()

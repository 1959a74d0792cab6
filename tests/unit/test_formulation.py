"""The paper's step: on nodal arrays, on particle values and in dense matrices it is the same.

`exact` solves to a residual of 1e-13 (see `serial_helpers.SETTINGS`), from guesses of earlier steps where it is fused.
"""

import numpy as np
import pytest

from covering_helpers import covering
from dense_helpers import Dense, close, pattern, run_euler
from mpipic.filters import FILTERS, NodalFilter
from mpipic.mapping.mapping import Mapping
from serial_helpers import allowed, by_id, euler_step, grid_of, on_nodes, plain_step, sweep_of

# h is a power of two, and cells are not cubes: moves are exact in the reference too, and mixed-up axes show
BOXES = {1: ((16,), (1.0,)), 2: ((6, 4), (1.5, 2.0)), 3: ((3, 4, 2), (0.75, 2.0, 2.0))}
FLOWS = {
    "at rest": (0.0, 0.0, 0.0),
    "slow": (0.0625, 0.03125, -0.125),
    "backwards": (-0.375, 0.0, -0.09375),
    "cells a step": (2.3125, -1.6875, 1.125),
    "more than a period": (-35.40625, 9.28125, 13.0),
}
"""Cells a step."""
KINDS = ["none", *sorted(FILTERS)]
NODAL = ["none", *[kind for kind in sorted(FILTERS) if issubclass(FILTERS[kind], NodalFilter)]]
STEPS = {"exact": 12, "svd": 12}
"""Kind to steps taken, 30 where it is not said: these cost a solve, or two decompositions, a step."""

every_dimension = pytest.mark.parametrize("dim", [1, 2, 3])
every_nodal_kind = pytest.mark.parametrize("kind", NODAL)
PATTERNS = ("random", "jittered", "lattice", "on nodes", "few")


def covered(kinds):
    """Any two of dimension, kind, pattern and flow together."""
    return pytest.mark.parametrize(("dim", "kind", "name", "flow"), covering(2, (1, 2, 3), kinds, PATTERNS, FLOWS))


def case(dim, name, flow):
    cells, length = BOXES[dim]
    position = pattern(name, cells, length)
    rng = np.random.default_rng(3)
    state = rng.standard_normal(len(position)), rng.standard_normal((len(position), dim))
    displacement = np.array(FLOWS[flow][:dim]) * length / cells
    return cells, length, position, *state, displacement


def rates_of(cells, length, cfl=0.2):
    """Rates dt ρ₀, dt c²/ρ₀ for ρ₀ = 1.7 and c = 1.3, so that neither is the other."""
    dt = cfl * min(np.array(length) / cells) / 1.3
    return dt * 1.7, dt * 1.3**2 / 1.7


def take_fused_steps(kind, grid, position, density, velocity, displacement, rates, steps):
    sweep = sweep_of(grid, position, density, velocity, displacement)
    step = euler_step(kind, sweep, rates)
    for _ in range(steps):
        step.step()
    return sweep


def take_plain_steps(kind, grid, position, density, velocity, displacement, rates, steps):
    position, density, velocity = position.copy(), density.copy(), velocity.copy()
    reference = plain_step(kind, Mapping(grid, position), rates)
    for _ in range(steps):
        reference.update(density, velocity)
        position = np.mod(position + displacement, grid.length)
        reference.mapping.update(position)
    return position, density, velocity


@covered(NODAL)
def test_the_step_on_nodes_is_the_dense_one(dim, kind, name, flow):
    cells, length, position, density, velocity, displacement = case(dim, name, flow)
    grid, rates = grid_of(cells, length), rates_of(cells, length)
    steps = STEPS.get(kind, 30)
    sweep = take_fused_steps(kind, grid, position, density, velocity, displacement, rates, steps)
    wanted = run_euler(cells, length, position, density, velocity, displacement, rates, kind, steps)
    assert np.array_equal(by_id(sweep.particles)[0], wanted[0])
    assert np.abs(wanted[1] - density).max() > 0.01 or name == "few"
    size = max(np.abs(field).max() for field in wanted[1:])
    for field, expected in zip(by_id(sweep.particles)[1:], wanted[1:]):
        close(field, expected, allowed(kind, 1e-12), scale=size)


@covered(KINDS)
def test_the_step_on_particles_is_the_dense_one(dim, kind, name, flow):
    cells, length, *particles, displacement = case(dim, name, flow)
    grid, rates = grid_of(cells, length), rates_of(cells, length)
    steps = STEPS.get(kind, 30)
    plain = take_plain_steps(kind, grid, *particles, displacement, rates, steps)
    wanted = run_euler(cells, length, *particles, displacement, rates, kind, steps)
    size = max(np.abs(field).max() for field in wanted[1:])
    for field, expected in zip(plain, wanted):
        close(field, expected, allowed(kind, 1e-12), scale=max(size, *length))


@pytest.mark.parametrize(("dim", "kind", "name"), covering(2, (1, 2, 3), NODAL, ("random", "lattice")))
def test_after_a_step_the_sweep_has_mapped_the_new_state(dim, kind, name):
    cells, length, *particles, displacement = case(dim, name, "slow")
    grid = grid_of(cells, length)
    sweep = take_fused_steps(kind, grid, *particles, displacement, rates_of(cells, length), 7)
    position, density, velocity = by_id(sweep.particles)
    dense = Dense(cells, length, position)
    rho, u = (on_nodes(grid, sweep.divide(sums)) for sums in sweep.state_sums)
    close(rho[:, 0], dense.S @ density)
    close(u, dense.S @ velocity)
    assert sweep.peak == np.abs(density).max()


@every_dimension
@every_nodal_kind
def test_a_step_conserves_the_sum_of_density_on_a_lattice_and_of_velocity(dim, kind):
    """On a lattice the slopes of the hat functions sum to zero over the particles: mass and momentum are kept."""
    cells, length, *particles, displacement = case(dim, "lattice", "slow")
    sweep = take_fused_steps(kind, grid_of(cells, length), *particles, displacement, rates_of(cells, length), 10)
    _, density, velocity = by_id(sweep.particles)
    n = len(density)
    assert abs(density.sum() - particles[1].sum()) < 1e-12 * n
    assert np.abs(velocity.sum(axis=0) - particles[2].sum(axis=0)).max() < 1e-12 * n


@every_dimension
@every_nodal_kind
def test_a_uniform_state_stays_as_it_is(dim, kind):
    cells, length, position, *_, displacement = case(dim, "random", "slow")
    n = len(position)
    uniform = np.full(n, 2.0), np.full((n, dim), -3.0)
    grid, rates = grid_of(cells, length), rates_of(cells, length)
    sweep = take_fused_steps(kind, grid, position, *uniform, displacement, rates, 20)
    _, density, velocity = by_id(sweep.particles)
    close(density, uniform[0], 1e-13)
    close(velocity, uniform[1], 1e-13)


@every_nodal_kind
def test_the_velocity_is_used_before_and_the_density_after_its_update(kind):
    """One step from a state at rest changes the velocity alone, one from uniform density both."""
    cells, length, position, *_ = case(1, "jittered", "at rest")
    grid, n = grid_of(cells, length), len(position)
    wave, rest = np.sin(2 * np.pi * position[:, 0]), np.zeros((n, 1))
    sweep = take_fused_steps(kind, grid, position, wave, rest, (0.0,), (0.01, 0.01), 1)
    _, density, velocity = by_id(sweep.particles)
    assert np.array_equal(density, wave) and np.abs(velocity).max() > 0.01
    sweep = take_fused_steps(kind, grid, position, np.zeros(n), wave[:, None], (0.0,), (0.01, 0.01), 1)
    _, density, velocity = by_id(sweep.particles)
    assert np.abs(density).max() > 0.01 and 1e-5 < np.abs(velocity[:, 0] - wave).max() < 0.01


@every_dimension
def test_without_flow_the_particles_stay_and_with_it_they_move(dim):
    cells, length, *particles, displacement = case(dim, "random", "slow")
    grid = grid_of(cells, length)
    for move in (np.zeros(dim), displacement):
        sweep = take_fused_steps("local", grid, *particles, move, rates_of(cells, length), 3)
        moved = by_id(sweep.particles)[0]
        assert np.array_equal(moved, particles[0]) == (not move.any())


@every_dimension
@pytest.mark.parametrize("name", ["few", "one"])
@pytest.mark.parametrize("uniform", [True, False])
def test_guesses_of_earlier_steps_do_not_wear_out_where_nodes_outnumber_particles(dim, name, uniform):
    """The matrix is singular, and the right-hand side at times no more than rounding."""
    cells, length, position, density, velocity, displacement = case(dim, name, "slow")
    if uniform:
        density, velocity = np.full_like(density, 2.0), np.full_like(velocity, -3.0)
    sweep = sweep_of(grid_of(cells, length), position, density, velocity, 0.01 * np.pi * displacement)
    step = euler_step("exact", sweep, rates_of(cells, length, cfl=0.02), {"tolerance": 1e-10})
    for _ in range(150):
        step.step()
    assert np.isfinite(sweep.peak)

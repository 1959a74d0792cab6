"""A run's step for every kind of scheme against dense matrices, and what holds for schemes of a kind.

`covering(3)` are few of the 684 schemes, in which any three choices of parts that go together occur together.
"""

from dataclasses import replace

import numpy as np
import pytest
from mpi4py import MPI

import covering_helpers
from dense_helpers import close, pattern
from mpipic.filters import FILTERS
from mpipic.mapping.mapping import Mapping
from mpipic.mapping.mass import LeastSquaresMass, LumpedMass
from mpipic.mesh.differences import CentralDifference, LowPass
from mpipic.mesh.grid import Grid
from mpipic.physics.acoustics.damping import Damping
from mpipic.physics.acoustics.gas import Gas as Constants
from mpipic.physics.acoustics.integrators import INTEGRATORS
from mpipic.physics.acoustics.midpoint import Midpoint
from mpipic.physics.acoustics.reference import MovingReference, ParticleScheme, ReferenceStep
from mpipic.physics.acoustics.step import AcousticStep
from scheme_helpers import SCHEMES, TIGHT, Run, covering, label
from spline_helpers import Gas, Scheme, Splines, run_steps, short_step

# h is a power of two, cells are not cubes; times a time step of CFL 0.325 moves are exact
BOXES = {1: ((16,), (1.0,)), 2: ((6, 4), (1.5, 2.0)), 3: ((3, 4, 2), (0.75, 2.0, 2.0))}
SMALL = {1: ((3,), (1.5,)), 2: ((1, 3), (0.5, 1.5)), 3: ((2, 1, 3), (0.5, 0.25, 3.0))}
FLOW = (0.25, 0.125, -0.5)
ALLOWED = 1e-11
"""Of the largest value. Solvers stop at residuals of 1e-13."""


def every_scheme(strength, wanted=lambda scheme: True):
    return pytest.mark.parametrize("scheme", covering(strength, wanted), ids=label)


def in_turn(strength, names, turns, wanted=lambda scheme: True):
    """Schemes as by `every_scheme`, each with one of several values of what `names` says, in turn."""
    rows = [(scheme, *turns[count % len(turns)]) for count, scheme in enumerate(covering(strength, wanted))]
    return pytest.mark.parametrize(("scheme", *names), rows, ids=lambda v: label(v) if isinstance(v, Scheme) else None)


def case(dim, name, flow=FLOW, boxes=BOXES):
    """Box, gas, time step, positions and state; 4 particles a cell."""
    cells, length = boxes[dim]
    position = pattern(name, cells, length)
    state = np.random.default_rng(3).standard_normal((len(position), 1 + dim))
    return (cells, length), Gas(1.7, 1.3, flow[:dim]), 0.25 * min(np.array(length) / cells), position, state


def take(scheme, box, gas, dt, position, state, steps):
    return Run(scheme, *box, gas, dt, position, state).steps(steps)


def is_the_dense_step(scheme, box, gas, dt, position, state, steps=5):
    run = take(scheme, box, gas, dt, position, state, steps)
    wanted = run_steps(short_step, scheme, gas, dt, *box, position, state, steps)
    close(run.result[0], wanted[0], 1e-14, scale=max(box[1]))
    close(run.result[1], wanted[1], ALLOWED)
    assert np.abs(wanted[1] - state).max() > 0.01
    return run


# ---------------------------------------------------------------- against dense matrices


@every_scheme(3)
def test_on_random_particles_in_1d_steps_are_the_dense_ones(scheme):
    is_the_dense_step(scheme, *case(1, "random"))


@in_turn(2, ("name",), [("jittered",), ("lattice",)])
def test_on_ordered_particles_in_1d_steps_are_the_dense_ones(scheme, name):
    is_the_dense_step(scheme, *case(1, name))


@every_scheme(2)
def test_in_2d_steps_are_the_dense_ones(scheme):
    is_the_dense_step(scheme, *case(2, "random"), steps=3)


@every_scheme(2)
def test_in_3d_steps_are_the_dense_ones(scheme):
    is_the_dense_step(scheme, *case(3, "jittered"), steps=2)


@in_turn(2, ("dim",), [(1,), (2,), (3,)])
def test_on_grids_smaller_than_the_stencils_steps_are_the_dense_ones(scheme, dim):
    box, gas, dt, *_ = case(dim, "random", boxes=SMALL)
    position = pattern("crowd", *box)[:60]
    state = np.random.default_rng(3).standard_normal((len(position), 1 + dim))
    is_the_dense_step(scheme, box, gas, dt, position, state, steps=2)


@in_turn(2, ("dim",), [(1,), (2,)])
def test_without_flow_steps_are_the_dense_ones_and_no_particle_moves(scheme, dim):
    box, gas, dt, position, state = case(dim, "jittered", flow=(0.0, 0.0, 0.0))
    run = is_the_dense_step(scheme, box, gas, dt, position, state, steps=2)
    assert np.array_equal(run.result[0], position) and run.physics.facts()["sorts"] <= 1


@every_scheme(2, lambda scheme: scheme.filter != "svd" or scheme.gradient == "grid")
def test_sorted_after_every_step_particles_take_the_same_steps(scheme, monkeypatch):
    box, gas, dt, position, state = case(1, "random")
    plain = take(scheme, box, gas, dt, position, state, 4)
    run = Run(scheme, *box, gas, dt, position, state)
    monkeypatch.setattr(run.sweep, "sort_when_due", lambda breaks: run.sweep.sort())
    run.steps(4)
    assert run.sweep.sorts == 5 and not np.array_equal(run.sweep.particles.ids, plain.sweep.particles.ids)
    for found, expected in zip(run.result, plain.result):
        close(found, expected, ALLOWED)


def test_a_filter_without_a_nodal_form_runs_on_particles_and_all_others_on_nodes():
    for scheme in SCHEMES:
        box, gas, dt, position, state = case(1, "lattice")
        if (scheme.basis, scheme.damping > 0) == ("quadratic", False):
            built = type(Run(scheme, *box, gas, dt, position, state).stepper)
            on_particles = scheme.filter == "svd" and scheme.gradient == "direct"
            assert built is (MovingReference if on_particles else AcousticStep), label(scheme)


# ---------------------------------------------------------------- on nodes and on particles


def not_penalised(scheme):
    return scheme.mass != "penalised"


def reference_of(scheme, box, gas, dt, position):
    """`ReferenceStep` put together by hand."""
    grid = Grid(*box, MPI.COMM_SELF, scheme.basis)
    mapping = Mapping(grid, position)
    settings = {"order": {"order": scheme.filter_order}, "chebyshev": {"order": scheme.filter_order}}
    settings |= {"exact": {"tolerance": TIGHT}}
    keep = FILTERS[scheme.filter](mapping, **settings.get(scheme.filter, {})) if scheme.filter != "none" else None
    mass = LumpedMass(mapping) if scheme.mass == "lumped" else LeastSquaresMass(mapping, TIGHT)
    midpoint = scheme.integrator == "midpoint"
    integrate = Midpoint(1e-12, symmetric=False) if midpoint else INTEGRATORS[scheme.integrator]()
    difference = CentralDifference(grid, scheme.gradient_order) if scheme.gradient == "grid" else None
    travel = gas.sound_speed * dt / np.array(grid.h)
    strengths = np.minimum(1.0, scheme.strength * travel)
    low_pass = LowPass(grid, scheme.damping, strengths) if scheme.damping else None
    damping = Damping(low_pass, min(1.0, scheme.null_space * travel.max()))
    constants = Constants(gas.sound_speed, gas.flow, gas.density)
    return ReferenceStep(mapping, constants, dt, ParticleScheme(mass, integrate, keep, difference, damping))


@every_scheme(2, lambda scheme: not_penalised(scheme) and scheme.gradient != "skew")
def test_the_reference_takes_the_steps_of_the_nodal_form(scheme):
    box, gas, dt, position, state = case(1, "jittered")
    expected = take(scheme, box, gas, dt, position, state, 4).result
    reference = reference_of(scheme, box, gas, dt, position)
    state = state.copy()
    for _ in range(4):
        reference.update(state[:, 0], state[:, 1:])
        position = np.mod(position + np.array(gas.flow) * dt, box[1])
        reference.mapping.update(position)
    close(position, expected[0], 1e-14)
    close(state, expected[1], ALLOWED)


@pytest.mark.parametrize(
    ("basis", "mass", "gradient", "integrator"),
    covering_helpers.covering(
        2,
        ("linear", "quadratic", "cubic"),
        ("lumped", "consistent"),
        ("direct", "grid"),
        ("symplectic", "rk4", "midpoint"),
    ),
)
def test_singular_values_give_the_steps_of_the_exact_filter(basis, mass, gradient, integrator):
    dim = 2 if (basis, integrator) == ("cubic", "rk4") else 1
    box, gas, dt, position, state = case(dim, "random")
    damping = 0 if mass == "lumped" else 2
    scheme = Scheme(basis, mass, gradient, "svd", integrator, damping)
    reference = take(scheme, box, gas, dt, position, state, 3)
    exact = take(replace(scheme, filter="exact"), box, gas, dt, position, state, 3)
    close(reference.result[1], exact.result[1], ALLOWED)


# ---------------------------------------------------------------- what is kept


@in_turn(2, ("dim", "name"), [(1, "random"), (2, "jittered")], lambda scheme: scheme.gradient != "skew")
def test_a_uniform_state_stays_as_it_is(scheme, dim, name):
    box, gas, dt, position, state = case(dim, name)
    uniform = np.broadcast_to([2.0, -3.0, 0.7][: 1 + dim], state.shape).copy()
    close(take(scheme, box, gas, dt, position, uniform, 5).result[1], uniform, 1e-10)


@every_scheme(2, lambda scheme: scheme.gradient == "skew")
def test_a_skew_gradient_keeps_a_uniform_state_on_a_lattice_and_not_elsewhere(scheme):
    """-½ Cᵀ1 = -½ Σ_p ∇φ_i(x_p): zero where the particles seen from a node are evenly spread."""
    for name, kept in (("lattice", True), ("random", False)):
        box, gas, dt, position, state = case(1, name)
        uniform = np.broadcast_to([2.0, -3.0], state.shape).copy()
        change = np.abs(take(scheme, box, gas, dt, position, uniform, 5).result[1] - uniform).max()
        assert change < 1e-11 if kept else change > 1e-3


@in_turn(2, ("dim",), [(1,), (2,)])
def test_on_a_lattice_mass_and_momentum_are_conserved_as_it_moves(scheme, dim):
    """Each node sees as much as any other, and the slopes of its spline sum to zero over the particles."""
    box, gas, dt, position, state = case(dim, "lattice")
    _, found = take(scheme, box, gas, dt, position, state, 4).result
    close(found.sum(axis=0), state.sum(axis=0), 1e-11, scale=np.abs(state).sum())
    assert np.abs(found - state).max() > 0.01


@every_scheme(2, lambda scheme: scheme.damping == 0 and scheme.gradient == "direct")
def test_on_disordered_particles_mass_changes_by_the_slopes_that_they_see(scheme):
    """What filters keep is the sum of the divergence over the particles, which is not zero."""
    box, gas, dt, position, state = case(1, "random")
    scheme = replace(scheme, integrator="symplectic")
    _, found = take(scheme, box, gas, dt, position, state, 1).result
    splines = Splines(scheme.basis, *box, position)
    seen = splines.D[0] @ (splines.mass(scheme) @ state[:, 1])
    change = found[:, 0].sum() - state[:, 0].sum()
    assert change == pytest.approx(-dt * gas.density * seen.sum(), rel=1e-9) and abs(change) > 1e-3


# ---------------------------------------------------------------- values of any size


@in_turn(2, ("size",), [(1e-200,), (1e150,)])
def test_values_of_any_size_take_the_same_steps(scheme, size):
    box, gas, dt, position, state = case(1, "jittered")
    expected = take(scheme, box, gas, dt, position, state, 3).result[1]
    close(take(scheme, box, gas, dt, position, size * state, 3).result[1] / size, expected, ALLOWED)


@in_turn(2, ("flow",), [(FLOW,), ((0.0, 0.0, 0.0),)])
def test_a_state_of_zeros_stays_zero(scheme, flow):
    box, gas, dt, position, state = case(2, "random", flow)
    assert not take(scheme, box, gas, dt, position, np.zeros_like(state), 3).result[1].any()


@in_turn(2, ("bad", "column"), [(np.nan, 0), (np.inf, 1), (np.inf, 0), (np.nan, 1)])
def test_a_value_that_is_no_number_ends_in_the_peak_and_raises_nothing(scheme, bad, column):
    box, gas, dt, position, state = case(1, "jittered")
    state[5, column] = bad
    with np.errstate(invalid="ignore"):
        run = take(scheme, box, gas, dt, position, state, 2)
    assert not np.isfinite(run.physics.peak)

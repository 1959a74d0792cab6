"""The implicit midpoint rule: the dense one at long time steps, what it conserves, and how it fails."""

import gc
import sys
from dataclasses import replace
from weakref import ref

import numpy as np
import pytest
from petsc4py import PETSc

from covering_helpers import covering
from dense_helpers import close, pattern
from mpipic.errors import NotConverged
from mpipic.physics.acoustics.reference import MovingReference
from scheme_helpers import Run, label
from spline_helpers import Gas, Scheme, Splines, run_steps, short_step

BOXES = {1: ((16,), (1.0,)), 2: ((6, 5), (1.5, 2.5))}
SKEW = Scheme("quadratic", "consistent", "skew", "exact", "midpoint")
GRID = Scheme("cubic", "consistent", "grid", "exact", "midpoint", gradient_order=6)
PENALISED = Scheme("cubic", "penalised", "grid", "exact", "midpoint", damping=4, gradient_order=10)
DIRECT = Scheme("linear", "lumped", "direct", "local", "midpoint")
REFERENCE = Scheme("quadratic", "consistent", "direct", "svd", "midpoint")
SCHEMES = [SKEW, GRID, PENALISED, DIRECT, REFERENCE]

every_basis = pytest.mark.parametrize("basis", ["linear", "quadratic", "cubic"])
every_scheme = pytest.mark.parametrize("scheme", SCHEMES, ids=label)
every_dimension = pytest.mark.parametrize("dim", [1, 2])


def integrator_of(run):
    stepper = run.stepper
    step = stepper.reference if isinstance(stepper, MovingReference) else stepper
    return step.scheme.integrate


def case(dim, name="random", cfl=5.0, flow=(0.0, 0.0), boxes=BOXES):
    """Box, gas, time step, positions and state; 4 particles a cell."""
    cells, length = boxes[dim]
    gas = Gas(1.7, 1.3, flow[:dim])
    position = pattern(name, cells, length)
    state = np.random.default_rng(3).standard_normal((len(position), 1 + dim))
    return (cells, length), gas, cfl * min(np.array(length) / cells) / gas.sound_speed, position, state


def run_of(scheme, box, gas, dt, position, state):
    return Run(scheme, *box, gas, dt, position, state)


@pytest.fixture
def options():
    """Set PETSc's options by name, without the prefix; forgotten after the test."""
    database, names = PETSc.Options(), []

    def give(**values):
        for name, value in values.items():
            names.append(f"midpoint_{name}")
            database[names[-1]] = value

    yield give
    for name in names:
        database.delValue(name)


# ---------------------------------------------------------------- the steps


@pytest.mark.parametrize(
    ("scheme", "dim", "cfl", "flow"),
    covering(2, SCHEMES, (1, 2), (1.0, 20.0), ((0.0, 0.0), (0.02, -0.3))),
    ids=lambda value: label(value) if isinstance(value, Scheme) else None,
)
def test_steps_are_those_of_the_dense_implicit_midpoint_rule(scheme, dim, cfl, flow):
    """The longer the time step, the more of the solvers' residuals, 1e-12, comes through."""
    allowed = {1.0: 1e-11, 20.0: 1e-8}[cfl]
    box, gas, dt, position, state = case(dim, "jittered", cfl, flow)
    found = run_of(scheme, box, gas, dt, position, state).steps(3).result
    wanted = run_steps(short_step, scheme, gas, dt, *box, position, state, 3)
    close(found[0], wanted[0], 1e-13)
    close(found[1], wanted[1], allowed)
    assert np.abs(wanted[1] - state).max() > 0.1


@pytest.mark.parametrize(
    "scheme, symmetric",
    [
        (GRID, True),
        (replace(GRID, filter="none"), True),
        (PENALISED, True),
        (replace(GRID, filter="local"), False),
        (replace(GRID, mass="lumped"), False),
        (SKEW, False),
        (REFERENCE, False),
    ],
    ids=lambda value: label(value) if isinstance(value, Scheme) else "",
)
def test_conjugate_gradients_serve_where_the_operator_is_symmetric(scheme, symmetric):
    """R U, built column by column, is symmetric and negative just where it is taken to be so."""
    box, gas, dt, position, _ = case(1)
    midpoint = integrator_of(run_of(scheme, box, gas, dt, position, np.zeros((len(position), 2))))
    assert midpoint.solver.symmetric is symmetric
    splines = Splines(scheme.basis, *box, position)
    slope = splines.field_slopes(scheme)[0]
    product = slope @ slope
    assert np.allclose(product, product.T, atol=1e-9 * np.abs(product).max()) == symmetric
    if symmetric:
        assert np.linalg.eigvalsh(0.5 * (product + product.T)).max() < 1e-9 * np.abs(product).max()


@every_scheme
@pytest.mark.parametrize("method", ["gmres", "fgmres", "bcgs"])
def test_other_methods_of_petsc_give_the_same_steps(scheme, method, options):
    box, gas, dt, position, state = case(1)
    expected = run_of(scheme, box, gas, dt, position, state).steps(2).result[1]
    options(ksp_type=method, ksp_gmres_restart=100)
    close(run_of(scheme, box, gas, dt, position, state).steps(2).result[1], expected, 1e-9)


# ---------------------------------------------------------------- what it conserves


def energy(gas, state):
    """(c²/ρ₀)² Σρ² / c² + Σ|u|², up to a factor the acoustic energy."""
    return gas.sound_speed**2 / gas.density**2 * np.sum(state[:, 0] ** 2) + np.sum(state[:, 1:] ** 2)


@pytest.mark.parametrize("basis, dim", [("linear", 1), ("quadratic", 1), ("cubic", 1), ("quadratic", 2)])
def test_with_skew_gradients_on_fixed_particles_their_energy_is_conserved(basis, dim):
    """dρ/dt = -ρ₀ Σ_a K^a u_a, du_a/dt = -(c²/ρ₀) K^a ρ with K^a = G⁺ ½(C^a - C^aᵀ), and G K^a is skew: so Σ_p q_p r_p,
    which is the product by G for what the nodes see, is kept for (c/ρ₀) ρ and u together; what they do not see is
    left alone. The midpoint rule keeps quadratic invariants, at CFL 5 too."""
    box, gas, dt, position, state = case(dim, boxes={1: BOXES[1], 2: ((4, 3), (1.0, 1.5))})
    run = run_of(replace(SKEW, basis=basis), box, gas, dt, position, state)
    start = energy(gas, state)
    for _ in range(10):
        assert energy(gas, run.steps(5).result[1]) == pytest.approx(start, rel=1e-10)
    assert np.abs(run.result[1] - state).max() > 0.5


@every_basis
def test_with_direct_gradients_it_is_not(basis):
    box, gas, dt, position, state = case(1)
    run = run_of(replace(SKEW, basis=basis, gradient="direct"), box, gas, dt, position, state)
    assert abs(energy(gas, run.steps(5).result[1]) / energy(gas, state) - 1.0) > 1e-3


@every_basis
@pytest.mark.parametrize("dim, order", [(1, 2), (1, 10), (2, 6)])
def test_with_gradients_on_the_grid_the_energy_of_the_nodal_fields_is_conserved(basis, dim, order):
    """Central differences are skew in the plain product over nodes, and consistent fields answer with the increment."""
    box, gas, dt, position, state = case(dim)
    scheme = replace(GRID, basis=basis, gradient_order=order)
    fields = Splines(basis, *box, position).mass(scheme)
    run = run_of(scheme, box, gas, dt, position, state)
    start = energy(gas, fields @ state)
    for _ in range(5):
        assert energy(gas, fields @ run.steps(10).result[1]) == pytest.approx(start, rel=1e-10)
    assert np.abs(run.result[1] - state).max() > 0.5


@pytest.mark.parametrize("scheme", [SKEW, GRID, DIRECT, REFERENCE], ids=label)
@every_dimension
def test_on_fixed_particles_a_step_with_the_velocity_turned_round_goes_back(scheme, dim):
    box, gas, dt, position, state = case(dim)
    there = run_of(scheme, box, gas, dt, position, state).steps(1).result[1]
    assert np.abs(there - state).max() > 0.1
    turn = np.array([1.0, *[-1.0] * dim])
    back = run_of(scheme, box, gas, dt, position, there * turn).steps(1).result[1]
    close(back * turn, state, 1e-10)


# ---------------------------------------------------------------- how it fails


@every_scheme
@every_dimension
def test_too_few_iterations_are_an_error_that_says_how_far_it_came(scheme, dim, options):
    options(ksp_max_it=1)
    run = run_of(scheme, *case(dim, cfl=20.0))
    with pytest.raises(NotConverged, match=r"implicit midpoint rule ended at residual \S+ after 1 iterations; asked"):
        run.steps(1)


def test_after_such_an_error_a_step_can_be_taken_with_enough_of_them(options):
    options(ksp_max_it=1)
    broken = run_of(GRID, *case(1, cfl=20.0))
    with pytest.raises(NotConverged):
        broken.steps(1)
    PETSc.Options().delValue("midpoint_ksp_max_it")
    assert np.isfinite(run_of(GRID, *case(1, cfl=20.0)).steps(1).result[1]).all()


@pytest.mark.parametrize(
    ("scheme", "dim", "bad", "column"),
    covering(2, SCHEMES, (1, 2), (np.nan, np.inf, -np.inf), (0, -1)),
    ids=lambda value: label(value) if isinstance(value, Scheme) else None,
)
def test_a_state_that_is_no_number_gives_nan_and_no_error(scheme, dim, bad, column):
    box, gas, dt, position, state = case(dim, flow=(0.02, -0.3))
    state[3, column] = bad
    with np.errstate(invalid="ignore"):
        run = run_of(scheme, box, gas, dt, position, state).steps(2)
    assert np.isnan(run.result[1][:, 0]).any() and not np.isfinite(run.physics.peak)


@every_scheme
def test_the_solver_is_made_once_and_begins_at_the_present_density(scheme):
    """A state that does not change is its own solution, but for rounding."""
    box, gas, dt, position, state = case(1, "lattice")
    uniform = np.broadcast_to([2.0, -0.7], state.shape).copy()
    run = run_of(scheme, box, gas, dt, position, uniform)
    run.steps(1)
    midpoint = integrator_of(run)
    solver = midpoint.solver.ksp
    run.steps(2)
    assert midpoint.solver.ksp is solver and midpoint.solver.iterations <= 2
    close(run.result[1], uniform, 1e-11)


@every_scheme
def test_a_run_that_is_dropped_gives_its_solvers_back_without_complaint(scheme, monkeypatch):
    complaints = []
    monkeypatch.setattr(sys, "unraisablehook", lambda found: complaints.append(repr(found.exc_value)))
    run = run_of(scheme, *case(1)).steps(1)
    midpoint = ref(integrator_of(run))
    del run
    gc.collect()
    assert midpoint() is None and complaints == []

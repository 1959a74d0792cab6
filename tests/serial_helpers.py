"""The package's parts on one rank, and nodal arrays to and from the numbering of `dense_helpers`."""

from __future__ import annotations

from functools import cache

import numpy as np
from mpi4py import MPI

from dense_helpers import GRIDS, Dense, pattern
from mpipic.filters import FILTERS
from mpipic.mapping.linear_sweep import LinearSweep
from mpipic.mapping.mapping import Mapping
from mpipic.mapping.mass import LumpedMass, Workspace
from mpipic.mesh.grid import Grid
from mpipic.particles.store import Particles
from mpipic.physics.acoustics.damping import Damping
from mpipic.physics.acoustics.gas import Gas
from mpipic.physics.acoustics.integrators import Symplectic
from mpipic.physics.acoustics.reference import MovingReference, ParticleScheme, ReferenceStep
from mpipic.physics.acoustics.slopes import FilteredSlopes, UnfilteredSlopes
from mpipic.physics.acoustics.step import AcousticStep, Scheme


@cache
def grid_of(cells, length):
    return Grid(cells, length, MPI.COMM_SELF)


def on_nodes(grid, nodal):
    """Own nodes of a local array, (local_nodes, ...) to (nodes, ...), numbered as in `dense_helpers`."""
    return grid.owned(nodal).reshape((grid.node_count, *nodal.shape[1:]))


def ghosted(grid, values):
    """A local array with these values (nodes,) or (nodes, k) on own nodes and their copies on ghosts."""
    nodal = grid.zeros(values[0].size)
    grid.owned(nodal)[...] = values.reshape((*grid.cells, -1))
    grid.fill_halo(nodal)
    return nodal.reshape((-1, *values.shape[1:]))


def particles_of(grid, position, density=None, velocity=None):
    """Particles numbered 0, 1, ... with these fields, or zeros."""
    n = len(position)
    state = np.zeros((n, 1 + grid.dim))
    if density is not None:
        state[:, 0] = density
    if velocity is not None:
        state[:, 1:] = velocity
    particles = Particles(grid.h, {"density": (), "velocity": (grid.dim,)})
    particles.append(grid.coordinate_of(position), state, np.arange(n))
    return particles


def sweep_of(grid, position, density=None, velocity=None, displacement=None):
    particles = particles_of(grid, position, density, velocity)
    return LinearSweep(grid, particles, displacement if displacement is not None else np.zeros(grid.dim))


def by_id(particles):
    """Position, density and velocity in the order of the ids 0, 1, ..., n - 1, each of which there must be once."""
    order = np.argsort(particles.ids)
    assert np.array_equal(particles.ids[order], np.arange(particles.count))
    return particles.position[order], particles["density"][order], particles["velocity"][order]


def gram_times(sweep, values):
    """G times the columns of values (nodes, k)."""
    grid = sweep.grid
    return on_nodes(grid, sweep.gram.apply(ghosted(grid, values)))


def gram_matrix(sweep):
    return gram_times(sweep, np.eye(sweep.grid.node_count))


def gradient_sums(sweep, values):
    """ΦᵀD^a of values (nodes,): (nodes, d)."""
    grid = sweep.grid
    out = sweep.gradient_sums(ghosted(grid, values[:, None]), out=grid.zeros(grid.dim))
    return on_nodes(grid, sweep.complete(out))


def divergence_sums(sweep, values):
    """Σ_a ΦᵀD^a of values (nodes, d): (nodes,)."""
    grid = sweep.grid
    out = sweep.divergence_sums(ghosted(grid, values), out=grid.zeros(1))
    return on_nodes(grid, sweep.complete(out))[:, 0]


# h is a power of two: coordinates, positions and moves are exact, in the reference too
EXACT = {1: ((8,), (1.0,)), 2: ((4, 6), (1.0, 3.0)), 3: ((4, 3, 5), (8.0, 3.0, 0.625))}


def case(box, name):
    cells, length = GRIDS[box]
    position = pattern(name, cells, length)
    return grid_of(cells, length), position, Dense(cells, length, position)


SETTINGS = {"exact": {"tolerance": 1e-13}}
"""Kind to settings other than the defaults: a solver's residual is to leave little of the errors allowed below."""
ITERATIVE = {"exact": 1e-11}
"""Kind to the relative error allowed where the answer is a solver's: a hundred times the residual it stops at.

All other kinds are direct, and are held to rounding alone, as each test says.
"""


def make(kind, mapping):
    """The filter of that kind, as accurate as it gets."""
    return FILTERS[kind](mapping, **SETTINGS.get(kind, {}))


def allowed(kind, rounding):
    """Relative error allowed to a kind where direct ones have `rounding`."""
    return max(rounding, ITERATIVE.get(kind, 0.0))


def values(n, *shape, seed=5):
    return np.random.default_rng(seed).standard_normal((n, *shape))


# ---------------------------------------------------------------- Formulation 2


def gas_of(rates, flow=()):
    """A gas whose rates dt ρ₀ and dt c²/ρ₀ are these for dt = 1."""
    return Gas(float(np.sqrt(rates[0] * rates[1])), tuple(flow), float(rates[0]))


def euler_step(kind, sweep, rates, settings=None):
    """The paper's step on nodal arrays, for a filter that has a form there, or none."""
    work = Workspace(sweep.grid.local_nodes, again=True)
    if kind == "none":
        slopes = UnfilteredSlopes(sweep, work)
    else:
        filter_ = make(kind, sweep) if settings is None else FILTERS[kind](sweep, **settings)
        filter_.strict = False  # as in a run
        slopes = FilteredSlopes(sweep, work, filter_)
    scheme = Scheme(LumpedMass(sweep), slopes, Symplectic(), Damping(), work)
    return AcousticStep(sweep, gas_of(rates), 1.0, scheme)


def plain_step(kind, mapping, rates, flow=()):
    """The paper's step on particle values, for any filter."""
    keep = None if kind == "none" else make(kind, mapping)
    if keep is not None:
        keep.strict = False
    return ReferenceStep(mapping, gas_of(rates, flow), 1.0, ParticleScheme(LumpedMass(mapping), Symplectic(), keep))


def moving_reference(kind, grid, particles, rates, displacement):
    """The same for particles of a run, which then move."""
    return MovingReference(particles, plain_step(kind, Mapping.at(grid, particles), rates, displacement))

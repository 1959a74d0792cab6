"""From a scene to the parts that it names: the one place that knows both, and which parts go together."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from mpipic import filters
from mpipic.arrays import FloatArray, IntArray
from mpipic.filters import Filter, NodalFilter
from mpipic.mapping import sweep
from mpipic.mapping.base import NodalMapping
from mpipic.mapping.mapping import Mapping
from mpipic.mapping.mass import LeastSquaresMass, LumpedMass, Mass, Workspace, penalty_of
from mpipic.mapping.sweep import ParticleSweep
from mpipic.mesh.grid import Grid
from mpipic.particles.layouts import LAYOUTS, share
from mpipic.particles.migration import Routes, packed, unpacked
from mpipic.particles.store import Particles
from mpipic.physics.acoustics import solutions
from mpipic.physics.acoustics.damping import Damping
from mpipic.physics.acoustics.gas import Gas
from mpipic.physics.acoustics.integrators import INTEGRATORS, Integrator
from mpipic.physics.acoustics.physics import Acoustics, Solution, Stepper
from mpipic.physics.base import Physics
from mpipic.scene.records import Problem, Scene, SceneError

if TYPE_CHECKING:
    from mpipic.physics.acoustics.slopes import Slopes
    from mpipic.physics.acoustics.step import AcousticStep

Phase = Callable[[str], None]


def _no_phase(name: str) -> None:
    return


# ---------------------------------------------------------------- physics


def physics_of(scene: Scene) -> Physics:
    """Return the scene's physics, not yet in its place on particles. Local."""
    return PHYSICS["acoustics"](scene)


def _acoustics(scene: Scene) -> Acoustics:
    def compose(grid: Grid, particles: Particles, phase: Phase) -> Stepper:
        return _stepper(scene, grid, particles, phase)

    return Acoustics(gas_of(scene), solution_of(scene), compose)


PHYSICS: dict[str, Callable[[Scene], Physics]] = {"acoustics": _acoustics}
"""Kind to what builds it from a scene."""


def gas_of(scene: Scene) -> Gas:
    """Return the constants of the scene's gas."""
    return Gas(scene.gas.sound_speed, scene.gas.flow, scene.gas.density)


def solution_of(scene: Scene) -> Solution | None:
    """Return initial data and exact solution as one function of (x, t); None where a file gives the state."""
    if scene.initial.profile == "file":
        return None
    initial = scene.initial
    try:
        return solutions.solution(
            initial.profile,
            length=scene.grid.length,
            gas=gas_of(scene),
            center=initial.center,
            sharpness=initial.sharpness,
            wave=initial.wave,
        )
    except ValueError as error:
        raise SceneError([Problem("initial", initial.profile, str(error))]) from None


# ---------------------------------------------------------------- grid and particles


def place(scene: Scene, comm: MPI.Comm, physics: Physics | None = None) -> tuple[Grid, Particles]:
    """Return the scene's grid, and its particles at t = 0 on the ranks that own their cells. Collective."""
    grid = Grid(scene.grid.cells, scene.grid.length, comm, scene.mapping.basis)
    return grid, populate(scene, grid, physics or physics_of(scene))


def populate(scene: Scene, grid: Grid, physics: Physics) -> Particles:
    """Return the scene's particles at t = 0 on the ranks that own their cells, with the fields of the physics.

    Every rank makes a block of consecutive ids; then each particle goes to its owner. Collective.
    """
    particles = Particles(grid.h, physics.fields(grid.dim))
    if scene.particles.layout == "file":
        ids, coordinate, state = _read_particles(scene, grid, particles)
    else:
        ids = share(scene.particle_count or 0, grid)
        layout = LAYOUTS[scene.particles.layout]
        drawn = layout(grid, scene.particles.per_cell, scene.particles.jitter, scene.particles.seed, ids)
        coordinate, state = grid.wrapped(drawn), particles.state_of({}, len(ids))
    if grid.size > 1:
        rows = Routes(grid).exchange(packed(coordinate, state, ids), grid.owner_of(coordinate)).rows
        coordinate, state, ids = unpacked(rows, grid.dim)
    particles.append(coordinate, state, ids)
    begin(particles, physics)
    return particles


def begin(particles: Particles, physics: Physics) -> None:
    """Give particles the initial values of the physics where they are; those that a file gave stay. Local."""
    for name, values in (physics.initial(particles.position) or {}).items():
        particles[name] = values


def _read_particles(scene: Scene, grid: Grid, particles: Particles) -> tuple[IntArray, FloatArray, FloatArray]:
    from mpipic.io.particle_file import ParticleFileError, read_particle_file

    try:
        rows = read_particle_file(scene.particles.path, grid.length, particles.shapes, grid.comm)
    except ParticleFileError as error:
        raise SceneError([Problem("particles.path", None, text) for text in error.problems]) from None
    known = rows.fields if scene.initial.profile == "file" else {}
    return rows.ids, grid.coordinate_of(rows.position), particles.state_of(known, len(rows.ids))


def check_filter(scene: Scene, particles: int, comm: MPI.Comm, kind: str | None = None) -> None:
    """Raise SceneError on all ranks for a filter, the scene's or `kind`, that there is no memory for. Collective."""
    if (kind or scene.filter.kind) != "svd":
        return
    from mpipic.filters.row_space import TooLarge, check_memory

    try:
        check_memory(scene.cell_count, particles, comm)
    except TooLarge as error:
        raise SceneError([Problem("filter.kind", "svd", str(error))]) from None


# ---------------------------------------------------------------- the step of acoustics


def _stepper(scene: Scene, grid: Grid, particles: Particles, phase: Phase) -> Stepper:
    """The scene's step: on nodal arrays, or for a filter that has no nodal form, on particle values."""
    if scene.filter.kind == "svd" and scene.mapping.gradient != "grid":
        return _reference(scene, grid, particles, phase)
    return step_on(scene, build_sweep(scene, grid, particles, phase))


def build_sweep(scene: Scene, grid: Grid, particles: Particles, phase: Phase = _no_phase) -> ParticleSweep:
    """Return the scene's particles, mapped. Collective."""
    displacement = [v * scene.dt for v in scene.gas.flow]
    return sweep.create(grid, particles, displacement, phase, transposed=scene.mapping.gradient == "skew")


def step_on(scene: Scene, carrier: ParticleSweep) -> AcousticStep:
    """Return the scene's step on nodal arrays for the particles of a sweep. Collective."""
    from mpipic.physics.acoustics.step import AcousticStep, Scheme

    mapping, kind = scene.mapping, scene.filter.kind
    # gradients on the nodes are in the range of the projection: it would change nothing
    idle = mapping.gradient == "grid" and kind in ("none", "exact", "svd")
    keep = None if idle or kind == "none" else filters.create(kind, carrier, scene.filter)
    assert keep is None or isinstance(keep, NodalFilter)
    integrate = _integrator(scene, symmetric=idle and mapping.mass != "lumped")
    damping = _damping(scene, carrier.grid)
    work = Workspace(carrier.grid.local_nodes, again=integrate.looks_once and not damping.acts)
    slopes = _slopes(scene, carrier, work, keep)
    scheme = Scheme(_mass(scene, carrier), slopes, integrate, damping, work)
    return AcousticStep(carrier, gas_of(scene), scene.dt, scheme)


def _reference(scene: Scene, grid: Grid, particles: Particles, phase: Phase) -> Stepper:
    from mpipic.mesh.differences import CentralDifference
    from mpipic.physics.acoustics.reference import MovingReference, ParticleScheme, ReferenceStep

    mapping = Mapping.at(grid, particles, phase=phase)
    keep: Filter | None = None
    if scene.filter.kind != "none":
        keep = filters.create(scene.filter.kind, mapping, scene.filter)
    order = scene.mapping.gradient_order if scene.mapping.gradient == "grid" else 0
    scheme = ParticleScheme(
        _mass(scene, mapping),
        _integrator(scene, symmetric=False),
        keep,
        CentralDifference(grid, order) if order else None,
        _damping(scene, grid),
    )
    return MovingReference(particles, ReferenceStep(mapping, gas_of(scene), scene.dt, scheme))


def _slopes(scene: Scene, carrier: ParticleSweep, work: Workspace, keep: NodalFilter | None) -> Slopes:
    from mpipic.mapping.spline_sweep import SplineSweep
    from mpipic.physics.acoustics.slopes import FilteredSlopes, GridSlopes, SkewSlopes, UnfilteredSlopes

    if scene.mapping.gradient == "grid":
        return GridSlopes(carrier, work, scene.mapping.gradient_order, keep)
    if keep is None:
        return UnfilteredSlopes(carrier, work)
    if scene.mapping.gradient == "skew":
        assert isinstance(carrier, SplineSweep)
        return SkewSlopes(carrier, work, keep)
    return FilteredSlopes(carrier, work, keep)


def _mass(scene: Scene, mapping: NodalMapping) -> Mass:
    if scene.mapping.mass == "lumped":
        return LumpedMass(mapping)
    return LeastSquaresMass(mapping, scene.filter.tolerance, penalty_of(scene.mapping))


def _integrator(scene: Scene, symmetric: bool) -> Integrator:
    if scene.time.integrator == "midpoint":
        from mpipic.physics.acoustics.midpoint import Midpoint

        return Midpoint(max(scene.filter.tolerance, 1e-14), symmetric)
    return INTEGRATORS[scene.time.integrator]()


def _damping(scene: Scene, grid: Grid) -> Damping:
    settings, low_pass = scene.damping, None
    if settings.order:
        from mpipic.mesh.differences import LowPass

        travel = settings.strength * scene.gas.sound_speed * scene.dt / np.array(grid.h)
        low_pass = LowPass(grid, settings.order, np.minimum(1.0, travel))
    return Damping(low_pass, min(1.0, settings.null_space * scene.cfl))

"""From a scene to the parts that it names: the one place that knows both, and which parts go together."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

import mpipic.run.parts  # noqa: F401  all that scenes can name
from mpipic.arrays import FloatArray, IntArray, Shape
from mpipic.console import Console
from mpipic.filters import FILTERS, Filter, NodalFilter, TooLarge
from mpipic.mapping import sweeps
from mpipic.mapping.base import NodalMapping
from mpipic.mapping.mapping import Mapping
from mpipic.mapping.mass import MASSES, Mass, Workspace
from mpipic.mapping.sweep import ParticleSweep
from mpipic.mesh.grid import Grid
from mpipic.particles.layouts import LAYOUTS, share
from mpipic.particles.migration import Routes, packed, unpacked
from mpipic.particles.store import Particles
from mpipic.parts import LEAST_SQUARES, NODAL_GRADIENTS
from mpipic.physics.acoustics.damping import Damping
from mpipic.physics.acoustics.gas import Gas
from mpipic.physics.acoustics.integrators import INTEGRATORS, Integrator
from mpipic.physics.acoustics.physics import Acoustics, Solution, Stepper
from mpipic.physics.acoustics.slopes import GRADIENTS
from mpipic.physics.acoustics.solutions import PROFILES
from mpipic.physics.base import Physics
from mpipic.scene.records import Problem, Scene, SceneError

if TYPE_CHECKING:
    from mpipic.io.particle_file import Request
    from mpipic.physics.acoustics.step import AcousticStep

Phase = Callable[[str], None]


def _no_phase(name: str) -> None:
    return


# ---------------------------------------------------------------- physics


def physics_of(scene: Scene) -> Physics:
    """Return the scene's physics, not yet in its place on particles. Local."""
    return PHYSICS[scene.physics.kind](scene)


def _acoustics(scene: Scene) -> Acoustics:
    def compose(grid: Grid, particles: Particles, phase: Phase) -> Stepper:
        return _stepper(scene, grid, particles, phase)

    return Acoustics(gas_of(scene), solution_of(scene), compose)


PHYSICS: dict[str, Callable[[Scene], Physics]] = {"acoustics": _acoustics}
"""Kind to what builds it from a scene."""


def gas_of(scene: Scene) -> Gas:
    """Return the constants of the scene's gas."""
    return Gas(**scene.values.settings(Gas))


def solution_of(scene: Scene) -> Solution | None:
    """Return initial data and exact solution as one function of (x, t); None where a file gives the state."""
    profile = PROFILES.get(scene.initial.profile)
    if profile is None:
        return None
    try:
        return profile(length=scene.grid.length, gas=gas_of(scene), **scene.settings("initial.profile"))
    except ValueError as error:
        raise SceneError([Problem("initial", scene.initial.profile, str(error))]) from None


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
    total = scene.particle_count
    if total is None:
        ids, coordinate, state = _read_particles(scene, grid, particles)
    else:
        ids = share(total, grid)
        drawn = LAYOUTS[scene.particles.layout].coordinates(grid, ids, **scene.settings("particles.layout"))
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
    from mpipic.io.particle_file import Box, read_particle_file

    with _of_the_scene():
        rows = read_particle_file(_request(scene, particles.shapes), Box(grid.length, grid.h), grid.comm)
    _say(rows.notes, grid.comm)
    return rows.ids, _coordinate_at(grid, rows.position), particles.state_of(rows.fields, len(rows.ids))


def _coordinate_at(grid: Grid, position: FloatArray) -> FloatArray:
    """Return coordinates in cells whose positions are those given to the last bit, where there are any. Local.

    Positions divided by the spacing are rounded twice, and may end a quantum beside the coordinate they were made of.
    """
    coordinate, inside, h = grid.coordinate_of(position), grid.in_box(position), np.array(grid.h)
    last = np.array(grid.cells) - np.array(grid.tolerance)
    for step in (np.array(grid.quantum), -np.array(grid.quantum)):
        other = coordinate + step
        better = (np.maximum(coordinate, 0.0) * h != inside) & (other * h == inside) & (other >= 0.0) & (other < last)
        coordinate = np.where(better, other, coordinate)
    return coordinate


def check_particles(scene: Scene, comm: MPI.Comm) -> None:
    """Raise SceneError on all ranks for a particle file that a run would refuse; reads it through. Collective."""
    if scene.particle_count is not None:
        return
    from mpipic.io.particle_file import Box, check_particle_file

    with _of_the_scene():
        request = _request(scene, dict(physics_of(scene).fields(scene.dim)))
        _say(check_particle_file(request, Box(scene.grid.length, scene.h), comm), comm)


def _say(notes: Sequence[str], comm: MPI.Comm) -> None:
    for note in notes:
        Console(comm).warning(note)


@contextmanager
def _of_the_scene() -> Iterator[None]:
    """Make what is wrong with a particle file the mistake of a scene."""
    from mpipic.io.particle_file import ParticleFileError

    try:
        yield
    except ParticleFileError as error:
        raise SceneError([Problem("particles.path", None, text) for text in error.problems]) from None


def _request(scene: Scene, fields: dict[str, Shape]) -> Request:
    """Return what the scene wants of its particle file: fields only where no profile gives them."""
    from mpipic.io.particle_file import Request

    settings = scene.settings("particles.layout")
    pairs = [entry.partition("=") for entry in settings.pop("records")]
    records = {name.strip(): record.strip() for name, _, record in pairs}
    given = scene.initial.profile in PROFILES
    giver = f'initial.profile = "{scene.initial.profile}" gives what "file" would take from there'
    return Request(
        dim=scene.dim,
        fields={} if given else fields,
        records=records,
        elsewhere={name: giver for name in fields} if given else {},
        **settings,
    )


def check_filter(scene: Scene, particles: int, comm: MPI.Comm, kind: str | None = None) -> None:
    """Raise SceneError on all ranks for a filter, the scene's or `kind`, that there is no memory for. Collective."""
    keep = FILTERS[kind] if kind else _acting_filter(scene)
    try:
        if keep is not None:
            keep.check_memory(scene.cell_count, particles, comm)
    except TooLarge as error:
        raise SceneError([Problem("filter.kind", keep.kind if keep else None, str(error))]) from None


# ---------------------------------------------------------------- the step of acoustics


def _stepper(scene: Scene, grid: Grid, particles: Particles, phase: Phase) -> Stepper:
    """Return the scene's step: on nodal arrays, or for a filter that has no nodal form, on particle values."""
    keep = _acting_filter(scene)
    if keep is not None and not issubclass(keep, NodalFilter):
        return _reference(scene, grid, particles, phase)
    return step_on(scene, build_sweep(scene, grid, particles, phase))


def _acting_filter(scene: Scene) -> type[Filter] | None:
    """Return the scene's filter; None if there is none, or it changes nothing."""
    keep = FILTERS.get(scene.filter.kind)
    return keep if keep is not None and keep.acts(scene.values) else None


def build_sweep(scene: Scene, grid: Grid, particles: Particles, phase: Phase = _no_phase) -> ParticleSweep:
    """Return the scene's particles, mapped. Collective."""
    displacement = [v * scene.dt for v in scene.gas.flow]
    transposed = GRADIENTS[scene.mapping.gradient].transposed
    return sweeps.create(grid, particles, displacement, phase, transposed=transposed)


def step_on(scene: Scene, carrier: ParticleSweep) -> AcousticStep:
    """Return the scene's step on nodal arrays for the particles of a sweep. Collective."""
    from mpipic.physics.acoustics.step import AcousticStep, Scheme

    values, kind = scene.values, _acting_filter(scene)
    keep = kind(carrier, **scene.settings("filter.kind")) if kind else None
    assert keep is None or isinstance(keep, NodalFilter)
    if keep is not None:
        keep.strict = False
    # least-squares fields of what has been in range(Φ) all the time
    symmetric = keep is None and values.has(NODAL_GRADIENTS) and values.has(LEAST_SQUARES)
    integrate = _integrator(scene, symmetric)
    damping = Damping.create(values, carrier.grid)
    work = Workspace(carrier.grid.local_nodes, again=integrate.looks_once and not damping.acts)
    gradient = GRADIENTS[scene.mapping.gradient]
    slopes = gradient.create(carrier, work, keep, **scene.settings("mapping.gradient"))
    scheme = Scheme(_mass(scene, carrier), slopes, integrate, damping, work)
    return AcousticStep(carrier, gas_of(scene), scene.dt, scheme)


def _reference(scene: Scene, grid: Grid, particles: Particles, phase: Phase) -> Stepper:
    from mpipic.physics.acoustics.reference import MovingReference, ParticleScheme, ReferenceStep

    mapping = Mapping.at(grid, particles, phase=phase)
    keep = FILTERS[scene.filter.kind](mapping, **scene.settings("filter.kind"))
    damping = Damping.create(scene.values, grid)
    scheme = ParticleScheme(_mass(scene, mapping), _integrator(scene, symmetric=False), keep, None, damping)
    return MovingReference(particles, ReferenceStep(mapping, gas_of(scene), scene.dt, scheme))


def _mass(scene: Scene, mapping: NodalMapping) -> Mass:
    return MASSES[scene.mapping.mass](mapping, **scene.settings("mapping.mass"))


def _integrator(scene: Scene, symmetric: bool) -> Integrator:
    return INTEGRATORS[scene.time.integrator].create(symmetric, **scene.settings("time.integrator"))

"""From a scene to the step that it names: the one place that knows which parts go together."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

from mpipic import filters
from mpipic.filters import ExactFilter, Filter, NodalFilter
from mpipic.mapping import sweep
from mpipic.mapping.mapping import Mapping, NodalMapping
from mpipic.mapping.sweep import ParticleSweep
from mpipic.mesh.grid import Grid
from mpipic.particles.store import Particles
from mpipic.phases import Phases
from mpipic.physics.acoustics import formulation
from mpipic.physics.acoustics.formulation import OnParticles, Update
from mpipic.scene.records import Scene

if TYPE_CHECKING:
    from mpipic.mapping.mass import Mass
    from mpipic.physics.acoustics.integrators import Integrator
    from mpipic.physics.acoustics.schemes import Damping, Gas, NodalScheme
    from mpipic.physics.acoustics.slopes import Slopes


class Formulation(Protocol):
    """One time step after another."""

    @property
    def nbytes(self) -> int:
        """Bytes of arrays that live as long as the run."""
        ...

    def forget(self) -> None:
        """Begin anew after particles were changed from outside. Collective."""
        ...

    def step(self) -> None:
        """Take density, velocity and positions from t to t + dt. Collective."""
        ...


def is_formulation_2(scene: Scene) -> bool:
    """Whether the scene's step is the paper's, but for basis and filter: then it has a faster form of its own."""
    mapping = scene.mapping
    plain = (
        mapping.mass == "lumped"
        and mapping.gradient == "direct"
        and not (scene.damping.order or scene.damping.null_space)
    )
    return plain and scene.time.integrator == "symplectic"


def build_sweep(scene: Scene, grid: Grid, particles: Particles, phases: Phases) -> ParticleSweep:
    """The scene's particles, mapped. Collective."""
    displacement = [v * scene.dt for v in scene.gas.flow]
    return sweep.create(grid, particles, displacement, phases, transposed=scene.mapping.gradient == "skew")


def build_step(scene: Scene, carrier: ParticleSweep) -> Formulation:
    """The scene's step on these particles. Collective."""
    if is_formulation_2(scene):
        gas = scene.gas
        rates = formulation.Rates(scene.dt * gas.density, scene.dt * gas.sound_speed**2 / gas.density)
        return formulation.symplectic(carrier, rates, scene.filter)
    return _high_order(scene, carrier)


def _high_order(scene: Scene, carrier: ParticleSweep) -> Formulation:
    from mpipic.physics.acoustics import schemes

    settings, on_grid = scene.filter, scene.mapping.gradient == "grid"
    if settings.kind != "svd" or on_grid:
        return build_rates(scene, carrier)
    svd = filters.SvdFilter(carrier)

    def make(mapping: Mapping) -> Update:
        mass, integrate = _mass(scene, mapping), _integrator(scene, symmetric=False)
        damping = _damping(scene, carrier.grid)
        return schemes.PlainScheme(mapping, _gas(scene), scene.dt, mass, integrate, svd, None, damping).step

    return OnParticles(carrier, svd, make)


def build_rates(scene: Scene, carrier: ParticleSweep) -> NodalScheme:
    """The scene's step in its general form on nodes, whichever faster form it may have. Collective."""
    from mpipic.physics.acoustics import schemes
    from mpipic.physics.acoustics.slopes import FilteredSlopes, GridSlopes, UnfilteredSlopes

    mapping, kind = scene.mapping, scene.filter.kind
    on_grid = mapping.gradient == "grid"
    unchanged = on_grid and kind in ("none", "exact", "svd")
    mass = _mass(scene, carrier)
    keep = None if unchanged or kind == "none" else _filter(scene, carrier, mass)
    slopes: Slopes
    if on_grid:
        slopes = GridSlopes(carrier, mass, mapping.gradient_order, keep)
    elif keep is None:
        slopes = UnfilteredSlopes(carrier, mass)
    else:
        slopes = FilteredSlopes(carrier, mass, keep, skew=mapping.gradient == "skew")
    integrate = _integrator(scene, symmetric=unchanged and mapping.mass != "lumped")
    damping = _damping(scene, carrier.grid)
    return schemes.NodalScheme(carrier, _gas(scene), scene.dt, mass, slopes, integrate, damping)


def _gas(scene: Scene) -> Gas:
    from mpipic.physics.acoustics.schemes import Gas

    return Gas(scene.gas.density, scene.gas.sound_speed**2 / scene.gas.density)


def _mass(scene: Scene, mapping: NodalMapping) -> Mass:
    from mpipic.mapping.mass import LeastSquaresMass, LumpedMass, penalty_of

    if scene.mapping.mass == "lumped":
        return LumpedMass(mapping)
    return LeastSquaresMass(mapping, scene.filter.tolerance, penalty_of(scene.mapping))


def _integrator(scene: Scene, symmetric: bool) -> Integrator:
    from mpipic.physics.acoustics.integrators import INTEGRATORS

    if scene.time.integrator == "midpoint":
        from mpipic.physics.acoustics.midpoint import Midpoint

        return Midpoint(max(scene.filter.tolerance, 1e-14), symmetric)
    return INTEGRATORS[scene.time.integrator]


def _filter(scene: Scene, carrier: ParticleSweep, mass: object) -> NodalFilter:
    """The scene's filter; the exact one shares the solver of a least-squares mass without penalty."""
    from mpipic.mapping.mass import LeastSquaresMass

    made: Filter = filters.create(scene.filter.kind, carrier, scene.filter)
    assert isinstance(made, NodalFilter)
    if isinstance(made, ExactFilter) and isinstance(mass, LeastSquaresMass) and not mass.penalised:
        made.solver = mass.solver
    return made


def _damping(scene: Scene, grid: Grid) -> Damping:
    from mpipic.physics.acoustics.schemes import Damping

    settings = scene.damping
    low_pass = None
    if settings.order:
        from mpipic.mesh.differences import LowPass

        travel = settings.strength * scene.gas.sound_speed * scene.dt / np.array(grid.h)
        low_pass = LowPass(grid, settings.order, np.minimum(1.0, travel))
    return Damping(low_pass, min(1.0, settings.null_space * scene.cfl))

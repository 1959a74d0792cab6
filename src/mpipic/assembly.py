"""From a scene to the step that it names: the one place that knows which parts go together."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

from mpipic import filters, formulation, sweep
from mpipic.filters import ExactFilter, Filter, NodalFilter
from mpipic.formulation import OnParticles
from mpipic.grid import Grid
from mpipic.particles import Particles
from mpipic.phases import Phases
from mpipic.scene import Scene
from mpipic.sweep import ParticleSweep

if TYPE_CHECKING:
    from mpipic.grid_operators import LowPass
    from mpipic.schemes import Integrator, PlainScheme


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
    plain = mapping.mass == "lumped" and mapping.gradient == "direct" and not scene.damping.order
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
    from mpipic import schemes

    gas = schemes.Gas(scene.gas.density, scene.gas.sound_speed**2 / scene.gas.density)
    mapping, settings = scene.mapping, scene.filter
    on_grid = mapping.gradient == "grid"
    mass: schemes.Mass = schemes.LumpedMass(carrier)
    if mapping.mass != "lumped":
        mass = schemes.LeastSquaresMass(carrier, settings.tolerance, schemes.penalty_of(mapping))
    symmetric = on_grid and mapping.mass != "lumped" and settings.kind in ("none", "exact", "svd")
    integrate = _integrator(scene, symmetric)
    if settings.kind == "svd" and not on_grid:
        svd = filters.SvdFilter(carrier)
        on_particles = OnParticles(carrier, svd)
        if isinstance(mass, schemes.LumpedMass):
            mass.mapping = on_particles.mapping
        else:
            mass = schemes.LeastSquaresMass(on_particles.mapping, settings.tolerance)
        damping = _damping(scene, carrier.grid)
        plain = schemes.PlainScheme(on_particles.mapping, gas, scene.dt, mass, integrate, svd, None, damping)
        return ReferenceScheme(on_particles, plain)
    slopes: schemes.Slopes
    if on_grid:
        keep = _filter(scene, carrier, mass) if settings.kind not in ("none", "exact", "svd") else None
        slopes = schemes.GridSlopes(carrier, mass, mapping.gradient_order, keep)
    elif settings.kind == "none":
        slopes = schemes.UnfilteredSlopes(carrier, mass)
    else:
        keep = _filter(scene, carrier, mass)
        assert keep is not None
        slopes = schemes.FilteredSlopes(carrier, mass, keep, skew=mapping.gradient == "skew")
    return schemes.NodalScheme(carrier, gas, scene.dt, mass, slopes, integrate, _damping(scene, carrier.grid))


def _integrator(scene: Scene, symmetric: bool) -> Integrator:
    from mpipic.schemes import INTEGRATORS

    if scene.time.integrator == "midpoint":
        from mpipic.midpoint import Midpoint

        return Midpoint(max(scene.filter.tolerance, 1e-12), symmetric)
    return INTEGRATORS[scene.time.integrator]


def _filter(scene: Scene, carrier: ParticleSweep, mass: object) -> NodalFilter:
    """The scene's filter; the exact one shares the solver of a least-squares mass without penalty."""
    from mpipic.schemes import LeastSquaresMass

    made: Filter = filters.create(scene.filter.kind, carrier, scene.filter)
    assert isinstance(made, NodalFilter)
    if isinstance(made, ExactFilter) and isinstance(mass, LeastSquaresMass) and not mass.penalised:
        made.solver = mass.solver
    return made


def _damping(scene: Scene, grid: Grid) -> LowPass | None:
    if not scene.damping.order:
        return None
    from mpipic.grid_operators import LowPass

    travel = scene.damping.strength * scene.gas.sound_speed * scene.dt / np.array(grid.h)
    return LowPass(grid, scene.damping.order, np.minimum(1.0, travel))


class ReferenceScheme:
    """A scheme of high order whose filter only acts on particle values, on the particles of a sweep."""

    def __init__(self, carrier: OnParticles, plain: PlainScheme) -> None:
        self._carrier, self._plain = carrier, plain

    @property
    def nbytes(self) -> int:
        """Bytes of mapping and filter."""
        return self._carrier.nbytes

    def forget(self) -> None:
        """Follow the particles wherever they have been put. Collective."""
        self._carrier.mapping.follow(self._carrier.sweep.particles)

    def step(self) -> None:
        """One time step."""
        self._plain.step(self._carrier.begin().state)
        self._carrier.end()

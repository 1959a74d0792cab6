"""Time steps: how density and velocity perturbations and positions go from t to t + dt.

    Dρ/Dt = -ρ₀ ∇·u,    Du/Dt = -(c²/ρ₀) ∇ρ,    Dx/Dt = v

A step never sees ranks, files or scenes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from mpipic import filters
from mpipic.arrays import FloatArray
from mpipic.filters import Filter, NodalFilter
from mpipic.mapping.mapping import Mapping
from mpipic.mapping.sweep import ParticleSweep

Update = Callable[[FloatArray], None]
"""Changes particle values (n, 1 + d) in place."""


@dataclass(frozen=True)
class Rates:
    """What a time step multiplies gradients with: dt ρ₀ and dt c²/ρ₀."""

    density: float
    velocity: float


class ParticleEuler:
    """Formulation 2, symplectic Euler, written with particle values: the plain form, for any filter.

    u is used at t, ρ at t + dt, F is the filter (the identity when there is none), positions x(t) throughout:

        u_i = S u_p;   ρ_p ← ρ_p - dt ρ₀ F(Σ_a D^a u_i,a);   ρ_i = S ρ_p;   u_p,a ← u_p,a - dt (c²/ρ₀) F(D^a ρ_i)

    Moving the particles is the caller's.

    Notes
    -----
    Collective. Four passes over the particles without a filter, eight with the local one.

    References
    ----------
    Gritton, Berzins, Kirby (2015), section 3.3; the signs here are for the physical unknowns.
    """

    def __init__(self, mapping: Mapping, rates: Rates, keep: Callable[[FloatArray], FloatArray] = lambda q: q) -> None:
        self.mapping, self.rates, self.keep = mapping, rates, keep

    def step(self, density: FloatArray, velocity: FloatArray) -> None:
        """Update density (n,) and velocity (n, d) in place."""
        u = self.mapping.p2g(velocity)
        density -= self.rates.density * self.keep(self.mapping.divergence(u))
        rho = self.mapping.p2g(density)
        velocity -= self.rates.velocity * self.keep(self.mapping.gradient(rho))


class SymplecticEuler:
    """Formulation 2 with a filter F = Φ N Φᵀ: the same step on nodal values, one pass over the particles.

    Within a step the positions are fixed and every update is Φ times nodal coefficients, so the mapped state can be
    updated on the nodes (Φᵀρ_p ← Φᵀρ_p - dt ρ₀ G N Φᵀ Σ_a D^a u_i,a) and the particles get both increments, and their
    displacement, at the end. `ParticleEuler` is the same map; a test holds the two together.

    Notes
    -----
    `step` is collective on neighbours: four pairs of halo exchanges, and migration.
    """

    def __init__(self, sweep: ParticleSweep, rates: Rates, filter_: NodalFilter) -> None:
        self.sweep, self.rates, self.filter = sweep, rates, filter_
        self.nodal = sweep.grid.zeros(1 + sweep.grid.dim)
        self._scalar, self._vector = sweep.grid.zeros(1), sweep.grid.zeros(sweep.grid.dim)

    @property
    def nbytes(self) -> int:
        """Bytes of the nodal work arrays."""
        return self.nodal.nbytes + self._scalar.nbytes + self._vector.nbytes + self.filter.nbytes

    def forget(self) -> None:
        """Begin every series anew: the next step does not know the last. Local."""
        self.filter.forget()

    def step(self) -> None:
        """One time step; u is used at t, ρ at t + dt."""
        sweep, rates = self.sweep, self.rates
        rho_sums, u_sums = sweep.state_sums
        divergence, gradient = self.nodal[:, :1], self.nodal[:, 1:]

        u = sweep.divide(u_sums, out=self._vector)
        sums = sweep.complete(sweep.divergence_sums(u, out=_zeroed(self._scalar)))
        self.filter.coefficients(sums, out=divergence, series="divergence")

        change = sweep.complete(sweep.gram(divergence, out=_zeroed(self._scalar)))
        rho = sweep.divide_changed(rho_sums, -rates.density, change, out=self._scalar)
        sums = sweep.complete(sweep.gradient_sums(rho, out=_zeroed(self._vector)))
        self.filter.coefficients(sums, out=gradient, series="gradient")

        sweep.advance(self.nodal, (-rates.density, -rates.velocity))


class UnfilteredEuler:
    """Formulation 2 without a filter, on nodal values: the particles get D, not Φ, times nodal values.

    Notes
    -----
    `step` is collective on neighbours: two pairs of halo exchanges, and migration.
    """

    def __init__(self, sweep: ParticleSweep, rates: Rates) -> None:
        self.sweep, self.rates = sweep, rates
        self.nodal = sweep.grid.zeros(1 + sweep.grid.dim)
        self._scalar = sweep.grid.zeros(1)

    @property
    def nbytes(self) -> int:
        """Bytes of the nodal work arrays."""
        return self.nodal.nbytes + self._scalar.nbytes

    def forget(self) -> None:
        """Nothing is remembered."""

    def step(self) -> None:
        """One time step; u is used at t, ρ at t + dt."""
        sweep, rates = self.sweep, self.rates
        rho_sums, u_sums = sweep.state_sums
        rho, u = self.nodal[:, :1], self.nodal[:, 1:]

        sweep.divide(u_sums, out=u)
        change = sweep.complete(sweep.divergence_sums(u, out=_zeroed(self._scalar)))
        sweep.divide_changed(rho_sums, -rates.density, change, out=rho)

        sweep.advance(self.nodal, (-rates.density, -rates.velocity), direct=True)


class OnParticles:
    """A step that works on the particle values of a sweep themselves, for filters that know no other way.

    Parameters
    ----------
    sweep
    filter_
        Its mapping becomes one that follows the particles.
    make
        Takes that mapping to the function that updates particle values (n, 1 + d) in place.

    Notes
    -----
    `step` is collective; it maps the particles anew, and with Formulation 2 passes over them nine times.
    """

    def __init__(self, sweep: ParticleSweep, filter_: Filter, make: Callable[[Mapping], Update]) -> None:
        self.sweep, self.filter = sweep, filter_
        self.mapping = Mapping.at(sweep.grid, sweep.particles)
        filter_.mapping = self.mapping
        self.update = make(self.mapping)
        self._nothing = sweep.grid.zeros(1 + sweep.grid.dim)

    @property
    def nbytes(self) -> int:
        """Bytes of the mapping, of what the filter keeps, and of the nodal work array."""
        return self.mapping.nbytes + self.filter.nbytes + self._nothing.nbytes

    def forget(self) -> None:
        """Follow the particles wherever they have been put. Collective."""
        self.mapping.follow(self.sweep.particles)

    def step(self) -> None:
        """One time step: update, then move."""
        sweep = self.sweep
        sweep.phase("particles")
        if sweep.moving:
            self.mapping.follow(sweep.particles)
        with np.errstate(over="ignore", invalid="ignore"):  # of a run that blows up, which is found and stated
            self.update(sweep.particles.state)
        sweep.advance(self._nothing, (0.0, 0.0))


Euler = SymplecticEuler | UnfilteredEuler | OnParticles


def symplectic(sweep: ParticleSweep, rates: Rates, settings: Any) -> Euler:
    """Formulation 2 with the filter of `settings`, a record like the scene's [filter] section. Collective."""
    if settings.kind == "none":
        return UnfilteredEuler(sweep, rates)
    filter_ = filters.create(settings.kind, sweep, settings)
    if isinstance(filter_, NodalFilter):
        return SymplecticEuler(sweep, rates, filter_)

    def make(mapping: Mapping) -> Update:
        plain = ParticleEuler(mapping, rates, filter_)
        return lambda state: plain.step(state[:, 0], state[:, 1:])

    return OnParticles(sweep, filter_, make)


def _zeroed(array: FloatArray) -> FloatArray:
    array.fill(0.0)
    return array

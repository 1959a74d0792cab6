"""The step of linearised gas dynamics written with particle values, to be read first; for any filter.

    Dρ/Dt = -ρ₀ ∇·u,    Du/Dt = -(c²/ρ₀) ∇ρ,    Dx/Dt = v

Formulation 2 of the paper, symplectic Euler, F the filter, x = x(t) throughout:

    u_i = S u_p;   ρ_p ← ρ_p - dt ρ₀ F(Σ_a D^a u_i,a);   ρ_i = S ρ_p;   u_p,a ← u_p,a - dt (c²/ρ₀) F(D^a ρ_i)
    x_p ← x_p + dt v

Other masses take the place of S, differences on the nodes that of D, and other integrators that of symplectic Euler.
`step.AcousticStep` is the same map on nodal arrays; tests hold the two together. Filters that know no nodal form, such
as the singular value decomposition, run in this one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from mpipic.arrays import FloatArray
from mpipic.mapping.mapping import Mapping
from mpipic.mapping.mass import Field, Gain, Mass
from mpipic.particles.motion import Motion
from mpipic.particles.store import Particles
from mpipic.physics.acoustics.damping import Damping
from mpipic.physics.acoustics.gas import Gas
from mpipic.physics.acoustics.integrators import Integrator, Rates, State

if TYPE_CHECKING:
    from mpipic.filters.family import Filter
    from mpipic.mesh.differences import CentralDifference


@dataclass(frozen=True)
class ParticleScheme:
    """The parts of a step on particle values; no `filter` is the identity, no `difference` takes D at the particles."""

    mass: Mass
    integrate: Integrator
    filter: Filter | None = None
    difference: CentralDifference | None = None
    damping: Damping = field(default_factory=Damping)


class ReferenceStep(Rates):
    """One time step after another, on particle values: each stage maps to the nodes, takes gradients, and filters.

    Parameters
    ----------
    mapping
        Follows the particles.
    gas
    dt
    scheme

    Notes
    -----
    Collective; some six passes over the particles a stage and field.

    References
    ----------
    Gritton, Berzins, Kirby (2015), section 3.3; the signs here are for the physical unknowns.
    """

    def __init__(self, mapping: Mapping, gas: Gas, dt: float, scheme: ParticleScheme) -> None:
        self.mapping, self.gas, self.dt, self.scheme, self.grid = mapping, gas, dt, scheme, mapping.grid
        self.factors = (-gas.density, -gas.stiffness)

    def density(self, velocity: FloatArray, stage: int) -> Gain:
        """Return the gain F(∇·u) of particle velocities (n, d), (n, 1). Collective."""
        scheme, u = self.scheme, self._fields(velocity, "velocity")
        if scheme.difference is not None:
            q = self.mapping.g2p(scheme.difference.divergence(u))
        else:
            q = self.mapping.divergence(u)[:, None]
        return self._filtered(q)

    def velocity(self, density: FloatArray, stage: int) -> Gain:
        """Return the gain F(∇ρ) of particle densities (n, 1), (n, d). Collective."""
        scheme, rho = self.scheme, self._fields(density, "density")
        if scheme.difference is not None:
            q = self.mapping.g2p(scheme.difference.gradient(rho))
        else:
            q = self.mapping.gradient(rho[:, 0])
        return self._filtered(q)

    def _fields(self, values: FloatArray, name: str) -> FloatArray:
        return self.scheme.mass.fields(self.mapping.sums(values), name)

    def _filtered(self, q: FloatArray) -> Gain:
        kept = q if self.scheme.filter is None else self.scheme.filter.apply(q)
        return Gain(kept, True, self.mapping.sums, "particles")

    def gained(self, gain: Gain) -> FloatArray:
        """Return the gain itself: fields are particle values here. Local."""
        return gain.coefficients

    def after(self, field: Field, scale: float, gain: Gain) -> FloatArray:
        """Return particle values once they have gained `scale` times `gain`. Local."""
        return field.values + scale * gain.coefficients

    def own(self, column: FloatArray) -> FloatArray:
        """Return the numbers of own particles. Local."""
        return column[:, 0]

    def spread(self, own: FloatArray) -> FloatArray:
        """Return own particles' numbers as a column. Local."""
        return own[:, None]

    def update(self, density: FloatArray, velocity: FloatArray) -> None:
        """Take ρ (n,) and u (n, d) from t to t + dt, in place, at the positions of t; moving is the caller's.

        Collective.
        """
        rho, u = density[:, None].copy(), velocity.copy()
        state = State(Field(rho, _itself), Field(u, _itself))
        rho_end, u_end = self.scheme.integrate(self, state, self.dt).end()
        damping = self.scheme.damping
        if damping.low_pass is not None:
            taken = self.mapping.g2p(damping.low_pass.change(self._both(rho_end, u_end, "end")))
            rho_end, u_end = rho_end + taken[:, :1], u_end + taken[:, 1:]
        if damping.null_space:
            seen = self.mapping.g2p(self._both(rho, u, "start"))
            rho_end = rho_end - damping.null_space * (rho - seen[:, :1])
            u_end = u_end - damping.null_space * (u - seen[:, 1:])
        density[...], velocity[...] = rho_end[:, 0], u_end

    def _both(self, rho: FloatArray, u: FloatArray, name: str) -> FloatArray:
        """Nodal fields of both, (local_nodes, 1 + d)."""
        sums = self.mapping.sums(np.concatenate([rho, u], axis=1))
        return self.scheme.mass.fields(sums, name, (1, u.shape[1]))


class MovingReference:
    """The reference step for the particles of a run: update, then move.

    Notes
    -----
    `step` is collective; it maps the particles anew, and with Formulation 2 passes over them nine times.
    """

    def __init__(self, particles: Particles, reference: ReferenceStep) -> None:
        self.particles, self.reference = particles, reference
        self.mapping, self.grid = reference.mapping, reference.grid
        self.motion = Motion(self.grid, particles)
        self._displacement = np.array(reference.gas.flow) * reference.dt
        self._find_peak()

    def step(self) -> None:
        """Take density, velocity and positions from t to t + dt. Collective."""
        particles, phase = self.particles, self.mapping.phase
        phase("particles")
        with np.errstate(over="ignore", invalid="ignore"):  # in a run that blows up, which is found and stated
            self.reference.update(particles["density"], particles["velocity"])
        self._find_peak()
        if self._displacement.any():
            phase("migrate")
            self.motion.move(self._displacement)
            phase("particles")
            self.mapping.follow(particles)
        phase("other")

    def _find_peak(self) -> None:
        size = np.abs(self.particles["density"])
        self._peak = float(np.where(np.isnan(size), np.inf, size).max(initial=0.0))

    @property
    def peak(self) -> float:
        """Largest |density| on this rank when last touched, infinity if any is NaN. Local."""
        return self._peak

    def restart(self) -> None:
        """Follow the particles wherever they have been put. Collective."""
        self.mapping.follow(self.particles)
        self._find_peak()

    def means(self) -> tuple[FloatArray, FloatArray]:
        """Return the means S ρ (local_nodes, 1) and S u (local_nodes, d). Collective."""
        particles = self.particles
        return self.mapping.p2g(particles["density"][:, None]), self.mapping.p2g(particles["velocity"])

    def close(self) -> None:
        """Give back communicators. Collective."""
        self.motion.close()

    @property
    def nbytes(self) -> int:
        """Bytes of the mapping and of what the filter keeps."""
        filter_ = self.reference.scheme.filter
        return self.mapping.nbytes + (filter_.nbytes if filter_ else 0)

    def remarks(self) -> list[str]:
        """Return those of the filter. Local."""
        filter_ = self.reference.scheme.filter
        return filter_.remarks() if filter_ else []

    def facts(self) -> dict[str, int]:
        """Return how often this rank sorted its particles, never, and exchanged ghost nodes, and with whom. Local."""
        nodes = self.grid.nodes
        return {"sorts": 0, "halo_exchanges": nodes.exchanges, "halo_neighbours": nodes.neighbours}


def _itself(values: FloatArray) -> FloatArray:
    return values

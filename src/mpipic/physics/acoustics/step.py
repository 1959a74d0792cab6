"""The step of linearised gas dynamics on nodal arrays: one pass over the particles in, one out.

    Dρ/Dt = -ρ₀ ∇·u,    Du/Dt = -(c²/ρ₀) ∇ρ,    Dx/Dt = v

Positions are frozen within a step, and every change of particle values is Φ times nodal coefficients (or, without a
filter, a gradient of nodal fields). So all stages of an integrator run on nodal arrays. Three choices make a scheme:

- a mass (`mapping.mass`) takes the sums Φᵀq to nodal fields, and says what these gain from the particles' gains;
- slopes (`slopes`) take nodal fields to the filtered particle gradient;
- an integrator (`integrators`, `midpoint`) combines stages.

Formulation 2 of the paper is the lumped mass, slopes at the particles, and the symplectic integrator. `reference` has
the same step written with particle values alone, to be read first.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mpipic.arrays import FloatArray
from mpipic.mapping.mass import Field, Gain, Mass, Workspace
from mpipic.mapping.sweep import ParticleSweep
from mpipic.physics.acoustics.damping import Damping
from mpipic.physics.acoustics.gas import Gas
from mpipic.physics.acoustics.integrators import Integrator, Rates, State, Step
from mpipic.physics.acoustics.slopes import Slopes


class Scheme(NamedTuple):
    """The parts of a step; `work` is the workspace that its slopes were made with."""

    mass: Mass
    slopes: Slopes
    integrate: Integrator
    damping: Damping
    work: Workspace


class AcousticStep(Rates):
    """One time step after another, for the particles of a sweep.

    Parameters
    ----------
    sweep
        The particles, mapped.
    gas
    dt
    scheme

    Notes
    -----
    `step` is collective: what the mass costs for 1 + d columns, what the slopes cost for every stage, and one pass over
    the particles, migration included.
    """

    def __init__(self, sweep: ParticleSweep, gas: Gas, dt: float, scheme: Scheme) -> None:
        self.sweep, self.gas, self.dt, self.scheme, self.grid = sweep, gas, dt, scheme, sweep.grid
        self.factors = (-gas.density, -gas.stiffness)
        self._increments: FloatArray | None = None

    # ------------------------------------------------------------ rates

    def density(self, velocity: FloatArray, stage: int) -> Gain:
        """Return the gain ∇·u. Collective."""
        return self.scheme.slopes.divergence(velocity, stage, self._room_for(self._columns[0]))

    def velocity(self, density: FloatArray, stage: int) -> Gain:
        """Return the gain ∇ρ. Collective."""
        return self.scheme.slopes.gradient(density, stage, self._room_for(self._columns[1]))

    def gained(self, gain: Gain) -> FloatArray:
        """Return what nodal fields gain when particles gain `gain`. Collective."""
        return self.scheme.mass.gained(gain)

    def after(self, field: Field, scale: float, gain: Gain) -> FloatArray:
        """Return the nodal field once particles have gained `scale` times `gain`. Collective."""
        return self.scheme.mass.after(field, scale, gain)

    def own(self, column: FloatArray) -> FloatArray:
        """Return the numbers of own nodes, x fastest. Local."""
        return np.ascontiguousarray(self.grid.nodes.own(column)).ravel()

    def spread(self, own: FloatArray) -> FloatArray:
        """Return the field on own and ghost nodes, (local_nodes, 1). Collective."""
        out = self.grid.zeros(1)
        block = self.grid.nodes.own(out)
        block[...] = own.reshape(block.shape)
        self.grid.nodes.fill(out)
        return out

    # ------------------------------------------------------------ the step

    def step(self) -> None:
        """Take density and velocity from t to t + dt at the positions of t, then move. Collective."""
        sweep, scheme = self.sweep, self.scheme
        sweep.phase("filter")
        state = State(*scheme.mass.start(sweep.held_sums[:, :-1], "state", (1, self.grid.dim), scheme.work))
        sweep.phase("nodes")
        self._increments = increments = scheme.work("increments", 1 + self.grid.dim)
        with np.errstate(over="ignore", invalid="ignore"):  # in a run that blows up, which is found and stated
            found = scheme.integrate(self, state, self.dt)
            rates = self._join(found, increments)
            if scheme.damping.acts:
                rates = self._damp(found, state, rates, increments)
        self._increments = None
        sweep.advance(increments, rates, direct=scheme.slopes.direct)

    @property
    def _columns(self) -> tuple[slice, slice]:
        """Where `advance` looks for the coefficients of density and velocity: unspanned, they are u and ρ."""
        scalar, vector = slice(0, 1), slice(1, None)
        return (vector, scalar) if self.scheme.slopes.direct else (scalar, vector)

    def _room_for(self, columns: slice) -> FloatArray | None:
        """Where coefficients can go at once, if within a step no other gain is looked at before it ends."""
        if self._increments is None or not self.scheme.integrate.looks_once:
            return None
        return self._increments[:, columns]

    def _join(self, found: Step, increments: FloatArray) -> tuple[float, float]:
        """Bring the coefficients of both changes to where `advance` reads them; return their factors."""
        for change, columns in zip((found.density, found.velocity), self._columns, strict=True):
            place = increments[:, columns]
            if not np.may_share_memory(place, change.coefficients):
                place[...] = change.coefficients
        return found.density.factor, found.velocity.factor

    def _damp(
        self, found: Step, state: State, rates: tuple[float, float], increments: FloatArray
    ) -> tuple[float, float]:
        """Add to the increments what damping changes; return the factors they then have. Collective."""
        damping = self.scheme.damping
        # before the increments change, which the gains of the end may lie in
        end = np.concatenate(found.end(), axis=1) if damping.low_pass is not None else None
        for columns, factor in zip(self._columns, rates, strict=True):
            increments[:, columns] *= factor
        if damping.low_pass is not None and end is not None:
            increments += damping.low_pass.change(end)
        if damping.null_space:
            values = self.sweep.particles.state
            values *= 1.0 - damping.null_space
            increments[:, :1] += damping.null_space * state.density.values
            increments[:, 1:] += damping.null_space * state.velocity.values
        return 1.0, 1.0

    # ------------------------------------------------------------ around it

    @property
    def peak(self) -> float:
        """Largest |density| on this rank when last touched, NaN if any is. Local."""
        return self.sweep.peak

    def restart(self) -> None:
        """Begin anew after particles were changed from outside. Collective."""
        self.sweep.remap()
        self.scheme.mass.forget()
        self.scheme.slopes.forget()

    def means(self) -> tuple[FloatArray, FloatArray]:
        """Return the means S ρ (local_nodes, 1) and S u (local_nodes, d). Local."""
        density, velocity = self.sweep.state_sums
        return self.sweep.divide(density), self.sweep.divide(velocity)

    def close(self) -> None:
        """Give back communicators. Collective."""
        self.sweep.close()

    @property
    def nbytes(self) -> int:
        """Bytes of what the parts hold; work arrays of the stages may come and go."""
        scheme = self.scheme
        parts = (self.sweep, scheme.mass, scheme.slopes, scheme.damping, scheme.work)
        return sum(part.nbytes for part in parts)

    def remarks(self) -> list[str]:
        """Return what whoever uses the results should know of. Local."""
        return self.scheme.slopes.remarks()

    def facts(self) -> dict[str, int]:
        """Return how often this rank sorted its particles and exchanged ghost nodes of nodal arrays, and with whom.

        Local.
        """
        nodes = self.grid.nodes
        return {"sorts": self.sweep.sorts, "halo_exchanges": nodes.exchanges, "halo_neighbours": nodes.neighbours}

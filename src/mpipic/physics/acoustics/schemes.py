"""Schemes of high order: which nodal fields represent particles, how gradients are taken, how time is integrated.

    Dρ/Dt = -ρ₀ ∇·u,    Du/Dt = -(c²/ρ₀) ∇ρ,    Dx/Dt = v

Positions are frozen within a step, and every change of particle values is Φ times nodal coefficients (or, without a
filter, D times nodal fields). So all stages of an integrator run on nodal arrays: one pass maps the particles, one
gives them their increments. Three choices make a scheme:

- a `Mass` (`mapping.mass`) takes the sums Φᵀq to nodal fields, and says how these answer to an increment Φ a;
- `Slopes` (`slopes`) take nodal fields to the coefficients of the filtered particle gradient;
- an integrator (`integrators`, `midpoint`) combines stages, each a function of the nodal state (ρ, u) in one array
  (local_nodes, 1 + d).

`PlainScheme` is the same method written with particle values alone, for any filter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mpipic.arrays import FloatArray
from mpipic.filters import Filter
from mpipic.mapping.mapping import Mapping
from mpipic.mapping.mass import Mass
from mpipic.mapping.sweep import ParticleSweep
from mpipic.mesh.differences import CentralDifference, LowPass
from mpipic.physics.acoustics.integrators import Integrator, Rates, State
from mpipic.physics.acoustics.slopes import Rate, Slopes


@dataclass(frozen=True)
class Gas:
    """What the gradients are multiplied with: ρ₀ and c²/ρ₀."""

    density: float
    stiffness: float


# ---------------------------------------------------------------- damping


@dataclass(frozen=True)
class Damping:
    """What a step takes away on purpose.

    Attributes
    ----------
    low_pass
        Grid-scale waves of the nodal fields: particles get Φ times what is taken from these.
    null_space
        The share of q - Φ a that particle values q lose, a their least-squares field: of what no node sees, and with a
        penalty, of what is rough. Where the grid moves past the particles such noise turns into sound and back, and can
        grow however well waves are damped; this makes the step without gradients a contraction, which it need not be
        otherwise.
    """

    low_pass: LowPass | None = None
    null_space: float = 0.0

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return self.low_pass.nbytes if self.low_pass else 0


# ---------------------------------------------------------------- the step on nodes


class NodalScheme(Rates):
    """A step whose stages run on nodal arrays: one pass over the particles in, one out.

    Notes
    -----
    `step` is collective: what the mass costs for 1 + d columns, what the slopes cost for every stage, and one pass over
    the particles, migration included.
    """

    def __init__(
        self,
        sweep: ParticleSweep,
        gas: Gas,
        dt: float,
        mass: Mass,
        slopes: Slopes,
        integrate: Integrator,
        damping: Damping | None = None,
    ) -> None:
        self.sweep, self.gas, self.dt, self.grid = sweep, gas, dt, sweep.grid
        self.mass, self.slopes, self.integrate, self.damping = mass, slopes, integrate, damping or Damping()

    def density(self, state: State, stage: int) -> Rate:
        """-ρ₀ ∇·u."""
        return self._times(-self.gas.density, self.slopes.divergence(np.ascontiguousarray(state[:, 1:]), stage))

    def velocity(self, state: State, stage: int) -> Rate:
        """-(c²/ρ₀) ∇ρ."""
        return self._times(-self.gas.stiffness, self.slopes.gradient(np.ascontiguousarray(state[:, :1]), stage))

    def _times(self, factor: float, rate: Rate) -> Rate:
        return Rate(factor * rate.coefficients, factor * rate.field)

    def join(self, of_density: FloatArray, of_velocity: FloatArray) -> State:
        """In the columns where `advance` looks for them: with direct slopes they are fields, u and ρ."""
        parts = [of_velocity, of_density] if self.slopes.direct else [of_density, of_velocity]
        return np.concatenate(parts, axis=1)

    def own(self, column: FloatArray) -> FloatArray:
        """Of own nodes, x fastest."""
        return np.ascontiguousarray(self.grid.nodes.own(column)).ravel()

    def spread(self, own: FloatArray) -> FloatArray:
        """On own and ghost nodes. Collective."""
        out = self.grid.zeros(1)
        block = self.grid.nodes.own(out)
        block[...] = own.reshape(block.shape)
        self.grid.fill_halo(out)
        return out

    @property
    def nbytes(self) -> int:
        """Bytes of what the parts hold; work arrays of the stages come and go."""
        return self.mass.nbytes + self.slopes.nbytes + self.damping.nbytes

    def forget(self) -> None:
        """Begin every series anew: the next step does not know the last. Local."""
        self.mass.forget()
        self.slopes.forget()

    def step(self) -> None:
        """One time step."""
        sweep = self.sweep
        sweep.phase("filter")
        start = self.mass.fields(sweep.sums[:, :-1], "state", (1, self.dim))
        sweep.phase("nodes")
        with np.errstate(over="ignore", invalid="ignore"):  # of a run that blows up, which is found and stated
            change, end = self.integrate(self, start, self.dt)
            if self.damping.low_pass is not None:
                change += self.damping.low_pass.change(end)
            if self.damping.null_space:
                values = sweep.particles.state
                values *= 1.0 - self.damping.null_space
                change += self.damping.null_space * start
        sweep.advance(np.ascontiguousarray(change), (1.0, 1.0), direct=self.slopes.direct)


# ---------------------------------------------------------------- the step on particles


class PlainScheme(Rates):
    """The same with particle values: each stage maps to the nodes, takes gradients and filters; for any filter.

    Notes
    -----
    Collective; some six passes over the particles a stage and field.
    """

    def __init__(
        self,
        mapping: Mapping,
        gas: Gas,
        dt: float,
        mass: Mass,
        integrate: Integrator,
        keep: Filter | None = None,
        difference: CentralDifference | None = None,
        damping: Damping | None = None,
    ) -> None:
        self.mapping, self.gas, self.dt, self.mass, self.integrate = mapping, gas, dt, mass, integrate
        self.keep, self.difference, self.damping, self.grid = keep, difference, damping or Damping(), mapping.grid

    def step(self, state: State) -> None:
        """Update particle values (n, 1 + d) in place; moving the particles is the caller's. Collective."""
        end, share = self.integrate(self, state, self.dt).end, self.damping.null_space
        if share:
            start = self.mass.fields(self.mapping.sums(state), "start", (1, self.dim))
            unseen = state - self.mapping.g2p(start)
        state[...] = end
        if self.damping.low_pass is not None:
            fields = self.mass.fields(self.mapping.sums(state), "end", (1, self.dim))
            state += self.mapping.g2p(self.damping.low_pass.change(fields))
        if share:
            state -= share * unseen

    def density(self, state: State, stage: int) -> Rate:
        """-ρ₀ F(∇·u)."""
        u = self.mass.fields(self.mapping.sums(np.ascontiguousarray(state[:, 1:])), "velocity")
        if self.difference is not None:
            q = self.mapping.g2p(self.difference.divergence(u))
        else:
            q = self.mapping.divergence(u)[:, None]
        return self._rate(-self.gas.density, q)

    def velocity(self, state: State, stage: int) -> Rate:
        """-(c²/ρ₀) F(∇ρ)."""
        rho = self.mass.fields(self.mapping.sums(np.ascontiguousarray(state[:, :1])), "density")
        if self.difference is not None:
            q = self.mapping.g2p(self.difference.gradient(rho))
        else:
            q = self.mapping.gradient(rho[:, 0].copy())
        return self._rate(-self.gas.stiffness, q)

    def _rate(self, factor: float, q: FloatArray) -> Rate:
        rate = factor * (q if self.keep is None else self.keep.apply(q))
        return Rate(rate, rate)

    def own(self, column: FloatArray) -> FloatArray:
        """Of own particles."""
        return column[:, 0]

    def spread(self, own: FloatArray) -> FloatArray:
        """On own particles."""
        return own[:, None]

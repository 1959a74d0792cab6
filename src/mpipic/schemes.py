"""Schemes of high order: which nodal fields represent particles, how gradients are taken, how time is integrated.

    Dρ/Dt = -ρ₀ ∇·u,    Du/Dt = -(c²/ρ₀) ∇ρ,    Dx/Dt = v

Positions are frozen within a step, and every change of particle values is Φ times nodal coefficients (or, without a
filter, D times nodal fields). So all stages of an integrator run on nodal arrays: one pass maps the particles, one
gives them their increments. Three choices make a scheme:

- a `Mass` (mpipic.mass) takes the sums Φᵀq to nodal fields, and says how these answer to an increment Φ a;
- `Slopes` take nodal fields to the coefficients of the filtered particle gradient;
- an integrator combines stages, each a function of the nodal state (ρ, u) in one array (local_nodes, 1 + d).

`PlainScheme` is the same method written with particle values alone, for any filter.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from mpi4py import MPI

from mpipic.filters import Filter, NodalFilter
from mpipic.grid import FloatArray, Grid
from mpipic.grid_operators import CentralDifference, LowPass
from mpipic.mapping import Mapping, NodalMapping
from mpipic.mass import Mass
from mpipic.sweep import ParticleSweep, SplineSweep


@dataclass(frozen=True)
class Gas:
    """What the gradients are multiplied with: ρ₀ and c²/ρ₀."""

    density: float
    stiffness: float


class Rate(NamedTuple):
    """Of one field: coefficients of the particles' change, and the change of the nodal field; (local_nodes, k)."""

    coefficients: FloatArray
    field: FloatArray


class Slopes(ABC):
    """Divergence and gradient of nodal fields as changes of particle values."""

    direct = False
    """Whether coefficients are nodal fields that particles take the gradient of themselves."""

    @abstractmethod
    def divergence(self, u: FloatArray, stage: int) -> Rate:
        """Of (local_nodes, d)."""

    @abstractmethod
    def gradient(self, rho: FloatArray, stage: int) -> Rate:
        """Of (local_nodes, 1)."""

    def forget(self) -> None:
        """Begin every series anew. Local."""
        return

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return 0


class UnfilteredSlopes(Slopes):
    """D at the particles, unfiltered: each particle takes the gradient of the nodal fields itself."""

    direct = True

    def __init__(self, sweep: ParticleSweep, mass: Mass) -> None:
        self.sweep, self.mass = sweep, mass

    def divergence(self, u: FloatArray, stage: int) -> Rate:
        """Coefficients u."""
        sums = self.sweep.complete(self.sweep.divergence_sums(u, out=self.sweep.grid.zeros(1)))
        return Rate(u, self.mass.fields(sums, f"divergence {stage}"))

    def gradient(self, rho: FloatArray, stage: int) -> Rate:
        """Coefficients ρ."""
        sums = self.sweep.complete(self.sweep.gradient_sums(rho, out=self.sweep.grid.zeros(self.sweep.grid.dim)))
        return Rate(rho, self.mass.fields(sums, f"gradient {stage}"))


class FilteredSlopes(Slopes):
    """F D at the particles (the paper), or with `skew`, F of ½(D - (Dᵀ)ᵀ): ½(C - Cᵀ) in place of C = ΦᵀD.

    Skew, with least-squares fields and the exact projection, the rates are a skew-symmetric operator on particle
    values: no integrator that is stable on the imaginary axis can make it grow. Its price is consistency on disordered
    particles.
    """

    def __init__(self, sweep: ParticleSweep, mass: Mass, filter_: NodalFilter, skew: bool = False) -> None:
        self.sweep, self.mass, self.filter, self.skew = sweep, mass, filter_, skew

    def divergence(self, u: FloatArray, stage: int) -> Rate:
        """Coefficients N Σ_a C^a u_a."""
        sums = self.sweep.divergence_sums(u, out=self.sweep.grid.zeros(1))
        if self.skew:
            sums = 0.5 * (sums - self._transposable.transposed_divergence_sums(u, out=self.sweep.grid.zeros(1)))
        return self._rate(sums, f"divergence {stage}")

    def gradient(self, rho: FloatArray, stage: int) -> Rate:
        """Coefficients N C^a ρ."""
        dim = self.sweep.grid.dim
        sums = self.sweep.gradient_sums(rho, out=self.sweep.grid.zeros(dim))
        if self.skew:
            sums = 0.5 * (sums - self._transposable.transposed_gradient_sums(rho, out=self.sweep.grid.zeros(dim)))
        return self._rate(sums, f"gradient {stage}")

    def _rate(self, sums: FloatArray, series: str) -> Rate:
        a = self.filter.coefficients(self.sweep.complete(sums), series=series)
        return Rate(a, self.mass.response(a))

    @property
    def _transposable(self) -> SplineSweep:
        assert isinstance(self.sweep, SplineSweep)
        return self.sweep

    def forget(self) -> None:
        """Begin every series anew. Local."""
        self.filter.forget()

    @property
    def nbytes(self) -> int:
        """Bytes that the filter holds."""
        return self.filter.nbytes


class GridSlopes(Slopes):
    """Derivatives taken on the nodal arrays, by central differences: particles get Φ times them.

    What they get is in range(Φ) already, so that the exact projection and its equals change nothing and are left out;
    any other filter acts on it: N G in place of 1.
    """

    def __init__(self, sweep: NodalMapping, mass: Mass, order: int, filter_: NodalFilter | None = None) -> None:
        self.sweep, self.mass, self.filter = sweep, mass, filter_
        self.difference = CentralDifference(sweep.grid, order)

    def divergence(self, u: FloatArray, stage: int) -> Rate:
        """Coefficients Σ_a ∂_a u_a."""
        return self._rate(self.difference.divergence(u), f"divergence {stage}")

    def gradient(self, rho: FloatArray, stage: int) -> Rate:
        """Coefficients ∂_a ρ."""
        return self._rate(self.difference.gradient(rho), f"gradient {stage}")

    def _rate(self, a: FloatArray, series: str) -> Rate:
        if self.filter is not None:
            a = self.filter.coefficients(self.sweep.apply_gram(a), series=series)
        return Rate(a, self.mass.response(a))

    def forget(self) -> None:
        """Begin every series anew. Local."""
        if self.filter is not None:
            self.filter.forget()

    @property
    def nbytes(self) -> int:
        """Bytes of the differences, and of the filter if there is one."""
        return self.difference.nbytes + (self.filter.nbytes if self.filter else 0)


# ---------------------------------------------------------------- integrators

State = FloatArray
"""ρ and u in one array (rows, 1 + d), of nodes or of particles."""


class Step(NamedTuple):
    """What an integrator makes of a step: the particles' change (as coefficients), and the state at its end."""

    change: State
    end: State


class Rates(ABC):
    """Time derivatives of a state, positions frozen: what integrators work with."""

    @abstractmethod
    def density(self, state: State, stage: int) -> Rate:
        """Of ρ, from u."""

    @abstractmethod
    def velocity(self, state: State, stage: int) -> Rate:
        """Of u, from ρ."""

    grid: Grid

    @abstractmethod
    def own(self, column: FloatArray) -> FloatArray:
        """This rank's own numbers of one field (rows, 1), compact."""

    @abstractmethod
    def spread(self, own: FloatArray) -> FloatArray:
        """The field (rows, 1) of these numbers, ghosts and all. Collective."""

    @property
    def dim(self) -> int:
        """Dimension."""
        return self.grid.dim

    @property
    def comm(self) -> MPI.Comm:
        """Communicator."""
        return self.grid.comm

    def any(self, mine: bool) -> bool:
        """Whether it is so on any rank. Collective."""
        return bool(self.grid.reduce(np.array([float(mine)]), MPI.MAX)[0])

    def size(self, own: FloatArray) -> float:
        """A power of two near the largest of these numbers on all ranks. Collective."""
        return self.grid.size_of(own)

    def both(self, state: State, stage: int) -> Rate:
        """Of ρ and u."""
        rho, u = self.density(state, stage), self.velocity(state, stage)
        return Rate(self.join(rho.coefficients, u.coefficients), np.concatenate([rho.field, u.field], axis=1))

    def join(self, of_density: FloatArray, of_velocity: FloatArray) -> State:
        """Coefficients of both changes in one array."""
        return np.concatenate([of_density, of_velocity], axis=1)


Integrator = Callable[[Rates, State, float], Step]


def symplectic(rates: Rates, state: State, dt: float) -> Step:
    """Symplectic Euler (Formulation 2): ρ from u at t, then u from ρ at t + dt."""
    rho = rates.density(state, 0)
    end = state.copy()
    end[:, :1] += dt * rho.field
    u = rates.velocity(end, 0)
    end[:, 1:] += dt * u.field
    return Step(dt * rates.join(rho.coefficients, u.coefficients), end)


def rk4(rates: Rates, state: State, dt: float) -> Step:
    """The classical Runge-Kutta method of order 4; stable while the largest frequency times dt is below 2.8."""
    first = rates.both(state, 0)
    second = rates.both(state + 0.5 * dt * first.field, 1)
    third = rates.both(state + 0.5 * dt * second.field, 2)
    fourth = rates.both(state + dt * third.field, 3)
    change, field = (dt / 6.0 * (first[part] + 2.0 * (second[part] + third[part]) + fourth[part]) for part in (0, 1))
    return Step(change, state + field)


INTEGRATORS: dict[str, Integrator] = {"symplectic": symplectic, "rk4": rk4}
"""Name to function; `midpoint` joins them from its own module."""


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

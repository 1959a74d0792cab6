"""Explicit integrators, and what they work with: rates of a state at frozen positions. See also `midpoint`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from mpi4py import MPI

from mpipic.arrays import FloatArray
from mpipic.mesh.grid import Grid
from mpipic.physics.acoustics.slopes import Rate

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

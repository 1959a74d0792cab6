"""Explicit integrators, and what they work with: rates of a state at frozen positions. See also `midpoint`."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from mpipic.arrays import FloatArray
from mpipic.mapping.mass import Field, Gain
from mpipic.parts import NODAL_GRADIENTS, SOLVED_FILTER, Choices, Part, Values

if TYPE_CHECKING:
    from mpipic.mesh.grid import Grid


class State(NamedTuple):
    """Density and velocity at the beginning of a step, on nodes or on particles."""

    density: Field
    velocity: Field


class Change(NamedTuple):
    """One field gains this in a step: a factor times the coefficients of a `Gain`."""

    factor: float
    coefficients: FloatArray


@dataclass(frozen=True)
class Step:
    """An integrator makes this of a step.

    Attributes
    ----------
    density, velocity
        The particles' changes.
    end : function without arguments
        Makes the fields (density, velocity) at the end. Collective.
    """

    density: Change
    velocity: Change
    end: Callable[[], tuple[FloatArray, FloatArray]]


class Rates(ABC):
    """Time derivatives of a state at frozen positions: what integrators work with.

    The particles' density changes by `factors[0]` times the gain that `density` finds, the velocity by `factors[1]`
    times that of `velocity`. Fields have rows of nodes or of particles, (rows, 1) and (rows, d).
    """

    grid: Grid
    factors: tuple[float, float]

    @abstractmethod
    def density(self, velocity: FloatArray, stage: int) -> Gain:
        """Return the gain ∇·u. Collective."""

    @abstractmethod
    def velocity(self, density: FloatArray, stage: int) -> Gain:
        """Return the gain ∇ρ. Collective."""

    @abstractmethod
    def gained(self, gain: Gain) -> FloatArray:
        """Return what fields gain when particles gain `gain`. Collective."""

    @abstractmethod
    def after(self, field: Field, scale: float, gain: Gain) -> FloatArray:
        """Return the field once particles have gained `scale` times `gain`. Collective."""

    @abstractmethod
    def own(self, column: FloatArray) -> FloatArray:
        """Return this rank's own numbers of a field (rows, 1), compact. Local."""

    @abstractmethod
    def spread(self, own: FloatArray) -> FloatArray:
        """Return the field (rows, 1) of these numbers, ghosts and all. Collective."""


class Integrator(Part, ABC):
    """Takes a state from t to t + dt.

    Attributes
    ----------
    looks_once
        Whether it looks at every gain once, before the next is made.
    stages
        At how many states gains are found.
    name
        What `mpipic check` calls it.
    reach
        The largest frequency times dt on the imaginary axis that it is stable for.
    """

    slot = "time.integrator"
    physics = "acoustics"
    looks_once: ClassVar[bool] = False
    stages: ClassVar[int] = 1
    name: ClassVar[str]
    reach: ClassVar[float]

    @classmethod
    def create(cls, symmetric: bool, **settings: Any) -> Integrator:
        """Return the integrator; `symmetric`: both rates together are symmetric, see `Midpoint`. Local."""
        return cls(**settings)

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return the name."""
        return cls.name

    @classmethod
    def node_doubles(cls, v: Values) -> int:
        """Return the gains of all stages, and where the filter solves for them, two earlier answers of each."""
        kept = 2 * cls.stages * (1 + v.dim) if cls.stages > 1 else 0
        solved = v.has(SOLVED_FILTER) and not v.has(NODAL_GRADIENTS)
        return kept + (2 * cls.stages * (1 + v.dim) if solved else 0)

    @abstractmethod
    def __call__(self, rates: Rates, state: State, dt: float) -> Step:
        """Return one step. Collective."""


class Symplectic(Integrator):
    """Symplectic Euler (Formulation 2): ρ from u at t, then u from ρ at t + dt."""

    kind = "symplectic"
    about = "symplectic Euler: Formulation 2 of the paper, of first order"
    is_default = True
    name = "symplectic Euler"
    reach = 2.0
    looks_once = True

    def __call__(self, rates: Rates, state: State, dt: float) -> Step:
        """Return one step; two gains, and one change of a field."""
        of_density, of_velocity = (dt * factor for factor in rates.factors)
        first = rates.density(state.velocity.values, 0)  # u at t
        rho = rates.after(state.density, of_density, first)  # ρ at t + dt
        second = rates.velocity(rho, 0)
        return Step(
            Change(of_density, first.coefficients),
            Change(of_velocity, second.coefficients),
            lambda: (rho, rates.after(state.velocity, of_velocity, second)),
        )


class RungeKutta4(Integrator):
    """The classical Runge-Kutta method of order 4; stable while the largest frequency times dt is below 2.8."""

    kind = "rk4"
    about = "Runge-Kutta of order 4"
    name = "Runge-Kutta of order 4"
    reach = 2.0 * math.sqrt(2.0)
    stages = 4
    NODES = (0.0, 0.5, 0.5, 1.0)
    WEIGHTS = (1.0, 2.0, 2.0, 1.0)

    def __call__(self, rates: Rates, state: State, dt: float) -> Step:
        """Return one step; eight gains, and six changes of fields."""
        rho, u = state.density.values, state.velocity.values
        found: list[tuple[Gain, Gain]] = []
        for stage, node in enumerate(self.NODES):
            if stage:
                at = tuple(node * dt * factor for factor in rates.factors)
                rho, u = (rates.after(field, s, gain) for field, s, gain in zip(state, at, found[-1], strict=True))
            found.append((rates.density(u, stage), rates.velocity(rho, stage)))
        return self._combined(rates, state, dt, found)

    def _combined(self, rates: Rates, state: State, dt: float, found: list[tuple[Gain, Gain]]) -> Step:
        """Return the weighted sum of all stages; the rates are linear, so it is a gain itself."""
        gains = [_sum_of(self.WEIGHTS, stages) for stages in zip(*found)]
        of_density, of_velocity = (
            Change(dt / 6.0 * factor, gain.coefficients) for factor, gain in zip(rates.factors, gains, strict=True)
        )

        def end() -> tuple[FloatArray, FloatArray]:
            parts = zip(state, (of_density, of_velocity), gains, strict=True)
            rho, u = (rates.after(field, change.factor, gain) for field, change, gain in parts)
            return rho, u

        return Step(of_density, of_velocity, end)


def _sum_of(weights: tuple[float, ...], gains: tuple[Gain, ...]) -> Gain:
    """Return Σ weights × gains."""
    total = gains[0].coefficients.copy()
    for weight, gain in zip(weights[1:], gains[1:], strict=True):
        total += weight * gain.coefficients

    return Gain(total, gains[0].spanned, gains[0].map_to_nodes, f"{gains[0].name} in all")


INTEGRATORS: Choices[Integrator] = Choices(Integrator)
"""Kind to class; `midpoint` joins them from its own module."""

"""The implicit midpoint rule: stable at any time step that is stable at all, for sound much faster than the flow.

    ȳ = y + dt/2 L ȳ,    y ← y + dt L ȳ,    L = [[0, R], [U, 0]]

With the velocity eliminated, the density at mid-step solves (1 - (dt/2)² R U) ρ̄ = ρ + dt/2 R u: one field instead of
1 + d, by a Krylov method (options ``-midpoint_ksp_type``, ...).
"""

from __future__ import annotations

import math
from typing import Any

from mpipic.arrays import FloatArray
from mpipic.keys import IN_0_1, Keys, Share, key
from mpipic.parts import Values
from mpipic.physics.acoustics.integrators import Change, Integrator, Rates, State, Step

LEAST_TOLERANCE = 1e-14
"""No residual is computed more closely than that."""


class Midpoint(Integrator):
    """The integrator; keeps its solver, and takes the density at the beginning of a step as the first guess.

    Parameters
    ----------
    tolerance
        Relative residual.
    symmetric
        Whether R U is symmetric negative in the plain inner product: conjugate gradients then, else GMRES.

    Raises
    ------
    NotConverged
        From a step; names the residual and the iteration count.

    Notes
    -----
    Collective. The number of iterations grows with c dt / h. An iteration applies R and U once.
    """

    kind = "midpoint"
    about = "implicit midpoint rule, for time steps far above the limit of sound"
    name = "implicit midpoint rule"
    brings_in = ("linear solvers",)
    reach = math.inf

    class Settings(Keys):
        """Keys of the integrator."""

        tolerance: Share = key(1e-10, IN_0_1, "relative residual of the solve")

    @classmethod
    def solvers(cls, v: Values) -> tuple[str, ...]:
        """Return the options of the solver for the density at mid-step."""
        return ("midpoint_ksp",)

    @classmethod
    def create(cls, symmetric: bool, **settings: Any) -> Midpoint:
        """Return the integrator. Local."""
        return cls(max(settings["tolerance"], LEAST_TOLERANCE), symmetric)

    def __init__(self, tolerance: float, symmetric: bool) -> None:
        from mpipic.mesh.shell_solver import ShellSolver

        self.solver = ShellSolver("midpoint_", "the implicit midpoint rule", tolerance, symmetric)

    def __call__(self, rates: Rates, state: State, dt: float) -> Step:
        """Return one step. Collective."""
        half = tuple(0.5 * dt * factor for factor in rates.factors)
        right = rates.after(state.density, half[0], rates.density(state.velocity.values, 0))
        rho = self._solve(rates, right, state.density.values, half)
        u = rates.after(state.velocity, half[1], rates.velocity(rho, 0))
        of_density, of_velocity = rates.density(u, 1), rates.velocity(rho, 1)
        whole = tuple(dt * factor for factor in rates.factors)
        return Step(
            Change(whole[0], of_density.coefficients),
            Change(whole[1], of_velocity.coefficients),
            lambda: (
                rates.after(state.density, whole[0], of_density),
                rates.after(state.velocity, whole[1], of_velocity),
            ),
        )

    def _solve(self, rates: Rates, right: FloatArray, guess: FloatArray, half: tuple[float, ...]) -> FloatArray:
        """ρ̄ of (1 - (dt/2)² R U) ρ̄ = right, (rows, 1). Collective."""

        def apply(own: FloatArray) -> FloatArray:
            rho = rates.spread(own)
            u = half[1] * rates.gained(rates.velocity(rho, 2))
            return rates.own(rho - half[0] * rates.gained(rates.density(u, 2)))

        return rates.spread(self.solver.solve(rates.grid, apply, rates.own(right), rates.own(guess)))

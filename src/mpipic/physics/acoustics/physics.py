"""Linearised gas dynamics as a physics: density and velocity perturbations on particles that move with the flow."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np

from mpipic.arrays import FloatArray, Shape
from mpipic.parts import A_FILTER, NODAL_FILTER, SIGNALS, Values
from mpipic.physics.acoustics.damping import Damping
from mpipic.physics.acoustics.gas import Gas
from mpipic.physics.base import Fields, Physics

if TYPE_CHECKING:
    from mpipic.mesh.grid import Grid
    from mpipic.particles.store import Particles

Solution = Callable[[FloatArray, float], tuple[FloatArray, FloatArray]]
"""Takes positions (n, d) and a time to density (n,) and velocity (n, d)."""


class Stepper(Protocol):
    """A step that has its place on the particles."""

    @property
    def peak(self) -> float:
        """Largest |density| on this rank when last touched. Local."""
        ...

    @property
    def nbytes(self) -> int:
        """Bytes of arrays that live as long as the run. Local."""
        ...

    def step(self) -> None:
        """Take density, velocity and positions from t to t + dt. Collective."""
        ...

    def restart(self) -> None:
        """Begin anew after particles were changed from outside. Collective."""
        ...

    def means(self) -> tuple[FloatArray, FloatArray]:
        """Return S ρ (local_nodes, 1) and S u (local_nodes, d). Collective."""
        ...

    def facts(self) -> dict[str, int]:
        """Return counts that a summary tells. Local."""
        ...

    def remarks(self) -> list[str]:
        """Return sentences that whoever uses the results should read, if there are any. Local."""
        ...

    def close(self) -> None:
        """Give back communicators. Collective."""
        ...


Compose = Callable[["Grid", "Particles", Callable[[str], None]], Stepper]
"""Builds the step for these particles. Collective."""


def _is_formulation_2(v: Values) -> bool:
    """Whether the scheme is that of the paper."""
    names = (v["mapping.mass"], v["mapping.gradient"], v["time.integrator"])
    return names == ("lumped", "direct", "symplectic")


class Acoustics(Physics):
    """Dρ/Dt = -ρ₀ ∇·u, Du/Dt = -(c²/ρ₀) ∇ρ, Dx/Dt = v.

    Parameters
    ----------
    gas
    solution
        Initial data and exact solution in one; None where a file gives the state.
    compose
        Builds the step once there are particles.
    """

    kind = "acoustics"
    about = "linearised gas dynamics about a uniform flow"
    is_default = True
    traits = (SIGNALS,)
    watched = "density"
    symbols: Mapping[str, str] = {"density": "ρ", "velocity": "u"}
    compared = ("density", "velocity")
    shares = ("null_space_fraction",)

    @classmethod
    def signal_speed_of(cls, v: Values) -> float:
        """Return c."""
        return float(v["gas.sound_speed"])

    @classmethod
    def pace(cls, v: Values) -> str:
        """Return how far the flow carries particles in a step."""
        return f"flow {max(map(abs, v['gas.flow'])) * v.dt / min(v.h):.3g} cells a step"

    @classmethod
    def particle_doubles(cls, v: Values) -> int:
        """Return density and velocity."""
        return 1 + v.dim

    @classmethod
    def node_doubles(cls, v: Values) -> int:
        """Return sums of both fields, row sums and their inverses, increments, and both fields on the way."""
        return (v.dim + 2) + 1 + 2 * (1 + v.dim)

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return the step: integrator, gradient and damping."""
        integrator, gradient = v.part("time.integrator"), v.part("mapping.gradient")
        if _is_formulation_2(v):
            passes = "one pass" if v.has(NODAL_FILTER) or not v.has(A_FILTER) else "nine passes"
            return f"Formulation 2 (symplectic Euler), {passes} over the particles a step"
        return f"{integrator.describe(v)}, {gradient.describe(v)}{Damping.describe(v)}"

    def __init__(self, gas: Gas, solution: Solution | None, compose: Compose) -> None:
        self.gas, self.solution, self._compose = gas, solution, compose
        self.stepper: Stepper

    def fields(self, dim: int) -> Mapping[str, Shape]:
        """Return density, a scalar, and velocity, a vector."""
        return {"density": (), "velocity": (dim,)}

    def initial(self, position: FloatArray) -> Fields | None:
        """Return the solution at t = 0. Local."""
        return self.exact(position, 0.0)

    def exact(self, position: FloatArray, time: float) -> Fields | None:
        """Return the exact solution; None where a file gave the state. Local."""
        if self.solution is None:
            return None
        density, velocity = self.solution(position, time)
        return {"density": density, "velocity": velocity}

    def place(self, grid: Grid, particles: Particles, phase: Callable[[str], None]) -> None:
        """Build the step on these particles. Collective."""
        self.grid, self.particles = grid, particles
        self.stepper = self._compose(grid, particles, phase)

    def step(self) -> None:
        """Take density, velocity and positions from t to t + dt. Collective."""
        self.stepper.step()

    def restart(self) -> None:
        """Begin anew after particles were changed from outside. Collective."""
        self.stepper.restart()

    def close(self) -> None:
        """Give back communicators. Collective."""
        self.stepper.close()

    @property
    def peak(self) -> float:
        """Largest |density| on this rank when last touched, NaN if any is. Local."""
        return self.stepper.peak

    def signal_speed(self) -> float:
        """Return c. Local."""
        return self.gas.sound_speed

    def sizes(self) -> list[float]:
        """Return the largest |ρ|, and where density starts at zero, what the velocity will turn into. Local."""
        largest = np.abs(self.particles["velocity"]).max(initial=0.0)
        return [*super().sizes(), float(self.gas.density / self.gas.sound_speed * largest)]

    def conserved(self) -> Fields:
        """Return Σρ and ρ₀ Σu over this rank's particles: mass and momentum of the perturbation a particle volume."""
        particles = self.particles
        momentum = self.gas.density * particles["velocity"].sum(axis=0)
        return {"mass": np.asarray(particles["density"].sum()), "momentum": momentum}

    def nodal(self) -> Fields:
        """Return the means S ρ and S u on own nodes, (x, y, z) and (x, y, z, d). Collective."""
        density, velocity = self.stepper.means()
        return {"density": self.grid.owned(density[:, 0]), "velocity": self.grid.owned(velocity)}

    def null_space_shares(self) -> Mapping[str, float | None]:
        """Return the share of the unfiltered particle gradient of the density that no node sees. Collective."""
        from mpipic.filters.measures import null_space_fraction

        return {"null_space_fraction": null_space_fraction(self.grid, self.particles, self.particles["density"])}

    @property
    def nbytes(self) -> int:
        """Bytes of the step's arrays. Local."""
        return self.stepper.nbytes

    def remarks(self) -> Sequence[str]:
        """Return those of the step. Local."""
        return self.stepper.remarks()

    def facts(self) -> Mapping[str, int]:
        """Return how often particles were sorted and ghost nodes exchanged. Local."""
        return self.stepper.facts()

"""A physics is this to the rest of the house: fields on particles, a step, and what it says about itself.

A physics knows nothing of ranks, files and scenes. Whoever runs it asks which fields the particles carry, gives them
their initial values, lets it take its place on the particles, and then steps. Everything that watches a run, errors,
history, snapshots, pictures, works from the names and numbers given here.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from mpipic.arrays import FloatArray, Shape
from mpipic.parts import Choices, Part

if TYPE_CHECKING:
    from mpipic.mesh.grid import Grid
    from mpipic.particles.store import Particles

Fields = Mapping[str, FloatArray]
"""Name to values of particles or points, (n, *shape)."""


class Physics(Part, ABC):
    """Equations of motion of particles that carry named fields.

    One that scenes can name has a `kind`, and says of a scene's values what a part says.

    Attributes
    ----------
    watched : str
        The field whose size ends a run when it grows past all bounds.
    symbols : mapping from name to symbol
        How pictures and progress abbreviate fields; a field without a symbol goes by its name.
    compared : tuple of names
        Fields that are held against the exact solution.
    shares : tuple of names
        What `null_space_shares` returns.
    grid, particles
        What it runs on, once it has taken its `place`.
    """

    slot = "physics.kind"
    watched: str
    symbols: Mapping[str, str] = {}
    compared: tuple[str, ...] = ()
    shares: tuple[str, ...] = ()
    grid: Grid
    particles: Particles

    # ------------------------------------------------------------ before the run

    @abstractmethod
    def fields(self, dim: int) -> Mapping[str, Shape]:
        """Return the fields that every particle carries, name to shape, in the order of the state's columns."""

    @abstractmethod
    def initial(self, position: FloatArray) -> Fields | None:
        """Return the fields at t = 0 at positions (n, d); None where a file gives them. Local."""

    def exact(self, position: FloatArray, time: float) -> Fields | None:
        """Return the exact solution at positions (n, d); None where there is none. Local."""
        return None

    @abstractmethod
    def place(self, grid: Grid, particles: Particles, phase: Callable[[str], None]) -> None:
        """Take place on these particles: build what a step needs. Collective.

        `phase` is to be called with the name of what takes time from then on.
        """

    # ------------------------------------------------------------ the run

    @abstractmethod
    def step(self) -> None:
        """Take fields and positions from t to t + dt. Collective."""

    @abstractmethod
    def restart(self) -> None:
        """Begin anew after particles were changed from outside: map them, forget the steps before. Collective."""

    def close(self) -> None:
        """Give back what must not wait for the end of the program. Collective; may be called twice."""
        return

    # ------------------------------------------------------------ what it says about itself

    @property
    @abstractmethod
    def peak(self) -> float:
        """Largest size of the watched field on this rank when last touched, NaN if any value is. Local."""

    def sizes(self) -> list[float]:
        """Return sizes on this rank that growth of the watched field is measured by; the first that is not 0 counts.

        Local.
        """
        return [float(np.abs(self.particles[self.watched]).max(initial=0.0))]

    @abstractmethod
    def signal_speed(self) -> float:
        """Return the speed of the fastest signal relative to the particles, on this rank. Local."""

    def conserved(self) -> Fields:
        """Return this rank's part of the sums that the equations conserve, name to number or vector. Local."""
        return {}

    def nodal(self) -> Fields:
        """Return what the grid sees of the fields, on own nodes, (x, y, z, *shape), axes there are. Local."""
        return {}

    def null_space_shares(self) -> Mapping[str, float | None]:
        """Return which share of its gradients no node sees, name to number; None where not found. Collective."""
        return {}

    @property
    def nbytes(self) -> int:
        """Bytes of arrays that live as long as the run, without the particles. Local."""
        return 0

    def remarks(self) -> Sequence[str]:
        """Return sentences that whoever uses the results should read, the same on all ranks. Local."""
        return ()

    def facts(self) -> Mapping[str, int]:
        """Return counts that a summary tells, such as how often particles were sorted. Local."""
        return {}


KINDS: Choices[Physics] = Choices(Physics)
"""Kind to class."""

"""The library's door: a mapping at given positions, applied to any particle values."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mpipic.arrays import FloatArray, IntArray, columns_of
from mpipic.kernels import generic
from mpipic.mapping.base import NodalMapping
from mpipic.mapping.gram import Gram
from mpipic.mesh.agreement import raise_together
from mpipic.mesh.grid import Grid
from mpipic.particles.store import Particles, locate


class Mapping(NodalMapping):
    """Φ, D and S at given positions, applied to any particle values; see `NodalMapping` for the verbs.

    Parameters
    ----------
    grid
        The node grid.
    position : (n, d)
        Positions in this rank's cells, in the unit of `grid.length`. `mpipic.Placement` brings particles there.
    weight : (n,), optional
        What each particle counts, V_p > 0, a mass or a volume in any unit: the inner product is then Σ_p V_p q_p r_p,
        S = diag(d)⁻¹ Φᵀ V, d = Φᵀ V 1, G = Φᵀ V Φ, and filters keep Σ_p V_p q_p. Default: each counts 1.
    phase
        Called with the name of what takes time from now on.

    Raises
    ------
    ValueError
        A position is not in its rank's cells, or a weight is not a finite number above 0; names the first. Raised on
        all ranks together.

    Notes
    -----
    Building, `update` and `follow` are collective: one pass, one halo sum and fill, one reduction.
    """

    def __init__(
        self,
        grid: Grid,
        position: FloatArray,
        weight: FloatArray | None = None,
        phase: Callable[[str], None] = lambda name: None,
    ) -> None:
        self._begin(grid, phase)
        self.update(position, weight)

    @classmethod
    def at(
        cls,
        grid: Grid,
        particles: Particles,
        weight: FloatArray | None = None,
        phase: Callable[[str], None] = lambda name: None,
    ) -> Mapping:
        """Return the mapping where these particles are. Collective."""
        mapping = cls.__new__(cls)
        mapping._begin(grid, phase)
        mapping.follow(particles, weight)
        return mapping

    def _begin(self, grid: Grid, phase: Callable[[str], None]) -> None:
        self.grid, self.phase, self.version = grid, phase, 0
        self.gram = Gram(self)

    def update(self, position: FloatArray, weight: FloatArray | None = None) -> None:
        """Move the mapping to new positions (n, d), with these weights. Collective."""
        self._place(lambda: self.grid.coordinate_of(columns_of(position)), weight)

    def follow(self, particles: Particles, weight: FloatArray | None = None) -> None:
        """Move the mapping to where these particles of a run are, with these weights, for example a field.

        Collective.
        """
        self._place(lambda: np.ascontiguousarray(particles.coordinate), weight)

    def _place(self, coordinate: Callable[[], FloatArray], weight: FloatArray | None) -> None:
        problem = None
        try:
            located = locate(self.grid, coordinate())
            checked = _checked(weight, len(located[0]))
        except ValueError as error:
            problem = error
        raise_together(self.grid.comm, problem)
        (self._cell, self._fraction), self._weight = located, checked
        self.version += 1
        self._moments: FloatArray | None = None
        self.row_sums = self.sums(np.ones(len(self._cell)))
        self.inverse_row_sums = np.empty_like(self.row_sums)
        generic.invert(self.row_sums, self.inverse_row_sums)

    @property
    def moments(self) -> FloatArray | None:
        """Pair moments on the linear basis, (local_cells, 3^d); one pass over the particles when first asked for."""
        if self._moments is None and self.grid.degree == 1:
            weight = np.ones(self.count) if self._weight is None else self._weight
            self._moments = np.zeros((self.grid.local_cells, 3**self.grid.dim))
            generic.add_moments(self._cell, self._fraction, weight, self._moments)
        return self._moments

    @property
    def located(self) -> tuple[IntArray, FloatArray]:
        """Local cell (n,) and local coordinates (n, d) of the particles. Local."""
        return self._cell, self._fraction

    @property
    def count(self) -> int:
        """Particles on this rank."""
        return len(self._cell)

    @property
    def weight(self) -> FloatArray | None:
        """V_p, (n,); None where each particle counts 1. Local."""
        return self._weight

    @property
    def nbytes(self) -> int:
        """Bytes of what is kept for each particle, cell and node."""
        arrays = (self._cell, self._fraction, self.row_sums, self.inverse_row_sums, self._moments, self._weight)
        return self.gram.nbytes + sum(a.nbytes for a in arrays if a is not None)


def _checked(weight: FloatArray | None, count: int) -> FloatArray | None:
    """Return the weights as (count,), or raise ValueError for the first that is not a finite number above 0."""
    if weight is None:
        return None
    weight = np.array(weight, dtype=np.float64)
    if weight.shape != (count,):
        raise ValueError(f"weight must have shape ({count},), one number a particle, not {weight.shape}")
    wrong = np.flatnonzero(~(np.isfinite(weight) & (weight > 0)))
    if wrong.size:
        raise ValueError(f"weight {wrong[0]} must be a finite number above 0, not {weight[wrong[0]]}")
    return weight

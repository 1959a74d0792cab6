"""The library's door: a mapping at given positions, applied to any particle values."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mpipic.arguments import real_array, told
from mpipic.arrays import FloatArray, IntArray
from mpipic.kernels import generic
from mpipic.mapping.base import NodalMapping
from mpipic.mapping.gram import Gram
from mpipic.mesh.agreement import Said, together
from mpipic.mesh.grid import Grid, checked_grid
from mpipic.particles.store import Particles, locate

LEAST_WEIGHT, MOST_WEIGHT = 1e-100, 1e100
"""Weights between these neither over- nor underflow in sums, products with shape functions, and inverses of these."""


class Mapping(NodalMapping):
    """Φ, D and S at given positions, applied to any particle values; see `NodalMapping` for the verbs.

    Parameters
    ----------
    grid
        The node grid.
    position : (n, d)
        Positions in this rank's cells, in the unit of `grid.length`; axes wrap (see `mpipic.box`). `mpipic.Placement`
        brings particles there.
    weight : (n,), optional
        What each particle counts, V_p from 1e-100 to 1e100, a mass or a volume in any unit: the inner product is then
        Σ_p V_p q_p r_p, S = diag(d)⁻¹ Φᵀ V, d = Φᵀ V 1, G = Φᵀ V Φ, and filters keep Σ_p V_p q_p. Default: each counts
        1. All ranks that hold particles give weights, or none does.
    phase
        Called with the name of what takes time from now on.

    Raises
    ------
    ValueError, TypeError
        Positions or weights are no such arrays; a position tells no cell or is not in its rank's cells, or a weight is
        out of range: names the first. Raised on all ranks together; the mapping is then as it was.

    Notes
    -----
    Building, `update` and `follow` are collective: one pass, one halo sum and fill, one reduction to agree.
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
        self.grid, self.phase, self.version = checked_grid(grid), phase, 0
        self.gram = Gram(self)

    def update(self, position: FloatArray, weight: FloatArray | None = None) -> None:
        """Move the mapping to new positions (n, d), with these weights. Collective."""
        self._place("Mapping", lambda: self.grid.coordinate_of(position), weight)

    def follow(self, particles: Particles, weight: FloatArray | None = None) -> None:
        """Move the mapping to where these particles of a run are, with these weights, for example a field.

        Collective.
        """

        def coordinate() -> FloatArray:
            if not isinstance(particles, Particles) or particles.dim != self.grid.dim:
                raise TypeError(f"particles must be Particles in {self.grid.dim} dimensions, not {told(particles)}")
            return np.ascontiguousarray(particles.coordinate)

        self._place("Mapping.follow", coordinate, weight)

    def _place(self, verb: str, coordinate: Callable[[], FloatArray], weight: FloatArray | None) -> None:
        def check() -> tuple[IntArray, FloatArray, FloatArray | None]:
            if not callable(self.phase):
                raise TypeError(f"phase must be a function of a name, not {told(self.phase)}")
            cell, fraction = locate(self.grid, coordinate())
            return cell, fraction, _checked(weight, len(cell))

        def say(found: tuple[IntArray, FloatArray, FloatArray | None]) -> Said:
            weighted = found[2] is not None
            return Said((float(weighted),), lambda: "weights" if weighted else "no weights", len(found[0]) > 0)

        (self._cell, self._fraction, own), (weighted,) = together(self.grid.comm, verb, check, say)
        self._weight = own if len(self._cell) else np.empty(0) if weighted else None
        self.version += 1
        self._moments: FloatArray | None = None
        self.row_sums = self.column_sums(np.ones((len(self._cell), 1)))[:, 0]
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
    """Return the weights as (count,), a copy, or raise for the first that is out of range."""
    if weight is None:
        return None
    given = np.array(real_array("weight", weight), dtype=np.float64)
    if given.shape != (count,):
        raise ValueError(f"weight must have shape ({count},), one number a particle, not {given.shape}")
    wrong = np.flatnonzero(~((given >= LEAST_WEIGHT) & (given <= MOST_WEIGHT)))
    if wrong.size:
        first = given[wrong[0]]
        span = f" (from {LEAST_WEIGHT:g} to {MOST_WEIGHT:g})" if 0.0 < first < np.inf else ""
        raise ValueError(f"weight {wrong[0]} must be a finite number above 0{span}, not {first}")
    return given

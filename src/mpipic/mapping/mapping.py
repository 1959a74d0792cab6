"""Mapping between particles and nodes.

Symbols as in the method: Φ interpolates nodes to particles, D^a differentiates, d = Φᵀ1 are the row sums, and
S = diag(d)⁻¹ Φᵀ is the paper's mapping matrix. `Mapping` applies them to any particle values, and is the library's
door; the particles that a run advances are mapped by `mpipic.mapping.sweep`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np

from mpipic.arrays import FloatArray, IntArray, columns_of
from mpipic.kernels import BY_DIMENSION, generic, spline, stencil
from mpipic.mesh.grid import Grid, raise_together
from mpipic.particles.store import Particles, locate


class NodalMapping(ABC):
    """What filters and solvers need of a mapping: the operators that S Φ is made of, on nodal arrays.

    On the linear basis G follows from the pair moments of every cell (see `kernels.cells`), on the others from passes
    over the particles.

    Attributes
    ----------
    weights : (local_nodes,)
        Row sums d, right on own and ghost nodes.
    inverse_weights : (local_nodes,)
        1 / d, 0 on nodes that no particle sees.
    version : int
        Counts changes of positions.
    """

    grid: Grid
    weights: FloatArray
    version: int
    inverse_weights: FloatArray
    phase: Callable[[str], None]

    @property
    @abstractmethod
    def moments(self) -> FloatArray | None:
        """Pair moments of own cells, (local_cells, 3^d); None where there are none."""

    @property
    @abstractmethod
    def located(self) -> tuple[IntArray, FloatArray]:
        """Local cell (n,) and local coordinates (n, d) of the particles. Local."""

    @property
    @abstractmethod
    def particle_weights(self) -> FloatArray:
        """What each particle counts, (n,). Local."""

    def divide(self, sums: FloatArray, out: FloatArray | None = None) -> FloatArray:
        """Nodal means from nodal sums: diag(d)⁻¹ sums, 0 on nodes that no particle sees. Local."""
        self.phase("nodes")
        result = np.empty(sums.shape) if out is None else out
        if sums.ndim == 1:
            generic.scale_rows(sums[:, None], self.inverse_weights, result[:, None])
        else:
            generic.scale_rows(sums, self.inverse_weights, result)
        return result

    def gram(self, nodal: FloatArray, out: FloatArray) -> FloatArray:
        """out += G nodal, one column; complete it afterwards. Local."""
        grid, moments = self.grid, self.moments
        if moments is not None:
            BY_DIMENSION[grid.dim].gram(moments, grid.padded_shape, grid.layout, nodal, out)
            return out
        where = self.located
        seen = np.zeros((len(where[0]), 1))
        geometry = (grid.padded_shape, grid.layout)
        spline.add_interpolated(grid.degree, *where, np.ascontiguousarray(nodal), np.ones(1), *geometry, seen)
        seen *= self.particle_weights[:, None]
        spline.add_sums(grid.degree, *where, seen, *geometry, out)
        return out

    def apply_gram(self, nodal: FloatArray) -> FloatArray:
        """G nodal, column by column, right on own and ghost nodes; ghosts of `nodal` filled.

        Collective; one halo sum, one fill.
        """
        out = np.zeros(nodal.shape)
        wide, result = nodal.reshape(len(nodal), -1), out.reshape(len(nodal), -1)
        for column in range(wide.shape[1]):
            self.gram(wide[:, column : column + 1], result[:, column : column + 1])
        return self.complete(out)

    def add_gram_entries(self, layout: tuple[int, int, int], entries: FloatArray) -> None:
        """entries (nodes, h) += half of G's rows in a padding of `layout` (see `kernels.stencil`).

        Local; ghosts still hold what belongs to their owners.
        """
        dim, degree, shape = self.grid.dim, self.grid.degree, self.grid.padded_shape
        moments = self.moments
        if moments is not None:
            stencil.add_moments(moments, stencil.moment_terms(dim), shape, layout, entries)
        else:
            spline.add_gram_entries(degree, *self.located, self.particle_weights, shape, layout, entries)

    def complete(self, sums: FloatArray) -> FloatArray:
        """Nodal sums made right on own and ghost nodes: one halo sum, one fill. Collective on neighbours."""
        self.phase("halo")
        self.grid.sum_halo(sums)
        self.grid.fill_halo(sums)
        self.phase("nodes")
        return sums


class Mapping(NodalMapping):
    """Φ, D and S at given positions, applied to any particle values.

    Parameters
    ----------
    grid
        The node grid.
    position : (n, d)
        Positions in this rank's cells, in the unit of `grid.length`. `mpipic.Placement` brings particles there.
    weight : (n,), optional
        What each particle counts, V_p > 0, a mass or a volume in any unit: the inner product is then Σ_p V_p q_p r_p,
        S = diag(d)⁻¹ Φᵀ V, d = Φᵀ V 1, G = Φᵀ V Φ, and filters keep Σ_p V_p q_p. Default: each counts 1.

    Raises
    ------
    ValueError
        A position is not in its rank's cells, or a weight is not a finite number above 0; names the first. Raised on
        all ranks together.

    Notes
    -----
    Collective, as are `p2g` and `sums`; `g2p`, `gradient` and `divergence` are local. Each costs one pass over the
    particles, and halo exchanges as stated. Nodal arrays are ghosted (see `mpipic.mesh.grid`).

    References
    ----------
    Gritton, Berzins, Kirby (2015), eq. 8-13.
    """

    def __init__(self, grid: Grid, position: FloatArray, weight: FloatArray | None = None) -> None:
        self._begin(grid)
        self.update(position, weight)

    @classmethod
    def at(cls, grid: Grid, particles: Particles) -> Mapping:
        """The mapping where these particles are, none weighted. Collective."""
        mapping = cls.__new__(cls)
        mapping._begin(grid)
        mapping.follow(particles)
        return mapping

    def _begin(self, grid: Grid) -> None:
        self.grid = grid
        self.version = 0
        self.phase = lambda name: None
        self._degree = grid.degree
        self._geometry = (grid.padded_shape, grid.layout)
        self._inverse_h = np.array(grid.inverse_h)

    def update(self, position: FloatArray, weight: FloatArray | None = None) -> None:
        """Move the mapping to new positions, with these weights. Collective; one pass, one sum and fill of the halo."""
        self._place(self.grid.coordinate_of(columns_of(position)), weight)

    def follow(self, particles: Particles) -> None:
        """Move the mapping to where these particles are, none weighted. Collective, as `update`."""
        self._place(np.ascontiguousarray(particles.coordinate), None)

    def _place(self, coordinate: FloatArray, weight: FloatArray | None) -> None:
        problem = None
        try:
            located = locate(self.grid, coordinate)
            checked = _checked(weight, len(located[0]))
        except ValueError as error:
            problem = str(error)
        raise_together(self.grid.comm, problem)
        (self._cell, self._fraction), self.weight = located, checked
        self.version += 1
        self._moments: FloatArray | None = None
        self.weights = self.sums(np.ones(len(self._cell)))
        self.inverse_weights = np.empty_like(self.weights)
        generic.invert(self.weights, self.inverse_weights)

    @property
    def moments(self) -> FloatArray | None:
        """On the linear basis pair moments, (local_cells, 3^d); one pass over the particles when first asked for."""
        if self._moments is None and self._degree == 1:
            self._moments = np.zeros((self.grid.local_cells, 3**self.grid.dim))
            generic.add_moments(self._cell, self._fraction, self.particle_weights, self._moments)
        return self._moments

    @property
    def count(self) -> int:
        """Particles on this rank."""
        return len(self._cell)

    @property
    def nbytes(self) -> int:
        """Bytes of what is kept for each particle, cell and node."""
        arrays = (self._cell, self._fraction, self.weights, self.inverse_weights, self._moments, self.weight)
        return sum(a.nbytes for a in arrays if a is not None)

    @property
    def located(self) -> tuple[IntArray, FloatArray]:
        """Local cell (n,) and local coordinates (n, d) of the particles. Local."""
        return self._cell, self._fraction

    @property
    def particle_weights(self) -> FloatArray:
        """What each particle counts, (n,). Local."""
        return np.ones(len(self._cell)) if self.weight is None else self.weight

    def sums(self, values: FloatArray) -> FloatArray:
        """Φᵀ values, or Φᵀ V values: (n,) or (n, k) to (local_nodes,) or (local_nodes, k).

        Σ over own nodes of all ranks = Σ over particles. Collective; one halo sum, one fill.
        """
        rows = columns_of(values)
        if self.weight is not None:
            rows = rows * self.weight[:, None]
        out = self.grid.zeros(rows.shape[1])
        spline.add_sums(self._degree, self._cell, self._fraction, rows, *self._geometry, out)
        return self.complete(out).reshape((-1, *np.shape(values)[1:]))

    def p2g(self, values: FloatArray) -> FloatArray:
        """S values: weighted means at the nodes, (n, ...) to (local_nodes, ...). Keeps constants. Collective."""
        return self.divide(self.sums(values))

    def g2p(self, nodal: FloatArray) -> FloatArray:
        """Φ nodal: spline values, (local_nodes, ...) to (n, ...). Keeps constants and linear functions. Local."""
        rows = columns_of(nodal)
        out = np.zeros((len(self._cell), rows.shape[1]))
        rate = np.ones(rows.shape[1])
        spline.add_interpolated(self._degree, self._cell, self._fraction, rows, rate, *self._geometry, out)
        return out.reshape((-1, *np.shape(nodal)[1:]))

    def gradient(self, nodal: FloatArray) -> FloatArray:
        """D^a nodal: (local_nodes,) to (n, d); on a node, the slope of the cell to its right. Local."""
        out = np.zeros_like(self._fraction)
        where = (self._degree, self._cell, self._fraction)
        spline.add_gradient(*where, nodal.reshape(-1), 1.0, self._inverse_h, *self._geometry, out)
        return out

    def divergence(self, nodal: FloatArray) -> FloatArray:
        """Σ_a D^a nodal_a: (local_nodes, d) to (n,). Local."""
        out = np.zeros(len(self._cell))
        where = (self._degree, self._cell, self._fraction)
        spline.add_divergence(*where, columns_of(nodal), 1.0, self._inverse_h, *self._geometry, out)
        return out


def _checked(weight: FloatArray | None, count: int) -> FloatArray | None:
    """The weights as (count,), or ValueError that names the first that is not a finite number above 0."""
    if weight is None:
        return None
    weight = np.array(weight, dtype=np.float64)
    if weight.shape != (count,):
        raise ValueError(f"weight must have shape ({count},), one number a particle, not {weight.shape}")
    wrong = np.flatnonzero(~(np.isfinite(weight) & (weight > 0)))
    if wrong.size:
        raise ValueError(f"weight {wrong[0]} must be a finite number above 0, not {weight[wrong[0]]}")
    return weight

"""Every mapping between particles and nodes can do this, whoever keeps the particles.

Symbols as in the method: Φ interpolates nodes to particles, D^a differentiates, V are particle weights (1 by default),
d = ΦᵀV1 are the row sums, S = diag(d)⁻¹ΦᵀV is the paper's mapping matrix, and G = ΦᵀVΦ.

Values have any shape, (n, *shape) on particles and (local_nodes, *shape) on nodes; each component is mapped alike. They
are real numbers of any type, calculated with as float64: whole numbers beyond 2^53 lose digits, as NumPy's do.
Infinities and NaN are values like others. Everything else is refused, complex, masked, too few or too many: by verbs
that are collective on all ranks together, at the cost of one reduction of a few numbers.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from mpipic.arguments import RealArray, nodal_rows, rows
from mpipic.arrays import FloatArray, IntArray, columns_of, size_of
from mpipic.kernels import generic, spline, stencil
from mpipic.mapping.gram import Gram
from mpipic.mesh.agreement import values_together
from mpipic.mesh.grid import Grid


class NodalMapping(ABC):
    """Φ, D, S and G where particles are.

    Attributes
    ----------
    grid
    row_sums : (local_nodes,)
        Row sums d, right on own and ghost nodes.
    inverse_row_sums : (local_nodes,)
        1 / d, 0 on nodes that no particle sees.
    version : int
        Counts changes of positions.
    gram : Gram
        G at the present positions.

    Notes
    -----
    `sums`, `p2g` and `adjoint_gradient` are collective on neighbours: one pass over the particles, one halo sum, one
    fill. `g2p`, `gradient` and `divergence` are local: one pass. Nodal arrays are ghosted (see `mpipic.mesh.grid`).

    References
    ----------
    Gritton, Berzins, Kirby (2015), eq. 8-13.
    """

    grid: Grid
    row_sums: FloatArray
    inverse_row_sums: FloatArray
    version: int
    gram: Gram
    phase: Callable[[str], None]

    @property
    @abstractmethod
    def moments(self) -> FloatArray | None:
        """Pair moments of own cells, (local_cells, 3^d), on the linear basis; None on others. Local."""

    @property
    @abstractmethod
    def located(self) -> tuple[IntArray, FloatArray]:
        """Local cell (n,) and local coordinates (n, d) of the particles. Local."""

    @property
    @abstractmethod
    def count(self) -> int:
        """Particles on this rank."""

    @property
    def weight(self) -> FloatArray | None:
        """V_p, (n,); None where each particle counts 1. Local."""
        return None

    def agreed(self, verb: str, values: npt.ArrayLike, last: int | None = None) -> RealArray:
        """Return values (n, *shape) of this rank's n particles, once all ranks have such, and of the same shape.

        A rank without particles may give (0,) and gets (0, *shape). `last` is what shape must end with.

        Raises
        ------
        ValueError, TypeError
            On all ranks together, naming the rank that gave something else.

        Notes
        -----
        Collective; one reduction.
        """
        return values_together(self.grid.comm, verb, lambda: rows("values", values, self.count, last))

    def nodal(self, values: npt.ArrayLike, last: int | None = None) -> RealArray:
        """Return nodal values (local_nodes, *shape) as an array, or raise ValueError or TypeError. Local."""
        return nodal_rows("nodal", values, self.grid.local_nodes, self.grid.owned_shape, last)

    # ------------------------------------------------------------ particles to nodes

    def sums(self, values: npt.ArrayLike) -> FloatArray:
        """Return ΦᵀV values: (n, *shape) to (local_nodes, *shape).

        Σ over own nodes of all ranks = Σ over particles. Collective; refuses as `agreed` does.
        """
        q = self.agreed("sums", values)
        return self.column_sums(columns_of(q)).reshape(self.grid.local_nodes, *q.shape[1:])

    def column_sums(self, columns: FloatArray) -> FloatArray:
        """Return ΦᵀV columns: (n, k), float64, C-contiguous, which is not checked, to (local_nodes, k). Collective."""
        if self.weight is not None:
            columns = columns * self.weight[:, None]
        out = self.grid.zeros(columns.shape[1])
        spline.add_sums(self.grid.degree, *self.located, columns, *self.geometry, out)
        return self.complete(out)

    def p2g(self, values: npt.ArrayLike) -> FloatArray:
        """Return S values, weighted means at the nodes: (n, *shape) to (local_nodes, *shape).

        Keeps constants; 0 on nodes that no particle sees. Collective; refuses as `agreed` does.
        """
        q = self.agreed("p2g", values)
        return self.divide(self.column_sums(columns_of(q))).reshape(self.grid.local_nodes, *q.shape[1:])

    def adjoint_gradient(self, values: npt.ArrayLike) -> FloatArray:
        """Return Σ_a (D^a)ᵀ values_a: (n, *shape, d) to (local_nodes, *shape).

        ⟨w, adjoint_gradient(q)⟩ over own nodes = ⟨gradient(w), q⟩ over particles; unweighted. Collective; refuses as
        `agreed` does.
        """
        q, dim = self.agreed("adjoint_gradient", values, last=self.grid.dim), self.grid.dim
        shape = q.shape[1:-1]
        vectors = columns_of(q).reshape(self.count, size_of(shape), dim)
        out = self.grid.zeros(vectors.shape[1])
        for column in range(vectors.shape[1]):
            along, total = np.ascontiguousarray(vectors[:, column]), np.zeros(len(out))
            spline.add_divergence_sums(self.grid.degree, *self.located, along, *self.differences, total)
            out[:, column] = total
        return self.complete(out).reshape(self.grid.local_nodes, *shape)

    # ------------------------------------------------------------ nodes to particles

    def g2p(self, nodal: npt.ArrayLike) -> FloatArray:
        """Return Φ nodal, spline values: (local_nodes, *shape), ghosts filled, to (n, *shape).

        Keeps constants and linear functions. Local; other rows than own and ghost nodes are refused.
        """
        values = self.nodal(nodal)
        columns = columns_of(values)
        out = np.zeros((self.count, columns.shape[1]))
        rate = np.ones(columns.shape[1])
        spline.add_interpolated(self.grid.degree, *self.located, columns, rate, *self.geometry, out)
        return out.reshape(self.count, *values.shape[1:])

    def gradient(self, nodal: npt.ArrayLike) -> FloatArray:
        """Return D^a nodal, a last: (local_nodes, *shape), ghosts filled, to (n, *shape, d).

        On a node it is the slope of the cell to its right. Local; one pass a component. Refuses as `g2p` does.
        """
        values = self.nodal(nodal)
        columns, dim = columns_of(values), self.grid.dim
        out = np.zeros((columns.shape[1], self.count, dim))
        for column in range(columns.shape[1]):
            one = np.ascontiguousarray(columns[:, column])
            spline.add_gradient(self.grid.degree, *self.located, one, 1.0, *self.differences, out[column])
        return np.moveaxis(out, 0, 1).reshape(self.count, *values.shape[1:], dim)

    def divergence(self, nodal: npt.ArrayLike) -> FloatArray:
        """Return Σ_a D^a nodal_a: (local_nodes, *shape, d), ghosts filled, to (n, *shape).

        Local; one pass a component. Refuses as `g2p` does.
        """
        values, dim = self.nodal(nodal, last=self.grid.dim), self.grid.dim
        shape = values.shape[1:-1]
        vectors = columns_of(values).reshape(len(values), size_of(shape), dim)
        out = np.zeros((vectors.shape[1], self.count))
        for column in range(vectors.shape[1]):
            along = np.ascontiguousarray(vectors[:, column])
            spline.add_divergence(self.grid.degree, *self.located, along, 1.0, *self.differences, out[column])
        return np.moveaxis(out, 0, 1).reshape(self.count, *shape)

    # ------------------------------------------------------------ on nodes

    def divide(self, sums: FloatArray, out: FloatArray | None = None) -> FloatArray:
        """Return nodal means from nodal sums, diag(d)⁻¹ sums; 0 on nodes that no particle sees. Local."""
        self.phase("nodes")
        result = np.empty(sums.shape) if out is None else out
        wide, into = (a if a.ndim == 2 else a.reshape(len(a), size_of(a.shape[1:])) for a in (sums, result))
        generic.scale_rows(wide, self.inverse_row_sums, into)
        return result

    def divide_changed(self, sums: FloatArray, scale: float, change: FloatArray, out: FloatArray) -> FloatArray:
        """Return diag(d)⁻¹ (sums + scale change), (local_nodes, k); `out` may be `change`. Local."""
        self.phase("nodes")
        generic.scale_changed(sums, scale, change, self.inverse_row_sums, out)
        return out

    def complete(self, sums: FloatArray) -> FloatArray:
        """Return nodal sums made right on own and ghost nodes, in place: one halo sum, one fill. Collective."""
        self.phase("halo")
        self.grid.nodes.add(sums)
        self.grid.nodes.fill(sums)
        self.phase("nodes")
        return sums

    # ------------------------------------------------------------ for G

    def add_passed(self, nodal: FloatArray, out: FloatArray) -> None:
        """Add G nodal to `out`, one column, by two passes over the particles; ghosts still hold their share. Local."""
        seen = np.zeros((self.count, 1))
        values = np.ascontiguousarray(nodal)
        spline.add_interpolated(self.grid.degree, *self.located, values, np.ones(1), *self.geometry, seen)
        if self.weight is not None:
            seen *= self.weight[:, None]
        spline.add_sums(self.grid.degree, *self.located, seen, *self.geometry, out)

    def add_gram_entries(self, layout: tuple[int, int, int], entries: FloatArray) -> None:
        """Add half of G's rows in a padding of `layout` to entries (nodes, h) (see `kernels.stencil`).

        Local; ghosts still hold what belongs to their owners.
        """
        dim, degree, shape = self.grid.dim, self.grid.degree, self.grid.padded_shape
        moments = self.moments
        if moments is not None:
            stencil.add_moments(moments, stencil.moment_terms(dim), shape, layout, entries)
        else:
            weight = np.ones(self.count) if self.weight is None else self.weight
            spline.add_gram_entries(degree, *self.located, weight, shape, layout, entries)

    @property
    def geometry(self) -> tuple[tuple[int, ...], tuple[int, int, int]]:
        """Own cells per axis, padded with 1, and layout of nodal arrays, as compiled loops take them. Local."""
        return self.grid.padded_shape, self.grid.layout

    @property
    def differences(self) -> tuple[FloatArray, tuple[int, ...], tuple[int, int, int]]:
        """The same for loops that differentiate: cells per unit of length (d,) first. Local."""
        return np.array(self.grid.inverse_h), self.grid.padded_shape, self.grid.layout

"""Operators on nodal arrays that know nothing of particles: central differences and the grid-scale low-pass.

Both are the same at every node, a stencil along each axis; each application costs one halo exchange of its own width.
"""

from __future__ import annotations

from math import comb, factorial

import numpy as np

from mpipic.arrays import FloatArray
from mpipic.kernels import stencil
from mpipic.mesh.grid import Grid
from mpipic.mesh.halo import Halo, PaddedColumns


def difference_weights(order: int) -> FloatArray:
    """Return weights (order/2 + 1,) of the central first difference of even `order`; antisymmetric, [0] is 0.

    For unit spacing: w_j = (-1)^(j+1) (q!)² / (j (q - j)! (q + j)!), q = order / 2, exact on polynomials up to that
    degree.
    """
    q = order // 2
    weights = [
        (-1.0) ** (j + 1) * factorial(q) ** 2 / (j * factorial(q - j) * factorial(q + j)) for j in range(1, q + 1)
    ]
    return np.array([0.0, *weights])


def low_pass_weights(order: int, strength: float) -> FloatArray:
    """Return weights (order + 1,) of 1 - σ sin^{2p}(θ/2) along an axis: p = order, σ = strength in [0, 1]."""
    p = order
    weights = -strength * np.array([(-1.0) ** j * comb(2 * p, p + j) for j in range(p + 1)]) / 4.0**p
    weights[0] += 1.0
    return np.asarray(weights)


class _Stencil:
    """Padded copies of columns, wide enough for the stencils applied to them."""

    def __init__(self, grid: Grid, width: int) -> None:
        self.grid, self.halo = grid, Halo(grid.comm, grid.cells, grid.starts, width)
        self._values = PaddedColumns(self.halo)
        self._result = np.empty(grid.local_cells)

    @property
    def nbytes(self) -> int:
        """Bytes of the work arrays."""
        return self._values.nbytes + self._result.nbytes

    def _load(self, nodal: FloatArray) -> FloatArray:
        """Return the columns (local_nodes, k) padded, (k, padded nodes)."""
        return self._values.load(np.moveaxis(self.grid.nodes.own(nodal), -1, 0))

    def _store(self, out: FloatArray) -> None:
        block = self.grid.nodes.own(out)
        block[...] = self._result.reshape(block.shape)


class CentralDifference(_Stencil):
    """Derivatives of nodal arrays by central differences of even order: skew-symmetric, exact on smooth fields.

    Parameters
    ----------
    grid
    order
        2 to 12.
    """

    def __init__(self, grid: Grid, order: int) -> None:
        super().__init__(grid, order // 2)
        self._weights = difference_weights(order)
        self._strides = (1, *self.halo.layout[1:])

    def _along(self, axis: int, values: FloatArray) -> FloatArray:
        weights = self._weights * self.grid.inverse_h[axis]
        stride, shape = self._strides[axis], self.grid.padded_shape
        stencil.difference(values, weights, stride, shape, self.halo.layout, self._result)
        return self._result

    def gradient(self, nodal: FloatArray) -> FloatArray:
        """∂_a nodal: (local_nodes, 1) to (local_nodes, d), right on own and ghost nodes. Collective on neighbours."""
        out = self.grid.zeros(self.grid.dim)
        (values,) = self._load(nodal)
        for axis in range(self.grid.dim):
            self._along(axis, values)
            self._store(out[:, axis])
        self.grid.nodes.fill(out)
        return out

    def divergence(self, nodal: FloatArray) -> FloatArray:
        """Σ_a ∂_a nodal_a: (local_nodes, d) to (local_nodes, 1), right on own and ghost nodes. Collective."""
        out = self.grid.zeros(1)
        block = self.grid.nodes.own(out)[..., 0]
        for axis, values in enumerate(self._load(nodal)):
            block += self._along(axis, values).reshape(block.shape)
        self.grid.nodes.fill(out)
        return out


class LowPass(_Stencil):
    """H(θ) = Π_a [1 - σ_a sin^{2p}(θ_a/2)]: takes the waves of two nodes a period, leaves the long ones.

    Parameters
    ----------
    grid
    order
        p, second differences per axis.
    strengths : d floats in [0, 1]
        σ_a: the share that the shortest wave loses.
    """

    def __init__(self, grid: Grid, order: int, strengths: FloatArray) -> None:
        super().__init__(grid, order)
        self._weights = np.eye(1, order + 1).repeat(3, axis=0)
        for axis, strength in enumerate(strengths):
            self._weights[axis] = low_pass_weights(order, float(strength))
        shape = self.halo.ghost_shape
        self._plane, self._line = np.empty(int(np.prod(shape[:2]))), np.empty(shape[0])

    def change(self, nodal: FloatArray) -> FloatArray:
        """(H - 1) nodal, column by column, right on own and ghost nodes. Collective; one halo exchange."""
        out = np.zeros(nodal.shape)
        for column, values in enumerate(self._load(nodal)):
            stencil.convolve(
                values, self._weights, self.grid.padded_shape, self.halo.layout, self._plane, self._line, self._result
            )
            self._result -= self.grid.nodes.own(nodal[:, column]).ravel()
            self._store(out[:, column])
        self.grid.nodes.fill(out)
        return out

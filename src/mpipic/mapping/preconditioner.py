"""A preconditioner for the Gram matrix: one short symmetric stencil per axis.

On a lattice the scaled G is the tensor product of one-dimensional circulant matrices; on other patterns it resembles
that, with the mean over nodes of the entries along the axis as theirs. The inverse of each is approximated by a stencil
of a few nodes. It is positive definite, the same on any number of ranks, and needs one halo exchange. Which scaling
brings G closest to a tensor product depends on the basis: diag(G) on the linear one (a node whose particles are all far
from it has a smaller diagonal than its row sum says), halfway to the row sums on the cubic one (`TILT`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from petsc4py import PETSc

from mpipic.arrays import FloatArray
from mpipic.kernels import stencil
from mpipic.mesh.halo import Halo, PaddedColumns

if TYPE_CHECKING:
    from mpipic.mapping.gram_stencil import GramStencil

STENCIL_REACH = {1: 2, 2: 5, 3: 8}
"""Degree of the splines to the nodes either side that the stencil along an axis takes."""
TILT = {1: 0.0, 2: 0.25, 3: 0.6}
"""Degree to the exponent t of the scaling, diag(G)^(1 - t) diag(d)^t."""


def inverse_stencil(couplings: FloatArray, reach: int) -> FloatArray:
    """Return weights (reach + 1,) of the symmetric stencil near the inverse of the circulant (..., c₁, 1, c₁, ...).

    With the symbol λ(θ) = 1 + 2 Σ_j c_j cos jθ it is the stencil g that makes 1 - λ g least in the mean square over θ;
    a symbol that comes near 0 is held above 0.02 of its largest value, and g above 0, so that the stencil is positive
    definite whatever the couplings are. Local.
    """
    theta = np.linspace(0.0, np.pi, 129)
    cosines = np.cos(theta[:, None] * np.arange(max(reach, len(couplings)) + 1))
    cosines[:, 1:] *= 2.0
    symbol = cosines[:, : len(couplings) + 1] @ np.concatenate([[1.0], couplings])
    symbol = np.maximum(symbol, 0.02 * symbol.max())
    basis = cosines[:, : reach + 1]
    ends = np.where((theta == 0.0) | (theta == np.pi), np.sqrt(0.5), 1.0)  # the trapezoidal rule over a period
    weights = np.asarray(np.linalg.lstsq((ends * symbol)[:, None] * basis, ends, rcond=None)[0])
    least = 0.1 / symbol.max()
    weights[0] += max(0.0, least - float((basis @ weights).min()))
    return weights


class TensorPreconditioner:
    """One short stencil per axis, all applied in one pass to every column; a PETSc shell preconditioner.

    Notes
    -----
    `refresh` is collective, one reduction; `apply` too, one halo exchange.
    """

    def __init__(self, matrix: GramStencil) -> None:
        self.matrix = matrix
        grid, self._reach = matrix.grid, STENCIL_REACH[matrix.grid.degree]
        self.halo = Halo(grid.comm, grid.cells, grid.starts, self._reach)
        self._values = PaddedColumns(self.halo)
        shape = self.halo.ghost_shape
        self._plane, self._line = np.empty(int(np.prod(shape[:2]))), np.empty(shape[0])
        self.stencils = np.eye(1, self._reach + 1).repeat(3, axis=0)
        self._tilt: FloatArray | None = None
        self._version = -1

    @property
    def nbytes(self) -> int:
        """Bytes of the work arrays."""
        return self._values.nbytes + self._plane.nbytes + self._line.nbytes

    def refresh(self) -> None:
        """Take scaling and couplings of the matrix as it is now, unless they are. Collective."""
        matrix, tilt = self.matrix, TILT[self.matrix.grid.degree]
        if self._version == matrix.version:
            return
        self._version = matrix.version
        padded = None
        if tilt and matrix.penalty is None:
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = matrix.root**2 / matrix.grid.nodes.own(matrix.mapping.row_sums).ravel()
            self._tilt = np.where(matrix.root > 0.0, ratio, 0.0) ** (0.5 * tilt)
            padded = matrix.load(self._tilt[None])[0]
        for axis, couplings in enumerate(matrix.axis_means(padded)):
            self.stencils[axis] = inverse_stencil(couplings, self._reach)

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = the stencils times x, as PETSc calls it."""
        matrix = self.matrix
        own = x.getArray(readonly=True).reshape(-1, matrix.root.size)
        values = self._values.load(own if self._tilt is None else own * self._tilt)
        with y as out:
            columns = out.reshape(own.shape)
            for column, padded in zip(columns, values, strict=True):
                stencil.convolve(
                    padded, self.stencils, matrix.shape, self.halo.layout, self._plane, self._line, column
                )  # fmt: skip
            if self._tilt is not None:
                columns *= self._tilt
            columns[:, matrix.unseen] = 0.0

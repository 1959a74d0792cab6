"""The Gram matrix G = ΦᵀΦ as a stencil on nodes, scaled to unit diagonal; with a roughness penalty if asked for.

With r = sqrt(diag G) the unknown is y = r a in (r⁻¹ G r⁻¹) y = r⁻¹ b. For nodes that no particle sees it reads y = 0,
and they get a = 0. `mpipic.mapping.solver` solves with it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import comb
from typing import TYPE_CHECKING
from weakref import proxy

import numpy as np
from petsc4py import PETSc

from mpipic.arrays import FloatArray
from mpipic.kernels import stencil
from mpipic.mesh.halo import Halo, PaddedColumns

if TYPE_CHECKING:
    from mpipic.mapping.gram import GramSource
    from mpipic.mapping.preconditioner import TensorPreconditioner

SHIFT = 1e-15
"""Added to the unit diagonal: where rounding alone decides whether G is singular, this much decides that it is not."""


@dataclass(frozen=True)
class Penalty:
    """Roughness penalty of P-splines, ε n̄ Σ_a Δ_sᵀ Δ_s / 4^s: Δ_s the s-th difference along an axis, n̄ = Σ d / m.

    Smooth fields pass; waves that no particle sees are set by their neighbours, so that G with it is positive definite
    on every pattern, unless all particles sit at too few places to tell polynomials of degree s - 1 apart.
    """

    strength: float
    order: int

    def couplings(self) -> FloatArray:
        """(s + 1,) coefficients of the stencil along one axis, the middle one first; largest symbol 1."""
        s = self.order
        return self.strength * np.array([(-1.0) ** j * comb(2 * s, s + j) for j in range(s + 1)]) / 4.0**s


class GramStencil:
    """G at the mapping's positions, scaled to unit diagonal; a PETSc shell matrix.

    Its vectors are one or more columns of own nodes, x fastest, one column after the other: G is applied to each.

    Parameters
    ----------
    mapping
        Where G comes from.
    penalty
        Added to G.

    Attributes
    ----------
    root, scale : (own nodes,)
        r and 1/r, both 0 on nodes that no particle sees.
    unseen
        Indices of those nodes.

    Notes
    -----
    Memory per node: 16 bytes for each of ((2 k + 1)^d + 1) / 2 diagonals on splines of degree k, and 4 vectors.
    `refresh` is collective: three halo exchanges, with a penalty one reduction; so is `mult`: one halo exchange.
    """

    def __init__(self, mapping: GramSource, penalty: Penalty | None = None) -> None:
        grid, degree = mapping.grid, mapping.grid.degree
        self.mapping, self.grid, self.penalty = mapping, grid, penalty
        self.reach = max(degree, penalty.order if penalty else 0)
        self.halo = Halo(grid.comm, grid.cells, grid.starts, self.reach)
        self._touched = Halo(grid.comm, grid.cells, grid.starts, self.reach, grid.reach)
        self._coupled = Halo(grid.comm, grid.cells, grid.starts, self.reach, (degree, degree))
        steps = np.array([1, *self.halo.layout[1:]])
        self.shape = grid.padded_shape
        half = stencil.half_stencil(grid.dim, degree)
        beyond = [[j * (a == axis) for a in range(3)] for axis in range(grid.dim) for j in range(1, self.reach + 1)]
        neighbours = np.array([*half.tolist(), *(row for row in beyond if max(row) > degree)])
        self.offsets = neighbours @ steps
        number = {tuple(offset): h for h, offset in enumerate(neighbours.tolist())}
        self._along = [
            [number[tuple(j * (a == axis) for a in range(3))] for j in range(1, self.reach + 1)]
            for axis in range(grid.dim)
        ]  # numbers of the diagonals to the next, second, ... node along each axis
        self._entries = np.zeros((self.halo.local_nodes, len(half)))
        self.diagonals = np.zeros((len(self.offsets), self.halo.local_nodes))
        self._values = PaddedColumns(self.halo)
        self._products = PaddedColumns(self.halo)
        self.root, self.scale = np.empty(grid.local_cells), np.empty(grid.local_cells)
        self.version = -1

    @cached_property
    def preconditioner(self) -> TensorPreconditioner:
        """The stencil that nearly inverts the scaled G, for all who solve; made when first asked for. Collective."""
        from mpipic.mapping.preconditioner import TensorPreconditioner

        return TensorPreconditioner(proxy(self))  # no cycle of references, see `Gram`

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays held."""
        arrays = (self._entries, self.diagonals, self.root, self.scale)
        return self._values.nbytes + self._products.nbytes + sum(a.nbytes for a in arrays)

    def refresh(self) -> bool:
        """Follow the mapping to its present positions; False if it has not moved. Collective."""
        if self.version == self.mapping.version:
            return False
        self.version = self.mapping.version
        halo, entries, constants = self.halo, self._entries, self._penalty_constants()
        entries.fill(0.0)
        self.mapping.add_gram_entries(halo.layout, entries)
        self._touched.add(entries)
        self._coupled.fill(entries)
        root, scale = np.empty((2, halo.local_nodes))
        stencil.root_and_scale(entries[:, 0] + constants[0], root, scale)
        halo.fill(scale)
        self.root[:], self.scale[:] = halo.own(root).ravel(), halo.own(scale).ravel()
        self.unseen = np.flatnonzero(self.root == 0.0)
        stencil.scale_diagonals(entries, constants, self.offsets, scale, self.diagonals)
        return True

    def _penalty_constants(self) -> FloatArray:
        """Return what the penalty adds to every diagonal. Collective; one reduction, none without a penalty."""
        constants = np.zeros(len(self.offsets))
        if self.penalty is not None:
            total = self.grid.reduce(np.array([self.grid.owned(self.mapping.row_sums).sum()]))[0]
            couplings = self.penalty.couplings() * (total / self.grid.node_count)
            constants[0] = self.grid.dim * couplings[0]
            for axis in range(self.grid.dim):
                constants[self._along[axis][: self.penalty.order]] = couplings[1:]
        return constants

    def load(self, own: FloatArray) -> FloatArray:
        """Return a padded copy (k, local_nodes) of own values (k, own nodes), ghosts filled. Collective."""
        return self._values.load(own)

    def multiply(self, nodal: FloatArray, out: FloatArray) -> None:
        """Put G nodal into `out`, both nodal arrays of the grid (local_nodes, k), ghosts filled too.

        Collective; two halo exchanges.
        """
        self.refresh()
        nodes = self.grid.nodes
        product = self._product(nodes.columns(nodal) * self.root)
        block = nodes.own(out)
        scaled = product * self.root.reshape(product.shape[1:])
        block[...] = np.moveaxis(scaled, 0, -1)
        nodes.fill(out)

    def _product(self, own: FloatArray) -> FloatArray:
        """Return the scaled G times columns (k, own nodes): (k, z, y, x), a view valid until the next. Collective."""
        values = self.load(own)
        product, block = self._products.rows(len(values))
        stencil.multiply(self.diagonals, self.offsets, 1.0 + SHIFT, values, self.shape, self.halo.layout, product)
        return block

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = G x, as PETSc calls it. Collective; one halo exchange."""
        product = self._product(x.getArray(readonly=True).reshape(-1, self.root.size))
        with y as out:
            out.reshape(product.shape)[...] = product

    def getDiagonal(self, mat: PETSc.Mat, y: PETSc.Vec) -> None:
        """Return the diagonal: ones. Local."""
        y.set(1.0)

    def axis_means(self, tilt: FloatArray | None) -> FloatArray:
        """Return the mean entries to the next nodes along each axis, relative to the diagonal's, (d, reach).

        tilt : padded factors, one a node, that rows and columns are multiplied with before. Collective.
        """
        halo, rows = self.halo, [0, *(h for axis in range(self.grid.dim) for h in self._along[axis])]
        sums = np.empty(len(rows))
        main = np.zeros(halo.local_nodes)
        halo.own(main)[...] = (self.root > 0.0).reshape(halo.own(main).shape)
        for place, h in enumerate(rows):
            entries = self.diagonals[h] if h else main
            if tilt is not None:
                entries = entries * tilt * np.roll(tilt, -self.offsets[h])
            sums[place] = halo.own(entries).sum()
        self.grid.reduce(sums)
        return np.asarray(sums[1:] / (sums[0] or 1.0)).reshape(self.grid.dim, self.reach)

    def assembled(self, sparse: bool = False) -> PETSc.Mat:
        """Return a new matrix of one column's G; if `sparse`, without the entries that are 0 now. Collective."""
        own, row = self.root.size, 2 * len(self.offsets) - 1
        matrix = PETSc.Mat().createAIJ(((own, None), (own, None)), nnz=row, comm=self.grid.comm)
        matrix.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)
        matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        matrix.setOption(PETSc.Mat.Option.IGNORE_ZERO_ENTRIES, sparse)
        self.assemble(matrix)
        return matrix

    def assemble(self, matrix: PETSc.Mat) -> None:
        """Put the entries of one column's G into an assembled matrix. Collective."""
        halo = self.halo
        own = halo.own(np.arange(halo.local_nodes)).ravel()
        number = np.full(halo.local_nodes, -1.0)
        first = matrix.getOwnershipRange()[0]
        halo.own(number)[...] = (first + np.arange(own.size)).reshape(halo.own(number).shape)
        halo.fill(number)
        columns = [own] + [own + o for o in self.offsets[1:]] + [own - o for o in self.offsets[1:]]
        entries = [np.full(own.size, 1.0 + SHIFT)]
        entries += [self.diagonals[h, own] for h in range(1, len(self.offsets))]
        entries += [self.diagonals[h, own - self.offsets[h]] for h in range(1, len(self.offsets))]
        starts = np.arange(own.size + 1) * len(columns)
        column = number[np.stack(columns, axis=1).ravel()]
        matrix.zeroEntries()
        matrix.setValuesIJV(
            starts.astype(PETSc.IntType), column.astype(PETSc.IntType), np.stack(entries, axis=1).ravel(),
            addv=PETSc.InsertMode.ADD_VALUES,
        )  # fmt: skip
        matrix.assemble()

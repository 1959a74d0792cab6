"""The Gram matrix G = ΦᵀVΦ at a mapping's positions: one product, by whichever form costs least.

On the linear basis the pair moments of every cell hold G (see `kernels.cells`). On splines a column is either passed
over the particles, to them and back, or multiplied with G assembled as a stencil on the nodes, which has to be done
once for every position and pays when enough columns follow.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol
from weakref import proxy

import numpy as np

from mpipic.arrays import FloatArray
from mpipic.kernels import BY_DIMENSION

if TYPE_CHECKING:
    from mpipic.mapping.gram_stencil import GramStencil
    from mpipic.mesh.grid import Grid

COSTS = {
    (1, 1): (8.0, 8.0, 3.0),
    (1, 2): (10.0, 9.0, 3.0),
    (1, 3): (12.0, 12.0, 3.0),
    (2, 1): (101.0, 60.0, 5.0),
    (2, 2): (121.0, 96.0, 8.0),
    (2, 3): (144.0, 136.0, 12.0),
    (3, 1): (119.0, 150.0, 10.0),
    (3, 2): (188.0, 447.0, 35.0),
    (3, 3): (326.0, 1370.0, 137.0),
}
"""Dimension and degree to nanoseconds (one core, 4 random particles a cell): of a column passed to a particle
and back, of assembly a particle, of a product a node. They decide which form is taken, not what comes out."""
MARGIN = 1.5
"""By how much assembly must pay, since it takes memory."""


class GramSource(Protocol):
    """A mapping gives this to make G of."""

    grid: Grid
    row_sums: FloatArray
    version: int

    @property
    def moments(self) -> FloatArray | None:
        """Pair moments (local_cells, 3^d), or None. Local."""
        ...

    @property
    def count(self) -> int:
        """Particles on this rank."""
        ...

    def add_passed(self, nodal: FloatArray, out: FloatArray) -> None:
        """Add G nodal to `out`, one column; ghosts still hold their share. Local."""
        ...

    def add_gram_entries(self, layout: tuple[int, int, int], entries: FloatArray) -> None:
        """Add half of G's rows to `entries` (see `kernels.stencil`); ghosts still hold their share. Local."""
        ...

    def complete(self, sums: FloatArray) -> FloatArray:
        """Return sums made right on own and ghost nodes, in place. Collective."""
        ...


class Gram:
    """G, symmetric, positive semidefinite, G 1 = d; follows its mapping.

    It belongs to its mapping and does not keep it alive: a cycle of references would leave PETSc's objects to the
    garbage collector, which comes at different times on different ranks.

    Attributes
    ----------
    assembled : bool
        Whether the last product used the stencil.
    """

    def __init__(self, mapping: GramSource) -> None:
        self.mapping: GramSource = proxy(mapping)
        self.assembled = False
        self._stencil: GramStencil | None = None
        self._version, self._columns, self._before = -1, 0, 0
        self._break_even = -1.0

    @property
    def stencil(self) -> GramStencil:
        """G as a stencil on the nodes, made when first asked for; `refresh` it before use. Collective."""
        if self._stencil is None:
            from mpipic.mapping.gram_stencil import GramStencil

            self._stencil = GramStencil(self.mapping)
        return self._stencil

    @property
    def nbytes(self) -> int:
        """Bytes of the stencil, if there is one."""
        return 0 if self._stencil is None else self._stencil.nbytes

    def apply(self, nodal: FloatArray, out: FloatArray | None = None) -> FloatArray:
        """Return G nodal, right on own and ghost nodes: (local_nodes, *shape) to the same; ghosts of `nodal` filled.

        out : where to put it, C-contiguous. Collective on neighbours; two halo exchanges.
        """
        result = np.empty(nodal.shape) if out is None else out
        wide, into = nodal.reshape(len(nodal), -1), result.reshape(len(nodal), -1)
        self.assembled = self.mapping.moments is None and self._pays(wide.shape[1])
        if self.assembled:
            self.stencil.multiply(wide, into)
        else:
            into.fill(0.0)
            for column in range(wide.shape[1]):
                self._add(wide, into, column)
            self.mapping.complete(into)
        return result

    def _add(self, nodal: FloatArray, out: FloatArray, column: int) -> None:
        grid, moments = self.mapping.grid, self.mapping.moments
        if moments is None:
            self.mapping.add_passed(nodal[:, column : column + 1], out[:, column : column + 1])
        else:  # the whole arrays, not a slice: the loop is compiled for contiguous ones
            BY_DIMENSION[grid.dim].gram(moments, grid.padded_shape, grid.layout, nodal, out, column)

    def _pays(self, columns: int) -> bool:
        """Return whether to assemble, from the columns so far at these positions or in all at those before.

        The same on all ranks. Collective when first asked.
        """
        if self._version != self.mapping.version:
            self._version, self._before, self._columns = self.mapping.version, self._columns, 0
        self._columns += columns
        if self._break_even < 0.0:
            grid = self.mapping.grid
            passed, assembly, product = COSTS[grid.dim, grid.degree]
            particles = float(grid.reduce(np.array([float(self.mapping.count)]))[0])
            saved = passed * particles - product * grid.node_count
            self._break_even = MARGIN * assembly * particles / saved if saved > 0.0 else np.inf
        return max(self._columns, self._before) > self._break_even

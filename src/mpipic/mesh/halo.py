"""Ghost nodes: padded copies of a rank's block of nodes, and the two verbs that keep them right.

Ghost nodes move between ranks, and around the period, by `add` (ghosts add into their owners) and `fill` (owners copy
to their ghosts), over a PETSc star forest. Blocks may be smaller than the padding: a ghost is found by its global node,
however many ranks or periods away.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any
from weakref import finalize

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from petsc4py import PETSc

from mpipic.arrays import FloatArray
from mpipic.mesh.petsc_objects import close_at_exit

Nodes = npt.NDArray[Any]
"""Nodal arrays of any numbers."""
Exchange = Callable[[MPI.Datatype, FloatArray, FloatArray, MPI.Op], None]


class Halo:
    """A rank's block of nodes with `width` ghost nodes on either side of every axis.

    Padded arrays are C-contiguous, x fastest: (local_nodes,) or (local_nodes, k). Columns that are kept apart, (k,
    local_nodes), are exchanged by `fill_rows`.

    Parameters
    ----------
    comm
        mpi4py communicator.
    cells
        Nodes per axis of the whole periodic grid, x first.
    starts
        Per axis the first node of every block along it; ranks count blocks x fastest.
    width
        Ghost nodes on either side.
    reach : (int, int), optional
        How many of them below and above are exchanged; default all.

    Attributes
    ----------
    owned_start, owned_shape, ghost_shape
        First own node, own nodes and padded nodes per axis, x first.
    layout : (int, int, int)
        Flat index of the first own node; flat strides along y and z.
    neighbours : int
        Other ranks that this rank's ghosts belong to.
    exchanges : int
        How often ghosts have been added or filled.

    Notes
    -----
    Building is collective, O(local nodes).
    """

    def __init__(
        self,
        comm: MPI.Comm,
        cells: Sequence[int],
        starts: Sequence[npt.NDArray[np.int64]],
        width: int,
        reach: tuple[int, int] | None = None,
    ) -> None:
        self.comm, self.width = comm, width
        sizes = [np.diff(np.append(first, n)) for first, n in zip(starts, cells, strict=True)]
        block = np.unravel_index(comm.rank, [len(size) for size in sizes], order="F")
        self.owned_start = tuple(int(first[b]) for first, b in zip(starts, block, strict=True))
        self.owned_shape = tuple(int(size[b]) for size, b in zip(sizes, block, strict=True))
        self.ghost_shape = tuple(n + 2 * width for n in self.owned_shape)
        self.local_nodes = int(np.prod(self.ghost_shape))
        self._padded = self.ghost_shape[::-1]
        self._own = tuple(slice(width, width + n) for n in self.owned_shape[::-1])
        strides = np.concatenate([[1], np.cumprod(self.ghost_shape)])
        self.layout = (
            int(width * strides[: len(cells)].sum()),
            int(strides[1]),
            int(strides[2]) if len(cells) > 1 else int(strides[1]),
        )
        self.exchanges = 0
        self._units: dict[int, MPI.Datatype] = {}
        finalize(self, _free, self._units)
        self._find(cells, starts, sizes, (width, width) if reach is None else reach)
        self._forest = self._join(1)
        self._forests = {1: self._forest}
        close_at_exit(self, comm)

    def close(self) -> None:
        """Give PETSc's objects back; no exchange after this. Collective."""
        for forest in self._forests.values():
            forest.destroy()

    def _find(
        self,
        cells: Sequence[int],
        starts: Sequence[npt.NDArray[np.int64]],
        sizes: Sequence[npt.NDArray[np.int64]],
        reach: tuple[int, int],
    ) -> None:
        """Ghosts within reach; of each its owner, where it is in the owner's array, and how large that is."""
        index = np.arange(self.local_nodes).reshape(self.ghost_shape[::-1])
        ghost = np.zeros(self.local_nodes, dtype=bool)
        ghost[self.block(index, reach).ravel()] = True
        ghost[self.block(index).ravel()] = False
        leaves = np.flatnonzero(ghost)
        owner, root = np.zeros((2, leaves.size), dtype=np.int64)
        ranks, stride, rest = 1, np.ones(leaves.size, dtype=np.int64), leaves
        for axis, n in enumerate(cells):
            rest, along = np.divmod(rest, self.ghost_shape[axis])
            node = np.mod(self.owned_start[axis] - self.width + along, n)
            block = np.searchsorted(starts[axis], node, side="right") - 1
            owner += ranks * block
            root += stride * (node - starts[axis][block] + self.width)
            ranks *= len(sizes[axis])
            stride = stride * (sizes[axis][block] + 2 * self.width)
        self.neighbours = int(np.setdiff1d(owner, [self.comm.rank]).size)
        self._ghosts = (leaves, owner, root, stride)

    def _join(self, rows: int) -> PETSc.SF:
        """Return the star forest of arrays (rows, local_nodes): ghosts are leaves of the nodes they are copies of."""
        leaves, owner, root, nodes = self._ghosts
        row = np.arange(rows)[:, None]
        local = (row * self.local_nodes + leaves).ravel()
        remote = np.stack([np.tile(owner, rows), (row * nodes + root).ravel()], axis=1)
        forest = PETSc.SF().create(self.comm)
        forest.setGraph(
            rows * self.local_nodes, local.astype(PETSc.IntType), remote.astype(PETSc.IntType).ravel()
        )  # fmt: skip
        forest.setUp()
        return forest

    def block(self, array: Nodes, reach: tuple[int, int] = (0, 0)) -> Nodes:
        """Return a view of the own nodes, and `reach` below and above, of an array shaped like ghost_shape reversed."""
        slices = tuple(slice(self.width - reach[0], self.width + n + reach[1]) for n in self.owned_shape)
        return array[slices[::-1]]

    def own(self, padded: Nodes) -> Nodes:
        """Return a view of the own nodes of a padded array (local_nodes, ...): (z, y, x, ...). Local."""
        return padded.reshape(self._padded + padded.shape[1:])[self._own]

    def columns(self, padded: FloatArray) -> FloatArray:
        """Return the own values of a padded array (local_nodes, *shape) as columns (k, own nodes). Local."""
        own = self.own(padded.reshape(self.local_nodes, -1))
        return np.moveaxis(own, -1, 0).reshape(own.shape[-1], -1)

    def nodal(self, columns: FloatArray) -> FloatArray:
        """Return columns (k, own nodes) as a padded array (local_nodes, k), ghosts filled. Collective."""
        out = np.zeros((self.local_nodes, len(columns)))
        own = self.own(out)
        own[...] = np.moveaxis(columns.reshape(-1, *own.shape[:-1]), 0, -1)
        self.fill(out)
        return out

    def own_rows(self, rows: Nodes) -> Nodes:
        """Return a view of the own nodes of rows (k, local_nodes): (k, z, y, x), axes there are. Local."""
        return rows.reshape(len(rows), *self._padded)[(slice(None), *self._own)]

    def add(self, *padded: FloatArray) -> None:
        """Add what ghosts hold into their owners, in place; ghosts keep their own share.

        Particles in a rank's upper cells touch nodes that the next rank owns: each rank sums what it sees, here the
        owner gets the sum of all shares. Its ghosts hold parts only until a `fill` gives them the whole.

        Collective; one message an array to each neighbour, all under way together.
        """
        self._exchange(self._forest.reduceBegin, self._forest.reduceEnd, MPI.SUM, padded)

    def fill(self, *padded: FloatArray) -> None:
        """Copy the owners' values to their ghosts, in place. Collective; messages as for `add`."""
        self._exchange(self._forest.bcastBegin, self._forest.bcastEnd, MPI.REPLACE, padded)

    def fill_rows(self, padded: FloatArray) -> None:
        """Do as `fill` for the rows of one array (k, local_nodes). Collective; one message to each neighbour."""
        rows = len(padded)
        if rows not in self._forests:
            self._forests[rows] = self._join(rows)
        self.exchanges += 1
        self._forests[rows].bcastBegin(MPI.DOUBLE, padded, padded, MPI.REPLACE)
        self._forests[rows].bcastEnd(MPI.DOUBLE, padded, padded, MPI.REPLACE)

    def _exchange(self, begin: Exchange, end: Exchange, how: MPI.Op, arrays: Sequence[FloatArray]) -> None:
        self.exchanges += len(arrays)
        arrays = [array for array in arrays if array.size]  # values without components have nothing to send
        for array in arrays:
            begin(self._unit(array), array, array, how)
        for array in arrays:
            end(self._unit(array), array, array, how)

    def _unit(self, padded: FloatArray) -> MPI.Datatype:
        """Return one node's columns as one MPI item; PETSc cannot add into a derived type of a single number."""
        columns = padded.size // self.local_nodes
        if columns == 1:
            return MPI.DOUBLE
        if columns not in self._units:
            self._units[columns] = MPI.DOUBLE.Create_contiguous(columns).Commit()
        return self._units[columns]


def _free(types: dict[int, MPI.Datatype]) -> None:
    """Give datatypes back to MPI, unless it has ended before. Local."""
    if not MPI.Is_finalized():
        for item in types.values():
            item.Free()
    types.clear()


class PaddedColumns:
    """Work arrays for padded copies of columns of own values, ghosts filled: one for every number of columns used."""

    def __init__(self, halo: Halo) -> None:
        self.halo = halo
        self._arrays: dict[int, tuple[FloatArray, FloatArray]] = {}

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return sum(rows.nbytes for rows, _ in self._arrays.values())

    def rows(self, count: int) -> tuple[FloatArray, FloatArray]:
        """Return the array (count, local_nodes), and the view (count, z, y, x) of its own nodes. Local."""
        if count not in self._arrays:
            rows = np.zeros((count, self.halo.local_nodes))
            self._arrays[count] = rows, self.halo.own_rows(rows)
        return self._arrays[count]

    def load(self, own: FloatArray) -> FloatArray:
        """Return a padded copy (k, local_nodes) of own values (k, z, y, x) or (k, own nodes), valid until the next.

        Collective; one halo exchange.
        """
        rows, block = self.rows(len(own))
        block[...] = own.reshape(block.shape)
        self.halo.fill_rows(rows)
        return rows

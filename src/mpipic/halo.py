"""Ghost nodes: padded copies of a rank's block of nodes, and the two verbs that keep them right.

Ghost nodes move between ranks, and around the period, by `add` (ghosts add into their owners) and `fill` (owners copy
to their ghosts), over a PETSc star forest. Blocks may be smaller than the padding: a ghost is found by its global node,
however many ranks or periods away.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from petsc4py import PETSc

FloatArray = npt.NDArray[np.float64]
Exchange = Callable[[MPI.Datatype, FloatArray, FloatArray, MPI.Op], None]


class Halo:
    """A rank's block of nodes with `width` ghost nodes on either side of every axis.

    Padded arrays are C-contiguous, x fastest: (local_nodes,), (local_nodes, k), or, for a column by itself, one row of
    (k, local_nodes).

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
        strides = np.concatenate([[1], np.cumprod(self.ghost_shape)])
        self.layout = (
            int(width * strides[: len(cells)].sum()),
            int(strides[1]),
            int(strides[2]) if len(cells) > 1 else int(strides[1]),
        )
        self.exchanges = 0
        self._units: dict[int, MPI.Datatype] = {}
        self._join(cells, starts, sizes, (width, width) if reach is None else reach)

    def _join(
        self,
        cells: Sequence[int],
        starts: Sequence[npt.NDArray[np.int64]],
        sizes: Sequence[npt.NDArray[np.int64]],
        reach: tuple[int, int],
    ) -> None:
        """The star forest: ghosts within reach are leaves, each of the node at its owner that it is a copy of."""
        index = np.arange(self.local_nodes).reshape(self.ghost_shape[::-1])
        ghost = np.zeros(self.local_nodes, dtype=bool)
        ghost[self.block(index, reach).ravel()] = True
        ghost[self.block(index).ravel()] = False
        leaves = np.flatnonzero(ghost).astype(PETSc.IntType)
        owner = np.zeros(leaves.size, dtype=np.int64)
        root = np.zeros(leaves.size, dtype=np.int64)
        ranks, stride, rest = 1, np.ones(leaves.size, dtype=np.int64), leaves.astype(np.int64)
        for axis, n in enumerate(cells):
            rest, along = np.divmod(rest, self.ghost_shape[axis])
            node = np.mod(self.owned_start[axis] - self.width + along, n)
            block = np.searchsorted(starts[axis], node, side="right") - 1
            owner += ranks * block
            root += stride * (node - starts[axis][block] + self.width)
            ranks *= len(sizes[axis])
            stride = stride * (sizes[axis][block] + 2 * self.width)
        self.neighbours = int(np.setdiff1d(owner, [self.comm.rank]).size)
        self._forest = PETSc.SF().create(self.comm)
        remote = np.stack([owner, root], axis=1).astype(PETSc.IntType)
        self._forest.setGraph(self.local_nodes, leaves, remote.ravel())
        self._forest.setUp()

    def block(self, array: np.ndarray, reach: tuple[int, int] = (0, 0)) -> np.ndarray:
        """View of the own nodes, and of `reach` below and above, of an array shaped like ghost_shape reversed."""
        slices = tuple(slice(self.width - reach[0], self.width + n + reach[1]) for n in self.owned_shape)
        return array[slices[::-1]]

    def own(self, padded: np.ndarray) -> np.ndarray:
        """View of the own nodes of a padded array (local_nodes, ...): (z, y, x, ...), axes there are. Local."""
        return self.block(padded.reshape(self.ghost_shape[::-1] + padded.shape[1:]))

    def add(self, *padded: FloatArray) -> None:
        """Add what ghosts hold into their owners, in place; ghosts keep their own share.

        Collective; one message an array to each neighbour, all under way together.
        """
        self._exchange(self._forest.reduceBegin, self._forest.reduceEnd, MPI.SUM, padded)

    def fill(self, *padded: FloatArray) -> None:
        """Copy the owners' values to their ghosts, in place. Collective; messages as for `add`."""
        self._exchange(self._forest.bcastBegin, self._forest.bcastEnd, MPI.REPLACE, padded)

    def _exchange(self, begin: Exchange, end: Exchange, how: MPI.Op, arrays: Sequence[FloatArray]) -> None:
        self.exchanges += len(arrays)
        for array in arrays:
            begin(self._unit(array), array, array, how)
        for array in arrays:
            end(self._unit(array), array, array, how)

    def _unit(self, padded: FloatArray) -> MPI.Datatype:
        """One node's columns as one MPI item; PETSc cannot add into a derived type of a single number."""
        columns = padded.size // self.local_nodes
        if columns == 1:
            return MPI.DOUBLE
        if columns not in self._units:
            self._units[columns] = MPI.DOUBLE.Create_contiguous(columns).Commit()
        return self._units[columns]

"""The node grid: uniform, periodic, split into one block per rank by a PETSc DMDA.

Node i of an axis lies at i h and opens cell i, so a rank owns the cells of its nodes. Nodal arrays are local, ghosted
and C-contiguous, of shape (local_nodes,) or (local_nodes, k), x fastest: the block a DMDA calls local. Ghost nodes
move between ranks, and around the period, in two verbs: `sum_halo` (ghosts add into their owners) and `fill_halo`
(owners copy to their ghosts).

Where a particle is, is kept as its coordinate in cells, a whole multiple of `Grid.quantum` (one unit in the last place
of the number of cells). Sums of such numbers are exact: particles that all move by the same displacement keep their
distances to the last bit, a lattice stays one, and a pattern that should recur does. In units of length neither would
hold, and the rounding of positions alone would feed null-space noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from petsc4py import PETSc

from mpipic.decomposition import process_grid

FloatArray = npt.NDArray[np.float64]

ON_NODE = 1e-10
"""A particle within this many cells of a node counts as on it, so that rounding never decides the side."""


def columns_of(values: npt.ArrayLike) -> FloatArray:
    """Values (n,) or (n, k) as a C-contiguous array (n, k), copied only where they are not one."""
    array = np.asarray(values, dtype=np.float64)
    return np.ascontiguousarray(array if array.ndim == 2 else array[:, None])


def raise_together(comm: MPI.Comm, problem: str | None) -> None:
    """Raise ValueError on all ranks with the problem of the lowest rank that has one. Collective; one reduction."""
    first = comm.allreduce(comm.rank if problem else comm.size, op=MPI.MIN)
    if first < comm.size:
        raise ValueError(f"rank {first}: {comm.bcast(problem, root=first)}")


class Grid:
    """A periodic grid of `cells` cells over a box of size `length`, split over the ranks of `comm`.

    Parameters
    ----------
    cells : one to three whole numbers
        Cells, and so nodes, per axis.
    length : floats, one per axis
        Period per axis, any unit of length.
    comm
        mpi4py communicator; every rank must take part in building the grid and in the halo verbs.
    reach : (int, int)
        How many nodes below and above the lower node of its cell a particle touches; (0, 1) on the linear basis.

    Attributes
    ----------
    dim, cells, length, h
        Dimension, cells, period and spacing per axis.
    owned_start, owned_shape
        First own cell, and number of own cells, per axis (x, y, z).
    local_nodes, local_cells
        Entries of a nodal array (own and ghost nodes), own cells.
    layout : (int, int, int)
        Flat index of the node that opens the first own cell; flat strides along y and z.
    quantum, tolerance : floats, cells
        Coordinates are multiples of the one; within the other of a node a particle counts as on it.
    starts : arrays, one per axis
        First cell of each block along the axis.

    Raises
    ------
    ValueError
        If the ranks cannot be laid out with at least one cell each.

    Notes
    -----
    Collective. Cost: O(local nodes) once.
    """

    def __init__(
        self,
        cells: Sequence[int],
        length: Sequence[float],
        comm: MPI.Comm = MPI.COMM_WORLD,
        reach: tuple[int, int] = (0, 1),
    ) -> None:
        self.comm, self.rank, self.size = comm, comm.rank, comm.size
        self.cells = tuple(int(n) for n in cells)
        self.length = tuple(float(x) for x in length)
        self.dim = len(self.cells)
        if not 1 <= self.dim <= 3 or len(self.length) != self.dim:
            raise ValueError(f"cells and length need one to three entries each, got {cells} and {length}")
        self.h = tuple(x / n for x, n in zip(self.length, self.cells, strict=True))
        self.inverse_h = tuple(n / x for x, n in zip(self.length, self.cells, strict=True))
        self.quantum = tuple(2.0 ** (math.frexp(n)[1] - 52) for n in self.cells)
        # A whole number of quanta, so that no comparison with it rounds; beyond some hundred thousand cells an axis
        # the quantum itself is coarser than ON_NODE.
        self.tolerance = tuple(max(round(ON_NODE / q), 2) * q for q in self.quantum)
        blocks = process_grid(self.cells, self.size)
        if blocks is None:
            raise ValueError(f"{self.size} ranks cannot share {self.cells} cells with at least one each")
        self.blocks = blocks
        self.reach = reach
        self._create(max(reach))

    def _create(self, width: int) -> None:
        da = PETSc.DMDA().create(
            dim=self.dim,
            sizes=self.cells,
            proc_sizes=self.blocks,
            dof=1,
            boundary_type=PETSc.DM.BoundaryType.PERIODIC,
            stencil_type=PETSc.DMDA.StencilType.BOX,
            stencil_width=width,
            comm=self.comm,
        )
        self.da = da
        self.starts = [np.concatenate([[0], np.cumsum(sizes)[:-1]]) for sizes in da.getOwnershipRanges()]
        start, shape = da.getCorners()
        ghost_start, ghost_shape = da.getGhostCorners()
        self.owned_start, self.owned_shape = tuple(map(int, start)), tuple(map(int, shape))
        self.ghost_shape = tuple(map(int, ghost_shape))
        self._offset = tuple(int(s - g) for s, g in zip(start, ghost_start, strict=True))
        self.local_nodes = int(np.prod(self.ghost_shape))
        self.local_cells = int(np.prod(self.owned_shape))
        self.node_count = int(np.prod(self.cells))
        strides = np.concatenate([[1], np.cumprod(self.ghost_shape)])
        self.layout = (
            int(sum(o * s for o, s in zip(self._offset, strides, strict=False))),
            int(strides[1]),
            int(strides[2]) if self.dim > 1 else int(strides[1]),
        )
        self.padded_shape = self.owned_shape + (1,) * (3 - self.dim)
        self._halo = self._star_forest()
        self._units: dict[int, MPI.Datatype] = {}

    def _star_forest(self) -> PETSc.SF:
        """Ghost nodes that the basis touches (leaves) and the local index of each at its owner (roots).

        DMDA itself tells which rank owns a ghost and under which local index: both are sent through it once.
        """
        index = np.arange(self.local_nodes).reshape(self.ghost_shape[::-1])
        own = self._block(index, (0, 0)).ravel()
        touched = np.zeros(self.local_nodes, dtype=bool)
        touched[self._block(index, self.reach).ravel()] = True
        touched[own] = False
        leaves = np.flatnonzero(touched).astype(PETSc.IntType)
        remote = np.empty((leaves.size, 2), dtype=PETSc.IntType)
        total, local = self.da.createGlobalVec(), self.da.createLocalVec()
        for column, values in enumerate((np.full(own.size, self.rank), own)):
            total.setArray(values.astype(float))
            self.da.globalToLocal(total, local)
            remote[:, column] = local.getArray(readonly=True)[leaves]
        total.destroy()
        local.destroy()
        halo = PETSc.SF().create(self.comm)
        halo.setGraph(self.local_nodes, leaves, remote.ravel())
        halo.setUp()
        return halo

    def _block(self, array: np.ndarray, reach: tuple[int, int]) -> np.ndarray:
        """Own nodes, and `reach` below and above, of an array shaped (z, y, x, ...)."""
        spans = zip(self._offset, self.owned_shape, strict=True)
        slices = tuple(slice(o - reach[0], o + n + reach[1]) for o, n in spans)[::-1]
        return array[slices]

    def zeros(self, columns: int) -> FloatArray:
        """A nodal array of zeros, shape (local_nodes, columns). Local."""
        return np.zeros((self.local_nodes, columns))

    def owned(self, nodal: np.ndarray) -> np.ndarray:
        """View of a nodal array's own nodes, shape owned_shape or owned_shape + (k,), axes in x, y, z order. Local."""
        tail = nodal.shape[1:]
        block = self._block(nodal.reshape(self.ghost_shape[::-1] + tail), (0, 0))
        axes = tuple(reversed(range(self.dim))) + tuple(range(self.dim, self.dim + len(tail)))
        return block.transpose(axes)

    def _unit(self, nodal: FloatArray) -> MPI.Datatype:
        """One node's columns as one MPI item; PETSc cannot add into a derived type of a single number."""
        columns = nodal.size // self.local_nodes
        if columns == 1:
            return MPI.DOUBLE
        if columns not in self._units:
            self._units[columns] = MPI.DOUBLE.Create_contiguous(columns).Commit()
        return self._units[columns]

    def sum_halo(self, nodal: FloatArray) -> None:
        """Add what ghost nodes hold into their owners, in place; ghosts keep their own share.

        Collective; one message to each neighbouring rank.
        """
        unit = self._unit(nodal)
        self._halo.reduceBegin(unit, nodal, nodal, MPI.SUM)
        self._halo.reduceEnd(unit, nodal, nodal, MPI.SUM)

    def fill_halo(self, nodal: FloatArray) -> None:
        """Copy the owners' values to their ghosts, in place. Collective; one message to each neighbouring rank."""
        unit = self._unit(nodal)
        self._halo.bcastBegin(unit, nodal, nodal, MPI.REPLACE)
        self._halo.bcastEnd(unit, nodal, nodal, MPI.REPLACE)

    def cell_of(self, coordinate: FloatArray) -> npt.NDArray[np.int64]:
        """Global cell (n, d) of coordinates (n, d), by the arithmetic of the compiled loops. Local."""
        return np.asarray((coordinate + np.array(self.tolerance)).astype(np.int64))

    def owner_of(self, coordinate: FloatArray) -> npt.NDArray[np.int64]:
        """Rank (n,) that owns the cell of each coordinate (n, d). Local."""
        cell = self.cell_of(coordinate)
        owner = np.zeros(len(cell), dtype=np.int64)
        stride = 1
        for axis, starts in enumerate(self.starts):
            owner += stride * (np.searchsorted(starts, cell[:, axis], side="right") - 1)
            stride *= len(starts)
        return owner

    def coordinate_of(self, position: FloatArray) -> FloatArray:
        """Coordinates (n, d) in cells, in the box, of positions (n, d) in length, any whole number of periods off."""
        return self.wrapped(np.asarray(position) / np.array(self.h))

    def wrapped(self, coordinate: FloatArray) -> FloatArray:
        """Coordinates (n, d) in the box and on its quantum: -tolerance <= x < cells - tolerance. Local.

        A particle that counts as on the upper face is on node 0, and has a coordinate just below 0.
        """
        period = np.array(self.cells, dtype=np.float64)
        with np.errstate(invalid="ignore"):
            inside = self.rounded(np.mod(coordinate, period))
        return np.where(inside >= period - np.array(self.tolerance), inside - period, inside)

    def rounded(self, coordinate: FloatArray) -> FloatArray:
        """Coordinates or displacements in cells, rounded to whole multiples of `quantum`. Local."""
        quantum = np.array(self.quantum)
        with np.errstate(invalid="ignore"):  # infinities become NaN, and are refused where cells are looked up
            return np.asarray(np.rint(np.asarray(coordinate) / quantum) * quantum)

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

from mpipic.arguments import axes_of, choice, nodal_array, positions, real_number, told, whole_number
from mpipic.arrays import FloatArray
from mpipic.box import first_misplaced, is_inside, wrap
from mpipic.decomposition import process_grid
from mpipic.keys import is_normal
from mpipic.mesh.agreement import Said, communicator, together, values_together
from mpipic.mesh.basis import BASES
from mpipic.mesh.halo import Halo, Nodes

ON_NODE = 1e-10
"""A particle within this many cells of a node counts as on it, so that rounding never decides the side."""
MOST_CELLS = int(np.iinfo(PETSc.IntType).max)
"""PETSc numbers nodes by an integer type that is chosen when it is built, commonly of 32 bits."""

Cells = tuple[int, ...]
Lengths = tuple[float, ...]


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
    basis
        linear, quadratic or cubic: the B-splines that particles see the nodes through.

    Attributes
    ----------
    dim, cells, length, h
        Dimension, cells, period and spacing per axis.
    degree, reach
        Those of the basis; see `mesh.basis`.
    owned_start, owned_shape
        First own cell, and number of own cells, per axis (x, y, z).
    local_nodes, local_cells
        Entries of a nodal array (own and ghost nodes), own cells.
    nodes : Halo
        The block of own nodes with its ghosts, which nodal arrays are shaped like.
    layout : (int, int, int)
        Flat index of the node that opens the first own cell; flat strides along y and z.
    quantum, tolerance : floats, cells
        Coordinates are multiples of the one; within the other of a node a particle counts as on it.
    reductions : int
        How often `reduce` has been called.
    starts : arrays, one per axis
        First cell of each block along the axis.

    Raises
    ------
    ValueError, TypeError
        An argument is not as above, cells or spacings are out of range, ranks cannot be laid out with at least one cell
        each, or were given different arguments. Raised on all ranks together.

    Notes
    -----
    Collective: one reduction to agree. Cost: O(local nodes) once.
    """

    def __init__(
        self,
        cells: Sequence[int],
        length: Sequence[float],
        comm: MPI.Comm = MPI.COMM_WORLD,
        basis: str = "linear",
    ) -> None:
        self.comm = communicator(comm)
        self.rank, self.size = comm.rank, comm.size
        self.cells, self.length = self._agree(cells, length, basis)
        self.dim = len(self.cells)
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
        self.starts = self._divide()
        self.degree, self.reach = BASES[basis].degree, BASES[basis].reach
        self.nodes = Halo(comm, self.cells, self.starts, max(self.reach), self.reach)
        self.owned_start, self.owned_shape = self.nodes.owned_start, self.nodes.owned_shape
        self.local_nodes, self.layout = self.nodes.local_nodes, self.nodes.layout
        self.local_cells = int(np.prod(self.owned_shape))
        self.reductions = 0
        self.node_count = int(np.prod(self.cells))
        self.padded_shape = self.owned_shape + (1,) * (3 - self.dim)

    def _agree(self, cells: Sequence[int], length: Sequence[float], basis: str) -> tuple[Cells, Lengths]:
        """Return cells and lengths, checked and the same on all ranks. Collective."""

        def check() -> tuple[Cells, Lengths]:
            choice("basis", basis, list(BASES))
            return checked_box(cells, length)

        def say(box: tuple[Cells, Lengths]) -> Said:
            words = f"cells {box[0]}, length {box[1]} and the {basis} basis"
            return Said((*box[0], *box[1], list(BASES).index(basis)), lambda: words)

        return together(self.comm, "Grid", check, say)[0]

    def _divide(self) -> list[npt.NDArray[np.int64]]:
        """First node of every block, per axis, as a DMDA divides the cells."""
        da = PETSc.DMDA().create(
            dim=self.dim, sizes=self.cells, proc_sizes=self.blocks, dof=1, stencil_width=0, comm=self.comm
        )
        starts = [np.cumsum([0, *sizes[:-1]], dtype=np.int64) for sizes in da.getOwnershipRanges()]
        da.destroy()
        return starts

    def zeros(self, columns: int) -> FloatArray:
        """Return a nodal array of zeros, shape (local_nodes, columns). Local."""
        return np.zeros((self.local_nodes, columns))

    def owned(self, nodal: Nodes) -> Nodes:
        """Return a view of a nodal array's own nodes, owned_shape + (*shape,), axes in x, y, z order. Local."""
        block = self.nodes.own(nodal_array("nodal", nodal, self.local_nodes, self.owned_shape, in_place=False))
        axes = tuple(reversed(range(self.dim))) + tuple(range(self.dim, block.ndim))
        return block.transpose(axes)

    def sum_halo(self, nodal: FloatArray) -> None:
        """Add what ghost nodes hold into their owners, in place; ghosts keep their own share.

        `nodal` : (local_nodes, *shape), float64, C-contiguous, the same shape on all ranks; refused on all together.
        Collective; one message to each neighbouring rank, and a reduction to agree.
        """
        self._agree_in_place("Grid.sum_halo", nodal)
        self.nodes.add(nodal)

    def fill_halo(self, nodal: FloatArray) -> None:
        """Copy the owners' values to their ghosts, in place; arguments and costs as for `sum_halo`. Collective."""
        self._agree_in_place("Grid.fill_halo", nodal)
        self.nodes.fill(nodal)

    def _agree_in_place(self, verb: str, nodal: FloatArray) -> None:
        nodes, own = self.local_nodes, self.owned_shape
        values_together(self.comm, verb, lambda: nodal_array("nodal", nodal, nodes, own, in_place=True))

    def reduce(self, numbers: FloatArray, op: MPI.Op = MPI.SUM) -> FloatArray:
        """Combine numbers of all ranks, in place, and count it. Collective."""
        self.reductions += 1
        self.comm.Allreduce(MPI.IN_PLACE, numbers, op=op)
        return numbers

    def size_of(self, numbers: FloatArray) -> float:
        """Return a power of two near the largest of these on all ranks; 1 for zeros, infinity where one is not finite.

        What is divided by it rounds nothing, and neither over- nor underflows in products. Collective; one reduction.
        """
        return float(self.sizes_of(numbers.reshape(1, -1))[0])

    def sizes_of(self, rows: FloatArray) -> FloatArray:
        """`size_of` for each of several rows (k, n), in one reduction: (k,)."""
        largest = np.maximum(rows.max(axis=1, initial=0.0), -rows.min(axis=1, initial=0.0))
        # what MAX makes of a NaN differs between MPIs: infinity stands in for it
        largest = self.reduce(np.where(np.isfinite(largest), largest, np.inf), MPI.MAX)
        with np.errstate(divide="ignore"):
            return np.where(
                (largest > 0.0) & (largest < np.inf),
                np.ldexp(1.0, np.frexp(largest)[1] - 1),
                largest + (largest == 0.0),
            )

    def cell_of(self, coordinate: FloatArray) -> npt.NDArray[np.int64]:
        """Return the global cell (n, d) of coordinates (n, d), by the arithmetic of the compiled loops. Local."""
        given = positions("coordinate", coordinate, self.dim)
        with np.errstate(invalid="ignore"):  # what is not finite is in no cell
            return np.asarray((given + np.array(self.tolerance)).astype(np.int64))

    def owner_of(self, coordinate: FloatArray) -> npt.NDArray[np.int64]:
        """Return the rank (n,) that owns the cell of each coordinate (n, d), in cells, as `coordinate_of` gives them.

        Raises ValueError naming the first that is not in the box. Local.
        """
        cell = self.cell_of(coordinate)
        with np.errstate(invalid="ignore"):
            below = ~(np.reshape(coordinate, cell.shape) >= -np.array(self.tolerance))
        outside = below | (cell < 0) | (cell >= np.array(self.cells))
        if outside.any():
            first = int(np.argmax(outside.any(axis=1)))
            at = np.asarray(coordinate)[first].tolist()
            raise ValueError(f"coordinate {first} = {at}, in cells, is not in the box of {self.cells} cells")
        owner = np.zeros(len(cell), dtype=np.int64)
        stride = 1
        for axis, starts in enumerate(self.starts):
            owner += stride * (np.searchsorted(starts, cell[:, axis], side="right") - 1)
            stride *= len(starts)
        return owner

    def coordinate_of(self, position: FloatArray) -> FloatArray:
        """Return coordinates (n, d) in cells, in the box, of positions (n, d) in length, any number of periods off.

        Positions count as those that `in_box` makes of them, or are refused by it. Local.
        """
        return self.wrapped(self.in_box(position) / np.array(self.h))

    def in_box(self, position: FloatArray) -> FloatArray:
        """Return positions (n, d) in the box, 0 <= x < length, by the rule of `mpipic.box`: axes wrap.

        Raises ValueError naming the first that is not finite, or so far away that its digits do not tell its cell.
        Local; O(n); copied only where needed.
        """
        given = positions("position", position, self.dim)
        if is_inside(given, self.length):
            return given
        problem = first_misplaced("position", given, self.h)
        if problem:
            raise ValueError(problem)
        return wrap(given, self.length)

    def wrapped(self, coordinate: FloatArray) -> FloatArray:
        """Return coordinates (n, d) in the box and on its quantum: -tolerance <= x < cells - tolerance. Local.

        A particle that counts as on the upper face is on node 0, and has a coordinate just below 0.
        """
        period = np.array(self.cells, dtype=np.float64)
        with np.errstate(invalid="ignore"):
            inside = self.rounded(np.mod(coordinate, period))
        return np.where(inside >= period - np.array(self.tolerance), inside - period, inside)

    def rounded(self, coordinate: FloatArray) -> FloatArray:
        """Return coordinates or displacements in cells, rounded to whole multiples of `quantum`. Local."""
        quantum = np.array(self.quantum)
        with np.errstate(invalid="ignore"):  # infinities become NaN, and are refused where cells are looked up
            return np.asarray(np.rint(np.asarray(coordinate) / quantum) * quantum)


def checked_box(cells: Sequence[int], length: Sequence[float]) -> tuple[Cells, Lengths]:
    """Return cells and lengths as numbers of Python.

    Raises
    ------
    ValueError, TypeError
        They are not whole numbers from 1 on and numbers above 0, one to three each; there are more cells than PETSc can
        number; or the spacing or the volume of a cell, or an inverse of these, is no number of full precision.
    """
    counts = tuple(whole_number(f"cells[{a}]", n, 1) for a, n in enumerate(axes_of("cells", cells)))
    lengths = tuple(real_number(f"length[{a}]", x, "a number above 0") for a, x in enumerate(axes_of("length", length)))
    if not 1 <= len(counts) <= 3 or len(lengths) != len(counts):
        raise ValueError(f"cells and length need one to three entries each, got {counts} and {lengths}")
    for axis, x in enumerate(lengths):
        if not 0.0 < x < math.inf:
            raise ValueError(f"length[{axis}] must be a finite number above 0, not {x}")
    total = math.prod(counts)
    if total > MOST_CELLS:
        bits = np.iinfo(PETSc.IntType).bits
        raise ValueError(f"cells {counts} are {total} nodes, and this PETSc numbers at most {MOST_CELLS} ({bits} bits)")
    h = [x / n for x, n in zip(lengths, counts, strict=True)]
    if not is_normal(*h, math.prod(h)):
        raise ValueError(f"length / cells is {h}, out of the range in which numbers have all their digits")
    return counts, lengths


def checked_grid(given: object) -> Grid:
    """Return a grid, or raise TypeError. Local: without one there are no ranks to agree with."""
    if not isinstance(given, Grid):
        raise TypeError(f"grid must be a Grid, not {told(given)}")
    return given

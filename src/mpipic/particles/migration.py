"""Particles on their way to the rank that owns their cell.

One mechanism on two graphs of ranks: all with all (any journey; used to place new particles), and for particles that
all move by the same displacement, by MPI's neighbourhood collectives, only those ranks whose blocks the displaced block
meets: at most 2^d of them however many ranks there are and however far the journey goes, on equal
blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from mpipic.arrays import FloatArray, IntArray
from mpipic.mesh.grid import Grid
from mpipic.particles.store import Particles


class LostParticles(RuntimeError):
    """The number of particles changed, or one must go where no message goes. Never expected: a bug or a bad move."""


@dataclass(frozen=True)
class Delivery:
    """Rows that came (m, k), ordered by source; own rows in the order sent; counts per destination and per source."""

    rows: FloatArray
    order: IntArray
    outgoing: IntArray
    incoming: IntArray


class Routes:
    """Which ranks this rank sends to and receives from.

    Parameters
    ----------
    grid
        The blocks.
    displacement : d floats, in cells, optional
        What every particle may be moved by; without it the graph joins all ranks with all.

    Notes
    -----
    Collective.
    """

    def __init__(self, grid: Grid, displacement: Sequence[float] | None = None) -> None:
        self.grid = grid
        self.comm: Any = MPI.Intracomm(grid.comm)
        self.everywhere = displacement is None
        if displacement is None:
            self.destinations = self.sources = list(range(grid.size))
        else:
            self.destinations = _ranks_met(grid, displacement, +1)
            self.sources = _ranks_met(grid, displacement, -1)
            self.comm = self.comm.Create_dist_graph_adjacent(self.sources, self.destinations)
        self._slot = np.full(grid.size, -1)
        self._slot[self.destinations] = np.arange(len(self.destinations))

    def exchange(self, rows: FloatArray, owner: IntArray) -> Delivery:
        """Send each row (n, k) to the rank that `owner` (n,) names.

        Collective on neighbours: one count and one block of rows to each destination. Raises LostParticles if an
        owner is not among the destinations.
        """
        slot = self._slot[owner]
        if slot.size and slot.min() < 0:
            stray = int(owner[np.argmin(slot)])
            raise LostParticles(f"rank {self.grid.rank} must send a particle to rank {stray}, which it has no route to")
        order = np.argsort(slot, kind="stable")
        outgoing = np.bincount(slot, minlength=len(self.destinations)).astype(np.int64)
        incoming = np.empty(len(self.sources), dtype=np.int64)
        (self.comm.Alltoall if self.everywhere else self.comm.Neighbor_alltoall)(outgoing, incoming)
        return Delivery(self._send(rows[order], outgoing, incoming), order, outgoing, incoming)

    def give_back(self, rows: FloatArray, delivery: Delivery) -> FloatArray:
        """Rows (m, k), one for each row that `delivery` brought, returned to where those came from, in their order.

        Only on the graph of all ranks. Collective.
        """
        returned = self._send(rows, delivery.incoming, delivery.outgoing)
        ordered = np.empty_like(returned)
        ordered[delivery.order] = returned
        return ordered

    def _send(self, rows: FloatArray, outgoing: IntArray, incoming: IntArray) -> FloatArray:
        rows = np.ascontiguousarray(rows)
        received = np.empty((int(incoming.sum()), rows.shape[1]))
        item = MPI.DOUBLE.Create_contiguous(rows.shape[1]).Commit()
        send = self.comm.Alltoallv if self.everywhere else self.comm.Neighbor_alltoallv
        try:
            send([rows, outgoing.astype(np.intc), item], [received, incoming.astype(np.intc), item])
        finally:
            item.Free()
        return received

    def free(self) -> None:
        """Give back to MPI the communicator that a displacement has of its own. Collective."""
        if not self.everywhere:
            self.comm.Free()


def can_leave(grid: Grid, displacement: Sequence[float]) -> bool:
    """Whether particles that move by so many cells can leave any rank's block at all. Local, the same everywhere."""
    return any(not np.array_equal(meets, np.eye(len(meets))) for meets in _meetings(grid, displacement))


def _meetings(grid: Grid, displacement: Sequence[float]) -> list[npt.NDArray[np.bool_]]:
    """For each axis the matrix [i, j]: block i, moved, overlaps block j."""
    axes = zip(grid.starts, grid.cells, displacement, strict=True)
    return [_blocks_met(starts, cells, moved) for starts, cells, moved in axes]


def _ranks_met(grid: Grid, displacement: Sequence[float], sign: int) -> list[int]:
    """Ranks whose cells this rank's cells meet when moved forward (+1), or that meet them when moved so (-1)."""
    place = np.unravel_index(grid.rank, grid.blocks[::-1])[::-1]
    meetings = zip(place, _meetings(grid, displacement), strict=True)
    per_axis = [np.flatnonzero(meets[own] if sign > 0 else meets[:, own]) for own, meets in meetings]
    places = product(*per_axis[::-1])
    return sorted(int(np.ravel_multi_index(q, grid.blocks[::-1])) for q in places)


def _blocks_met(starts: IntArray, cells: int, cells_moved: float) -> npt.NDArray[np.bool_]:
    """Matrix [i, j]: block i of an axis, moved by so many cells around the period, overlaps block j.

    Exact, as the motion is: a particle of the cells from s to e lands in the cells floor(s + moved) to
    ceil(e + moved) - 1.
    """
    ends = np.append(starts[1:], cells)
    lowest = np.floor(starts + cells_moved).astype(np.int64)[:, None]
    spanned = np.ceil(ends + cells_moved).astype(np.int64)[:, None] - 1 - lowest
    starts_inside = np.mod(starts[None, :] - lowest, cells) <= spanned
    holds_lowest = np.mod(lowest - starts[None, :], cells) < (ends - starts)[None, :]
    return starts_inside | holds_lowest


def migrate(particles: Particles, routes: Routes, leaving: IntArray) -> int:
    """Send the particles at the sorted local indices `leaving` to their owners and append those that arrive.

    Returns how many arrived; they are the last ones. Raises LostParticles if a particle arrives at the wrong rank or
    the local count does not add up. Collective on neighbours; O(number that leave and arrive).
    """
    grid, before = routes.grid, particles.count
    coordinate, state, ids = particles.take(leaving)
    rows = np.concatenate([coordinate, state, ids.view(np.float64)[:, None]], axis=1)
    delivery = routes.exchange(rows, grid.owner_of(coordinate))
    arrived = delivery.rows
    dim = particles.dim
    if np.any(grid.owner_of(arrived[:, :dim]) != grid.rank):
        raise LostParticles(f"rank {grid.rank} was sent particles that are not in its cells")
    particles.append(arrived[:, :dim], arrived[:, dim:-1], np.ascontiguousarray(arrived[:, -1]).view(np.int64))
    if particles.count != before - len(leaving) + int(delivery.incoming.sum()):
        raise LostParticles(f"rank {grid.rank} has {particles.count} particles, not those it had, less sent, plus come")
    return len(arrived)

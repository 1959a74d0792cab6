"""Particles on their way to the rank that owns their cell.

One mechanism on two graphs of ranks: all with all (any journey; used to place new particles), and for particles that
move by a known reach, by MPI's neighbourhood collectives, only those ranks whose blocks the displaced block meets.
Where all particles move alike these are at most 2^d however many ranks there are and however far the journey goes, on
equal blocks; where each moves by up to a cell, the 3^d - 1 ranks around.
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

    rows: npt.NDArray[Any]
    order: IntArray
    outgoing: IntArray
    incoming: IntArray


@dataclass(frozen=True)
class Reach:
    """Least and greatest displacement per axis, in cells: how far particles may be moved."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    @classmethod
    def of_one(cls, displacement: Sequence[float]) -> Reach:
        """Return the reach of particles that all move by the same displacement."""
        return cls(tuple(displacement), tuple(displacement))

    def covers(self, other: Reach) -> bool:
        """Return whether every displacement of the other is one of these."""
        return all(a <= b for a, b in zip(self.low, other.low)) and all(a >= b for a, b in zip(self.high, other.high))

    def joined(self, other: Reach) -> Reach:
        """Return the least reach that covers both."""
        return Reach(tuple(map(min, self.low, other.low)), tuple(map(max, self.high, other.high)))


class Routes:
    """Which ranks this rank sends to and receives from.

    Parameters
    ----------
    grid
        The blocks.
    reach : Reach, in cells, optional
        What particles may be moved by; without it the graph joins all ranks with all.

    Notes
    -----
    Collective.
    """

    def __init__(self, grid: Grid, reach: Reach | None = None) -> None:
        self.grid = grid
        self.comm: Any = MPI.Intracomm(grid.comm)  # mpi4py's hints know no neighbourhood collectives here
        self.everywhere = reach is None
        if reach is None:
            self.destinations = self.sources = list(range(grid.size))
        else:
            self.destinations = _ranks_met(grid, reach, +1)
            self.sources = _ranks_met(grid, reach, -1)
            self.comm = self.comm.Create_dist_graph_adjacent(self.sources, self.destinations)
        self._slot = np.full(grid.size, -1)
        self._slot[self.destinations] = np.arange(len(self.destinations))

    def exchange(self, rows: npt.NDArray[Any], owner: IntArray) -> Delivery:
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

    def give_back(self, rows: npt.NDArray[Any], delivery: Delivery) -> npt.NDArray[Any]:
        """Rows (m, k), one for each row that `delivery` brought, returned to where those came from, in their order.

        Only on the graph of all ranks. Collective.
        """
        returned = self._send(rows, delivery.incoming, delivery.outgoing)
        ordered = np.empty_like(returned)
        ordered[delivery.order] = returned
        return ordered

    def _send(self, rows: npt.NDArray[Any], outgoing: IntArray, incoming: IntArray) -> npt.NDArray[Any]:
        """Return the rows (m, k) that come, in the type of those sent, bit for bit."""
        rows = np.ascontiguousarray(rows)
        received = np.empty((int(incoming.sum()), rows.shape[1]), rows.dtype)
        if not rows.shape[1]:
            return received
        item = MPI.BYTE.Create_contiguous(rows.shape[1] * rows.itemsize).Commit()
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


def can_leave(grid: Grid, reach: Reach) -> bool:
    """Return whether particles with this reach can leave any rank's block at all. Local, the same everywhere."""
    return any(not np.array_equal(meets, np.eye(len(meets))) for meets in _meetings(grid, reach))


def _meetings(grid: Grid, reach: Reach) -> list[npt.NDArray[np.bool_]]:
    """For each axis the matrix [i, j]: block i, moved, overlaps block j."""
    axes = zip(grid.starts, grid.cells, reach.low, reach.high, strict=True)
    return [_blocks_met(starts, cells, low, high) for starts, cells, low, high in axes]


def _ranks_met(grid: Grid, reach: Reach, sign: int) -> list[int]:
    """Return ranks whose cells this rank's cells meet when moved forward (+1), or that meet them when moved so (-1)."""
    place = np.unravel_index(grid.rank, grid.blocks[::-1])[::-1]
    meetings = zip(place, _meetings(grid, reach), strict=True)
    per_axis = [np.flatnonzero(meets[own] if sign > 0 else meets[:, own]) for own, meets in meetings]
    places = product(*per_axis[::-1])
    return sorted(int(np.ravel_multi_index(q, grid.blocks[::-1])) for q in places)


def _blocks_met(starts: IntArray, cells: int, low: float, high: float) -> npt.NDArray[np.bool_]:
    """Return the matrix [i, j]: block i of an axis, moved by low to high cells around the period, overlaps block j.

    Exact, as the motion is: a particle of the cells from s to e lands in the cells floor(s + low) to
    ceil(e + high) - 1.
    """
    ends = np.append(starts[1:], cells)
    lowest = np.floor(starts + low).astype(np.int64)[:, None]
    spanned = np.ceil(ends + high).astype(np.int64)[:, None] - 1 - lowest
    starts_inside = np.mod(starts[None, :] - lowest, cells) <= spanned
    holds_lowest = np.mod(lowest - starts[None, :], cells) < (ends - starts)[None, :]
    return np.asarray(starts_inside | holds_lowest)


def migrate(particles: Particles, routes: Routes, leaving: IntArray) -> int:
    """Send the particles at the sorted local indices `leaving` to their owners and append those that arrive.

    Returns how many arrived; they are the last ones. Raises LostParticles if a particle arrives at the wrong rank or
    the local count does not add up. Collective on neighbours; O(number that leave and arrive).
    """
    grid, before = routes.grid, particles.count
    coordinate, state, ids = particles.take(leaving)
    rows = packed(coordinate, state, ids)
    delivery = routes.exchange(rows, grid.owner_of(coordinate))
    coordinate, state, ids = unpacked(delivery.rows, particles.dim)
    if np.any(grid.owner_of(coordinate) != grid.rank):
        raise LostParticles(f"rank {grid.rank} was sent particles that are not in its cells")
    particles.append(coordinate, state, ids)
    if particles.count != before - len(leaving) + int(delivery.incoming.sum()):
        raise LostParticles(f"rank {grid.rank} has {particles.count} particles, not those it had, less sent, plus come")
    return len(ids)


def packed(coordinate: FloatArray, state: FloatArray, ids: IntArray) -> FloatArray:
    """Return particles as rows of numbers to send, (n, d + k + 1): an id travels bit for bit as a float. Local."""
    return np.concatenate([coordinate, state, ids.view(np.float64)[:, None]], axis=1)


def unpacked(rows: FloatArray, dim: int) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return coordinates (n, d), state (n, k) and ids (n,) of packed rows. Local."""
    return rows[:, :dim], rows[:, dim:-1], np.ascontiguousarray(rows[:, -1]).view(np.int64)

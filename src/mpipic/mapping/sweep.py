"""The particles of a run, mapped: sums at the nodes that are kept with the particles as they move.

Within a step the positions are fixed, so whatever a time step does between two passes over the particles it does on
nodal arrays; `advance` then gives the particles their increments, moves them, and maps them where they have come.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import ClassVar

import numpy as np

from mpipic.arrays import FloatArray, IntArray
from mpipic.kernels import generic
from mpipic.mapping.base import NodalMapping
from mpipic.mapping.gram import Gram
from mpipic.mesh.agreement import together
from mpipic.mesh.grid import Grid
from mpipic.particles import migration
from mpipic.particles.store import Particles, check_inside, locate


class ParticleSweep(NodalMapping):
    """The particles of a run, mapped: kept with them as they move.

    Holds at the present positions the sums Φᵀ of all state columns and the row sums d; `gradient_sums` and
    `divergence_sums` apply what else a step needs of the mapping. `advance` ends one position and begins the next.

    Parameters
    ----------
    grid
    particles
        State columns: one scalar, then a vector of d components. Must be in this rank's cells; sorted by cell here.
    displacement : d floats, unit of length
        What every particle moves by in `advance`; all zero: mapped once and for all.

    Attributes
    ----------
    held_sums : (local_nodes, d + 2)
        Φᵀ(scalar), Φᵀ(vector), d; right on own and ghost nodes.
    row_sums : (local_nodes,)
        The row sums d, by themselves.
    peak : float
        Largest |scalar| of this rank's particles when last touched, NaN if any is.

    Notes
    -----
    Building and `advance` are collective on neighbours; the other verbs are local on nodal arrays whose ghosts are
    filled, and leave sums whose ghosts are not: end them with `complete`.
    """

    def __init__(
        self,
        grid: Grid,
        particles: Particles,
        displacement: Sequence[float],
        phase: Callable[[str], None] = lambda name: None,
    ) -> None:
        self.grid, self.particles = grid, particles
        self.phase = phase
        in_cells = np.fmod(np.asarray(displacement) / np.array(grid.h), grid.cells)
        self.shift = shift = tuple(grid.rounded(in_cells).tolist())
        self.moving = any(shift)
        period = tuple(map(float, grid.cells))
        self.kernel_geometry = (grid.inverse_h, grid.tolerance, period, shift, grid.owned_start)
        reach = migration.Reach.of_one(shift)
        self.routes = migration.Routes(grid, reach) if migration.can_leave(grid, reach) else None
        self.gram = Gram(self)
        self.held_sums = grid.zeros(grid.dim + 2)
        self.row_sums = self.held_sums[:, -1]
        self.inverse_row_sums = np.empty(grid.local_nodes)
        self.version = 0
        self.leaving = np.empty(max(1024, particles.count // 16), dtype=np.int64)
        self.peak = 0.0
        self.migrated = 0
        self.sorts = 0
        self.allocate()
        self.remap()

    def remap(self) -> None:
        """Map the particles where and as they are, after they were changed from outside.

        Raises ValueError on all ranks together if one is not in its rank's cells. Collective; one reduction to agree.
        """
        together(self.grid.comm, "remap", lambda: check_inside(self.particles, self.grid))
        self.version += 1
        self.peak = 0.0
        self.sort()
        self.clear_sums(weigh=True)
        self.deposit(0, self.particles.count, weigh=True)
        self.finish_sums(weigh=True)

    # ------------------------------------------------------------ on nodes

    def allocate(self) -> None:
        """Make what the other verbs work with. Local."""

    @property
    def state_sums(self) -> tuple[FloatArray, FloatArray]:
        """Views of `held_sums`: Φᵀ(scalar) (local_nodes, 1) and Φᵀ(vector) (local_nodes, d)."""
        return self.held_sums[:, :1], self.held_sums[:, 1:-1]

    @property
    def count(self) -> int:
        """Particles on this rank."""
        return self.particles.count

    @property
    def located(self) -> tuple[IntArray, FloatArray]:
        """Local cell (n,) and local coordinates (n, d) of the particles. Local; O(n)."""
        return locate(self.grid, np.ascontiguousarray(self.particles.coordinate))

    @abstractmethod
    def gradient_sums(self, nodal: FloatArray, out: FloatArray) -> FloatArray:
        """out += ΦᵀD^a nodal: one column to d; complete it afterwards. Local."""

    @abstractmethod
    def divergence_sums(self, nodal: FloatArray, out: FloatArray) -> FloatArray:
        """out += Σ_a ΦᵀD^a nodal_a: d columns to one; complete it afterwards. Local."""

    def close(self) -> None:
        """Give the communicator of the routes back to MPI; no `advance` after this. Collective."""
        if self.routes is not None:
            self.routes.free()

    @property
    def nbytes(self) -> int:
        """Bytes of the nodal sums, of G where it is assembled, and of the list of leavers."""
        return self.gram.nbytes + sum(a.nbytes for a in (self.held_sums, self.inverse_row_sums, self.leaving))

    # ------------------------------------------------------------ on particles

    def advance(self, nodal: FloatArray, rates: tuple[float, float], direct: bool = False) -> None:
        """Add to every particle an increment from its nodes, move it, migrate it, and map the new state.

        Parameters
        ----------
        nodal : (local_nodes, 1 + d), ghosts filled
        rates : factors of the scalar's and of the vector's increment
            The scalar gets rates[0] Φ nodal[:, 0], the vector rates[1] Φ nodal[:, 1:]; or, if `direct`, the scalar
            rates[0] Σ_a D^a nodal[:, a], the vector rates[1] D nodal[:, 0].

        Notes
        -----
        Collective on neighbours: one message for the halo each way, and with several ranks a count and a block of
        particles to at most 2^d ranks.
        """
        particles, weigh = self.particles, self.moving
        self.phase("particles")
        self.clear_sums(weigh)
        breaks, left = self.update_and_move(nodal, rates, direct, weigh)
        arrived = 0
        if self.routes is not None:
            self.phase("migrate")
            arrived = migration.migrate(particles, self.routes, self._leavers(left))
            self.migrated += arrived
            self.phase("particles")
        self.deposit(particles.count - arrived if self.one_pass else 0, particles.count, weigh)
        self.finish_sums(weigh)
        if weigh:
            self.version += 1
            self.sort_when_due(breaks)
        self.phase("other")

    def _leavers(self, left: int) -> IntArray:
        if left <= len(self.leaving):
            return self.leaving[:left].copy()
        self.leaving = np.empty(left + left // 4, dtype=np.int64)
        return np.flatnonzero(self.grid.owner_of(self.particles.coordinate) != self.grid.rank)

    one_pass: ClassVar[bool]
    """Whether `update_and_move` also sums the particles that stay."""

    def clear_sums(self, weigh: bool) -> None:
        """Set the sums to zero before a pass; the row sums too if `weigh`. Local."""
        if weigh:
            self.held_sums.fill(0.0)
        else:
            self.held_sums[:, :-1] = 0.0

    @abstractmethod
    def update_and_move(
        self, nodal: FloatArray, rates: tuple[float, float], direct: bool, weigh: bool
    ) -> tuple[int, int]:
        """Add the increments, move, list the leavers. Local.

        Returns how many particles lie in another cell than their predecessor, and how many left.
        """

    @abstractmethod
    def deposit(self, start: int, stop: int, weigh: bool) -> None:
        """Add the particles from `start` to `stop` to the sums, and look at their |scalar|. Local."""

    def finish_sums(self, weigh: bool) -> None:
        """Make the sums right on own and ghost nodes; the row sums too if `weigh`. Collective on neighbours."""
        if weigh:
            self.complete(self.held_sums)
            generic.invert(self.row_sums, self.inverse_row_sums)
        else:
            # the row sums are complete already, on ghosts too: summing the halo again would count them twice
            state = np.ascontiguousarray(self.held_sums[:, :-1])
            self.held_sums[:, :-1] = self.complete(state)

    # ------------------------------------------------------------ order in memory

    def sort(self) -> None:
        """Put the particles in the order of their cells. Local; O(n)."""
        self.phase("sort")
        self.particles.sort_by_cell(self.grid)
        self.sorts += 1
        self._excess, self._fewest_breaks = 0, -1

    def sort_when_due(self, breaks: int) -> None:
        """Sort once disorder has cost as much as sorting does.

        Disorder is counted in breaks, particles in another cell than their predecessor: each costs about a tenth of
        what sorting costs a particle. A count, not a clock, decides, so that runs repeat to the bit.
        """
        if self._fewest_breaks < 0:
            self._fewest_breaks = breaks
        self._excess += max(0, breaks - self._fewest_breaks)
        if self._excess > 12 * self.particles.count:
            self.sort()

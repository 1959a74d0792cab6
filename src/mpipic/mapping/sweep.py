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
from mpipic.kernels import BY_DIMENSION, blocks, generic, spline
from mpipic.mapping.mapping import NodalMapping
from mpipic.mesh.grid import Grid
from mpipic.particles import migration
from mpipic.particles.store import Particles, locate


class ParticleSweep(NodalMapping):
    """The particles of a run, mapped: kept with them as they move.

    Holds at the present positions the sums Φᵀ of all state columns and the row sums d; `gram`, `gradient_sums` and
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
    sums : (local_nodes, d + 2)
        Φᵀ(scalar), Φᵀ(vector), d; right on own and ghost nodes.
    weights : (local_nodes,)
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
        shift = tuple(grid.rounded(np.fmod(np.asarray(displacement) / np.array(grid.h), grid.cells)).tolist())
        self.moving = any(shift)
        period = tuple(map(float, grid.cells))
        self._geometry = (grid.inverse_h, grid.tolerance, period, shift, grid.owned_start)
        self._cells = (grid.padded_shape, grid.layout)
        self.routes = migration.Routes(grid, shift) if migration.can_leave(grid, shift) else None
        self.sums = grid.zeros(grid.dim + 2)
        self.weights = self.sums[:, -1]
        self.inverse_weights = np.empty(grid.local_nodes)
        self.version = 0
        self._leaving = np.empty(max(1024, particles.count // 16), dtype=np.int64)
        self.peak = 0.0
        self.migrated = 0
        self.sorts = 0
        self._allocate()
        self.remap()

    def remap(self) -> None:
        """Map the particles where and as they are, after they were changed from outside. Collective."""
        self.version += 1
        self.peak = 0.0
        self._sort()
        self._clear(weigh=True)
        self._deposit(0, self.particles.count, weigh=True)
        self._finish_sums(weigh=True)

    # ------------------------------------------------------------ on nodes

    def _allocate(self) -> None:
        """Make what `_clear`, `_pass` and `_deposit` work with."""

    @property
    def state_sums(self) -> tuple[FloatArray, FloatArray]:
        """Views of `sums`: Φᵀ(scalar) (local_nodes, 1) and Φᵀ(vector) (local_nodes, d)."""
        return self.sums[:, :1], self.sums[:, 1:-1]

    def divide_changed(self, sums: FloatArray, rate: float, change: FloatArray, out: FloatArray) -> FloatArray:
        """diag(d)⁻¹ (sums + rate change), one column. Local."""
        generic.scale_changed(sums, rate, change, self.inverse_weights, out)
        return out

    @property
    def located(self) -> tuple[IntArray, FloatArray]:
        """Local cell (n,) and local coordinates (n, d) of the particles. Local; O(n)."""
        return locate(self.grid, np.ascontiguousarray(self.particles.coordinate))

    @property
    def particle_weights(self) -> FloatArray:
        """Ones. Local."""
        return np.ones(self.particles.count)

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
        """Bytes of the nodal sums and the list of leavers."""
        return sum(a.nbytes for a in (self.sums, self.inverse_weights, self._leaving))

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
        self._clear(weigh)
        breaks, left = self._pass(nodal, rates, direct, weigh)
        arrived = 0
        if self.routes is not None:
            self.phase("migrate")
            arrived = migration.migrate(particles, self.routes, self._leavers(left))
            self.migrated += arrived
            self.phase("particles")
        self._deposit(particles.count - arrived if self.one_pass else 0, particles.count, weigh)
        self._finish_sums(weigh)
        if weigh:
            self.version += 1
            self._sort_when_due(breaks)
        self.phase("other")

    def _leavers(self, left: int) -> IntArray:
        if left <= len(self._leaving):
            return self._leaving[:left].copy()
        self._leaving = np.empty(left + left // 4, dtype=np.int64)
        return np.flatnonzero(self.grid.owner_of(self.particles.coordinate) != self.grid.rank)

    one_pass: ClassVar[bool]
    """Whether `_pass` also sums the particles that stay."""

    def _clear(self, weigh: bool) -> None:
        if weigh:
            self.sums.fill(0.0)
        else:
            self.sums[:, :-1] = 0.0

    @abstractmethod
    def _pass(self, nodal: FloatArray, rates: tuple[float, float], direct: bool, weigh: bool) -> tuple[int, int]:
        """Add the increments, move, list the leavers: how many particles follow one of another cell, how many left."""

    @abstractmethod
    def _deposit(self, start: int, stop: int, weigh: bool) -> None:
        """Add these particles to the sums, and look at their |scalar|."""

    def _finish_sums(self, weigh: bool) -> None:
        if weigh:
            self.complete(self.sums)
            generic.invert(self.weights, self.inverse_weights)
        else:
            # the row sums are complete already, on ghosts too: summing the halo again would count them twice
            state = np.ascontiguousarray(self.sums[:, :-1])
            self.sums[:, :-1] = self.complete(state)

    # ------------------------------------------------------------ order in memory

    def _sort(self) -> None:
        self.phase("sort")
        self.particles.sort_by_cell(self.grid)
        self.sorts += 1
        self._excess, self._fewest_breaks = 0, -1

    def _sort_when_due(self, breaks: int) -> None:
        """Sort once disorder has cost as much as sorting does.

        Disorder is counted in breaks, particles in another cell than their predecessor: each costs about a tenth of
        what sorting costs a particle. A count, not a clock, decides, so that runs repeat to the bit.
        """
        if self._fewest_breaks < 0:
            self._fewest_breaks = breaks
        self._excess += max(0, breaks - self._fewest_breaks)
        if self._excess > 12 * self.particles.count:
            self._sort()


class Sweep(ParticleSweep):
    """On the linear basis: one pass over memory a step, and pair moments of every cell for what happens between passes.

    Notes
    -----
    `advance` costs O(particles), the verbs on nodal arrays O(cells). Memory per rank: nodal arrays, 3^d numbers a cell.
    """

    one_pass = True

    def _allocate(self) -> None:
        self._kernels = BY_DIMENSION[self.grid.dim]
        self._moments = np.empty((self.grid.local_cells, 3**self.grid.dim))

    @property
    def moments(self) -> FloatArray:
        """Pair moments of own cells, (local_cells, 3^d)."""
        return self._moments

    @property
    def nbytes(self) -> int:
        """Bytes of the nodal sums, the pair moments and the list of leavers."""
        return super().nbytes + self._moments.nbytes

    def gradient_sums(self, nodal: FloatArray, out: FloatArray) -> FloatArray:
        """out += ΦᵀD^a nodal: one column to d; complete it afterwards. Local."""
        self._kernels.cross(self._moments, *self._cells, self.grid.inverse_h, nodal, out, False)
        return out

    def divergence_sums(self, nodal: FloatArray, out: FloatArray) -> FloatArray:
        """out += Σ_a ΦᵀD^a nodal_a: d columns to one; complete it afterwards. Local."""
        self._kernels.cross(self._moments, *self._cells, self.grid.inverse_h, nodal, out, True)
        return out

    def _clear(self, weigh: bool) -> None:
        super()._clear(weigh)
        if weigh:
            self._moments.fill(0.0)

    def _pass(self, nodal: FloatArray, rates: tuple[float, float], direct: bool, weigh: bool) -> tuple[int, int]:
        particles = self.particles
        self.peak, breaks, left = self._kernels.advance(
            particles.axes, particles.state, nodal, rates, self.sums, self._moments, 0, particles.count,
            self._geometry, *self._cells, direct, weigh, self.routes is not None, self._leaving,
        )  # fmt: skip
        return breaks, left

    def _deposit(self, start: int, stop: int, weigh: bool) -> None:
        if start == stop:
            return
        particles = self.particles
        peak = self._kernels.deposit(
            particles.axes, particles.state, self.sums, self._moments,
            start, stop, self._geometry, *self._cells, weigh,
        )  # fmt: skip
        self.peak = float(np.maximum(self.peak, peak))

    def _finish_sums(self, weigh: bool) -> None:
        if weigh and self.grid.dim == 3:
            self._kernels.row_sums(self._moments, *self._cells, self.sums, self.sums.shape[1] - 1)
        super()._finish_sums(weigh)


class SplineSweep(ParticleSweep):
    """On splines of any degree: a few passes over the particles a step, and two more for every gradient.

    Notes
    -----
    `gram`, `gradient_sums`, `divergence_sums` and their transposes cost two passes over the particles each. Memory per
    rank: nodal arrays, and cell and local coordinates of every particle.
    """

    one_pass = False

    @property
    def moments(self) -> None:
        """None: everything goes by way of the particles."""
        return None

    @property
    def located(self) -> tuple[IntArray, FloatArray]:
        """Local cell (n,) and local coordinates (n, d) of the particles. Local."""
        return self._cell, self._fraction

    @property
    def nbytes(self) -> int:
        """Bytes of the nodal sums, the list of leavers, and where the particles are."""
        return super().nbytes + self._cell.nbytes + self._fraction.nbytes

    @property
    def _slopes(self) -> tuple[FloatArray, tuple[int, ...], tuple[int, int, int]]:
        return (np.array(self.grid.inverse_h), *self._cells)

    def gradient_sums(self, nodal: FloatArray, out: FloatArray) -> FloatArray:
        """out += ΦᵀD^a nodal: one column to d; complete it afterwards. Local."""
        seen = np.zeros((self.particles.count, self.grid.dim))
        column = np.ascontiguousarray(nodal[:, 0])
        spline.add_gradient(self.grid.degree, *self.located, column, 1.0, *self._slopes, seen)
        spline.add_sums(self.grid.degree, *self.located, seen, *self._cells, out)
        return out

    def divergence_sums(self, nodal: FloatArray, out: FloatArray) -> FloatArray:
        """out += Σ_a ΦᵀD^a nodal_a: d columns to one; complete it afterwards. Local."""
        seen = np.zeros(self.particles.count)
        spline.add_divergence(self.grid.degree, *self.located, np.ascontiguousarray(nodal), 1.0, *self._slopes, seen)
        spline.add_sums(self.grid.degree, *self.located, seen[:, None], *self._cells, out)
        return out

    def transposed_gradient_sums(self, nodal: FloatArray, out: FloatArray) -> FloatArray:
        """out += (D^a)ᵀΦ nodal: one column to d; complete it afterwards. Local."""
        seen = np.zeros((self.particles.count, 1))
        spline.add_interpolated(
            self.grid.degree, *self.located, np.ascontiguousarray(nodal), np.ones(1), *self._cells, seen
        )
        spline.add_gradient_sums(self.grid.degree, *self.located, seen[:, 0].copy(), *self._slopes, out)
        return out

    def transposed_divergence_sums(self, nodal: FloatArray, out: FloatArray) -> FloatArray:
        """out += Σ_a (D^a)ᵀΦ nodal_a: d columns to one; complete it afterwards. Local."""
        seen = np.zeros((self.particles.count, self.grid.dim))
        spline.add_interpolated(
            self.grid.degree, *self.located, np.ascontiguousarray(nodal), np.ones(self.grid.dim), *self._cells, seen
        )
        total = np.zeros(len(out))
        spline.add_divergence_sums(self.grid.degree, *self.located, seen, *self._slopes, total)
        out[:, 0] += total
        return out

    def _pass(self, nodal: FloatArray, rates: tuple[float, float], direct: bool, weigh: bool) -> tuple[int, int]:
        particles, degree, dim = self.particles, self.grid.degree, self.grid.dim
        state = particles.state
        if direct:
            change = np.zeros(state.shape)
            vector, scalar = np.ascontiguousarray(nodal[:, 1:]), np.ascontiguousarray(nodal[:, 0])
            along, across = np.zeros(len(state)), np.zeros((len(state), dim))
            spline.add_divergence(degree, *self.located, vector, rates[0], *self._slopes, along)
            spline.add_gradient(degree, *self.located, scalar, rates[1], *self._slopes, across)
            change[:, 0], change[:, 1:] = along, across
            state += change
        else:
            each = np.array([rates[0], *[rates[1]] * dim])
            spline.add_interpolated(degree, *self.located, nodal, each, *self._cells, state)
        outside = np.zeros(particles.count, dtype=np.int32)
        for axis, shift in enumerate(self._geometry[3]):
            x, tolerance = particles.axes[axis, : particles.count], self.grid.tolerance[axis]
            if shift:
                blocks.move(x, shift, float(self.grid.cells[axis]), tolerance)
            first, size = self.grid.owned_start[axis], self.grid.owned_shape[axis]
            blocks.mark_outside(x, tolerance, np.int32(first), np.int32(size), outside)
        self.peak = 0.0
        gone = np.flatnonzero(outside)
        left = gone.size
        if left <= len(self._leaving):
            self._leaving[:left] = gone
        return int(np.count_nonzero(np.diff(self._cell))), left

    def _sort(self) -> None:
        super()._sort()
        self._locate()

    def _locate(self) -> None:
        self._cell, self._fraction = super().located

    def _deposit(self, start: int, stop: int, weigh: bool) -> None:
        particles = self.particles
        self._locate()
        rows = np.ones((particles.count, self.grid.dim + 2))
        rows[:, :-1] = particles.state
        sums = self.sums if weigh else np.zeros(self.sums.shape)
        spline.add_sums(self.grid.degree, *self.located, rows, *self._cells, sums)
        if not weigh:
            self.sums[:, :-1] += sums[:, :-1]
        self.peak = float(np.max(np.abs(rows[:, 0]), initial=0.0))


def create(
    grid: Grid,
    particles: Particles,
    displacement: Sequence[float],
    phase: Callable[[str], None] = lambda name: None,
    transposed: bool = False,
) -> Sweep | SplineSweep:
    """The sweep for the basis of the grid; `transposed`: one that has the transposed gradients too."""
    cls = Sweep if grid.degree == 1 and not transposed else SplineSweep
    return cls(grid, particles, displacement, phase)

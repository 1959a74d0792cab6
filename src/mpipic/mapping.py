"""Mapping between particles and nodes.

Symbols as in the method: Φ interpolates nodes to particles, D^a differentiates, d = Φᵀ1 are the row sums, and
S = diag(d)⁻¹ Φᵀ is the paper's mapping matrix. Both classes here answer the same questions at the particles' present
positions: `Mapping` particle by particle, for any values (the library's door); `Sweep` for the particles that a run
advances, cell by cell from pair moments and in one pass over the particles a step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from mpipic import migration
from mpipic.grid import FloatArray, Grid, columns_of, raise_together
from mpipic.kernels import BY_DIMENSION, generic, spline, stencil
from mpipic.particles import IntArray, Particles, locate


class NodalMapping:
    """What filters and solvers need of a mapping: the operators that S Φ is made of, on nodal arrays.

    On the linear basis G follows from the pair moments of every cell (see `kernels.cells`), on the others from passes
    over the particles.

    Attributes
    ----------
    weights : (local_nodes,)
        Row sums d, right on own and ghost nodes.
    inverse_weights : (local_nodes,)
        1 / d, 0 on nodes that no particle sees.
    version : int
        Counts changes of positions.
    """

    grid: Grid
    weights: FloatArray
    version: int
    inverse_weights: FloatArray
    phase: Callable[[str], None]

    @property
    def moments(self) -> FloatArray:
        """Pair moments of own cells, (local_cells, 3^d)."""
        raise NotImplementedError

    def divide(self, sums: FloatArray, out: FloatArray | None = None) -> FloatArray:
        """Nodal means from nodal sums: diag(d)⁻¹ sums, 0 on nodes that no particle sees. Local."""
        self.phase("nodes")
        result = np.empty(sums.shape) if out is None else out
        if sums.ndim == 1:
            generic.scale_rows(sums[:, None], self.inverse_weights, result[:, None])
        else:
            generic.scale_rows(sums, self.inverse_weights, result)
        return result

    @property
    def located(self) -> tuple[IntArray, FloatArray]:
        """Local cell (n,) and local coordinates (n, d) of the particles. Local."""
        raise NotImplementedError

    @property
    def particle_weights(self) -> FloatArray:
        """What each particle counts, (n,). Local."""
        raise NotImplementedError

    def gram(self, nodal: FloatArray, out: FloatArray) -> FloatArray:
        """out += G nodal, one column; complete it afterwards. Local."""
        grid = self.grid
        if grid.degree == 1:
            BY_DIMENSION[grid.dim].gram(self.moments, grid.padded_shape, grid.layout, nodal, out)
            return out
        where = (*self.located,)
        seen = np.zeros((len(where[0]), 1))
        geometry = (grid.padded_shape, grid.layout)
        spline.add_interpolated(grid.degree, *where, np.ascontiguousarray(nodal), np.ones(1), *geometry, seen)
        seen *= self.particle_weights[:, None]
        spline.add_sums(grid.degree, *where, seen, *geometry, out)
        return out

    def apply_gram(self, nodal: FloatArray) -> FloatArray:
        """G nodal, column by column, right on own and ghost nodes; ghosts of `nodal` filled.

        Collective; one halo sum, one fill.
        """
        out = np.zeros(nodal.shape)
        wide, result = nodal.reshape(len(nodal), -1), out.reshape(len(nodal), -1)
        for column in range(wide.shape[1]):
            self.gram(wide[:, column : column + 1], result[:, column : column + 1])
        return self.complete(out)

    def add_gram_entries(self, layout: tuple[int, int, int], entries: FloatArray) -> None:
        """entries += half of G's diagonals in a padding of `layout` (see `kernels.stencil`).

        Local; ghosts still hold what belongs to their owners.
        """
        dim, degree, shape = self.grid.dim, self.grid.degree, self.grid.padded_shape
        if degree == 1:
            stencil.add_moments(self.moments, stencil.moment_terms(dim), shape, layout, entries)
        else:
            offsets = stencil.half_stencil(dim, degree)
            spline.add_gram_entries(degree, *self.located, self.particle_weights, offsets, shape, layout, entries)

    def complete(self, sums: FloatArray) -> FloatArray:
        """Nodal sums made right on own and ghost nodes: one halo sum, one fill. Collective on neighbours."""
        self.phase("halo")
        self.grid.sum_halo(sums)
        self.grid.fill_halo(sums)
        self.phase("nodes")
        return sums


class Mapping(NodalMapping):
    """Φ, D and S at given positions, applied to any particle values.

    Parameters
    ----------
    grid
        The node grid.
    position : (n, d)
        Positions in this rank's cells, in the unit of `grid.length`. `mpipic.Placement` brings particles there.
    weight : (n,), optional
        What each particle counts, V_p > 0, a mass or a volume in any unit: the inner product is then Σ_p V_p q_p r_p,
        S = diag(d)⁻¹ Φᵀ V, d = Φᵀ V 1, G = Φᵀ V Φ, and filters keep Σ_p V_p q_p. Default: each counts 1.

    Raises
    ------
    ValueError
        A position is not in its rank's cells, or a weight is not a finite number above 0; names the first. Raised on
        all ranks together.

    Notes
    -----
    Collective, as are `p2g` and `sums`; `g2p`, `gradient` and `divergence` are local. Each costs one pass over the
    particles, and halo exchanges as stated. Nodal arrays are ghosted (see `mpipic.grid`).

    References
    ----------
    Gritton, Berzins, Kirby (2015), eq. 8-13.
    """

    def __init__(self, grid: Grid, position: FloatArray, weight: FloatArray | None = None) -> None:
        self._begin(grid)
        self.update(position, weight)

    @classmethod
    def at(cls, grid: Grid, particles: Particles) -> Mapping:
        """The mapping where these particles are, none weighted. Collective."""
        mapping = cls.__new__(cls)
        mapping._begin(grid)
        mapping.follow(particles)
        return mapping

    def _begin(self, grid: Grid) -> None:
        self.grid = grid
        self.version = 0
        self.phase = lambda name: None
        self._degree = grid.degree
        self._geometry = (grid.padded_shape, grid.layout)
        self._inverse_h = np.array(grid.inverse_h)

    def update(self, position: FloatArray, weight: FloatArray | None = None) -> None:
        """Move the mapping to new positions, with these weights. Collective; one pass, one sum and fill of the halo."""
        self._place(self.grid.coordinate_of(columns_of(position)), weight)

    def follow(self, particles: Particles) -> None:
        """Move the mapping to where these particles are, none weighted. Collective, as `update`."""
        self._place(np.ascontiguousarray(particles.coordinate), None)

    def _place(self, coordinate: FloatArray, weight: FloatArray | None) -> None:
        problem = None
        try:
            self._cell, self._fraction = locate(self.grid, coordinate)
            self.weight = _checked(weight, len(self._cell))
        except ValueError as error:
            problem = str(error)
        raise_together(self.grid.comm, problem)
        self.version += 1
        self._moments: FloatArray | None = None
        self.weights = self.sums(np.ones(len(self._cell)))
        self.inverse_weights = np.empty_like(self.weights)
        generic.invert(self.weights, self.inverse_weights)

    @property
    def moments(self) -> FloatArray:
        """Pair moments of own cells, (local_cells, 3^d); one pass over the particles when first asked for."""
        if self._moments is None:
            self._moments = np.zeros((self.grid.local_cells, 3**self.grid.dim))
            generic.add_moments(self._cell, self._fraction, self.particle_weights, self._moments)
        return self._moments

    @property
    def count(self) -> int:
        """Particles on this rank."""
        return len(self._cell)

    @property
    def nbytes(self) -> int:
        """Bytes of what is kept for each particle, cell and node."""
        arrays = (self._cell, self._fraction, self.weights, self.inverse_weights, self._moments, self.weight)
        return sum(a.nbytes for a in arrays if a is not None)

    @property
    def located(self) -> tuple[IntArray, FloatArray]:
        """Local cell (n,) and local coordinates (n, d) of the particles. Local."""
        return self._cell, self._fraction

    @property
    def particle_weights(self) -> FloatArray:
        """What each particle counts, (n,). Local."""
        return np.ones(len(self._cell)) if self.weight is None else self.weight

    def sums(self, values: FloatArray) -> FloatArray:
        """Φᵀ values, or Φᵀ V values: (n,) or (n, k) to (local_nodes,) or (local_nodes, k).

        Σ over own nodes of all ranks = Σ over particles. Collective; one halo sum, one fill.
        """
        rows = columns_of(values)
        if self.weight is not None:
            rows = rows * self.weight[:, None]
        out = self.grid.zeros(rows.shape[1])
        spline.add_sums(self._degree, self._cell, self._fraction, rows, *self._geometry, out)
        return self.complete(out).reshape((-1, *np.shape(values)[1:]))

    def p2g(self, values: FloatArray) -> FloatArray:
        """S values: weighted means at the nodes, (n, ...) to (local_nodes, ...). Keeps constants. Collective."""
        return self.divide(self.sums(values))

    def g2p(self, nodal: FloatArray) -> FloatArray:
        """Φ nodal: spline values, (local_nodes, ...) to (n, ...). Keeps constants and linear functions. Local."""
        rows = columns_of(nodal)
        out = np.zeros((len(self._cell), rows.shape[1]))
        rate = np.ones(rows.shape[1])
        spline.add_interpolated(self._degree, self._cell, self._fraction, rows, rate, *self._geometry, out)
        return out.reshape((-1, *np.shape(nodal)[1:]))

    def gradient(self, nodal: FloatArray) -> FloatArray:
        """D^a nodal: (local_nodes,) to (n, d); on a node, the slope of the cell to its right. Local."""
        out = np.zeros_like(self._fraction)
        where = (self._degree, self._cell, self._fraction)
        spline.add_gradient(*where, nodal.reshape(-1), 1.0, self._inverse_h, *self._geometry, out)
        return out

    def divergence(self, nodal: FloatArray) -> FloatArray:
        """Σ_a D^a nodal_a: (local_nodes, d) to (n,). Local."""
        out = np.zeros(len(self._cell))
        where = (self._degree, self._cell, self._fraction)
        spline.add_divergence(*where, columns_of(nodal), 1.0, self._inverse_h, *self._geometry, out)
        return out


class Sweep(NodalMapping):
    """The particles of a run, mapped: kept with them as they move, one pass over memory a step.

    Holds at the present positions the sums Φᵀ of all state columns, the row sums d, and the pair moments of every
    cell, from which `gram`, `gradient_sums` and `divergence_sums` follow without touching particles. `advance` ends
    one position and begins the next.

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
    filled, and leave sums whose ghosts are not: end them with `complete`. `advance` costs O(particles), the others
    O(cells).
    Memory per rank: nodal arrays, 3^d numbers a cell.
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
        self._kernels = BY_DIMENSION[grid.dim]
        shift = tuple(grid.rounded(np.fmod(np.asarray(displacement) / np.array(grid.h), grid.cells)).tolist())
        self.moving = any(shift)
        period = tuple(map(float, grid.cells))
        self._geometry = (grid.inverse_h, grid.tolerance, period, shift, grid.owned_start)
        self._cells = (grid.padded_shape, grid.layout)
        self.routes = migration.Routes(grid, shift) if migration.can_leave(grid, shift) else None
        self.sums = grid.zeros(grid.dim + 2)
        self.weights = self.sums[:, -1]
        self.inverse_weights = np.empty(grid.local_nodes)
        self._moments = np.empty((grid.local_cells, 3**grid.dim))
        self.version = 0
        self._leaving = np.empty(max(1024, particles.count // 16), dtype=np.int64)
        self.peak = 0.0
        self.migrated = 0
        self.sorts = 0
        self._sort()
        self._clear(weigh=True)
        self._deposit(0, particles.count, weigh=True)
        self._finish_sums(weigh=True)

    # ------------------------------------------------------------ on nodes

    @property
    def moments(self) -> FloatArray:
        """Pair moments of own cells, (local_cells, 3^d)."""
        return self._moments

    @property
    def state_sums(self) -> tuple[FloatArray, FloatArray]:
        """Views of `sums`: Φᵀ(scalar) (local_nodes, 1) and Φᵀ(vector) (local_nodes, d)."""
        return self.sums[:, :1], self.sums[:, 1:-1]

    def divide_changed(self, sums: FloatArray, rate: float, change: FloatArray, out: FloatArray) -> FloatArray:
        """diag(d)⁻¹ (sums + rate change), one column. Local."""
        generic.scale_changed(sums, rate, change, self.inverse_weights, out)
        return out

    def gradient_sums(self, nodal: FloatArray, out: FloatArray) -> FloatArray:
        """out += ΦᵀD^a nodal: one column to d; complete it afterwards. Local."""
        self._kernels.cross(self._moments, *self._cells, self.grid.inverse_h, nodal, out, False)
        return out

    def divergence_sums(self, nodal: FloatArray, out: FloatArray) -> FloatArray:
        """out += Σ_a ΦᵀD^a nodal_a: d columns to one; complete it afterwards. Local."""
        self._kernels.cross(self._moments, *self._cells, self.grid.inverse_h, nodal, out, True)
        return out

    def close(self) -> None:
        """Give the communicator of the routes back to MPI; no `advance` after this. Collective."""
        if self.routes is not None:
            self.routes.free()

    @property
    def nbytes(self) -> int:
        """Bytes of the nodal sums, the pair moments and the list of leavers."""
        return sum(a.nbytes for a in (self.sums, self.inverse_weights, self._moments, self._leaving))

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
        self.peak, breaks, left = self._kernels.advance(
            particles.axes, particles.state, nodal, rates, self.sums, self._moments, 0, particles.count,
            self._geometry, *self._cells, direct, weigh, self.routes is not None, self._leaving,
        )  # fmt: skip
        if self.routes is not None:
            self.phase("migrate")
            arrived = migration.migrate(particles, self.routes, self._leavers(left))
            self.migrated += arrived
            self.phase("particles")
            self._deposit(particles.count - arrived, particles.count, weigh)
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

    def _clear(self, weigh: bool) -> None:
        if weigh:
            self.sums.fill(0.0)
            self._moments.fill(0.0)
        else:
            self.sums[:, :-1] = 0.0

    def _deposit(self, start: int, stop: int, weigh: bool) -> None:
        particles = self.particles
        peak = self._kernels.deposit(
            particles.axes, particles.state, self.sums, self._moments,
            start, stop, self._geometry, *self._cells, weigh,
        )  # fmt: skip
        self.peak = float(np.maximum(self.peak, peak))

    def _finish_sums(self, weigh: bool) -> None:
        if weigh and self.grid.dim == 3:
            self._kernels.row_sums(self._moments, *self._cells, self.sums, self.sums.shape[1] - 1)
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


def _checked(weight: FloatArray | None, count: int) -> FloatArray | None:
    """The weights as (count,), or ValueError that names the first that is not a finite number above 0."""
    if weight is None:
        return None
    weight = np.array(weight, dtype=np.float64)
    if weight.shape != (count,):
        raise ValueError(f"weight must have shape ({count},), one number a particle, not {weight.shape}")
    wrong = np.flatnonzero(~(np.isfinite(weight) & (weight > 0)))
    if wrong.size:
        raise ValueError(f"weight {wrong[0]} must be a finite number above 0, not {weight[wrong[0]]}")
    return weight

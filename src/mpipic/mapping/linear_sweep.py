"""On the linear basis: one pass over memory a step, and pair moments for what happens between passes."""

from __future__ import annotations

import numpy as np

from mpipic.arrays import FloatArray
from mpipic.kernels import BY_DIMENSION
from mpipic.mapping.sweep import ParticleSweep


class LinearSweep(ParticleSweep):
    """On the linear basis: one pass over memory a step, and pair moments of every cell for what happens between passes.

    Notes
    -----
    `advance` costs O(particles), the verbs on nodal arrays O(cells). Memory per rank: nodal arrays, 3^d numbers a cell.
    """

    one_pass = True

    def allocate(self) -> None:
        """Make what the other verbs work with. Local."""
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
        self._kernels.cross(self._moments, *self.geometry, self.grid.inverse_h, nodal, out, False)
        return out

    def divergence_sums(self, nodal: FloatArray, out: FloatArray) -> FloatArray:
        """out += Σ_a ΦᵀD^a nodal_a: d columns to one; complete it afterwards. Local."""
        self._kernels.cross(self._moments, *self.geometry, self.grid.inverse_h, nodal, out, True)
        return out

    def clear_sums(self, weigh: bool) -> None:
        """Set the sums to zero before a pass; the row sums too if `weigh`. Local."""
        super().clear_sums(weigh)
        if weigh:
            self._moments.fill(0.0)

    def update_and_move(
        self, nodal: FloatArray, rates: tuple[float, float], direct: bool, weigh: bool
    ) -> tuple[int, int]:
        """Add the increments, move, list the leavers. Local.

        Returns how many particles lie in another cell than their predecessor, and how many left.
        """
        particles = self.particles
        self.peak, breaks, left = self._kernels.advance(
            particles.axes, particles.state, nodal, rates, self.held_sums, self._moments, 0, particles.count,
            self.kernel_geometry, *self.geometry, direct, weigh, self.routes is not None, self.leaving,
        )  # fmt: skip
        return breaks, left

    def deposit(self, start: int, stop: int, weigh: bool) -> None:
        """Add the particles from `start` to `stop` to the sums, and look at their |scalar|. Local."""
        if start == stop:
            return
        particles = self.particles
        peak = self._kernels.deposit(
            particles.axes, particles.state, self.held_sums, self._moments,
            start, stop, self.kernel_geometry, *self.geometry, weigh,
        )  # fmt: skip
        self.peak = float(np.maximum(self.peak, peak))

    def finish_sums(self, weigh: bool) -> None:
        """Make the sums right on own and ghost nodes; the row sums too if `weigh`. Collective on neighbours."""
        if weigh and self._kernels.row_sums is not None:
            self._kernels.row_sums(self._moments, *self.geometry, self.held_sums, self.held_sums.shape[1] - 1)
        super().finish_sums(weigh)

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
        self._kernels.cross(self._moments, *self._geometry, self.grid.inverse_h, nodal, out, False)
        return out

    def divergence_sums(self, nodal: FloatArray, out: FloatArray) -> FloatArray:
        """out += Σ_a ΦᵀD^a nodal_a: d columns to one; complete it afterwards. Local."""
        self._kernels.cross(self._moments, *self._geometry, self.grid.inverse_h, nodal, out, True)
        return out

    def _clear(self, weigh: bool) -> None:
        super()._clear(weigh)
        if weigh:
            self._moments.fill(0.0)

    def _pass(self, nodal: FloatArray, rates: tuple[float, float], direct: bool, weigh: bool) -> tuple[int, int]:
        particles = self.particles
        self.peak, breaks, left = self._kernels.advance(
            particles.axes, particles.state, nodal, rates, self.held_sums, self._moments, 0, particles.count,
            self._kernel_geometry, *self._geometry, direct, weigh, self.routes is not None, self._leaving,
        )  # fmt: skip
        return breaks, left

    def _deposit(self, start: int, stop: int, weigh: bool) -> None:
        if start == stop:
            return
        particles = self.particles
        peak = self._kernels.deposit(
            particles.axes, particles.state, self.held_sums, self._moments,
            start, stop, self._kernel_geometry, *self._geometry, weigh,
        )  # fmt: skip
        self.peak = float(np.maximum(self.peak, peak))

    def _finish_sums(self, weigh: bool) -> None:
        if weigh and self.grid.dim == 3:
            self._kernels.row_sums(self._moments, *self._geometry, self.held_sums, self.held_sums.shape[1] - 1)
        super()._finish_sums(weigh)

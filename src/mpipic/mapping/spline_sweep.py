"""On splines of any degree: a few passes over the particles a step."""

from __future__ import annotations

import numpy as np

from mpipic.arrays import FloatArray, IntArray
from mpipic.kernels import spline
from mpipic.mapping.sweep import ParticleSweep
from mpipic.particles import motion


class SplineSweep(ParticleSweep):
    """On splines of any degree: a few passes over the particles a step, and two more for every gradient.

    Notes
    -----
    `gradient_sums`, `divergence_sums` and their transposes cost two passes over the particles each. Memory per
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

    def gradient_sums(self, nodal: FloatArray, out: FloatArray) -> FloatArray:
        """out += ΦᵀD^a nodal: one column to d; complete it afterwards. Local."""
        seen = np.zeros((self.particles.count, self.grid.dim))
        column = np.ascontiguousarray(nodal[:, 0])
        spline.add_gradient(self.grid.degree, *self.located, column, 1.0, *self.differences, seen)
        spline.add_sums(self.grid.degree, *self.located, seen, *self.geometry, out)
        return out

    def divergence_sums(self, nodal: FloatArray, out: FloatArray) -> FloatArray:
        """out += Σ_a ΦᵀD^a nodal_a: d columns to one; complete it afterwards. Local."""
        seen = np.zeros(self.particles.count)
        spline.add_divergence(
            self.grid.degree, *self.located, np.ascontiguousarray(nodal), 1.0, *self.differences, seen
        )
        spline.add_sums(self.grid.degree, *self.located, seen[:, None], *self.geometry, out)
        return out

    def transposed_gradient_sums(self, nodal: FloatArray, out: FloatArray) -> FloatArray:
        """out += (D^a)ᵀΦ nodal: one column to d; complete it afterwards. Local."""
        seen = np.zeros((self.particles.count, 1))
        spline.add_interpolated(
            self.grid.degree, *self.located, np.ascontiguousarray(nodal), np.ones(1), *self.geometry, seen
        )
        spline.add_gradient_sums(self.grid.degree, *self.located, seen[:, 0].copy(), *self.differences, out)
        return out

    def transposed_divergence_sums(self, nodal: FloatArray, out: FloatArray) -> FloatArray:
        """out += Σ_a (D^a)ᵀΦ nodal_a: d columns to one; complete it afterwards. Local."""
        seen = np.zeros((self.particles.count, self.grid.dim))
        spline.add_interpolated(
            self.grid.degree, *self.located, np.ascontiguousarray(nodal), np.ones(self.grid.dim), *self.geometry, seen
        )
        total = np.zeros(len(out))
        spline.add_divergence_sums(self.grid.degree, *self.located, seen, *self.differences, total)
        out[:, 0] += total
        return out

    def update_and_move(
        self, nodal: FloatArray, rates: tuple[float, float], direct: bool, weigh: bool
    ) -> tuple[int, int]:
        """Add the increments, move, list the leavers. Local.

        Returns how many particles lie in another cell than their predecessor, and how many left.
        """
        particles, degree, dim = self.particles, self.grid.degree, self.grid.dim
        state = particles.state
        if direct:
            change = np.zeros(state.shape)
            vector, scalar = np.ascontiguousarray(nodal[:, 1:]), np.ascontiguousarray(nodal[:, 0])
            along, across = np.zeros(len(state)), np.zeros((len(state), dim))
            spline.add_divergence(degree, *self.located, vector, rates[0], *self.differences, along)
            spline.add_gradient(degree, *self.located, scalar, rates[1], *self.differences, across)
            change[:, 0], change[:, 1:] = along, across
            state += change
        else:
            each = np.array([rates[0], *[rates[1]] * dim])
            spline.add_interpolated(degree, *self.located, nodal, each, *self.geometry, state)
        gone = motion.shift(particles, self.grid, np.array(self.shift))
        self.peak = 0.0
        left = gone.size
        if left <= len(self.leaving):
            self.leaving[:left] = gone
        return int(np.count_nonzero(np.diff(self._cell))), left

    def sort(self) -> None:
        """Put the particles in the order of their cells. Local; O(n)."""
        super().sort()
        self._locate()

    def _locate(self) -> None:
        self._cell, self._fraction = super().located

    def deposit(self, start: int, stop: int, weigh: bool) -> None:
        """Add the particles from `start` to `stop` to the sums, and look at their |scalar|. Local."""
        particles = self.particles
        self._locate()
        rows = np.ones((particles.count, self.grid.dim + 2))
        rows[:, :-1] = particles.state
        sums = self.held_sums if weigh else np.zeros(self.held_sums.shape)
        spline.add_sums(self.grid.degree, *self.located, rows, *self.geometry, sums)
        if not weigh:
            self.held_sums[:, :-1] += sums[:, :-1]
        self.peak = float(np.max(np.abs(rows[:, 0]), initial=0.0))

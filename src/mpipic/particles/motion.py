"""Particles that move: by one displacement, or each by its own; those that leave this rank's cells are sent on."""

from __future__ import annotations

import math

import numpy as np
from mpi4py import MPI

from mpipic.arguments import positions, real_array
from mpipic.arrays import FloatArray, IntArray
from mpipic.box import first_misplaced
from mpipic.kernels import blocks
from mpipic.mesh.agreement import Said, together
from mpipic.mesh.grid import Grid
from mpipic.particles import migration
from mpipic.particles.store import Particles, check_inside


class Motion:
    """Moves the particles of a run around the periodic box, and migrates them.

    Parameters
    ----------
    grid
    particles
        Must be in this rank's cells.

    Attributes
    ----------
    migrated : int
        How many have arrived on this rank so far.

    Notes
    -----
    Messages go to the ranks within reach of the largest displacements so far; a graph of ranks is made when these grow
    past whole cells, and kept.
    """

    def __init__(self, grid: Grid, particles: Particles) -> None:
        self.grid, self.particles, self.migrated = grid, particles, 0
        self._routes: migration.Routes | None = None
        self._reach: migration.Reach | None = None

    def move(self, displacement: FloatArray) -> int:
        """Move all particles by a displacement (d,), or each by its own (n, d), in units of length.

        Coordinates change by whole quanta of the grid (see `mpipic.mesh.grid`), by the same arithmetic on any rank.
        Returns how many particles arrived on this rank; they are the last ones. A rank without particles may give (0,).

        Raises
        ------
        ValueError, TypeError
            Displacements are of another shape or no numbers; one is not finite, or so large that its digits do not tell
            a cell; the one displacement differs between ranks; particles are not in their rank's cells. On all ranks
            together, and nothing has moved then.

        Notes
        -----
        Collective. One reduction to agree; with a displacement for each, one of 2 d numbers more finds the reach; then
        a count and a block of particles to each rank within it.
        """
        grid, n = self.grid, self.particles.count

        def check() -> FloatArray:
            steps = self._steps(displacement)
            check_inside(self.particles, grid)
            return steps

        def say(steps: FloatArray) -> Said:
            if steps.ndim == 1:
                return Said((1.0, *steps), lambda: f"one displacement {steps.tolist()}, in cells", n > 0)
            return Said((0.0,), lambda: "a displacement for each particle", n > 0)

        steps, (for_all, *common) = together(grid.comm, "Motion.move", check, say)
        if not n:  # the others say which
            steps = np.array(common) if for_all else np.empty((0, grid.dim))
        reach = migration.Reach.of_one(steps.tolist()) if for_all else self._reach_of(steps)
        return self._send(reach, shift(self.particles, grid, steps))

    def _steps(self, displacement: FloatArray) -> FloatArray:
        """Return displacements (d,) or (n, d) in cells, less than a period, rounded to quanta. Local."""
        grid, given = self.grid, real_array("displacement", displacement)
        if given.shape != (grid.dim,):
            given = positions("displacement", given, grid.dim, self.particles.count)
        problem = first_misplaced("displacement", np.atleast_2d(given), grid.h)
        if problem:
            raise ValueError(problem)
        return grid.rounded(np.fmod(given / np.array(grid.h), np.array(grid.cells, dtype=np.float64)))

    def _reach_of(self, steps: FloatArray) -> migration.Reach:
        """Least and greatest steps of all ranks, out to whole cells. Collective."""
        ends = np.concatenate([steps.max(axis=0, initial=0.0), -steps.min(axis=0, initial=0.0)])
        ends = self.grid.reduce(ends, MPI.MAX)
        high, low = ends[: self.grid.dim], -ends[self.grid.dim :]
        return migration.Reach(tuple(map(math.floor, low)), tuple(map(math.ceil, high)))

    def _send(self, reach: migration.Reach, leaving: IntArray) -> int:
        if not migration.can_leave(self.grid, reach):
            return 0
        if self._reach is None or not self._reach.covers(reach):
            self.close()
            self._reach = self._reach.joined(reach) if self._reach else reach
            self._routes = migration.Routes(self.grid, self._reach)
        assert self._routes is not None
        arrived = migration.migrate(self.particles, self._routes, leaving)
        self.migrated += arrived
        return arrived

    def close(self) -> None:
        """Give the communicator of the routes back to MPI; the next move makes another. Collective."""
        if self._routes is not None:
            self._routes.free()
            self._routes = None


def shift(particles: Particles, grid: Grid, steps: FloatArray) -> IntArray:
    """Move coordinates by steps (d,) or (n, d) in cells, less than a period; return who is outside this rank's cells.

    Sorted local indices. Local; O(n).
    """
    outside = np.zeros(particles.count, dtype=np.int32)
    for axis, (cells, tolerance) in enumerate(zip(grid.cells, grid.tolerance, strict=True)):
        x = particles.axes[axis, : particles.count]
        if steps.ndim == 2:
            blocks.move_each(x, np.ascontiguousarray(steps[:, axis]), float(cells), tolerance)
        elif steps[axis]:
            blocks.move(x, float(steps[axis]), float(cells), tolerance)
        first, size = grid.owned_start[axis], grid.owned_shape[axis]
        blocks.mark_outside(x, tolerance, np.int32(first), np.int32(size), outside)
    return np.flatnonzero(outside)

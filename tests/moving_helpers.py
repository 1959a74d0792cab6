"""Mistakes with particles of a run: how they move, and where they are put."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from argument_helpers import expect
from mpipic import Scene, Simulation
from mpipic.particles.motion import Motion


class MovingWalk:
    """Moves particles of a run, and puts them elsewhere, wrongly on some ranks, then rightly on all."""

    def __init__(self, comm, seed):
        self.comm, self.rng = comm, np.random.default_rng(seed)
        scene = Scene.from_dict({"grid": {"cells": [np.int64(6), 4]}, "time": {"steps": 2}})
        self.simulation = Simulation(scene, comm)
        self.motion = Motion(self.simulation.grid, self.simulation.particles)

    def who(self):
        """Whether this rank is among those that do it."""
        return bool((self.rng.integers(2, size=self.comm.size) | (np.arange(self.comm.size) == 0))[self.comm.rank])

    def step(self):
        """Move and set the state, both wrong and right."""
        particles, grid = self.simulation.particles, self.simulation.grid
        n, who, before = particles.count, self.who(), particles.coordinate.copy()
        each = np.full((n, 2), 0.3)
        wrong = [np.full(3, 0.1), np.full((n, 3), 0.1), np.full((n + 1, 2), 0.1), each.T, each * 1j, None, "x",
                 np.ma.masked_array(each), np.where(np.eye(n, 2) > 0, np.nan, each), each * 1e300]  # fmt: skip
        bad = wrong[self.rng.integers(len(wrong))]
        expect(True, lambda: self.motion.move(bad if who else each), ["displacement"])
        assert np.array_equal(particles.coordinate, before)
        if self.comm.size > 1:
            one = np.array([0.1, 0.2]) * (1 + self.comm.rank)
            expect(True, lambda: self.motion.move(one), ["ranks must call the same"])
            expect(True, lambda: self.motion.move(each if self.comm.rank else one), ["ranks must call the same"])
        self.put_wrong(who, n, particles, grid)
        self.stray(particles, grid)
        self.motion.move(np.array([0.17, -0.4]))
        self.motion.move(self.rng.standard_normal((particles.count, 2)) if self.comm.size == 1 else
                         np.random.default_rng(self.comm.rank).standard_normal((particles.count, 2)))  # fmt: skip
        assert self.comm.allreduce(particles.count) == self.simulation.total
        self.simulation.set_state(state=np.ones((particles.count, 3)))
        assert np.all(particles.state == 1.0)

    def put_wrong(self, who, n, particles, grid):
        """States that are none."""
        places, state, ids = particles.coordinate.copy(), particles.state.copy(), particles.ids.copy()
        kept = places.copy(), state.copy(), ids.copy()
        far = places.copy()
        far[0] = np.nan
        there, here = (lambda state: (None, state, None)), (lambda ids: (places, state, ids))
        wrong = [
            ("coordinate", (places[:, :1], state, ids)), ("coordinate", (far, state, ids)), ("state", there("x")),
            ("state", there(state[:-1])), ("state", there(state * 1j)), ("state", (places, state[:, :2], ids)),
            ("state", there(np.zeros(n))), ("ids", here(ids[:-1])), ("ids", here(ids + 0.5)), ("ids", here(0 * ids)),
            ("ids", here("x")), ("ids", (places, None, None)),
        ]  # fmt: skip
        name, arguments = wrong[self.rng.integers(len(wrong))]
        right = (None, state, None) if arguments[0] is None and arguments[2] is None else (places, state, ids)
        expect(True, lambda: self.simulation.set_state(*(arguments if who else right)), [name])
        if grid.size > 1:  # to where another rank's cells are
            elsewhere = np.mod(places + np.array(grid.cells) / 2, grid.cells)
            moved = elsewhere if who else places
            expect(True, lambda: self.simulation.set_state(moved, state, ids), ["particle"])
        now = particles.coordinate, particles.state, particles.ids
        assert all(np.array_equal(one, other) for one, other in zip(now, kept, strict=True))

    def stray(self, particles, grid):
        """A particle that a caller put out of its rank's cells, along the last axis: refused by all, not waited for."""
        if grid.size == 1 or not self.comm.allreduce(particles.count > 0, op=MPI.LAND):
            return
        saved = particles.coordinate.copy()
        if self.comm.rank == grid.size - 1:
            particles.coordinate[0] = np.mod(saved[0] + np.array(grid.cells) / 2, grid.cells)
        expect(True, lambda: self.motion.move(np.zeros(2)), ["particle"])
        expect(True, lambda: self.simulation.physics.restart(), ["particle"])
        particles.coordinate[...] = saved
        self.simulation.physics.restart()

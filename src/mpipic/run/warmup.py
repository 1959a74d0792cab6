"""Compiling ahead: what a run will call is compiled, or loaded from the cache, before its clock starts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from mpipic.mesh.grid import Grid
from mpipic.particles.store import Particles
from mpipic.phases import Phases
from mpipic.run.build import physics_of

if TYPE_CHECKING:
    from mpipic.scene.records import Scene


def compile_loops(scene: Scene) -> None:
    """Compile what a run of the scene will call, or load it from the cache. Local.

    Takes one step of the scene's kind with a few particles on a small grid, and tells what reports will tell if the
    scene asks for any.
    """
    dim = scene.dim
    small = scene.having(grid={"cells": (2,) * dim, "length": (1.0,) * dim})
    physics = physics_of(small)
    grid = Grid(small.grid.cells, small.grid.length, MPI.COMM_SELF, scene.mapping.basis)
    particles = Particles(grid.h, physics.fields(dim))
    # evenly spread, and no field 0 all over: solvers must have something to iterate on
    axes = [(np.arange(4) + 0.5) / 2] * dim
    coordinate = np.stack([x.ravel() for x in np.meshgrid(*axes)], axis=1)
    count = len(coordinate)
    width = particles.state.shape[1]
    state = np.sin(np.arange(1.0, count * width + 1)).reshape(count, width)
    particles.append(grid.wrapped(coordinate), state, np.arange(count))
    for name, values in (physics.initial(particles.position) or {}).items():
        particles[name] = np.where(values == 0.0, particles[name], values)
    physics.place(grid, particles, Phases())
    physics.step()
    if scene.output.report_at:
        physics.null_space_shares()
    physics.close()

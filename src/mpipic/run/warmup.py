"""Compiling ahead: what a run will call is compiled, or loaded from the cache, before its clock starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from mpi4py import MPI

from mpipic.mesh.grid import Grid
from mpipic.particles.store import Particles
from mpipic.phases import Phases
from mpipic.run.build import build_step, build_sweep
from mpipic.scene.records import Scene


def compile_loops(scene: Scene) -> None:
    """Take one step of the scene's kind with a few particles on a small grid, so that every loop is compiled. Local."""
    dim = scene.dim
    small = replace(scene, grid=scene.grid.model_copy(update={"cells": (2,) * dim, "length": (1.0,) * dim}))
    grid = Grid(small.grid.cells, small.grid.length, MPI.COMM_SELF, scene.mapping.basis)
    particles = Particles(grid.h, {"density": 0, "velocity": dim})
    # evenly spread and not at rest: solvers must have something to iterate on
    axes = [(np.arange(4) + 0.5) / 2] * dim
    coordinate = np.stack([x.ravel() for x in np.meshgrid(*axes)], axis=1)
    count = len(coordinate)
    state = np.sin(np.arange(1.0, count * (1 + dim) + 1)).reshape(count, 1 + dim)
    particles.append(grid.wrapped(coordinate), state, np.arange(count))
    build_step(small, build_sweep(small, grid, particles, Phases())).step()
    particles.take(np.arange(1))

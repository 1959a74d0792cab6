"""Compiling ahead: what a run will call is compiled, or loaded from the cache, before its clock starts."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from mpipic.formulation import Rates, symplectic
from mpipic.grid import Grid
from mpipic.particles import Particles
from mpipic.scene import Scene
from mpipic.sweep import Sweep


def compile_loops(scene: Scene) -> None:
    """Take one step of the scene's kind with two particles on a small grid, so that every loop is compiled. Local."""
    dim = scene.dim
    grid = Grid((2,) * dim, (1.0,) * dim, MPI.COMM_SELF)
    particles = Particles(grid.h, {"density": 0, "velocity": dim})
    particles.append(np.full((2, dim), 0.5), np.zeros((2, 1 + dim)), np.arange(2))
    sweep = Sweep(grid, particles, (0.125,) * dim)
    symplectic(sweep, Rates(1.0, 1.0), scene.filter).step()
    particles.take(np.arange(1))

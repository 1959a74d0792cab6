"""Compiling ahead: what a run will call is compiled, or loaded from the cache, before its clock starts."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from mpipic.filters import FILTERS
from mpipic.formulation import Rates, SymplecticEuler, UnfilteredEuler
from mpipic.grid import Grid
from mpipic.mapping import Sweep
from mpipic.particles import Particles


def compile_loops(dim: int, kind: str) -> None:
    """Take one step with two particles on a grid of its own, so that every loop of such a run is compiled. Local."""
    grid = Grid((2,) * dim, (1.0,) * dim, MPI.COMM_SELF)
    particles = Particles(grid.h, {"density": 0, "velocity": dim})
    particles.append(np.full((2, dim), 0.5), np.zeros((2, 1 + dim)), np.arange(2))
    sweep = Sweep(grid, particles, (0.125,) * dim)
    rates = Rates(1.0, 1.0)
    (UnfilteredEuler(sweep, rates) if kind == "none" else SymplecticEuler(sweep, rates, FILTERS[kind](sweep))).step()
    particles.take(np.arange(1))

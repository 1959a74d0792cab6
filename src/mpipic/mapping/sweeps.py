"""Which sweep serves which basis."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mpipic.mapping.linear_sweep import LinearSweep
from mpipic.mapping.spline_sweep import SplineSweep
from mpipic.mapping.sweep import ParticleSweep
from mpipic.mesh.grid import Grid
from mpipic.particles.store import Particles


def create(
    grid: Grid,
    particles: Particles,
    displacement: Sequence[float],
    phase: Callable[[str], None] = lambda name: None,
    transposed: bool = False,
) -> ParticleSweep:
    """Return the sweep for the basis of the grid; `transposed`: one that has the transposed gradients too."""
    cls = LinearSweep if grid.degree == 1 and not transposed else SplineSweep
    return cls(grid, particles, displacement, phase)

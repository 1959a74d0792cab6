"""Filters tell one thing about a state: the share of it that no node sees."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from mpipic.arrays import FloatArray, columns_of
from mpipic.errors import NotConverged
from mpipic.filters.exact import ExactFilter
from mpipic.mapping.mapping import Mapping
from mpipic.mesh.grid import Grid
from mpipic.particles.store import Particles

SHARE_TOLERANCE = 1e-10


def null_space_fraction(grid: Grid, particles: Particles, field: FloatArray) -> float | None:
    """Return ‖(1 - P) q‖ / ‖q‖ of q = D S f, the unfiltered particle gradient of a scalar field f (n,).

    It is the share that no node sees: 0 for a gradient that vanishes; None where the projection P did not converge or
    the gradient is not finite. Collective; costs about a step with the exact filter, and its memory.
    """
    mapping = Mapping.at(grid, particles)
    q = mapping.gradient(mapping.p2g(field))
    return share_unseen(mapping, q)


def share_unseen(mapping: Mapping, q: FloatArray) -> float | None:
    """Return ‖(1 - P) q‖ / ‖q‖ of particle values (n, *shape), as `null_space_fraction`. `q` is not modified.

    Collective.
    """
    grid, q = mapping.grid, columns_of(mapping.agreed("share_unseen", q))
    largest = grid.reduce(np.array([np.where(np.isfinite(q), np.abs(q), np.inf).max(initial=0.0)]), MPI.MAX)[0]
    if largest == 0.0 or not np.isfinite(largest):
        return 0.0 if largest == 0.0 else None
    q = q / largest
    try:
        hidden = q - ExactFilter(mapping, SHARE_TOLERANCE, "report_", strict=False).apply(q)
    except NotConverged:
        return None
    sums = grid.reduce(np.array([np.sum(hidden**2), np.sum(q**2)]))
    return float(np.sqrt(sums[0] / sums[1]))

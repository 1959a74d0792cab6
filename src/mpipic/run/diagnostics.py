"""Numbers about a state: errors against an exact solution, noise that no node sees. Collective; all ranks know them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI

from mpipic.arrays import FloatArray
from mpipic.errors import NotConverged
from mpipic.mesh.grid import Grid
from mpipic.particles.store import Particles

Exact = Callable[[FloatArray, float], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True)
class Norms:
    """Mean, root mean square and largest of |e| over all particles."""

    l1: float
    l2: float
    linf: float


@dataclass(frozen=True)
class ErrorReport:
    """Errors of density and velocity at one step; the null-space share is None where it was not asked for."""

    step: int
    time: float
    density: Norms
    velocity: Norms
    null_space_fraction: float | None = None

    def row(self) -> dict[str, Any]:
        """The report as flat columns: density_l1 to velocity_linf, null_space_fraction."""
        columns = {
            f"{name}_{norm}": getattr(getattr(self, name), norm)
            for name in ("density", "velocity")
            for norm in ("l1", "l2", "linf")
        }
        return {**columns, "null_space_fraction": self.null_space_fraction}


def norms(error: FloatArray, total: int, comm: MPI.Comm) -> Norms:
    """Norms of errors (n,), or of the Euclidean lengths of error vectors (n, d), over `total` particles on all ranks.

    Sizes are taken relative to the largest, so that neither tiny nor huge errors under- or overflow when squared.
    One error that is not finite makes all three norms infinite. Collective; two reductions.
    """
    size = np.abs(error)
    if error.ndim == 2:
        longest = size.max(axis=1, initial=0.0)
        scale = np.where((longest > 0) & np.isfinite(longest), longest, 1.0)
        with np.errstate(invalid="ignore"):  # of infinities; they are found below
            size = longest * np.sqrt(np.sum((size / scale[:, None]) ** 2, axis=1))
    # what MAX makes of a NaN differs between MPIs: infinity stands in for it
    largest = comm.allreduce(float(np.where(np.isnan(size), np.inf, size).max(initial=0.0)), op=MPI.MAX)
    if largest == 0.0 or not np.isfinite(largest):
        return Norms(largest, largest, largest)
    relative = size / largest
    sums = np.array([relative.sum(), np.square(relative).sum()])
    comm.Allreduce(MPI.IN_PLACE, sums)
    return Norms(largest * sums[0] / total, largest * float(np.sqrt(sums[1] / total)), largest)


def measure(particles: Particles, exact: Exact, step: int, time: float, total: int, comm: MPI.Comm) -> ErrorReport:
    """Errors of the fields density and velocity at `time`. Collective; the exact solution is evaluated locally."""
    density, velocity = exact(particles.position, time)
    return ErrorReport(
        step,
        time,
        norms(particles.field("density") - density, total, comm),
        norms(particles.field("velocity") - velocity, total, comm),
    )


SHARE_TOLERANCE = 1e-10


def null_space_fraction(grid: Grid, particles: Particles) -> float | None:
    """‖(1 - P) q‖ / ‖q‖ of q = D S ρ_p, the unfiltered particle gradient of the density: the share that no node sees.

    0 for a gradient that vanishes; None where the projection P did not converge or the gradient is not finite.
    Collective; costs about a step with the exact filter, and its memory.
    """
    from mpipic.filters import ExactFilter
    from mpipic.mapping.mapping import Mapping

    mapping = Mapping.at(grid, particles)
    density = np.ascontiguousarray(particles.field("density"))
    q = mapping.gradient(mapping.p2g(density))
    largest = grid.reduce(np.array([np.where(np.isfinite(q), np.abs(q), np.inf).max(initial=0.0)]), MPI.MAX)[0]
    if largest == 0.0 or not np.isfinite(largest):
        return 0.0 if largest == 0.0 else None
    q /= largest
    try:
        hidden = q - ExactFilter(mapping, SHARE_TOLERANCE).apply(q)
    except NotConverged:
        return None
    sums = grid.reduce(np.array([np.sum(hidden**2), np.sum(q**2)]))
    return float(np.sqrt(sums[0] / sums[1]))

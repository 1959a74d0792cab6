"""Numbers about a state: errors against an exact solution, noise that no node sees. Collective; all ranks know them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from mpi4py import MPI

from mpipic.arrays import FloatArray, columns_of
from mpipic.particles.store import Particles


@dataclass(frozen=True)
class Norms:
    """Mean, root mean square and largest of |e| over all particles."""

    l1: float
    l2: float
    linf: float


@dataclass(frozen=True)
class ErrorReport:
    """Errors of the fields that a physics compares, at one step, and the null-space shares that were asked for.

    Attributes
    ----------
    errors : name of a field to norms
    shares : name of a share to number; None where it could not be found
    """

    step: int
    time: float
    errors: Mapping[str, Norms]
    shares: Mapping[str, float | None] = field(default_factory=dict)

    def row(self) -> dict[str, float | None]:
        """Return the report as flat columns: density_l1, density_l2, ..., null_space_fraction."""
        columns: dict[str, float | None] = {
            f"{name}_{norm}": getattr(norms, norm)
            for name, norms in self.errors.items()
            for norm in ("l1", "l2", "linf")
        }
        return {**columns, **self.shares}

    def record(self) -> dict[str, object]:
        """Return the report as summary.json holds it: step, time, norms by field, shares."""
        return {"step": self.step, "time": self.time, **self.errors, **self.shares}


def norms(error: FloatArray, total: int, comm: MPI.Comm) -> Norms:
    """Return norms of errors (n,), or of the lengths of error vectors (n, d), over `total` particles on all ranks.

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


def measure(
    particles: Particles, exact: Mapping[str, FloatArray], step: int, time: float, total: int, comm: MPI.Comm
) -> ErrorReport:
    """Return the errors of all fields that the exact solution names, (n, *shape) each. Collective.

    Of a tensor's error the norm over all components is taken.
    """
    errors = {}
    for name, truth in exact.items():
        error = particles[name] - truth
        errors[name] = norms(error if error.ndim == 1 else columns_of(error), total, comm)
    return ErrorReport(step, time, errors)

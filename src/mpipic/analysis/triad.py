"""The memory bandwidth of the machine, by STREAM's triad."""

from __future__ import annotations

from time import perf_counter

import numpy as np
from mpi4py import MPI

from mpipic.kernels.bandwidth import triad

DOUBLES = 20_000_000
"""Length of each of the three arrays on every rank: far more than caches hold."""


class Triad:
    """STREAM's triad, a = b + s c, 24 bytes an element, on all ranks at once."""

    def __init__(self, comm: MPI.Comm) -> None:
        self.comm = comm
        self._arrays = [np.ones(DOUBLES) for _ in range(3)]
        triad(*self._arrays, 3.0)

    def bandwidth(self) -> float:
        """Return the bytes per second of all ranks together, the best of three. Collective."""
        best = np.inf
        for _ in range(3):
            self.comm.Barrier()
            began = perf_counter()
            triad(*self._arrays, 3.0)
            best = min(best, perf_counter() - began)
        return 24.0 * DOUBLES * self.comm.size / float(self.comm.allreduce(best, op=MPI.MAX))

"""The end of PETSc objects that call back into Python.

PETSc finalises after Python has gone, and must find none of them then. Destroying them is collective, so it cannot be
left to the garbage collector, which comes at different times on different ranks.
"""

from __future__ import annotations

import atexit
import gc
from typing import Protocol
from weakref import ref

from mpi4py import MPI
from petsc4py import PETSc


class Closable(Protocol):
    """Holds PETSc objects."""

    def close(self) -> None:
        """Destroy them. Collective; may be called twice."""
        ...


_made: list[ref[Closable]] = []
"""In the order of their making, which is the same on all ranks."""


def close_at_exit(holder: Closable) -> None:
    """Close the holder when Python ends, if it then still lives. Local."""
    _made[:] = [other for other in _made if other() is not None]
    _made.append(ref(holder))


@atexit.register
def close_all() -> None:
    """Close every holder that still lives, once: before PETSc ends. Collective."""
    while _made:
        holder = _made.pop(0)()
        if holder is not None:
            holder.close()
    if MPI.COMM_WORLD.size == 1:
        # what cycles of references still hold; on several ranks these may differ, and cleaning up together would wait
        gc.collect()
        PETSc.garbage_cleanup()

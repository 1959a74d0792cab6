"""The end of PETSc objects that call back into Python.

PETSc finalises after Python has gone, and must find none of them then. Destroying them is collective, so it cannot be
left to the garbage collector, which comes at different times on different ranks.
"""

from __future__ import annotations

import atexit
import ctypes
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


Key = tuple[tuple[int, ...], int]
"""The ranks of a holder's communicator, as MPI.COMM_WORLD counts them, and how many holders these had made before."""

_made: dict[Key, ref[Closable]] = {}
_counts: dict[tuple[int, ...], int] = {}
_sentinel: list[PETSc.Vec] = []
"""PETSc 3.18 waits at its end for all ranks, but only on those where a collector has left something behind. So that all
wait, each leaves this behind."""


def close_at_exit(holder: Closable, comm: MPI.Comm) -> None:
    """Close the holder when Python ends, if it then still lives on all ranks of its communicator. Collective."""
    for key in [key for key, made in _made.items() if made() is None]:
        del _made[key]
    members = tuple(MPI.Group.Translate_ranks(comm.group, list(range(comm.size)), MPI.COMM_WORLD.group))
    _counts[members] = _counts.get(members, 0) + 1
    _made[members, _counts[members]] = ref(holder)
    if 1 < len(members) == MPI.COMM_WORLD.size and not _sentinel:
        _sentinel.append(PETSc.Vec().createMPI(len(members), comm=PETSc.COMM_WORLD))


@atexit.register
def close_all() -> None:
    """Close every holder that lives on all its ranks, in the same order everywhere, once: before PETSc ends.

    What lives on some of them only, since a collector has come to the others, is given up: to destroy it would wait for
    them for ever. Collective.
    """
    living = {key: holder for key, made in _made.items() if (holder := made()) is not None}
    _made.clear()
    several = MPI.COMM_WORLD.size > 1
    told = MPI.COMM_WORLD.allgather([key for key in living if len(key[0]) > 1]) if several else []
    for key in sorted(living):
        if len(key[0]) == 1 or all(key in told[rank] for rank in key[0]):
            living[key].close()
        else:
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(living[key]))
    if several:
        _sentinel.clear()
    else:
        # what cycles of references still hold; on several ranks these may differ, and cleaning up together would wait
        gc.collect()
        PETSc.garbage_cleanup()

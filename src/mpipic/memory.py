"""How much memory this process can have."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import psutil

if TYPE_CHECKING:
    from mpi4py import MPI


def available_bytes() -> float:
    """Return the memory that can be had without swapping and within the limit of this process's control group."""
    limits = [float(psutil.virtual_memory().available)]
    group = Path("/sys/fs/cgroup")
    with suppress(OSError, ValueError):  # no such group, or "max"
        limits.append(float((group / "memory.max").read_text()) - float((group / "memory.current").read_text()))
    return min(limits)


def free_bytes(comm: MPI.Comm) -> float:
    """Return the memory that can be had on all ranks together, each with as much as the poorest. Collective."""
    from mpi4py import MPI

    here = comm.Split_type(MPI.COMM_TYPE_SHARED)
    share = available_bytes() / here.size
    here.Free()
    return float(comm.allreduce(share, op=MPI.MIN)) * comm.size

"""Facts that go with every result: versions, and the phases that make up the time of stepping."""

from __future__ import annotations

import platform
import sys
from importlib import metadata

from mpi4py import MPI

STEP_PHASES = ("particles", "nodes", "filter", "halo", "migrate", "sort")
"""Phases of a clock that are steps; the others are set-up, reports and files."""
LIBRARIES = ("mpipic", "numpy", "mpi4py", "petsc4py", "numba")


def versions() -> dict[str, str]:
    """Return the versions of everything that a result may depend on."""
    found = {name: _version(name) for name in LIBRARIES}
    library = MPI.Get_library_version().splitlines()[0].strip("\0 ")
    return {**found, "python": platform.python_version(), "mpi": library, "machine": platform.machine()}


def _version(name: str) -> str:
    """Return the version of an imported library; some installations tell it in the module only."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return str(getattr(sys.modules.get(name), "__version__", "unknown"))

"""PETSc options for a test, and every method and preconditioner that PETSc knows, tried on a filter."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from collections.abc import Mapping as Named
from contextlib import contextmanager

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from mpipic.draws import noise
from mpipic.errors import NotConverged
from mpipic.filters import ExactFilter
from mpipic.mapping.mapping import Mapping
from mpipic.mesh.grid import Grid
from mpipic.mesh.petsc_options import BadOption
from mpipic.particles.placement import Placement

TOLERANCE = 1e-10


@contextmanager
def options(**given: object) -> Iterator[None]:
    """Have these in PETSc's database for a while."""
    database = PETSc.Options()
    for name, value in given.items():
        database.setValue(name, value)
    try:
        yield
    finally:
        for name in given:
            database.delValue(name)


def types() -> list[dict[str, str]]:
    """Every method alone and with Jacobi's preconditioner, and every preconditioner with the usual method."""
    methods, preconditioners = (
        sorted({str(value) for name, value in vars(kind).items() if name.isupper()})
        for kind in (PETSc.KSP.Type, PETSc.PC.Type)
    )
    with_jacobi = [{"filter_ksp_type": name, "filter_pc_type": "jacobi"} for name in methods]
    alone = [{"filter_ksp_type": name} for name in methods]
    return [*alone, *with_jacobi, *({"filter_pc_type": name} for name in preconditioners)]


def outcomes(comm: MPI.Intracomm) -> list[tuple[Named[str, str], str, float]]:
    """For each of `types`: whether the filter came out, was refused or did not converge, and how far it was off."""
    grid = Grid((8,), (1.0,), comm, "quadratic")
    ids = np.arange(comm.rank, 40, comm.size)
    placement = Placement(grid, 0.5 + 0.5 * noise(ids)[:, None])
    mapping, q = Mapping(grid, placement.position), placement.to_owners(noise(ids + 40))
    reference = ExactFilter(mapping, 1e-13).apply(q)
    found = []
    for given in types():
        with options(**given, filter_ksp_max_it="500"):
            try:
                off = ExactFilter(mapping, TOLERANCE).apply(q) - reference
                size = math.sqrt(comm.allreduce(float(off @ off)) / comm.allreduce(float(q @ q)))
                found.append((given, "solved", size))
            except (BadOption, NotConverged) as error:
                found.append((given, type(error).__name__, 0.0))
    return found


def failures(found: Sequence[tuple[Named[str, str], str, float]]) -> list[str]:
    """Say which answers are wrong: PETSc's less accurate methods may be off by the root of the tolerance, few are."""
    wrong = [f"{given}: off by {off:.1g}" for given, _, off in found if off > 10.0 * math.sqrt(TOLERANCE)]
    solved = [off for _, how, off in found if how == "solved"]
    if len(solved) < 60 or np.median(solved) > TOLERANCE:
        wrong.append(f"{len(solved)} of {len(found)} solve, off by {np.median(solved):.1g}")
    return wrong

"""PETSc's options, held against the solvers that a scene's parts bring in, before anything is built."""

from __future__ import annotations

from typing import TYPE_CHECKING

from petsc4py import PETSc

from mpipic import parts
from mpipic.mesh import petsc_options

if TYPE_CHECKING:
    from mpi4py import MPI

    from mpipic.scene.records import Scene

FILTERS = ("filter_ksp", "filter_svd")


def unread_options(
    scene: Scene, comm: MPI.Comm, any_filter: bool = False, more: petsc_options.Solvers | None = None
) -> list[str]:
    """Return which PETSc options no solver of the scene reads, in words. Collective.

    Parameters
    ----------
    any_filter : whether all filters may be made, not the scene's alone
    more : the solvers that a verb has besides those of the scene

    Raises
    ------
    BadOption
        With every value that a solver cannot take.
    """
    values = scene.values
    begin = [one for part in parts.chosen(values) for one in part.solvers(values)]
    begin += [one for one in FILTERS if any_filter and one not in begin]
    begin += ["report_ksp"] if petsc_options.given("report_") else []
    return petsc_options.check({**{one: _class_of(one) for one in begin}, **(more or {})}, comm)


def left_over() -> list[str]:
    """Return which options of solvers nothing has read until now, in words, but those that were said before. Local."""
    return petsc_options.left_over()


def _class_of(begin: str) -> type[petsc_options.Solver]:
    if begin.endswith("ksp"):
        found: type[petsc_options.Solver] = PETSc.KSP
        return found
    from mpipic.filters.row_space import solver_class

    return solver_class()

"""Linear systems whose matrix is a function, solved by PETSc's Krylov methods."""

from __future__ import annotations

from collections.abc import Callable
from weakref import ref

import numpy as np
from petsc4py import PETSc

from mpipic.arrays import FloatArray
from mpipic.errors import NotConverged
from mpipic.mesh.grid import Grid
from mpipic.mesh.petsc_objects import close_at_exit
from mpipic.mesh.petsc_options import configure, solve

Apply = Callable[[FloatArray], FloatArray]


class _Product:
    """Is called by the shell matrix: it must not keep the solver alive, and must outlive it."""

    def __init__(self, owner: ShellSolver) -> None:
        self._owner = ref(owner)

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = A x, as PETSc calls it. Collective."""
        owner = self._owner()
        assert owner is not None and owner.apply is not None
        result = owner.apply(np.array(x.getArray(readonly=True)))
        with y as out:
            out[...] = result


class ShellSolver:
    """x = A⁻¹ b to a relative residual; keeps its PETSc objects between solves.

    Parameters
    ----------
    prefix
        For PETSc's options: ``-<prefix>ksp_type``, ...
    name
        What messages call it.
    tolerance
        Relative residual.
    symmetric
        Whether A is symmetric positive definite: conjugate gradients then, else GMRES.

    Attributes
    ----------
    ksp : PETSc.KSP or None
        The solver, once there was something to solve.
    iterations : int
        In the last solve.
    apply : function or None
        A, while a solve runs: what it held would otherwise live until a collector comes, at its own time on every rank.
    """

    def __init__(self, prefix: str, name: str, tolerance: float, symmetric: bool) -> None:
        self.prefix, self.name, self.tolerance, self.symmetric = prefix, name, tolerance, symmetric
        self.iterations = 0
        self.apply: Apply | None = None
        self.ksp: PETSc.KSP | None = None
        self._shell: PETSc.Mat
        self._x: PETSc.Vec
        self._b: PETSc.Vec

    def close(self) -> None:
        """Give PETSc's objects back. Collective."""
        if self.ksp is not None:
            for item in (self.ksp, self._shell, self._x, self._b):
                item.destroy()
            self.ksp = None

    def solve(self, grid: Grid, apply: Apply, right: FloatArray, guess: FloatArray) -> FloatArray:
        """Return x on this rank, (own,), from this rank's part of b and of a first guess; NaN where b is not finite.

        Raises
        ------
        NotConverged
            Names the residual and the iteration count.
        BadOption
            PETSc's options do not let it be solved.

        Notes
        -----
        Collective; two reductions, and those of the Krylov method. `apply` is collective too.
        """
        size = grid.size_of(right)
        if not np.isfinite(size):
            return np.full(right.shape, np.nan)
        ksp = self._solver(grid, right.size)
        with self._b as b:
            np.divide(right, size, out=b)
        with self._x as x:
            np.divide(guess, size, out=x)
        self.apply = apply
        try:
            solve(ksp, self._b, self._x)
        finally:
            self.apply = None
        self.iterations = ksp.getIterationNumber()
        if ksp.getConvergedReason() < 0:
            raise NotConverged(
                f"{self.name} ended at residual {ksp.getResidualNorm():.3g} after {self.iterations} "
                f"iterations; asked for is {self.tolerance:g} of the right-hand side's norm"
            )
        return np.asarray(self._x.getArray(readonly=True) * size)

    def _solver(self, grid: Grid, own: int) -> PETSc.KSP:
        """Return the KSP; made anew where the number of unknowns on this rank has changed (particles that migrated)."""
        changed = self.ksp is None or self._b.getLocalSize() != own
        if not grid.reduce(np.array([float(changed)]))[0]:
            return self.ksp
        if self.ksp is None:
            close_at_exit(self, grid.comm)
        self.close()
        self._shell = PETSc.Mat().createPython(((own, None), (own, None)), _Product(self), comm=grid.comm)
        self._x, self._b = self._shell.createVecs()
        ksp = PETSc.KSP().create(grid.comm)
        ksp.setOptionsPrefix(self.prefix)
        ksp.setType(PETSc.KSP.Type.CG if self.symmetric else PETSc.KSP.Type.GMRES)
        ksp.getPC().setType(PETSc.PC.Type.NONE)
        ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED if self.symmetric else PETSc.KSP.NormType.DEFAULT)
        ksp.setTolerances(rtol=self.tolerance, atol=0.0, divtol=1e100)
        ksp.setInitialGuessNonzero(True)
        ksp.setOperators(self._shell)
        configure(ksp, self._shell, self._x, self._b)
        self.ksp = ksp
        return ksp

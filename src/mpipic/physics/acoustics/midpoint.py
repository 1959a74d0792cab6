"""The implicit midpoint rule: stable at any time step that is stable at all, for sound much faster than the flow.

    ȳ = y + dt/2 L ȳ,    y ← y + dt L ȳ,    L = [[0, R], [U, 0]]

With the velocity eliminated, the density at mid-step solves (1 - (dt/2)² R U) ρ̄ = ρ + dt/2 R u: one field instead of
1 + d, by a PETSc KSP (options ``-midpoint_ksp_type``, ...) on a shell matrix.
"""

from __future__ import annotations

from typing import Any
from weakref import ref

import numpy as np
from petsc4py import PETSc

from mpipic.arrays import FloatArray
from mpipic.errors import NotConverged
from mpipic.mesh.petsc_objects import close_at_exit
from mpipic.physics.acoustics.integrators import Rates, State, Step


class _Product:
    """What the shell matrix calls: it must not keep the integrator alive, and must outlive it."""

    def __init__(self, owner: Midpoint) -> None:
        self._owner = ref(owner)

    def mult(self, mat: Any, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = (1 - (dt/2)² R U) x. Collective."""
        owner = self._owner()
        assert owner is not None
        owner.mult(mat, x, y)


class Midpoint:
    """The integrator; keeps its solver, and takes the density at the beginning of a step as the first guess.

    Parameters
    ----------
    tolerance
        Relative residual.
    symmetric
        Whether R U is symmetric negative in the plain inner product: conjugate gradients then, else GMRES.

    Raises
    ------
    NotConverged
        From a step; names the residual and the iteration count.

    Notes
    -----
    Collective. The number of iterations grows with c dt / h. An iteration applies R and U once.
    """

    def __init__(self, tolerance: float, symmetric: bool) -> None:
        self.tolerance, self.symmetric, self.iterations = tolerance, symmetric, 0
        self._ksp: PETSc.KSP | None = None
        self._shell: PETSc.Mat
        self._x: PETSc.Vec
        self._b: PETSc.Vec
        self._half = 0.0
        self._rates: Rates | None = None
        close_at_exit(self)

    def close(self) -> None:
        """Give PETSc's objects back. Collective."""
        if self._ksp is not None:
            for item in (self._ksp, self._shell, self._x, self._b):
                item.destroy()
            self._ksp = None

    def __call__(self, rates: Rates, state: State, dt: float) -> Step:
        """One step; see `mpipic.physics.acoustics.integrators`."""
        self._rates, self._half = rates, 0.5 * dt
        right = state[:, :1] + self._half * rates.density(state, 0).field
        middle = state.copy()
        middle[:, :1] = self._solve(right, state)
        # no cycle of references: what it held would live until a collector comes, at its own time on every rank
        self._rates = None
        middle[:, 1:] = state[:, 1:] + self._half * rates.velocity(middle, 0).field
        rate = rates.both(middle, 1)
        return Step(dt * rate.coefficients, state + dt * rate.field)

    def _solve(self, right: FloatArray, state: State) -> FloatArray:
        assert self._rates is not None
        rates = self._rates
        own = rates.own(right)
        size = rates.size(own)
        if not np.isfinite(size):
            return np.full(right.shape, np.nan)
        ksp = self._solver(rates, own.size)
        with self._b as b:
            np.divide(own, size, out=b)
        with self._x as x:
            np.divide(rates.own(state[:, :1]), size, out=x)
        ksp.solve(self._b, self._x)
        self.iterations = ksp.getIterationNumber()
        if ksp.getConvergedReason() < 0:
            raise NotConverged(
                f"the implicit midpoint rule ended at residual {ksp.getResidualNorm():.3g} after {self.iterations} "
                f"iterations; asked for is {self.tolerance:g} of the right-hand side's norm"
            )
        return rates.spread(self._x.getArray(readonly=True) * size)

    def _solver(self, rates: Rates, own: int) -> PETSc.KSP:
        """The KSP; made anew where the number of unknowns on this rank has changed (particles that migrated)."""
        changed = self._ksp is None or self._b.getLocalSize() != own
        if not rates.any(changed):
            return self._ksp
        self.close()
        comm = rates.comm
        self._shell = PETSc.Mat().createPython(((own, None), (own, None)), _Product(self), comm=comm)
        self._x, self._b = self._shell.createVecs()
        ksp = PETSc.KSP().create(comm)
        ksp.setOptionsPrefix("midpoint_")
        ksp.setType(PETSc.KSP.Type.CG if self.symmetric else PETSc.KSP.Type.GMRES)
        ksp.getPC().setType(PETSc.PC.Type.NONE)
        ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED if self.symmetric else PETSc.KSP.NormType.DEFAULT)
        ksp.setTolerances(rtol=self.tolerance, atol=0.0, divtol=1e100)
        ksp.setInitialGuessNonzero(True)
        ksp.setOperators(self._shell)
        ksp.setFromOptions()
        self._ksp = ksp
        return ksp

    def mult(self, mat: Any, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = (1 - (dt/2)² R U) x, as PETSc calls it. Collective."""
        rates = self._rates
        assert rates is not None
        rho = rates.spread(np.array(x.getArray(readonly=True)))
        state = np.zeros((len(rho), 1 + rates.dim))
        state[:, :1] = rho
        state[:, 1:] = rates.velocity(state, 2).field
        result = rho - self._half**2 * rates.density(state, 2).field
        with y as out:
            out[...] = rates.own(result)

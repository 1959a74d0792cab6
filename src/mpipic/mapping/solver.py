"""Solving with the Gram matrix by PETSc's Krylov methods, all columns together.

Several right-hand sides are one system, I ⊗ G, on vectors that hold one column after the other: an iteration then reads
G once, and exchanges and reduces once, for all of them. Each quantity, a scalar or the components of a vector, is
scaled to about unit norm first, so that none hides behind a larger one.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from math import comb
from typing import NamedTuple

import numpy as np
from petsc4py import PETSc

from mpipic.arrays import FloatArray
from mpipic.errors import NotConverged
from mpipic.kernels import stencil
from mpipic.mapping.base import NodalMapping
from mpipic.mapping.gram_stencil import GramStencil, Penalty
from mpipic.mesh.petsc_objects import close_at_exit
from mpipic.mesh.petsc_options import configure, solve

EARLIER = 2
"""Solutions of a series that the first guess of the next is extrapolated from."""
ENTRIES_NOT_NEEDED = ("none", "jacobi", "python")
"""Preconditioners of PETSc that work without matrix entries."""


class Series:
    """The last EARLIER solutions of one quantity at equally spaced times, (EARLIER, own nodes)."""

    def __init__(self, size: int) -> None:
        self._ring = np.empty((EARLIER, size))
        self.count = 0

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return self._ring.nbytes

    def append(self, values: FloatArray) -> None:
        """Keep the newest, and forget the oldest."""
        self._ring[self.count % EARLIER] = values
        self.count += 1

    def extrapolate(self, factors: FloatArray, factor: float, out: FloatArray) -> None:
        """Return the polynomial through what there is, one step on, times one factor a node and one for all."""
        order = min(self.count, EARLIER)
        weights = np.zeros(EARLIER)
        for j in range(order):
            weights[(self.count - 1 - j) % EARLIER] = (-1) ** j * comb(order, j + 1) * factor
        stencil.extrapolate(self._ring[:order], weights[:order], factors, out)


class _System(NamedTuple):
    """PETSc's objects for one number of columns."""

    ksp: PETSc.KSP
    matrix: PETSc.Mat
    x: PETSc.Vec
    b: PETSc.Vec
    tolerance: float

    def destroy(self) -> None:
        """Give the objects back. Collective."""
        for item in (self.ksp, self.matrix, self.x, self.b):
            item.destroy()


class GramSolver:
    """a = G⁺ b on nodes, to a relative residual, by a PETSc KSP.

    Conjugate gradients with `TensorPreconditioner`, unless PETSc's options with the prefix say otherwise
    (``-filter_ksp_type``, ``-filter_pc_type``, ``-filter_ksp_monitor``, ...). A preconditioner that needs matrix
    entries gets them: the stencil is then assembled as an AIJ matrix, its structure once, its values at every move, and
    columns are solved for one by one.

    Parameters
    ----------
    mapping
        Where G comes from; followed as it moves. Without a penalty, all who solve share its stencil.
    tolerance
        On (r, B r)^½ / (b, B b)^½, r the residual, B the preconditioner: where B is near G⁻¹, that is the relative
        error of Φ a on the particles.
    prefix
        Of the options.
    penalty
        Solve with G and this penalty instead.
    most_iterations : int, optional
        Default: PETSc's 10 000.

    Attributes
    ----------
    iterations : int
        Of the last solve.
    smallest : float
        Smallest Ritz value of B G in the last solve, above its smallest eigenvalue λ, and near it where that one held
        up convergence: what the tolerance is on, divided by λ^½, is the error that Φ a may have.

    Notes
    -----
    Collective. An iteration costs two halo exchanges and two reductions, a solve two or three reductions more. Memory
    per node: the stencil's, and for each column about ten vectors, and EARLIER for each series that it is in.
    """

    def __init__(
        self,
        mapping: NodalMapping,
        tolerance: float,
        prefix: str = "filter_",
        penalty: Penalty | None = None,
        most_iterations: int | None = None,
    ) -> None:
        self.matrix = GramStencil(mapping, penalty) if penalty else mapping.gram.stencil
        self.mapping = mapping  # which a stencil that all share does not keep alive
        self.preconditioner = self.matrix.preconditioner
        self._version = -1
        self.tolerance, self.prefix, self.most_iterations = tolerance, prefix, most_iterations
        self.iterations, self.smallest = 0, np.inf
        self._earlier: dict[Hashable, Series] = {}
        self._systems: dict[int, _System] = {}
        self._entries = PETSc.Options(prefix).getString("pc_type", "python") not in ENTRIES_NOT_NEEDED
        close_at_exit(self, mapping.grid.comm)

    def close(self) -> None:
        """Give PETSc's objects back; no `solve` after this. Collective."""
        for system in self._systems.values():
            system.destroy()

    def forget(self) -> None:
        """Begin every series anew. Local."""
        self._earlier.clear()

    def system(self, columns: int) -> _System:
        """PETSc's objects for so many columns, made when first asked for. Collective."""
        if columns not in self._systems:
            matrix = self.matrix.assembled() if self._entries else self._shell(columns)
            ksp = PETSc.KSP().create(matrix.getComm())
            ksp.setOptionsPrefix(self.prefix)
            ksp.setType(PETSc.KSP.Type.CG)
            ksp.setNormType(PETSc.KSP.NormType.NATURAL)
            ksp.setTolerances(self.tolerance / np.sqrt(columns), 0.0, 1e100, self.most_iterations)
            pc = ksp.getPC()
            pc.setType(PETSc.PC.Type.PYTHON)
            pc.setPythonContext(self.preconditioner)
            ksp.setOperators(matrix)
            configure(ksp, matrix)
            ksp.setComputeSingularValues(_knows_its_spectrum(ksp))
            x, b = matrix.createVecs()
            self._systems[columns] = _System(ksp, matrix, x, b, ksp.getTolerances()[0])
        return self._systems[columns]

    def _shell(self, columns: int) -> PETSc.Mat:
        own = columns * self.matrix.root.size
        matrix = PETSc.Mat().createPython(((own, None), (own, None)), self.matrix, comm=self.matrix.grid.comm)
        matrix.assemble()
        return matrix

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays held, without PETSc's work vectors and a stencil that is the mapping's."""
        series = sum(earlier.nbytes for earlier in self._earlier.values())
        vectors = 8 * 2 * self.matrix.root.size * sum(self._systems)
        own = self.matrix.nbytes if self.matrix.penalty else 0
        return own + self.preconditioner.nbytes + series + vectors

    def solve(
        self,
        sums: FloatArray,
        series: Hashable | None = None,
        quantities: Sequence[int] | None = None,
        sharper: float = 1.0,
    ) -> FloatArray:
        """G⁺ sums, right on own and ghost nodes: (local_nodes,) or (local_nodes, k) to the same.

        Calls with the same `series`, which is not None, are the same at equally spaced times: the first guess is
        extrapolated from the earlier answers. `quantities` are the numbers of columns that make up a quantity, one
        after the other: the tolerance, times `sharper`, is relative to its norm; by default each column is one. Columns
        that are not finite give NaN, and leave others alone.

        Raises
        ------
        NotConverged
        """
        matrix, nodes = self.matrix, self.matrix.grid.nodes
        matrix.refresh()
        if self._version != matrix.version:
            self._version = matrix.version
            self.preconditioner.refresh()
            for system in self._systems.values():
                self._follow(system)
        right = nodes.columns(sums) * matrix.scale
        columns = len(right)
        names = [None if series is None else (series, column) for column in range(columns)]
        self.iterations, self.smallest = 0, np.inf
        if self._entries and columns > 1:
            parts = [self._solve(right[c : c + 1], names[c : c + 1], (1,), sharper) for c in range(columns)]
            answer = np.concatenate(parts)
        else:
            answer = self._solve(right, names, quantities or (1,) * columns, sharper)
        return nodes.nodal(answer).reshape(sums.shape)

    def _follow(self, system: _System) -> None:
        if self._entries:
            self.matrix.assemble(system.matrix)
        else:
            system.matrix.assemble()

    def _solve(
        self, right: FloatArray, series: Sequence[Hashable | None], quantities: Sequence[int], sharper: float
    ) -> FloatArray:
        """Unscaled answers (k, own nodes) to scaled right-hand sides."""
        matrix, system = self.matrix, self.system(len(right))
        system.ksp.setTolerances(rtol=system.tolerance * sharper)
        sizes = matrix.grid.sizes_of(right)
        finite = np.isfinite(sizes)
        right[~finite], sizes[~finite] = 0.0, 1.0
        ends = np.cumsum(quantities)
        for first, end in zip(ends - quantities, ends, strict=True):
            sizes[first:end] = sizes[first:end].max()
        right /= sizes[:, None]
        weights = self._balance(right, quantities)
        with system.b as b:
            np.multiply(right, weights[:, None], out=b.reshape(right.shape))
        earlier = [
            self._earlier.setdefault(name, Series(matrix.root.size)) if name is not None and known else None
            for name, known in zip(series, finite, strict=True)
        ]
        guessed = self._guess(system.x, earlier, sizes, weights)
        system.ksp.setInitialGuessNonzero(guessed)
        solve(system.ksp, system.b, system.x)
        if guessed and system.ksp.getConvergedReason() < 0:
            # a guess far off, on a matrix near singular, leaves rounding of its own size behind
            system.ksp.setInitialGuessNonzero(False)
            solve(system.ksp, system.b, system.x)
        self._note(system.ksp)
        answer: FloatArray = system.x.getArray(readonly=True).reshape(right.shape) * matrix.scale
        answer /= weights[:, None]
        answer *= sizes[:, None]
        for row, known in zip(answer, earlier, strict=True):
            if known is not None:
                known.append(row)
        answer[~finite] = np.nan
        return answer

    def _balance(self, right: FloatArray, quantities: Sequence[int]) -> FloatArray:
        """Powers of two that bring quantities of size 1 to norm 1, so that all weigh alike, by column. Collective."""
        weights = np.ones(len(quantities))
        if len(quantities) > 1:
            squares = self.matrix.grid.reduce(np.sum(right**2, axis=1))
            squares = np.add.reduceat(squares, np.cumsum([0, *quantities[:-1]]))
            weights[squares > 0.0] = np.exp2(-np.rint(0.5 * np.log2(squares[squares > 0.0])))
        return np.repeat(weights, quantities)

    def _guess(self, x: PETSc.Vec, earlier: list[Series | None], sizes: FloatArray, weights: FloatArray) -> bool:
        """Put into x what the series lead to; whether there is any. Collective if there are series."""
        if not any(earlier):
            return False
        grid, root, guessed = self.matrix.grid, self.matrix.root, False
        with x as values:
            rows = values.reshape(len(earlier), -1)
            rows[...] = 0.0
            for row, known, size, weight in zip(rows, earlier, sizes, weights, strict=True):
                if known is not None:
                    known.extrapolate(root, weight / size, row)
            # rounding of G times the guess must stay below the residual asked for
            rounding = 8.0 * float(np.finfo(float).eps) * grid.sizes_of(rows) / weights
            for row, known, noise in zip(rows, earlier, rounding, strict=True):
                if known is not None and not noise <= self.tolerance:
                    known.count = 0
                    row[:] = 0.0
                guessed = guessed or (known is not None and known.count > 0)
        return guessed

    def _note(self, ksp: PETSc.KSP) -> None:
        """Keep what a solve found out, or raise NotConverged."""
        self.iterations = max(self.iterations, int(ksp.getIterationNumber()))
        if _knows_its_spectrum(ksp):
            largest, smallest = ksp.computeExtremeSingularValues()
            if largest > 0.0:  # not without an iteration
                self.smallest = min(self.smallest, float(smallest))
        if ksp.getConvergedReason() < 0:
            reasons = {
                value: name for name, value in vars(PETSc.KSP.ConvergedReason).items() if name.startswith("DIVERGED")
            }
            why = reasons.get(ksp.getConvergedReason(), str(ksp.getConvergedReason()))
            raise NotConverged(
                f"solving with the Gram matrix ended at residual {ksp.getResidualNorm():.3g} after "
                f"{ksp.getIterationNumber()} iterations ({why.lower()}); asked for is {self.tolerance:g} of the "
                "right-hand side's norm"
            )


def _knows_its_spectrum(ksp: PETSc.KSP) -> bool:
    """Return whether PETSc can be asked for Ritz values: of other methods some crash (fcg of PETSc 3.18)."""
    return bool(ksp.getType() == PETSc.KSP.Type.CG)

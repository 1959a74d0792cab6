"""Solving with the Gram matrix G = ΦᵀΦ: a stencil on nodes, PETSc's Krylov solvers, and a preconditioner for it.

G is scaled to unit diagonal: with r = sqrt(diag G) the unknown is y = r a in (r⁻¹ G r⁻¹) y = r⁻¹ b. For nodes that no
particle sees it reads y = 0, and they get a = 0.

The preconditioner is made of one short symmetric stencil per axis. On a lattice the scaled G is the tensor product of
one-dimensional circulant matrices; on other patterns it resembles that, with the mean over nodes of the entries along
the axis as theirs. The inverse of each is approximated by a stencil of a few nodes. It is positive definite, the same
on any number of ranks, and needs one halo exchange. Which scaling brings G closest to a tensor product depends on the
basis: diag(G) on the linear one (a node whose particles are all far from it has a smaller diagonal than its row sum
says), halfway to the row sums on the cubic one (`TILT`).
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from math import comb
from typing import Any, Protocol

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from mpipic.errors import NotConverged
from mpipic.grid import FloatArray, Grid
from mpipic.halo import Halo
from mpipic.kernels import stencil
from mpipic.petsc_objects import close_at_exit

REACH = {1: 2, 2: 5, 3: 8}
"""Degree of the splines to the nodes either side that the preconditioner's stencil along an axis takes."""
TILT = {1: 0.0, 2: 0.25, 3: 0.6}
"""Degree to the exponent t of the preconditioner's scaling, diag(G)^(1 - t) diag(d)^t."""
EARLIER = 2
"""Solutions of a series that the first guess of the next is extrapolated from."""
SHIFT = 1e-15
"""Added to the unit diagonal: where rounding alone decides whether G is singular, this much decides that it is not."""
ENTRIES_NOT_NEEDED = ("none", "jacobi", "python")
"""Preconditioners of PETSc that work without matrix entries."""


class GramMatrix(Protocol):
    """What the solver needs of a mapping."""

    grid: Grid
    weights: FloatArray
    version: int
    """Counts changes of positions."""

    def add_gram_entries(self, layout: tuple[int, int, int], entries: FloatArray) -> None:
        """entries += half of G's diagonals (see `kernels.stencil`), ghosts not yet added to their owners. Local."""
        ...


@dataclass(frozen=True)
class Penalty:
    """Roughness penalty of P-splines, ε n̄ Σ_a Δ_sᵀ Δ_s / 4^s: Δ_s the s-th difference along an axis, n̄ = Σ d / m.

    Smooth fields pass; waves that no particle sees are set by their neighbours, so that G with it is positive definite
    on every pattern, unless all particles sit at too few places to tell polynomials of degree s - 1 apart.
    """

    strength: float
    order: int

    def couplings(self) -> FloatArray:
        """(s + 1,) coefficients of the stencil along one axis, the middle one first; largest symbol 1."""
        s = self.order
        return self.strength * np.array([(-1.0) ** j * comb(2 * s, s + j) for j in range(s + 1)]) / 4.0**s


class GramStencil:
    """G at the mapping's positions, scaled to unit diagonal; a PETSc shell matrix on own nodes, x fastest.

    Parameters
    ----------
    mapping
        Where G comes from.
    penalty
        Added to G.

    Attributes
    ----------
    root, scale : (own nodes,)
        r and 1/r, both 0 on nodes that no particle sees.
    unseen
        Indices of those nodes.

    Notes
    -----
    Memory per node: 8 bytes for each of ((2 k + 1)^d + 1) / 2 diagonals on splines of degree k, and 4 vectors.
    `refresh` is collective: two halo exchanges per diagonal; `mult` one.
    """

    def __init__(self, mapping: GramMatrix, penalty: Penalty | None = None) -> None:
        grid = mapping.grid
        self.mapping, self.grid, self.penalty = mapping, grid, penalty
        self.reach = max(grid.degree, penalty.order if penalty else 0)
        self.halo = Halo(grid.comm, grid.cells, grid.starts, self.reach)
        steps = np.array([1, *self.halo.layout[1:]])
        self.shape = grid.padded_shape
        half = stencil.half_stencil(grid.dim, grid.degree)
        beyond = [[j * (a == axis) for a in range(3)] for axis in range(grid.dim) for j in range(1, self.reach + 1)]
        self.neighbours = np.array([*half.tolist(), *(row for row in beyond if max(row) > grid.degree)])
        self.offsets = self.neighbours @ steps
        self.entries = np.zeros((len(self.offsets), self.halo.local_nodes))
        self.values, self._product = np.zeros((2, self.halo.local_nodes))
        last = np.array(self.shape) - 1
        self._span = (self.halo.layout[0], self.halo.layout[0] + int(last @ steps) + 1)
        self.root, self.scale = np.empty(grid.local_cells), np.empty(grid.local_cells)
        self.version = -1

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays held."""
        return sum(a.nbytes for a in (self.entries, self.values, self._product, self.root, self.scale))

    def refresh(self) -> bool:
        """Follow the mapping to its present positions; False if it has not moved. Collective."""
        if self.version == self.mapping.version:
            return False
        self.version = self.mapping.version
        halo, rows = self.halo, tuple(self.entries)
        self.entries.fill(0.0)
        self.mapping.add_gram_entries(halo.layout, self.entries)
        halo.add(*rows)
        if self.penalty is not None:
            self._add_penalty(self.penalty)
        root, scale = np.empty((2, halo.local_nodes))
        halo.fill(rows[0])
        stencil.root_and_scale(rows[0], root, scale)
        self.root[:], self.scale[:] = halo.own(root).ravel(), halo.own(scale).ravel()
        self.unseen = np.flatnonzero(self.root == 0.0)
        stencil.scale_entries(self.entries, self.offsets, scale, self.shape, halo.layout)
        halo.fill(*rows)
        return True

    def _add_penalty(self, penalty: Penalty) -> None:
        """Collective; one reduction."""
        total = self.grid.reduce(np.array([self.grid.owned(self.mapping.weights).sum()]))[0]
        couplings = penalty.couplings() * (total / self.grid.node_count)
        halo = self.halo
        halo.own(self.entries[0])[...] += self.grid.dim * couplings[0]
        for axis in range(self.grid.dim):
            for j, h in enumerate(self._along(axis), start=1):
                if j <= penalty.order:
                    halo.own(self.entries[h])[...] += couplings[j]

    def _along(self, axis: int) -> list[int]:
        """Numbers of the diagonals to the next, second, ... node along an axis."""
        order = [tuple(j * (a == axis) for a in range(3)) for j in range(1, self.reach + 1)]
        number = {tuple(offset): h for h, offset in enumerate(self.neighbours.tolist())}
        return [number[offset] for offset in order]

    def load(self, own: FloatArray) -> FloatArray:
        """A padded copy of own values, ghosts filled. Collective."""
        block = self.halo.own(self.values)
        block[...] = own.reshape(block.shape)
        self.halo.fill(self.values)
        return self.values

    def mult(self, mat: Any, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = G x, as PETSc calls it. Collective; one halo exchange."""
        values = self.load(x.getArray(readonly=True))
        stencil.multiply(self.entries, self.offsets, 1.0 + SHIFT, values, *self._span, self._product)
        product = self.halo.own(self._product)
        with y as out:
            out.reshape(product.shape)[...] = product

    def getDiagonal(self, mat: Any, y: PETSc.Vec) -> None:
        """The diagonal: ones. Local."""
        y.set(1.0)

    def axis_means(self, tilt: FloatArray | None) -> FloatArray:
        """Mean over nodes of the entries to the next nodes along each axis, relative to the diagonal's, (d, reach).

        tilt : padded factors, one a node, that rows and columns are multiplied with before. Collective.
        """
        halo, rows = self.halo, [0, *(h for axis in range(self.grid.dim) for h in self._along(axis))]
        sums = np.empty(len(rows))
        for place, h in enumerate(rows):
            entries = self.entries[h]
            if tilt is not None:
                entries = entries * tilt * np.roll(tilt, -self.offsets[h])
            sums[place] = halo.own(entries).sum()
        self.grid.reduce(sums)
        return np.asarray(sums[1:] / (sums[0] or 1.0)).reshape(self.grid.dim, self.reach)

    def assemble(self, matrix: PETSc.Mat) -> None:
        """Put the entries into an assembled matrix. Collective."""
        halo = self.halo
        own = halo.own(np.arange(halo.local_nodes)).ravel()
        number = np.full(halo.local_nodes, -1.0)
        first = matrix.getOwnershipRange()[0]
        halo.own(number)[...] = (first + np.arange(own.size)).reshape(halo.own(number).shape)
        halo.fill(number)
        columns = [own] + [own + o for o in self.offsets[1:]] + [own - o for o in self.offsets[1:]]
        entries = [np.full(own.size, 1.0 + SHIFT)]
        entries += [self.entries[h, own] for h in range(1, len(self.offsets))]
        entries += [self.entries[h, own - self.offsets[h]] for h in range(1, len(self.offsets))]
        starts = np.arange(own.size + 1) * len(columns)
        column = number[np.stack(columns, axis=1).ravel()]
        matrix.zeroEntries()
        matrix.setValuesIJV(
            starts.astype(PETSc.IntType), column.astype(PETSc.IntType), np.stack(entries, axis=1).ravel(),
            addv=PETSc.InsertMode.ADD_VALUES,
        )  # fmt: skip
        matrix.assemble()


def inverse_stencil(couplings: FloatArray, reach: int) -> FloatArray:
    """Weights (reach + 1,) of the symmetric stencil near the inverse of the circulant (..., c₂, c₁, 1, c₁, c₂, ...).

    With the symbol λ(θ) = 1 + 2 Σ_j c_j cos jθ it is the stencil g that makes 1 - λ g least in the mean square over θ;
    a symbol that comes near 0 is held above 0.02 of its largest value, and g above 0, so that the stencil is positive
    definite whatever the couplings are. Local.
    """
    theta = np.linspace(0.0, np.pi, 129)
    cosines = np.cos(theta[:, None] * np.arange(max(reach, len(couplings)) + 1))
    cosines[:, 1:] *= 2.0
    symbol = cosines[:, : len(couplings) + 1] @ np.concatenate([[1.0], couplings])
    symbol = np.maximum(symbol, 0.02 * symbol.max())
    basis = cosines[:, : reach + 1]
    ends = np.where((theta == 0.0) | (theta == np.pi), np.sqrt(0.5), 1.0)  # the trapezoidal rule over a period
    weights = np.asarray(np.linalg.lstsq((ends * symbol)[:, None] * basis, ends, rcond=None)[0])
    least = 0.1 / symbol.max()
    weights[0] += max(0.0, least - float((basis @ weights).min()))
    return weights


class TensorPreconditioner:
    """One short stencil per axis, all applied in one pass; a PETSc shell preconditioner.

    Notes
    -----
    `refresh` is collective, one reduction; `apply` too, one halo exchange.
    """

    def __init__(self, matrix: GramStencil) -> None:
        self.matrix = matrix
        grid, self._reach = matrix.grid, REACH[matrix.grid.degree]
        self.halo = Halo(grid.comm, grid.cells, grid.starts, self._reach)
        self._values = np.zeros(self.halo.local_nodes)
        shape = self.halo.ghost_shape
        self._plane, self._line = np.empty(int(np.prod(shape[:2]))), np.empty(shape[0])
        self.weights = np.eye(1, self._reach + 1).repeat(3, axis=0)
        self._tilt: FloatArray | None = None

    def refresh(self) -> None:
        """Take scaling and couplings of the matrix as it is now."""
        matrix, tilt = self.matrix, TILT[self.matrix.grid.degree]
        padded = None
        if tilt and matrix.penalty is None:
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = matrix.root**2 / matrix.grid.nodes.own(matrix.mapping.weights).ravel()
            self._tilt = np.where(matrix.root > 0.0, ratio, 0.0) ** (0.5 * tilt)
            padded = matrix.load(self._tilt).copy()
        for axis, couplings in enumerate(matrix.axis_means(padded)):
            self.weights[axis] = inverse_stencil(couplings, self._reach)

    def apply(self, pc: Any, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = the stencils times x, as PETSc calls it."""
        matrix = self.matrix
        own = x.getArray(readonly=True)
        block = self.halo.own(self._values)
        block[...] = (own if self._tilt is None else own * self._tilt).reshape(block.shape)
        self.halo.fill(self._values)
        with y as out:
            stencil.convolve(
                self._values, self.weights, matrix.shape, self.halo.layout, self._plane, self._line, out
            )  # fmt: skip
            if self._tilt is not None:
                out *= self._tilt
            out[matrix.unseen] = 0.0


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
        """The polynomial through what there is, one step on, times one factor a node and one for all."""
        order = min(self.count, EARLIER)
        weights = np.zeros(EARLIER)
        for j in range(order):
            weights[(self.count - 1 - j) % EARLIER] = (-1) ** j * comb(order, j + 1) * factor
        stencil.extrapolate(self._ring[:order], weights[:order], factors, out)


class GramSolver:
    """a = G⁺ b on nodes, to a relative residual, by a PETSc KSP.

    Conjugate gradients with `TensorPreconditioner`, unless PETSc's options with the prefix say otherwise
    (``-filter_ksp_type``, ``-filter_pc_type``, ``-filter_ksp_monitor``, ...). A preconditioner that needs matrix
    entries gets them: the stencil is then assembled as an AIJ matrix, its structure once, its values at every move.

    Parameters
    ----------
    mapping
        Where G comes from; followed as it moves.
    tolerance
        On (r, B r)^½ / (b, B b)^½, r the residual, B the preconditioner: where B is near G⁻¹, that is the relative
        error of Φ a on the particles.
    prefix
        Of the options.
    penalty
        Solve with G and this penalty instead.

    Attributes
    ----------
    iterations : int
        Of the last solve.

    Notes
    -----
    Collective. An iteration costs two halo exchanges and two reductions, a solve two reductions more. Memory per node:
    the stencil's, about ten vectors, and EARLIER vectors for each column of each series.
    """

    def __init__(
        self, mapping: GramMatrix, tolerance: float, prefix: str = "filter_", penalty: Penalty | None = None
    ) -> None:
        self.matrix = GramStencil(mapping, penalty)
        self.preconditioner = TensorPreconditioner(self.matrix)
        self.tolerance, self.iterations = tolerance, 0
        self._earlier: dict[Hashable, Series] = {}
        comm, own = mapping.grid.comm, self.matrix.root.size
        self._shell = PETSc.Mat().createPython(((own, None), (own, None)), self.matrix, comm=comm)
        self._assembled: PETSc.Mat | None = None
        self._ksp = self._configure(comm, prefix)
        self._x, self._b = self._shell.createVecs()
        close_at_exit(self)

    def close(self) -> None:
        """Give PETSc's objects back; no `solve` after this. Collective."""
        for item in (self._ksp, self._shell, self._x, self._b):
            item.destroy()

    def forget(self) -> None:
        """Begin every series anew. Local."""
        self._earlier.clear()

    def _configure(self, comm: MPI.Comm, prefix: str) -> PETSc.KSP:
        ksp = PETSc.KSP().create(comm)
        ksp.setOptionsPrefix(prefix)
        ksp.setType(PETSc.KSP.Type.CG)
        ksp.setNormType(PETSc.KSP.NormType.NATURAL)
        ksp.setTolerances(rtol=self.tolerance, atol=0.0, divtol=1e100)
        pc = ksp.getPC()
        pc.setType(PETSc.PC.Type.PYTHON)
        pc.setPythonContext(self.preconditioner)
        chosen = PETSc.Options(prefix).getString("pc_type", "python")
        if chosen not in ENTRIES_NOT_NEEDED:
            self._assembled = self._structure(comm)
        ksp.setOperators(self._shell if self._assembled is None else self._assembled)
        ksp.setFromOptions()
        return ksp

    def _structure(self, comm: MPI.Comm) -> PETSc.Mat:
        own, row = self.matrix.root.size, 2 * len(self.matrix.offsets) - 1
        matrix = PETSc.Mat().createAIJ(((own, None), (own, None)), nnz=row, comm=comm)
        matrix.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)
        matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        return matrix

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays held, without PETSc's work vectors."""
        series = sum(earlier.nbytes for earlier in self._earlier.values())
        return self.matrix.nbytes + series + 8 * 2 * self.matrix.root.size

    def solve(self, sums: FloatArray, series: Hashable | None = None) -> FloatArray:
        """G⁺ sums, right on own and ghost nodes: (local_nodes,) to (local_nodes,).

        Calls with the same `series`, which is not None, are one quantity at equally spaced times: the first guess is
        extrapolated from the earlier answers. Sums that are not finite give NaN.

        Raises
        ------
        NotConverged
        """
        matrix, nodes = self.matrix, self.matrix.grid.nodes
        if matrix.refresh():
            self._refresh()
        block = nodes.own(sums)
        right = (block * matrix.scale.reshape(block.shape)).ravel()
        size = matrix.grid.size_of(right)
        out = np.zeros(nodes.local_nodes)
        if not np.isfinite(size):
            out.fill(np.nan)
        else:
            earlier = self._earlier.setdefault(series, Series(right.size)) if series is not None else None
            answer = self._solve(right, size, earlier)
            if earlier is not None:
                earlier.append(answer)
            nodes.own(out)[...] = answer.reshape(block.shape)
        nodes.fill(out)
        return out

    def _refresh(self) -> None:
        self.preconditioner.refresh()
        self._shell.assemble()
        if self._assembled is not None:
            self.matrix.assemble(self._assembled)

    def _solve(self, right: FloatArray, size: float, earlier: Series | None) -> FloatArray:
        """Unscaled answer on own nodes to the scaled right-hand side."""
        matrix = self.matrix
        with self._b as b:
            np.divide(right, size, out=b)
        with self._x as x:
            if earlier is not None:
                earlier.extrapolate(matrix.root, 1.0 / size, x)
        guessed = earlier is not None and earlier.count > 0
        if guessed:
            # rounding of G times the guess must stay below the residual asked for
            rounding = 8.0 * float(np.finfo(float).eps) * matrix.grid.size_of(self._x.getArray(readonly=True))
            guessed = rounding <= self.tolerance
        if earlier is not None and not guessed:
            earlier.count = 0
        self._ksp.setInitialGuessNonzero(guessed)
        self._ksp.solve(self._b, self._x)
        if guessed and self._ksp.getConvergedReason() < 0:
            # a guess far off, on a matrix near singular, leaves rounding of its own size behind
            self._ksp.setInitialGuessNonzero(False)
            self._ksp.solve(self._b, self._x)
        self._check()
        answer = self._x.getArray(readonly=True) * matrix.scale
        answer *= size
        return np.asarray(answer)

    def _check(self) -> None:
        ksp = self._ksp
        self.iterations = ksp.getIterationNumber()
        if ksp.getConvergedReason() < 0:
            reasons = {
                value: name for name, value in vars(PETSc.KSP.ConvergedReason).items() if name.startswith("DIVERGED")
            }
            why = reasons.get(ksp.getConvergedReason(), str(ksp.getConvergedReason()))
            raise NotConverged(
                f"solving with the Gram matrix ended at residual {ksp.getResidualNorm():.3g} after {self.iterations} "
                f"iterations ({why.lower()}); asked for is {self.tolerance:g} of the right-hand side's norm"
            )

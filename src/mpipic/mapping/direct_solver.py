"""Solving with a Gram matrix that is nearly singular: a factorisation, refined by passes over the particles.

On particles that cover only part of their cells, or are few, some combinations of nodes are hardly seen by any. With
D = diag(G)^-½ they are the small singular values σ of V^½ΦD. G has their squares: a product with its rounded entries
is known to ε/σ² of what it means on the particles (ε the spacing of floating-point numbers), and conjugate gradients
take long to find them. Here

    a ← a + D A⁻¹ D (b - ΦᵀVΦ a),    A = DGD + s,    b = ΦᵀVq,

with A factorised and the product made by passes over the particles: ε/σ, as good as any method that knows Φ to
rounding, in a few rounds, each of which leaves s / (σ² + s) of the error. Directions that no particle sees (σ = 0)
take no part: what rounding puts there, no particle sees.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from petsc4py import PETSc

from mpipic.arrays import FloatArray
from mpipic.errors import NotConverged
from mpipic.mapping.base import NodalMapping
from mpipic.mesh.petsc_objects import close_at_exit

SHIFTS = (1e-14, 1e-13, 1e-12)
"""s, the next where rounding of G's entries leaves A with the first not positive definite."""
ROUNDING = 2.0 * float(np.finfo(float).eps)
"""The projection is known to this divided by σ."""
LEAST = 1e-7
"""The refinement is slow on σ below sqrt(s)."""
UNSEEN = 1e-13
"""σ below is rounding of 0."""
MOST_ROUNDS = 100
FEW_ROUNDS = 12
"""Refinement goes on for so long where some directions are not determined: what is left of those is damped."""
JUDGED_EVERY = 16
"""One in so many positions is judged where they need not be determined."""
MOST_NODES = {1: 1_000_000, 2: 100_000, 3: 20_000}
"""Dimension to nodes that particles see: with more, factorising takes longer than some seconds on cubic splines."""
DOUBT = 1000.0
"""A random vector has less than one part in this of the root of its norm along a given direction once in a thousand."""


class DirectSolver:
    """a with Φ a = P q from b = ΦᵀVq, by a factorised G and passes over the particles.

    Parameters
    ----------
    mapping
        Where G and Φ come from; followed as it moves.
    tolerance
        On ‖Φ a - P q‖ / ‖P q‖.

    Attributes
    ----------
    iterations : int
        Rounds of the last solve.
    uncertainty : float
        Largest uncertainty of P that was found at positions that do not determine it to the tolerance; 0 if none.

    Notes
    -----
    Collective. Factorised anew whenever positions have changed: by CHOLMOD on one rank, MUMPS on several. A round
    costs a solve with the factors, a pass to the particles and one back. Memory is the factors', O(m) in 1D, O(m log m)
    in 2D, O(m^(4/3)) in 3D.
    """

    def __init__(self, mapping: NodalMapping, tolerance: float) -> None:
        self.mapping, self.tolerance = mapping, tolerance
        self.matrix = mapping.gram.stencil
        self.needed = max(ROUNDING / tolerance, LEAST)
        self.iterations, self.uncertainty = 0, 0.0
        self._version, self._nodes, self._shift = -1, 0, SHIFTS[0]
        self._moves, self._least = 0, np.nan
        self._owned: tuple[PETSc.Object, ...] = ()
        close_at_exit(self, mapping.grid.comm)

    def close(self) -> None:
        """Give PETSc's objects back. Collective; may be called twice."""
        for item in self._owned:
            item.destroy()
        self._owned = ()

    @property
    def fits(self) -> bool:
        """Whether so few nodes are seen that factorising is bearable. Collective; at most one reduction."""
        grid = self.matrix.grid
        most = MOST_NODES[grid.dim]
        return grid.node_count <= most or self._seen_nodes() <= most

    def _seen_nodes(self) -> int:
        self.matrix.refresh()
        return int(self.matrix.grid.reduce(np.array([float(np.count_nonzero(self.matrix.root))]))[0])

    def solve(self, sums: FloatArray, strict: bool = True) -> FloatArray:
        """Return a, right on own and ghost nodes: (local_nodes, *shape) to the same. Collective.

        Columns that are not finite give NaN, and leave others alone. If not `strict`, directions that are not
        determined are kept in part: the operator is symmetric, with eigenvalues in [0, 1], all the same.

        Raises
        ------
        NotConverged
            If `strict`: the projection is not determined to the tolerance at these positions; says to how much it is.
        """
        self._follow(strict)
        matrix, nodes = self.matrix, self.matrix.grid.nodes
        right = nodes.columns(sums) * matrix.scale
        sizes = matrix.grid.sizes_of(right)
        finite = np.isfinite(sizes)
        right[~finite], sizes[~finite] = 0.0, 1.0
        answer = self._refine(right / sizes[:, None], MOST_ROUNDS if strict else FEW_ROUNDS)
        answer *= matrix.scale * sizes[:, None]
        answer[~finite] = np.nan
        return nodes.nodal(answer).reshape(sums.shape)

    def _refine(self, residual: FloatArray, most: int) -> FloatArray:
        """Return the scaled answers (k, own nodes) to scaled right-hand sides, which are overwritten. Collective."""
        answer, first = np.zeros_like(residual), np.zeros(len(residual))
        left = self._shift / self.needed**2  # of a round's change is what later rounds may change, at most
        for self.iterations in range(1, most + 1):
            change = self._solve_factorised(residual)
            answer += change
            seen, sizes = self._seen(change)
            first = sizes if self.iterations == 1 else first
            if np.all(left * sizes <= self.tolerance * first):
                return answer
            residual -= self._sums(seen)
        if most < MOST_ROUNDS:
            return answer
        raise NotConverged(
            f"solving with the factorised Gram matrix left changes of {np.max(sizes / first):.3g} after "
            f"{MOST_ROUNDS} rounds; asked for is {self.tolerance:g}"
        )

    def _seen(self, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return Φ D columns, (n, k), and its norms (k,), weighted. Collective; one reduction."""
        matrix = self.matrix
        seen = self.mapping.g2p(matrix.grid.nodes.nodal(columns * matrix.scale))
        weighted = seen if self.mapping.weight is None else seen * self.mapping.weight[:, None]
        return seen, np.sqrt(matrix.grid.reduce(np.einsum("nk,nk->k", seen, weighted)))

    def _sums(self, seen: FloatArray) -> FloatArray:
        """Return D ΦᵀV seen, (k, own nodes). Collective."""
        sums = self.matrix.grid.nodes.columns(self.mapping.sums(seen)) * self.matrix.scale
        self.mapping.phase("filter")
        return sums

    # ------------------------------------------------------------ factors

    def _follow(self, strict: bool) -> None:
        """Factorise G at the mapping's present positions, and judge it, if not `strict`, now and then. Collective."""
        if self._version != self.mapping.version:
            self._version = -1
            self._nodes, self._least = self._seen_nodes(), np.nan
            self._factorise()
            self._version, self._moves = self.mapping.version, self._moves + 1
        if np.isnan(self._least) and (strict or self._moves % JUDGED_EVERY == 1):
            self._least = self._smallest()
        if self._least < self.needed:
            self.uncertainty = max(self.uncertainty, ROUNDING / self._least)
            if strict:
                raise NotConverged(self._undetermined())

    def _factorise(self) -> None:
        for self._shift in SHIFTS:
            self.close()
            matrix = self.matrix.assembled(sparse=True)
            matrix.shift(self._shift)
            matrix.setOption(PETSc.Mat.Option.SPD, True)
            x, b = matrix.createVecs()
            ksp = PETSc.KSP().create(matrix.getComm())
            self._owned = (ksp, x, b, matrix)
            ksp.setType(PETSc.KSP.Type.PREONLY)
            ksp.getPC().setType(PETSc.PC.Type.CHOLESKY)
            alone = matrix.getComm().size == 1
            ksp.getPC().setFactorSolverType(PETSc.Mat.SolverType.CHOLMOD if alone else PETSc.Mat.SolverType.MUMPS)
            ksp.setOperators(matrix)
            b.set(1.0)
            ksp.solve(b, x)
            if ksp.getConvergedReason() > 0:
                return
        raise NotConverged(f"the Gram matrix has no Cholesky factors, not even with {SHIFTS[-1]:g} added to it")

    def _solve_factorised(self, columns: FloatArray) -> FloatArray:
        """Return A⁻¹ columns, (k, own nodes). Collective."""
        ksp, x, b, _ = self._owned
        out = np.empty_like(columns)
        for column, into in zip(columns, out, strict=True):
            with b as values:
                values[:] = column
            ksp.solve(b, x)
            into[:] = x.getArray(readonly=True)
        return out

    # ------------------------------------------------------------ condition

    def _smallest(self) -> float:
        """Return about the smallest σ that is not 0, if it may be below what is needed, else infinity. Collective.

        A random vector times A⁻¹ shows whether anything is small at all. If so, 1 - A⁻¹G, which is s / (σ² + s), takes
        from it all but what has σ² below s, and the size of the rest on the particles tells hardly seen from unseen;
        A⁻¹GA⁻¹, which is σ² / (σ² + s)², has its largest eigenvalues where σ is small but not 0, and a few powers show
        them.
        """
        random = np.random.default_rng(self.matrix.grid.rank).standard_normal((1, self.matrix.root.size))
        start = np.where(self.matrix.root > 0.0, random, 0.0)
        change = self._solve_factorised(start)
        if DOUBT * sqrt(self._nodes) * self._norm(change) * self.needed**2 < self._norm(start):
            return np.inf
        least = self._of_inverse(start)
        if least < self.needed and least > 4.0 * LEAST:
            return least
        return min(self._of_unseen(change) or np.inf, least)

    def _of_unseen(self, columns: FloatArray) -> float:
        """Return the size on the particles of (1 - A⁻¹G)^k columns, relative to its own, once k changes little.

        G by passes, k ≤ 12; 0 where what is left is rounding. Collective.
        """
        before = np.inf
        for _ in range(12):
            columns = columns / self._norm(columns)
            seen, sizes = self._seen(columns)
            size = float(sizes[0])
            if size < UNSEEN:
                return 0.0
            if size > 0.5 * before:
                break
            before = size
            columns = columns - self._solve_factorised(self._sums(seen))
        return size

    def _of_inverse(self, columns: FloatArray) -> float:
        """Return σ from the largest σ / (σ² + s), by three powers from columns. Collective."""
        largest = 0.0
        for _ in range(3):
            size = self._norm(columns)
            if size == 0.0:
                return np.inf
            seen, sizes = self._seen(self._solve_factorised(columns / size))
            largest = float(sizes[0])
            columns = self._solve_factorised(self._sums(seen))
        return (1.0 + sqrt(max(0.0, 1.0 - 4.0 * self._shift * largest**2))) / (2.0 * largest) if largest else np.inf

    def _norm(self, columns: FloatArray) -> float:
        return float(np.sqrt(self.matrix.grid.reduce(np.array([np.sum(columns**2)]))[0]))

    def _undetermined(self) -> str:
        least, known = self._least, ROUNDING / self._least
        ask = f"filter.tolerance = {2.0 * known:.1g}, " if least > 2.0 * LEAST else ""
        return (
            f"particles determine some nodes hardly (smallest singular value of the scaled mapping {least:.1g}), so "
            f"that rounding leaves the projection uncertain by {known:.1g}, and the tolerance is {self.tolerance:g}; "
            f'{ask}a basis of lower degree or more particles help, or filter.kind = "order" or "chebyshev", which '
            "solve nothing"
        )

"""Coefficients of the orthogonal projection on what nodes see, whatever the cloud: by whichever solver gets there.

Conjugate gradients take some ten iterations on particles that fill their cells. Their smallest Ritz value tells
whether the error is what the residual says; where it is not, or they do not converge, the Gram matrix is factorised
(see `mapping.direct_solver`), or, where it is too large for that, they go on to a smaller residual.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from functools import cached_property

import numpy as np

from mpipic.arrays import FloatArray
from mpipic.errors import NotConverged
from mpipic.mapping.base import NodalMapping
from mpipic.mapping.direct_solver import ROUNDING, DirectSolver
from mpipic.mapping.solver import GramSolver
from mpipic.mesh.petsc_options import given

ERROR = 10.0
"""The error may be so many times the tolerance."""
MOST_ITERATIONS = 300
"""Conjugate gradients may take so many where factorising is possible: twice what they do where they can be trusted."""
PATIENCE = (8, 64)
"""Positions that the factorisation is kept for before conjugate gradients are tried again, at first and at most."""


class Projection:
    """a = G⁺ b with Φ a = P q, from b = ΦᵀVq, to ten times a tolerance of ‖P q‖, or an error.

    Parameters
    ----------
    mapping
        Where Φ comes from; followed as it moves.
    tolerance
        Of the relative residual of conjugate gradients.
    prefix
        Of their options. Where there are any, a user has chosen how to solve: their word alone counts then, and the
        tolerance is on the residual.

    Attributes
    ----------
    iterations : int
        Of the last solve: of conjugate gradients, or rounds of refinement.
    factorised : bool
        Whether the last solve was by factors.

    Notes
    -----
    Collective, as `GramSolver` and `DirectSolver`.
    """

    def __init__(self, mapping: NodalMapping, tolerance: float, prefix: str = "filter_") -> None:
        self.mapping, self.tolerance, self.prefix = mapping, tolerance, prefix
        self.iterations, self.factorised = 0, False
        self._patience, self._again = PATIENCE[0], -1
        self._sharper, self._uncertainty = 1.0, 0.0

    @cached_property
    def krylov(self) -> GramSolver:
        """Conjugate gradients."""
        most = MOST_ITERATIONS if not self._chosen and self.direct.fits else None
        return GramSolver(self.mapping, self.tolerance, self.prefix, most_iterations=most)

    @cached_property
    def direct(self) -> DirectSolver:
        """The factorised matrix, which is not factorised before it is used."""
        return DirectSolver(self.mapping, self.tolerance)

    def forget(self) -> None:
        """Begin every series anew. Local."""
        self.krylov.forget()
        self._patience, self._again, self._sharper = PATIENCE[0], -1, 1.0

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays, without PETSc's vectors and factors."""
        return self.krylov.nbytes

    def solve(
        self,
        sums: FloatArray,
        series: Hashable | None = None,
        quantities: Sequence[int] | None = None,
        strict: bool = True,
    ) -> FloatArray:
        """Return a, right on own and ghost nodes: (local_nodes, *shape) to the same; see `GramSolver.solve`.

        If not `strict`, what particles do not determine to the tolerance is damped; see `DirectSolver.solve`.

        Raises
        ------
        NotConverged
            Neither way leads to the tolerance; says why.
        """
        if self._chosen:
            self.factorised, answer = False, self.krylov.solve(sums, series, quantities)
            self.iterations = self.krylov.iterations
            return answer
        if self.mapping.version >= self._again:
            found = self._by_iteration(sums, series, quantities, strict)
            if found is not None:
                return found
        return self._by_factors(sums, strict)

    @cached_property
    def _chosen(self) -> bool:
        """Whether the user's options say how to solve."""
        return bool(given(self.prefix))

    @property
    def uncertainty(self) -> float:
        """Largest uncertainty of P that was found; see `DirectSolver`."""
        return max(self._uncertainty, self.direct.uncertainty)

    def _by_iteration(
        self, sums: FloatArray, series: Hashable | None, quantities: Sequence[int] | None, strict: bool
    ) -> FloatArray | None:
        """Return what conjugate gradients find, or None if factors are what leads on."""
        self.factorised = False
        while True:
            try:
                answer = self.krylov.solve(sums, series, quantities, self._sharper)
            except NotConverged:
                if self.direct.fits:
                    return None
                raise
            self.iterations = self.krylov.iterations
            needed = ERROR * np.sqrt(max(self.krylov.smallest, 0.0))
            if self._sharper <= needed:
                return answer
            if self.direct.fits:
                return None
            # products with the rounded entries of G leave an error of ε/λ, whatever the residual
            if ERROR * self.tolerance * self.krylov.smallest <= ROUNDING:
                if strict:
                    raise NotConverged(self._too_large())
                self._uncertainty = max(self._uncertainty, ROUNDING / max(self.krylov.smallest, ROUNDING))
                return answer
            self._sharper = 0.5 * needed

    def _by_factors(self, sums: FloatArray, strict: bool) -> FloatArray:
        if self.mapping.version >= self._again:
            self._again = self.mapping.version + self._patience
            self._patience = min(2 * self._patience, PATIENCE[1])
        self.factorised = True
        answer = self.direct.solve(sums, strict)
        self.iterations = self.direct.iterations
        return answer

    def _too_large(self) -> str:
        return (
            "solving with the Gram matrix reached its residual, but not its error: particles determine some nodes "
            f"hardly (smallest eigenvalue of the preconditioned matrix {self.krylov.smallest:.1g}), and there are too "
            "many nodes for a factorisation; more particles a cell or a basis of lower degree help, or "
            'filter.kind = "order" or "chebyshev", which solve nothing'
        )

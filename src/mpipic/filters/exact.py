"""The orthogonal projection on what nodes see, by a solve with the Gram matrix."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any

from mpipic.arrays import FloatArray
from mpipic.filters.family import NodalFilter
from mpipic.keys import IN_0_1, Keys, Share, key
from mpipic.mapping.mass import gram_doubles
from mpipic.parts import GRAM_SOLVER, SOLVED_FILTER, Values

if TYPE_CHECKING:
    from mpipic.mapping.base import NodalMapping
    from mpipic.mapping.projection import Projection


class ExactFilter(NodalFilter):
    """F = P = Φ G⁺ Φᵀ, the orthogonal projection on range(Φ), by a solve with the Gram matrix on the nodes.

    P is what the paper's global SVD filter computes: P² = P, S P = S, P 1 = 1, Pᵀ = P, all to ten times the tolerance,
    at a cost of O(n) instead of O(m² n + n³). Where G is singular (empty nodes, fewer particles than nodes, coincident
    particles) P q is the answer of least norm all the same; nodes that no particle sees get 0.

    Conjugate gradients solve where particles fill their cells; on ragged clouds, where they would miss the tolerance,
    a factorisation does, as long as no more nodes are seen than `mpipic.mapping.direct_solver.MOST_NODES` says. With σ
    the smallest singular value that is not 0 of the mapping, scaled, rounding alone leaves P uncertain by some
    4e-16 / σ: where that is above the tolerance, no method finds what is asked for.

    Parameters
    ----------
    tolerance
        Relative residual of conjugate gradients; the error of P q stays below ten times that.
    prefix
        Of the solver's PETSc options, ``-filter_ksp_type`` and others. Where there are any, they alone say how to
        solve. Measurements use ``report_``: what a user says of the filter must not change what it is measured by.
    strict
        Refuse positions that do not determine P to the tolerance. Otherwise, as in runs, what they hardly determine is
        damped: F is symmetric, with eigenvalues in [0, 1], and P but for that; `remarks` tells.

    Raises
    ------
    NotConverged
        From `apply` and `coefficients`; names what was reached, and what would help.

    Notes
    -----
    Collective. An iteration costs two halo exchanges and two reductions: O(n/ranks + its·m/ranks); for a factorisation
    see `mpipic.mapping.direct_solver`.

    References
    ----------
    Gritton, Berzins, Kirby (2015), eq. 23, in Gram form.
    """

    kind = "exact"
    about = "the orthogonal projection on what nodes see, by a solve on the nodes"
    is_projection = True
    traits = (SOLVED_FILTER,)
    brings_in = ("filter", "linear solvers")

    class Settings(Keys):
        """Keys of the filter."""

        tolerance: Share = key(1e-10, IN_0_1, "relative residual of the solve")

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return how it is applied."""
        if not cls.acts(v):
            return "exact: nothing to do, gradients on the nodes are in its range"
        return f"exact: conjugate gradients on the nodes to {v['filter.tolerance']:g}, neighbours and dot products"

    @classmethod
    def brings(cls, v: Values) -> tuple[str, ...]:
        """Return everything where it acts."""
        return cls.brings_in if cls.acts(v) else ()

    @classmethod
    def solvers(cls, v: Values) -> tuple[str, ...]:
        """Return the Gram solver's options where it acts."""
        return ("filter_ksp",) if cls.acts(v) else ()

    @classmethod
    def node_doubles(cls, v: Values) -> int:
        """Return the Gram matrix with its solver, unless the mass has the same."""
        return gram_doubles(v) if cls.acts(v) and not v.has(GRAM_SOLVER) else 0

    def __init__(
        self, mapping: NodalMapping, tolerance: float = 1e-10, prefix: str = "filter_", strict: bool = True
    ) -> None:
        super().__init__(mapping, tolerance=tolerance)
        self.strict = strict
        self.tolerance, self.prefix = float(self.settings["tolerance"]), prefix
        self.iterations = 0

    @cached_property
    def solver(self) -> Projection:
        """The solver, made when first used."""
        from mpipic.mapping.projection import Projection

        return Projection(self.mapping, self.tolerance, self.prefix)

    def coefficients(
        self, sums: FloatArray, out: FloatArray | None = None, series: Hashable | None = None
    ) -> FloatArray:
        """G⁺ sums, all columns together; zero on nodes that no particle sees. Collective."""
        self.mapping.phase("filter")
        together = None if series is None else (sums.size // len(sums),)
        answer = self.solver.solve(sums, series, together, self.strict)
        self.iterations = self.solver.iterations
        self.mapping.phase("nodes")
        if out is None:
            return answer
        out[...] = answer
        return out

    def forget(self) -> None:
        """Begin every series anew. Local."""
        self.solver.forget()

    @property
    def nbytes(self) -> int:
        """Bytes of the solver's arrays, without PETSc's work vectors."""
        return self.solver.nbytes

    def facts(self) -> dict[str, object]:
        """Return the iterations of the last application, the relative residual they go to, and how it was solved."""
        return {"iterations": self.iterations, "tolerance": self.tolerance, "factorised": self.solver.factorised}

    @classmethod
    def in_words(cls, facts: Mapping[str, Any]) -> str | None:
        """Return how the projection was solved for."""
        how = "with a factorised matrix" if facts["factorised"] else f"in {facts['iterations']} iterations"
        return f"{cls.kind}: solved {how}, to a residual of {facts['tolerance']:g}"

    def remarks(self) -> list[str]:
        """Return that the projection was uncertain, and by how much, if it was. Local."""
        uncertain = self.solver.uncertainty
        if not uncertain > self.tolerance:
            return []
        return [
            f"at times particles determined the projection to {uncertain:.1g} only, and filter.tolerance is "
            f"{self.tolerance:g}: what they hardly determined was damped"
        ]

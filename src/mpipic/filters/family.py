"""Null-space filters: linear operators on particle values that keep what the nodes see and remove what they do not.

A filter is a class with a `kind`, registered in `FILTERS`. All but the singular value decomposition have the form
F = Φ N Φᵀ with a nodal operator N: they take the nodal sums Φᵀq of particle values q to nodal coefficients
a = N Φᵀq, and their result is Φ a.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from mpipic.mapping.mapping import Mapping, NodalMapping
from mpipic.mesh.grid import FloatArray

FILTERS: dict[str, type[Filter]] = {}
"""Kind to class."""


class Filter(ABC):
    """A filter at the positions of a mapping.

    Parameters
    ----------
    mapping
        What the filter works with; when it moves on to new positions, so does the filter.
    """

    kind: ClassVar[str]
    settings: ClassVar[tuple[str, ...]] = ()
    """Keys of the scene's [filter] section that the class takes as keywords, with the same defaults."""

    def __init_subclass__(cls) -> None:
        if "kind" in vars(cls):
            FILTERS[cls.kind] = cls

    def __init__(self, mapping: NodalMapping) -> None:
        self.mapping = mapping

    @abstractmethod
    def apply(self, q: FloatArray) -> FloatArray:
        """F q: filtered particle values.

        Keeps constants (F 1 = 1).

        Parameters
        ----------
        q : (n,) or (n, k)
            Particle values, any unit, columns filtered one by one. Not modified.

        Returns
        -------
        array, shape and unit of `q`

        Notes
        -----
        Collective; needs a `Mapping`.
        """

    def __call__(self, q: FloatArray) -> FloatArray:
        """F q, as `apply`."""
        return self.apply(q)

    @property
    def nbytes(self) -> int:
        """Bytes that the filter keeps between applications."""
        return 0

    def forget(self) -> None:
        """Begin every series anew. Local."""
        return

    def facts(self) -> dict[str, Any]:
        """What the filter found out about itself at its present positions, for reports."""
        return {}

    def _particles(self) -> Mapping:
        if not isinstance(self.mapping, Mapping):
            raise TypeError(f"apply needs a Mapping, which maps any values, not a {type(self.mapping).__name__}")
        return self.mapping


class NodalFilter(Filter):
    """A filter F = Φ N Φᵀ."""

    @abstractmethod
    def coefficients(
        self, sums: FloatArray, out: FloatArray | None = None, series: Hashable | None = None
    ) -> FloatArray:
        """Nodal a = N sums with F q = Φ a.

        Parameters
        ----------
        sums : (local_nodes,) or (local_nodes, k)
            Φᵀq, or ΦᵀVq with particle weights, right on own and ghost nodes.
        out
            Where to put the result, shape of `sums`.
        series
            Calls with the same `series` are one quantity, a scalar or the components of a vector, at equally spaced
            times, which is where solvers take their first guess from. None: each column is a quantity of its own,
            nothing is remembered, and equal arguments give equal results.
        """

    def apply(self, q: FloatArray) -> FloatArray:
        """F q; see `Filter.apply`. Collective; one pass to the nodes, one back, and what `coefficients` costs."""
        mapping = self._particles()
        return mapping.g2p(self.coefficients(mapping.sums(q)))


class LocalFilter(NodalFilter):
    """F = Φ S: map to the nodes and back.

    SΦ has its eigenvalues in [0, 1], so what the nodes see is smoothed as well: F is no projection. It keeps the sum,
    Σ_p (F q)_p = Σ_p q_p. Neighbour communication only: one halo exchange to sum, one to fill.

    References
    ----------
    Gritton, Berzins, Kirby (2015), eq. 25-27.
    """

    kind = "local"

    def coefficients(
        self, sums: FloatArray, out: FloatArray | None = None, series: Hashable | None = None
    ) -> FloatArray:
        """diag(d)⁻¹ sums. Local."""
        return self.mapping.divide(sums, out)


class _Series(NodalFilter):
    """F = Φ p_k(SΦ) S with a polynomial p_k of degree k - 1, chosen so that 1 - λ p_k(λ) is small where λ is not 0.

    SΦ = diag(d)⁻¹G has its eigenvalues in [0, 1]; what the nodes see but cannot tell apart (λ = 0, fewer particles than
    nodes) is left out by every p_k. All keep constants, since λ = 1 belongs to them and 1 - p_k(1) = 0. Neighbour
    communication only: k halo exchanges, no reductions.
    """

    settings = ("order",)

    def __init__(self, mapping: NodalMapping, order: int = 2) -> None:
        super().__init__(mapping)
        if order < 1:
            raise ValueError(f"order must be 1 or above, not {order}")
        self.order = order

    def coefficients(
        self, sums: FloatArray, out: FloatArray | None = None, series: Hashable | None = None
    ) -> FloatArray:
        """p_k(SΦ) diag(d)⁻¹ sums. Collective on neighbours."""
        means = self.mapping.divide(sums)
        result = means if self.order == 1 else self._sum_up(means)
        if out is None:
            return result
        out[...] = result
        return out

    def _smooth(self, nodal: FloatArray) -> FloatArray:
        """SΦ nodal."""
        gram = self.mapping.apply_gram(nodal)
        return self.mapping.divide(gram, out=gram)

    @abstractmethod
    def _sum_up(self, means: FloatArray) -> FloatArray:
        """p_k(SΦ) means, for k > 1. `means` may be overwritten."""


class OrderFilter(_Series):
    """F = Φ [Σ_{j<k} (1 - SΦ)^j] S, the truncated Neumann series: on range(Φ), F = 1 - (1 - ΦS)^k.

    k = 1 is the local filter, k → ∞ the exact projection. Flat on long waves: a wave with eigenvalue λ loses (1 - λ)^k.
    Σ_p (F q)_p = Σ_p q_p for every k.

    References
    ----------
    Hammerquist, Nairn (2017), XPIC(k).
    """

    kind = "order"

    def _sum_up(self, means: FloatArray) -> FloatArray:
        term, total = means, means.copy()
        for _ in range(1, self.order):
            term = term - self._smooth(term)
            total += term
        return total


class ChebyshevFilter(_Series):
    """As `order`, at the same cost, with 1 - λ p_k(λ) = (1 - λ) T(λ), T the Chebyshev polynomial of degree k - 1.

    T is scaled to [λ_low, 1] and to T(0) = 1. It is smaller in the operator norm than (1 - λ)^(k-1), which in turn is
    flatter on long waves; the factor 1 - λ keeps constants exact. This is the Chebyshev iteration for SΦ a = S q, begun
    at a = S q.

    The lower bound is λ_low = (1/3)^d, the smallest eigenvalue on cells filled evenly: it depends on no positions, so
    it never ages, takes no reduction, and a run gives the same numbers wherever it is restarted. Few or disordered
    particles have eigenvalues below it, but there 0 <= T <= 1, so what they carry is damped, never amplified. Above
    λ_low, T changes sign k - 1 times, and a wave may come out larger by up to (1 - λ) |T(λ)|; where the bound is too
    low (particles near nodes) the series only converges more slowly.

    References
    ----------
    Saad, Iterative Methods for Sparse Linear Systems, algorithm 12.1.
    """

    kind = "chebyshev"

    def _sum_up(self, means: FloatArray) -> FloatArray:
        low = 3.0**-self.mapping.grid.dim
        middle, half = 0.5 * (1.0 + low), 0.5 * (1.0 - low)
        ratio = half / middle
        residual = means - self._smooth(means)
        change = residual / middle
        total = means + change
        for _ in range(2, self.order):
            residual -= self._smooth(change)
            following = 1.0 / (2.0 * middle / half - ratio)
            change = following * ratio * change + 2.0 * following / half * residual
            ratio = following
            total += change
        return total


class ExactFilter(NodalFilter):
    """F = P = Φ G⁺ Φᵀ, the orthogonal projection on range(Φ), by conjugate gradients on the nodes.

    P is what the paper's global SVD filter computes: P² = P, S P = S, P 1 = 1, Pᵀ = P, all to the solver's tolerance,
    at a cost of O(n) instead of O(m² n + n³). Where G is singular (empty nodes, fewer particles than nodes, coincident
    particles) P q is the answer of least norm all the same; nodes that no particle sees get 0.

    Parameters
    ----------
    tolerance
        Relative residual; see `mpipic.mapping.solver.GramSolver`, whose PETSc options begin with ``-filter_``.

    Raises
    ------
    NotConverged
        From `apply` and `coefficients`; names the residual and the iteration count.

    Notes
    -----
    Collective. An iteration costs two halo exchanges and two reductions: O(n/ranks + its·m/ranks).

    References
    ----------
    Gritton, Berzins, Kirby (2015), eq. 23, in Gram form.
    """

    kind = "exact"
    settings = ("tolerance",)

    def __init__(self, mapping: NodalMapping, tolerance: float = 1e-10) -> None:
        super().__init__(mapping)
        self.tolerance = tolerance
        self.iterations = 0

    @cached_property
    def solver(self) -> Any:
        """The Gram solver, made when first used."""
        from mpipic.mapping.solver import GramSolver

        return GramSolver(self.mapping, self.tolerance)

    def coefficients(
        self, sums: FloatArray, out: FloatArray | None = None, series: Hashable | None = None
    ) -> FloatArray:
        """G⁺ sums, all columns together; zero on nodes that no particle sees. Collective."""
        self.mapping.phase("filter")
        together = None if series is None else (sums.size // len(sums),)
        answer: FloatArray = self.solver.solve(sums, series, together)
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
        return int(self.solver.nbytes)

    def facts(self) -> dict[str, Any]:
        """Iterations of the last application, and the relative residual they go to."""
        return {"iterations": self.iterations, "tolerance": self.tolerance}


class SvdFilter(Filter):
    """F = V_r V_rᵀ, with V_r the right singular vectors of S that belong to singular values above the cut.

    The paper's global filter, distributed; the reference that the others are compared with. With particle weights, V_r
    are those of S V^-½, and F = V^-½ V_r V_rᵀ V^½.

    Notes
    -----
    Collective. All triplets are computed anew whenever positions have changed: O(m² n + m³) work, O(m n) memory.

    References
    ----------
    Gritton, Berzins, Kirby (2015), eq. 14-23.
    """

    kind = "svd"

    def __init__(self, mapping: NodalMapping) -> None:
        super().__init__(mapping)
        self._version = -1

    @property
    def rows(self) -> Any:
        """Row space of S at the present positions, a `RowSpace`. Collective where they have changed."""
        from mpipic.filters.row_space import RowSpace

        mapping = self._particles()
        if self._version != mapping.version:
            self._rows, self._version = RowSpace(mapping), mapping.version
        return self._rows

    def apply(self, q: FloatArray) -> FloatArray:
        """V_r V_rᵀ q; see `Filter.apply`."""
        return np.asarray(self.rows.project(q))

    @property
    def nbytes(self) -> int:
        """Bytes of V_r on this rank."""
        return int(self.rows.nbytes)

    def facts(self) -> dict[str, Any]:
        """Rank, cut, and the singular values on either side of it."""
        return dict(self.rows.facts)


def create(kind: str, mapping: NodalMapping, settings: Any) -> Filter:
    """The filter `kind` with what it needs of `settings`, a record like the scene's [filter] section."""
    cls = FILTERS[kind]
    return cls(mapping, **{name: getattr(settings, name) for name in cls.settings})

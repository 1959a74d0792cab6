"""Filters that are polynomials in SΦ: neighbour communication only, whatever the order."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Hashable
from typing import TYPE_CHECKING

from mpipic.arrays import FloatArray
from mpipic.filters.family import NodalFilter
from mpipic.keys import Keys, UpTo1000, key
from mpipic.parts import Values

if TYPE_CHECKING:
    from mpipic.mapping.base import NodalMapping


class LocalFilter(NodalFilter):
    """F = Φ S: map to the nodes and back.

    SΦ has its eigenvalues in [0, 1], so what the nodes see is smoothed as well: F is no projection. It keeps the sum,
    Σ_p (F q)_p = Σ_p q_p. Neighbour communication only: one halo exchange to sum, one to fill.

    References
    ----------
    Gritton, Berzins, Kirby (2015), eq. 25-27.
    """

    kind = "local"
    about = "to the nodes and back: smooths what the nodes see as well"
    is_default = True

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return what an application costs."""
        return "local: neighbours only, 1 halo exchange an application"

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

    argument = "order"

    class Settings(Keys):
        """Keys of the filter."""

        order: UpTo1000 = key(
            2, "a whole number from 1 to 1000", "terms of the series, each of which costs a halo exchange"
        )

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return what an application costs."""
        order = v["filter.order"]
        return f"{cls.kind} {order}: neighbours only, {order} halo exchange{'s' * (order > 1)} an application"

    def __init__(self, mapping: NodalMapping, order: int = 2) -> None:
        super().__init__(mapping, order=order)
        self.order = int(self.settings["order"])

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
        gram = self.mapping.gram.apply(nodal)
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
    about = "a truncated Neumann series, flat on long waves; order 1 is local"

    def _sum_up(self, means: FloatArray) -> FloatArray:
        term, total = means, means.copy()
        for _ in range(1, self.order):
            term = term - self._smooth(term)
            total += term
        return total


class ChebyshevFilter(_Series):
    """Does as `order`, at the same cost, with 1 - λ p_k(λ) = (1 - λ) T(λ), T the Chebyshev polynomial of degree k - 1.

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
    about = "a Chebyshev series, sharper than order at the same cost"

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

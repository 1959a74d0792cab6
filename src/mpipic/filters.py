"""Null-space filters: linear operators on particle values that keep what the nodes see and remove what they do not.

Every filter here has the form F = Φ N Φᵀ with a nodal operator N: it takes the nodal sums Φᵀq of particle values q to
nodal coefficients a = N Φᵀq, and its result is Φ a. A filter is a class with a `kind`, registered in `FILTERS`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

from mpipic.grid import FloatArray
from mpipic.mapping import Mapping, NodalMapping

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
    def coefficients(self, sums: FloatArray, out: FloatArray | None = None) -> FloatArray:
        """Nodal a = N sums with F q = Φ a, where sums = Φᵀq: (local_nodes, ...), right on own and ghost nodes."""

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
        Collective; needs a `Mapping`. One pass to the nodes, one back, and what `coefficients` costs.
        """
        if not isinstance(self.mapping, Mapping):
            raise TypeError(f"apply needs a Mapping, which maps any values, not a {type(self.mapping).__name__}")
        return self.mapping.g2p(self.coefficients(self.mapping.sums(q)))

    __call__ = apply


class LocalFilter(Filter):
    """F = Φ S: map to the nodes and back.

    SΦ has its eigenvalues in [0, 1], so what the nodes see is smoothed as well: F is no projection. It keeps the sum,
    Σ_p (F q)_p = Σ_p q_p. Neighbour communication only: one halo exchange to sum, one to fill.

    References
    ----------
    Gritton, Berzins, Kirby (2015), eq. 25-27.
    """

    kind = "local"

    def coefficients(self, sums: FloatArray, out: FloatArray | None = None) -> FloatArray:
        """diag(d)⁻¹ sums. Local."""
        return self.mapping.divide(sums, out)


class _Series(Filter):
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

    def coefficients(self, sums: FloatArray, out: FloatArray | None = None) -> FloatArray:
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

    The lower bound is λ_low = (1/3)^d, the smallest eigenvalue on cells filled with many particles. Few or disordered
    particles have eigenvalues below it, but there 0 <= T <= 1, so what they carry is damped, never amplified. Above
    λ_low, T changes sign k - 1 times, and a wave may come out larger by up to (1 - λ) |T(λ)|.

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


def create(kind: str, mapping: NodalMapping, settings: Any) -> Filter:
    """The filter `kind` with what it needs of `settings`, a record like the scene's [filter] section."""
    cls = FILTERS[kind]
    return cls(mapping, **{name: getattr(settings, name) for name in cls.settings})

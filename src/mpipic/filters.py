"""Null-space filters: linear operators on particle values that keep what the nodes see and remove what they do not.

Every filter here has the form F = Φ N Φᵀ with a nodal operator N: it takes the nodal sums Φᵀq of particle values q to
nodal coefficients a = N Φᵀq, and its result is Φ a. A filter is a class with a `kind`, registered in `FILTERS`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

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

    def __init_subclass__(cls) -> None:
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

"""Null-space filters: linear operators on particle values that keep what the nodes see and remove what they do not.

A filter is a class with a `kind`, registered in `FILTERS`. All but the singular value decomposition have the form
F = Φ N Φᵀ with a nodal operator N: they take the nodal sums Φᵀq of particle values q to nodal coefficients
a = N Φᵀq, and their result is Φ a.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable
from typing import TYPE_CHECKING, Any, ClassVar

from mpipic.arrays import FloatArray

if TYPE_CHECKING:
    from mpipic.mapping.base import NodalMapping

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
        q : (n, *shape)
            Particle values, any unit, components filtered one by one. Not modified.

        Returns
        -------
        array, shape and unit of `q`

        Notes
        -----
        Collective.
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

    def facts(self) -> dict[str, object]:
        """Return what the filter found out about itself at its present positions, for reports."""
        return {}


class NodalFilter(Filter):
    """A filter F = Φ N Φᵀ."""

    @abstractmethod
    def coefficients(
        self, sums: FloatArray, out: FloatArray | None = None, series: Hashable | None = None
    ) -> FloatArray:
        """Nodal a = N sums with F q = Φ a.

        Parameters
        ----------
        sums : (local_nodes, *shape)
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
        return self.mapping.g2p(self.coefficients(self.mapping.sums(q)))


def create(kind: str, mapping: NodalMapping, settings: Any) -> Filter:
    """Return the filter `kind` with what it needs of `settings`, a record like the scene's [filter] section."""
    cls = FILTERS[kind]
    return cls(mapping, **{name: getattr(settings, name) for name in cls.settings})

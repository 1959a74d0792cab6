"""Null-space filters: linear operators on particle values that keep what the nodes see and remove what they do not.

A filter is a part (see `mpipic.parts`): a class with a `kind`, which `FILTERS` then holds. All but the singular value
decomposition have the form F = Φ N Φᵀ with a nodal operator N: they take the nodal sums Φᵀq of particle values q to
nodal coefficients a = N Φᵀq, and their result is Φ a.
"""

from __future__ import annotations

import zlib
from abc import ABC, abstractmethod
from collections.abc import Hashable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy.typing as npt

from mpipic.arguments import choice, told
from mpipic.arrays import FloatArray, columns_of
from mpipic.parts import A_FILTER, NODAL_FILTER, NODAL_GRADIENTS, Choices, Part, Values, checked_settings

if TYPE_CHECKING:
    from mpi4py import MPI

    from mpipic.mapping.base import NodalMapping


class TooLarge(MemoryError):
    """A filter's arrays would not fit into the memory of this machine; the message says by how much."""


class FilterPart(Part):
    """Can be named by a scene as its filter; `none` is one too.

    Attributes
    ----------
    is_projection
        Whether it is the orthogonal projection on range(Φ), which changes nothing that comes from nodal coefficients.
    """

    slot = "filter.kind"
    is_projection: ClassVar[bool] = False

    @classmethod
    def acts(cls, v: Values) -> bool:
        """Whether the filter changes anything: a projection does nothing to gradients taken on the nodes."""
        return not (cls.is_projection and v.has(NODAL_GRADIENTS))


class Filter(FilterPart, ABC):
    """A filter at the positions of a mapping.

    Parameters
    ----------
    mapping
        What the filter works with; when it moves on to new positions, so does the filter.
    settings
        Values of the keys of `Settings`; a class takes them as keywords, with the same defaults.

    Attributes
    ----------
    strict : bool
        Whether positions are refused at which the filter cannot be had to its tolerance. Runs set it to False, and tell
        `remarks`.

    Raises
    ------
    TypeError
        `mapping` is none.
    ValueError
        A setting breaks its rule, or differs between ranks; on all ranks together.

    Notes
    -----
    Building is collective; one reduction to agree.
    """

    brings_in: ClassVar[tuple[str, ...]] = ("filter",)
    strict: bool = True
    traits = (A_FILTER,)

    @staticmethod
    def check_memory(nodes: int, particles: int, comm: MPI.Comm) -> None:
        """Raise TooLarge on all ranks if there is no memory for the filter. Collective."""
        return

    def __init__(self, mapping: NodalMapping, **settings: object) -> None:
        from mpipic.mapping.base import NodalMapping
        from mpipic.mesh.agreement import Said, together

        if not isinstance(mapping, NodalMapping):
            raise TypeError(f"{type(self).__name__} needs a Mapping, not {told(mapping)}")
        self.mapping = mapping

        def say(known: dict[str, Any]) -> Said:
            words = ", ".join(f"{name} {value!r}" for name, value in known.items())
            return Said([zlib.crc32(words.encode())], lambda: words)

        verb = type(self).__name__
        self.settings, _ = together(mapping.grid.comm, verb, lambda: checked_settings(type(self), settings), say)

    def apply(self, q: npt.ArrayLike) -> FloatArray:
        """F q: filtered particle values.

        Keeps constants (F 1 = 1).

        Parameters
        ----------
        q : (n, *shape)
            Values of this rank's particles in the order of the mapping's positions, real numbers, any unit, components
            filtered one by one. Not modified. Without particles (0,) will do.

        Returns
        -------
        array, shape and unit of `q`, float64

        Raises
        ------
        ValueError, TypeError
            `q` is nothing like that, or of another shape on another rank; on all ranks together.

        Notes
        -----
        Collective; one reduction to agree, and what `filtered` costs.
        """
        values = self.mapping.agreed(f"{type(self).__name__}.apply", q)
        columns = columns_of(values)
        result = self.filtered(columns) if columns.shape[1] else columns
        return result.reshape(values.shape)

    @abstractmethod
    def filtered(self, columns: FloatArray) -> FloatArray:
        """F columns: (n, k) to the same, k >= 1, float64 and C-contiguous, which is not checked. Collective."""

    def __call__(self, q: npt.ArrayLike) -> FloatArray:
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

    @classmethod
    def in_words(cls, facts: Mapping[str, Any]) -> str | None:
        """Return such facts as a sentence; None where there are none."""
        return None

    def remarks(self) -> list[str]:
        """Return sentences that whoever uses results of the filter should read, if there are any. Local."""
        return []


class NodalFilter(Filter):
    """A filter F = Φ N Φᵀ."""

    traits = (NODAL_FILTER,)

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

    def filtered(self, columns: FloatArray) -> FloatArray:
        """F columns. Collective; one pass to the nodes, one back, and what `coefficients` costs."""
        return self.mapping.g2p(self.coefficients(self.mapping.column_sums(columns)))


FILTERS: Choices[Filter] = Choices(Filter)
"""Kind to class."""


def create(kind: str, mapping: NodalMapping, settings: Mapping[str, Any]) -> Filter:
    """Return the filter `kind` with its settings by name. Collective."""
    return FILTERS[choice("kind", kind, list(FILTERS))](mapping, **settings)

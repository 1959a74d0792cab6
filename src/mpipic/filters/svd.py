"""The paper's global filter: the same projection, by singular vectors of the mapping matrix."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from mpipic.arrays import FloatArray
from mpipic.filters.family import Filter
from mpipic.parts import PENALTY, Broken, Values, rule

if TYPE_CHECKING:
    from mpi4py import MPI

    from mpipic.filters.row_space import RowSpace
    from mpipic.mapping.base import NodalMapping


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
    about = "the same projection by singular vectors: the paper's global filter, for small scenes"
    is_projection = True
    brings_in = ("filter", "SLEPc", "assembled matrices")

    @rule("filter.kind", "mapping.mass", "mapping.gradient")
    @staticmethod
    def knows_no_penalty(v: Values) -> Broken | None:
        """The reference works on particle values, where the penalised scheme is not defined."""
        if not v.has(PENALTY) or not SvdFilter.acts(v):
            return None
        return "filter.kind", 'svd needs mapping.mass = lumped or consistent, or mapping.gradient = "grid"; use exact'

    @staticmethod
    def check_memory(nodes: int, particles: int, comm: MPI.Comm) -> None:
        """Raise TooLarge on all ranks if there is no memory for all singular triplets. Collective."""
        from mpipic.filters.row_space import check_memory

        check_memory(nodes, particles, comm)

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return how it is applied."""
        if not cls.acts(v):
            return "svd: nothing to do, gradients on the nodes are in its range"
        return "svd: all singular triplets of the mapping matrix by SLEPc, whenever particles have moved"

    @classmethod
    def brings(cls, v: Values) -> tuple[str, ...]:
        """Return everything where it acts."""
        return cls.brings_in if cls.acts(v) else ()

    @classmethod
    def solvers(cls, v: Values) -> tuple[str, ...]:
        """Return the decomposition's options where it acts."""
        return ("filter_svd",) if cls.acts(v) else ()

    def __init__(self, mapping: NodalMapping) -> None:
        super().__init__(mapping)
        self._version = -1

    @property
    def rows(self) -> RowSpace:
        """Row space of S at the present positions, a `RowSpace`. Collective where they have changed."""
        from mpipic.filters.row_space import RowSpace

        if self._version != self.mapping.version:
            self._rows, self._version = RowSpace(self.mapping), self.mapping.version
        return self._rows

    def filtered(self, columns: FloatArray) -> FloatArray:
        """V_r V_rᵀ columns. Collective."""
        return self.rows.project(columns)

    @property
    def nbytes(self) -> int:
        """Bytes of V_r on this rank."""
        return self.rows.nbytes

    @classmethod
    def in_words(cls, facts: Mapping[str, Any]) -> str | None:
        """Return by which solver, and what it found."""
        from mpipic.filters.row_space import describe

        return f"{cls.kind} by {facts['solver']}: {describe(dict(facts))}"

    def facts(self) -> dict[str, object]:
        """Rank, cut, and the singular values on either side of it."""
        return dict(self.rows.facts)

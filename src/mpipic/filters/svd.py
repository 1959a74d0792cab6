"""The paper's global filter: the same projection, by singular vectors of the mapping matrix."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mpipic.arrays import FloatArray
from mpipic.filters.family import Filter

if TYPE_CHECKING:
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

    def apply(self, q: FloatArray) -> FloatArray:
        """V_r V_rᵀ q; see `Filter.apply`."""
        return self.rows.project(q)

    @property
    def nbytes(self) -> int:
        """Bytes of V_r on this rank."""
        return self.rows.nbytes

    def facts(self) -> dict[str, object]:
        """Rank, cut, and the singular values on either side of it."""
        return dict(self.rows.facts)

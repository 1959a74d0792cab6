"""No filter: particles take gradients as they find them."""

from __future__ import annotations

from mpipic.filters.family import FilterPart


class NoFilter(FilterPart):
    """Stands in a scene for a step without a filter; nothing is built."""

    kind = "none"
    about = "no filter"

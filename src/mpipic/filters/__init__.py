"""Null-space filters: what they keep of particle values, and how; imported in the order in which choices are listed."""

# isort: off
from mpipic.filters.family import FILTERS, Filter, FilterPart, NodalFilter, TooLarge, create
from mpipic.filters.none import NoFilter
from mpipic.filters.series import ChebyshevFilter, LocalFilter, OrderFilter
from mpipic.filters.exact import ExactFilter
from mpipic.filters.svd import SvdFilter
# isort: on

__all__ = [
    "FILTERS",
    "ChebyshevFilter",
    "ExactFilter",
    "Filter",
    "FilterPart",
    "LocalFilter",
    "NoFilter",
    "NodalFilter",
    "OrderFilter",
    "SvdFilter",
    "TooLarge",
    "create",
]

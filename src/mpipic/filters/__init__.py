"""Null-space filters: what they keep of particle values, and how."""

from mpipic.filters.exact import ExactFilter
from mpipic.filters.family import FILTERS, Filter, NodalFilter, create
from mpipic.filters.series import ChebyshevFilter, LocalFilter, OrderFilter
from mpipic.filters.svd import SvdFilter

__all__ = [
    "FILTERS",
    "ChebyshevFilter",
    "ExactFilter",
    "Filter",
    "LocalFilter",
    "NodalFilter",
    "OrderFilter",
    "SvdFilter",
    "create",
]

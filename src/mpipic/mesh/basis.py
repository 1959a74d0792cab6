"""The bases of the grid: B-splines centred on nodes, by name. Their values and slopes are in `kernels.spline`."""

from __future__ import annotations

DEGREES = {"linear": 1, "quadratic": 2, "cubic": 3}
"""Name to polynomial degree."""
REACH = {1: (0, 1), 2: (1, 2), 3: (1, 2)}
"""Degree to the nodes below and above the lower node of its cell that a particle touches at most."""

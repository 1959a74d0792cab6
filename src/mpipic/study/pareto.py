"""Choosing among many pairs (cost, error): which of them nothing beats, and how fast error falls with h."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import linear_regression


def front(pairs: Sequence[tuple[float, float]]) -> list[int]:
    """Return, by rising cost, the indices of pairs (cost, error) that none beats in one without losing in the other.

    The first of equal pairs counts. O(n log n).
    """
    best, found = math.inf, []
    for index in sorted(range(len(pairs)), key=lambda i: (*pairs[i], i)):
        if pairs[index][1] < best:
            best = pairs[index][1]
            found.append(index)
    return found


@dataclass(frozen=True)
class Fit:
    """A least squares line through (ln h, ln error): error = coefficient h^order.

    `residual` is the root mean square of ln error about the line: 0.1 is about 10 % of the error.
    """

    order: float
    coefficient: float
    residual: float
    count: int


def fit_order(h: Sequence[float], errors: Sequence[float]) -> Fit:
    """Fit the order of convergence to at least two errors above 0 at different h."""
    x, y = [math.log(value) for value in h], [math.log(value) for value in errors]
    order, intercept = linear_regression(x, y)
    squares = math.fsum((b - intercept - order * a) ** 2 for a, b in zip(x, y, strict=True))
    return Fit(order, math.exp(intercept), math.sqrt(squares / len(x)), len(x))


def cheapest(pairs: Sequence[tuple[float, float]], error: float) -> int | None:
    """Return the index of the pair (cost, error) of least cost whose error is at most `error`; None without one."""
    return min((i for i, pair in enumerate(pairs) if pair[1] <= error), key=lambda i: pairs[i], default=None)


def most_accurate(pairs: Sequence[tuple[float, float]], cost: float) -> int | None:
    """Return the index of the pair (cost, error) of least error whose cost is at most `cost`; None without one."""
    affordable = (i for i, pair in enumerate(pairs) if pair[0] <= cost)
    return min(affordable, key=lambda i: pairs[i][::-1], default=None)

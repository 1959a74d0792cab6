"""Few of many combinations, so that any two choices (or three) that can meet do meet in one of them."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Sequence
from itertools import combinations, product
from typing import TypeVar

Case = TypeVar("Case")


def cover(candidates: Sequence[Case], choices_of: Callable[[Case], Iterable[Hashable]]) -> list[Case]:
    """Few of the candidates that have, together, every choice that any of them has: greedily, the same in each run."""
    choices = [set(choices_of(candidate)) for candidate in candidates]
    missing, chosen = set().union(*choices), []
    while missing:
        best = max(range(len(candidates)), key=lambda i: len(choices[i] & missing))
        missing -= choices[best]
        chosen.append(candidates[best])
    return chosen


def covering(strength: int, *factors: Iterable[Hashable]) -> list[tuple[Hashable, ...]]:
    """Rows of one value a factor in which any `strength` values of different factors occur together."""
    return cover(list(product(*factors)), lambda row: combinations(enumerate(row), strength))

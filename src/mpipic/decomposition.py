"""How ranks share a box: the process grid. Pure arithmetic, for scenes and grids alike."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product


def process_grid(cells: Sequence[int], size: int) -> tuple[int, ...] | None:
    """Return the ranks per axis p with the least halo surface, or None when no p has p_a <= cells_a.

    The product of p is `size`. The surface is the sum over split axes (p_a > 1) of a block's cross-section across that
    axis, in cells; a block has cells_a / p_a cells per axis. Of equal surfaces the one that splits x least is taken,
    then y: it has fewer neighbours, memory runs along x, and so does the default flow. O(sqrt(size)) divisions.
    """
    total = math.prod(cells)
    if not 1 <= size <= total:
        return None
    low = [n for n in range(1, math.isqrt(size) + 1) if size % n == 0]
    divisors = sorted({*low, *(size // n for n in low)})
    best: tuple[int, tuple[int, ...]] | None = None
    for head in product(*([n for n in divisors if n <= count] for count in cells[:-1])):
        last, rest = divmod(size, math.prod(head))
        if rest or not 1 <= last <= cells[-1]:
            continue
        grid = (*head, last)
        # A cross-section is volume / cells_a p_a, and every candidate has the same volume: integers, so ties are exact.
        surface = sum(p * (total // count) for p, count in zip(grid, cells, strict=True) if p > 1)
        best = min(best, (surface, grid)) if best else (surface, grid)
    return best[1] if best else None

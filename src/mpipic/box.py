"""The periodic box: one rule for positions, wherever they come from. Plain arrays; no ranks, no files.

Axes are periodic, so a position may be any number of periods off: it counts as the one in [0, length) that it falls on.
Refused are positions that tell no place: those that are not finite, and those so far off that two neighbouring
floating-point numbers there are further apart than a cell.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from mpipic.arrays import FloatArray

NOT_FINITE = "is not finite"
TOO_FAR = "is so far away that its digits do not tell its cell"


def is_inside(position: FloatArray, length: Sequence[float]) -> bool:
    """Return whether all positions (n, d) are in the box. O(n)."""
    return all(bool(((x >= 0.0) & (x < size)).all()) for x, size in zip(position.T, length, strict=True))


def wrap(position: FloatArray, length: Sequence[float]) -> FloatArray:
    """Return positions (n, d) in the box, 0 <= x < length on every axis.

    Those in the box keep every bit. The upper face is the lower one, and so is what lies below 0 by so little that
    rounding puts it on the upper face: -1e-17 in a box of length 1. Not finite: NaN.
    """
    size = np.array(length)
    with np.errstate(invalid="ignore"):
        inside = np.mod(position, size)
    return np.where(inside >= size, 0.0, inside)


def misplaced(position: FloatArray, h: Sequence[float]) -> Iterator[tuple[str, npt.NDArray[np.bool_]]]:
    """Yield each rule that positions (n, d) may break, in words, and who breaks it, (n,); nobody breaks two. O(n)."""
    finite = np.isfinite(position).all(axis=1)
    yield NOT_FINITE, ~finite
    with np.errstate(invalid="ignore", over="ignore"):
        yield TOO_FAR, finite & (np.spacing(np.abs(position)) > np.array(h)).any(axis=1)


def first_misplaced(name: str, position: FloatArray, h: Sequence[float]) -> str | None:
    """Return which of the positions (n, d) is the first to break a rule, and which; None if none does. O(n)."""
    if position.size and np.abs(position).max() < 2.0**51 * min(h):  # the spacing of such numbers is below min(h) / 2
        return None
    found = [(int(np.argmax(broken)), rule) for rule, broken in misplaced(position, h) if broken.any()]
    if not found:
        return None
    row, rule = min(found)
    return f"{name} {row} = {position[row].tolist()} {rule}"

"""Judge rows that were read: values that are not finite, positions that tell no place or lie beyond the box, ids.

Pieces are judged one by one, and what is found is put together over pieces and ranks.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mpipic.arrays import FloatArray, IntArray, columns_of
from mpipic.box import misplaced
from mpipic.io.selection import POSITION

if TYPE_CHECKING:
    from mpi4py import MPI

ON_FACE = 1e-9
"""Share of the box within which a position beyond a face counts as on it, and is not worth a word."""

# Rule broken -> (how often, first row, value there).
Findings = dict[str, tuple[int, int, str]]


@dataclass
class Outside:
    """Positions beyond the box: how many, and the one furthest off, as distance, axis and value."""

    count: int = 0
    furthest: tuple[float, int, float] = (0.0, 0, 0.0)


def find_broken(name: str, values: FloatArray, first_row: int, h: Sequence[float]) -> Findings:
    """Return the rules that some rows break: positions that tell no place, other values that are not finite. Local."""
    table = columns_of(values)
    rules = misplaced(table, h) if name == POSITION else [("is not finite", ~np.isfinite(table).all(axis=1))]
    found: Findings = {}
    for rule, broken in rules:
        where = np.flatnonzero(broken)
        if where.size:
            value = ", ".join(repr(float(number)) for number in table[where[0]])
            shown = f"({value})" if values.ndim > 1 else value
            found[f"{name} {rule}"] = (int(where.size), first_row + int(where[0]), shown)
    return found


def merge(findings: Iterable[Findings]) -> Findings:
    """Return the findings of all, counts added, with the first row of each rule."""
    merged: Findings = {}
    for found in findings:
        merge_into(merged, found)
    return merged


def merge_into(merged: Findings, found: Findings) -> None:
    """Add what is found somewhere to what is found elsewhere."""
    for rule, (count, row, value) in found.items():
        before = merged.get(rule)
        merged[rule] = (count, row, value) if before is None else (before[0] + count, *min(before[1:], (row, value)))


def sentences(path: str, found: Findings) -> list[str]:
    """Return a sentence for every rule that rows break, with the first of them."""
    return [
        f"{path}: {rule} in {count} row{'s' * (count > 1)}, first row {row}: {value}"
        for rule, (count, row, value) in sorted(found.items())
    ]


def count_outside(outside: Outside, position: FloatArray, length: Sequence[float]) -> None:
    """Count rows that lie beyond the box by more than rounding, and keep the furthest; not finite: neither."""
    size = np.array(length)
    with np.errstate(invalid="ignore"):
        beyond = np.maximum(-position, position - size) / size
        beyond = np.where(np.isfinite(beyond), beyond, 0.0)
    outside.count += int(np.count_nonzero((beyond > ON_FACE).any(axis=1)))
    row, axis = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
    outside.furthest = max(outside.furthest, (float(beyond[row, axis]), int(axis), float(position[row, axis])))


def said_outside(path: str, parts: Sequence[Outside], rows: int, length: Sequence[float]) -> list[str]:
    """Return the sentence about positions beyond the box, if there are any."""
    count, (_, axis, value) = sum(part.count for part in parts), max(part.furthest for part in parts)
    if not count:
        return []
    box = " x ".join(f"[0, {_digits(size)})" for size in length)
    lie = "lies" if count == 1 else "lie"
    were = "was" if count == 1 else "were"
    return [
        f"{path}: {count} of {rows} positions {lie} outside the box {box} and {were} wrapped; "
        f"furthest {'xyz'[axis]} = {_digits(value)}"
    ]


def _digits(number: float) -> str:
    """Return a number with as many digits as it takes to be that number."""
    short = f"{number:g}"
    return short if float(short) == number else repr(float(number))


def repeated(ids: IntArray, start: int, comm: MPI.Comm) -> str:
    """Return a sentence about particles that have the id of another one; "" where there are none. Collective.

    Every id goes to one rank, with its row: O(n / ranks) memory.
    """
    rows = np.arange(start, start + len(ids), dtype=np.int64)
    if comm.size > 1:
        home = ids % comm.size
        sent = [(ids[home == rank], rows[home == rank]) for rank in range(comm.size)]
        ids, rows = (np.concatenate(parts) for parts in zip(*comm.alltoall(sent), strict=True))
    order = np.lexsort((rows, ids))
    again = np.flatnonzero(ids[order][1:] == ids[order][:-1])
    first = min(((int(rows[order[k + 1]]), int(rows[order[k]]), int(ids[order[k]])) for k in again), default=None)
    found = [(len(again), first)] if first else []
    everywhere = [one for part in comm.allgather(found) for one in part]
    if not everywhere:
        return ""
    count, (later, earlier, number) = sum(one for one, _ in everywhere), min(one for _, one in everywhere)
    return f"id is repeated in {count} row{'s' * (count > 1)}: {number} is in row {earlier} and in row {later}"

"""Read particles from an HDF5 file: `position` (n, d), and optionally values of their fields, (n, *shape) each.

The number of a row is the global id of its particle. Files are read in pieces of at most `PIECE_BYTES` when checked,
and every rank reads only its own rows.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mpipic.arrays import FloatArray, IntArray, Shape, columns_of

if TYPE_CHECKING:
    import h5py
    from mpi4py import MPI

PIECE_BYTES = 32 << 20

# Rule broken -> (how often, first row, value there).
Findings = dict[str, tuple[int, int, str]]


class ParticleFileError(ValueError):
    """A particle file that cannot be used; `problems` lists all that is wrong. Raised on all ranks together."""

    def __init__(self, problems: Sequence[str]) -> None:
        super().__init__("; ".join(problems))
        self.problems = list(problems)


@dataclass(frozen=True)
class ParticleRows:
    """Rows of a particle file: ids (n,), which are the row numbers, positions (n, d), and the fields that it has."""

    ids: IntArray
    position: FloatArray
    fields: Mapping[str, FloatArray]


def check_particle_file(path: Path | str, length: Sequence[float], fields: Mapping[str, Shape]) -> list[str]:
    """Return everything that is wrong with a particle file, one sentence each; empty when it can be used.

    Parameters
    ----------
    path : HDF5 file
    length : size of the box, d numbers; positions must be in [0, length) on every axis
    fields : name of a field that the file may have to the shape of one particle's value

    Notes
    -----
    Local, meant for one rank. Reads the whole file, in pieces.
    """
    return _inspect(path, length, fields)[0]


def read_particle_file(
    path: Path | str, length: Sequence[float], fields: Mapping[str, Shape], comm: MPI.Comm
) -> ParticleRows:
    """Read this rank's block of rows: rows n·rank/size to n·(rank + 1)/size.

    `path`, `length` and `fields` are those of `check_particle_file`.

    Raises
    ------
    ParticleFileError
        On all ranks, with all problems of the whole file, as from `check_particle_file`.

    Notes
    -----
    Collective. Every row is read and checked once, by the rank that keeps it.
    """
    problems, found, rows = _inspect(path, length, fields, (comm.rank, comm.size))
    everywhere = comm.allgather((problems, found))
    named = list(dict.fromkeys(text for texts, _ in everywhere for text in texts))
    named += _sentences(_merge(found for _, found in everywhere))
    if named:
        raise ParticleFileError(named)
    return rows


def _inspect(
    path: Path | str, length: Sequence[float], fields: Mapping[str, Shape], part: tuple[int, int] | None = None
) -> tuple[list[str], Findings, ParticleRows]:
    """Open, check and, given `part` = (rank, size), keep that rank's rows; else check all rows and keep none.

    Findings of values stay apart for a part, to be merged over ranks; for the whole file they are among the problems.
    """
    import h5py

    none = ParticleRows(np.empty(0, dtype=np.int64), np.empty((0, len(length))), {})
    if not Path(path).is_file():
        return [f"{path}: no such file"], {}, none
    try:
        with h5py.File(path, "r") as file:
            problems, sets = _structure(file, str(path), {"position": (len(length),), **fields})
            if part is None:
                found = _merge(_check_rows(name, data, 0, len(data), length) for name, data in sets.items())
                return problems + _sentences(found), {}, none
            if problems:
                return problems, {}, none
            start, stop = (len(sets["position"]) * rank // part[1] for rank in (part[0], part[0] + 1))
            rows = {name: data[start:stop].astype(np.float64) for name, data in sets.items()}
    except OSError as error:
        return [f"{path}: cannot be read as HDF5: {error}"], {}, none
    found = _merge(find_broken(name, values, start, length) for name, values in rows.items())
    ids = np.arange(start, stop, dtype=np.int64)
    return [], found, ParticleRows(ids, rows.pop("position"), rows)


def _structure(file: h5py.File, path: str, shapes: Mapping[str, Shape]) -> tuple[list[str], dict[str, h5py.Dataset]]:
    """Return problems of names, shapes and types, and the data sets whose values can be looked at."""
    import h5py

    problems: list[str] = []
    sets: dict[str, h5py.Dataset] = {}
    if "position" not in file:
        problems.append(f"{path}: position is missing; expected a data set of shape (n, {shapes['position'][0]})")
    n = None
    for name, shape in shapes.items():
        if name not in file:
            continue
        data = file[name]
        if not isinstance(data, h5py.Dataset):
            problems.append(f"{path}: {name} is a group, expected a data set")
            continue
        fits = data.ndim == 1 + len(shape) and data.shape[1:] == shape and n in (None, data.shape[0])
        if not fits:
            wanted = ", ".join(["n" if n is None else str(n), *map(str, shape)]) + ("" if shape else ",")
            problems.append(f"{path}: {name} has shape {data.shape}, expected ({wanted})")
        elif name == "position":
            n = data.shape[0]
        if data.dtype.kind not in "fiu":
            problems.append(f"{path}: {name} has type {data.dtype}, expected real numbers")
        elif fits:
            sets[name] = data
    if n == 0:
        problems.append(f"{path}: position has no rows")
    return problems, sets


def _check_rows(name: str, data: h5py.Dataset, start: int, stop: int, length: Sequence[float]) -> Findings:
    """Look at rows of a data set, read in pieces, and return what is found in them."""
    row = data.dtype.itemsize * int(np.prod(data.shape[1:], dtype=np.int64))
    step = max(1, PIECE_BYTES // max(row, 1))
    pieces = ((at, data[at : min(at + step, stop)].astype(np.float64)) for at in range(start, stop, step))
    return _merge(find_broken(name, values, at, length) for at, values in pieces)


def find_broken(name: str, values: FloatArray, first_row: int, length: Sequence[float]) -> Findings:
    """Return the rules that some rows break: values that are not finite, positions outside of the box. Local."""
    table = columns_of(values)
    finite = np.isfinite(table).all(axis=1)
    rules = [(f"{name} is not finite", ~finite)]
    if name == "position":
        for axis, size in enumerate(length):
            outside = finite & ~((table[:, axis] >= 0.0) & (table[:, axis] < size))
            rules.append((f"position is outside [0, {size:g}) on axis {'xyz'[axis]}", outside))
    found: Findings = {}
    for rule, broken in rules:
        where = np.flatnonzero(broken)
        if where.size:
            value = ", ".join(repr(float(number)) for number in table[where[0]])
            found[rule] = (int(where.size), first_row + int(where[0]), f"({value})" if values.ndim > 1 else value)
    return found


def _merge(findings: Iterable[Findings]) -> Findings:
    """Return the findings of all, counts added, with the first row of each rule."""
    merged: Findings = {}
    for rule, (count, row, value) in _items(findings):
        before = merged.get(rule)
        if before is None:
            merged[rule] = (count, row, value)
        else:
            merged[rule] = (before[0] + count, *min(before[1:], (row, value)))
    return merged


def _items(findings: Iterable[Findings]) -> Iterator[tuple[str, tuple[int, int, str]]]:
    for found in findings:
        yield from found.items()


def _sentences(found: Findings) -> list[str]:
    return [
        f"{rule} in {count} row{'s' * (count > 1)}, first row {row}: {value}"
        for rule, (count, row, value) in sorted(found.items())
    ]

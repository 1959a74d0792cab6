"""Read particles from a file: plain HDF5, or an openPMD species of any code, in slices, on any number of ranks.

A plain file has `position` (n, d), and optionally fields (n, *shape) and `id` (n,) as data sets; without ids, the
number of a row is the id of its particle. Every rank reads only its own rows, at most about `PIECE_BYTES` at a time, by
a process of its own, see `mpipic.io.apart`: whatever the file holds, the answer is particles, or a `ParticleFileError`
on all ranks.
"""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np

from mpipic.arrays import FloatArray, IntArray, Shape, size_of
from mpipic.io.apart import Apart, Died
from mpipic.io.columns import ParticleFileError, reading
from mpipic.io.findings import (
    Findings,
    Outside,
    count_outside,
    find_broken,
    merge,
    merge_into,
    repeated,
    said_outside,
    sentences,
)
from mpipic.io.selection import ID, POSITION, Request, Selection, select, table_of
from mpipic.io.species import MARK, Series
from mpipic.memory import available_bytes
from mpipic.wording import escape

if TYPE_CHECKING:
    from mpi4py import MPI

__all__ = ["Box", "ParticleFileError", "ParticleRows", "Request", "check_particle_file", "read_particle_file"]

PIECE_BYTES = 32 << 20
COPIES = 2
"""How often a rank holds its particles while it takes them in."""


@dataclass(frozen=True)
class Box:
    """Size of a periodic box and spacing of its nodes, d numbers each."""

    length: Sequence[float]
    h: Sequence[float]


@dataclass(frozen=True)
class ParticleRows:
    """Rows of a particle file: ids (n,), positions (n, d) as they are there, fields that it has, what is to be said."""

    ids: IntArray
    position: FloatArray
    fields: Mapping[str, FloatArray]
    notes: Sequence[str] = ()


@dataclass(frozen=True)
class Head:
    """Holds what a file says before its numbers: rows, quantities given, what is wrong with it, what is to be said."""

    rows: int
    names: tuple[str, ...]
    problems: Sequence[str]
    notes: Sequence[str]


@dataclass(frozen=True)
class Piece:
    """Some rows of a file: the first, values by name, and ids where the file has some."""

    start: int
    values: Mapping[str, FloatArray]
    ids: IntArray | None


@dataclass
class Part:
    """Holds what one rank has read of a file."""

    problems: list[str] = field(default_factory=list)
    head: Head | None = None
    start: int = 0
    rows: dict[str, FloatArray] = field(default_factory=dict)
    ids: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    found: Findings = field(default_factory=dict)
    used: set[str] = field(default_factory=set)
    """Names of quantities that are not 0 in every row."""
    outside: Outside = field(default_factory=Outside)


def check_particle_file(request: Request, box: Box, comm: MPI.Comm, process: Apart | None = None) -> list[str]:
    """Read a file through and return what is to be said about it; parameters, errors as for `read_particle_file`.

    Notes
    -----
    Collective. Keeps no more than the ids: reads a file that has no room in memory.
    """
    return list(_take(request, box, comm, process, keep=False).notes)


def read_particle_file(request: Request, box: Box, comm: MPI.Comm, process: Apart | None = None) -> ParticleRows:
    """Read this rank's block of rows: rows n·rank/size to n·(rank + 1)/size.

    Parameters
    ----------
    request
        The file, and what of it is wanted.
    box
        Where positions shall lie. Axes wrap: they may be any number of periods off, see `mpipic.box`; how many are off
        is said.
    process
        The process of its own that reads; None: one for this call.

    Raises
    ------
    ParticleFileError
        On all ranks, with everything that is wrong with the whole file.

    Notes
    -----
    Collective. Every row is read and judged once, by the rank that keeps it.
    """
    return _take(request, box, comm, process, keep=True)


def _take(request: Request, box: Box, comm: MPI.Comm, process: Apart | None, keep: bool) -> ParticleRows:
    """Read, judge and, if wanted, keep this rank's rows; agree on what is wrong. Collective."""
    room = _room(comm) if keep else float("inf")
    own = process or Apart()
    try:
        part = _read(request, box, comm, own, room, keep)
    finally:
        if process is None:
            own.close()
    everywhere = comm.allgather((part.problems, part.found, part.outside, part.used))
    path = escape(request.path)
    problems = list(dict.fromkeys(text for texts, *_ in everywhere for text in texts))
    problems += sentences(path, merge(found for _, found, *_ in everywhere))
    if problems or part.head is None:
        raise ParticleFileError(*problems)
    twice = repeated(part.ids, part.start, comm) if ID in part.head.names else ""
    if twice:
        raise ParticleFileError(f'{path}: {twice}; particles.records = ["{ID}="] numbers them by row')
    notes = [*part.head.notes, *said_outside(path, [one for *_, one, _ in everywhere], part.head.rows, box.length)]
    idle = set(part.head.names) & set(request.fields) - set[str]().union(*(used for *_, used in everywhere))
    notes += [f"{path}: {name} is 0 in every row" for name in sorted(idle)]
    position = part.rows.pop(POSITION)
    return ParticleRows(part.ids, position, part.rows, notes)


def _read(request: Request, box: Box, comm: MPI.Comm, process: Apart, room: float, keep: bool) -> Part:
    """Read and judge this rank's rows; whatever is wrong is in the answer. Local."""
    part = Part()
    try:
        for item in process.run(pieces, request, comm.rank, comm.size):
            if isinstance(item, Head):
                _begin(part, item, request, comm, room, keep)
                continue
            _add(part, item, box, keep)
    except ParticleFileError as error:
        part.problems += error.problems
    except Died as error:
        part.problems.append(f"{escape(request.path)} cannot be read, the file is damaged: reading it {error}")
    except MemoryError:
        part.problems.append(f"{escape(request.path)} cannot be read: there is no memory for it")
    return part


def _add(part: Part, piece: Piece, box: Box, keep: bool) -> None:
    """Judge a piece and, if wanted, keep it."""
    for name, values in piece.values.items():
        merge_into(part.found, find_broken(name, values, piece.start, box.h))
        if np.count_nonzero(values):
            part.used.add(name)
        span = slice(piece.start - part.start, piece.start - part.start + len(values))
        if name == POSITION:
            count_outside(part.outside, values, box.length)
            if piece.ids is not None:
                part.ids[span] = piece.ids
        if keep:
            part.rows[name][span] = values


def _begin(part: Part, head: Head, request: Request, comm: MPI.Comm, room: float, keep: bool) -> None:
    """Take note of what a file says of itself, and make room for this rank's rows."""
    part.head = head
    part.problems += head.problems
    part.start, stop = block(head.rows, comm.rank, comm.size)
    count = 0 if head.problems else stop - part.start
    shapes: dict[str, Shape] = {POSITION: (request.dim,), **request.fields}
    needed = 8 * count * (1 + sum(size_of(shape) for shape in shapes.values())) * COPIES
    if needed > room:
        ranks = f"{comm.size} rank{'s' * (comm.size > 1)}"
        sizes = f"about {1e-9 * needed * comm.size:.3g} GB, and {1e-9 * room * comm.size:.3g} GB are free"
        raise ParticleFileError(f"{escape(request.path)}: {head.rows} particles need on {ranks} {sizes}")
    names = head.names if keep else ()
    part.rows = {name: np.empty((count, *shapes[name])) for name in (*names, POSITION) if name != ID}
    part.ids = np.arange(part.start, part.start + count if keep or ID in head.names else part.start, dtype=np.int64)


def block(rows: int, rank: int, size: int) -> tuple[int, int]:
    """Return the first row of a rank, and the first one after its rows."""
    return rows * rank // size, rows * (rank + 1) // size


def _room(comm: MPI.Comm) -> float:
    """Return the bytes that this rank can have: an equal share of what its machine has left. Collective."""
    machines = comm.allgather(platform.node())
    return available_bytes() / machines.count(machines[comm.rank] if len(machines) > comm.rank else machines[0])


# ---------------------------------------------------------------- what touches the file


def pieces(request: Request, rank: int, size: int) -> Iterator[Head | Piece]:
    """Yield the `Head` of a file and then, where it can be used, a rank's rows in pieces.

    Raises ParticleFileError. Local.
    """
    with reading(escape(request.path)), opened(request) as (file, found):
        selection = select(table_of(file, found), found)
        names = tuple(selection.values)
        yield Head(selection.rows, names, selection.problems, selection.notes)
        if selection.problems:
            return
        start, stop = block(selection.rows, rank, size)
        step = _step(selection)
        while start < stop:
            end = min(stop, (start // step + 1) * step)
            values = {name: one.read(start, end) for name, one in selection.values.items() if name != ID}
            ids = selection.values[ID].read_whole(start, end) if ID in selection.values else None
            yield Piece(start, values, ids)
            start = end


def _step(selection: Selection) -> int:
    """Return how many rows a piece has: as many as `PIECE_BYTES` hold, and whole chunks of the file's."""
    row = sum(8 * size_of(values.shape) for values in selection.values.values())
    columns = [column for values in selection.values.values() for column in (*values.columns, *values.offsets)]
    chunks = [column.data.chunks[0] for column in columns if column.data is not None and column.data.chunks]
    largest = max(chunks, default=1)
    return int(max(1, PIECE_BYTES // row // largest) * largest)


@contextmanager
def opened(request: Request) -> Iterator[tuple[h5py.File, Request]]:
    """Open the file of a request, or that of its series which has the iteration, and yield it with a request for it."""
    with _opened(request.path) as file:
        series = Series.of(file, escape(request.path)) if MARK in file.attrs else None
        other = series.sibling(request.iteration) if series else None
        if other is None:
            yield file, request
            return
    with _opened(str(other)) as file:
        yield file, replace(request, path=str(other))


@contextmanager
def _opened(path: str) -> Iterator[h5py.File]:
    where = escape(path)
    if not Path(path).exists():
        raise ParticleFileError(f"{where}: no such file")
    if not Path(path).is_file():
        raise ParticleFileError(f"{where}: is no regular file")
    with reading(f"{where}: as HDF5, it"):
        file = h5py.File(path, "r")
    try:
        yield file
    finally:
        with reading(where):
            file.close()

"""An HDF5 file that all ranks write together, whatever h5py they have, and that a failing disk leaves whole."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mpipic.agreement import together
from mpipic.files import write_at
from mpipic.io import hdf5
from mpipic.io.openpmd import Attributes, Block, Numbers, Tree

if TYPE_CHECKING:
    from mpi4py import MPI

PIECE_BYTES = 8 << 20


class SharedFile:
    """A growing HDF5 file: rank 0 lays out what is added, every rank writes its own blocks to their places.

    Where some rank cannot open the file that rank 0 created, as on nodes that do not share the folder, rank 0 writes
    for all and receives the blocks in rank order, at most `PIECE_BYTES` at a time.

    Parameters
    ----------
    path : file to create; an old one is replaced
    comm : mpi4py communicator, for this file alone
    attributes : of the file, those of rank 0
    group : name of a group to begin with

    Raises
    ------
    WriteFailed
        On all ranks, with the reason and the rank that met it.

    Notes
    -----
    Every method is collective.
    """

    def __init__(self, path: Path, comm: MPI.Comm, attributes: Attributes, group: str) -> None:
        self.path, self._comm = path, comm
        self._descriptor = -1
        self._staged: hdf5.StagedFile | None = None
        with together(comm, f"{path} cannot be created"):
            if comm.rank == 0:
                self._create(attributes, group)
        self._number: int = comm.bcast(os.fstat(self._descriptor).st_ino if comm.rank == 0 else 0)
        self.direct = all(comm.allgather(self._opens()))

    def add(self, name: str, tree: Tree, title: str) -> None:
        """Write what a tree describes as the group `name`: all of it, or nothing when that fails on any rank.

        `tree` describes the same data sets on all ranks, in the same order; messages call it by its `title`. Copies a
        piece of one component at a time; fields of nodes pass between the ranks once, so that each writes one run.
        """
        what = f"{title} cannot be written to {self.path}"
        try:
            offsets: dict[str, int] = {}
            with together(self._comm, what):
                if self._staged:
                    if os.stat(self.path).st_ino != self._number:
                        raise FileNotFoundError("another file has taken its place")
                    offsets = hdf5.add(self._staged, name, tree)
            offsets = self._comm.bcast(offsets)
            with together(self._comm, what):
                self._fill(tree, offsets)
            with together(self._comm, what):
                if self._staged:
                    self._staged.commit()
        except BaseException:
            if self._staged:
                self._staged.discard()
            raise

    def close(self) -> None:
        """Force everything to the disk and let go of the file."""
        with together(self._comm, f"{self.path} may not be whole on the disk"):
            if self._descriptor >= 0:
                try:
                    os.fsync(self._descriptor)
                finally:
                    os.close(self._descriptor)
                    self._descriptor = -1

    def _create(self, attributes: Attributes, group: str) -> None:
        self.path.unlink(missing_ok=True)
        self._descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        try:
            self._staged = hdf5.StagedFile(self._descriptor)
            hdf5.begin(self._staged, attributes, group)
            self._staged.commit()
        except OSError:
            os.close(self._descriptor)
            with suppress(OSError):
                self.path.unlink()
            raise

    def _opens(self) -> bool:
        """Return whether this rank can write to the very file that rank 0 created, having opened it if so."""
        if self._staged:
            return True
        try:
            self._descriptor = os.open(self.path, os.O_WRONLY)
        except OSError:
            return False
        return os.fstat(self._descriptor).st_ino == self._number

    def _fill(self, tree: Tree, offsets: dict[str, int]) -> None:
        """Write this rank's part of every data set; after a failure go on without writing, as the others go on."""
        problem: OSError | None = None
        for block in tree.blocks:
            if 0 in block.shape:
                continue
            start, values = _as_run(block, self._comm)
            place = offsets[block.path] + start * values.itemsize
            for at, piece in self._pieces(place, values):
                try:
                    if problem is None:
                        write_at(self._descriptor, np.ascontiguousarray(piece).data, at)
                except OSError as error:
                    problem = error
        if problem:
            raise problem

    def _pieces(self, place: int, values: Numbers) -> Iterator[tuple[int, Numbers]]:
        """Yield what this rank writes, (place in the file, values): of its own, or on rank 0 that of all in turn."""
        if self.direct:
            yield from _cut(place, values)
            return
        parts = self._comm.gather((place, len(values)))
        if parts is None:
            for _, piece in _cut(place, values):
                self._comm.Send(np.ascontiguousarray(piece), dest=0)
            return
        yield from _cut(place, values)
        for source, (begin, count) in list(enumerate(parts))[1:]:
            for at, piece in _cut(begin, np.empty(count, values.dtype)):
                self._comm.Recv(piece, source=source)
                yield at, piece


def _as_run(block: Block, comm: MPI.Comm) -> tuple[int, Numbers]:
    """Return a part of a data set that is one run of it in C order: (first element, values). Collective.

    A row of an array of particles is one as it is. Blocks of several axes lie in many short rows; ranks exchange their
    elements so that each holds one run: 16 bytes an element in one Alltoallv.
    """
    if len(block.shape) == 1:
        return block.start[0], block.data
    if comm.size == 1:
        return 0, np.ascontiguousarray(block.data).ravel()
    total = math.prod(block.shape)
    borders = [total * rank // comm.size for rank in range(comm.size + 1)]
    axes = (np.arange(start, start + count) for start, count in zip(block.start, block.data.shape, strict=True))
    where = np.ravel_multi_index(np.ix_(*axes), block.shape).ravel()
    counts = np.diff(np.searchsorted(where, borders))
    incoming = np.array(comm.alltoall(counts.tolist()))
    received = np.empty(incoming.sum(), where.dtype), np.empty(incoming.sum(), block.data.dtype)
    for mine, theirs in zip((where, np.ascontiguousarray(block.data).ravel()), received, strict=True):
        comm.Alltoallv([mine, counts], [theirs, incoming])
    first = borders[comm.rank]
    run = np.empty(borders[comm.rank + 1] - first, block.data.dtype)
    run[received[0] - first] = received[1]
    return first, run


def _cut(place: int, values: Numbers) -> Iterator[tuple[int, Numbers]]:
    """Yield pieces of at most `PIECE_BYTES` of values that go to `place` of the file, each with its own place."""
    rows = max(1, PIECE_BYTES // values.itemsize)
    for row in range(0, len(values), rows):
        yield place + row * values.itemsize, values[row : row + rows]

"""Particle snapshots in openPMD 1.1: one HDF5 file that grows while a run goes on, written by all ranks."""

from __future__ import annotations

import math
import os
import time as clock
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import h5py
import numpy as np

from mpipic.arrays import FloatArray, ParticleArrays
from mpipic.errors import OutputError
from mpipic.files import sync
from mpipic.io import hdf5, openpmd
from mpipic.io.openpmd import Blocks
from mpipic.io.run_directory import PART, SceneText

if TYPE_CHECKING:
    from mpi4py import MPI

PIECE_BYTES = 8 << 20
ARRIVAL_SECONDS = 2.0


class ParticleSeries:
    """Snapshots of particles and nodal fields in one openPMD 1.1 file, written by all ranks.

    On several ranks with a parallel h5py, each rank writes its own part by MPI-IO; otherwise rank 0 writes and receives
    the parts of the others in rank order, at most `PIECE_BYTES` at a time. Both give the same data. The file grows as
    `<path>.part`, is flushed after every snapshot, and gets its name in `close`: a run that dies leaves a readable
    `.part`. A snapshot is linked into the file only when all ranks wrote it whole.

    Parameters
    ----------
    path : final name, such as particles.h5; an older file there is replaced on closing
    comm : mpi4py communicator; a duplicate is used
    scene : kept as the file's comment where given

    Notes
    -----
    Creation, `write` and `close` are collective. Closing takes all ranks: when an exception leaves a `with` block on
    some ranks only, the series stays a `.part`, and the exception goes on.
    """

    def __init__(self, path: Path | str, comm: MPI.Comm, scene: SceneText | None = None) -> None:
        self.path = Path(path)
        self.part = self.path.with_name(self.path.name + PART)
        self._comm = comm.Dup()
        self._steps: set[int] = set()
        self.collective = self._comm.size > 1 and all(self._comm.allgather(hdf5.has_mpi()))
        comment = (scene.name, scene.to_toml()) if scene is not None else ()
        attributes = self._comm.bcast(openpmd.root_attributes(*comment) if self._comm.rank == 0 else None)
        self._file: h5py.File | None = None
        with self._together(f"{self.part} cannot be created"):
            if self.collective or self._comm.rank == 0:
                self._file = hdf5.create_file(self.part, self._comm if self.collective else None)
                self._file.attrs.update(attributes)
                self._file.create_group("data")
        self._open = True

    def write(
        self,
        step: int,
        time: float,
        dt: float,
        particles: ParticleArrays,
        grid: Blocks,
        nodal_fields: Mapping[str, FloatArray],
    ) -> None:
        """Add the snapshot of one step. Collective; copies one component of one field at a time.

        Parameters
        ----------
        step, time, dt : number and time of the step, step size
        particles : of this rank
        grid : the block of nodes of this rank
        nodal_fields : name to values on owned nodes, `owned_shape` + shape

        Raises
        ------
        OutputError
            Arrays that do not fit or differ between ranks, a step written before, or a failing disk. The series keeps
            the snapshots before this one and can go on.
        """
        if not self._open:
            raise OutputError(f"snapshot of step {step} cannot be written: {self.path} is closed")
        counts = self._comm.allgather(len(particles.ids))
        with self._together(f"snapshot of step {step} cannot be written"):
            if step in self._steps:
                raise ValueError("the step was written before")
            tree = openpmd.snapshot(time, dt, particles, counts, self._comm.rank, grid, nodal_fields)
        self._compare(step, tree)
        self._add(step, tree)
        self._steps.add(step)

    def _add(self, step: int, tree: openpmd.Tree) -> None:
        """Write a snapshot and, when all of it is there, link it into the file. Collective."""
        with self._together(f"{self.part}: snapshot of step {step} failed"):
            group, datasets = hdf5.create_tree(self._file, tree) if self._file else (None, {})
        try:
            self._fill(step, tree, datasets)
        except OutputError:
            hdf5.release(group, datasets)
            raise
        with self._together(f"{self.part}: snapshot of step {step} failed"):
            if self._file:
                self._file["data"][str(step)] = group
                hdf5.release(group, datasets)
                self._file.flush()

    def close(self) -> None:
        """Finish the file and give it its name; without snapshots, leave none. Collective; repeatable."""
        if not self._open:
            return
        self._open = False
        with self._together(f"{self.part} cannot be closed"):
            if self._file:
                self._file.close()
        with self._together(f"{self.path} cannot be put in place"):
            if self._comm.rank == 0 and self._steps:
                sync(self.part)
                os.replace(self.part, self.path)
            elif self._comm.rank == 0:
                self.part.unlink()
        self._comm.Free()

    def __enter__(self) -> ParticleSeries:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None or not self._open or self._all_arrive():
            self.close()

    def _all_arrive(self) -> bool:
        """Return whether all ranks left the `with` block, as after an interrupt of all; wait `ARRIVAL_SECONDS`."""
        request = self._comm.Ibarrier()
        deadline = clock.monotonic() + ARRIVAL_SECONDS
        while not request.Test():
            if clock.monotonic() > deadline:
                return False
            clock.sleep(0.001)
        return True

    @contextmanager
    def _together(self, what: str) -> Iterator[None]:
        """Run a block on all ranks and raise the same `OutputError` on all of them when it fails on any."""
        problem = None
        try:
            yield
        except (OSError, ValueError, RuntimeError, KeyError) as error:
            problem = f"rank {self._comm.rank}: {error}"
        problems = [text for text in self._comm.allgather(problem) if text]
        if problems:
            raise OutputError(f"{what}: {problems[0]}")

    def _compare(self, step: int, tree: openpmd.Tree) -> None:
        """Stop before the file is touched when the ranks would not create the same data sets: HDF5 would hang."""
        with self._together(f"snapshot of step {step} differs between ranks"):
            mine = tree.signature()
            expected = self._comm.bcast(mine)
            if mine != expected:
                different = [entry for entry in mine if entry not in expected]
                raise ValueError(f"not the data sets of rank 0: {different or 'some are missing, or in another order'}")

    def _fill(self, step: int, tree: openpmd.Tree, datasets: hdf5.DataSets) -> None:
        with self._together(f"{self.part}: snapshot of step {step} failed"):
            problem: Exception | None = None
            for block in tree.blocks:
                if 0 in block.shape:
                    continue
                try:
                    if self.collective:
                        hdf5.write_block(datasets[block.path], block.start, block.data, collective=True)
                    else:
                        self._pass_on(block, datasets.get(block.path))
                except (OSError, ValueError, RuntimeError) as error:
                    problem = problem or error  # the other ranks go on to the next block: stay in step with them
            if problem:
                raise problem

    def _pass_on(self, block: openpmd.Block, dataset: h5py.h5d.DatasetID | None) -> None:
        """Rank 0 writes its own part, then the parts of the others as they come, in pieces along the first axis."""
        comm, problem = self._comm, None
        places = comm.gather((block.start, block.data.shape))
        if places is None:
            for rows in _pieces(block.data.shape, block.data.itemsize):
                comm.Send(np.ascontiguousarray(block.data[rows]), dest=0)
            return
        for source, (start, shape) in enumerate(places):
            for rows in _pieces(shape, block.data.itemsize):
                if source:
                    piece = np.empty((rows.stop - rows.start, *shape[1:]), block.data.dtype)
                    comm.Recv(piece, source=source)
                else:
                    piece = block.data[rows]
                try:
                    hdf5.write_block(dataset, (start[0] + rows.start, *start[1:]), piece, collective=False)
                except (OSError, ValueError, RuntimeError) as error:
                    problem = problem or error  # go on receiving: the senders wait
        if problem:
            raise problem


def _pieces(shape: Sequence[int], itemsize: int) -> Iterator[slice]:
    """Yield ranges of the first axis that hold at most `PIECE_BYTES` but a row each; none for an empty array."""
    row = itemsize * math.prod(shape[1:])
    rows = max(1, PIECE_BYTES // max(row, 1))
    for start in range(0, shape[0] if row else 0, rows):
        yield slice(start, min(start + rows, shape[0]))

"""Particle snapshots in openPMD 1.1: one HDF5 file that grows while a run goes on, written by all ranks."""

from __future__ import annotations

import os
import time as clock
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from mpipic.agreement import together
from mpipic.arrays import FloatArray, ParticleArrays
from mpipic.errors import OutputError
from mpipic.io import openpmd
from mpipic.io.openpmd import Blocks
from mpipic.io.run_directory import PART, SceneText
from mpipic.io.shared_file import SharedFile

if TYPE_CHECKING:
    from mpi4py import MPI

ARRIVAL_SECONDS = 2.0


class ParticleSeries:
    """Snapshots of particles and nodal fields in one openPMD 1.1 file, written by all ranks.

    The file grows as `<path>.part` and gets its name in `close`: a run that dies leaves a readable `.part`. A snapshot
    becomes part of the file only when all ranks wrote it whole; what fails, as on a full disk, leaves those before it.

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
        self._comm = comm.Dup()
        self._steps: set[int] = set()
        comment = (scene.name, scene.to_toml()) if scene is not None else ()
        part = self.path.with_name(self.path.name + PART)
        self._file = SharedFile(part, self._comm, openpmd.root_attributes(*comment), "data")
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
            Arrays that do not fit or differ between ranks, a step written before; `WriteFailed` where the disk fails.
            The series keeps the snapshots before this one and can go on.
        """
        if not self._open:
            raise OutputError(f"snapshot of step {step} cannot be written: {self.path} is closed")
        counts = self._comm.allgather(len(particles.ids))
        with together(self._comm, f"snapshot of step {step} cannot be written"):
            if step in self._steps:
                raise ValueError("the step was written before")
            tree = openpmd.snapshot(time, dt, particles, counts, self._comm.rank, grid, nodal_fields)
        self._compare(step, tree)
        self._file.add(f"data/{step}", tree, f"snapshot of step {step}")
        self._steps.add(step)

    def close(self) -> None:
        """Finish the file and give it its name; without snapshots, leave none. Collective; repeatable."""
        if not self._open:
            return
        self._open = False
        self._file.close()
        with together(self._comm, f"{self.path} cannot be put in place"):
            if self._comm.rank == 0 and self._steps:
                os.replace(self._file.path, self.path)
            elif self._comm.rank == 0:
                self._file.path.unlink(missing_ok=True)
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

    def _compare(self, step: int, tree: openpmd.Tree) -> None:
        """Stop before the file is touched when the ranks do not have the same data sets."""
        with together(self._comm, f"snapshot of step {step} differs between ranks"):
            mine = tree.signature()
            expected = self._comm.bcast(mine)
            if mine != expected:
                different = [entry for entry in mine if entry not in expected]
                raise ValueError(f"not the data sets of rank 0: {different or 'some are missing, or in another order'}")

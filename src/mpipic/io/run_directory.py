"""Write what a run leaves behind: the run directory, its small text files, and particle snapshots in openPMD 1.1.

Every file appears whole or not at all: it is written under another name in the same folder, forced to disk and renamed.
h5py is imported by `ParticleSeries` alone, so that a run without snapshots never loads it.
"""

from __future__ import annotations

import csv
import io
import json
import math
import os
import re
import time as clock
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from mpipic.errors import Refused
from mpipic.files import plain, replacing, sync
from mpipic.io import openpmd

SCENE, SUMMARY, HISTORY = "scene.toml", "summary.json", "history.csv"
PARTICLES, ERROR_PLOT, SOLUTION_PLOT = "particles.h5", "error.png", "solution.png"
PART = ".part"
RESULTS = (SUMMARY, HISTORY, PARTICLES, PARTICLES + PART)
HISTORY_COLUMNS = (
    "step", "time", "max_density", "density_l1", "density_l2", "density_linf", "velocity_l1", "velocity_l2",
    "velocity_linf", "null_space_fraction", "seconds",
)  # fmt: skip
SCENE_HEADER = "# Every value of this run, resolved; run it again with: mpipic run scene.toml\n"
PIECE_BYTES = 8 << 20
ARRIVAL_SECONDS = 2.0


class OutputError(Refused):
    """Output that cannot be written, with the path and the reason; raised on all ranks together."""


class RunDirectory:
    """The folder of one run and its text files.

    Parameters
    ----------
    path : folder, created with its parents when missing
    comm : mpi4py communicator; rank 0 touches the disk
    overwrite : remove the files of an earlier run instead of refusing

    Raises
    ------
    OutputError
        The folder holds the results of another run, or a scene.toml that no run wrote, or cannot be written.

    Notes
    -----
    Creation is collective. The `write_*` methods act on rank 0 and do nothing elsewhere; any ranks may call them.
    """

    def __init__(self, path: Path | str, comm: Any, overwrite: bool = False) -> None:
        self.path = Path(path)
        self._writes = comm.rank == 0
        problem = comm.bcast(_prepare(self.path, overwrite) if self._writes else None)
        if problem:
            raise OutputError(problem)

    @staticmethod
    def default(scene_name: str, comm: Any, parent: Path | str = "runs") -> Path:
        """Create and return runs/<scene name>-<YYYYmmdd-HHMMSS>, with -2, -3, … when taken. Collective."""
        answer = comm.bcast(_claim(Path(parent), scene_name) if comm.rank == 0 else None)
        if isinstance(answer, str):
            raise OutputError(answer)
        return answer

    def write_scene(self, scene: Any) -> None:
        """Write scene.toml with every value resolved."""
        if self._writes:
            self._write(SCENE, SCENE_HEADER + scene.to_toml())

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Write summary.json as strict JSON: what is not finite becomes null; NumPy values and records are unpacked."""
        if self._writes:
            self._write(SUMMARY, json.dumps(plain(summary), indent=2, allow_nan=False, ensure_ascii=False) + "\n")

    def write_history(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Write history.csv, one line a row; None is an empty cell, floats read back to the same bits.

        Columns are `HISTORY_COLUMNS`, then any others in the order in which they appear.
        """
        if self._writes:
            columns = list(dict.fromkeys([*HISTORY_COLUMNS, *(key for row in rows for key in row)]))
            stream = io.StringIO()
            table = csv.writer(stream, lineterminator="\n")
            table.writerow(columns)
            table.writerows([_cell(row.get(column)) for column in columns] for row in rows)
            self._write(HISTORY, stream.getvalue())

    def _write(self, name: str, content: str) -> None:
        with replacing(self.path / name) as temporary:
            temporary.write_text(content, encoding="utf-8")


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return repr(float(value)) if isinstance(value, (float, np.floating)) else str(value)


def _prepare(path: Path, overwrite: bool) -> str | None:
    """Make the folder ready; returns what is wrong instead of raising, so that rank 0 can tell the others."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        taken = [name for name in RESULTS if (path / name).exists()]
        scene = path / SCENE
        if scene.exists() and not scene.read_text("utf-8", "replace").startswith(SCENE_HEADER):
            taken.append(SCENE)
        if taken and not overwrite:
            return f"output folder {path} already holds {', '.join(taken)}: name another folder, or ask to overwrite"
        for name in (*RESULTS, SCENE, ERROR_PLOT, SOLUTION_PLOT):
            (path / name).unlink(missing_ok=True)
        if not os.access(path, os.W_OK | os.X_OK):
            return f"output folder {path} cannot be written: permission denied"
    except OSError as error:
        return f"output folder {path} cannot be used: {error.strerror or error}"
    return None


def _claim(parent: Path, scene_name: str) -> Path | str:
    """Create a folder that did not exist before: two runs started in the same second get two folders."""
    name = re.sub(r"[^\w.-]+", "-", scene_name).strip("-.") or "run"
    stem = f"{name}-{clock.strftime('%Y%m%d-%H%M%S')}"
    count = 1
    while True:
        path = parent / (stem if count == 1 else f"{stem}-{count}")
        try:
            path.mkdir(parents=True)
            return path
        except FileExistsError:
            if not path.is_dir():
                return f"output folder {parent} cannot be used: {path} is not a folder"
            count += 1
        except OSError as error:
            return f"output folder {path} cannot be created: {error.strerror or error}"


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
    scene : has `name` and `to_toml()`, kept as the file's comment; may be None

    Notes
    -----
    Creation, `write` and `close` are collective. Closing takes all ranks: when an exception leaves a `with` block on
    some ranks only, the series stays a `.part`, and the exception goes on.
    """

    def __init__(self, path: Path | str, comm: Any, scene: Any = None) -> None:
        from mpipic.io import hdf5

        self.path = Path(path)
        self.part = self.path.with_name(self.path.name + PART)
        self._comm = comm.Dup()
        self._hdf5 = hdf5
        self._steps: set[int] = set()
        self._collective = self._comm.size > 1 and all(self._comm.allgather(hdf5.has_mpi()))
        self._holds = self._collective or self._comm.rank == 0
        comment = (scene.name, scene.to_toml()) if scene is not None else ()
        attributes = self._comm.bcast(openpmd.root_attributes(*comment) if self._comm.rank == 0 else None)
        self._file: Any = None
        with self._together(f"{self.part} cannot be created"):
            if self._holds:
                self._file = hdf5.create_file(self.part, self._comm if self._collective else None)
                self._file.attrs.update(attributes)
                self._file.create_group("data")
        self._open = True

    def write(
        self, step: int, time: float, dt: float, particles: Any, grid: Any, nodal_fields: Mapping[str, Any]
    ) -> None:
        """Add the snapshot of one step. Collective; copies one component of one field at a time.

        Parameters
        ----------
        step, time, dt : number and time of the step, step size
        particles : has `ids` (n_local,), `position` (n_local, d), `fields`, name -> (n_local,) or (n_local, k)
        grid : has `cells`, `length`, `owned_start`, `owned_shape`
        nodal_fields : name -> owned nodes, `owned_shape` or `owned_shape` + (k,)

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
        with self._together(f"{self.part}: snapshot of step {step} failed"):
            group, datasets = self._hdf5.create_tree(self._file, tree) if self._holds else (None, {})
        try:
            self._fill(step, tree, datasets)
        except OutputError:
            self._hdf5.release(group, datasets)
            raise
        with self._together(f"{self.part}: snapshot of step {step} failed"):
            if self._holds:
                self._file["data"][str(step)] = group
                self._hdf5.release(group, datasets)
                self._file.flush()
        self._steps.add(step)

    def close(self) -> None:
        """Finish the file and give it its name; without snapshots, leave none. Collective; repeatable."""
        if not self._open:
            return
        self._open = False
        with self._together(f"{self.part} cannot be closed"):
            if self._holds:
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
        """Whether all ranks left the `with` block, as after an interrupt of them all; waits `ARRIVAL_SECONDS`."""
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

    def _fill(self, step: int, tree: openpmd.Tree, datasets: Mapping[str, Any]) -> None:
        with self._together(f"{self.part}: snapshot of step {step} failed"):
            problem: Exception | None = None
            for block in tree.blocks:
                if 0 in block.shape:
                    continue
                try:
                    if self._collective:
                        self._hdf5.write_block(datasets[block.path], block.start, block.data, collective=True)
                    else:
                        self._pass_on(block, datasets.get(block.path))
                except (OSError, ValueError, RuntimeError) as error:
                    problem = problem or error  # the other ranks go on to the next block: stay in step with them
            if problem:
                raise problem

    def _pass_on(self, block: openpmd.Block, dataset: Any) -> None:
        """Rank 0 writes its own part, then the parts of the others as they come, in pieces along the first axis."""
        comm, problem = self._comm, None
        places = comm.gather((block.start, block.data.shape))
        if comm.rank != 0:
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
                    self._hdf5.write_block(dataset, (start[0] + rows.start, *start[1:]), piece, collective=False)
                except (OSError, ValueError, RuntimeError) as error:
                    problem = problem or error  # go on receiving: the senders wait
        if problem:
            raise problem


def _pieces(shape: Sequence[int], itemsize: int) -> Iterator[slice]:
    """Ranges of the first axis that hold at most `PIECE_BYTES`, at least one row each; none for an empty array."""
    row = itemsize * math.prod(shape[1:])
    rows = max(1, PIECE_BYTES // max(row, 1))
    for start in range(0, shape[0] if row else 0, rows):
        yield slice(start, min(start + rows, shape[0]))

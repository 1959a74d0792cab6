"""What each rank runs for `test_io_ranks.py`: python io_helpers.py FOLDER CASE...

A case writes to FOLDER/CASE; each is begun by all ranks together.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import numpy as np

from mpipic.errors import OutputError
from mpipic.io import shared_file, snapshots
from mpipic.io.apart import Apart
from mpipic.io.particle_file import Box, ParticleFileError, Request, read_particle_file
from mpipic.io.run_directory import RunDirectory
from mpipic.io.shared_file import SharedFile
from mpipic.io.snapshots import ParticleSeries
from mpipic.plots.sample import gather_sample
from mpipic.runtime import start

sys.path.insert(0, str(Path(__file__).parents[1]))

from damage_helpers import damaged, judge, write_all

COMM = start()
TOTAL, DAMAGED = 2003, 80


def owner(ids: np.ndarray, ranks: int) -> np.ndarray:
    """Scattered ownership; the last of three or more ranks holds nothing."""
    return (ids * 7 + ids // 11) % max(1, ranks - (ranks > 2))


def particle_values(ids: np.ndarray, dim: int) -> dict[str, np.ndarray]:
    """Position and fields as functions of the id: the same particles on any number of ranks."""
    factors = (0.617, 0.414, 0.732)[:dim]
    position = np.stack([((ids + 1) * factor % 1.0) * (axis + 1) for axis, factor in enumerate(factors)], axis=1)
    return {
        "position": position,
        "density": np.sin(ids),
        "velocity": np.cos(ids[:, None] + np.arange(dim)),
        "colour": (ids % 5).astype(np.int32),
    }


def particles_of(rank: int, ranks: int, dim: int) -> SimpleNamespace:
    """The particles of one rank, as views that are not contiguous."""
    ids = np.arange(TOTAL)
    ids = ids[owner(ids, ranks) == rank]
    values = particle_values(ids, dim)
    strided = {name: np.asfortranarray(np.repeat(array, 2, axis=0))[::2] for name, array in values.items()}
    return SimpleNamespace(ids=ids, position=strided.pop("position"), fields=strided)


def nodal_value(cells: tuple[int, ...]) -> np.ndarray:
    """A different number on every node."""
    return np.arange(np.prod(cells), dtype=float).reshape(cells) + 0.5


def grid_of(rank: int, ranks: int, dim: int) -> tuple[SimpleNamespace, dict[str, np.ndarray]]:
    """Uneven slabs along the last axis, so that blocks of a data set interleave in the file."""
    cells, length = (5, 4, 11)[-dim:], (1.0, 2.0, 3.0)[:dim]
    cuts = [cells[-1] * r * (r + 1) // (ranks * (ranks + 1)) for r in range(ranks + 1)]
    owned = (slice(None),) * (dim - 1) + (slice(cuts[rank], cuts[rank + 1]),)
    density = nodal_value(cells)[owned]
    start = (0,) * (dim - 1) + (cuts[rank],)
    grid = SimpleNamespace(cells=cells, length=length, owned_start=start, owned_shape=density.shape, comm=COMM)
    return grid, {"density": density, "velocity": np.stack([density * (k + 1) for k in range(dim)], axis=-1)}


def write_step(series: ParticleSeries, step: int, dim: int) -> None:
    """One snapshot of the particles and nodes above, time 0.25 a step."""
    grid, nodal = grid_of(COMM.rank, COMM.size, dim)
    series.write(step, 0.25 * step, 0.25, particles_of(COMM.rank, COMM.size, dim), grid, nodal)


def expect_error(action, *words: str) -> None:
    """The action raises an OutputError on every rank, with the same text that has all the words."""
    try:
        action()
        said = None
    except OutputError as error:
        said = str(error)
    everywhere = COMM.allgather(said)
    assert said is not None and len(set(everywhere)) == 1, everywhere
    assert all(word in said for word in words), said


def case_write(folder: Path) -> None:
    """Two snapshots in each dimension."""
    for dim in (1, 2, 3):
        with ParticleSeries(folder / f"{dim}.h5", COMM) as series:
            write_step(series, 0, dim)
            write_step(series, 10, dim)


def alone():
    """No rank but the first sees the file that it creates, as where nodes do not share the folder."""
    return mock.patch.object(SharedFile, "_opens", lambda self: COMM.rank == 0)


def case_funnel(folder: Path) -> None:
    """The same through rank 0, in pieces of a few rows."""
    with alone(), mock.patch.object(shared_file, "PIECE_BYTES", 400):
        case_write(folder)


def case_failure(folder: Path, writer: int = COMM.size - 1) -> None:
    """A snapshot that fails in the middle, on the last rank, leaves the others whole, and the series goes on."""
    with ParticleSeries(folder / "1.h5", COMM) as series:
        write_step(series, 0, 1)
        whole, calls = shared_file.write_at, []

        def failing(*args: object) -> None:
            whole(*args)
            calls.append(1)
            if len(calls) == 4 and COMM.rank == writer:
                raise OSError(errno.ENOSPC, "disk full")

        size = (folder / "1.h5.part").stat().st_size
        COMM.Barrier()
        with mock.patch.object(shared_file, "write_at", failing):
            expect_error(lambda: write_step(series, 1, 1), "step 1", "disk full", "free some space", "1.h5.part")
        COMM.Barrier()
        assert (folder / "1.h5.part").stat().st_size == size, "the space is given back"
        expect_error(lambda: write_step(series, 0, 1), "written before")
        wrong = particles_of(COMM.rank, COMM.size, 1)
        if COMM.rank == COMM.size - 1:
            wrong.fields["density"] = wrong.fields["density"].astype(np.float32)
        grid, nodal = grid_of(COMM.rank, COMM.size, 1)
        if COMM.size > 1:
            last = f"rank {COMM.size - 1}"
            expect_error(lambda: series.write(3, 0.75, 0.25, wrong, grid, nodal), "step 3", "density", last)
        write_step(series, 2, 1)


def case_failure_funnel(folder: Path) -> None:
    """The same when rank 0 writes for all."""
    with alone():
        case_failure(folder, writer=0)


def case_killed(folder: Path) -> None:
    """The run dies after two snapshots without closing."""
    series = ParticleSeries(folder / "1.h5", COMM)
    write_step(series, 0, 1)
    write_step(series, 1, 1)
    COMM.Barrier()
    os.kill(os.getpid(), 9)


def case_interrupt(folder: Path) -> None:
    """All ranks leave by an exception: the file is complete. Then one rank alone does: nobody waits for ever."""
    try:
        with ParticleSeries(folder / "1.h5", COMM) as series:
            write_step(series, 0, 1)
            raise KeyboardInterrupt
    except KeyboardInterrupt:
        pass
    COMM.Barrier()
    assert (folder / "1.h5").exists() and not (folder / "1.h5.part").exists()
    snapshots.ARRIVAL_SECONDS = 0.2
    try:
        with ParticleSeries(folder / "2.h5", COMM) as series:
            write_step(series, 0, 1)
            if COMM.rank == 0:
                raise ZeroDivisionError
            COMM.recv(source=0)
    except ZeroDivisionError:
        print("one rank left", flush=True)
        COMM.Abort(7)


def case_directory(folder: Path) -> None:
    """Names are agreed on, and refusal is the same everywhere."""
    paths = COMM.allgather([RunDirectory.default("a b/c", COMM, folder / "runs") for _ in range(3)])
    assert paths == [paths[0]] * COMM.size and len(set(paths[0])) == 3, paths
    run = RunDirectory(folder / "x" / "y", COMM)
    run.write_summary({"ranks": COMM.size})
    run.write_history(["step"], [{"step": 1}])
    COMM.Barrier()
    expect_error(lambda: RunDirectory(folder / "x" / "y", COMM), "summary.json", str(folder / "x" / "y"))


def case_sample(folder: Path) -> None:
    """A sample of at most 100 and one of everybody, saved for comparison."""
    particles = particles_of(COMM.rank, COMM.size, 2)
    few, everybody = gather_sample(particles, COMM, 100), gather_sample(particles, COMM)
    assert (few is None) == (COMM.rank != 0) == (everybody is None)
    if few is not None:
        np.savez(folder / "sample.npz", all=everybody["ids"], **few)


def case_read(folder: Path) -> None:
    """Rows are split without gaps; what is wrong on any rank is said on all, with the count of the whole file."""
    fields, box = {"density": (), "velocity": (1,)}, Box([1.0], [0.01])
    mine = read_particle_file(Request(str(folder / "good.h5"), 1, fields), box, COMM)
    assert set(mine.fields) == {"density"}
    assert np.array_equal(mine.fields["density"], mine.ids) and mine.fields["density"].dtype == np.float64
    assert np.array_equal(np.concatenate(COMM.allgather(mine.ids)), np.arange(7))
    assert abs(len(mine.ids) - 7 / COMM.size) < 1
    wrapped = "2 of 7 positions lie outside the box [0, 1) and were wrapped; furthest x = -2.75"
    said = read_particle_file(Request(str(folder / "outside.h5"), 1, {}), box, COMM).notes
    assert COMM.allgather(list(said)) == [[f"{folder}/outside.h5: {wrapped}"]] * COMM.size, said
    for name, problem in (
        ("bad.h5", "in 2 rows, first row 1: (nan)"),
        ("none.h5", "no such file"),
        ("twice.h5", "id is repeated in 3 rows: 8 is in row 0 and in row 4"),
    ):
        said = refused(Request(str(folder / name), 1, {}), box)
        assert len(said) == 1 and problem in said[0], said
    with Lonely() as process:  # one rank's trouble is everybody's
        said = refused(Request(str(folder / "good.h5"), 1, fields), box, process)
    assert len(said) == 1 and "the file is damaged: reading it ended by SIGKILL" in said[0], said


def case_damaged(folder: Path) -> None:
    """Files with damage anywhere are read or refused on all ranks alike."""
    if COMM.rank == 0:
        for number, (_, data) in enumerate(damaged(write_all(folder), seed=11, count=DAMAGED)):
            (folder / f"copy{number}.h5").write_bytes(data)
    COMM.Barrier()
    outcomes = []
    with Apart(patience=10.0) as process:
        for number in range(DAMAGED):
            everywhere = COMM.allgather(judge(folder / f"copy{number}.h5", process, COMM))
            assert everywhere in (["read"] * COMM.size, ["refused"] * COMM.size), (number, everywhere)
            outcomes.append(everywhere[0])
    assert min(outcomes.count("read"), outcomes.count("refused")) > DAMAGED // 5


class Lonely(Apart):
    """A process of its own that is killed on the last rank before it answers."""

    def _start(self) -> bool:
        started = super()._start()
        if COMM.rank == COMM.size - 1:
            os.kill(self._process.pid, signal.SIGKILL)
        return started


def refused(request: Request, box: Box, process: Apart | None = None) -> list[str]:
    """What is wrong with a file, said alike on all ranks."""
    try:
        read_particle_file(request, box, COMM, process)
        said = []
    except ParticleFileError as error:
        said = error.problems
    everywhere = COMM.allgather(said)
    assert everywhere == [said] * COMM.size, everywhere
    return said


if __name__ == "__main__":
    for name in sys.argv[2:]:
        COMM.Barrier()
        globals()[f"case_{name}"](Path(sys.argv[1]) / name)
        os.write(1, f"rank {COMM.rank} of {COMM.size} did {name}\n".encode())  # one write: prints may come out mixed

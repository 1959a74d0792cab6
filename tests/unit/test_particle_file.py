"""Claims about reading particles from HDF5 files."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
from mpi4py import MPI

from mpipic.io import particle_file
from mpipic.io.particle_file import ParticleFileError, check_particle_file, read_particle_file

COMM = MPI.COMM_SELF
FIELDS = {dim: {"density": (), "velocity": (dim,)} for dim in (1, 2)}
N = 50


def save(path: Path, **sets: Any) -> Path:
    with h5py.File(path, "w") as file:
        for name, values in sets.items():
            file[name] = values
    return path


@pytest.fixture
def good() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(3)
    return {"position": rng.random((N, 2)) * [1.0, 4.0], "density": rng.random(N), "velocity": rng.random((N, 2))}


def test_a_good_file_has_no_problems_and_reads_back(tmp_path: Path, good: dict[str, np.ndarray]) -> None:
    path = save(tmp_path / "p.h5", **good)
    assert check_particle_file(path, (1.0, 4.0), FIELDS[2]) == []
    data = read_particle_file(path, (1.0, 4.0), FIELDS[2], COMM)
    assert data.ids.dtype == np.int64 and np.array_equal(data.ids, np.arange(N))
    read = {"position": data.position, **data.fields}
    assert set(read) == set(good) and all(np.array_equal(read[name], good[name]) for name in good)


def test_fields_may_be_tensors(tmp_path: Path, good: dict[str, np.ndarray]) -> None:
    shapes = {"F": (2, 2), "mass": ()}
    good["F"] = np.random.default_rng(4).random((N, 2, 2))
    path = save(tmp_path / "p.h5", **good)
    data = read_particle_file(path, (1.0, 4.0), shapes, COMM)
    assert set(data.fields) == {"F"} and np.array_equal(data.fields["F"], good["F"])
    good["F"][3, 1, 0] = np.nan
    (problem,) = check_particle_file(save(tmp_path / "p.h5", **good), (1.0, 4.0), shapes)
    assert problem.startswith("F is not finite in 1 row, first row 3: (")
    (problem,) = check_particle_file(save(tmp_path / "p.h5", **good), (1.0, 4.0), {"F": (2,)})
    assert f"F has shape ({N}, 2, 2), expected ({N}, 2)" in problem


def test_fields_are_optional_and_other_real_types_become_float64(tmp_path: Path) -> None:
    path = save(tmp_path / "p.h5", position=np.zeros((3, 1), np.float32), density=np.arange(3, dtype=np.uint8))
    data = read_particle_file(path, (1.0,), FIELDS[1], COMM)
    assert set(data.fields) == {"density"}
    assert data.position.dtype == data.fields["density"].dtype == np.float64
    assert list(data.fields["density"]) == [0.0, 1.0, 2.0]


@pytest.mark.parametrize("ranks", [1, 2, 3, 7, 60])
def test_blocks_of_rows_cover_the_file_once(tmp_path: Path, good: dict[str, np.ndarray], ranks: int) -> None:
    path = save(tmp_path / "p.h5", **good)
    blocks = []
    for rank in range(ranks):
        comm = SimpleNamespace(rank=rank, size=ranks, allgather=lambda value: [value])
        blocks.append(read_particle_file(path, (1.0, 4.0), FIELDS[2], comm))
    assert np.array_equal(np.concatenate([block.ids for block in blocks]), np.arange(N))
    assert np.array_equal(np.concatenate([block.fields["velocity"] for block in blocks]), good["velocity"])
    sizes = [len(block.ids) for block in blocks]
    assert max(sizes) - min(sizes) <= 1 and blocks[0].position.shape[1] == 2


@pytest.mark.parametrize("piece", [1, 100, 1 << 20])
def test_values_are_judged_row_by_row_whatever_the_pieces(
    tmp_path: Path, good: dict[str, np.ndarray], piece: int, monkeypatch: Any
) -> None:
    monkeypatch.setattr(particle_file, "PIECE_BYTES", piece)
    good["position"][[7, 9]] = [[0.5, 4.0], [0.5, -1e-9]]
    good["position"][20] = [1.0, 0.5]
    good["position"][30] = [np.nan, 9.0]
    good["density"][[11, 40, 41]] = [np.inf, np.nan, 0.0]
    good["velocity"][3, 1] = -np.inf
    path = save(tmp_path / "p.h5", **good)
    problems = check_particle_file(path, (1.0, 4.0), FIELDS[2])
    assert problems == [
        "density is not finite in 2 rows, first row 11: inf",
        "position is not finite in 1 row, first row 30: (nan, 9.0)",
        "position is outside [0, 1) on axis x in 1 row, first row 20: (1.0, 0.5)",
        "position is outside [0, 4) on axis y in 2 rows, first row 7: (0.5, 4.0)",
        f"velocity is not finite in 1 row, first row 3: ({good['velocity'][3, 0]!r}, -inf)",
    ]
    with pytest.raises(ParticleFileError) as caught:
        read_particle_file(path, (1.0, 4.0), FIELDS[2], COMM)
    assert caught.value.problems == problems


@pytest.mark.parametrize(
    ("sets", "words"),
    [
        ({"density": np.zeros(3)}, ["position is missing", "(n, 2)"]),
        ({"position": np.zeros(3)}, ["position has shape (3,), expected (n, 2)"]),
        ({"position": np.zeros((3, 3))}, ["position has shape (3, 3), expected (n, 2)"]),
        ({"position": np.zeros((0, 2))}, ["no rows"]),
        ({"position": np.zeros((3, 2), complex)}, ["position has type complex128"]),
        ({"position": np.zeros((3, 2), "S4")}, ["position has type |S4"]),
        ({"position": np.zeros((3, 2), bool)}, ["position has type bool"]),
        ({"position": 1.0}, ["position has shape ()"]),
        ({"position/x": np.zeros(3)}, ["position is a group"]),
        ({"position": np.zeros((3, 2)), "density": np.zeros(4)}, ["density has shape (4,), expected (3,)"]),
        ({"position": np.zeros((3, 2)), "velocity": np.zeros((3, 1))}, ["velocity has shape (3, 1), expected (3, 2)"]),
    ],
)
def test_a_wrong_structure_is_named(tmp_path: Path, sets: dict[str, Any], words: list[str]) -> None:
    path = save(tmp_path / "p.h5", **sets)
    problems = check_particle_file(path, (1.0, 1.0), FIELDS[2])
    assert len(problems) == 1 and str(path) in problems[0]
    assert all(word in problems[0] for word in words), problems
    with pytest.raises(ParticleFileError) as caught:
        read_particle_file(path, (1.0, 1.0), FIELDS[2], COMM)
    assert caught.value.problems == problems


def test_all_problems_come_at_once(tmp_path: Path) -> None:
    path = save(
        tmp_path / "p.h5", position=np.full((3, 1), 2.0), density=np.zeros((3, 3)), velocity=np.zeros((3, 1), complex)
    )
    problems = check_particle_file(path, (1.0,), FIELDS[1])
    assert len(problems) == 3
    assert [word in " ".join(problems) for word in ("density has shape", "velocity has type", "3 rows")] == [True] * 3


@pytest.mark.parametrize("kind", ["missing", "folder", "text"])
def test_what_is_no_hdf5_file_is_a_problem_and_no_traceback(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "p.h5"
    if kind == "folder":
        path.mkdir()
    elif kind == "text":
        path.write_text("not HDF5")
    (problem,) = check_particle_file(path, (1.0,), FIELDS[1])
    assert str(path) in problem and ("HDF5" if kind == "text" else "no such file") in problem


def test_a_huge_file_is_checked_in_pieces(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(particle_file, "PIECE_BYTES", 8 * 1000)
    sizes: list[int] = []
    whole = particle_file.find_broken
    monkeypatch.setattr(particle_file, "find_broken", lambda *a: (sizes.append(a[1].nbytes), whole(*a))[1])
    path = save(tmp_path / "p.h5", position=np.full((10_500, 1), 0.5))
    assert check_particle_file(path, (1.0,), FIELDS[1]) == []
    assert max(sizes) <= 8000 and sum(sizes) == 8 * 10_500

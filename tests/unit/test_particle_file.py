"""Claims about reading particles from plain HDF5 files."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
from mpi4py import MPI

from mpipic.io import particle_file
from mpipic.io.apart import Apart
from mpipic.io.particle_file import (
    Box,
    ParticleFileError,
    ParticleRows,
    Request,
    check_particle_file,
    read_particle_file,
)

COMM = MPI.COMM_SELF
FIELDS = {dim: {"density": (), "velocity": (dim,)} for dim in (1, 2)}
N = 50


class Here(Apart):
    """Does tasks in this process, where a test can look into them."""

    def _start(self) -> bool:
        return False


@pytest.fixture(scope="module")
def process() -> Iterator[Apart]:
    """One process of its own for all files: starting one takes longer than reading a small file."""
    with Apart() as one:
        yield one


def read(
    path: Path, length: tuple, fields: dict, process: Apart, comm: Any = COMM, cells: int = 100, **more: Any
) -> ParticleRows:
    box = Box(length, [size / cells for size in length])
    return read_particle_file(Request(str(path), len(length), fields, **more), box, comm, process)


def refusal(path: Path, length: tuple, fields: dict, process: Apart, **more: Any) -> list[str]:
    """The problems of a file, the same whether it is checked or read, without the name of the file before each."""
    request, box = Request(str(path), len(length), fields, **more), Box(length, [size / 100 for size in length])
    said = []
    for verb in (check_particle_file, read_particle_file):
        with pytest.raises(ParticleFileError) as caught:
            verb(request, box, COMM, process)
        said.append(caught.value.problems)
    assert said[0] == said[1] and all(text.startswith(f"{path}: ") for text in said[0]), said
    return [text.removeprefix(f"{path}: ") for text in said[0]]


def save(path: Path, **sets: Any) -> Path:
    with h5py.File(path, "w") as file:
        for name, values in sets.items():
            file[name] = values
    return path


@pytest.fixture
def good() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(3)
    return {"position": rng.random((N, 2)) * [1.0, 4.0], "density": rng.random(N), "velocity": rng.random((N, 2))}


def test_a_good_file_has_no_problems_and_reads_back(
    tmp_path: Path, good: dict[str, np.ndarray], process: Apart
) -> None:
    path = save(tmp_path / "p.h5", **good)
    request, box = Request(str(path), 2, FIELDS[2]), Box((1.0, 4.0), (0.1, 0.1))
    assert check_particle_file(request, box, COMM, process) == []
    data = read_particle_file(request, box, COMM)
    assert data.ids.dtype == np.int64 and np.array_equal(data.ids, np.arange(N)) and list(data.notes) == []
    found = {"position": data.position, **data.fields}
    assert set(found) == set(good) and all(np.array_equal(found[name], good[name]) for name in good)


def test_fields_may_be_tensors(tmp_path: Path, good: dict[str, np.ndarray], process: Apart) -> None:
    shapes = {"F": (2, 2), "mass": ()}
    del good["density"], good["velocity"]
    good["F"] = np.random.default_rng(4).random((N, 2, 2))
    data = read(save(tmp_path / "p.h5", **good), (1.0, 4.0), shapes, process)
    assert set(data.fields) == {"F"} and np.array_equal(data.fields["F"], good["F"])
    assert list(data.notes) == [f"{tmp_path}/p.h5: mass is missing, and starts at zero"]
    good["F"][3, 1, 0] = np.nan
    (problem,) = refusal(save(tmp_path / "p.h5", **good), (1.0, 4.0), shapes, process)
    assert problem.startswith("F is not finite in 1 row, first row 3: (")
    (problem,) = refusal(save(tmp_path / "p.h5", **good), (1.0, 4.0), {"F": (2,)}, process)
    assert problem == f"F has shape ({N}, 2, 2), expected (n, 2)"


def test_other_real_types_become_float64(tmp_path: Path, process: Apart) -> None:
    for kind in ("f2", "f4", ">f8", "i1", "u2", ">i4", "u8", "g"):
        path = save(tmp_path / "p.h5", position=np.zeros((3, 1), kind), density=np.arange(3).astype(kind))
        data = read(path, (1.0,), FIELDS[1], process)
        assert data.position.dtype == data.fields["density"].dtype == np.float64
        assert list(data.fields["density"]) == [0.0, 1.0, 2.0], kind


@pytest.mark.parametrize("ranks", [1, 2, 3, 7, 60])
def test_blocks_of_rows_cover_the_file_once(
    tmp_path: Path, good: dict[str, np.ndarray], ranks: int, process: Apart
) -> None:
    path = save(tmp_path / "p.h5", **good)
    blocks = []
    for rank in range(ranks):
        comm = SimpleNamespace(rank=rank, size=ranks, allgather=lambda value: [value])
        blocks.append(read(path, (1.0, 4.0), FIELDS[2], process, comm))
    assert np.array_equal(np.concatenate([block.ids for block in blocks]), np.arange(N))
    assert np.array_equal(np.concatenate([block.fields["velocity"] for block in blocks]), good["velocity"])
    sizes = [len(block.ids) for block in blocks]
    assert max(sizes) - min(sizes) <= 1 and blocks[0].position.shape[1] == 2


@pytest.mark.parametrize("piece", [1, 100, 1 << 20])
def test_values_are_judged_row_by_row_whatever_the_pieces(
    tmp_path: Path, good: dict[str, np.ndarray], piece: int, monkeypatch: Any
) -> None:
    monkeypatch.setattr(particle_file, "PIECE_BYTES", piece)
    good["position"][[7, 9]] = [[0.5, 1e300], [-1e17, 0.5]]
    good["position"][30] = [np.nan, 9.0]
    good["density"][[11, 40, 41]] = [np.inf, np.nan, 0.0]
    good["velocity"][3, 1] = -np.inf
    path = save(tmp_path / "p.h5", **good)
    assert refusal(path, (1.0, 4.0), FIELDS[2], Here()) == [
        "density is not finite in 2 rows, first row 11: inf",
        "position is not finite in 1 row, first row 30: (nan, 9.0)",
        "position is so far away that its digits do not tell its cell in 2 rows, first row 7: (0.5, 1e+300)",
        f"velocity is not finite in 1 row, first row 3: ({good['velocity'][3, 0]!r}, -inf)",
    ]


@pytest.mark.parametrize("piece", [1, 1 << 20])
def test_positions_off_the_box_are_counted_and_those_on_its_face_are_not(
    tmp_path: Path, piece: int, monkeypatch: Any
) -> None:
    monkeypatch.setattr(particle_file, "PIECE_BYTES", piece)
    length = (35.8569, 0.1)
    position = np.array([[1.0, 0.1], [35.8569, -1e-17], [35.85686, 0.0], [-1.0, 0.05], [35.9, 0.25], [0.0, 0.05]])
    path = save(tmp_path / "p.h5", position=position)
    data = read(path, length, {}, Here())
    assert np.array_equal(data.position, position)
    box = "[0, 35.8569) x [0, 0.1)"
    wrapped = f"2 of 6 positions lie outside the box {box} and were wrapped; furthest y = 0.25"
    assert list(data.notes) == [f"{path}: {wrapped}"]
    path = save(tmp_path / "p.h5", position=position[:3])
    assert list(read(path, length, {}, Here()).notes) == []
    path = save(tmp_path / "p.h5", position=[[35.85686], [0.2]])
    (note,) = read(path, (35.8568,), {}, Here()).notes
    assert note.endswith("1 of 2 positions lies outside the box [0, 35.8568) and was wrapped; furthest x = 35.85686")


def shared(folder: Path) -> dict[str, Any]:
    """Things that are wrong with a data set called density, by what makes them."""
    return {
        "group": lambda file: file.create_group("density"),
        "type": lambda file: file.__setitem__("density", np.dtype("f8")),
        "empty": lambda file: file.__setitem__("density", h5py.Empty("f8")),
        "loop": lambda file: file.update({"density": h5py.SoftLink("/round"), "round": h5py.SoftLink("/density")}),
        "soft": lambda file: file.__setitem__("density", h5py.SoftLink("/no/where")),
        "external": lambda file: file.__setitem__("density", h5py.ExternalLink("no.h5", "/density")),
        "external-fifo": lambda file: file.__setitem__("density", h5py.ExternalLink(f"{folder}/fifo", "/density")),
        "external-zero": lambda file: file.__setitem__("density", h5py.ExternalLink("/dev/zero", "/density")),
        "never-written": lambda file: file.create_dataset("density", (N,)),
        "half-written": lambda file: file.create_dataset("density", (N,), chunks=(10,)).__setitem__(slice(20), 1.0),
        "raw-lost": lambda file: file.create_dataset("density", (N,), external=[(f"{folder}/no.raw", 0, 8 * N)]),
        "virtual-lost": lambda file: virtual(file, f"{folder}/no.h5", N),
        "virtual-part": lambda file: virtual(file, f"{folder}/source.h5", N - 1),
    }


def virtual(file: h5py.File, source: str, rows: int) -> None:
    layout = h5py.VirtualLayout((N,), "f8")
    layout[:rows] = h5py.VirtualSource(source, "density", (N,))[:rows]
    file.create_virtual_dataset("density", layout)


SHARED = {
    "group": "density is a group, expected a data set",
    "type": "density is a type, expected a data set",
    "empty": "density is empty (it has no shape), expected rows of numbers",
    "loop": "density is a link to /round and cannot be read: ",
    "soft": "density is a link to /no/where and cannot be read: ",
    "external": "density is a link to no.h5:/density and cannot be read: ",
    "external-fifo": "/fifo, which is no regular file",
    "external-zero": "density is a link to /dev/zero, which is no regular file",
    "never-written": f"density holds 0 of the {4 * N} bytes of its shape ({N},): the others were never written",
    "half-written": f"density holds 2 of the 5 chunks of its shape ({N},): the others were never written",
    "raw-lost": "/no.raw, which is not there or no regular file",
    "virtual-lost": "/no.h5, which is not there or no regular file",
    "virtual-part": f"density is virtual, and maps {N - 1} of the {N} numbers of its shape ({N},)",
}


def test_what_is_not_there_never_becomes_zeros(tmp_path: Path, good: dict[str, np.ndarray], process: Apart) -> None:
    os.mkfifo(tmp_path / "fifo")
    save(tmp_path / "source.h5", density=np.zeros(N))
    assert list(shared(tmp_path)) == list(SHARED)
    for name, make in shared(tmp_path).items():
        with h5py.File(save(tmp_path / "p.h5", position=good["position"]), "a") as file:
            make(file)
        (problem,) = refusal(tmp_path / "p.h5", (1.0, 4.0), {"density": ()}, process)
        assert SHARED[name] in problem, (name, problem)


def test_links_and_virtual_data_sets_that_lead_somewhere_are_read(
    tmp_path: Path, good: dict[str, np.ndarray], process: Apart
) -> None:
    save(tmp_path / "source.h5", **good)
    values = good["density"]
    values.tofile(tmp_path / "values.raw")
    makers = {
        "soft": lambda file: file.update({"density": h5py.SoftLink("/other/rho"), "other/rho": values}),
        "external": lambda file: file.__setitem__("density", h5py.ExternalLink("source.h5", "/density")),
        "virtual": lambda file: virtual(file, "source.h5", N),
        "raw": lambda file: file.create_dataset("density", (N,), "f8", external=[(f"{tmp_path}/values.raw", 0, 8 * N)]),
    }
    for name, make in makers.items():
        with h5py.File(save(tmp_path / "p.h5", position=good["position"]), "a") as file:
            make(file)
        data = read(tmp_path / "p.h5", (1.0, 4.0), {"density": ()}, process)
        assert np.array_equal(data.fields["density"], values), name


TEXT = h5py.string_dtype()


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
        (
            {"position": np.zeros((3, 2), [("x", "f8"), ("y", "f8")])},
            ["position has type [('x', '<f8'), ('y', '<f8')]"],
        ),
        ({"position": np.full((3, 2), "a", TEXT)}, ["position has type object"]),
        ({"position": np.full((3, 2), h5py.Reference(), h5py.ref_dtype)}, ["position has type object"]),
        ({"position": np.zeros((3, 2), "V8")}, ["position has type |V8"]),
        ({"position": 1.0}, ["position has shape ()"]),
        ({"position/x": np.zeros(3)}, ["position is a group"]),
        ({"position": np.zeros((3, 2)), "density": np.zeros(4)}, ["density has shape (4,), expected (3,)"]),
        ({"position": np.zeros((3, 2)), "density": 1.0}, ["density has shape (), expected (n,)"]),
        ({"position": np.zeros((3, 2)), "velocity": np.zeros((3, 1))}, ["velocity has shape (3, 1), expected (n, 2)"]),
        ({"position": np.zeros((3, 2)), "id": np.zeros(3)}, ["id must hold whole numbers"]),
        ({"position": np.zeros((3, 2)), "id": [4, 9, 4]}, ["id is repeated in 1 row: 4 is in row 0 and in row 2"]),
        (
            {"position": np.zeros((2, 2)), "id": np.array([1, 2**63], "u8")},
            ["id holds 9223372036854775808, which is above"],
        ),
    ],
)
def test_a_wrong_structure_is_named(tmp_path: Path, sets: dict[str, Any], words: list[str], process: Apart) -> None:
    fields = {name: shape for name, shape in FIELDS[2].items() if name in sets}
    problems = refusal(save(tmp_path / "p.h5", **sets), (1.0, 1.0), fields, process)
    assert len(problems) == 1 and all(word in problems[0] for word in words), problems


def test_all_problems_come_at_once(tmp_path: Path, process: Apart) -> None:
    path = save(
        tmp_path / "p.h5", position=np.zeros((3, 2)), density=np.zeros((3, 3)), velocity=np.zeros((3, 1), complex)
    )
    problems = refusal(path, (1.0,), FIELDS[1], process)
    assert [text.split(", expected")[0] for text in problems] == [
        "position has shape (3, 2)", "density has shape (3, 3)", "velocity has type complex128",
    ]  # fmt: skip


NAMES = {
    "Density": "density", "densities": "density", "dens": "density", "density_": "density", "desnity": "density",
    "vel": "velocity", "Velocity": "velocity", "velocities": "velocity", "VELOCITY": "velocity", "pos": "position",
    "Position": "position", "positions": "position",
}  # fmt: skip


def test_a_name_that_is_nearly_right_is_refused_with_the_name_that_is_near(
    tmp_path: Path, good: dict[str, np.ndarray], process: Apart
) -> None:
    for wrong, right in NAMES.items():
        sets = {wrong if name == right else name: values for name, values in good.items()}
        path = save(tmp_path / "p.h5", **sets)
        (problem,) = refusal(path, (1.0, 4.0), FIELDS[2], process)
        assert problem.startswith(f"{right} is missing; ") and f'Did you mean "{wrong}"?' in problem
        assert f'particles.records = ["{right}={wrong}"]' in problem and "the file has" in problem
        data = read(path, (1.0, 4.0), FIELDS[2], process, records={right: wrong})
        found = {"position": data.position, **data.fields}
        assert np.array_equal(found[right], good[right]) and list(data.notes) == []


def test_fields_come_from_somewhere_or_are_said_to_be_zero(
    tmp_path: Path, good: dict[str, np.ndarray], process: Apart
) -> None:
    position, density = good["position"], good["density"]
    path = save(tmp_path / "p.h5", position=position, rho=density, u=density)
    problems = refusal(path, (1.0, 4.0), FIELDS[2], process)
    assert [text.split(";")[0] for text in problems] == ["density is missing", "velocity is missing"]
    assert all("the file has position, rho and u" in text for text in problems)
    data = read(path, (1.0, 4.0), FIELDS[2], process, records={"density": "rho", "velocity": ""})
    assert set(data.fields) == {"density"} and list(data.notes) == [f"{path}: u is not used"]
    data = read(path, (1.0, 4.0), FIELDS[2], process, records={"density": "rho"})
    assert list(data.notes) == [f"{path}: velocity is missing, and starts at zero", f"{path}: u is not used"]
    (problem,) = refusal(path, (1.0, 4.0), FIELDS[2], process, records={"density": "rhoo", "velocity": ""})
    assert problem == 'rhoo is not there, to be density; the file has position, rho and u. Did you mean "rho"?'


def test_fields_that_something_else_gives_are_neither_read_nor_passed_over(
    tmp_path: Path, good: dict[str, np.ndarray], process: Apart
) -> None:
    good["density"][3] = np.nan
    path = save(tmp_path / "p.h5", **good, colour=np.zeros(N))
    data = read(path, (1.0, 4.0), {}, process, elsewhere=dict.fromkeys(FIELDS[2], "a profile gives them"))
    assert not data.fields
    assert list(data.notes) == [
        f"{path}: density and velocity are not used: a profile gives them", f"{path}: colour is not used",
    ]  # fmt: skip


def test_ids_of_a_file_are_kept_to_the_last_digit(tmp_path: Path, good: dict[str, np.ndarray], process: Apart) -> None:
    ids = np.array([2**62 + 1, 2**62, 3, -5], dtype=np.int64)
    path = save(tmp_path / "p.h5", position=good["position"][:4], id=ids)
    assert np.array_equal(read(path, (1.0, 4.0), {}, process).ids, ids)
    assert np.array_equal(read(path, (1.0, 4.0), {}, process, records={"id": ""}).ids, np.arange(4))


@pytest.mark.parametrize("kind", ["missing", "folder", "text", "fifo", "device", "empty"])
def test_what_is_no_hdf5_file_is_a_problem_and_no_traceback(tmp_path: Path, kind: str, process: Apart) -> None:
    path = tmp_path / "p.h5"
    if kind == "folder":
        path.mkdir()
    elif kind == "text":
        path.write_text("not HDF5")
    elif kind == "fifo":
        os.mkfifo(path)
    elif kind == "device":
        path = Path("/dev/zero")
    elif kind == "empty":
        path.touch()
    (problem,) = refusal(path, (1.0,), FIELDS[1], process)
    words = {"missing": "no such file", "text": "as HDF5, it cannot be read", "empty": "as HDF5, it cannot be read"}
    assert problem.startswith(words.get(kind, "is no regular file"))


def test_more_rows_than_fit_are_refused_at_once(tmp_path: Path, monkeypatch: Any) -> None:
    rows = 10**18
    with h5py.File(tmp_path / "p.h5", "w") as file:
        file.create_dataset("position", (rows, 1), chunks=(1000, 1))[:1000] = 0.5
    (problem,) = refusal(tmp_path / "p.h5", (1.0,), {}, Here())
    assert problem.startswith(f"position holds 1 of the {rows // 1000} chunks of its shape ({rows}, 1)")
    path = save(tmp_path / "p.h5", position=np.full((1000, 1), 0.5))
    monkeypatch.setattr(particle_file, "available_bytes", lambda: 8.0 * 1000 * 2 * 2 - 1)
    with pytest.raises(
        ParticleFileError, match=r"1000 particles need on 1 rank about 3.2e-05 GB, and 3.2e-05 GB are free"
    ):
        read(path, (1.0,), {}, Here())
    monkeypatch.setattr(particle_file, "available_bytes", lambda: 8.0 * 1000 * 2 * 2)
    assert len(read(path, (1.0,), {}, Here()).ids) == 1000


def test_a_huge_file_is_checked_in_pieces(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(particle_file, "PIECE_BYTES", 8 * 1000)
    sizes: list[int] = []
    whole = particle_file.find_broken
    monkeypatch.setattr(particle_file, "find_broken", lambda *a: (sizes.append(a[1].nbytes), whole(*a))[1])
    path = save(tmp_path / "p.h5", position=np.full((10_500, 1), 0.5))
    assert check_particle_file(Request(str(path), 1, {}), Box((1.0,), (0.1,)), COMM, Here()) == []
    assert max(sizes) <= 8000 and sum(sizes) == 8 * 10_500
    assert len(read(path, (1.0,), {}, Here()).ids) == 10_500


def test_pieces_are_whole_chunks_of_the_file(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(particle_file, "PIECE_BYTES", 8)
    with h5py.File(tmp_path / "p.h5", "w") as file:
        file.create_dataset("position", data=np.full((100, 1), 0.5), chunks=(30, 1))
    pieces = [piece for piece in particle_file.pieces(Request(str(tmp_path / "p.h5"), 1, {}), 1, 2)][1:]
    assert [(piece.start, len(piece.values["position"])) for piece in pieces] == [(50, 10), (60, 30), (90, 10)]

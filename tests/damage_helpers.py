"""Particle files of many kinds, and copies of them that are damaged in seeded ways."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
from mpi4py import MPI

from mpipic.io.apart import Apart
from mpipic.io.particle_file import Box, ParticleFileError, Request, read_particle_file

ROWS = 60
PLAIN: dict[str, tuple[str | None, dict]] = {
    "contiguous": (None, {}),
    "newest format": ("latest", {}),
    "chunks": (None, {"chunks": True}),
    "chunks, newest format": ("latest", {"chunks": True}),
    "resizable": ("latest", {"chunks": True, "maxshape": True}),
    "gzip and shuffle": (None, {"compression": "gzip", "shuffle": True}),
    "lzf and checksums": (None, {"compression": "lzf", "fletcher32": True}),
    "scale and offset": (None, {"scaleoffset": 6}),
    "big-endian": (None, {"dtype": ">f8"}),
    "half": (None, {"dtype": "f2"}),
}


def write_plain(path: Path, kind: str) -> None:
    """position (n, 2), density (n,), velocity (n, 2), id (n,) in one of the ways of `PLAIN`."""
    version, how = PLAIN[kind]
    rng = np.random.default_rng(1)
    with h5py.File(path, "w", libver=version) as file:
        for name, shape in (("position", (ROWS, 2)), ("density", (ROWS,)), ("velocity", (ROWS, 2))):
            options = {**how, **({"maxshape": (None, *shape[1:])} if "maxshape" in how else {})}
            file.create_dataset(name, data=rng.random(shape), **options)
        file["id"] = np.arange(ROWS)[::-1] * 7


def write_openpmd(path: Path, style: str, rows: int = ROWS) -> None:
    """Two iterations of one species, as PIConGPU ("offsets"), WarpX ("constants") or openPMD-api ("texts") write it."""
    rng = np.random.default_rng(2)
    text = (lambda value: value) if style == "texts" else np.bytes_
    with h5py.File(path, "w", libver="latest" if style == "texts" else None) as file:
        root = {
            "openPMD": "1.1.0",
            "basePath": "/data/%T/",
            "particlesPath": "particles/",
            "iterationEncoding": "groupBased",
        }
        for name, value in root.items():
            file.attrs[name] = text(value)
        file.attrs["openPMDextension"] = np.uint32(1)
        for iteration in (0, 100):
            species = file.create_group(f"data/{iteration}/particles/e")
            for axis in "xy":
                chunks = (16,) if style == "texts" else None
                in_cell = rng.random(rows).astype("f4" if style == "offsets" else "f8")
                put(
                    species,
                    f"position/{axis}",
                    in_cell * (1.0 if style == "offsets" else 1e-6),
                    1e-6 if style == "offsets" else 1.0,
                    chunks,
                )
                if style == "offsets":
                    put(species, f"positionOffset/{axis}", rng.integers(0, 9, rows).astype("i4"), 1e-6)
                else:
                    put_constant(species, f"positionOffset/{axis}", 0.0, rows)
                put(species, f"velocity/{axis}", rng.random(rows), 2.5, chunks)
            put(species, "id", np.arange(rows, dtype="u8") + 5)
            if style == "constants":
                put_constant(species, "density", 0.25, rows)
            else:
                put(species, "density", rng.random(rows).astype("f4"), 1.0, chunks)


def put(species: h5py.Group, name: str, values: np.ndarray, unit: float = 1.0, chunks: tuple | None = None) -> None:
    """A component that is a data set."""
    species.create_dataset(name, data=values, chunks=chunks).attrs["unitSI"] = unit


def put_constant(species: h5py.Group, name: str, value: float, rows: int, unit: float = 1.0) -> None:
    """A component that is one number."""
    group = species.create_group(name)
    group.attrs.update({"value": value, "shape": np.array([rows], "u8"), "unitSI": unit})


def write_all(folder: Path) -> dict[str, Path]:
    """Good files of every kind."""
    writers: dict[str, Callable[[Path], None]] = {
        kind: lambda path, kind=kind: write_plain(path, kind) for kind in PLAIN
    }
    writers |= {
        f"openPMD, {style}": lambda path, style=style: write_openpmd(path, style)
        for style in ("offsets", "constants", "texts")
    }
    found = {}
    for kind, write in writers.items():
        found[kind] = folder / f"{len(found)}.h5"
        write(found[kind])
    return found


def damaged(files: dict[str, Path], seed: int, count: int) -> Iterator[tuple[str, bytes]]:
    """Copies with flipped bits, other bytes, holes of zeros, swapped blocks or a lost end; more at the front."""
    rng = random.Random(seed)
    whole = {kind: path.read_bytes() for kind, path in files.items()}
    for number in range(count):
        kind = list(whole)[number % len(whole)]
        data = bytearray(whole[kind])
        size = len(data) if rng.random() < 0.5 else min(len(data), 3000)
        way = rng.choice(["bit", "bit", "byte", "bits", "zeros", "swap", "end"])
        at = rng.randrange(size)
        if way == "end":
            del data[at:]
        elif way == "zeros":
            data[at : at + rng.choice([1, 8, 64, 512])] = bytes(min(len(data) - at, rng.choice([1, 8, 64, 512])))
        elif way == "swap":
            other, width = rng.randrange(size), rng.choice([8, 64])
            data[at : at + width], data[other : other + width] = data[other : other + width], data[at : at + width]
        else:
            for _ in range(8 if way == "bits" else 1):
                place = rng.randrange(size)
                data[place] = rng.randrange(256) if way == "byte" else data[place] ^ (1 << rng.randrange(8))
        yield f"{number}: {kind}, {way} at {at}", bytes(data)


def judge(path: Path, process: Apart, comm: MPI.Comm = MPI.COMM_SELF) -> str:
    """Return "read", "refused", or what is wrong with what became of reading a file of `write_all`. Collective."""
    request = Request(str(path), 2, {"density": (), "velocity": (2,)})
    try:
        rows = read_particle_file(request, Box((1.0, 1.0), (0.1, 0.1)), comm, process)
    except ParticleFileError as error:
        blind = [text for text in error.problems if not text.startswith(str(path))]
        return f"names no file: {blind}" if blind or not error.problems else "refused"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    said, values = " ".join(rows.notes), {"position": rows.position, **rows.fields}
    for name in request.fields:
        found = comm.allreduce(np.count_nonzero(values.get(name, 0.0)))
        if not found and not any(f"{name} {how}" in said for how in ("is missing", "is 0 in every row")):
            return f"{name} is lost"
    return "read" if all(np.isfinite(each).all() for each in values.values()) else "not finite"

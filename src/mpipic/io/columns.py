"""Columns of numbers in an HDF5 file: found by name, judged before any of them is read, and read in slices.

Files come from anywhere and may be damaged anywhere. What h5py raises about them, of whatever type, becomes a
`ParticleFileError` in `reading`, the one place for that.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import h5py
import numpy as np
from h5py._hl.vds import VDSmap

from mpipic.arrays import FloatArray, IntArray, Shape
from mpipic.wording import escape, listed, shorten

LONGEST_REASON = 160
LONGEST_LIST = 12


class ParticleFileError(ValueError):
    """A particle file that cannot be used; `problems` lists what is wrong, one sentence each."""

    def __init__(self, *problems: str) -> None:
        super().__init__(*problems)
        self.problems = list(problems)

    def __str__(self) -> str:
        """Return all problems on one line."""
        return "; ".join(self.problems)


@contextmanager
def reading(where: str) -> Iterator[None]:
    """Turn whatever h5py raises within a block into a `ParticleFileError` that says where, and why. Local."""
    try:
        yield
    except ParticleFileError:
        raise
    except Exception as error:  # KeyError, RuntimeError, OSError, SystemError ...: damage raises them all
        raise ParticleFileError(f"{where} cannot be read: {reason_of(error)}") from None


def reason_of(error: BaseException) -> str:
    """Return the first line of an error's message, or its type where it has none."""
    said = str(error.args[0] if isinstance(error, KeyError) and error.args else error)
    return shorten(escape(said.strip().split("\n")[0]), LONGEST_REASON) or type(error).__name__


def names_of(names: Sequence[str]) -> str:
    """Return names in words, the first `LONGEST_LIST` of them; "nothing" for none."""
    shown = [shorten(escape(name)) for name in names[:LONGEST_LIST]]
    rest = [f"{len(names) - LONGEST_LIST} more"] if len(names) > LONGEST_LIST else []
    return listed(shown + rest) if names else "nothing"


@dataclass(frozen=True)
class Column:
    """Rows of real numbers, each of a `shape`: those of a data set, or without one, `value` in every row.

    Attributes
    ----------
    where
        File and name, for messages.
    rows, shape
        Number of rows, and the shape of one.
    unit
        What numbers are multiplied by when read; exactly 1 changes no bit.
    """

    where: str
    rows: int
    shape: Shape = ()
    data: h5py.Dataset | None = None
    value: float = 0.0
    unit: float = 1.0

    @property
    def is_zero(self) -> bool:
        """Return whether every row is 0 without reading any."""
        return self.data is None and self.value == 0.0

    def read(self, start: int, stop: int) -> FloatArray:
        """Return rows start to stop in double precision, times the unit: (stop - start, *shape). Local."""
        if self.data is None:
            return np.full((stop - start, *self.shape), self.value * self.unit)
        with reading(self.where):
            _refuse_lost_chunks(self.data, start, stop, self.where)
            rows = np.asarray(self.data[start:stop]).astype(np.float64)
        with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is found by whoever judges values
            return rows if self.unit == 1.0 else rows * self.unit

    def read_whole(self, start: int, stop: int) -> IntArray:
        """Return rows start to stop of whole numbers, to the last digit: (stop - start, *shape). Local."""
        if self.data is None or self.data.dtype.kind not in "iu":
            raise ParticleFileError(f"{self.where} must hold whole numbers")
        with reading(self.where):
            rows = np.asarray(self.data[start:stop])
        if rows.dtype.kind == "u" and rows.size and int(rows.max()) > np.iinfo(np.int64).max:
            raise ParticleFileError(f"{self.where} holds {int(rows.max())}, which is above 2^63 - 1")
        return rows.astype(np.int64)


def find(group: h5py.Group, path: str, where: str) -> h5py.HLObject:
    """Return what lies at a path below a group, through links of any kind. Raises ParticleFileError."""
    for name in filter(None, path.split("/")):
        with reading(where):
            link = group.get(name, getlink=True) if isinstance(group, h5py.Group) else None
        if link is None:
            raise ParticleFileError(f"{where} is not there")
        target = _target(group, link, where)
        try:
            group = group[name]
        except Exception as error:  # as in `reading`, with the link named
            raise ParticleFileError(f"{where} {target}cannot be read: {reason_of(error)}") from None
    return group


def _target(group: h5py.Group, link: object, where: str) -> str:
    """Return what a message says of a link; refuse an external one to what is no regular file, and could hang."""
    if isinstance(link, h5py.ExternalLink):
        with reading(where):
            folder = Path(group.file.filename).parent
            special = [place for place in (folder / link.filename, Path(link.filename)) if place.exists()]
        if special and not special[0].is_file():
            raise ParticleFileError(f"{where} is a link to {escape(link.filename)}, which is no regular file")
        return f"is a link to {escape(link.filename)}:{escape(link.path)} and "
    return f"is a link to {escape(link.path)} and " if isinstance(link, h5py.SoftLink) else ""


def column_of(data: h5py.HLObject, where: str) -> Column:
    """Return the column that a data set is, judged by what the file says of it, none of its numbers read.

    Raises
    ------
    ParticleFileError
        It is no data set, has no rows axis, is not made of real numbers, or holds less than its shape declares.
    """
    with reading(where):
        if not isinstance(data, h5py.Dataset):
            kind = "a group" if isinstance(data, h5py.Group) else "a type"
            raise ParticleFileError(f"{where} is {kind}, expected a data set")
        if data.shape is None:
            raise ParticleFileError(f"{where} is empty (it has no shape), expected rows of numbers")
        _refuse_type(data, where)
        problem = _unwritten(data)
        if problem:
            raise ParticleFileError(f"{where} {problem}")
        rows, *shape = data.shape or (1,)
        return Column(where, int(rows), tuple(int(size) for size in shape), data)


def _refuse_type(data: h5py.Dataset, where: str) -> None:
    """Raise for anything but integers and floating-point numbers of a format that NumPy has."""
    if data.dtype.kind not in "fiu":
        raise ParticleFileError(f"{where} has type {data.dtype}, expected real numbers")
    if not data.id.get_type().equal(h5py.h5t.py_create(data.dtype)):
        raise ParticleFileError(f"{where} has numbers of a format of its own, like {data.dtype} but not that")


def _unwritten(data: h5py.Dataset) -> str:
    """Return what is said of a data set whose file holds less than its shape declares: HDF5 would read zeros."""
    declared = math.prod(data.shape) * data.dtype.itemsize
    made = data.id.get_create_plist()
    layout = made.get_layout()
    if declared == 0 or layout == h5py.h5d.COMPACT:
        return ""
    if layout == h5py.h5d.VIRTUAL:
        return _unmapped(data)
    if layout == h5py.h5d.CHUNKED:
        wanted = math.prod(-(-size // chunk) for size, chunk in zip(data.shape, data.chunks, strict=True))
        found = data.id.get_num_chunks()
        text = f"{found} of the {wanted} chunks of its shape {data.shape}"
        return "" if found == wanted else f"holds {text}: the others were never written"
    held = data.id.get_storage_size()
    if made.get_external_count():
        return _lost(data, [made.get_external(k)[0].decode() for k in range(made.get_external_count())])
    text = f"{held} of the {declared} bytes of its shape {data.shape}"
    return "" if held == declared else f"holds {text}: the others were never written"


def _refuse_lost_chunks(data: h5py.Dataset, start: int, stop: int, where: str) -> None:
    """Raise for chunks of these rows that the file's index does not lead to: HDF5 would read zeros."""
    if not data.chunks:
        return
    first = start // data.chunks[0] * data.chunks[0]
    corners = [range(first, stop, data.chunks[0])]
    corners += [range(0, size, step) for size, step in zip(data.shape[1:], data.chunks[1:], strict=True)]
    for corner in product(*corners):
        found = data.id.get_chunk_info_by_coord(corner)
        if not found.byte_offset or not found.size:
            raise ParticleFileError(f"{where} is damaged: the file does not lead to its numbers from row {corner[0]}")


def _unmapped(data: h5py.Dataset) -> str:
    """Return what is said of a virtual data set that not all of its shape has a source for."""
    sources = data.virtual_sources()
    mapped = sum(source.vspace.get_select_npoints() for source in sources)
    if mapped != math.prod(data.shape):
        return f"is virtual, and maps {mapped} of the {math.prod(data.shape)} numbers of its shape {data.shape}"
    for source in sources:
        here = source.file_name == "."
        lost = "" if here else _lost(data, [source.file_name])
        if lost or not _is_whole(data, source, here):
            return lost or f"is virtual, and its source {escape(f'{source.file_name}:{source.dset_name}')} is not whole"
    return ""


def _is_whole(data: h5py.Dataset, source: VDSmap, here: bool) -> bool:
    """Return whether the source of a virtual data set is there, and has been written."""
    if here:
        origin = data.file.get(source.dset_name)
        return isinstance(origin, h5py.Dataset) and not _unwritten(origin)
    beside = Path(data.file.filename).parent / source.file_name
    with h5py.File(beside if beside.exists() else source.file_name, "r") as other:
        origin = other.get(source.dset_name)
        return isinstance(origin, h5py.Dataset) and not _unwritten(origin)


def _lost(data: h5py.Dataset, names: Sequence[str]) -> str:
    """Return what is said of files beside the one of a data set that are not there, or are no regular files."""
    folder = Path(data.file.filename).parent
    lost = [name for name in names if not ((folder / name).is_file() or Path(name).is_file())]
    return f"has its numbers in {names_of(lost)}, which is not there or no regular file" if lost else ""

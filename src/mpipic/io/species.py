"""Read particle species from openPMD files of any code: units, offsets, constant records, any templates of paths.

A component comes back as stored number × unitSI, positions as position × unitSI + positionOffset × unitSI. Where units
are 1 and offsets 0, as in this program's own snapshots, that is the stored number to the last bit.

References
----------
openPMD standard 1.1.0, https://github.com/openPMD/openPMD-standard/blob/1.1.0/STANDARD.md
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import h5py
import numpy as np

from mpipic.arrays import FloatArray, IntArray, Shape
from mpipic.io.columns import Column, ParticleFileError, column_of, find, names_of, reading
from mpipic.io.openpmd import component_name
from mpipic.wording import escape

MARK = "openPMD"
"""The root attribute that makes an HDF5 file an openPMD file."""
POSITION, OFFSET = "position", "positionOffset"
NO_RECORDS = ("particlePatches",)
COUNTER = re.compile(r"%(?:0(\d+))?T")


@dataclass(frozen=True)
class Values:
    """One quantity of all particles: `read` gives its rows, of a `shape`.

    `columns` is one column of this shape, or one of scalars for each component in C order; `offsets`, if any, are added
    to them.
    """

    rows: int
    shape: Shape
    columns: tuple[Column, ...]
    offsets: tuple[Column, ...] = ()

    def read(self, start: int, stop: int) -> FloatArray:
        """Return rows start to stop, (stop - start, *shape), in double precision. Local."""
        parts = [column.read(start, stop) for column in self.columns]
        for k, offset in enumerate(self.offsets):
            if not offset.is_zero:
                parts[k] = parts[k] + offset.read(start, stop)
        if self.columns[0].shape == self.shape:
            return parts[0]
        return np.stack(parts, axis=1).reshape(stop - start, *self.shape)

    def read_whole(self, start: int, stop: int) -> IntArray:
        """Return rows start to stop of whole numbers, (stop - start,). Local."""
        return self.columns[0].read_whole(start, stop)


@dataclass(frozen=True)
class Series:
    """The iterations and species of one openPMD file."""

    file: h5py.File
    path: str
    iterations: dict[int, str] = field(default_factory=dict)
    """Number of an iteration to the path of its group."""

    @classmethod
    def of(cls, file: h5py.File, path: str) -> Series:
        """Return the series of an open file. Raises ParticleFileError where its templates lead nowhere."""
        base = attribute_text(file, "basePath", path)
        counter = COUNTER.search(base)
        if counter is None:
            raise ParticleFileError(f"{path}: basePath = {escape(base)} has no %T: variable-based files are not read")
        folder, _, stem = base[: counter.start()].rpartition("/")
        tail, _, rest = base[counter.end() :].partition("/")
        pattern = re.compile(f"{re.escape(stem)}([0-9]+){re.escape(tail)}")
        group = find(file, folder, f"{path}: {folder or '/'}")
        with reading(f"{path}: {folder or '/'}"):
            found = {int(match[1]): name for name in group if (match := pattern.fullmatch(name))}
        return cls(file, path, {number: f"{folder}/{found[number]}/{rest}" for number in sorted(found)})

    def choose(self, iteration: int | None) -> int:
        """Return the iteration that is asked for; None: the last."""
        if not self.iterations:
            raise ParticleFileError(f"{self.path}: has no iterations")
        if iteration is None:
            return max(self.iterations)
        if iteration not in self.iterations:
            names = names_of([str(number) for number in self.iterations])
            raise ParticleFileError(f"{self.path}: has no iteration {iteration}; it has {names}")
        return iteration

    def species(self, iteration: int) -> dict[str, h5py.Group]:
        """Return the species of an iteration by name."""
        where = f"{self.path}: iteration {iteration}"
        below = attribute_text(self.file, "particlesPath", self.path)
        group = find(self.file, f"{self.iterations[iteration]}/{below}", f"{where}: {below}")
        with reading(where):
            names = list(group)
        found = {name: find(group, name, f"{where}, species {escape(name)}") for name in names}
        return {name: item for name, item in found.items() if isinstance(item, h5py.Group)}

    def sibling(self, iteration: int | None) -> Path | None:
        """Return the file of a file-based series that holds another iteration; None where it is this one."""
        if iteration is None or iteration in self.iterations:
            return None
        if attribute_text(self.file, "iterationEncoding", self.path) != "fileBased":
            return None
        form = attribute_text(self.file, "iterationFormat", self.path)
        name = COUNTER.sub(lambda counter: str(iteration).zfill(int(counter[1] or 1)), form)
        place = Path(self.path).with_name(Path(name).name)
        if not place.is_file():
            names = names_of([str(number) for number in self.iterations])
            raise ParticleFileError(f"{self.path}: has iteration {names}, and {place} of its series is not there")
        return place if place != Path(self.path) else None


@dataclass(frozen=True)
class Species:
    """The records of one species at one iteration: a table of particles.

    `axes` are the names of the components that stand for the axes of the grid; none: those that positions have.
    """

    group: h5py.Group
    where: str
    axes: tuple[str, ...] = ()

    def names(self) -> list[str]:
        """Return the names of the records, without what only places the positions."""
        with reading(self.where):
            return [name for name in self.group if name not in (*NO_RECORDS, OFFSET)]

    def components(self, record: str) -> dict[str, h5py.HLObject]:
        """Return what a record consists of: data sets and constants by component, "" for a scalar's only one."""
        where = f"{self.where}: {escape(record)}"
        item = find(self.group, record, where)
        with reading(where):
            if isinstance(item, h5py.Dataset) or "value" in item.attrs:
                return {"": item}
            names = sorted(item)
        return {name: find(item, name, f"{where}/{escape(name)}") for name in names}

    def find(self, record: str, shape: Shape) -> Values:
        """Return the values of a record that particles shall have in a shape. Raises ParticleFileError."""
        parts, where = self.components(record), f"{self.where}: {escape(record)}"
        axes = self.axes or tuple(parts if record == POSITION else self.components(POSITION))
        if record == POSITION:
            _refuse_other_axes(axes, shape, where)
        wanted = [component_name(index, shape, axes) for index in np.ndindex(shape)]
        if list(parts) == [""] and len(wanted) == 1:
            wanted = [""]
        lost = [name for name in wanted if name not in parts]
        if lost:
            have = "is a scalar" if list(parts) == [""] else f"has the components {names_of(list(parts))}"
            need = f"needs {names_of(lost)}" if shape else f"is to be a scalar: name one of them, {record}/..."
            raise ParticleFileError(f"{where} {have}, and {need}")
        columns = tuple(component(parts[name], f"{where}/{name}".rstrip("/")) for name in wanted)
        offsets = self._offsets(wanted) if record == POSITION else ()
        return Values(columns[0].rows, shape, columns, offsets)

    def _offsets(self, wanted: Sequence[str]) -> tuple[Column, ...]:
        """Return the columns to be added to positions; none where the species has no offsets."""
        with reading(self.where):
            if OFFSET not in self.group:
                return ()
        parts, where = self.components(OFFSET), f"{self.where}: {OFFSET}"
        lost = [name for name in wanted if name not in parts]
        if lost:
            raise ParticleFileError(f"{where} has the components {names_of(list(parts))}, and needs {names_of(lost)}")
        return tuple(component(parts[name], f"{where}/{name}".rstrip("/")) for name in wanted)


def _refuse_other_axes(axes: Sequence[str], shape: Shape, where: str) -> None:
    """Raise unless positions have as many components as the grid has axes."""
    if len(axes) != shape[0]:
        choice = ", ".join(f'"{escape(name)}"' for name in axes[: shape[0]])
        rule = f"name those to take, as in particles.axes = [{choice}]" if len(axes) > shape[0] else "too few"
        have = f"has the components {names_of(axes)}"
        raise ParticleFileError(f"{where} {have}, and the grid has {shape[0]} axes: {rule}")


def component(item: h5py.HLObject, where: str) -> Column:
    """Return the column of a component: a data set with a unit, or a constant. Raises ParticleFileError."""
    unit = attribute_number(item, "unitSI", where)
    if unit == 0.0:
        raise ParticleFileError(f"{where} has unitSI = 0")
    if isinstance(item, h5py.Dataset):
        column = column_of(item, where)
        if item.shape == () or column.shape:
            raise ParticleFileError(f"{where} has shape {item.shape}, expected (n,)")
        return replace(column, unit=unit)
    value, rows = attribute_number(item, "value", where), attribute_number(item, "shape", where)
    if rows < 0 or rows != int(rows):
        raise ParticleFileError(f"{where} has shape = {rows}, expected a whole number")
    return Column(where, int(rows), value=value, unit=unit)


def attribute(item: h5py.HLObject, name: str, where: str) -> object:
    """Return an attribute, a list of one as its only entry. Raises ParticleFileError if it is not there."""
    with reading(f"{where}: attribute {name}"):
        if name not in item.attrs:
            raise ParticleFileError(f"{where} has no attribute {name}, which openPMD asks for")
        value = item.attrs[name]
        return value.reshape(-1)[0] if isinstance(value, np.ndarray) and value.size == 1 else value


def attribute_text(item: h5py.HLObject, name: str, where: str) -> str:
    """Return a text that an attribute holds. Raises ParticleFileError for anything else."""
    value = attribute(item, name, where)
    with reading(f"{where}: attribute {name}"):
        value = value.decode() if isinstance(value, bytes) else value
    if not isinstance(value, str):
        raise ParticleFileError(f"{where}: attribute {name} must be a text")
    return value


def attribute_number(item: h5py.HLObject, name: str, where: str) -> float:
    """Return a finite number that an attribute holds. Raises ParticleFileError for anything else."""
    value = attribute(item, name, where)
    if not isinstance(value, (np.integer, np.floating)) or not np.isfinite(value):
        raise ParticleFileError(f"{where}: attribute {name} must be a finite number")
    return float(value)

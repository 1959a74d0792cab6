"""Which data sets of a particle file stand for which quantities: by their own names, or as a scene names them.

A file is plain, `position` (n, d) and fields (n, *shape) as data sets, or holds openPMD species. Either way it is a
table of records; what is missing is held against what the file has beside, so that no misspelt name becomes zeros.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import h5py

from mpipic.arrays import Shape
from mpipic.io.columns import ParticleFileError, column_of, find, names_of, reading
from mpipic.io.species import MARK, Series, Species, Values
from mpipic.wording import closest, escape, listed, show

POSITION, ID = "position", "id"
SHORTEST_STEM = 3


@dataclass(frozen=True)
class Request:
    """Says what is wanted of a particle file.

    Attributes
    ----------
    path
        HDF5 file; of a file-based openPMD series, any file of it.
    dim
        Axes of the grid.
    fields
        Name of a quantity that the file may have to the shape of one particle's value.
    records
        Name of a quantity, one of `fields`, position or id, to that of the record that stands for it; "": none does.
    iteration, species, axes
        For openPMD files: which iteration (None: the last), which species ("": the only one), and which components of
        vectors stand for the axes of the grid (none: those that positions have).
    elsewhere
        Name of a quantity to what gives it in place of the file, for messages.
    """

    path: str
    dim: int
    fields: Mapping[str, Shape]
    records: Mapping[str, str] = field(default_factory=dict)
    iteration: int | None = None
    species: str = ""
    axes: tuple[str, ...] = ()
    elsewhere: Mapping[str, str] = field(default_factory=dict)


class Table(Protocol):
    """Particles as records by name."""

    @property
    def where(self) -> str:
        """File, and place in it, for messages."""
        ...

    def names(self) -> list[str]:
        """Return the names of the records."""
        ...

    def find(self, record: str, shape: Shape) -> Values:
        """Return the values of a record, of a shape per particle. Raises ParticleFileError."""
        ...


@dataclass(frozen=True)
class Plain:
    """Data sets of a plain file: a table of particles."""

    file: h5py.File
    where: str

    def names(self) -> list[str]:
        """Return the names of all that lies at the root."""
        with reading(self.where):
            return list(self.file)

    def find(self, record: str, shape: Shape) -> Values:
        """Return the values of a data set. Raises ParticleFileError where its shape is not (n, *shape)."""
        where = f"{self.where}: {escape(record)}"
        data = find(self.file, record, where)
        column = column_of(data, where)
        if data.shape == () or column.shape != shape:
            wanted = ", ".join(["n", *map(str, shape)]) + ("" if shape else ",")
            raise ParticleFileError(f"{where} has shape {data.shape}, expected ({wanted})")
        return Values(column.rows, shape, (column,))


@dataclass
class Selection:
    """Holds what a file gives: values by quantity, and what is to be said about it."""

    rows: int = 0
    values: dict[str, Values] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def table_of(file: h5py.File, request: Request) -> Table:
    """Return the table of an open file that a request is about. Raises ParticleFileError, with the choices."""
    path = escape(request.path)
    with reading(path):
        is_series = MARK in file.attrs
    if not is_series:
        unused = [name for name in ("iteration", "species", "axes") if getattr(request, name) not in (None, "", ())]
        if unused:
            raise ParticleFileError(f"{path}: is no openPMD file, and has no {listed(unused, 'or')} to choose")
        return Plain(file, path)
    series = Series.of(file, path)
    number = series.choose(request.iteration)
    species, where = series.species(number), f"{path}: iteration {number}"
    name = request.species or (next(iter(species)) if len(species) == 1 else "")
    if not species:
        raise ParticleFileError(f"{where} has no particles")
    if not name:
        have = names_of(list(species))
        raise ParticleFileError(
            f"{where} has the species {have}: name one, as in particles.species = {show(min(species))}"
        )
    if name not in species:
        have = names_of(list(species)) + _mean(closest(name, list(species)))
        raise ParticleFileError(f"{where} has no species {escape(name)}; it has {have}")
    return Species(species[name], f"{where}, {escape(name)}", request.axes)


def select(table: Table, request: Request) -> Selection:
    """Return what a table gives for a request, with everything that is wrong with it; no number is read."""
    shapes: dict[str, Shape] = {POSITION: (request.dim,), ID: (), **request.fields}
    found = Selection(problems=_unknown(table, request, shapes))
    named = {name: request.records.get(name, name) for name in shapes}
    try:
        names = table.names()
    except ParticleFileError as error:
        found.problems += error.problems
        return found
    taken = {record.split("/")[0] for record in named.values()} & set(names)
    left = [name for name in names if name not in taken]
    missing = []
    for name, record in named.items():
        if not record:
            continue
        if record.split("/")[0] in taken:
            _take(found, table, name, record, shapes[name])
        elif name in request.records:
            found.problems.append(f"{table.where}: {escape(record)} is not there, to be {name}; {_have(names, record)}")
        else:
            missing.append(name)
    _judge_missing(found, table, request, missing, names, left)
    _note_unused(found, table, request, left)
    return found


def _unknown(table: Table, request: Request, shapes: Mapping[str, Shape]) -> list[str]:
    """Return what is wrong with the quantities that records are named for."""
    names = [name for name in request.records if name not in shapes and name not in request.elsewhere]
    known = [*shapes, *request.elsewhere]
    rule = f"is none of the quantities that particles have, {listed(known)}"
    return [f"particles.records: {escape(name)} {rule}{_mean(closest(name, known))}" for name in names]


def _take(found: Selection, table: Table, name: str, record: str, shape: Shape) -> None:
    """Add the values of one quantity, or what is wrong with them."""
    try:
        values = table.find(record, shape)
    except ParticleFileError as error:
        found.problems += error.problems
        return
    if name == POSITION:
        found.rows = values.rows
        if not values.rows:
            found.problems.append(f"{table.where}: {escape(record)} has no rows")
    places = [column for column in (*values.columns, *values.offsets) if column.rows != found.rows]
    if places and POSITION in (name, *found.values):
        data, size = places[0].data, found.rows
        has = f"has shape {data.shape}" if data is not None else f"has {places[0].rows} rows"
        wanted = ", ".join(map(str, (size, *places[0].shape))) + ("" if places[0].shape else ",")
        found.problems.append(f"{places[0].where} {has}, expected ({wanted})")
    found.values[name] = values


def _judge_missing(
    found: Selection, table: Table, request: Request, missing: Sequence[str], names: Sequence[str], left: Sequence[str]
) -> None:
    """Refuse a missing position, and fields whose names are nearly there or that all are missing; else say zeros."""
    wanted = [name for name in missing if name in request.fields]
    given = [name for name in request.fields if name not in missing]
    if POSITION in missing:
        shape = f"; expected a data set of shape (n, {request.dim})" if isinstance(table, Plain) else ""
        found.problems.append(f"{table.where}: position is missing{shape}; {_have(names, POSITION, left)}")
    for name in wanted:
        if near(name, left) or not given:
            found.problems.append(f"{table.where}: {name} is missing; {_have(names, name, left)}")
        else:
            found.notes.append(f"{table.where}: {name} is missing, and starts at zero")


def _note_unused(found: Selection, table: Table, request: Request, left: Sequence[str]) -> None:
    """Say what the file has beside: quantities that something else gives, and what nothing asks for."""
    for giver in dict.fromkeys(request.elsewhere.values()):
        twice = [name for name in left if request.elsewhere.get(name) == giver]
        if twice:
            found.notes.append(f"{table.where}: {names_of(twice)} {_is(twice)} not used: {giver}")
    rest = [name for name in left if name not in request.elsewhere]
    if rest:
        found.notes.append(f"{table.where}: {names_of(rest)} {_is(rest)} not used")


def _is(names: Sequence[str]) -> str:
    return "is" if len(names) == 1 else "are"


def _have(names: Sequence[str], wanted: str, left: Sequence[str] | None = None) -> str:
    """Return what a file has, and which of that may be meant."""
    guess = near(wanted, names if left is None else left)
    return f"the file has {names_of(names)}{_mean(guess)}" + (
        f' Then say particles.records = ["{wanted}={escape(guess)}"]' if guess and left is not None else ""
    )


def _mean(name: str | None) -> str:
    return f'. Did you mean "{escape(name)}"?' if name else ""


def near(word: str, names: Sequence[str]) -> str | None:
    """Return the name that `word` may have been meant by: one much like it, or one that is its beginning."""
    plain = word.lower()
    stems = [name for name in names if len(name) >= SHORTEST_STEM and plain.startswith(name.lower())]
    longer = [name for name in names if name.lower().startswith(plain)]
    return next(iter(stems + longer), None) or closest(word, names)

"""Where particles start: layouts, drawn by global id, so that they are the same on any number of ranks."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mpipic.arrays import FloatArray, IntArray
from mpipic.draws import uniform
from mpipic.keys import FROM_0, FROM_1, NOT_BELOW_0, ByScene, Count, CountOrZero, Keys, NotNegative, key
from mpipic.parts import Broken, Choices, Part, Values, rule
from mpipic.wording import show

if TYPE_CHECKING:
    from mpipic.mesh.grid import Grid

PARTICLE_LIMIT = 2**53
PER_AXIS = "a list of whole numbers, each 1 or above, one per axis, for example [2]"
RECORDS = 'a list of texts "quantity=record", for example ["velocity=momentum"]'
SEED = "a whole number from 0 to 2^63 - 1"


def _per_axis() -> Any:
    default = ByScene("2 per axis", lambda v: (2,) * v.dim, ("grid.cells",))
    return key(default, PER_AXIS, "particles per cell along each axis", per_axis=True)


class Layout(Part):
    """Where particles start."""

    slot = "particles.layout"

    @rule("particles.per_cell", "grid.cells")
    @staticmethod
    def particles_can_be_counted(v: Values) -> Broken | None:
        """Counts stay exact as floating-point numbers."""
        if v.cell_count * math.prod(v["particles.per_cell"]) < PARTICLE_LIMIT:
            return None
        return "particles.per_cell", f"must give fewer than 2^53 particles in all, grid.cells = {show(v['grid.cells'])}"

    @classmethod
    def count(cls, v: Values) -> int | None:
        """Return the number of particles; None where a file decides."""
        return v.cell_count * int(math.prod(v["particles.per_cell"]))

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return how many particles there are, and how they lie."""
        return f"{cls.count(v):,} on a {cls.kind} layout, {' x '.join(map(str, v['particles.per_cell']))} per cell"

    @staticmethod
    def coordinates(grid: Grid, ids: IntArray, **settings: Any) -> FloatArray:
        """Return the coordinates (n, d), in cells, of the particles with these consecutive ids. Local."""
        raise NotImplementedError("particles from a file are read, not drawn")


class Lattice(Layout):
    """Cell-centred lattice: (j + 1/2) / per_cell cells along each axis, ids counting x fastest."""

    kind = "lattice"
    about = "a regular lattice, centred in the cells"
    is_default = True

    class Settings(Keys):
        """Keys of the layout."""

        per_cell: tuple[Count, ...] = _per_axis()

    @staticmethod
    def coordinates(grid: Grid, ids: IntArray, **settings: Any) -> FloatArray:
        """Return points of the lattice. Local."""
        per_cell = settings["per_cell"]
        points = [n * k for n, k in zip(grid.cells, per_cell, strict=True)]
        index = np.unravel_index(ids, points[::-1])[::-1]
        return np.stack([(j + 0.5) / k for j, k in zip(index, per_cell, strict=True)], axis=1)


class Jittered(Layout):
    """The lattice, every particle moved by up to `jitter` particle spacings along every axis."""

    kind = "jittered"
    about = "the lattice, every particle moved at random"

    class Settings(Keys):
        """Keys of the layout."""

        per_cell: tuple[Count, ...] = _per_axis()
        jitter: NotNegative = key(0.0, NOT_BELOW_0, "largest displacement along each axis", unit="particle spacings")
        seed: CountOrZero = key(0, SEED, "which random numbers; the same on any number of ranks")

    @rule("particles.per_cell", "particles.jitter", "grid.cells")
    @staticmethod
    def jitter_stays_in_the_box(v: Values) -> Broken | None:
        """No displacement is longer than the box."""
        most = min(cells * count for cells, count in zip(v["grid.cells"], v["particles.per_cell"], strict=True))
        if v["particles.jitter"] <= most:
            return None
        return "particles.jitter", f"must be at most {most} particle spacings, the width of the box"

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return how many particles there are, and how far they were moved."""
        return f"{super().describe(v)}, moved by up to {v['particles.jitter']:g} spacings"

    @staticmethod
    def coordinates(grid: Grid, ids: IntArray, **settings: Any) -> FloatArray:
        """Return points of the lattice, moved. Local."""
        turned = 2.0 * uniform(settings["seed"], ids, grid.dim) - 1.0
        offset = turned * settings["jitter"] / np.array(settings["per_cell"])
        return np.asarray(Lattice.coordinates(grid, ids, per_cell=settings["per_cell"]) + offset)


class Random(Layout):
    """Independent positions, uniform in the box."""

    kind = "random"
    about = "independent, uniform in the box"

    class Settings(Keys):
        """Keys of the layout."""

        per_cell: tuple[Count] = key(
            ByScene("4, in 1D 2", lambda v: (2,) if v.dim == 1 else (4,), ("grid.cells",)),
            f"a list of exactly 1 entry, {FROM_1}, for example [4]",
            "particles per cell on average",
        )
        seed: CountOrZero = key(0, SEED, "which random numbers; the same on any number of ranks")

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return how many particles there are."""
        return f"{super().describe(v)} on average"

    @staticmethod
    def coordinates(grid: Grid, ids: IntArray, **settings: Any) -> FloatArray:
        """Return independent positions. Local."""
        return np.asarray(uniform(settings["seed"], ids, grid.dim) * np.array(grid.cells))


class FromFile(Layout):
    """Particles of an HDF5 file: position (n, d), and optional fields; or of a species of an openPMD file."""

    kind = "file"
    about = "from a file: plain HDF5 or openPMD, see [docs/particle-files.md](particle-files.md)"
    brings_in = ("h5py",)

    class Settings(Keys):
        """Keys of the layout."""

        path: str = key("", "the name of a file", "HDF5 file, looked for from the scene's folder", is_file=True)
        records: tuple[str, ...] = key(
            (), RECORDS, "data sets or records of other names; after = nothing: none stands for it"
        )
        iteration: CountOrZero | None = key(
            ByScene("the last", lambda v: None), FROM_0, "openPMD: which iteration of the file, or of its series"
        )
        species: str = key(ByScene("the only one", lambda v: ""), "a name", "openPMD: which particle species")
        axes: tuple[str, ...] = key(
            ByScene("those of position", lambda v: ()),
            'a list of names, one per axis, for example ["x", "z"]',
            "openPMD: components of vectors that stand for the axes of the grid",
        )

    @rule("particles.records")
    @staticmethod
    def records_are_pairs(v: Values) -> Broken | None:
        """Every entry names a quantity, once."""
        names = [entry.partition("=")[0].strip() for entry in v["particles.records"]]
        if all(names) and len(set(names)) == len(names) and all("=" in entry for entry in v["particles.records"]):
            return None
        return "particles.records", f"must be {RECORDS}, each quantity once"

    @rule("particles.axes", "grid.cells")
    @staticmethod
    def axes_are_those_of_the_grid(v: Values) -> Broken | None:
        """There is a component for every axis, and for each its own."""
        axes = v["particles.axes"]
        if not axes or (len(axes) == v.dim == len(set(axes)) and all(axes)):
            return None
        return "particles.axes", f"must hold as many different names as grid.cells has entries, {v.dim}"

    @rule("particles.path")
    @staticmethod
    def file_can_be_read(v: Values) -> Broken | None:
        """Say what keeps the file from being read; its content is for its reader to check."""
        dotted, name = "particles.path", v["particles.path"]
        if not name:
            return dotted, 'must name an HDF5 file with particles.layout = "file"'
        try:
            name.encode("utf-8")  # else the resolved scene could not be written
            path = Path(name)
            if path.exists() and not path.is_file():
                return dotted, "must name a file, not a folder or a device"
            with path.open("rb"):
                return None
        except OSError as error:
            return dotted, f"cannot be read: {error.strerror or error}"
        except ValueError:
            return dotted, "is not a usable file name"

    @classmethod
    def count(cls, v: Values) -> int | None:
        """Return None: the file decides."""
        return None

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return the file."""
        return f"from {v['particles.path']}"


LAYOUTS: Choices[Layout] = Choices(Layout)
"""Kind to class."""


def share(total: int, grid: Grid) -> IntArray:
    """Return this rank's contiguous part of the ids 0 to total - 1. Local."""
    edges = [total * r // grid.size for r in (grid.rank, grid.rank + 1)]
    return np.arange(*edges, dtype=np.int64)

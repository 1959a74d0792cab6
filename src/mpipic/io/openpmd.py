"""Describe one snapshot in the layout of the openPMD standard 1.1, group based, without touching a file.

A snapshot is a `Tree`: attributes of groups, and `Block` records that say which part of which data set this rank holds.
Whoever writes it needs to know nothing about the standard, and the standard is here alone.

References
----------
openPMD standard 1.1.0, https://github.com/openPMD/openPMD-standard/blob/1.1.0/STANDARD.md
"""

from __future__ import annotations

import getpass
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from types import EllipsisType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mpipic import __version__
from mpipic.arrays import FloatArray, ParticleArrays

AXES = ("x", "y", "z")
SPECIES = "particles/gas"
MESHES = "fields"

# Powers of (length, mass, time, current, temperature, amount, light) by record name; others are dimensionless.
DIMENSIONS: dict[str, tuple[float, ...]] = {
    "position": (1, 0, 0, 0, 0, 0, 0),
    "positionOffset": (1, 0, 0, 0, 0, 0, 0),
    "density": (-3, 1, 0, 0, 0, 0, 0),
    "velocity": (1, 0, -1, 0, 0, 0, 0),
    "momentum": (1, 1, -1, 0, 0, 0, 0),
    "mass": (0, 1, 0, 0, 0, 0, 0),
    "volume": (3, 0, 0, 0, 0, 0, 0),
}
DIMENSIONLESS = (0.0,) * 7

# HDF5 keeps an attribute inside the object's header, which holds 64 kB.
LONGEST_COMMENT = 32_000

Numbers = NDArray[np.generic]
Attributes = dict[str, np.generic | Numbers]


class Blocks(Protocol):
    """A grid of nodes, of which this rank owns a block; entries are for the axes that there are, x first."""

    @property
    def cells(self) -> Sequence[int]:
        """Cells of the whole grid."""
        ...

    @property
    def length(self) -> Sequence[float]:
        """Size of the box."""
        ...

    @property
    def owned_start(self) -> Sequence[int]:
        """First own node."""
        ...

    @property
    def owned_shape(self) -> Sequence[int]:
        """Number of own nodes."""
        ...


@dataclass(frozen=True)
class Block:
    """The part of one data set that this rank holds: `data` goes to `start` of a global array of `shape`."""

    path: str
    shape: tuple[int, ...]
    start: tuple[int, ...]
    data: Numbers


@dataclass
class Tree:
    """Groups, data sets and attributes of one snapshot; paths are relative to /data/<step>.

    `attributes` is equal on all ranks, as are the order, paths, shapes and types of `blocks`; a path in `attributes`
    that is not a block is a group.
    """

    attributes: dict[str, Attributes] = field(default_factory=dict)
    blocks: list[Block] = field(default_factory=list)

    def add(self, block: Block, attributes: Attributes) -> None:
        """Add a data set with its attributes."""
        self.blocks.append(block)
        self.attributes[block.path] = attributes

    def signature(self) -> list[tuple[str, tuple[int, ...], str]]:
        """Return path, global shape and type of every data set: all ranks must agree on them before they write."""
        return [(block.path, block.shape, block.data.dtype.str) for block in self.blocks]


def root_attributes(name: str = "", comment: str = "") -> Attributes:
    """Return the attributes of the file itself. They hold the date and the user's name: let one rank decide.

    Parameters
    ----------
    name : name of the scene, first line of the comment
    comment : free text, such as the scene file; left out when too long for an attribute
    """
    note = f"{name}\n{comment}".strip()
    if len(note.encode()) > LONGEST_COMMENT:
        note = name
    attributes: Attributes = {
        "openPMD": text("1.1.0"),
        "openPMDextension": np.uint32(0),
        "basePath": text("/data/%T/"),
        "meshesPath": text(f"{MESHES}/"),
        "particlesPath": text("particles/"),
        "iterationEncoding": text("groupBased"),
        "iterationFormat": text("/data/%T/"),
        "author": text(_user()),
        "software": text("mpipic"),
        "softwareVersion": text(__version__),
        "date": text(datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S +0000")),
    }
    return attributes | ({"comment": text(note)} if note else {})


def snapshot(
    time: float,
    dt: float,
    particles: ParticleArrays,
    counts: Sequence[int],
    rank: int,
    grid: Blocks,
    nodal_fields: Mapping[str, FloatArray],
) -> Tree:
    """Describe one snapshot as this rank sees it. Local; views of the particle arrays, no copies.

    Parameters
    ----------
    time, dt : time of the snapshot and time step
    particles : of this rank
    counts : particles of every rank; this rank's rows go after those of the ranks before it
    rank : this one
    grid : the block of nodes of this rank
    nodal_fields : name to values on owned nodes, `owned_shape` + shape, axes in the order x, y, z

    Raises
    ------
    ValueError
        An array that does not fit the particles or the grid, or is not made of real numbers.
    """
    tree = Tree()
    tree.attributes[""] = {
        "time": np.float64(time),
        "dt": np.float64(dt),
        "timeUnitSI": np.float64(1.0),
        "closed": np.uint8(1),
    }
    _add_particles(tree, particles, counts, rank)
    _add_patches(tree, particles, counts, rank)
    tree.attributes[MESHES] = {}
    for name, values in nodal_fields.items():
        _add_mesh(tree, name, np.asarray(values), grid)
    return tree


def record_attributes(name: str) -> Attributes:
    """Return what openPMD asks of every record: the powers of its unit, and its time relative to the snapshot's."""
    return {
        "unitDimension": np.array(DIMENSIONS.get(name, DIMENSIONLESS), dtype=np.float64),
        "timeOffset": np.float64(0.0),
    }


def text(value: str) -> np.bytes_:
    """Return a fixed-length HDF5 string; other characters than ASCII are kept as UTF-8."""
    return np.bytes_(value.encode())


def _user() -> str:
    try:
        return getpass.getuser() or "unknown"
    except (KeyError, OSError, ImportError):
        return "unknown"


def _component() -> Attributes:
    return {"unitSI": np.float64(1.0)}


def component_name(index: tuple[int, ...], shape: tuple[int, ...], axes: Sequence[str]) -> str:
    """Return the name of a component: axes for vectors and tensors of the space, x or xy, numbers otherwise."""
    of_space = all(size == len(axes) for size in shape)
    return "".join(axes[k] for k in index) if of_space else "_".join(str(k) for k in index)


def _split(values: Numbers, rows: int, dim: int) -> Iterator[tuple[str, Numbers]]:
    """Yield (suffix of the path, values) of each component, `rows` the number of axes of a scalar; "" for a scalar."""
    shape = values.shape[rows:]
    for index in np.ndindex(shape):
        component: tuple[EllipsisType | int, ...] = (..., *index)
        yield f"/{component_name(index, shape, AXES[:dim])}" if shape else "", values[component]


def _check(name: str, values: Numbers, shape: tuple[int, ...]) -> None:
    if values.shape[: len(shape)] != shape:
        raise ValueError(f"field {name!r} has shape {values.shape}, expected {shape} and that of a value")
    if values.dtype.kind not in "fiu":
        raise ValueError(f"field {name!r} has type {values.dtype}, expected real numbers")


def _add_particles(tree: Tree, particles: ParticleArrays, counts: Sequence[int], rank: int) -> None:
    total, start, n = sum(counts), sum(counts[:rank]), counts[rank]
    dim = particles.position.shape[1]
    records: dict[str, Numbers] = {"id": particles.ids, "position": particles.position, **particles.fields}
    tree.attributes[SPECIES] = {}
    for name, array in records.items():
        values = np.asarray(array)
        _check(name, values, (n,))
        path = f"{SPECIES}/{name}"
        if values.ndim > 1:
            tree.attributes[path] = record_attributes(name)
        for suffix, column in _split(values, 1, dim):
            extra = {} if suffix else record_attributes(name)
            tree.add(Block(path + suffix, (total,), (start,), column), extra | _component())
    offset = f"{SPECIES}/positionOffset"
    tree.attributes[offset] = record_attributes("positionOffset")
    for axis in AXES[:dim]:
        constant: Attributes = {"value": np.float64(0.0), "shape": np.array([total], dtype=np.uint64)}
        tree.attributes[f"{offset}/{axis}"] = constant | _component()


def _add_patches(tree: Tree, particles: ParticleArrays, counts: Sequence[int], rank: int) -> None:
    """Add one patch per rank: its rows, and a box [offset, offset + extent) that holds its particles."""
    dim, ranks = particles.position.shape[1], (len(counts),)
    patches = f"{SPECIES}/particlePatches"
    tree.attributes[patches] = {}

    def add(path: str, value: float, dtype: type[np.generic]) -> None:
        tree.add(Block(f"{patches}/{path}", ranks, (rank,), np.array([value], dtype=dtype)), _component())

    add("numParticles", counts[rank], np.uint64)
    add("numParticlesOffset", sum(counts[:rank]), np.uint64)
    low, extent = smallest_box(np.asarray(particles.position, dtype=np.float64))
    for name, corner in (("offset", low), ("extent", extent)):
        tree.attributes[f"{patches}/{name}"] = record_attributes("position")
        for axis in range(dim):
            add(f"{name}/{AXES[axis]}", corner[axis], np.float64)


def smallest_box(position: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return corner and size of the smallest half-open box around the points; zeros when there are none."""
    if len(position) == 0:
        zero = np.zeros(position.shape[1])
        return zero, zero
    low, high = position.min(axis=0), position.max(axis=0)
    with np.errstate(invalid="ignore", over="ignore"):
        # Two units in the last place: low + extent must round to more than high.
        return low, (high - low) + 2 * np.spacing(np.maximum(abs(low), abs(high)))


def _add_mesh(tree: Tree, name: str, values: Numbers, grid: Blocks) -> None:
    """Add a nodal field on the whole grid; nodes sit on the corners of the cells, node 0 at the origin."""
    dim = len(grid.cells)
    shape = tuple(int(m) for m in grid.cells)
    start = tuple(int(i) for i in grid.owned_start)
    _check(name, values, tuple(int(m) for m in grid.owned_shape))
    mesh: Attributes = {
        **record_attributes(name),
        "geometry": text("cartesian"),
        "dataOrder": text("C"),
        "axisLabels": np.array([axis.encode() for axis in AXES[:dim]]),
        "gridSpacing": np.array(grid.length, dtype=np.float64) / np.array(grid.cells),
        "gridGlobalOffset": np.zeros(dim),
        "gridUnitSI": np.float64(1.0),
    }
    path = f"{MESHES}/{name}"
    if values.ndim > dim:
        tree.attributes[path] = mesh
    for suffix, component in _split(values, dim, dim):
        extra = {} if suffix else mesh
        tree.add(Block(path + suffix, shape, start, component), extra | _component() | {"position": np.zeros(dim)})

"""Particles of one rank: growable columns of named fields of any shape, global ids, order by cell.

A particle is a coordinate, an id that is its own on all ranks, and one row of the state array, whose columns are the
components of its named fields: scalars, vectors, tensors. Nothing here knows what the fields mean.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from mpipic.arguments import real_array
from mpipic.arrays import FloatArray, IntArray, Shape, size_of
from mpipic.kernels import blocks, generic
from mpipic.mesh.grid import Grid
from mpipic.wording import listed


class Particles:
    """Columns of the particles that this rank holds.

    `particles["velocity"]` is a view of a field, (n, *shape), and can be assigned to.

    Parameters
    ----------
    h : d floats
        Spacing of the grid, unit of length; its number of entries is the dimension.
    fields : mapping from name to the shape of one particle's value
        For example {"density": (), "velocity": (2,), "stress": (2, 2)}; columns of the state in this order.

    Attributes
    ----------
    coordinate : (n, d), in cells
    position : (n, d), unit of length
        A copy.
    state : (n, k)
        All components of all fields side by side. `coordinate`, `state`, `ids` and fields are views: ask again after
        particles came or went.
    ids : (n,) int64
        Global id, never changed.
    shapes : dict from name to shape

    Notes
    -----
    Local. Memory: 8 (d + k + 1) bytes a particle, and up to an eighth more once particles have arrived.
    """

    def __init__(self, h: Sequence[float], fields: Mapping[str, Shape]) -> None:
        self.h = tuple(h)
        self.dim = len(self.h)
        self.shapes = {name: tuple(shape) for name, shape in fields.items()}
        self.count = 0
        self._columns: dict[str, slice] = {}
        first = 0
        for name, shape in self.shapes.items():
            self._columns[name] = slice(first, first + size_of(shape))
            first += size_of(shape)
        self._axes = np.empty((self.dim, 0))
        self._state = np.empty((0, first))
        self._ids = np.empty((0, 1), dtype=np.int64)

    @property
    def coordinate(self) -> FloatArray:
        """Coordinates in cells, (n, d), a view."""
        return self._axes[:, : self.count].T

    @property
    def axes(self) -> FloatArray:
        """Coordinates in cells with one row per axis, (d, room): the memory behind `coordinate`, C-contiguous."""
        return self._axes

    @property
    def position(self) -> FloatArray:
        """Positions in units of length, (n, d), a copy; what counts as on node 0 is there."""
        return np.asarray(np.maximum(self.coordinate, 0.0) * np.array(self.h))

    @property
    def state(self) -> FloatArray:
        """All components side by side, (n, k), a view."""
        return self._state[: self.count]

    @property
    def ids(self) -> IntArray:
        """Global ids, (n,), a view."""
        return self._ids[: self.count, 0]

    @property
    def fields(self) -> dict[str, FloatArray]:
        """All fields by name, views (n, *shape)."""
        return {name: self[name] for name in self.shapes}

    def __getitem__(self, name: str) -> FloatArray:
        """Return the field of this name, (n, *shape), a view."""
        return self.columns_of_state(self.state, name)

    def __setitem__(self, name: str, values: npt.ArrayLike) -> None:
        """Give all particles these values of a field, (n, *shape), or one value to all, (*shape) or a number."""
        given, field = real_array(f"values of {name}", values), self[name]
        if given.shape not in (field.shape, field.shape[1:], ()):
            raise ValueError(f"values of {name} must have shape {field.shape}, not {given.shape}")
        field[...] = given

    def columns_of_state(self, state: FloatArray, name: str) -> FloatArray:
        """Return a field's columns of rows like those of `state`, (m, k), as (m, *shape), a view."""
        if name not in self.shapes:
            raise KeyError(f"particles have no field {name!r}, only {listed(self.shapes)}")
        return state[:, self._columns[name]].reshape(len(state), *self.shapes[name])

    def state_of(self, fields: Mapping[str, FloatArray], count: int) -> FloatArray:
        """Return state rows (count, k) that hold these fields, (count, *shape) each; what is not named is 0."""
        state = np.zeros((count, self._state.shape[1]))
        for name, values in fields.items():
            self.columns_of_state(state, name)[...] = values
        return state

    @property
    def bytes_per_particle(self) -> int:
        """Bytes of one particle's row in all columns."""
        return 8 * (self.dim + self._state.shape[1] + 1)

    @property
    def nbytes(self) -> int:
        """Bytes of all columns, with the room kept for arrivals."""
        return sum(array.nbytes for array in (self._axes, self._state, self._ids))

    def append(self, coordinate: FloatArray, state: FloatArray, ids: IntArray) -> None:
        """Add particles after the present ones. Shapes (j, d), (j, k), (j,). Local; O(j), now and then O(n)."""
        added = len(ids)
        wanted = (added, self.dim), (added, self._state.shape[1]), (added,)
        if (coordinate.shape, state.shape, ids.shape) != wanted:
            given = f"{coordinate.shape}, {state.shape} and {ids.shape}"
            raise ValueError(f"coordinate, state and ids must have the shapes {listed(map(str, wanted))}, not {given}")
        self._reserve(self.count + added)
        span = slice(self.count, self.count + added)
        self._axes[:, span], self._state[span], self._ids[span, 0] = coordinate.T, state, ids
        self.count += added

    def replace(self, coordinate: FloatArray, state: FloatArray, ids: IntArray) -> None:
        """Hold these particles and no others. Shapes (n, d), (n, k), (n,). Local; O(n)."""
        self.count = 0
        self.append(coordinate, state, ids)

    def _reserve(self, wanted: int) -> None:
        if wanted <= len(self._ids):
            return
        room = wanted if self.count == 0 else wanted + wanted // 8
        axes, state, ids = self.coordinate, self.state, self.ids
        self._axes = np.empty((self.dim, room))
        self._state = np.empty((room, state.shape[1]))
        self._ids = np.empty((room, 1), dtype=np.int64)
        self.coordinate[:], self.state[:], self.ids[:] = axes, state, ids

    def take(self, index: IntArray) -> tuple[FloatArray, FloatArray, IntArray]:
        """Remove the particles at these sorted indices and return copies (coordinate, state, ids).

        Others move into the gaps from the end. Local; O(number removed).
        """
        taken = self.coordinate[index], self.state[index], self.ids[index]
        stay = self.count - len(index)
        gaps = index[index < stay]
        moved = np.ones(len(index), dtype=bool)  # of the particles from `stay` on: those that are not taken
        moved[index[len(gaps) :] - stay] = False
        fill = stay + np.flatnonzero(moved)[::-1]
        for array in (*self._axes, self._state, self._ids):
            array[gaps] = array[fill]
        self.count = stay
        return taken

    def sort_by_cell(self, grid: Grid) -> None:
        """Order by cell, x fastest; those of one cell keep their order. Local; O(n), one column copied at a time."""
        cell, _ = locate(grid, self.coordinate)
        order = np.empty(self.count, dtype=np.int64)
        generic.sort_order(cell, grid.local_cells, order)
        for array in (*self._axes, self._state, self._ids):
            array[: self.count] = array[order]


def locate(grid: Grid, coordinate: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return local cell (n,) and local coordinates (n, d) of coordinates (n, d), which must lie in this rank's cells.

    Raises ValueError naming the first that does not. Local; O(n).
    """
    cell = np.empty(len(coordinate), dtype=np.int64)
    fraction = np.empty_like(coordinate)
    stray = generic.locate(
        coordinate, np.array(grid.tolerance), np.array(grid.owned_start), np.array(grid.owned_shape), cell, fraction
    )
    if stray >= 0:
        raise _stray(grid, coordinate, stray)
    return cell, fraction


def check_inside(particles: Particles, grid: Grid) -> None:
    """Raise ValueError naming the first particle that is not in this rank's cells. Local; O(n)."""
    outside = np.zeros(particles.count, dtype=np.int32)
    for axis, (first, size) in enumerate(zip(grid.owned_start, grid.owned_shape, strict=True)):
        x = particles.axes[axis, : particles.count]
        blocks.mark_outside(x, grid.tolerance[axis], np.int32(first), np.int32(size), outside)
    if outside.any():
        raise _stray(grid, particles.coordinate, int(np.argmax(outside != 0)))


def _stray(grid: Grid, coordinate: FloatArray, row: int) -> ValueError:
    stop = tuple(s + n for s, n in zip(grid.owned_start, grid.owned_shape, strict=True))
    return ValueError(
        f"particle {row} at {(coordinate[row] * np.array(grid.h)).tolist()}, in cells {coordinate[row].tolist()}, is "
        f"not in the cells {grid.owned_start} to {stop} of rank {grid.rank}; mpipic.Placement brings particles to the "
        "ranks that own their cells"
    )

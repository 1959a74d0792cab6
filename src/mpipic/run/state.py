"""Particles and values that a caller gives to a simulation, looked at before anything is changed."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mpipic.arguments import positions, real_array, rows
from mpipic.arrays import FloatArray, IntArray
from mpipic.mesh.agreement import Said, together
from mpipic.mesh.grid import Grid
from mpipic.particles.store import Particles, locate
from mpipic.wording import listed

NewState = tuple[FloatArray | None, FloatArray | None, IntArray | None]
"""Coordinates (n, d) in the box, state rows (n, k) and ids (n,); None for what is not given."""
Given = npt.ArrayLike | None


def agreed_state(grid: Grid, particles: Particles, coordinate: Given, state: Given, ids: Given) -> NewState:
    """Return what is given for these particles, once it is right on all ranks, and all give the same of it.

    Raises
    ------
    ValueError, TypeError
        One is of another shape or type; coordinates come without ids, or are not in this rank's cells; ids are no
        whole numbers of 64 bits, or one comes twice. On all ranks together.

    Notes
    -----
    Collective; one reduction.
    """

    def say(found: NewState) -> Said:
        given = [values is not None for values in found]
        named = [name for name, there in zip(("coordinate", "state", "ids"), given, strict=True) if there]
        return Said(list(map(float, given)), lambda: listed(named) if named else "nothing")

    return together(grid.comm, "set_state", lambda: _checked(grid, particles, coordinate, state, ids), say)[0]


def _checked(grid: Grid, particles: Particles, coordinate: Given, state: Given, ids: Given) -> NewState:
    if (coordinate is None) != (ids is None):
        raise ValueError("coordinate and ids go together: new places need to know whose they are")
    places = names = None
    if coordinate is not None and ids is not None:
        places = positions("coordinate", coordinate, grid.dim)
        if not np.isfinite(places).all():
            first = int(np.argmin(np.isfinite(places).all(axis=1)))
            raise ValueError(f"coordinate {first} = {places[first].tolist()} is not finite")
        places = grid.wrapped(places)
        locate(grid, np.ascontiguousarray(places))
        names = _ids(ids, len(places))
    if state is None:
        return places, None, names
    count, width = particles.count if places is None else len(places), particles.state.shape[1]
    values = np.asarray(rows("state", state, count, width), dtype=np.float64)
    if values.ndim != 2:
        raise ValueError(f"state must have shape ({count}, {width}), a row for each particle, not {values.shape}")
    return places, values, names


def _ids(ids: npt.ArrayLike, count: int) -> IntArray:
    given = real_array("ids", ids)
    if given.shape != (count,):
        raise ValueError(f"ids must have shape ({count},), one for each row of coordinate, not {given.shape}")
    if count and (given.dtype.kind not in "iu" or given.max() > np.iinfo(np.int64).max):
        raise TypeError(f"ids must be whole numbers of 64 bits, not of type {given.dtype}")
    names = np.asarray(given, dtype=np.int64)
    if len(np.unique(names)) < count:
        raise ValueError("ids must be different from each other")
    return names

"""Particles of another code, brought to the ranks that own their cells, and their values sent back."""

from __future__ import annotations

import numpy as np

from mpipic.arrays import FloatArray, columns_of
from mpipic.mesh.agreement import raise_together
from mpipic.mesh.grid import Grid
from mpipic.particles.migration import Routes


class Placement:
    """Particles of another code, held by any rank, brought to the ranks that own their cells, and values sent back.

    Parameters
    ----------
    grid
        The grid that will map them.
    position : (n, d)
        This rank's block of positions; any rank may hold any particle. Axes are periodic: a position off the box counts
        as the one in the box that it falls on (see `mpipic.box`).

    Attributes
    ----------
    position : (m, d)
        Positions in the box, 0 <= x < length, of the particles that this rank's cells hold; `to_owners` gives values in
        the same order.

    Raises
    ------
    ValueError
        A position is not finite, or so far away that its digits do not tell its cell; names the first. Raised on all
        ranks together.

    Notes
    -----
    Collective, with messages to all ranks that hold particles of each other's cells.
    """

    def __init__(self, grid: Grid, position: FloatArray) -> None:
        problem = None
        try:
            position = grid.in_box(np.asarray(position, dtype=np.float64).reshape(-1, grid.dim))
        except ValueError as error:
            problem = error
        raise_together(grid.comm, problem)
        self._routes = Routes(grid)
        self._owner = grid.owner_of(grid.coordinate_of(position))
        self._delivery = self._routes.exchange(position, self._owner)
        self.position = self._delivery.rows

    def to_owners(self, values: FloatArray) -> FloatArray:
        """Return values (n, *shape) of this rank's block as (m, *shape) in the order of `position`. Collective."""
        rows = self._routes.exchange(columns_of(values), self._owner).rows
        return rows.reshape((-1, *np.shape(values)[1:]))

    def to_callers(self, values: FloatArray) -> FloatArray:
        """Return values (m, *shape) in the order of `position` to where they came from, (n, *shape). Collective."""
        rows = self._routes.give_back(columns_of(values), self._delivery)
        return rows.reshape((-1, *np.shape(values)[1:]))

"""Particles of another code, brought to the ranks that own their cells, and their values sent back."""

from __future__ import annotations

from typing import Any

import numpy.typing as npt

from mpipic.arguments import rows
from mpipic.arrays import FloatArray, side_by_side
from mpipic.mesh.agreement import together, values_together
from mpipic.mesh.grid import Grid, checked_grid
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
    ValueError, TypeError
        Positions are no array (n, d) of real numbers; or one of them is not finite, or so far away that its digits do
        not tell its cell: names the first. Raised on all ranks together.

    Notes
    -----
    Collective, with messages to all ranks that hold particles of each other's cells, and a reduction to agree.
    """

    def __init__(self, grid: Grid, position: FloatArray) -> None:
        self._comm = checked_grid(grid).comm
        inside, _ = together(self._comm, "Placement", lambda: grid.in_box(position))
        self._routes = Routes(grid)
        self._owner = grid.owner_of(grid.coordinate_of(inside))
        self._delivery = self._routes.exchange(inside, self._owner)
        self.position = self._delivery.rows

    def to_owners(self, values: npt.ArrayLike) -> npt.NDArray[Any]:
        """Return values (n, *shape) of this rank's block as (m, *shape) in the order of `position`.

        They come bit for bit, in the type that they have: whole numbers such as ids stay whole. Type and shape must be
        those of the other ranks; a rank without particles may give (0,) whatever theirs are.

        Raises
        ------
        ValueError, TypeError
            On all ranks together.

        Notes
        -----
        Collective: a block of values to each rank that owns some, and a reduction to agree.
        """
        own = self._agreed("Placement.to_owners", values, len(self._owner))
        sent = self._routes.exchange(side_by_side(own), self._owner).rows
        return sent.reshape(len(sent), *own.shape[1:])

    def to_callers(self, values: npt.ArrayLike) -> npt.NDArray[Any]:
        """Return values (m, *shape) in the order of `position` to where they came from, (n, *shape).

        Rules, errors and costs are those of `to_owners`. Collective.
        """
        own = self._agreed("Placement.to_callers", values, len(self.position))
        returned = self._routes.give_back(side_by_side(own), self._delivery)
        return returned.reshape(len(returned), *own.shape[1:])

    def _agreed(self, verb: str, values: npt.ArrayLike, count: int) -> npt.NDArray[Any]:
        return values_together(self._comm, verb, lambda: rows("values", values, count), typed=True)

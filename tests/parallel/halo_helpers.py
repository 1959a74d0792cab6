"""What each rank runs for `test_halo_ranks.py`: python halo_helpers.py FILE; rank 0 writes it as JSON.

All values are small whole numbers, so that sums are exact in any order.
"""

from __future__ import annotations

import json
import sys
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from mpipic.decomposition import process_grid
from mpipic.mesh.grid import Grid
from mpipic.mesh.halo import Halo
from mpipic.runtime import start

COMM = start()
BOXES = ((1,), (2,), (3,), (5,), (3, 4), (1, 4), (5, 7), (2, 3, 2), (4, 3, 5))
WIDTHS = (1, 2, 3)
UNTOUCHED = -999.0


def node_of(halo: Halo, cells: tuple[int, ...]) -> np.ndarray:
    """Global node, x fastest, of every entry of a padded array, from what the halo says of itself."""
    axes = [
        np.mod(first - halo.width + np.arange(n), period)
        for first, n, period in zip(halo.owned_start, halo.ghost_shape, cells, strict=True)
    ]
    number = np.zeros(halo.ghost_shape[::-1], dtype=int)
    for axis, along in enumerate(axes):
        shape = [1] * len(cells)
        shape[len(cells) - 1 - axis] = -1
        number += (along * int(np.prod(cells[:axis]))).reshape(shape)
    return number.ravel()


def within(halo: Halo, reach: tuple[int, int]) -> np.ndarray:
    """Which entries of a padded array lie among the own nodes and `reach` below and above them; flat booleans."""
    inside = np.ones(halo.ghost_shape[::-1], dtype=bool)
    for axis, n in enumerate(halo.owned_shape):
        along = np.arange(n + 2 * halo.width) - halo.width
        shape = [1] * inside.ndim
        shape[inside.ndim - 1 - axis] = -1
        inside &= ((along >= -reach[0]) & (along < n + reach[1])).reshape(shape)
    return inside.ravel()


def wrong_after_fill(halo: Halo, table: np.ndarray, node: np.ndarray, reached: np.ndarray, own: np.ndarray) -> int:
    """Entries that do not hold the value of their global node, or were written to although out of reach."""
    padded = np.full((halo.local_nodes, *table.shape[1:]), UNTOUCHED)
    padded[own] = table[node[own]]
    halo.fill(padded)
    return int(np.count_nonzero(padded[reached] != table[node[reached]])) + int(
        np.count_nonzero(padded[~reached] != UNTOUCHED)
    )


def check_add(halo: Halo, table: np.ndarray, node: np.ndarray, reached: np.ndarray, own: np.ndarray) -> dict[str, Any]:
    """Own entries that are not the sum over all copies of their node, and both sides of <add x, y> = <x, fill y>."""
    rng = np.random.default_rng([7, COMM.rank])
    given = rng.integers(-50, 50, (halo.local_nodes, *table.shape[1:])).astype(float)
    sums = np.zeros(table.shape)
    np.add.at(sums, node[reached], given[reached])
    COMM.Allreduce(MPI.IN_PLACE, sums)
    added = given.copy()
    halo.add(added)
    filled = np.zeros(given.shape)
    filled[own] = table[node[own]]
    halo.fill(filled)
    left, right = float((added[own] * table[node[own]]).sum()), float((given[reached] * filled[reached]).sum())
    return {
        "wrong_sums": int(np.count_nonzero(added[own] != sums[node[own]])),
        "changed_ghosts": int(np.count_nonzero(added[~own] != given[~own])),
        "products": [COMM.allreduce(left), COMM.allreduce(right)],
    }


def run_case(cells: tuple[int, ...], width: int, reach: tuple[int, int]) -> dict[str, Any] | None:
    """One box, width and reach; scalars and three columns."""
    starts = Grid(cells, [1.0] * len(cells)).starts
    halo = Halo(COMM, cells, starts, width, None if reach == (width, width) else reach)
    node, reached, own = node_of(halo, cells), within(halo, reach), within(halo, (0, 0))
    facts: dict[str, Any] = {"ghosts": int(np.count_nonzero(reached & ~own)), "shape": halo.owned_shape, "columns": []}
    for columns in ((), (3,)):
        table = np.random.default_rng(3).integers(1, 99, (int(np.prod(cells)), *columns)).astype(float)
        found = {"wrong_ghosts": wrong_after_fill(halo, table, node, reached, own)}
        facts["columns"].append({**found, **check_add(halo, table, node, reached, own)})
    everywhere = COMM.gather(facts)
    name = {"cells": cells, "width": width, "reach": reach}
    return None if everywhere is None else {**name, "ranks": everywhere}


def main(file: Path) -> None:
    """Run all cases that this number of ranks can be laid out for."""
    result = []
    for cells, width in product(BOXES, WIDTHS):
        if process_grid(cells, COMM.size) is None:
            continue
        for reach in sorted({(width, width), (0, 1), (width, width - 1)}):
            result.append(run_case(cells, width, reach))
    if COMM.rank == 0:
        file.write_text(json.dumps(result))


if __name__ == "__main__":
    main(Path(sys.argv[1]))

"""What each rank runs for `test_exact_ranks.py`: python exact_helpers.py FOLDER.

Applies the exact filter to the same particles on any number of ranks. Rank 0 saves FOLDER/<case>.npz.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from mpipic.filters import ExactFilter
from mpipic.mapping.mapping import Mapping
from mpipic.mesh.grid import Grid
from mpipic.runtime import start

COMM = start()
BOXES = {2: ((24, 21), (1.0, 1.3)), 3: ((9, 8, 10), (1.0, 0.8, 1.7))}
CASES = [f"{dim}d-{layout}" for dim in BOXES for layout in ("random", "lattice")]


def particles(case: str) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, d) and values (n, 2) of all particles, the same on every rank."""
    dim, layout = int(case[0]), case[3:]
    cells, length = BOXES[dim]
    rng = np.random.default_rng(dim)
    if layout == "lattice":
        # off the middles of the cells, so that no symmetry shortens the iteration
        axes = [(np.arange(2 * n) + 0.4) / (2 * n) * box for n, box in zip(cells, length, strict=True)]
        position = np.stack([x.ravel() for x in np.meshgrid(*axes)], axis=1)
    else:
        position = rng.random((4 * int(np.prod(cells)), dim)) * length
    return position, rng.standard_normal((len(position), 2))


def run_case(case: str) -> dict[str, np.ndarray] | None:
    """Filter twice, the second time after the particles have moved by a third of a cell."""
    position, values = particles(case)
    grid = Grid(*BOXES[int(case[0])])
    keep, answers, iterations = None, [], []
    for move in (0.0, 1.0 / 3.0):
        there = np.mod(position + move * np.array(grid.h), grid.length)
        mine = np.flatnonzero(grid.owner_of(grid.coordinate_of(there)) == COMM.rank)
        if keep is None:
            keep = ExactFilter(Mapping(grid, there[mine]), tolerance=1e-10)
        else:
            keep.mapping.update(there[mine])
        parts = COMM.gather((mine, keep.apply(values[mine])))
        iterations.append(COMM.gather(keep.facts()["iterations"]))
        if parts is not None:
            order = np.argsort(np.concatenate([ids for ids, _ in parts]))
            answers.append(np.concatenate([answer for _, answer in parts])[order])
    if COMM.rank:
        return None
    return {"answers": np.array(answers), "iterations": np.array(iterations)}


def main(folder: Path) -> None:
    """Run all cases."""
    for case in CASES:
        result = run_case(case)
        if result is not None:
            np.savez(folder / f"{case}.npz", **result)


if __name__ == "__main__":
    main(Path(sys.argv[1]))

"""What each rank runs for `test_exact_ranks.py`: python exact_helpers.py FOLDER.

Applies the exact filter to the same particles on any number of ranks. Rank 0 saves FOLDER/<case>.npz.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from mpipic.errors import NotConverged
from mpipic.filters import ExactFilter
from mpipic.mapping.mapping import Mapping
from mpipic.mesh.grid import Grid
from mpipic.particles.placement import Placement
from mpipic.runtime import start

COMM = start()
BOXES = {2: ((24, 21), (1.0, 1.3)), 3: ((9, 8, 10), (1.0, 0.8, 1.7))}
CLOUDS = ("block", "line")
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


def cloud(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, 2) in the unit box and values (n, 2) of a turned block, or of a line, which is refused."""
    rng = np.random.default_rng(4)
    if kind == "line":
        position = 0.5 + 0.4 * (rng.random(80)[:, None] - 0.5) * np.array([1.0, 0.37])
    else:
        square = np.stack(np.meshgrid(*[(np.arange(16) + 0.5) / 16 - 0.5] * 2), axis=-1).reshape(-1, 2)
        position = square * (0.475, 0.3) @ np.array([[2.0, -1.0], [1.0, 2.0]]).T / np.sqrt(5.0) + 0.5
    return position, rng.standard_normal((len(position), 2))


def run_cloud(kind: str) -> dict[str, np.ndarray] | None:
    """Filter a cloud that leaves most cells empty, cubic; what each rank was told if it was refused."""
    position, values = cloud(kind)
    grid = Grid((16, 12), (1.0, 1.0), basis="cubic")
    placement = Placement(grid, position[COMM.rank :: COMM.size])
    keep = ExactFilter(Mapping(grid, placement.position), tolerance=1e-10)
    there, told = placement.to_owners(values[COMM.rank :: COMM.size]), ""
    try:
        there = keep.apply(there)
    except NotConverged as error:
        told = str(error)
    parts = COMM.gather((placement.to_callers(there), told, keep.solver.factorised))
    if parts is None:
        return None
    answer = np.empty_like(values)
    for rank, (rows, _, _) in enumerate(parts):
        answer[rank :: COMM.size] = rows
    return {
        "answers": answer,
        "told": np.array([told for _, told, _ in parts]),
        "factorised": np.array([by_factors for *_, by_factors in parts]),
    }


def main(folder: Path) -> None:
    """Run all cases."""
    for kind in CLOUDS:
        result = run_cloud(kind)
        if result is not None:
            np.savez(folder / f"{kind}.npz", **result)
    for case in CASES:
        result = run_case(case)
        if result is not None:
            np.savez(folder / f"{case}.npz", **result)


if __name__ == "__main__":
    main(Path(sys.argv[1]))

"""What each rank runs for `test_library_ranks.py`: python library_helpers.py FOLDER.

Uses the package as a library on particles of its own. Rank 0 saves FOLDER/<dim>d-<distribution>.npz.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from mpipic import Grid, LocalFilter, Mapping, Placement
from mpipic.filters import ExactFilter, SvdFilter
from mpipic.runtime import start

COMM = start()
BOXES = {
    1: ((11,), (2.0,)),
    2: ((5, 7), (1.0, 3.0)),
    3: ((3, 5, 4), (1.5, 1.0, 2.0)),
}
COUNT = 240


def particles(dim: int, distribution: str) -> dict[str, np.ndarray]:
    """The same particles and values on every rank; some sit on nodes and on the box's lower faces."""
    cells, length = BOXES[dim]
    rng = np.random.default_rng(dim)
    position = rng.random((COUNT, dim)) * length
    h = np.array(length) / cells
    position[:30] = np.floor(position[:30] / h) * h
    position[30] = 0.0
    if distribution == "corner":
        position *= 0.2
    scalar, vector = rng.standard_normal(COUNT), rng.standard_normal((COUNT, 3))
    return {"position": position, "scalar": scalar, "vector": vector, "weight": 10.0 ** rng.uniform(-1.0, 1.0, COUNT)}


def held_by(distribution: str) -> np.ndarray:
    """Which rank holds which particle before any is placed."""
    ids = np.arange(COUNT)
    holders = {
        "corner": ids % COMM.size,
        "blocks": ids * COMM.size // COUNT,
        "interleaved": ids % COMM.size,
        "last": np.full(COUNT, COMM.size - 1),
        "first-has-none": 1 % COMM.size + ids % max(1, COMM.size - 1),
    }
    return holders[distribution]


DISTRIBUTIONS = ("blocks", "interleaved", "last", "first-has-none", "corner")
"""Of particles over ranks; corner: they fill so little of the box that some ranks own none."""
WEIGHTED = "interleaved"
"""How particles of different weights are distributed."""


def filters_of(mapping: Mapping) -> dict[str, object]:
    """Those that are compared with dense matrices, by kind."""
    return {
        "local": LocalFilter(mapping),
        "exact": ExactFilter(mapping, tolerance=1e-12),
        "svd": SvdFilter(mapping),
    }


def in_order_of_ids(mine: np.ndarray, **values: np.ndarray) -> dict[str, np.ndarray] | None:
    """Values of all ranks in the order of the ids; None but on rank 0."""
    parts = COMM.gather((mine, values))
    if parts is None:
        return None
    order = np.argsort(np.concatenate([part[0] for part in parts]), kind="stable")
    return {name: np.concatenate([part[1][name] for part in parts])[order] for name in values}


def run_case(dim: int, distribution: str) -> dict[str, np.ndarray] | None:
    """Place, map, filter, and bring everything back to the holders."""
    whole = particles(dim, distribution)
    mine = np.flatnonzero(held_by(distribution) == COMM.rank)
    np.random.default_rng(COMM.rank).shuffle(mine)  # callers keep their particles in any order
    given = {name: values[mine] for name, values in whole.items()}

    grid = Grid(*BOXES[dim])
    placement = Placement(grid, given["position"])
    mapping = Mapping(grid, placement.position)
    scalar, vector = placement.to_owners(given["scalar"]), placement.to_owners(given["vector"])
    ids = placement.to_owners(mine.astype(float)).astype(int)
    nodal = mapping.p2g(vector)
    back = {
        "round_trip": placement.to_callers(scalar),
        "round_trip_vector": placement.to_callers(vector),
        "slope": placement.to_callers(mapping.gradient(nodal[:, 0].copy())),
        "divergence": placement.to_callers(mapping.divergence(nodal[:, :dim].copy())),
        "owner": placement.to_callers(np.full(len(ids), float(COMM.rank))),
    }
    for kind, keep in filters_of(mapping).items():
        back[kind] = placement.to_callers(keep(scalar))
        back[f"{kind}_vector"] = placement.to_callers(keep.apply(vector))
    assert all(len(values) == len(mine) for values in back.values())
    assert np.array_equal(scalar, whole["scalar"][ids]) and np.array_equal(placement.position, whole["position"][ids])
    sums = COMM.allreduce(grid.owned(mapping.sums(vector)).reshape(-1, 3).sum(axis=0))
    weights = COMM.allreduce(float(grid.owned(mapping.row_sums).sum()))
    result = in_order_of_ids(mine, ids=mine, holder=np.full(len(mine), COMM.rank), **back)
    return None if result is None else {**result, "sums": sums, "weights": np.array(weights)}


def run_weighted_case(dim: int) -> dict[str, np.ndarray] | None:
    """Place particles of different weights, filter, and bring the result back to the holders."""
    whole = particles(dim, WEIGHTED)
    mine = np.flatnonzero(held_by(WEIGHTED) == COMM.rank)
    grid = Grid(*BOXES[dim])
    placement = Placement(grid, whole["position"][mine])
    weight, vector = (placement.to_owners(whole[name][mine]) for name in ("weight", "vector"))
    mapping = Mapping(grid, placement.position, weight)
    back = {kind: placement.to_callers(keep.apply(vector)) for kind, keep in filters_of(mapping).items()}
    return in_order_of_ids(mine, **back)


def main(folder: Path) -> None:
    """Run all cases."""
    for dim in BOXES:
        result = run_weighted_case(dim)
        if result is not None:
            np.savez(folder / f"{dim}d-weighted.npz", **result)
        for distribution in DISTRIBUTIONS:
            result = run_case(dim, distribution)
            if result is not None:
                np.savez(folder / f"{dim}d-{distribution}.npz", **result)
    for outside in (1e17, np.inf, np.nan):
        try:
            Placement(Grid(*BOXES[1]), np.array([[0.25], [outside]]))
        except ValueError as error:
            said = str(error)
        else:
            said = "accepted"
        assert "position 1 " in said and str(outside) in said, said
    COMM.Barrier()
    if COMM.rank == 0:
        print("all refused", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))

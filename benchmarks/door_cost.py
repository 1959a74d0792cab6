"""Cost of the checks at the library's door, as shares of what they guard.

    ./run -n 2 exec python benchmarks/door_cost.py [--particles 100000] [--dim 2]

Times a check alone, agreement of the ranks and all, and the whole verb; the least of many repeats, the slowest rank's.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from time import perf_counter

from mpipic.runtime import start

COMM = start()

import numpy as np  # noqa: E402  after the settings that start() makes
from mpi4py import MPI  # noqa: E402

from mpipic import Grid, LocalFilter, Mapping, Placement  # noqa: E402

CELLS = {1: (25_000,), 2: (158, 158), 3: (29, 29, 29)}


def seconds(call: Callable[[], object], repeats: int) -> float:
    """The least time of a call, the slowest rank's."""
    least = np.inf
    for _ in range(repeats):
        COMM.Barrier()
        began = perf_counter()
        call()
        least = min(least, COMM.allreduce(perf_counter() - began, op=MPI.MAX))
    return float(least)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--particles", type=float, default=1e5, help="on all ranks")
    parser.add_argument("--dim", type=int, default=2, choices=(1, 2, 3))
    chosen = parser.parse_args()
    dim, n = chosen.dim, int(chosen.particles) // COMM.size
    grid = Grid(CELLS[dim], (1.0,) * dim, COMM)
    placed = Placement(grid, np.random.default_rng(COMM.rank).random((n, dim)))
    mapping = Mapping(grid, placed.position)
    q = placed.to_owners(np.ones(n))
    nodal, keep = mapping.p2g(q), LocalFilter(mapping)
    checks = {
        "p2g": (lambda: mapping.agreed("p2g", q), lambda: mapping.p2g(q)),
        "LocalFilter.apply": (lambda: mapping.agreed("apply", q), lambda: keep.apply(q)),
        "g2p": (lambda: mapping.nodal(nodal), lambda: mapping.g2p(nodal)),
        "Mapping.update": (lambda: grid.in_box(placed.position), lambda: mapping.update(placed.position)),
    }
    for name, (check, verb) in checks.items():
        alone, whole = seconds(check, 1000), seconds(verb, 50)
        if COMM.rank == 0:
            print(f"{name:18s} {1e6 * alone:8.1f} of {1e6 * whole:10.1f} µs, {100 * alone / whole:5.2f} %")


if __name__ == "__main__":
    main()

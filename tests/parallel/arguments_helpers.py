"""What each rank runs for `test_argument_ranks.py`: python arguments_helpers.py CASES.

Walks worlds of particles that all ranks, one of them, or none hold, with mistakes of one rank and of several. All ranks
must see the same outcome: where a verb is collective an error is raised on all, by the same words.
"""

from __future__ import annotations

import sys

from argument_helpers import World
from moving_helpers import MovingWalk
from mpipic.runtime import start
from walk_helpers import Walk

COMM = start()


def main(cases: int) -> None:
    """Walk, and count."""
    total = 0
    for dim, spread, weighted in ((2, "box", True), (1, "corner", False), (3, "box", False), (2, "none", False)):
        walk = Walk(World(COMM, dim, spread, weighted), seed=10 * dim)
        for _ in range(cases):
            walk.step()
        assert walk.seen.total() >= cases
        total += cases
    moving = MovingWalk(COMM, seed=3)
    for _ in range(cases // 10):
        moving.step()
    if COMM.rank == 0:
        print(f"walked {total} cases", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]))

"""The walk of the tests through wrong and right arguments, as long as wanted, on any number of ranks.

    ./run -n 2 exec python benchmarks/arguments.py [--cases 50000] [--seed 0]

Ends with exit code 0 and a table of what was refused and answered; the first answer that is not that of the dense
matrices, or refusal that should not be, ends it with a traceback that names seed and case.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from pathlib import Path

from mpipic.runtime import start

COMM = start()
sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

import mpipic.run.parts  # noqa: E402, F401  all that scenes can name
from argument_helpers import World  # noqa: E402
from moving_helpers import MovingWalk  # noqa: E402
from walk_helpers import Walk  # noqa: E402

WORLDS = [(dim, spread, weighted) for dim in (1, 2, 3) for spread in ("box", "corner") for weighted in (False, True)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=50_000)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    seen: Counter[tuple[str, str]] = Counter()
    each = -(-chosen.cases // (len(WORLDS) + 2))
    for world in [*WORLDS, (1, "none", False), (2, "none", True)]:
        walk = Walk(World(COMM, *world), chosen.seed)
        for case in range(each):
            try:
                walk.step()
            except BaseException:
                print(f"seed {chosen.seed}, world {world}, case {case}", file=sys.stderr, flush=True)
                raise
        seen += walk.seen
    moving = MovingWalk(COMM, chosen.seed)
    for _ in range(each // 10):
        moving.step()
    if COMM.rank == 0:
        print(f"{seen.total()} cases on {COMM.size} ranks, and {each // 10} rounds of moving particles")
        for kind in sorted({kind for kind, _ in seen}):
            print(f"  {kind:18s} {seen[kind, 'answered']:7d} answered {seen[kind, 'refused']:7d} refused")


if __name__ == "__main__":
    main()

"""What each rank runs for `test_growth_ranks.py`: python growth_helpers.py FILE; rank 0 writes it as JSON.

The growth of the same scenes on any number of ranks, with M written out and by Krylov's method.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path

from mpipic.analysis import growth
from mpipic.runtime import start
from mpipic.scene.records import Scene

COMM = start()
DENSE = growth.DENSE
CASES = {
    "1d-paper-random": ("paper", [8], "random", [2], [1.0], 0.5),
    "1d-paper-lattice": ("paper", [10], "lattice", [2], [0.5], 0.25),
    "1d-recommended-random": ("recommended", [8], "random", [2], [1.25], 0.4),
    "2d-paper-jittered": ("paper", [4, 3], "jittered", [2, 1], [1.0, 1.0], 0.5),
}


def scene(name: str) -> Scene:
    """The scene of a case."""
    preset, cells, layout, per_cell, flow, cfl = CASES[name]
    overrides = [
        f"grid.cells={cells}", f"particles.layout={layout}", f"particles.per_cell={per_cell}", f"gas.flow={flow}",
        f"time.cfl={cfl}", "initial.profile=plane-wave", *(["particles.jitter=0.4"] if layout == "jittered" else []),
    ]  # fmt: skip
    return Scene.load(None, overrides, preset)


def main(file: Path) -> None:
    """Analyse all."""
    results = {}
    for name in CASES:
        for solver, dense in (("lapack", DENSE), ("krylovschur", 0)):
            growth.DENSE = dense
            found = asdict(growth.analyse(scene(name), COMM, 100))
            assert found["solver"] == solver
            results[f"{name} {solver}"] = [{**found, "ranks": COMM.size}, *COMM.allgather(found)]
    if COMM.rank == 0:
        file.write_text(json.dumps(results), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))

"""Growth per step of a scheme over many patterns of particles: the largest, and where it is found.

    ./run exec python benchmarks/growth.py [--preset recommended] [--dim 1] [--seeds 20] [--cells 16] [--set KEY=VALUE]

For random and jittered (by up to 0.4 spacings) particles, 1, 2, 4 and 8 a cell; flows and CFL numbers that recur after
a few steps. Growth below 1e-9 is what eigenvalues cannot resolve.
"""

from __future__ import annotations

import argparse
from itertools import product

from mpipic.runtime import start

COMM = start()

from mpipic.errors import NotConverged  # noqa: E402  after the settings that start() makes
from mpipic.scene import Scene  # noqa: E402
from mpipic.stability import analyse  # noqa: E402

PER_AXIS = {1: {1: [1], 2: [2], 4: [4], 8: [8]}, 2: {1: [1, 1], 2: [2, 1], 4: [2, 2], 8: [4, 2]},
            3: {1: [1, 1, 1], 2: [2, 1, 1], 4: [2, 2, 1], 8: [2, 2, 2]}}  # fmt: skip
SETTINGS = ((0.0, 0.4), (0.5, 0.4), (1.0, 0.4), (2.0, 0.4), (0.5, 0.1))
"""v/c and CFL."""


def scene(chosen: argparse.Namespace, layout: str, per_cell: int, seed: int, flow: float, cfl: float) -> Scene:
    dim = chosen.dim
    each = [per_cell] if layout == "random" else PER_AXIS[dim][per_cell]
    jitter = ["particles.jitter=0.4"] if layout == "jittered" else []
    overrides = [
        f"grid.cells={[chosen.cells] * dim}", f"particles.layout={layout}", f"particles.per_cell={each}",
        f"particles.seed={seed}", f"gas.flow={[flow] + [0.0] * (dim - 1)}", f"time.cfl={cfl}",
        "initial.profile=plane-wave", *jitter, *chosen.set,
    ]  # fmt: skip
    return Scene.load(None, overrides, chosen.preset)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="recommended")
    parser.add_argument("--dim", type=int, default=1)
    parser.add_argument("--cells", type=int, default=16)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--per-cell", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--set", action="append", default=[])
    chosen = parser.parse_args()
    for layout, per_cell in product(("random", "jittered"), chosen.per_cell):
        worst: tuple[float, str] = (-1.0, "")
        failed = 0
        for seed, (flow, cfl) in product(range(chosen.seeds), SETTINGS):
            try:
                growth = analyse(scene(chosen, layout, per_cell, seed, flow, cfl), COMM, 400).growth_per_step
            except NotConverged:
                failed += 1
                continue
            worst = max(worst, (growth, f"seed {seed}, v/c {flow}, CFL {cfl}"))
        print(
            f"{layout:9s} {per_cell} a cell: largest growth {worst[0]:.2e} ({worst[1]}), {failed} not found", flush=True
        )


if __name__ == "__main__":
    main()

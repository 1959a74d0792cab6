"""What the exact filter costs: against the local one, against SLEPc's and NumPy's decompositions, and as n grows.

    ./run exec python benchmarks/filter_cost.py [--particles 1e5 3e5 1e6 3e6 1e7] [--layout jittered] [--output FILE]

Seconds a step in 2D, 4 particles a cell, one rank: medians. A step filters three columns. The decomposition is made
anew every step, as it must be when particles move; NumPy's is timed by itself, for the matrix of one step. An exponent
is the slope of log seconds against log particles.
"""

from __future__ import annotations

import argparse
import statistics
from pathlib import Path
from time import perf_counter

from mpipic.runtime import start

COMM = start()

import numpy as np  # noqa: E402  after the settings that start() makes

from mpipic.analysis.bench import Plan, scene_of  # noqa: E402
from mpipic.files import write_json  # noqa: E402
from mpipic.mapping.mapping import Mapping  # noqa: E402
from mpipic.run.loop import Simulation  # noqa: E402
from mpipic.run.warmup import compile_loops  # noqa: E402
from mpipic.scene.records import Scene  # noqa: E402

WARM, LONGEST = 12, 60.0
"""Steps before the clock starts, so that particles have begun to cross cells; seconds that one case may take."""


def simulation(kind: str, particles: int, layout: str, tolerance: float) -> Simulation:
    scene = scene_of(2, kind, Plan((2,), particles, 4, (kind,), layout, 5, 5, tolerance))
    compile_loops(scene)
    return Simulation(scene, COMM)


def step_seconds(kind: str, particles: int, layout: str, tolerance: float, warm: int = WARM) -> tuple[int, float]:
    """Particles, and the median seconds of a step over at least 3."""
    run = simulation(kind, particles, layout, tolerance)
    for _ in range(warm):
        run.physics.step()
    times: list[float] = []
    while len(times) < 3 or (len(times) < 25 and sum(times) < LONGEST / 4):
        began = perf_counter()
        run.physics.step()
        times.append(perf_counter() - began)
    return run.total, statistics.median(times)


def numpy_seconds(particles: int, layout: str) -> float:
    """One dense decomposition of the mapping matrix by NumPy."""
    run = simulation("local", particles, layout, 1e-8)
    mapping = Mapping.at(run.grid, run.particles)
    grid, nodes = run.grid, run.grid.node_count
    unit = grid.zeros(nodes)
    grid.owned(unit)[...] = np.eye(nodes).reshape(*grid.cells, nodes)
    grid.fill_halo(unit)
    phi = mapping.g2p(unit)
    matrix = np.ascontiguousarray(phi.T / phi.sum(axis=0)[:, None])
    began = perf_counter()
    np.linalg.svd(matrix, full_matrices=False)
    return perf_counter() - began


def exponent(points: list[tuple[int, float]]) -> float:
    n, seconds = np.log(np.array(points)).T
    return statistics.linear_regression(n, seconds).slope


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--particles", type=float, nargs="+", default=[1e5, 3e5, 1e6, 3e6, 1e7])
    parser.add_argument("--small", type=float, nargs="*", default=[400, 900, 1600, 3600, 6400])
    parser.add_argument("--layout", default="jittered", choices=("lattice", "jittered", "random"))
    parser.add_argument("--tolerance", type=float, default=1e-8)
    parser.add_argument("--output", type=Path)
    chosen = parser.parse_args()
    found: dict[str, list[tuple[int, float]]] = {"local": [], "exact": [], "svd": [], "exact, small": [], "numpy": []}
    for count in map(int, chosen.particles):
        for kind in ("local", "exact"):
            found[kind].append(step_seconds(kind, count, chosen.layout, chosen.tolerance))
        (n, local), (_, exact) = found["local"][-1], found["exact"][-1]
        print(f"n = {n:9,}: local {local:.3e} s a step, exact {exact:.3e} s, ratio {exact / local:.2f}", flush=True)
    for count in map(int, chosen.small):
        found["exact, small"].append(step_seconds("exact", count, chosen.layout, chosen.tolerance))
        found["svd"].append(step_seconds("svd", count, chosen.layout, chosen.tolerance, warm=0))
        n = found["svd"][-1][0]
        found["numpy"].append((n, numpy_seconds(count, chosen.layout)))
        exact, svd, dense = (found[name][-1][1] for name in ("exact, small", "svd", "numpy"))
        print(
            f"n = {n:9,}: exact {exact:.3e} s a step, svd {svd:.3e} s ({svd / exact:.0f} times), "
            f"one NumPy decomposition {dense:.3e} s ({dense / exact:.0f} times)", flush=True,
        )  # fmt: skip
    exponents = {name: exponent(points) for name, points in found.items() if len(points) > 1}
    print(f"{chosen.layout}, tolerance {chosen.tolerance:g}; exponents in n:")
    for name, value in exponents.items():
        print(f"  {name:14s} {value:.2f}")
    if chosen.output:
        scene = scene_of(2, "exact", Plan((2,), 1000, 4, ("exact",), chosen.layout, 5, 5, chosen.tolerance))
        assert isinstance(scene, Scene)
        content = {"seconds": found, "exponents": exponents, "scene": scene.to_dict()}
        write_json(chosen.output, content)


if __name__ == "__main__":
    main()

"""The exact filter on ragged clouds: its error, whether it refuses, and its time beside conjugate gradients alone.

    ./run exec python benchmarks/ragged.py [--clouds 2000] [--tolerance 1e-10] [--seed 1] [--output FILE]

Clouds are those of the tests (discs, rings, turned blocks, blobs, lines, shells, single cells; 1D to 3D, linear to
cubic); the error is the largest of ‖P²q - Pq‖ and ‖Pq - P_svd q‖ over noise and the directions hardest to get right,
all of norm 1. Times are those of one application to eight columns, positions mapped before, in milliseconds.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections import defaultdict
from pathlib import Path
from time import perf_counter

from mpipic.runtime import start

start()

import numpy as np  # noqa: E402  after the settings that start() makes

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from cloud_helpers import clouds, projected  # noqa: E402
from mpipic.errors import NotConverged  # noqa: E402
from mpipic.files import write_json  # noqa: E402
from mpipic.filters import ExactFilter  # noqa: E402
from mpipic.mapping.solver import GramSolver  # noqa: E402

REFUSED = float("nan")


def timed(apply, reference, q):
    """Largest error, NaN if refused, and milliseconds of the first of two applications."""
    began = perf_counter()
    try:
        once = apply(q)
        took = perf_counter() - began
        twice = apply(once)
    except NotConverged:
        return REFUSED, 1e3 * (perf_counter() - began)
    errors = [np.linalg.norm(x, axis=0).max() for x in (twice - once, once - reference(q))]
    return float(max(errors)), 1e3 * took


def judge(cloud, tolerance, rng):
    """Error and time of the exact filter and of conjugate gradients alone, and the smallest singular value."""
    mapping = cloud.mapping()
    mapping.gram.stencil.refresh()
    reference = projected(mapping)
    noise = rng.standard_normal((len(cloud.position), 4))
    q = np.concatenate([noise / np.linalg.norm(noise, axis=0), reference.vectors[:, -4:]], axis=1)
    filter_, alone = ExactFilter(mapping, tolerance), GramSolver(mapping, tolerance)
    now = timed(filter_.apply, reference, q)
    before = timed(lambda values: mapping.g2p(alone.solve(mapping.sums(values))), reference, q)
    return now, before, float(reference.values[-1]), filter_.solver.factorised


def main() -> None:
    """Print a line a kind, and the sum."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clouds", type=int, default=2000)
    parser.add_argument("--tolerance", type=float, default=1e-10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path)
    asked = parser.parse_args()
    rng, rows = np.random.default_rng(asked.seed), defaultdict(list)
    for cloud in clouds(asked.clouds, asked.seed):
        rows[cloud.kind].append(judge(cloud, asked.tolerance, rng))
    rows["all"] = [row for kind in list(rows) for row in rows[kind]]
    result = {}
    for kind, found in rows.items():
        now, before, _, factorised = zip(*found, strict=True)
        errors = np.array([error for error, _ in now])
        missed = [error for error, _ in before if not error <= 10 * asked.tolerance]
        result[kind] = {
            "clouds": len(found),
            "factorised": sum(factorised),
            "refused": int(np.isnan(errors).sum()),
            "largest_error": float(np.nanmax(errors)),
            "milliseconds": [statistics.median(t for _, t in now), max(t for _, t in now)],
            "alone_missed": len(missed),
            "alone_milliseconds": [statistics.median(t for _, t in before), max(t for _, t in before)],
        }
        print(f"{kind:12}", ", ".join(f"{name} {value}" for name, value in result[kind].items()), flush=True)
    if asked.output:
        write_json(asked.output, {"tolerance": asked.tolerance, "seed": asked.seed, "kinds": result})


if __name__ == "__main__":
    main()

"""Schemes of high order on several ranks: who holds a particle changes, what it carries does not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from mpipic.scene.presets import PRESETS
from simulation_helpers import Result, simulated

TOLERANCE = 1e-9
"""Of the largest value: sums in another order may cost a solver an iteration more or less, which changes an answer by
its residual, 1e-13, times what a Gram matrix of few particles makes of it."""

pytestmark = pytest.mark.mpi


def overrides(cells: list[int], flow: list[float], steps: int, *more: str, cfl: float = 0.2) -> list[str]:
    """Of a scene of unequal box lengths in which particles cross cells, and so ranks."""
    length = [1.0, 0.9, 1.2][: len(cells)]
    return [
        f"grid.cells={cells}", f"grid.length={length}", f"gas.flow={flow}", "initial.sharpness=15",
        f"time.cfl={cfl}", f"time.steps={steps}", *more,
    ]  # fmt: skip


def parts(mapping: str, kind: str, integrator: str, *more: str) -> list[str]:
    """Overrides that name a scheme: basis, mass and gradient in one string."""
    basis, mass, gradient = mapping.split()
    names = [f"mapping.basis={basis}", f"mapping.mass={mass}", f"mapping.gradient={gradient}"]
    tight = [] if mass == "lumped" else ["mapping.tolerance=1e-13"]
    tight += ["filter.tolerance=1e-13"] if kind == "exact" else []
    tight += ["time.tolerance=1e-13"] if integrator == "midpoint" else []
    return [*names, f"filter.kind={kind}", f"time.integrator={integrator}", *tight, *more]


RECOMMENDED = [
    *(f"{section}.{key}={value}" for section, keys in PRESETS["recommended"].items() for key, value in keys.items()),
    "mapping.tolerance=1e-13",
]
HIGH_ORDER = parts("quadratic consistent direct", "exact", "rk4")
SKEW = parts("cubic consistent skew", "exact", "rk4")
MIDPOINT = parts("cubic penalised grid", "exact", "midpoint")
RANDOM = ["particles.layout=random", "particles.seed=7"]
JITTER = ["particles.layout=jittered", "particles.jitter=0.3"]

# name: (overrides, numbers of ranks); sound moves a fifth of a cell a step, the flow more than half of one
CASES: dict[str, tuple[list[str], tuple[int, ...]]] = {
    "1d-recommended": (overrides([24], [2.7], 12, *RECOMMENDED, *RANDOM), (1, 2, 3, 4)),
    "1d-quadratic-consistent-rk4": (overrides([21], [-2.3], 10, *HIGH_ORDER, *JITTER), (1, 2, 3)),
    "1d-skew": (overrides([20], [2.7], 10, *SKEW, *JITTER), (1, 2, 3)),
    "1d-midpoint-on-the-grid": (overrides([24], [-0.4], 6, *MIDPOINT, *RANDOM, cfl=3.0), (1, 2, 3)),
    "2d-recommended": (overrides([9, 8], [3.1, -2.7], 5, *RECOMMENDED, *RANDOM), (1, 2, 3)),
    "2d-quadratic-consistent-rk4": (overrides([8, 9], [-3.1, 2.7], 4, *HIGH_ORDER, *JITTER), (1, 2, 3)),
    "2d-skew": (overrides([8, 8], [3.1, 2.7], 4, *SKEW, *JITTER), (1, 2, 3)),
    "2d-midpoint-on-the-grid": (overrides([9, 8], [0.5, -0.4], 3, *MIDPOINT, *JITTER, cfl=3.0), (1, 2, 3)),
    # steps on the particles themselves: their number on a rank, and so the solver's size, changes as they migrate
    "1d-svd-midpoint": (
        overrides([12], [0.9], 6, *parts("quadratic consistent direct", "svd", "midpoint"), *JITTER, cfl=1.0),
        (1, 2, 3),
    ),
    "1d-unfiltered": (overrides([18], [2.7], 10, *parts("cubic consistent direct", "none", "rk4"), *JITTER), (1, 2, 3)),
    "1d-lumped-skew": (
        overrides([18], [2.7], 10, *parts("linear lumped skew", "exact", "symplectic"), *JITTER),
        (1, 2, 3),
    ),
    # blocks of fewer nodes than differences (5), damping (4), penalty (4) and preconditioner (8) reach over
    "1d-blocks-of-two-cells": (overrides([8], [2.7], 8, *RECOMMENDED, *RANDOM), (1, 2, 3, 4)),
    "1d-blocks-of-one-cell": (overrides([3], [2.7], 6, *HIGH_ORDER, "particles.per_cell=[5]"), (1, 2, 3)),
    "2d-blocks-of-one-row": (overrides([4, 4], [3.1, -2.7], 4, *RECOMMENDED, *RANDOM), (1, 2, 4)),
    "1d-skew-blocks-of-two-cells": (overrides([6], [2.7], 8, *SKEW, "particles.per_cell=[5]"), (1, 2, 3)),
    "3d-recommended": (overrides([4, 3, 4], [3.1, -2.7, 2.3], 2, *RECOMMENDED, *JITTER), (1, 2)),
}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, int], Result]:
    """Of all cases."""
    return simulated(tmp_path_factory.mktemp("schemes"), CASES)


def several(results: Callable[..., Result], name: str) -> list[tuple[int, Result]]:
    """The case on all its numbers of ranks above 1."""
    return [(ranks, results(name, ranks)) for ranks in CASES[name][1] if ranks > 1]


@pytest.mark.parametrize("name", CASES)
def test_particles_end_the_same_on_any_number_of_ranks(results: Callable[..., Result], name: str) -> None:
    one = results(name, 1)
    for ranks, many in several(results, name):
        assert one.completed and many.completed
        assert np.array_equal(many.coordinate, one.coordinate), f"{ranks}: the same arithmetic moves them everywhere"
        for field in ("density", "velocity"):
            start, expected, found = getattr(one, f"{field}_before"), getattr(one, field), getattr(many, field)
            assert np.abs(expected - start).max() > 1e-2 * np.abs(one.density).max(), "nothing happened"
            assert np.abs(found - expected).max() <= TOLERANCE * np.abs(expected).max(), (ranks, field)


def test_particles_changed_rank_and_none_was_lost(results: Callable[..., Result]) -> None:
    for name in CASES:
        for ranks, many in several(results, name):
            total, case = len(many.ids), (name, ranks)
            assert np.array_equal(many.ids, np.arange(total)) and np.all(many.counts.sum(axis=0) == total), case
            assert np.array_equal(many.owner, many.rank), case
            assert np.count_nonzero(many.rank != many.rank_before) > 0, case
            assert many.migrated[:, -1].sum() > total / 8, case
            assert np.all(many.migrated[:, -1] > 0), f"{case}: every rank was sent some"


@pytest.mark.parametrize(
    ("name", "ranks", "blocks"),
    [("1d-blocks-of-two-cells", 4, [4]), ("1d-blocks-of-one-cell", 3, [3]), ("2d-blocks-of-one-row", 4, [1, 4])],
)
def test_blocks_are_as_small_as_they_say(
    results: Callable[..., Result], name: str, ranks: int, blocks: list[int]
) -> None:
    assert results(name, ranks).blocks.tolist() == blocks

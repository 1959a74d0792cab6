"""Claims about the number of ranks: it changes who holds a particle, not where the particle is or what it carries."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from simulation_helpers import Result, simulated

TOLERANCE = 1e-11
"""Of the largest value: a hundred steps of sums in another order stay well below."""
SOLVED = 1e-9
"""The same for the exact filter: sums in another order may cost it an iteration more or less, which changes an answer
by its residual, 1e-13, times what a nearly singular Gram matrix (few particles) makes of it."""

pytestmark = pytest.mark.mpi


def moving(cells: list[int], flow: list[float], steps: int, layout: str, kind: str, *more: str) -> list[str]:
    """Overrides of a scene of unequal box lengths in which particles cross cells, and so ranks."""
    length = [1.0, 0.9, 1.2][: len(cells)]
    return [
        f"grid.cells={cells}", f"grid.length={length}", f"gas.flow={flow}", "initial.sharpness=15",
        f"particles.layout={layout}", f"filter.kind={kind}", "time.cfl=0.2", f"time.steps={steps}", *more,
    ]  # fmt: skip


JITTER = "particles.jitter=0.4"
SEED = "particles.seed=7"
TIGHT = "filter.tolerance=1e-13"

# name: (overrides, numbers of ranks)
FLOWS: dict[str, tuple[list[str], tuple[int, ...]]] = {
    "1d-lattice-local": (moving([20], [0.5], 60, "lattice", "local"), (1, 2, 3, 4)),
    "1d-jittered-none-back": (moving([21], [-0.7], 60, "jittered", "none", JITTER, SEED), (1, 2, 3)),
    "1d-random-local-back": (moving([24], [-1.3], 60, "random", "local", "particles.per_cell=[3]"), (1, 2, 3)),
    "2d-random-local": (moving([9, 8], [0.6, -0.4], 40, "random", "local", SEED), (1, 2, 3, 4, 8)),
    "2d-jittered-none": (moving([8, 10], [-0.5, 0.3], 40, "jittered", "none", JITTER), (1, 2, 3)),
    "2d-lattice-local-one-axis": (moving([12, 12], [0.0, -0.7], 40, "lattice", "local"), (1, 2, 3)),
    "3d-jittered-local": (moving([6, 7, 8], [0.6, -0.5, -0.7], 30, "jittered", "local", JITTER), (1, 2, 3, 4)),
    "3d-random-none": (moving([6, 6, 6], [-0.6, 0.7, 0.5], 25, "random", "none"), (1, 2, 3)),
    "1d-random-order": (moving([24], [0.9], 60, "random", "order", "filter.order=4"), (1, 2, 3)),
    "2d-jittered-chebyshev": (
        moving([9, 8], [0.6, -0.4], 40, "jittered", "chebyshev", "filter.order=3", JITTER),
        (1, 2, 3),
    ),
    "3d-jittered-order": (moving([6, 7, 8], [0.6, -0.5, -0.7], 20, "jittered", "order", JITTER), (1, 2, 3)),
    "1d-random-exact": (moving([24], [0.9], 60, "random", "exact", TIGHT), (1, 2, 3)),
    "2d-jittered-exact": (moving([9, 8], [0.6, -0.4], 40, "jittered", "exact", TIGHT, JITTER), (1, 2, 3)),
    "3d-random-exact": (moving([6, 6, 6], [0.6, -0.5, -0.7], 20, "random", "exact", TIGHT), (1, 2, 3)),
    "1d-lattice-svd": (moving([20], [0.9], 60, "lattice", "svd"), (1, 2, 3)),
    "2d-random-svd": (moving([9, 8], [0.6, -0.4], 40, "random", "svd", SEED), (1, 2, 3)),
    "3d-random-svd": (moving([4, 3, 5], [0.6, -0.5, -0.7], 20, "random", "svd"), (1, 2, 3)),
    "3d-random-local": (moving([3, 3, 3], [-0.6, 0.7, 0.5], 25, "random", "local"), (1, 2, 3, 8)),
}

LONG = ["time.dt=0.01", "time.steps=12"]
# with two nodes an axis the filter takes nearly all of the gradient
UNEVEN = ["particles.layout=random", "initial.profile=plane-wave", "filter.kind=none"]
FLOWS |= {
    # 0.43 and -1.65 of a box a step: over several ranks, and more than once around the period
    "1d-across-ranks": (["grid.cells=[24]", "gas.flow=[43.0]", *LONG], (1, 2, 3)),
    "1d-past-a-period": (["grid.cells=[24]", "gas.flow=[-165.0]", *LONG], (1, 2, 3)),
    "2d-past-a-period": (
        ["grid.cells=[8, 9]", "gas.flow=[-237.0, 141.0]", "particles.layout=random", "initial.sharpness=15", *LONG],
        (1, 2, 3, 4),
    ),
    "3d-across-ranks": (
        ["grid.cells=[6, 5, 4]", "gas.flow=[61.0, -33.0, 129.0]", "initial.sharpness=15", *LONG],
        (1, 2, 3, 8),
    ),
    "a-cell-a-rank": (["grid.cells=[4]", "gas.flow=[3.0]", "initial.sharpness=9", *LONG], (1, 2, 3, 4)),
    "ranks-of-one-and-two-cells": (["grid.cells=[5]", "gas.flow=[-3.0]", "initial.sharpness=9", *LONG], (1, 2, 3, 4)),
    "a-cell-a-rank-in-2d": (["grid.cells=[2, 2]", "gas.flow=[3.0, -2.0]", *UNEVEN, *LONG], (1, 2, 4)),
    "a-cell-a-rank-in-3d": (["grid.cells=[2, 2, 2]", "gas.flow=[3.0, -2.0, 4.0]", *UNEVEN, *LONG], (1, 2, 4, 8)),
    "an-axis-of-one-cell": (["grid.cells=[1, 6]", "gas.flow=[3.0, 2.0]", "initial.sharpness=5", *LONG], (1, 2, 3)),
}

STILL: dict[str, tuple[list[str], tuple[int, ...]]] = {
    "still-1d-random": (moving([16], [0.0], 50, "random", "local"), (1, 2, 3)),
    "still-2d-jittered": (moving([8, 9], [0.0, 0.0], 40, "jittered", "none", JITTER), (1, 2, 3)),
}

CLUSTERS: dict[str, tuple[list[str], int, list[float]]] = {
    # name: (overrides, particles, and the part of the box that they fill at first)
    "one-corner-1d": (["grid.cells=[16]", "gas.flow=[2.0]"], 40, [0.1]),
    "one-corner-2d": (["grid.cells=[8, 8]", "gas.flow=[1.7, -1.1]"], 60, [0.2, 0.15]),
    "one-corner-3d": (["grid.cells=[4, 4, 4]", "gas.flow=[-2.1, 1.3, 1.9]"], 60, [0.2, 0.2, 0.2]),
    "fewer-particles-than-ranks": (["grid.cells=[8]", "gas.flow=[5.0]"], 2, [1.0]),
    "a-single-particle": (["grid.cells=[3, 3]", "gas.flow=[5.0, -4.0]"], 1, [1.0, 1.0]),
}
# few particles, many nodes that none sees: the Gram matrix is singular
CLUSTERS |= {
    f"{name}-{kind}": ([*CLUSTERS[name][0], *more], *CLUSTERS[name][1:])
    for kind, more in {"exact": ["filter.kind=exact", TIGHT], "svd": ["filter.kind=svd"]}.items()
    for name in ("one-corner-1d", "one-corner-2d", "one-corner-3d", "fewer-particles-than-ranks")
    if (name, kind) != ("one-corner-3d", "svd")  # slow, and like 2D
}


RANKS_OF = {name: ranks for name, (_, ranks) in {**FLOWS, **STILL}.items()}
RANKS_OF |= {name: (1, 2, 3) if name.endswith(("exact", "svd")) else (1, 2, 3, 4) for name in CLUSTERS}
"""Case to numbers of ranks: four and eight where they make blocks of another shape."""


def write_cluster(path: Path, count: int, box: list[float]) -> None:
    rng = np.random.default_rng(5)
    dim = len(box)
    with h5py.File(path, "w") as file:
        file["position"] = rng.random((count, dim)) * box
        file["density"] = rng.standard_normal(count)
        file["velocity"] = rng.standard_normal((count, dim))


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, int], Result]:
    """Results by case and number of ranks; each number of ranks is started once, with all its cases."""
    folder = tmp_path_factory.mktemp("simulations")
    cases = {**FLOWS, **STILL}
    for name, (overrides, count, box) in CLUSTERS.items():
        file = folder / f"{name}.h5"
        write_cluster(file, count, box)
        source = ["particles.layout=file", f"particles.path={file}", "initial.profile=file", "filter.kind=local"]
        cases[name] = ([*source, *overrides, "time.dt=0.01", "time.steps=50", "time.blow_up=1e6"], RANKS_OF[name])
    return simulated(folder, cases)


def several(results: Callable[..., Result], name: str) -> list[tuple[int, Result]]:
    """The case on all its numbers of ranks above 1."""
    return [(ranks, results(name, ranks)) for ranks in RANKS_OF[name] if ranks > 1]


@pytest.mark.parametrize("name", RANKS_OF)
def test_particles_end_the_same_on_any_number_of_ranks(results: Callable[..., Result], name: str) -> None:
    one = results(name, 1)
    for ranks, many in several(results, name):
        assert one.completed and many.completed
        assert np.array_equal(many.coordinate_before, one.coordinate_before), ranks
        assert np.array_equal(many.coordinate, one.coordinate), f"{ranks}: the same arithmetic moves them everywhere"
        for field in ("density", "velocity"):
            start, expected, found = getattr(one, f"{field}_before"), getattr(one, field), getattr(many, field)
            change, difference = float(np.abs(expected - start).max()), float(np.abs(found - expected).max())
            assert change > 1e-3 * float(np.abs(one.density).max()) or len(one.ids) == 1, "nothing happened"
            tolerance = SOLVED if name.endswith("-exact") else TOLERANCE
            assert difference <= tolerance * float(np.abs(expected).max()), (ranks, field)


GROUPS = {"flow": FLOWS, "still": STILL, "clusters": CLUSTERS}


@pytest.mark.parametrize("group", GROUPS)
def test_no_particle_is_lost_doubled_or_misplaced(results: Callable[..., Result], group: str) -> None:
    for name in GROUPS[group]:
        for ranks, many in several(results, name):
            total, case = len(many.ids_before), (name, ranks)
            assert np.array_equal(many.ids_before, np.arange(total)), case
            assert np.array_equal(many.ids, np.arange(total)), case
            assert np.array_equal(many.owner, many.rank) and np.array_equal(many.owner_before, many.rank_before), case
            assert many.counts.shape[0] == ranks and np.all(many.counts.sum(axis=0) == total), f"{case}: at every step"


def test_with_a_flow_every_rank_is_sent_particles_and_counts_them(results: Callable[..., Result]) -> None:
    for name in FLOWS:
        for ranks, many in several(results, name):
            changed, journeys = np.count_nonzero(many.rank != many.rank_before), many.migrated[:, -1].sum()
            assert 0 < changed <= journeys, (name, ranks)
            assert journeys > len(many.ids) / 8, f"{name}, {ranks}: too few to trust the comparison"
            assert np.all(many.migrated[:, -1] > 0), (name, ranks)


def test_clusters_go_from_rank_to_rank(results: Callable[..., Result]) -> None:
    """Each may be back where it began."""
    for name in CLUSTERS:
        for ranks, many in several(results, name):
            changed, journeys = np.count_nonzero(many.rank != many.rank_before), many.migrated[:, -1].sum()
            assert journeys >= max(changed, 1), (name, ranks)
            assert journeys > len(many.ids) / 8 or len(many.ids) <= 2, f"{name}, {ranks}: too few to trust"


def test_without_flow_nothing_moves(results: Callable[..., Result]) -> None:
    for name in STILL:
        for ranks, many in several(results, name):
            assert np.array_equal(many.coordinate, many.coordinate_before), (name, ranks)
            assert not many.migrated.any(), (name, ranks)


def test_particles_travel_with_the_flow_around_the_period(results: Callable[..., Result]) -> None:
    for name, (_, numbers) in FLOWS.items():
        many = results(name, max(numbers))
        expected = np.mod(many.position_before + many.moved, many.length)
        distance = np.abs(many.position - expected)
        assert np.all(np.minimum(distance, many.length - distance) < 1e-11 * (1 + np.abs(many.moved))), name
        assert np.all((many.position >= 0) & (many.position < many.length)), name
        wrapped = np.floor((many.position_before + many.moved) / many.length).any(axis=1)
        assert wrapped.any() and len(set(many.rank[wrapped])) > 1, f"{name}: the period must have been crossed"


def test_every_axis_is_split_in_2d_and_3d(results: Callable[..., Result]) -> None:
    assert results("2d-random-local", 8).blocks.tolist() == [4, 2]
    assert results("3d-random-local", 8).blocks.tolist() == [2, 2, 2]
    assert results("a-cell-a-rank-in-3d", 8).blocks.tolist() == [2, 2, 2]


@pytest.mark.parametrize("name", [name for name in CLUSTERS if name.startswith("one-corner") and 4 in RANKS_OF[name]])
def test_a_cluster_leaves_ranks_empty_and_fills_others_later(results: Callable[..., Result], name: str) -> None:
    many = results(name, 4)
    empty = many.counts == 0
    assert len(set(many.rank_before)) < 4, "some ranks must start empty"
    assert np.all(empty.any(axis=1)), "every rank is empty at some time"
    assert not empty.all(axis=1).any(), "and holds particles at another"

"""Figures 1 to 4: the gradient of the paper's g at the particles, computed, and what filters make of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mpipic.arrays import FloatArray, IntArray
from mpipic.filters import create
from mpipic.mapping.mapping import Mapping as ParticleMapping
from mpipic.plots.sample import gather_sample
from mpipic.run.build import place

if TYPE_CHECKING:
    from mpi4py import MPI

    from mpipic.scene.records import Scene

COLUMNS = {
    1: ("x", "true", "computed"),
    2: ("x", "null_space"),
    3: ("x", "true", "svd"),
    4: ("x", "true", "local"),
}
"""Number of a figure to its columns."""
SHARPNESS, CENTER = 60.0, 0.5
ON_NODE = 1e-10


@dataclass(frozen=True)
class _Columns:
    """Values of this rank's particles, as `gather_sample` takes them."""

    ids: IntArray
    position: FloatArray
    fields: Mapping[str, FloatArray]


def true_gradient(x: FloatArray) -> FloatArray:
    """Return the derivative of g(x) = exp(-60 (x - 1/2)²) at x (n,). Local."""
    away = x - CENTER
    return np.asarray(-2.0 * SHARPNESS * away * np.exp(-SHARPNESS * away**2))


def gradient_columns(scene: Scene, comm: MPI.Comm) -> dict[str, FloatArray]:
    """Return x, true, computed, null_space, svd, local and what is left of the null space in these two, on all ranks.

    With g at the particles, computed is q = D S g (eq. 9, 12), svd is V_r V_rᵀ q (eq. 23), null_space is q less that
    (eq. 22), and local is Φ S q (eq. 25-27); (n,) each, of all particles by id. Collective.
    """
    grid, particles = place(scene, comm)
    mapping = ParticleMapping.at(grid, particles)
    x = particles.position[:, 0]
    computed = mapping.gradient(mapping.p2g(np.exp(-SHARPNESS * (x - CENTER) ** 2)))[:, 0]
    svd = create("svd", mapping, {})
    kept = {"svd": svd.apply(computed), "local": create("local", mapping, {}).apply(computed)}
    values = {"x": x, "true": true_gradient(x), "computed": computed, "null_space": computed - kept["svd"], **kept}
    values |= {f"{kind}_null_space": filtered - svd.apply(filtered) for kind, filtered in kept.items()}
    seen = gather_sample(_Columns(particles.ids, particles.position, values), comm, 1 << 30)
    seen = comm.bcast(seen)
    assert seen is not None
    return {name: np.asarray(seen[name], dtype=np.float64) for name in values}


def share(part: FloatArray, whole: FloatArray) -> float:
    """Return ‖part‖ / ‖whole‖."""
    return float(np.linalg.norm(part) / np.linalg.norm(whole))


def sign_changes(values: FloatArray) -> float:
    """Return the share of neighbours of opposite sign among the values (n,) that stand out of rounding."""
    large = values[np.abs(values) > 1e-10 * np.abs(values).max(initial=0.0)]
    return float(np.mean(large[1:] * large[:-1] < 0.0)) if len(large) > 1 else 0.0


def spread_in_cells(x: FloatArray, values: FloatArray, h: float) -> float:
    """Return the largest difference of values within one cell of width h, relative to the largest value."""
    cell = np.floor(x / h + ON_NODE).astype(int)
    high, low = np.full(cell.max() + 1, -np.inf), np.full(cell.max() + 1, np.inf)
    np.maximum.at(high, cell, values)
    np.minimum.at(low, cell, values)
    return float(np.max(high - low, where=high >= low, initial=0.0) / np.abs(values).max())

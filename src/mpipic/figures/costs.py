"""Measures what filters cost: one application at new positions, timed over grids, and how it grows with the nodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from mpipic.arrays import FloatArray
from mpipic.draws import noise
from mpipic.figures.plan import Plan, with_values
from mpipic.filters import create
from mpipic.mapping.mapping import Mapping
from mpipic.run.build import place

if TYPE_CHECKING:
    from mpipic.scene.records import Scene

REPEATS = 5
TIMED = ("svd", "exact", "local")


@dataclass(frozen=True)
class Cost:
    """One filter on one grid: nodes m, and the least seconds of an application at new positions."""

    filter: str
    nodes: int
    seconds: float


def costs(plan: Plan) -> list[Cost]:
    """Return the timings, filter by filter, two particles a cell in one dimension. Local: on one process."""
    found = []
    for kind in TIMED:
        for cells in plan.svd_cells if kind == "svd" else plan.cells:
            found.append(Cost(kind, cells, _seconds(plan.scene, kind, cells)))
    return found


def _seconds(scene: Scene, kind: str, cells: int) -> float:
    """Return the least time of mapping moved particles and filtering them, which a step with this filter pays."""
    grid, particles = place(with_values(scene, grid={"cells": [cells]}), MPI.COMM_SELF)
    mapping = Mapping.at(grid, particles)
    keep = create(kind, mapping, {})
    q = noise(particles.ids)
    keep.apply(q)
    position: FloatArray = np.array(particles.position)
    least = np.inf
    for _ in range(REPEATS):
        position = np.mod(position + 0.01 * grid.h[0], grid.length[0])
        begun = perf_counter()
        mapping.update(position)
        keep.apply(q)
        least = min(least, perf_counter() - begun)
    return float(least)


def exponent(measured: Sequence[Cost], kind: str) -> float:
    """Return p of seconds ~ nodes^p by least squares over the three largest grids, free of what a call costs."""
    largest = sorted((one.nodes, one.seconds) for one in measured if one.filter == kind)[-3:]
    nodes, seconds = np.log(largest).T
    return float(np.polyfit(nodes, seconds, 1)[0])

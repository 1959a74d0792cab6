"""After how many steps the pattern of particles relative to the grid recurs, and how particles change places then."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from mpipic.arrays import IntArray
from mpipic.scene.records import Problem, Scene, SceneError

EXACT = 1e-9
"""Cells that a pattern may be off its start and still count as recurring."""


@dataclass(frozen=True)
class Recurrence:
    """A period.

    Attributes
    ----------
    steps
        The period T.
    shift
        How far the pattern has moved after T steps, in particle spacings per axis on a lattice, else in cells.
    lattice
        Points per axis of the lattice that coincides with itself then; None where each particle is its own successor.
    """

    steps: int
    shift: tuple[int, ...]
    lattice: tuple[int, ...] | None

    def successor(self, ids: IntArray) -> IntArray:
        """Return ids of the particles in whose places these are after a period; lattice ids count x fastest. Local."""
        if self.lattice is None:
            return ids
        sites = np.unravel_index(ids, self.lattice[::-1])[::-1]
        moved = [(j + k) % n for j, k, n in zip(sites, self.shift, self.lattice, strict=True)]
        return np.ravel_multi_index(moved[::-1], self.lattice[::-1]).astype(np.int64)


def displacement(scene: Scene) -> tuple[float, ...]:
    """Return the cells that particles move per step, on every axis."""
    return tuple(v * scene.dt / h for v, h in zip(scene.gas.flow, scene.h, strict=True))


def find(scene: Scene, most: int) -> Recurrence:
    """Return the shortest period of the scene's pattern, of at most `most` steps.

    Raises
    ------
    SceneError
        There is none; names the nearest flows that have one.
    """
    moves = displacement(scene)
    if not any(moves):
        return Recurrence(1, (0,) * scene.dim, None)
    per_cell = scene.particles.per_cell if scene.particles.layout == "lattice" else (1,) * scene.dim
    lattice = tuple(n * k for n, k in zip(scene.grid.cells, per_cell, strict=True))
    steps = np.arange(1, most + 1)
    fits = np.ones(most, dtype=bool)
    for move, pieces in zip(moves, per_cell, strict=True):
        spacings = steps * (move * pieces)
        fits &= np.abs(spacings - np.rint(spacings)) <= EXACT * pieces
    if not fits.any():
        flows = ", ".join(str(list(flow)) for flow in nearest_flows(scene, most))
        rule = f"does not bring the particles back to the same places in the grid within {most} steps"
        raise SceneError([Problem("gas.flow", list(scene.gas.flow), f"{rule}; near it, these do: {flows}")])
    period = int(steps[fits][0])
    shift = tuple(round(period * move * pieces) for move, pieces in zip(moves, per_cell, strict=True))
    return Recurrence(period, shift, lattice if scene.particles.layout == "lattice" else None)


def nearest_flows(scene: Scene, most: int, count: int = 3) -> list[tuple[float, ...]]:
    """Return flows near the scene's that recur within `most` steps, the nearest first.

    Every axis moves a rational number of particle spacings a step; their common denominator is the period.
    """
    per_cell = scene.particles.per_cell if scene.particles.layout == "lattice" else (1,) * scene.dim
    units = [h / (pieces * scene.dt) for h, pieces in zip(scene.h, per_cell, strict=True)]
    flow = scene.gas.flow
    found: dict[tuple[float, ...], float] = {}
    for period in range(1, most + 1):
        near = tuple(unit * _nearest(v / unit, period) for v, unit in zip(flow, units, strict=True))
        found[near] = max(abs(v - w) for v, w in zip(flow, near, strict=True))
    return sorted(found, key=lambda near: found[near])[:count]


def _nearest(move: float, period: int) -> float:
    """Return the multiple of 1 / period nearest to `move`; not 0 unless `move` is."""
    return float(Fraction(round(move * period) or int(np.sign(move)), period))

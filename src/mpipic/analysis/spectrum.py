"""The verb `spectrum`: what a single application of each filter keeps of every wave, on the scene's particles.

A filter F keeps ⟨q, F q⟩ / ⟨q, q⟩ of the wave q = cos(k·x + phase) on the particles. The phase matters only where the
grid cannot hold both of a wave's phases: at two nodes a period, a cosine that peaks on the nodes is kept best, a sine
not at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from mpipic import filters
from mpipic.agreement import on_first
from mpipic.analysis.filter_choice import Choice
from mpipic.analysis.writing import make_folder
from mpipic.arrays import FloatArray
from mpipic.console import Console
from mpipic.errors import Refused
from mpipic.files import write_csv
from mpipic.mapping.mapping import Mapping
from mpipic.mesh.grid import Grid
from mpipic.run.build import check_filter, place

if TYPE_CHECKING:
    from mpipic.plots.spectra import Curve
    from mpipic.scene.records import Scene

PHASE = 0.3
WAVES = 64
"""At most so many wave numbers a direction."""
AT_ONCE = 1 << 22
"""Numbers of the waves that are filtered together."""
SHOWN = (2, 4, 8, 16, 32)
COLUMNS = ("direction", "wave", "lambda_over_h", "filter", "kept")


@dataclass(frozen=True)
class Kept:
    """One point: direction x, y, z or diagonal; whole periods in the box along it; nodes a period; share kept."""

    direction: str
    wave: int
    lambda_over_h: float
    filter: str
    kept: float


def wave_numbers(cells: int) -> list[int]:
    """Return whole periods in `cells` cells, down to two nodes a period; of many, about WAVES and all dyadic ones."""
    every = np.arange(1, cells // 2 + 1)
    if every.size <= WAVES:
        return [int(k) for k in every]
    dyadic = [cells // m for m in (2, 3, 4, 6, 8, 12, 16, 24, 32, 64) if cells % m == 0]
    spread = np.unique(np.rint(np.geomspace(1, cells // 2, WAVES)).astype(int))
    return sorted({*spread.tolist(), *dyadic})


def directions(cells: Sequence[int]) -> list[tuple[str, tuple[int, ...], list[int]]]:
    """Return name, unit wave vector in periods and wave numbers of each axis that can carry a wave, and the diagonal.

    Along the diagonal every axis has the same number of periods.
    """
    found = []
    for axis, n in enumerate(cells):
        unit = tuple(int(a == axis) for a in range(len(cells)))
        found.append(("xyz"[axis], unit, wave_numbers(n)))
    if len(cells) > 1:
        found.append(("diagonal", (1,) * len(cells), wave_numbers(min(cells))))
    return [item for item in found if item[2]]


def measure(scene: Scene, choices: Sequence[Choice], comm: MPI.Comm, phase: float = PHASE) -> list[Kept]:
    """Return every point of the spectra at the scene's initial positions; `phase` in radians. Collective.

    Raises
    ------
    Refused
        The grid carries no wave along any axis.
    """
    if not directions(scene.grid.cells):
        rule = "carries no wave, whose shortest takes two cells along an axis"
        raise Refused(f"grid.cells = {list(scene.grid.cells)}: {rule}")
    grid, particles = place(scene, comm)
    total = int(comm.allreduce(particles.count))
    mapping = Mapping.at(grid, particles)
    turn = 2.0 * np.pi * np.ascontiguousarray(particles.coordinate) / np.array(grid.cells)
    points = []
    for choice in choices:
        check_filter(scene, total, comm, choice.kind)
        filter_ = filters.create(choice.kind, mapping, choice.settings)
        for name, unit, waves in directions(grid.cells):
            shortest = min(n for n, periods in zip(grid.cells, unit, strict=True) if periods)
            kept = _kept(filter_, turn @ np.array(unit, dtype=float), phase, waves, grid)
            points += [
                Kept(name, k, shortest / k, choice.label, float(share)) for k, share in zip(waves, kept, strict=True)
            ]
    return points


def _kept(filter_: filters.Filter, turn: FloatArray, phase: float, waves: Sequence[int], grid: Grid) -> FloatArray:
    """Return ⟨q, F q⟩ / ⟨q, q⟩ for q = cos(wave turn + phase); 0 for a wave that vanishes on all particles."""
    together = max(1, AT_ONCE // max(1, int(grid.reduce(np.array([float(len(turn))]), MPI.MAX)[0])))
    shares = []
    for start in range(0, len(waves), together):
        q = np.cos(turn[:, None] * np.array(waves[start : start + together], dtype=float) + phase)
        products = np.stack([np.sum(q * filter_.apply(q), axis=0), np.sum(q * q, axis=0)])
        grid.reduce(products)
        shares.append(np.divide(products[0], products[1], out=np.zeros(len(products[0])), where=products[1] > 0))
    return np.concatenate(shares)


def run(
    scene: Scene, choices: Sequence[Choice], comm: MPI.Comm, console: Console, output: Path, plot: bool, phase: float
) -> None:
    """Measure, print a table, write spectrum.csv and spectrum.png into the folder `output`. Collective."""
    make_folder(output, comm)
    points = measure(scene, choices, comm, phase)
    labels = list(dict.fromkeys(point.filter for point in points))
    for direction in dict.fromkeys(point.direction for point in points):
        rows = _rows(points, direction, labels)
        if rows:
            console.table(f"kept of a wave along {direction}", ("λ/h", *labels), rows)
    on_first(comm, lambda: _write(output, points, f"{scene.name}: what one application keeps" if plot else None))
    console.message(f"spectra of {len(labels)} filters in {output}")


def _write(output: Path, points: Sequence[Kept], title: str | None) -> None:
    """Write the points as CSV, and draw them under a title if there is one. Local."""
    lines = ((p.direction, p.wave, p.lambda_over_h, p.filter, p.kept) for p in points)
    write_csv(output / "spectrum.csv", COLUMNS, lines)
    if title is not None:
        from mpipic.plots.spectra import draw_spectrum

        draw_spectrum(output / "spectrum.png", _curves(points), title)


def _curves(points: Sequence[Kept]) -> list[Curve]:
    """Return the points as the picture joins them: a curve for each filter and direction, by length of the waves."""
    from mpipic.plots.spectra import Curve

    families: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for point in points:
        families.setdefault((point.direction, point.filter), []).append((point.lambda_over_h, point.kept))
    curves = []
    for (direction, label), pairs in families.items():
        lengths, kept = zip(*sorted(pairs), strict=True)
        curves.append(Curve(direction, label, lengths, kept))
    return curves


def _rows(points: Sequence[Kept], direction: str, labels: Sequence[str]) -> list[list[str]]:
    """Return the lines of a table: waves of SHOWN lengths where there are such, else up to five others."""
    mine = [point for point in points if point.direction == direction]
    lengths = sorted({point.lambda_over_h for point in mine})
    shown = [length for length in lengths if length in SHOWN] or lengths[:: max(1, len(lengths) // 5)]
    value = {(point.lambda_over_h, point.filter): point.kept for point in mine}
    return [[f"{length:g}", *(f"{value[length, label]:.4f}" for label in labels)] for length in shown]

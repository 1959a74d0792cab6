"""The question that the paper leaves open: how long each filter holds, and how well, away from the paper's setting."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, cast

import numpy as np
from mpi4py import MPI

from mpipic.figures.plan import GROWING, Analyse, Growth, Survey, spread, with_filter, with_values
from mpipic.figures.waves import rms
from mpipic.run.loop import Simulation

if TYPE_CHECKING:
    from mpipic.scene.records import Scene

NEVER = 1e-8
"""Growth per step below which noise is said never to arrive: eigenvalues that meet are no more accurate."""


@dataclass(frozen=True)
class Point:
    """One setting and what came of it: growth and its last good step, None for never; the error, None if not asked."""

    part: str
    filter: str
    flow: float
    per_cell: int
    cfl: float
    dim: int
    growth: float | None
    last_good_step: float | None
    error: float | None


@dataclass(frozen=True)
class _Setting:
    part: str
    filter: str
    layout: str
    flow: float
    per_cell: int
    cfl: float
    cells: tuple[int, ...]

    def scene(self, base: Scene, cells: tuple[int, ...]) -> Scene:
        """Return the scene of this setting on a grid."""
        dim = len(cells)
        each = (self.per_cell,) * dim if self.layout == "lattice" else (self.per_cell,)
        placed = with_values(
            base,
            grid={"cells": cells, "length": (1.0,) * dim},
            particles={"layout": self.layout, "per_cell": each},
            gas={"flow": (self.flow * base.gas.sound_speed,) * dim},
            initial={"profile": "gaussian", "center": (0.5,) * dim},
            time={"cfl": self.cfl},
        )
        return with_filter(placed, GROWING[self.filter])


def points(base: Scene, survey: Survey, analyse: Analyse, comm: MPI.Comm) -> list[Point]:
    """Return every point of the survey, part by part, on all ranks. Collective: ranks share the points."""
    jobs: dict[str, Callable[[], object]] = {}
    settings = list(_settings(survey))
    for number, setting in enumerate(settings):
        jobs[str(number)] = partial(_point, base, setting, survey, analyse)
    found = spread(comm, jobs)
    missing = [Point(s.part, s.filter, s.flow, s.per_cell, s.cfl, len(s.cells), None, None, None) for s in settings]
    return [cast("Point", found[str(n)] or lost) for n, lost in enumerate(missing)]


def _settings(survey: Survey) -> Iterator[_Setting]:
    line = (survey.cells,)
    for kind in GROWING:
        for flow in survey.flows:
            for layout in ("lattice", "random"):
                for count in survey.per_cell:
                    yield _Setting(layout, kind, layout, flow, count, survey.cfl, line)
            for cfl in survey.cfls:
                yield _Setting("CFL", kind, "lattice", flow, 2, cfl, line)
        for box in survey.boxes:
            for layout in ("lattice", "random"):
                yield _Setting(f"dimensions, {layout}", kind, layout, survey.box_flow, 2, survey.cfl, box)


def _point(base: Scene, setting: _Setting, survey: Survey, analyse: Analyse) -> Point:
    growth = analyse(setting.scene(base, setting.cells), MPI.COMM_SELF, survey.most)
    error = None
    if not setting.part.startswith("dimensions"):
        error = _error(setting.scene(base, (survey.error_cells,)), survey.until)
    value, steps = growth.growth_per_step, _last_good_step(growth)
    return Point(
        setting.part, setting.filter, setting.flow, setting.per_cell, setting.cfl, len(setting.cells), value, steps,
        error,
    )  # fmt: skip


def _last_good_step(growth: Growth) -> float | None:
    """Return the step at which rounding noise is as large as the solution; None for never."""
    return growth.noise_step if growth.growth_per_step > NEVER else None


def _error(scene: Scene, until: float) -> float:
    """Return the root mean square error of the density at the step nearest to a time, infinite after a blow-up."""
    simulation = Simulation(scene, MPI.COMM_SELF)
    steps = round(until / scene.dt)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(steps):
            simulation.physics.step()
    exact = simulation.physics.exact(simulation.particles.position, steps * scene.dt)
    assert exact is not None
    error = rms(np.asarray(simulation.particles["density"] - exact["density"]))
    simulation.close()
    return error


def holding(found: Sequence[Point], steps: int) -> Mapping[tuple[str, str], tuple[int, int]]:
    """Return by part and filter how many points hold for so many steps, and of how many."""
    counted: dict[tuple[str, str], tuple[int, int]] = {}
    for point in found:
        if point.growth is not None:
            good, of = counted.get((point.part, point.filter), (0, 0))
            holds = point.last_good_step is None or point.last_good_step >= steps
            counted[point.part, point.filter] = good + holds, of + 1
    return counted

"""A run: builds what the scene names and nothing else, and owns the time loop."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Protocol

import numpy as np
from mpi4py import MPI

from mpipic.arrays import FloatArray, IntArray
from mpipic.mesh.grid import Grid
from mpipic.particles.layouts import LAYOUTS, share
from mpipic.particles.migration import LostParticles, Routes
from mpipic.particles.store import Particles
from mpipic.phases import Phases
from mpipic.physics.acoustics import solutions as exact
from mpipic.run.build import build_step, build_sweep
from mpipic.run.diagnostics import ErrorReport, Exact, measure, null_space_fraction
from mpipic.scene.records import Problem, Scene, SceneError

MONITORED = 400
"""At how many steps of a run, evenly spread, the largest density is recorded."""
LONGEST_UNCHECKED = 0.1
"""Seconds between two looks at blow-up and interruption, where steps are shorter than that."""


@dataclass(frozen=True)
class BlowUp:
    """Where a run went wrong: first step at which |density| passed the limit, and the worst particle then."""

    step: int
    rank: int
    cell: tuple[int, ...]
    value: float


@dataclass(frozen=True)
class Outcome:
    """How a run ended: completed, unstable or interrupted, after which step."""

    status: str
    step: int
    blow_up: BlowUp | None = None


class Observer(Protocol):
    """What watches a run; every method is called on all ranks together, except `progress`."""

    def record(self, step: int, time: float, peak: float, report: ErrorReport | None) -> None:
        """Largest |density|, and errors where they were asked for."""

    def snapshot(self, step: int, time: float) -> None:
        """The state is to be written."""

    def progress(self, step: int, time: float) -> None:
        """Called after every step; local."""


def solution_of(scene: Scene) -> Exact | None:
    """Initial data and exact solution of the scene as one function of (x, t); None where a file gives the state."""
    if scene.initial.profile == "file":
        return None
    gas = exact.Gas(scene.gas.sound_speed, scene.gas.flow, scene.gas.density)
    initial = scene.initial
    try:
        return exact.solution(
            initial.profile,
            length=scene.grid.length,
            gas=gas,
            center=initial.center,
            sharpness=initial.sharpness,
            wave=initial.wave,
        )
    except ValueError as error:
        raise SceneError([Problem("initial", initial.profile, str(error))]) from None


def check_filter(scene: Scene, particles: int, comm: MPI.Comm, kind: str | None = None) -> None:
    """Raise SceneError on all ranks for a filter, the scene's or `kind`, that there is no memory for. Collective."""
    if (kind or scene.filter.kind) != "svd":
        return
    from mpipic.filters.row_space import TooLarge, check_memory

    try:
        check_memory(scene.cell_count, particles, comm)
    except TooLarge as error:
        raise SceneError([Problem("filter.kind", "svd", str(error))]) from None


def populate(scene: Scene, grid: Grid, solution: Exact | None) -> Particles:
    """The scene's particles at t = 0 on the ranks that own their cells.

    Every rank makes a block of consecutive ids; then each particle goes to its owner. Collective.
    """
    particles = Particles(grid.h, {"density": 0, "velocity": grid.dim})
    if scene.particles.layout == "file":
        ids, coordinate, state = _read_particles(scene, grid)
    else:
        ids = share(scene.particle_count or 0, grid)
        layout = LAYOUTS[scene.particles.layout]
        drawn = layout(grid, scene.particles.per_cell, scene.particles.jitter, scene.particles.seed, ids)
        coordinate = grid.wrapped(drawn)
        state = np.zeros((len(ids), 1 + grid.dim))
    if grid.size > 1:
        rows = np.concatenate([coordinate, state, ids.view(np.float64)[:, None]], axis=1)
        rows = Routes(grid).exchange(rows, grid.owner_of(coordinate)).rows
        coordinate, state = rows[:, : grid.dim], rows[:, grid.dim : -1]
        ids = np.ascontiguousarray(rows[:, -1]).view(np.int64)
    particles.append(coordinate, state, ids)
    if solution is not None:
        density, velocity = solution(particles.position, 0.0)
        particles.field("density")[:] = density
        particles.state[:, 1:] = velocity
    return particles


def _read_particles(scene: Scene, grid: Grid) -> tuple[IntArray, FloatArray, FloatArray]:
    from mpipic.io.particle_file import ParticleFileError, read_particle_file

    try:
        data = read_particle_file(scene.particles.path, grid.dim, grid.length, grid.comm)
    except ParticleFileError as error:
        raise SceneError([Problem("particles.path", None, text) for text in error.problems]) from None
    state = np.zeros((len(data["ids"]), 1 + grid.dim))
    if scene.initial.profile == "file":
        state[:, 0] = data.get("density", 0.0)
        state[:, 1:] = data.get("velocity", 0.0)
    return data["ids"], grid.coordinate_of(data["position"]), state


class Simulation:
    """The parts that a scene names, put together on the ranks of `comm`, and the loop over its steps.

    Attributes
    ----------
    grid, particles, sweep, formulation
        The parts.
    exact : function of (x, t), or None
    total : int
        Particles on all ranks.
    step, time
        How far the run is.

    Raises
    ------
    SceneError
        What only shows when the scene is built: ranks that do not fit, a particle file that is not right.

    Notes
    -----
    Collective.
    """

    def __init__(self, scene: Scene, comm: MPI.Comm, phases: Phases | None = None) -> None:
        self.scene, self.comm = scene, comm
        self.phases = phases or Phases()
        self.phases("setup")
        scene.check_ranks(comm.size)
        self.exact = solution_of(scene)
        self.grid = Grid(scene.grid.cells, scene.grid.length, comm, scene.mapping.basis)
        self.particles = populate(scene, self.grid, self.exact)
        self.total = comm.allreduce(self.particles.count)
        self.sweep = build_sweep(scene, self.grid, self.particles, self.phases)
        check_filter(scene, self.total, comm)
        self.formulation = build_step(scene, self.sweep)
        self.step = 0
        self.phases("setup")
        self.limit = scene.time.blow_up * self._initial_size()
        self._bad: tuple[int, tuple[int, ...], float] | None = None
        self.phases("other")

    @property
    def time(self) -> float:
        """Time reached: step times dt, not a running sum."""
        return self.step * self.scene.dt

    def close(self) -> None:
        """Give communicators back to MPI, for programs that build many simulations. Collective."""
        self.sweep.close()

    def resident_bytes(self) -> int:
        """Bytes of this rank's arrays of particles and nodes that live as long as the run. Local."""
        return self.particles.nbytes + self.sweep.nbytes + self.formulation.nbytes

    def nodal_means(self) -> dict[str, FloatArray]:
        """Means S ρ_p and S u_p at own nodes, arrays (x, y, z) or (x, y, z, d): what the grid sees. Local."""
        density, velocity = (self.sweep.divide(sums) for sums in self.sweep.state_sums)
        return {"density": self.grid.owned(density[:, 0]), "velocity": self.grid.owned(velocity)}

    def _initial_size(self) -> float:
        """Largest |density|; where density starts at zero, the density that the velocity will turn into."""
        gas, state = self.scene.gas, np.abs(self.particles.state)
        density = state[:, 0].max(initial=0.0)
        from_velocity = gas.density / gas.sound_speed * state[:, 1:].max(initial=0.0)
        largest = np.array([density, from_velocity])
        self.comm.Allreduce(MPI.IN_PLACE, largest, op=MPI.MAX)
        return float(largest[0] or largest[1])

    # ------------------------------------------------------------ the loop

    def run(self, observer: Observer, interrupted: Callable[[], bool] = lambda: False) -> Outcome:
        """Take the scene's steps, telling `observer`; stop at a blow-up or when `interrupted` on any rank.

        Collective. Ranks agree by one reduction of four numbers (and one that counts particles) at report, snapshot
        and monitored steps, and otherwise about ten times a second; a blow-up is dated to its step all the same.
        """
        steps, output = self.scene.time.steps, self.scene.output
        reports = {*output.report_at, steps}
        snapshots = set(range(0, steps + 1, output.every)) if output.every else set()
        monitored = set(range(0, steps + 1, max(1, -(-steps // MONITORED))))
        due = reports | snapshots | monitored
        last, next_check, since = 0, 0, perf_counter()
        while True:
            if self.step in due or self.step >= next_check:
                seconds = (perf_counter() - since) / max(1, self.step - last)
                peak, stop, stride = self._agree(interrupted(), seconds)
                if stop is not None:
                    return stop
                if self.step in due:
                    self._tell(observer, peak, self.step in reports, self.step in snapshots)
                last, next_check, since = self.step, self.step + stride, perf_counter()
            if self.step >= steps:
                return Outcome("completed", self.step)
            self.formulation.step()
            self.step += 1
            if not self.sweep.peak <= self.limit and self._bad is None:
                self._bad = (self.step, *self._worst())
            observer.progress(self.step, self.time)

    def _agree(self, interrupted: bool, seconds: float) -> tuple[float, Outcome | None, int]:
        """What all ranks know together: largest |density|, why to stop if so, and steps until the next look."""
        stride = max(1, min(1000, int(LONGEST_UNCHECKED / max(seconds, 1e-9))))
        first_bad = self._bad[0] if self._bad else math.inf
        peak = self.sweep.peak if math.isfinite(self.sweep.peak) else math.inf
        facts = np.array([-first_bad, float(interrupted), -stride, peak])
        self.comm.Allreduce(MPI.IN_PLACE, facts, op=MPI.MAX)
        total = self.comm.allreduce(self.particles.count)
        if total != self.total:
            raise LostParticles(f"there are {total} particles at step {self.step}, not {self.total}")
        if math.isfinite(facts[0]):
            return float(facts[3]), Outcome("unstable", int(-facts[0]), self._find_blow_up(int(-facts[0]))), 0
        stop = Outcome("interrupted", self.step) if facts[1] else None
        return float(facts[3]), stop, int(-facts[2])

    def _worst(self) -> tuple[tuple[int, ...], float]:
        """Cell and |density| of this rank's worst particle, NaN the worst of all; ((), -1) if there is none."""
        if self.particles.count == 0:
            return (), -1.0
        size = np.abs(self.particles.field("density"))
        worst = int(np.argmax(np.where(np.isnan(size), np.inf, size)))
        cell = self.grid.cell_of(self.particles.coordinate[worst : worst + 1])[0]
        return tuple(map(int, cell)), float(size[worst])

    def _find_blow_up(self, step: int) -> BlowUp:
        """The worst of all ranks that saw the limit passed at `step`."""
        mine = (self._bad[1], self._bad[2]) if self._bad and self._bad[0] == step else ((), -1.0)
        seen = self.comm.allgather(mine)
        rank = max(range(len(seen)), key=lambda r: math.inf if math.isnan(seen[r][1]) else seen[r][1])
        return BlowUp(step, rank, *seen[rank])

    def _tell(self, observer: Observer, peak: float, report: bool, snapshot: bool) -> None:
        measured = None
        if report and self.exact is not None:
            self.phases("report")
            measured = measure(self.particles, self.exact, self.step, self.time, self.total, self.comm)
            if self.step in self.scene.output.report_at:
                measured = replace(measured, null_space_fraction=null_space_fraction(self.grid, self.particles))
        observer.record(self.step, self.time, peak, measured)
        if snapshot:
            self.phases("output")
            observer.snapshot(self.step, self.time)
        self.phases("other")

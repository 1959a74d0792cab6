"""A run: builds what the scene names and nothing else, and owns the time loop."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter
from typing import TYPE_CHECKING, Protocol

import numpy as np
from mpi4py import MPI

from mpipic.arguments import told
from mpipic.arrays import FloatArray, IntArray
from mpipic.mesh.agreement import Said, communicator, together
from mpipic.particles.migration import LostParticles
from mpipic.phases import Phases
from mpipic.physics.base import Physics
from mpipic.run.build import begin, check_filter, physics_of, place
from mpipic.run.diagnostics import ErrorReport, measure
from mpipic.run.ranks import check_ranks
from mpipic.run.state import agreed_state

if TYPE_CHECKING:
    from mpipic.scene.records import Scene

MONITORED = 400
"""At how many steps of a run, evenly spread, the largest density is recorded."""
LONGEST_UNCHECKED = 0.1
"""Seconds between two looks at blow-up and interruption, where steps are shorter than that."""


@dataclass(frozen=True)
class BlowUp:
    """Where a run went wrong: first step at which the watched field passed the limit, and the worst particle then."""

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
    """Watches a run; every method is called on all ranks together, except `progress`."""

    def record(self, step: int, time: float, peak: float, report: ErrorReport | None) -> None:
        """Take the largest size of the watched field, and errors where they were asked for."""

    def snapshot(self, step: int, time: float) -> None:
        """Write the state."""

    def progress(self, step: int, time: float) -> None:
        """Show how far the run is; after every step, local."""


class Simulation:
    """The parts that a scene names, put together on the ranks of `comm`, and the loop over its steps.

    Attributes
    ----------
    grid, particles, physics
        The parts. What compiles loops may be done in `before_first_use`, when nothing is left to refuse.
    total : int
        Particles on all ranks.
    step, time
        How far the run is.

    Raises
    ------
    SceneError
        What only shows when the scene is built: ranks that do not fit, a particle file that is not right.
    ValueError
        The scene is not the same on all ranks; on all together.

    Notes
    -----
    Collective.
    """

    def __init__(
        self,
        scene: Scene,
        comm: MPI.Comm,
        phases: Phases | None = None,
        physics: Physics | None = None,
        before_first_use: Callable[[], None] = lambda: None,
    ) -> None:
        self.scene, self.comm = scene, communicator(comm)
        self.phases = phases or Phases()
        together(comm, "Simulation", lambda: _digest(scene), _say_digest)
        self.phases("setup")
        check_ranks(scene, comm.size)
        self.physics = physics or physics_of(scene)
        self.grid, self.particles = place(scene, comm, self.physics)
        self.total = comm.allreduce(self.particles.count)
        check_filter(scene, self.total, comm)
        self.phases("compile")
        before_first_use()
        self.phases("setup")
        self.physics.place(self.grid, self.particles, self.phases)
        self.step = 0
        self.phases("setup")
        self.limit = scene.time.blow_up * self._initial_size()
        self.conserved_at_start = self.conserved()
        self._bad: tuple[int, tuple[int, ...], float] | None = None
        self.phases("other")

    @property
    def time(self) -> float:
        """Time reached: step times dt, not a running sum."""
        return self.step * self.scene.dt

    def set_state(
        self,
        coordinate: FloatArray | None = None,
        state: FloatArray | None = None,
        ids: IntArray | None = None,
    ) -> None:
        """Begin anew from other particles, or the present ones with other values: nothing of the past counts.

        Parameters
        ----------
        coordinate : (n, d), in cells, in this rank's cells
            Where particles are, axes wrap; default: where they are.
        state : (n, k)
            Components of their fields in the order of `Particles.state`; default: the initial values of the physics,
            for new coordinates, else those that there are.
        ids : (n,)
            With new coordinates, who they are: whole numbers.

        Raises
        ------
        ValueError, TypeError
            An argument is not as above, or ranks give different ones; on all ranks together, and nothing has changed.

        Notes
        -----
        Collective: every rank gives its own, and they agree by one reduction. `step` counts on.
        """
        particles = self.particles
        places, values, names = agreed_state(self.grid, particles, coordinate, state, ids)
        if places is not None and names is not None:
            particles.replace(places, particles.state_of({}, len(names)) if values is None else values, names)
            if values is None:
                begin(particles, self.physics)
            self.total = int(self.comm.allreduce(particles.count))
        elif values is not None:
            particles.state[...] = values
        self.physics.restart()

    def close(self) -> None:
        """Give communicators back to MPI, for programs that build many simulations. Collective."""
        self.physics.close()

    def resident_bytes(self) -> int:
        """Return the bytes of this rank's arrays of particles and nodes that live as long as the run. Local."""
        return self.particles.nbytes + self.physics.nbytes

    def conserved(self) -> dict[str, FloatArray]:
        """Return the sums over all ranks that the physics conserves, by name. Collective; one reduction."""
        mine = {name: np.asarray(value, dtype=np.float64) for name, value in self.physics.conserved().items()}
        if not mine:
            return {}
        sums = np.concatenate([np.ravel(value) for value in mine.values()])
        self.comm.Allreduce(MPI.IN_PLACE, sums)
        parts = np.split(sums, np.cumsum([value.size for value in mine.values()])[:-1])
        return {name: part.reshape(value.shape) for (name, value), part in zip(mine.items(), parts, strict=True)}

    def measured(self, shares: bool) -> ErrorReport | None:
        """Return errors against the exact solution, with null-space shares if asked; None without one. Collective."""
        physics = self.physics
        exact = physics.exact(self.particles.position, self.time)
        if exact is None:
            return None
        compared = {name: exact[name] for name in physics.compared}
        report = measure(self.particles, compared, self.step, self.time, self.total, self.comm)
        return replace(report, shares=physics.null_space_shares() if shares else dict.fromkeys(physics.shares))

    def _initial_size(self) -> float:
        """Return the size that growth is measured by, over all ranks."""
        sizes = np.array(self.physics.sizes())
        self.comm.Allreduce(MPI.IN_PLACE, sizes, op=MPI.MAX)
        return float(next((size for size in sizes if size), 0.0))

    # ------------------------------------------------------------ the loop

    def run(self, observer: Observer, interrupted: Callable[[], bool] = lambda: False) -> Outcome:
        """Take the scene's steps, telling `observer`; stop at a blow-up or when `interrupted` on any rank.

        Collective. Ranks agree by one reduction of four numbers (and one that counts particles) at report, snapshot
        and monitored steps, and otherwise about ten times a second; a blow-up is dated to its step all the same.
        """
        steps, output = self.scene.time.steps, self.scene.output
        reports = {*output.report_at, steps}
        snapshots = range(0, steps + 1, output.every) if output.every else ()
        monitored = range(0, steps + 1, max(1, -(-steps // MONITORED)))
        last, next_check, since = 0, 0, perf_counter()
        while True:
            due = self.step in snapshots or self.step in monitored or self.step in reports
            if due or self.step >= next_check:
                seconds = (perf_counter() - since) / max(1, self.step - last)
                peak, stop, stride = self._agree(interrupted(), seconds)
                if stop is not None:
                    return stop
                if due:
                    self._tell(observer, peak, self.step in reports, self.step in snapshots)
                last, next_check, since = self.step, self.step + stride, perf_counter()
            if self.step >= steps:
                return Outcome("completed", self.step)
            self.physics.step()
            self.step += 1
            if not self.physics.peak <= self.limit and self._bad is None:
                self._bad = (self.step, *self._worst())
            observer.progress(self.step, self.time)

    def _agree(self, interrupted: bool, seconds: float) -> tuple[float, Outcome | None, int]:
        """Return what all ranks know together: the peak, why to stop if so, and steps until the next look."""
        stride = max(1, min(1000, int(LONGEST_UNCHECKED / max(seconds, 1e-9))))
        first_bad = self._bad[0] if self._bad else math.inf
        peak = self.physics.peak if math.isfinite(self.physics.peak) else math.inf
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
        size = np.abs(self.particles[self.physics.watched])
        worst = int(np.argmax(np.where(np.isnan(size), np.inf, size)))
        cell = self.grid.cell_of(self.particles.coordinate[worst : worst + 1])[0]
        return tuple(map(int, cell)), float(size[worst])

    def _find_blow_up(self, step: int) -> BlowUp:
        """Return the worst of all ranks that saw the limit passed at `step`."""
        mine = (self._bad[1], self._bad[2]) if self._bad and self._bad[0] == step else ((), -1.0)
        seen = self.comm.allgather(mine)
        rank = max(range(len(seen)), key=lambda r: math.inf if math.isnan(seen[r][1]) else seen[r][1])
        return BlowUp(step, rank, *seen[rank])

    def _tell(self, observer: Observer, peak: float, report: bool, snapshot: bool) -> None:
        measured = None
        if report:
            self.phases("report")
            measured = self.measured(shares=self.step in self.scene.output.report_at)
        observer.record(self.step, self.time, peak, measured)
        if snapshot:
            self.phases("output")
            observer.snapshot(self.step, self.time)
        self.phases("other")


def _digest(scene: Scene) -> float:
    """Return a number that tells scenes of different values apart."""
    if not hasattr(scene, "values"):
        raise TypeError(f"scene must be a Scene, such as Scene.load or Scene.from_dict makes, not {told(scene)}")
    return float(zlib.crc32(repr(dict(scene.values)).encode()))


def _say_digest(digest: float) -> Said:
    return Said([digest], lambda: f"a scene of digest {digest:.0f}")

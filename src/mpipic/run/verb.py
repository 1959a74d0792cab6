"""The verb `run`: a simulation with a banner, progress, a run directory and pictures around it."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from mpipic.agreement import on_first
from mpipic.console import Console, Progress
from mpipic.errors import NotConverged, WriteFailed
from mpipic.io.run_directory import ERROR_PLOT, PARTICLES, SOLUTION_PLOT, RunDirectory
from mpipic.parts import A_FILTER, PENALTY
from mpipic.phases import Phases
from mpipic.run import describe
from mpipic.run.diagnostics import ErrorReport
from mpipic.run.facts import STEP_PHASES, versions
from mpipic.run.limits import cfl_limit
from mpipic.run.loop import Outcome, Simulation
from mpipic.run.warmup import compile_loops
from mpipic.runtime import StopRequest

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from mpi4py import MPI

    from mpipic.arrays import FloatArray
    from mpipic.io.snapshots import ParticleSeries
    from mpipic.physics.base import Physics
    from mpipic.plots.solution import Exact
    from mpipic.scene.records import Scene

EXIT_CODES = {"completed": 0, "failed": 1, "unstable": 3, "interrupted": 130}


class Losses:
    """Keeps what could not be written, so that the rest still is."""

    def __init__(self) -> None:
        self.reasons: list[str] = []
        """Why, one entry a reason."""

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Keep the reason of a `WriteFailed`, which all ranks raise together, instead of passing it on."""
        try:
            yield
        except WriteFailed as error:
            if str(error) not in self.reasons:
                self.reasons.append(str(error))


class Recorder:
    """Watches a run and keeps what it says: history rows, error reports, snapshots, progress."""

    def __init__(self, simulation: Simulation, directory: RunDirectory, progress: Progress) -> None:
        self.rows: list[dict[str, float | None]] = []
        self.reports: list[ErrorReport] = []
        self._simulation, self._directory, self._progress = simulation, directory, progress
        self._series: ParticleSeries | None = None
        self._since = perf_counter()
        self._peak = float("nan")

    def record(self, step: int, time: float, peak: float, report: ErrorReport | None) -> None:
        """Keep a row of the history; at report steps also bring the files up to date."""
        self._peak = peak
        self.progress(step, time)
        seconds, measured = perf_counter() - self._since, report.row() if report else {}
        self.rows.append({"step": step, "time": time, self._peak_column: peak, "seconds": seconds, **measured})
        if report:
            self.reports.append(report)
            self.write_history()

    def snapshot(self, step: int, time: float) -> None:
        """Write particles and nodal means. Collective."""
        simulation, scene = self._simulation, self._simulation.scene
        if self._series is None:
            from mpipic.io.snapshots import ParticleSeries

            self._series = ParticleSeries(self._directory.path / PARTICLES, simulation.comm, scene)
        nodal = simulation.physics.nodal()
        simulation.phases("output")
        self._series.write(step, time, scene.dt, simulation.particles, simulation.grid, nodal)

    def progress(self, step: int, time: float) -> None:
        """Show how far the run is; rank 0's clock, the peak at the last look at all ranks."""
        rate = self._simulation.total * step / max(perf_counter() - self._since, 1e-9)
        self._progress.update(step, time, self._peak, rate)

    def finish(self, losses: Losses) -> None:
        """Bring snapshots and history to their end, as far as the disk lets it. Collective."""
        if self._series is not None:
            with losses.noted():
                self._series.close()
        with losses.noted():
            self.write_history()

    @property
    def _peak_column(self) -> str:
        return f"max_{self._simulation.physics.watched}"

    def write_history(self) -> None:
        """Write the rows so far, with a column for everything that the physics measures. Rank 0 writes."""
        physics = self._simulation.physics
        errors = [f"{name}_{norm}" for name in physics.compared for norm in ("l1", "l2", "linf")]
        columns = ["step", "time", self._peak_column, *errors, *physics.shares, "seconds"]
        self._directory.write_history(columns, self.rows)


def run(scene: Scene, comm: MPI.Comm, output: Path | None, overwrite: bool, console: Console, plots: bool) -> int:
    """Run a scene into a run directory; returns the exit code.

    0 completed, 1 not all could be written, 3 unstable, 130 interrupted. Raises SceneError, OutputError. Collective.
    """
    began = perf_counter()
    phases = Phases()
    if output is not None:
        RunDirectory.check(output, comm, overwrite)
    simulation = Simulation(scene, comm, phases, before_first_use=lambda: compile_loops(scene))
    # only now: a scene that is refused must neither leave a directory nor clear one
    path = output if output is not None else RunDirectory.default(scene.name, comm)
    directory = RunDirectory(path, comm, overwrite)
    directory.write_scene(scene)
    phases("compile")
    limit = cfl_limit(scene, comm)
    phases("other")
    console.banner(banner(simulation, path, limit))
    if limit is not None and scene.cfl > limit:
        console.warning(f"CFL {scene.cfl:.4g} is above {limit:.4g}, the limit of this scheme: sound waves will grow")
    losses = Losses()
    try:
        outcome = _steps_and_results(simulation, directory, console, losses, plots, limit, began)
        console.phase_table(_at_least_a_millisecond(phases.seconds), perf_counter() - began)
        console.message(f"results in {path}")
    finally:
        for reason in losses.reasons:
            console.fail(reason)
    simulation.close()
    return EXIT_CODES["failed"] if losses.reasons else EXIT_CODES[outcome.status]


def _steps_and_results(
    simulation: Simulation,
    directory: RunDirectory,
    console: Console,
    losses: Losses,
    plots: bool,
    limit: float | None,
    began: float,
) -> Outcome:
    """Take the steps, say how it went, and leave the files, whatever of them can be written. Collective."""
    phases, stop = simulation.phases, StopRequest()
    try:
        outcome, recorder = _take_steps(simulation, directory, console, stop, losses)
        seconds = {"total": perf_counter() - began, "setup": phases.total("setup", "compile")}
        content = summary(simulation, outcome, recorder.reports, seconds, losses.reasons)
        with losses.noted():
            directory.write_summary(content)
        _say(console, outcome, simulation, recorder, limit)
        if plots and outcome.status not in ("interrupted", "failed"):
            phases("pictures")
            with losses.noted():
                _draw(directory, simulation, outcome, recorder)
            phases("other")
    finally:
        stop.release()
    return outcome


def _take_steps(
    simulation: Simulation, directory: RunDirectory, console: Console, stop: StopRequest, losses: Losses
) -> tuple[Outcome, Recorder]:
    """Run to the end, and leave snapshots and history complete, also where a solver or the disk fails. Collective."""
    physics = simulation.physics
    watched = physics.symbols.get(physics.watched, physics.watched)
    outcome = None
    with console.progress(simulation.scene.time.steps, watched) as progress:
        recorder = Recorder(simulation, directory, progress)
        try:
            with losses.noted():
                outcome = simulation.run(recorder, stop)
        except NotConverged:
            recorder.finish(losses)
            raise
    simulation.phases("output")
    recorder.finish(losses)
    return outcome or Outcome("failed", simulation.step), recorder


def banner(simulation: Simulation, path: Path, limit: float | None = None) -> list[tuple[str, str]]:
    """Return what is about to run, as (name, value) lines; `limit` is the scheme's CFL limit where it is known."""
    scene, grid = simulation.scene, simulation.grid
    ranks = f"{grid.size}, as {' x '.join(map(str, grid.blocks))} blocks" if grid.size > 1 else "1"
    per_cell = simulation.total / grid.node_count
    bound = "" if limit is None else f" (limit {limit:.3g})"
    courant = ", ".join(filter(None, [f"CFL {scene.cfl:.4g}{bound}", scene.part("physics.kind").pace(scene.values)]))
    particles = f"{simulation.total:,}, {per_cell:.3g} a cell, layout {scene.particles.layout}"
    built = dict(describe.built(scene))
    first = {"grid": built.pop("grid"), "particles": particles, "ranks": ranks}
    return [
        ("scene", scene.name),
        *first.items(),
        *((name, words) for name, words in built.items() if name not in ("particles", "initial")),
        ("steps", f"{scene.time.steps} of dt = {scene.dt:.6g}: {courant}"),
        ("left out", ", ".join(describe.left_out(scene))),
        ("output", str(path)),
    ]


def summary(
    simulation: Simulation,
    outcome: Outcome,
    reports: list[ErrorReport],
    seconds: dict[str, float],
    lost: Sequence[str] = (),
) -> dict[str, object]:
    """Return the content of summary.json, with remarks and what could not be written, if any. Collective."""
    phases = simulation.phases
    stepping = phases.total(*STEP_PHASES)
    # a blow-up is dated to its step, but steps go on until the ranks next look
    done = simulation.total * simulation.step
    result: dict[str, object] = {
        "status": outcome.status,
        "steps": outcome.step,
        "time": outcome.step * simulation.scene.dt,
        "ranks": simulation.comm.size,
        "particles": simulation.total,
        "nodes": simulation.grid.node_count,
        "errors": [report.record() for report in reports],
        "seconds": {**seconds, "step": stepping, "phases": phases.seconds},
        "particle_steps_per_second": done / stepping if done else 0.0,
        "bytes_per_particle": simulation.particles.bytes_per_particle,
        **simulation.physics.facts(),
        "conserved": {
            name: [start, end]
            for (name, start), end in zip(
                simulation.conserved_at_start.items(), simulation.conserved().values(), strict=True
            )
        },
        "scene": simulation.scene.to_dict(),
        "versions": versions(),
    }
    said = {"remarks": list(simulation.physics.remarks()), "lost": lost}
    result |= {name: texts for name, texts in said.items() if texts}
    if outcome.blow_up is not None:
        result["blow_up"] = outcome.blow_up
        result["cfl"] = simulation.scene.cfl
    return result


def _say(console: Console, outcome: Outcome, simulation: Simulation, recorder: Recorder, limit: float | None) -> None:
    console.error_table(recorder.reports)
    for remark in simulation.physics.remarks():
        console.warning(remark)
    if outcome.status == "interrupted":
        console.warning(f"interrupted after step {outcome.step}; what was recorded until then is complete")
    if outcome.status == "failed":
        console.warning(f"ended after step {outcome.step}: not all could be written; what was written before is kept")
    if outcome.blow_up is not None:
        bad, scene = outcome.blow_up, simulation.scene
        console.fail(
            f"unstable: |{simulation.physics.watched}| = {bad.value:.3g} passed {simulation.limit:.3g} "
            f"at step {bad.step}, t = {bad.step * scene.dt:.6g}, in cell {list(bad.cell)} on rank {bad.rank}; "
            f"CFL {scene.cfl:.4g}"
        )
        console.message(_blame(scene, limit))


def _blame(scene: Scene, limit: float | None) -> str:
    """Return what made a run unstable, and which setting would hold."""
    if limit is not None and scene.cfl > limit:
        return f"cause: the time step; the scheme takes CFL up to {limit:.3g}: try time.cfl={0.9 * limit:.2g}"
    cause = "cause: null-space noise, which grows as particles cross cells; mpipic stability computes how fast"
    remedies = [] if scene.values.has(A_FILTER) else ["filter.kind=local delays it"]
    remedies += [] if scene.values.has(PENALTY) else ["--preset recommended avoids it"]
    return "; ".join([cause, *remedies])


def _at_least_a_millisecond(seconds: dict[str, float]) -> dict[str, float]:
    return {name: spent for name, spent in seconds.items() if spent >= 1e-3 and name != "other"}


def _draw(directory: RunDirectory, simulation: Simulation, outcome: Outcome, recorder: Recorder) -> None:
    """Draw the pictures on rank 0. Collective."""
    from mpipic.plots.history import draw_error
    from mpipic.plots.sample import gather_sample
    from mpipic.plots.solution import draw_solution
    from mpipic.plots.style import Subject

    sample = gather_sample(simulation.particles, simulation.comm)
    scene, step, physics = simulation.scene, simulation.step, simulation.physics
    vector = next((name for name, shape in physics.fields(scene.dim).items() if shape == (scene.dim,)), None)
    subject = Subject(
        scene.name, scene.filter.kind, scene.grid.length, scene.h, physics.watched, vector, physics.symbols
    )

    def draw() -> None:
        assert sample is not None
        known = physics.exact(np.zeros((1, scene.dim)), simulation.time) is not None
        exact = _exact_of(physics) if known else None
        draw_error(directory.path / ERROR_PLOT, recorder.rows, subject, outcome.status == "unstable")
        draw_solution(directory.path / SOLUTION_PLOT, subject, simulation.time, step, sample, exact)

    on_first(simulation.comm, draw)


def _exact_of(physics: Physics) -> Exact:
    """Return the exact solution of a physics that has one, as pictures take it."""

    def exact(points: FloatArray, time: float) -> Mapping[str, FloatArray]:
        found = physics.exact(points, time)
        assert found is not None
        return found

    return exact

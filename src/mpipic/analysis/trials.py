"""The verb `trials`: stiff and extreme cases, each run and judged.

The rule for every case: a right answer, or a stated `unstable`, or a refusal with a reason; never a number that is not
finite, never a wrong number called completed. Where a growth rate can be computed, the run must bear it out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
from mpi4py import MPI

from mpipic.agreement import on_first
from mpipic.analysis.growth import NOISE, Growth, analyse
from mpipic.analysis.trial_cases import CASES, Case
from mpipic.analysis.writing import check_file
from mpipic.arrays import FloatArray
from mpipic.console import Console
from mpipic.errors import NotConverged, Refused
from mpipic.files import write_json
from mpipic.run.diagnostics import ErrorReport, norms
from mpipic.run.facts import versions
from mpipic.run.loop import Outcome, Simulation
from mpipic.scene.records import Scene, SceneError
from mpipic.wording import listed, show

AGREE = 0.05
"""Growth rates of run and prediction may differ by this share."""
RESOLVED = 1e-3
"""Growth per step above which the two are compared."""


@dataclass(frozen=True)
class Judgement:
    """A case, judged: status completed, unstable, refused or not converged; verdict good or BAD, and why."""

    case: str
    filter: str
    status: str
    steps: int
    growth: float | None
    predicted: float | None
    error: float | None
    seconds: float
    verdict: str
    reason: str


class _Watch:
    """Keeps the largest |density| of every step."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self.peaks: list[float] = [simulation.physics.peak]

    def record(self, step: int, time: float, peak: float, report: ErrorReport | None) -> None:
        """Do nothing: peaks come with every step."""

    def snapshot(self, step: int, time: float) -> None:
        """Do nothing."""

    def progress(self, step: int, time: float) -> None:
        """Keep this rank's largest density."""
        self.peaks.append(self._simulation.physics.peak)

    def growth(self, comm: MPI.Comm, period: int) -> float | None:
        """Return the growth per step of max |ρ| over all ranks, the slope of its logarithm over whole periods.

        It is taken where max |ρ| is a thousand times the start, which leaves the solution itself behind; None where
        that lasts for less than two periods.
        """
        peaks = np.array(self.peaks)
        peaks = np.where(np.isfinite(peaks), peaks, np.inf)
        comm.Allreduce(MPI.IN_PLACE, peaks, op=MPI.MAX)
        peaks = peaks[np.isfinite(peaks)]
        grown = np.flatnonzero(peaks > 1e3 * peaks[0])
        if grown.size == 0 or peaks[0] <= 0.0:
            return None
        periods = (len(peaks) - 1 - int(grown[0])) // period
        if periods < 2:
            return None
        return float(np.log(peaks[-1] / peaks[-1 - periods * period]) / (periods * period))


@dataclass(frozen=True)
class Finding:
    """How a case ended, whether that is good, and why."""

    status: str
    good: bool
    reason: str
    steps: int = 0
    error: float | None = None
    growth: float | None = None
    predicted: float | None = None


def judge(case: Case, comm: MPI.Comm) -> Judgement:
    """Run one case and hold it against its rule. Collective."""
    began = perf_counter()
    try:
        found = _run(case, Scene.from_dict(case.scene, name=case.name), comm)
    except SceneError as error:
        found = Finding("refused", case.expect in ("refused", "any"), str(error).splitlines()[0])
    except NotConverged as error:
        found = Finding("not converged", case.expect == "any", str(error))
    return Judgement(
        case=case.name,
        filter=str(case.scene.get("filter", {}).get("kind", "local")),
        status=found.status,
        steps=found.steps,
        growth=found.growth,
        predicted=found.predicted,
        error=found.error,
        seconds=perf_counter() - began,
        verdict="good" if found.good else "BAD",
        reason=found.reason,
    )


def _run(case: Case, scene: Scene, comm: MPI.Comm) -> Finding:
    simulation = Simulation(scene, comm)
    if case.place is not None:
        _place(simulation, case.place(simulation.grid, np.random.default_rng(0)))
    if case.amplitude != 1.0:
        simulation.limit *= case.amplitude
        simulation.set_state(state=simulation.particles.state * case.amplitude)
    watch = _Watch(simulation)
    outcome = simulation.run(watch)
    error = _error(case, simulation) if outcome.status == "completed" else None
    finite = bool(comm.allreduce(bool(np.isfinite(simulation.particles.state).all()), op=MPI.MIN))
    simulation.close()
    if case.predict and (finite or outcome.status != "completed"):
        return _against_prediction(outcome, error, analyse(scene, comm, 2000), scene, watch, comm)
    good, reason = _verdict(case, outcome.status, finite, error)
    return Finding(outcome.status, good, reason, outcome.step, error)


def _verdict(case: Case, status: str, finite: bool, error: float | None) -> tuple[bool, str]:
    """Return whether a run that ended so keeps the rule of its case, and why."""
    if status == "unstable":
        good = case.expect in ("unstable", "any")
        return good, "stated" if good else "should have completed"
    if not finite:
        return False, "a value that is not finite was called completed"
    if case.expect == "unstable":
        return False, "should have ended unstable"
    right = error is None or error <= case.error
    words = "bounded" if error is None else f"error {error:.2g}, at most {case.error:g}"
    return right, words if right else f"a wrong answer: {words}"


def _place(simulation: Simulation, coordinate: FloatArray) -> None:
    """Put the particles at these coordinates in cells, (n, d), the same on all ranks, as at t = 0. Collective."""
    grid = simulation.grid
    coordinate = grid.wrapped(coordinate)
    ids = np.flatnonzero(grid.owner_of(coordinate) == grid.rank)
    simulation.set_state(coordinate[ids], None, ids)


def _error(case: Case, simulation: Simulation) -> float | None:
    """Return the l2 error of the density, relative to the amplitude. Collective."""
    exact = simulation.physics.exact(simulation.particles.position, simulation.time)
    if exact is None or not simulation.total:
        return None
    error = simulation.particles["density"] - case.amplitude * exact["density"]
    return norms(error, simulation.total, simulation.comm).l2 / case.amplitude


def _against_prediction(
    outcome: Outcome, error: float | None, analysis: Growth, scene: Scene, watch: _Watch, comm: MPI.Comm
) -> Finding:
    """Hold a run against what its growth rate says. Collective."""
    predicted = math.log1p(analysis.growth_per_step)
    growth = watch.growth(comm, analysis.period_steps)
    if predicted > RESOLVED and growth is not None:
        off = abs(growth - predicted) / predicted
        good, reason = off <= AGREE, f"growth differs from the prediction by {100 * off:.1f} %"
    else:
        # rounding begins far below its unit where symmetry hides a mode: a run may outlast the prediction by half
        due = math.log(1e3 / NOISE) / predicted if predicted > 0.0 else math.inf
        good = not (growth is None and outcome.status == "completed" and 1.5 * due < scene.time.steps)
        reason = "as predicted: stable for so long" if good else "should have grown"
    return Finding(outcome.status, good, reason, outcome.step, error, growth, predicted)


def run(
    comm: MPI.Comm, console: Console, output: Path | None, short: bool, only: Sequence[str] | None = None
) -> list[Judgement]:
    """Judge all cases, or the short ones, or those whose name contains one of `only`; print one table. Collective."""
    cases = [case for case in CASES if case.short or not short]
    if only:
        cases = [case for case in cases if any(part in case.name for part in only)]
        if not cases:
            raise Refused(f"no case {'of the short form ' * short}has {listed(map(show, only), 'or')} in its name")
    check_file(output, comm)
    judged = []
    for case in cases:
        judged.append(judge(case, comm))
        console.message(f"{judged[-1].verdict:4s} {judged[-1].case}: {judged[-1].reason} ({judged[-1].seconds:.1f} s)")
    console.table(f"{len(judged)} cases on {comm.size} ranks", HEADER, [_entries(item) for item in judged])
    bad = [item for item in judged if item.verdict != "good"]
    for item in bad:
        console.fail(f"{item.case}: {item.reason}")
    console.message(f"{len(judged) - len(bad)} good, {len(bad)} bad, in {sum(j.seconds for j in judged):.0f} s")
    if output is not None:
        content = {"ranks": comm.size, "cases": judged, "versions": versions()}
        on_first(comm, lambda: write_json(output, content))
    return judged


HEADER = ("of", "status", "step", "growth", "predicted", "error", "verdict")


def _entries(item: Judgement) -> list[str]:
    def number(value: float | None) -> str:
        return "" if value is None else f"{value:.2e}"

    return [
        item.case, item.status, str(item.steps), number(item.growth), number(item.predicted), number(item.error),
        item.verdict,
    ]  # fmt: skip

"""Figures 5 to 8: the paper's wave under each filter, and how long the local filter holds out."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from mpipic.arrays import FloatArray
from mpipic.figures.plan import Plan, with_filter
from mpipic.plots.sample import gather_sample
from mpipic.run.build import solution_of
from mpipic.run.loop import Simulation

if TYPE_CHECKING:
    from mpipic.scene.records import Scene

LOOK = 100
"""Steps between two looks at whether the long run has failed."""


def wave_columns(plan: Plan, comm: MPI.Comm) -> dict[int, dict[str, FloatArray]]:
    """Return by step x, exact and the density under each filter at all particles by id, on all ranks. Collective."""
    found: dict[int, dict[str, FloatArray]] = {step: {} for step in plan.steps}
    for label, settings in plan.filters.items():
        simulation = Simulation(with_filter(plan.scene, settings), comm)
        with np.errstate(over="ignore", invalid="ignore"):
            for step in range(plan.last + 1):
                if step in found:
                    _take(found[step], label, simulation, step * plan.scene.dt)
                if step < plan.last:
                    simulation.physics.step()
        simulation.close()
    return found


def _take(columns: dict[str, FloatArray], label: str, simulation: Simulation, time: float) -> None:
    """Put the density by id, and with the first filter positions and exact values, into a figure's columns."""
    sample = simulation.comm.bcast(gather_sample(simulation.particles, simulation.comm, 1 << 30))
    assert sample is not None
    position = np.asarray(sample["position"], dtype=np.float64)
    if not columns:
        exact = simulation.physics.exact(position, time)
        assert exact is not None
        columns |= {"x": position[:, 0], "exact": np.asarray(exact["density"])}
    columns[label] = np.asarray(sample["density"], dtype=np.float64)


def rms(values: FloatArray) -> float:
    """Return the root mean square, infinite where a value is not finite."""
    with np.errstate(over="ignore"):
        return float(np.sqrt(np.mean(values**2))) if np.isfinite(values).all() else float("inf")


def failing_step(scene: Scene, steps: int, comm: MPI.Comm) -> int | None:
    """Return the step, to LOOK steps, at which |ρ| passes the scene's limit; None if it does not in `steps` steps.

    Collective.
    """
    simulation = Simulation(scene, comm)
    failed = None
    for step in range(1, steps + 1):
        simulation.physics.step()
        if step % LOOK == 0 and not comm.allreduce(simulation.physics.peak, op=MPI.MAX) <= simulation.limit:
            failed = step
            break
    simulation.close()
    return failed


def misprint_errors(scene: Scene, time: float) -> dict[str, float]:
    """Return root mean square errors of eq. 7 as printed and as corrected, against the exact solution. Local.

    Printed: ρ = ½ [f(x - (c - v) t) + f(x + (c - v) t)]; the first speed must be c + v.
    """
    solution = solution_of(scene)
    assert solution is not None
    x = np.linspace(0.0, scene.grid.length[0], 400, endpoint=False)[:, None]
    c, v = scene.gas.sound_speed, scene.gas.flow[0]
    exact = np.asarray(solution(x, time)[0])

    def half(speed: float) -> FloatArray:
        return 0.5 * np.asarray(solution(np.mod(x - speed * time, scene.grid.length[0]), 0.0)[0])

    back = half(-(c - v))
    return {"printed": rms(half(c - v) + back - exact), "corrected": rms(half(c + v) + back - exact)}

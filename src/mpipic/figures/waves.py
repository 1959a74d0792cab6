"""Figures 5 to 8: the paper's wave under each filter, and how long the local filter holds out."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, cast

import numpy as np
from mpi4py import MPI

from mpipic.arrays import FloatArray
from mpipic.errors import NotConverged
from mpipic.figures.plan import Plan, spread, with_filter
from mpipic.plots.sample import gather_sample
from mpipic.run.build import solution_of
from mpipic.run.loop import Simulation

if TYPE_CHECKING:
    from mpipic.scene.records import Scene

LOOK = 100
"""Steps between two looks at whether the long run has failed."""


def wave_columns(plan: Plan, comm: MPI.Comm) -> dict[int, dict[str, FloatArray]]:
    """Return by step x, exact and the density under each filter at all particles by id, on all ranks.

    Collective: ranks share the filters, so that a figure has the same bits, noise too, on any number of ranks.
    """
    runs = spread(comm, {label: partial(_run, plan, label) for label in plan.filters})
    found: dict[int, dict[str, FloatArray]] = {step: {} for step in plan.steps}
    for label, columns in runs.items():
        if columns is None:
            raise NotConverged(f"the filter {label} did not converge in {plan.last} steps")
        for step, one in cast("dict[int, dict[str, FloatArray]]", columns).items():
            found[step] |= one
    return found


def _run(plan: Plan, label: str) -> dict[int, dict[str, FloatArray]]:
    """Return by step x, exact and the density under one filter, by id. Local."""
    simulation = Simulation(with_filter(plan.scene, plan.filters[label]), MPI.COMM_SELF)
    found = {}
    with np.errstate(over="ignore", invalid="ignore"):
        for step in range(plan.last + 1):
            if step in plan.steps:
                found[step] = _columns(simulation, label, step * plan.scene.dt)
            if step < plan.last:
                simulation.physics.step()
    simulation.close()
    return found


def _columns(simulation: Simulation, label: str, time: float) -> dict[str, FloatArray]:
    """Return x, exact and the density now, by id."""
    sample = gather_sample(simulation.particles, simulation.comm, 1 << 30)
    assert sample is not None
    position = np.asarray(sample["position"], dtype=np.float64)
    exact = simulation.physics.exact(position, time)
    assert exact is not None
    density = np.asarray(sample["density"], dtype=np.float64)
    return {"x": position[:, 0], "exact": np.asarray(exact["density"]), label: density}


def rms(values: FloatArray) -> float:
    """Return the root mean square, infinite where a value is not finite."""
    with np.errstate(over="ignore"):
        return float(np.sqrt(np.mean(values**2))) if np.isfinite(values).all() else float("inf")


def failing_step(scene: Scene, steps: int) -> int | None:
    """Return the step, to LOOK steps, at which |ρ| passes the scene's limit, None if `steps` do not reach it. Local."""
    simulation = Simulation(scene, MPI.COMM_SELF)
    failed = None
    for step in range(1, steps + 1):
        simulation.physics.step()
        if step % LOOK == 0 and not simulation.physics.peak <= simulation.limit:
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

"""The verb `bench`: particle-steps per second, and what share of the memory bandwidth limit they are.

A step that read and wrote every particle as seldom as four fused sweeps allow would move 40 d + 16 bytes a particle
(56, 96, 136 in 1D, 2D, 3D); the limit is that many bytes at the speed of the STREAM triad, measured here on the same
ranks between the same samples. `Sweep` touches particles once, 32 d + 16 bytes, so a share of 1 is no upper bound.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from mpipic import parts
from mpipic.agreement import on_first
from mpipic.analysis.triad import Triad
from mpipic.analysis.writing import check_file
from mpipic.console import Console
from mpipic.errors import Refused
from mpipic.files import write_json
from mpipic.memory import free_bytes
from mpipic.phases import Phases
from mpipic.run.describe import rank_bytes
from mpipic.run.facts import STEP_PHASES, versions
from mpipic.run.loop import Simulation
from mpipic.run.warmup import compile_loops
from mpipic.scene.presets import with_preset
from mpipic.scene.records import Scene

if TYPE_CHECKING:
    from mpi4py import MPI

WARM_STEPS = 2
FLOW, CFL = 0.05, 0.1


@dataclass(frozen=True)
class Plan:
    """Every dimension with every filter is timed, with about `particles` particles in all, `per_cell` to a cell.

    A `preset` takes the place of basis and filters.
    """

    dims: tuple[int, ...]
    particles: int
    per_cell: int
    kinds: tuple[str, ...]
    layout: str
    steps: int
    repeats: int
    tolerance: float
    basis: str = "linear"
    preset: str | None = None


@dataclass(frozen=True)
class Timing:
    """A row of the tables: medians over the samples, and the spread of what is quoted."""

    dim: int
    filter: str
    layout: str
    ranks: int
    particles: int
    cells: tuple[int, ...]
    setup_seconds: float
    ns_per_particle_step: float
    spread: tuple[float, float]
    particle_steps_per_second: float
    triad_gigabytes_per_second: float
    share: float
    bytes_per_particle: float
    phases: dict[str, float]


def scene_of(dim: int, kind: str, plan: Plan) -> Scene:
    """Return a box of about the planned number of particles: cubic, flow along every axis, a plane wave."""
    per_axis = _per_axis(dim, plan.per_cell)
    per_cell = [plan.per_cell] if plan.layout == "random" else per_axis
    side = max(2, round((plan.particles / float(np.prod(per_axis))) ** (1.0 / dim)))
    particles: dict[str, object] = {"layout": plan.layout, "per_cell": per_cell}
    if plan.layout == "jittered":
        particles["jitter"] = 0.4
    data: dict[str, object] = {
        "grid": {"cells": [side] * dim},
        "particles": particles,
        "gas": {"flow": [FLOW] * dim},
        "initial": {"profile": "plane-wave"},
        "mapping": {"basis": plan.basis},
        "filter": {"kind": kind, **({"tolerance": plan.tolerance} if _has_tolerance(kind) else {})},
        "time": {"cfl": CFL, "steps": WARM_STEPS + plan.steps * plan.repeats},
    }
    return Scene.from_dict(with_preset(data, plan.preset) if plan.preset else data, name="bench")


def _has_tolerance(kind: str) -> bool:
    part = parts.find("filter.kind", kind, "acoustics")
    return part is not None and "tolerance" in part.Settings.model_fields


def _per_axis(dim: int, per_cell: int) -> list[int]:
    """Return factors of `per_cell`, one per axis, as even as whole numbers allow, the largest first."""
    factors = [1] * dim
    rest, prime = per_cell, 2
    while rest > 1:
        while rest % prime:
            prime += 1
        factors[int(np.argmin(factors))] *= prime
        rest //= prime
    return sorted(factors, reverse=True)


def time_steps(dim: int, kind: str, plan: Plan, comm: MPI.Comm, triad: Triad) -> Timing:
    """Time one case. Collective."""
    scene = scene_of(dim, kind, plan)
    compile_loops(scene)
    began = perf_counter()
    simulation = Simulation(scene, comm)
    setup = perf_counter() - began
    for _ in range(WARM_STEPS):
        simulation.physics.step()
    simulation.phases.seconds.clear()
    seconds, triads = [], []
    for _ in range(plan.repeats):
        triads.append(triad.bandwidth())
        comm.Barrier()
        began = perf_counter()
        for _ in range(plan.steps):
            simulation.physics.step()
        comm.Barrier()
        seconds.append((perf_counter() - began) / plan.steps / simulation.total)
    simulation.close()
    shares = [(40 * dim + 16) / (s * t) for s, t in zip(seconds, triads, strict=True)]
    spent = statistics.median(seconds)
    return Timing(
        dim=dim,
        filter=plan.preset or kind,
        layout=plan.layout,
        ranks=comm.size,
        particles=simulation.total,
        cells=scene.grid.cells,
        setup_seconds=setup,
        ns_per_particle_step=1e9 * spent,
        spread=(1e9 * min(seconds), 1e9 * max(seconds)),
        particle_steps_per_second=1.0 / spent,
        triad_gigabytes_per_second=1e-9 * statistics.median(triads),
        share=statistics.median(shares),
        bytes_per_particle=simulation.resident_bytes() / max(1, simulation.particles.count),
        phases=_share_of_phases(simulation.phases),
    )


def _share_of_phases(phases: Phases) -> dict[str, float]:
    phases("other")
    total = phases.total(*STEP_PHASES) or 1.0
    return {name: phases.seconds[name] / total for name in STEP_PHASES if name in phases.seconds}


def _check_memory(plan: Plan, comm: MPI.Comm) -> None:
    """Raise Refused on all ranks for a plan with a case that there is no memory for. Collective."""
    scenes = [scene_of(dim, kind, plan) for dim in plan.dims for kind in plan.kinds]
    needed, free = max(rank_bytes(s, 1, s.particle_count or 0) for s in scenes), free_bytes(comm)
    if needed > free:
        raise Refused(f"--particles {plan.particles}: needs {1e-9 * needed:.3g} GB, and {1e-9 * free:.3g} GB are free")


def run(plan: Plan, comm: MPI.Comm, console: Console, output: Path | None = None) -> list[Timing]:
    """Time every case of the plan, print the table, write it as JSON if asked. Collective."""
    check_file(output, comm)
    _check_memory(plan, comm)
    triad = Triad(comm)
    timings = [time_steps(dim, kind, plan, comm, triad) for dim in plan.dims for kind in plan.kinds]
    console.table("speed, per particle and step", SPEED, [_speed(timing) for timing in timings])
    console.table("set-up, memory, and where a step's time goes", COST, [_cost(timing) for timing in timings])
    if output is not None:
        content = {"plan": plan, "timings": timings, "versions": versions()}
        on_first(comm, lambda: write_json(output, content))
    return timings


SPEED = ("d", "filter", "ranks", "particles", "ns/step", "from..to", "10^6 steps/s", "triad GB/s", "share")
COST = ("d", "filter", "set-up s", "bytes a particle", "phases")


def _speed(timing: Timing) -> Sequence[str]:
    return (
        str(timing.dim), timing.filter, str(timing.ranks), f"{timing.particles:.3g}",
        f"{timing.ns_per_particle_step:.2f}", f"{timing.spread[0]:.2f}..{timing.spread[1]:.2f}",
        f"{1e-6 * timing.particle_steps_per_second:.1f}", f"{timing.triad_gigabytes_per_second:.1f}",
        f"{timing.share:.3f}",
    )  # fmt: skip


def _cost(timing: Timing) -> Sequence[str]:
    phases = ", ".join(f"{name} {100 * share:.0f} %" for name, share in timing.phases.items() if share >= 0.005)
    setup, size = f"{timing.setup_seconds:.2f}", f"{timing.bytes_per_particle:.0f}"
    return (str(timing.dim), timing.filter, setup, size, phases)

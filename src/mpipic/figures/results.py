"""All that is computed for the paper's figures, by all ranks, and the claims that follow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, cast

import numpy as np
from mpi4py import MPI

from mpipic.arrays import FloatArray
from mpipic.console import Console
from mpipic.figures import claims
from mpipic.figures.claims import Claim
from mpipic.figures.costs import Cost, costs
from mpipic.figures.gradients import gradient_columns, share
from mpipic.figures.maps import Point, points
from mpipic.figures.plan import GROWING, Analyse, Growth, Plan, spread, with_filter
from mpipic.figures.waves import failing_step, misprint_errors, rms, wave_columns

if TYPE_CHECKING:
    from mpipic.scene.records import Scene

Columns = Mapping[str, FloatArray]


@dataclass(frozen=True)
class Results:
    """Numbers behind the figures, the same on all ranks.

    Attributes
    ----------
    gradients, waves
        Columns of figures 1 to 4, and of figures 5 to 8 by step.
    growth
        Growth of the scene by filter, those that were found.
    costs
        Timings, of one process.
    survey
        Points of the wider question.
    failed
        The step at which the local filter failed in the long run; None without one, or if it did not.
    """

    gradients: Columns
    waves: Mapping[int, Columns]
    growth: Mapping[str, Growth]
    costs: Sequence[Cost]
    survey: Sequence[Point]
    failed: int | None


def compute(plan: Plan, analyse: Analyse, comm: MPI.Comm, console: Console) -> Results:
    """Return everything, saying what is being computed. Collective."""
    console.message("figures 1 to 4: gradients")
    gradients = gradient_columns(plan.scene, comm)
    console.message(f"figures 5 to 8: {plan.last:,} steps with each filter")
    waves = wave_columns(plan, comm)
    console.message("growth per step, and costs")
    alone = spread(comm, {"costs": partial(costs, plan)} | {
        label: partial(analyse, with_filter(plan.scene, settings), MPI.COMM_SELF, plan.most_period)
        for label, settings in GROWING.items()
    })  # fmt: skip
    timed = cast("list[Cost]", alone.pop("costs"))
    growth = {label: cast("Growth", found) for label, found in alone.items() if found is not None}
    console.message("maps: filters against flow, particles per cell, CFL and layout")
    survey = points(plan.scene, plan.survey, analyse, comm)
    failed = None
    if plan.long_steps:
        console.message(f"the local filter, up to {plan.long_steps:,} steps")
        scene = with_filter(plan.scene, {"kind": "local"})
        failed = cast("int | None", spread(comm, {"": partial(failing_step, scene, plan.long_steps)})[""])
    return Results(gradients, waves, growth, timed, survey, failed)


def judge(plan: Plan, results: Results) -> list[Claim]:
    """Return every claim with its verdict, in the order of the figures. Local."""
    seen, h = results.gradients, plan.scene.h[0]
    errors = {name: rms(seen[name] - seen["true"]) for name in ("computed", "svd", "local")}
    found = [
        claims.pairs(seen, h),
        claims.oscillation(seen),
        claims.reintroduction(seen),
        claims.removal(
            share(seen["null_space"], seen["computed"]),
            share(seen["svd_null_space"], seen["svd"]),
            (errors["computed"], errors["svd"]),
        ),
        claims.local_filter(errors),
        claims.interpolation(share(seen["local_null_space"], seen["local"])),
        *_of_waves(plan, results),
        claims.cost(results.costs),
    ]
    return [*found, claims.misprint(misprint_errors(plan.scene, plan.scene.dt * plan.steps[-2]))]


def _of_waves(plan: Plan, results: Results) -> list[Claim]:
    """Return the claims about figures 6 to 8."""
    _, noisy, late, last = plan.steps
    errors = {name: rms(values - results.waves[noisy]["exact"]) for name, values in _of_filters(plan, results, noisy)}
    peaks = {step: _peaks(plan, results, step) for step in (late, last)}
    growth = results.growth
    found = [claims.noise_at(noisy, errors, 6), claims.still_stable(late, peaks[late], 7)]
    if {"unfiltered", "local"} <= growth.keys():
        found += [
            claims.improved_stability({name: growth[name] for name in reversed(list(GROWING)) if name in growth}),
            claims.local_stability(peaks[last]["local"], growth["local"], results.failed, last, plan.long_steps),
        ]
    return [*found, claims.svd_fails(peaks[last]["svd"], growth.get("svd"), last)]


def _of_filters(plan: Plan, results: Results, step: int) -> list[tuple[str, FloatArray]]:
    return [(name, results.waves[step][name]) for name in plan.filters]


def _peaks(plan: Plan, results: Results, step: int) -> dict[str, float]:
    """Return by filter the largest |ρ| at a step against that at the start, infinite where it is not finite."""
    start = float(np.abs(results.waves[0]["exact"]).max())
    sizes = {name: float(np.abs(values).max()) / start for name, values in _of_filters(plan, results, step)}
    return {name: size if np.isfinite(size) else float("inf") for name, size in sizes.items()}


def scene_text(scene: Scene) -> str:
    """Return the scene file without the filter, which the figures vary."""
    return "".join(part for part in _sections(scene.to_toml()) if not part.startswith("[filter]"))


def _sections(text: str) -> list[str]:
    first, *rest = text.split("\n[")
    return [first + "\n", *("[" + part + "\n" for part in rest)]

"""The verb `filters`: every filter on the scene's particles, side by side: cost, and distance from the projection."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from mpipic import filters
from mpipic.agreement import on_first
from mpipic.analysis.filter_choice import Choice, svd_is_quick
from mpipic.analysis.writing import check_file
from mpipic.arrays import FloatArray
from mpipic.console import Console
from mpipic.draws import noise
from mpipic.files import write_json
from mpipic.mapping.mapping import Mapping
from mpipic.run.build import check_filter, place
from mpipic.run.facts import versions

if TYPE_CHECKING:
    from mpipic.scene.records import Scene

REFERENCE_TOLERANCE = 1e-13
LONGEST, MOST = 1.0, 25
"""Seconds and number of applications that a timing takes at most (but at least three)."""


@dataclass(frozen=True)
class FilterRow:
    """One filter on white noise q.

    Attributes
    ----------
    setup_seconds
        Time of what positions determine, paid again whenever particles move: the first application less a usual one.
    seconds, spread
        Time of one application: median, and fastest and slowest.
    messages, reductions
        Traffic of one application, on all ranks together; nothing is sent on one rank.
    distance
        ‖F q - P q‖ / ‖q‖, P the reference.
    null_space_share
        ‖(1 - P) F q‖ / ‖F q‖.
    sum_error
        |Σ F q - Σ q| / Σ |q|.
    facts
        Words of the filter about itself: iterations, rank and gap.
    """

    filter: str
    kind: str
    order: int | None
    setup_seconds: float
    seconds: float
    spread: tuple[float, float]
    messages: int
    reductions: int
    distance: float
    null_space_share: float
    sum_error: float
    facts: dict[str, Any] = field(default_factory=dict)


class Comparison:
    """The scene's particles at t = 0, a noise on them, and what the reference makes of it. Collective."""

    def __init__(self, scene: Scene, comm: MPI.Comm) -> None:
        self.scene, self.comm = scene, comm
        self.grid, self.particles = place(scene, comm)
        self.total = int(comm.allreduce(self.particles.count))
        self.mapping = Mapping.at(self.grid, self.particles)
        self.q = noise(self.particles.ids)
        self.reference = "svd" if svd_is_quick(scene.cell_count, self.total) else "exact"
        self._projector: filters.Filter = (
            filters.SvdFilter(self.mapping)
            if self.reference == "svd"
            else filters.ExactFilter(self.mapping, REFERENCE_TOLERANCE, "report_", strict=False)
        )
        self.projected = self._projector.apply(self.q)

    def norm(self, q: FloatArray) -> float:
        """Return the Euclidean norm over all ranks. Collective."""
        return float(np.sqrt(self.comm.allreduce(float(q @ q))))

    @property
    def unfiltered_share(self) -> float:
        """The share of the noise itself that no node sees, ‖(1 - P) q‖ / ‖q‖. Collective."""
        return self.norm(self.q - self.projected) / self.norm(self.q)

    def row(self, choice: Choice) -> FilterRow:
        """Apply the filter, and say what it costs and does. Collective."""
        check_filter(self.scene, self.total, self.comm, choice.kind)
        filter_ = filters.create(choice.kind, self.mapping, choice.settings)
        filter_.strict = False
        first = self._seconds(filter_)
        times = [self._seconds(filter_)]
        while len(times) < 3 or (sum(times) < LONGEST and len(times) < MOST):
            times.append(self._seconds(filter_))
        messages, reductions = self._traffic(filter_)
        filtered = filter_.apply(self.q)
        size, kept = self.norm(self.q), self.norm(filtered)
        sums = self.grid.reduce(np.array([filtered.sum(), self.q.sum(), np.abs(self.q).sum()]))
        return FilterRow(
            filter=choice.label,
            kind=choice.kind,
            order=choice.settings.get("order"),
            setup_seconds=max(0.0, first - statistics.median(times)),
            seconds=statistics.median(times),
            spread=(min(times), max(times)),
            messages=messages,
            reductions=reductions,
            distance=self.norm(filtered - self.projected) / size,
            null_space_share=self.norm(filtered - self._projector.apply(filtered)) / kept if kept else 0.0,
            sum_error=float(abs(sums[0] - sums[1]) / sums[2]),
            facts=filter_.facts(),
        )

    def _seconds(self, filter_: filters.Filter) -> float:
        """Return the time of one application, the slowest rank's, which all ranks agree on. Collective."""
        self.comm.Barrier()
        began = perf_counter()
        filter_.apply(self.q)
        return float(self.comm.allreduce(perf_counter() - began, op=MPI.MAX))

    def _traffic(self, filter_: filters.Filter) -> tuple[int, int]:
        """Return messages of all ranks, and reductions, of one application, as PETSc's log and the grid count them."""
        PETSc.Log.begin()
        event = PETSc.Log.Event("filter application")
        before, counted = self.grid.reductions, event.getPerfInfo()
        event.begin()
        filter_.apply(self.q)
        event.end()
        after = event.getPerfInfo()
        messages = self.comm.allreduce(after["numMessages"] - counted["numMessages"])
        reductions = after["numReductions"] - counted["numReductions"] + self.grid.reductions - before
        return int(messages), int(reductions) if self.comm.size > 1 else 0


def run(
    scene: Scene, choices: Sequence[Choice], comm: MPI.Comm, console: Console, output: Path | None
) -> list[FilterRow]:
    """Print one table, and write it as JSON if asked. Collective."""
    check_file(output, comm)
    comparison = Comparison(scene, comm)
    rows = [comparison.row(choice) for choice in choices]
    share = comparison.unfiltered_share
    console.message(
        f"{comparison.total:,} particles, {comparison.grid.node_count:,} nodes, {comm.size} "
        f"rank{'s' if comm.size > 1 else ''}; white noise of which {100 * share:.1f} % is in the null space; "
        f"distances from {comparison.reference}"
    )
    console.table("filters on this scene's particles, one application", HEADER, [_entries(row) for row in rows])
    for note in filter(None, (filters.FILTERS[row.kind].in_words(row.facts) for row in rows)):
        console.message(note)
    if output is not None:
        content = {
            "scene": scene.to_dict(),
            "ranks": comm.size,
            "particles": comparison.total,
            "nodes": comparison.grid.node_count,
            "reference": comparison.reference,
            "unfiltered_null_space_share": share,
            "filters": rows,
            "versions": versions(),
        }
        on_first(comm, lambda: write_json(output, content))
    return rows


HEADER = ("filter", "set-up s", "s", "messages", "reductions", "distance", "null space left", "sum error")


def _entries(row: FilterRow) -> list[str]:
    return [
        row.filter, f"{row.setup_seconds:.2g}", f"{row.seconds:.2e}", str(row.messages), str(row.reductions),
        f"{row.distance:.2e}", f"{row.null_space_share:.0e}", f"{row.sum_error:.0e}",
    ]  # fmt: skip

"""Tells what is drawn: scene, steps, filters and their names; and how ranks share what one process computes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from mpipic.errors import NotConverged

if TYPE_CHECKING:
    from mpi4py import MPI

    from mpipic.scene.records import Scene

FILTERS: Mapping[str, Mapping[str, Any]] = {
    "unfiltered": {"kind": "none"},
    "svd": {"kind": "svd"},
    "local": {"kind": "local"},
}
"""The filters that the paper compares: name in its figures here to the scene's section [filter]."""
GROWING: Mapping[str, Mapping[str, Any]] = {
    "svd": {"kind": "exact", "tolerance": 1e-10},
    "order 2": {"kind": "order", "order": 2},
    "local": {"kind": "local"},
    "unfiltered": {"kind": "none"},
}
"""Filters whose growth is computed; the svd by `exact`, the same operator to its tolerance, the costliest first."""


class Growth(Protocol):
    """Growth of a scheme per step, and the step at which rounding noise ends a run."""

    @property
    def growth_per_step(self) -> float:
        """μ - 1."""
        ...

    @property
    def noise_step(self) -> float | None:
        """Step at which rounding noise is as large as the solution; None without growth."""
        ...

    @property
    def blow_up_step(self) -> float | None:
        """Step at which rounding noise ends the run; None without growth."""
        ...


Analyse = Callable[["Scene", "MPI.Comm", int], Growth]
"""Returns the growth of a scene's scheme, whose pattern recurs within so many steps."""


@dataclass(frozen=True)
class Survey:
    """The settings that are tried: flows in units of the sound speed, particles per cell, CFL numbers, and grids.

    Growth is computed on the `cells`, errors at the time `until` on `error_cells`; `boxes` are of several dimensions.

    Every flow brings the particles back to the same places of the grid within `most` steps.
    """

    flows: Sequence[float] = (0.0, 0.1, 0.25, 0.5, 1.0, 2.0)
    per_cell: Sequence[int] = (1, 2, 4, 8)
    cfls: Sequence[float] = (0.1, 0.2, 0.4, 0.8)
    cells: int = 8
    error_cells: int = 32
    box_flow: float = 1.0
    boxes: Sequence[tuple[int, ...]] = ((4,), (4, 4), (3, 3, 3))
    cfl: float = 0.2
    until: float = 0.5
    most: int = 200


@dataclass(frozen=True)
class Plan:
    """Says what is computed.

    Attributes
    ----------
    scene
        The paper's scene, or a smaller one; its filter is replaced.
    steps
        At which the waves are drawn; increasing.
    svd_cells, cells
        Grids on which the svd, and the other filters, are timed.
    survey
        The settings away from the scene's that are tried.
    long_steps
        Steps that the local filter takes to find out where it fails; 0 for none.
    """

    scene: Scene
    steps: Sequence[int] = (0, 700, 1000, 5000)
    svd_cells: Sequence[int] = (50, 100, 200, 400)
    cells: Sequence[int] = (4000, 16000, 64000, 256000)
    long_steps: int = 0
    most_period: int = 1000
    survey: Survey = field(default_factory=Survey)
    filters: Mapping[str, Mapping[str, Any]] = field(default_factory=lambda: FILTERS)

    @property
    def last(self) -> int:
        """Step of the last figure."""
        return self.steps[-1]


def with_filter(scene: Scene, settings: Mapping[str, Any]) -> Scene:
    """Return the scene with another filter."""
    from mpipic.scene.records import Scene

    return Scene.from_dict({**scene.to_dict(), "filter": dict(settings)}, name=scene.name)


def with_values(scene: Scene, **sections: Mapping[str, Any]) -> Scene:
    """Return the scene with other values of some keys, section by section; of the time step, only one is kept."""
    from mpipic.scene.records import Scene

    data = scene.to_dict()
    if "cfl" in sections.get("time", {}):
        data["time"].pop("dt", None)
    for section, values in sections.items():
        data[section] = {**data.get(section, {}), **values}
    return Scene.from_dict(data, name=scene.name)


def spread(comm: MPI.Comm, jobs: Mapping[str, Callable[[], object]]) -> dict[str, object]:
    """Return the results of jobs that take one process each, by name, on all ranks; None where one did not converge.

    Collective: every rank does its share, dealt to and fro.
    """
    mine: dict[str, object] = {}
    for number, (name, job) in enumerate(jobs.items()):
        turn, place = divmod(number, comm.size)
        if comm.rank == (comm.size - 1 - place if turn % 2 else place):
            try:
                mine[name] = job()
            except NotConverged:
                mine[name] = None
    found = {name: result for part in comm.allgather(mine) for name, result in part.items()}
    return {name: found[name] for name in jobs}

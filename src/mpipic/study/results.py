"""The runs of a study summed up: a row for each point, the Pareto front, orders of convergence, CSV and JSON."""

from __future__ import annotations

import math
import statistics
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from mpipic.files import write_csv
from mpipic.plots.work_precision import Mark
from mpipic.scene.records import Scene
from mpipic.study.file import NORMS, QUANTITIES, Study
from mpipic.study.journal import COMPLETED, UNSTABLE, Errors, Machine, Record
from mpipic.study.pareto import Fit, fit_order, front
from mpipic.study.points import Axis, Point
from mpipic.wording import show

CSV, JSON = "study.csv", "study.json"
NOT_RUN = "not run"
ABOVE_FLOOR, FEWEST = 10.0, 3
"""Errors count for an order from so many times the floor on, and so many of them make one."""
CELLS = "grid.cells"


@dataclass(frozen=True)
class Spread:
    """Median, least and largest over the repeats."""

    median: float
    least: float
    largest: float

    @classmethod
    def over(cls, values: Sequence[float]) -> Spread:
        """Return the spread of at least one value."""
        return cls(statistics.median(values), min(values), max(values))


@dataclass
class Row:
    """A point and what its runs say; what was not measured is None. Times in seconds, memory in bytes.

    Attributes
    ----------
    status
        completed, unstable, timeout, crashed, not converged, refused, or not run.
    seconds, total_seconds
        Time of stepping, and of everything within the process; until it blew up, of an unstable point.
    error
        At the end, in the norm of the study; None unless completed.
    on_front
        Whether no completed point is faster and as accurate, or more accurate and as fast.
    """

    point: Point
    status: str
    message: str = ""
    repeats: int = 0
    seconds: Spread | None = None
    total_seconds: Spread | None = None
    phases: dict[str, float] = field(default_factory=dict)
    rate: float | None = None
    peak_memory: int | None = None
    steps: int | None = None
    time: float | None = None
    particles: int | None = None
    nodes: int | None = None
    errors: Errors = field(default_factory=dict)
    error: float | None = None
    on_front: bool = False

    @property
    def is_stable(self) -> bool:
        """Whether it completed with an error that is a number."""
        return self.status == COMPLETED and self.error is not None

    @property
    def whole_seconds(self) -> float | None:
        """Stepping seconds of all steps, at the pace of those that were taken before a blow-up."""
        if self.seconds is None or not self.steps:
            return None
        return float(self.seconds.median * self.point.scene.time.steps / self.steps)


def row_of(point: Point, runs: Sequence[Record], norm: str) -> Row:
    """Sum up the runs of a point: the first that did not complete decides its status, else all of them count."""
    failed = next((run for run in runs if run["status"] != COMPLETED), None)
    counted = [failed] if failed else list(runs)
    if not counted:
        return Row(point, NOT_RUN)
    first = counted[0]
    row = Row(point, first["status"], first.get("message", ""), len(runs))
    row.steps, row.time = first.get("steps"), first.get("time")
    row.particles, row.nodes = first.get("particles"), first.get("nodes")
    row.peak_memory = max(run["peak_memory"] for run in counted) or None
    clocks = [clock for run in counted if (clock := run.get("seconds"))]
    if clocks:
        row.seconds = Spread.over([clock["step"] for clock in clocks])
        row.total_seconds = Spread.over([clock["total"] for clock in clocks])
        names = clocks[0]["phases"]
        row.phases = {name: statistics.median(clock["phases"].get(name, 0.0) for clock in clocks) for name in names}
        row.rate = statistics.median([run.get("particle_steps_per_second") or 0.0 for run in counted])
    if errors := first.get("errors"):
        row.errors = {quantity: errors[quantity] for quantity in QUANTITIES}
        quantity, measure = norm.split(".")
        error = row.errors[quantity][measure]
        row.error = error if error is not None and math.isfinite(error) else None
    return row


def sum_up(study: Study, runs: Sequence[Sequence[Record]]) -> list[Row]:
    """Return a row for each point of the study, those on the Pareto front marked."""
    rows = [row_of(point, of_it, study.settings.error) for point, of_it in zip(study.points, runs, strict=True)]
    stable, pairs = stable_pairs(rows)
    for index in front(pairs):
        stable[index].on_front = True
    return rows


def stable_pairs(rows: Sequence[Row]) -> tuple[list[Row], list[tuple[float, float]]]:
    """Return the rows that may be recommended, and their (seconds, error)."""
    stable = [row for row in rows if row.is_stable and row.seconds]
    return stable, [(row.seconds.median, row.error) for row in stable if row.seconds and row.error is not None]


# ------------------------------------------------------------ convergence


@dataclass(frozen=True)
class Order:
    """Observed order of convergence of points that differ only in grid.cells; `left_out` of them are at the floor."""

    label: str
    fit: Fit
    left_out: int


def floor(scene: Scene, steps: int) -> float:
    """Return an estimate of the error that no scheme gets below: rounding that adds up over steps, and the solver's.

    2.2e-16 steps + the tolerances of its solvers, for solutions of size 1, as the profiles are.
    """
    solvers = sum(float(value) for key, value in scene.values.items() if key.endswith(".tolerance"))
    return sys.float_info.epsilon * steps + solvers


def orders(rows: Sequence[Row]) -> list[Order]:
    """Return orders of convergence wherever at least three errors are ten times above the floor."""
    families: dict[str, list[Row]] = {}
    for row in rows:
        if CELLS in row.point.values and row.is_stable and row.error:
            families.setdefault(row.point.apart_from(CELLS), []).append(row)
    found = []
    for family in families.values():
        good = [row for row in family if (row.error or 0.0) > ABOVE_FLOOR * floor(row.point.scene, row.steps or 0)]
        h = [min(row.point.scene.h) for row in good]
        if len(set(h)) >= FEWEST:
            fit = fit_order(h, [row.error or 0.0 for row in good])
            found.append(Order(_family_label(good[0].point), fit, len(family) - len(good)))
    return found


def _family_label(point: Point) -> str:
    rest = [part for part in point.resolution.split(", ") if part and not part.endswith(" cells")]
    return ", ".join(filter(None, (point.scheme, *rest))) or "all points"


# ------------------------------------------------------------ files

MEASURED = (
    "id", "label", "status", "ranks", "particles", "nodes", "h", "dt", "cfl", "steps", "time",
    *(f"{quantity}_{norm}" for quantity in QUANTITIES for norm in NORMS),
    "repeats", "seconds", "seconds_min", "seconds_max", "total_seconds", "total_seconds_min", "total_seconds_max",
    "particle_steps_per_second", "peak_memory", "on_front", "message",
)  # fmt: skip


def columns(row: Row) -> dict[str, str | float | None]:
    """Return what was measured at a point, by column of the tables."""
    point = row.point
    return {
        "id": point.id, "label": point.label, "scheme": point.scheme, "resolution": point.resolution,
        "status": row.status, "ranks": point.ranks, "particles": row.particles, "nodes": row.nodes,
        "h": min(point.scene.h), "dt": point.scene.dt, "cfl": point.scene.cfl, "steps": row.steps, "time": row.time,
        **{f"{quantity}_{norm}": row.errors.get(quantity, {}).get(norm) for quantity in QUANTITIES for norm in NORMS},
        "repeats": row.repeats,
        **_spread("seconds", row.seconds), **_spread("total_seconds", row.total_seconds),
        "particle_steps_per_second": row.rate, "peak_memory": row.peak_memory, "on_front": row.on_front,
        "message": row.message,
    }  # fmt: skip


def _spread(name: str, spread: Spread | None) -> dict[str, float | None]:
    """Return the columns of a median with its least and largest value; None where nothing was measured."""
    values = (spread.median, spread.least, spread.largest) if spread else (None, None, None)
    return dict(zip((name, f"{name}_min", f"{name}_max"), values, strict=True))


def write_table(path: Path, study: Study, rows: Sequence[Row]) -> None:
    """Write one line of CSV a point: the values of the axes, what was measured, the seconds of each phase."""
    axes = [axis.name for axis in study.axes if axis.name != "ranks"]
    phases = list(dict.fromkeys(name for row in rows for name in row.phases))
    lines = []
    for row in rows:
        measured = columns(row)
        values = [*(row.point.values[name] for name in axes), *(measured[name] for name in MEASURED)]
        lines.append([_entry(value) for value in [*values, *(row.phases.get(name) for name in phases)]])
    write_csv(path, [*axes, *MEASURED, *(f"seconds_{name}" for name in phases)], lines)


def _entry(value: object) -> str | float | None:
    """Write lists and truth values as scene files do; the rest is as it is."""
    return value if value is None or isinstance(value, (str, float)) else show(value)


@dataclass(frozen=True)
class Origin:
    """Where results come from: the command that reproduces them, the machine, and the versions of what ran there."""

    command: str
    machine: Machine
    versions: Mapping[str, str]


def content(study: Study, rows: Sequence[Row], runs: Sequence[Sequence[Record]], origin: Origin) -> dict[str, object]:
    """Return everything, for study.json."""
    points = []
    for row, of_it in zip(rows, runs, strict=True):
        scene = row.point.scene.to_dict()
        brief = [{key: value for key, value in run.items() if key not in ("machine", "versions")} for run in of_it]
        values = {"values": row.point.values, "phases": row.phases, "scene": scene, "runs": brief}
        points.append({**columns(row), **values})
    return {
        "title": study.title,
        "settings": study.settings.model_dump(),
        "axes": [axis.name for axis in study.axes],
        **asdict(origin),
        "points": points,
        "orders": [{"label": order.label, **asdict(order.fit), "left_out": order.left_out} for order in orders(rows)],
    }


# ------------------------------------------------------------ for the picture


def joined(study: Study) -> Axis | None:
    """Return the axis along which the picture joins points: grid.cells, else the first that refines schemes."""
    refining = [axis for axis in study.axes if axis.refines and len(axis.choices) > 1]
    return next((axis for axis in refining if axis.name == CELLS), next(iter(refining), None))


def marks(study: Study, rows: Sequence[Row]) -> list[Mark]:
    """Return what belongs in the picture: completed points, and unstable ones at the time that all steps would take."""
    axis = joined(study)
    found = []
    for row in rows:
        scheme, line = row.point.scheme or study.title, row.point.apart_from(axis.name if axis else "")
        if row.is_stable and row.seconds and row.error:
            spread = (row.seconds.least, row.seconds.largest)
            found.append(Mark(scheme, line, row.seconds.median, spread, row.error, row.on_front))
        elif row.status == UNSTABLE and row.whole_seconds:
            found.append(Mark(scheme, line, row.whole_seconds, (row.whole_seconds,) * 2, None, False))
    return found

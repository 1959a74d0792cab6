"""A study as one HTML page: what report.html.jinja shows, made ready; the template escapes what others have named."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from mpipic.page import embedded, fill
from mpipic.scene.text import write_toml
from mpipic.study.file import Study
from mpipic.study.points import differing
from mpipic.study.results import Order, Origin, Row, columns, orders

REPORT, TEMPLATE = "report.html", "report.html.jinja"
SHOWN = {
    "scheme": "scheme", "resolution": "resolution", "status": "status", "ranks": "ranks", "particles": "particles",
    "steps": "steps", "dt": "dt", "cfl": "CFL",
    "density_l1": "density l1", "density_l2": "density l2", "density_linf": "density l∞",
    "velocity_l1": "velocity l1", "velocity_l2": "velocity l2", "velocity_linf": "velocity l∞",
    "seconds": "seconds of stepping", "seconds_min": "least", "seconds_max": "largest",
    "total_seconds": "total seconds",
    "particle_steps_per_second": "particle-steps/s", "peak_memory": "peak MB", "repeats": "runs", "id": "id",
    "message": "remark",
}  # fmt: skip


@dataclass(frozen=True)
class Entry:
    """An entry of a table: its class, what it shows, and what it is sorted by where that is something else."""

    kind: str
    shown: str
    key: str | None = None


@dataclass(frozen=True)
class TableRow:
    """A row of a table, and its class."""

    kind: str
    entries: tuple[Entry, ...]


def page(study: Study, rows: Sequence[Row], origin: Origin, picture: Path) -> str:
    """Return the page, with the picture in it."""
    return fill(
        "mpipic.study",
        TEMPLATE,
        study=study,
        norm=study.settings.error.replace(".", " "),
        image=embedded(picture),
        points=_points(rows),
        orders=[_order(order) for order in orders(rows)],
        origin=origin,
        differing=", ".join(differing(study.points)),
        shared=_shared(study),
    )


def _points(rows: Sequence[Row]) -> tuple[Iterable[str], list[TableRow]]:
    """Return the headings of the table of points, without those of empty columns, and its lines."""
    measured = [columns(row) for row in rows]
    shown = {key: name for key, name in SHOWN.items() if any(one[key] not in (None, "") for one in measured)}
    lines = []
    for row, one in zip(rows, measured, strict=True):
        kind = "front" if row.on_front else "" if row.is_stable else "failed"
        lines.append(TableRow(kind, tuple(_entry(key, one[key]) for key in shown)))
    return shown.values(), lines


def _order(order: Order) -> TableRow:
    numbers = {"order": round(order.fit.order, 3), "residual": order.fit.residual, "count": order.fit.count,
               "left_out": order.left_out}  # fmt: skip
    return TableRow("", (_entry("label", order.label), *(_entry(key, value) for key, value in numbers.items())))


def _entry(key: str, value: str | float | None) -> Entry:
    if value is None or value == "":
        return Entry("empty", "", "")
    if isinstance(value, str):
        return Entry("message" if key == "message" else "text", value)
    shown = f"{value / 1e6:.0f}" if key == "peak_memory" else f"{value:,}" if isinstance(value, int) else f"{value:.4g}"
    return Entry("number", shown, repr(value))


def _shared(study: Study) -> str:
    """Return the resolved settings that all points have in common, as a scene file."""
    apart = set(differing(study.points))
    scene = tomllib.loads(study.points[0].scene.to_toml())
    tables = {s: {k: v for k, v in table.items() if f"{s}.{k}" not in apart} for s, table in scene.items()}
    return write_toml({section: table for section, table in tables.items() if table})

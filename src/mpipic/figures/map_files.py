"""The wider question as files: the survey's points as CSV, two pictures, and the tables of the page."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from mpipic.figures.claims import number
from mpipic.figures.maps import NEVER, Point, holding
from mpipic.figures.plan import GROWING, Survey
from mpipic.files import write_csv
from mpipic.plots.heat import HeatRow, draw_heat

HEADER = ("part", "filter", "flow", "per_cell", "cfl", "dimension", "growth_per_step", "last_good_step", "error")
STEPS, ERRORS = "map-steps", "map-errors"
ORDER = tuple(reversed(list(GROWING)))
"""Filters in the order of the pictures, from none to the costliest."""
PARTS = ("lattice", "random", "CFL")


def write_maps(folder: Path, survey: Survey, found: Sequence[Point]) -> None:
    """Write maps.csv, map-steps.png and map-errors.png. Local."""
    rows = (
        (p.part, p.filter, p.flow, p.per_cell, p.cfl, p.dim, p.growth, p.last_good_step, p.error) for p in found
    )  # fmt: skip
    write_csv(folder / "maps.csv", HEADER, rows)
    title = "Last good step: rounding noise is then as large as the solution (from growth per step)"
    draw_heat(folder / f"{STEPS}.png", title, _heat_rows(survey, found, _steps), (1e2, 1e6), "never", True)
    title = f"Error of density at t = {survey.until:g} on {survey.error_cells} cells, root mean square"
    draw_heat(folder / f"{ERRORS}.png", title, _heat_rows(survey, found, _error), (1e-2, 1.0), "blown up", False)


def _steps(point: Point) -> float:
    if point.growth is None:
        return np.nan
    return np.inf if point.last_good_step is None else point.last_good_step


def _error(point: Point) -> float:
    return np.nan if point.error is None else point.error if point.error < 1e6 else np.inf


def _heat_rows(survey: Survey, found: Sequence[Point], value: Callable[[Point], float]) -> list[HeatRow]:
    rows = []
    for part in PARTS:
        name, values = ("CFL number", survey.cfls) if part == "CFL" else ("particles per cell", survey.per_cell)
        title = "lattice, 2 a cell" if part == "CFL" else f"{part}, CFL {survey.cfl:g}"
        panels = {}
        for kind in ORDER:
            mine = [
                value(point) for y in values for x in survey.flows for point in found if _is(point, part, kind, x, y)
            ]
            panels[kind] = np.array(mine, dtype=np.float64).reshape(len(values), len(survey.flows))
        rows.append(HeatRow(title, "flow / sound speed", survey.flows, name, values, panels))
    return rows


def _is(point: Point, part: str, kind: str, flow: float, y: float) -> bool:
    """Return whether a point belongs to a part and a filter, and to these values of the two settings."""
    return (point.part, point.filter, point.flow) == (part, kind, flow) and y in (
        point.cfl if part == "CFL" else point.per_cell,
    )


def tables(found: Sequence[Point], steps: int) -> list[Mapping[str, object]]:
    """Return what the page tells of the survey: title, header and rows of words. Local."""
    counted = holding(found, steps)
    shares = {key: f"{good} of {of}" for key, (good, of) in counted.items()}
    count = [(kind, *(shares.get((part, kind), "-") for part in PARTS)) for kind in ORDER]
    boxes = sorted({(p.part, p.dim) for p in found if p.part.startswith("dimensions")})
    growth = {(p.filter, p.part, p.dim): p.growth for p in found}
    header = ("filter", *(f"{dim}D, {part.removeprefix('dimensions, ')}" for part, dim in boxes))
    rows = [(kind, *(_growth(growth[kind, part, dim]) for part, dim in boxes)) for kind in ORDER]
    return [
        {"title": f"Settings that hold for {steps:,} steps", "header": ("filter", *PARTS), "rows": count},
        {"title": "Growth per step in one, two and three dimensions", "header": header, "rows": rows},
    ]


def _growth(value: float | None) -> str:
    return "not found" if value is None else "none" if value <= NEVER else number(value)

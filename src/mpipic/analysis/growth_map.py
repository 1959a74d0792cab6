"""Stability maps: growth per step over two keys of a scene, one panel for each filter."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from mpi4py import MPI

from mpipic.agreement import on_first
from mpipic.analysis.filter_choice import Choice
from mpipic.analysis.growth import analyse
from mpipic.analysis.recurrence import nearest_flows
from mpipic.analysis.writing import make_folder
from mpipic.arrays import FloatArray
from mpipic.console import Console
from mpipic.errors import NotConverged
from mpipic.files import write_csv
from mpipic.parts import alternatives
from mpipic.scene.records import Problem, Scene, SceneError
from mpipic.wording import closest

BORDER = 1e-6
"""Growth per step that the line in the picture stands for."""
MOST_POINTS = 10_000
COLUMNS = ("filter", "x", "y", "flow", "growth_per_step", "period_steps", "blow_up_step", "status")


@dataclass(frozen=True)
class MapAxis:
    """A dotted key and the values that it takes."""

    key: str
    values: tuple[float, ...]


@dataclass(frozen=True)
class MapPoint:
    """A point of a map: growth is None where `status` says why there is none."""

    filter: str
    x: float
    y: float
    flow: tuple[float, ...]
    growth: float | None
    period: int | None
    blow_up: float | None
    status: str


def parse_axis(text: str) -> MapAxis:
    """Read KEY=a:b:n, n values evenly from a to b; raises SceneError."""
    key, equals, span = text.partition("=")
    try:
        first, last, number = span.split(":")
        ends, count = (float(first), float(last)), int(number)
        if not equals or not 1 <= count <= MOST_POINTS or not np.isfinite(ends).all():
            raise ValueError
    except ValueError:
        rule = f"two numbers and a whole number from 1 to {MOST_POINTS}, like gas.flow=0:0.5:6"
        raise SceneError([Problem("--map", text, f"must read KEY=FROM:TO:COUNT with {rule}")]) from None
    values = tuple(round(float(value), 12) for value in np.linspace(*ends, count))
    if len({*values}) < count:
        raise SceneError([Problem("--map", text, f"its {count} values must differ")])
    return MapAxis(key.strip(), values)


def check_axes(scene: Scene, axes: Sequence[MapAxis], panels: int) -> None:
    """Raise SceneError, before any point is computed, with all that is wrong with the axes of a map for this scene."""
    keys = [axis.key for axis in axes]
    problems = []
    if len(axes) != 2 or keys[0] == keys[-1]:
        problems.append(Problem("--map", None, f"a map needs two different keys; given are {', '.join(keys)}"))
    elif keys[1] in alternatives(keys[0]):
        problems.append(Problem("--map", None, f"{keys[0]} and {keys[1]} say the same: a map takes one of them"))
    points = math.prod(len(axis.values) for axis in axes) * panels
    if points > MOST_POINTS:
        problems.append(Problem("--map", None, f"a map has at most {MOST_POINTS} points; these are {points}"))
    for axis in axes if not problems else ():
        problems += _problems_of(scene, axis)
    if problems:
        raise SceneError(problems)


def _problems_of(scene: Scene, axis: MapAxis) -> list[Problem]:
    """Return what is wrong with an axis: a key that cannot vary, or values that the scene does not take."""
    varying = [key for key, value in scene.values.items() if _number(value) is not None and not _is_fixed(key)]
    varying += [other for key in varying for other in alternatives(key)]
    if axis.key not in varying:
        rule = "is no number of this scene that growth depends on"
        return [Problem(f"--map {axis.key}", None, rule, tuple(varying), closest(axis.key, varying))]
    if isinstance(_number(scene.values[axis.key]), int):
        broken = [value for value in axis.values if not value.is_integer()]
        if broken:
            return [Problem(f"--map {axis.key}", broken[0], "takes whole numbers alone")]
    for value in axis.values:
        try:
            with_value(scene, axis.key, value)
        except SceneError as error:
            return [replace(problem, key=f"--map {problem.key}") for problem in error.problems]
    return []


def _number(value: object) -> float | None:
    """Return a value of a scene, or the first of a list, if it is a number."""
    first = value[0] if isinstance(value, tuple) and value else value
    return first if isinstance(first, int | float) and not isinstance(first, bool) else None


def _is_fixed(key: str) -> bool:
    """Return whether a key changes no growth, or is what the panels of a map differ in."""
    return key.split(".")[0] in ("filter", "output") or key == "time.steps"


def with_value(scene: Scene, key: str, value: float) -> Scene:
    """Return the scene with another value; of a list with one entry per axis, the first is changed."""
    data = scene.to_dict()
    section, _, name = key.partition(".")
    if key == "time.cfl":
        data["time"].pop("dt", None)
    if key == "time.dt":
        data["time"].pop("cfl", None)
    present = data.get(section, {}).get(name)
    whole = isinstance(present, int) or (isinstance(present, list) and isinstance(present[0], int))
    number = round(value) if whole else value
    data.setdefault(section, {})[name] = [number, *present[1:]] if isinstance(present, list) else number
    return Scene.from_dict(data, name=scene.name)


def with_flow(scene: Scene, most: int) -> Scene:
    """Return the scene with the nearest flow that recurs within `most` steps."""
    flow = nearest_flows(scene, most)[0]
    data = scene.to_dict()
    data["gas"]["flow"] = list(flow)
    return Scene.from_dict(data, name=scene.name)


def points(
    scene: Scene, axes: Sequence[MapAxis], choices: Sequence[Choice], comm: MPI.Comm, most: int
) -> Iterator[MapPoint]:
    """Yield every point, filter by filter; flows are rounded to the nearest that recur in `most` steps. Collective."""
    for choice in choices:
        for x, y in product(axes[0].values, axes[1].values):
            flow: tuple[float, ...] = ()
            try:
                placed = with_value(with_value(scene, axes[0].key, x), axes[1].key, y)
                data = placed.to_dict()
                data["filter"] = {"kind": choice.kind, **choice.settings}
                rounded = with_flow(Scene.from_dict(data, name=scene.name), most)
                flow = tuple(rounded.gas.flow)
                growth = analyse(rounded, comm, most)
            except (NotConverged, SceneError) as error:
                why = "refused" if isinstance(error, SceneError) else "not converged"
                yield MapPoint(choice.label, x, y, flow, None, None, None, f"{why}: {error}")
                continue
            yield MapPoint(
                choice.label, x, y, flow, growth.growth_per_step, growth.period_steps, growth.blow_up_step, "found"
            )


def run(
    scene: Scene,
    axes: Sequence[MapAxis],
    choices: Sequence[Choice],
    comm: MPI.Comm,
    console: Console,
    output: Path,
    most: int,
) -> list[MapPoint]:
    """Compute the map; write stability-map.csv and stability-map.png into `output`. Collective."""
    make_folder(output, comm)
    found: list[MapPoint] = []
    for point in points(scene, axes, choices, comm, most):
        found.append(point)
        value = point.status if point.growth is None else f"{point.growth:.3e}"
        console.message(f"{point.filter}: {axes[0].key} {point.x:g}, {axes[1].key} {point.y:g}: {value}")
    on_first(comm, lambda: _write(output / "stability-map.csv", axes, found))
    on_first(comm, lambda: _draw(output / "stability-map.png", axes, found, f"{scene.name}: growth per step"))
    console.message(f"map of {len(found)} points in {output}")
    return found


def _draw(path: Path, axes: Sequence[MapAxis], found: Sequence[MapPoint], title: str) -> None:
    from mpipic.plots.growth_map import Scale, draw_map

    x, y = (Scale(axis.key, np.array(axis.values)) for axis in axes)
    draw_map(path, x, y, by_filter(axes, found), BORDER, title)


def by_filter(axes: Sequence[MapAxis], found: Sequence[MapPoint]) -> dict[str, FloatArray]:
    """Return name of a filter to growth, (nx, ny) for the values of the two axes, nan where none was found."""
    growth: dict[str, FloatArray] = {}
    for point in found:
        values = growth.setdefault(point.filter, np.full((len(axes[0].values), len(axes[1].values)), np.nan))
        if point.growth is not None:
            values[axes[0].values.index(point.x), axes[1].values.index(point.y)] = point.growth
    return growth


def _write(path: Path, axes: Sequence[MapAxis], found: Sequence[MapPoint]) -> None:
    names = {"x": axes[0].key, "y": axes[1].key, "flow": "flow taken"}
    rows = ((p.filter, p.x, p.y, " ".join(map(repr, p.flow)), p.growth, p.period, p.blow_up, p.status) for p in found)
    write_csv(path, [names.get(column, column) for column in COLUMNS], rows)

"""Stability maps: growth per step over two keys of a scene, one panel for each filter."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from mpi4py import MPI

from mpipic.analysis.filter_choice import Choice
from mpipic.analysis.growth import analyse
from mpipic.analysis.recurrence import nearest_flows
from mpipic.arrays import FloatArray
from mpipic.console import Console
from mpipic.errors import NotConverged
from mpipic.files import write_csv
from mpipic.scene.records import Problem, Scene, SceneError

BORDER = 1e-6
"""Growth per step that the line in the picture stands for."""
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
        first, last, count = span.split(":")
        values = np.linspace(float(first), float(last), int(count))
        if not equals or int(count) < 1 or not np.isfinite(values).all():
            raise ValueError
    except ValueError:
        rule = "must read KEY=FROM:TO:COUNT with two numbers and a whole number above 0, like gas.flow=0:0.5:6"
        raise SceneError([Problem("--map", text, rule)]) from None
    return MapAxis(key, tuple(round(float(value), 12) for value in values))


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
            placed = with_value(with_value(scene, axes[0].key, x), axes[1].key, y)
            data = placed.to_dict()
            data["filter"] = {"kind": choice.kind, **choice.settings}
            rounded = with_flow(Scene.from_dict(data, name=scene.name), most)
            flow = tuple(rounded.gas.flow)
            try:
                growth = analyse(rounded, comm, most)
            except NotConverged as error:
                yield MapPoint(choice.label, x, y, flow, None, None, None, f"not converged: {error}")
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
    if len(axes) != 2:
        raise SceneError([Problem("--map", None, f"a map needs two keys; {len(axes)} given")])
    found = []
    for point in points(scene, axes, choices, comm, most):
        found.append(point)
        value = point.status if point.growth is None else f"{point.growth:.3e}"
        console.message(f"{point.filter}: {axes[0].key} {point.x:g}, {axes[1].key} {point.y:g}: {value}")
    if comm.rank == 0:
        output.mkdir(parents=True, exist_ok=True)
        _write(output / "stability-map.csv", axes, found)
        _draw(output / "stability-map.png", axes, found, f"{scene.name}: growth per step")
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

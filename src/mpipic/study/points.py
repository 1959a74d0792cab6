"""Points of a study: every combination of the choices of its axes, as scenes that end at the same physical time."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import mpipic.run.parts  # noqa: F401  all that scenes can name
from mpipic.parts import EXACT_SOLUTION, alternatives, sections
from mpipic.run.ranks import check_ranks
from mpipic.scene.records import Problem, Scene, SceneError
from mpipic.wording import show

RESOLUTION = ("grid.cells", "particles.per_cell", "time.cfl", "time.dt")
"""Keys that refine a scheme instead of making another one of it."""
SCHEME, RANKS = "scheme", "ranks"
MOST_STEPS = 10**9

Values = dict[str, object]
"""Dotted scene key, or ranks, to value."""
Sections = Mapping[str, Mapping[str, object]]
"""Name of a section to its keys and values."""


@dataclass(frozen=True)
class Choice:
    """One value of an axis: what tables call it, and the scene keys (and ranks) that it sets."""

    value: object
    settings: Values


NOTHING = (Choice("", {}),)
"""Stands for the choices of an axis that cannot be used, so that the points can be checked without it."""


@dataclass(frozen=True)
class Axis:
    """Choices that are swept together under one name: a scene key, ranks, or a name of its own."""

    name: str
    choices: tuple[Choice, ...]

    @property
    def keys(self) -> set[str]:
        """All that any of its choices sets."""
        return {key for choice in self.choices for key in choice.settings}

    @property
    def refines(self) -> bool:
        """Whether its choices are resolutions of one scheme, and not schemes."""
        return bool(self.keys) and self.keys <= set(RESOLUTION)


@dataclass(frozen=True)
class Point:
    """One combination of choices: a scene to run on so many ranks.

    Attributes
    ----------
    values
        Axis name -> value.
    scheme, resolution
        In words, the choices that make the scheme, and those that refine it; axes of one choice are left out.
    """

    values: Values
    scheme: str
    resolution: str
    scene: Scene
    ranks: int

    @property
    def id(self) -> str:
        """A digest of all that the run depends on: the resolved scene and the number of ranks."""
        content = json.dumps([self.scene.to_dict(), self.ranks], sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:12]

    @property
    def label(self) -> str:
        """Scheme and resolution, as tables call the point."""
        return ", ".join(filter(None, (self.scheme, self.resolution))) or "the only point"

    def apart_from(self, axis: str) -> str:
        """Return a text that is equal for points of one dimension that differ only in the value of this axis."""
        rest = {name: value for name, value in self.values.items() if name != axis}
        return json.dumps([self.scene.dim, rest], sort_keys=True, default=str)


def fit_steps(until: float, dt: float) -> tuple[int, float]:
    """Return the fewest steps of at most `dt`, and their dt, for which steps times dt is `until` to the last bit.

    About half of all numbers of steps have such a dt, so that a few steps may be added.
    """
    fewest = max(1, math.ceil(until / dt * (1 - 1e-12)))
    for steps in range(fewest, fewest + 1000):
        near = until / steps
        for candidate in (near, math.nextafter(near, 0.0), math.nextafter(near, math.inf)):
            if steps * candidate == until:
                return steps, candidate
    return fewest, until / fewest


def words(key: str, value: object) -> str:
    """Return a value as labels show it: `64 cells`, `2 x 2 a cell`, `CFL 0.1`, `2 ranks`, `local`, `order 5`."""
    if isinstance(value, str):
        return value
    text = " x ".join(map(show, value)) if isinstance(value, (list, tuple)) else show(value)
    if key == RANKS:
        return f"{text} rank{'' if value == 1 else 's'}"
    forms = {"grid.cells": "{} cells", "particles.per_cell": "{} a cell", "time.cfl": "CFL {}", "time.dt": "dt {}"}
    return forms.get(key, key.split(".")[-1].replace("_", " ") + " {}").format(text)


def expand(data: Sections, base: Values, axes: Sequence[Axis], until: float, problems: list[Problem]) -> list[Point]:
    """Return every combination that is a scene; report each problem of the others once, and how many have it."""
    points: list[Point] = []
    found: dict[str, tuple[Problem, list[str]]] = {}
    combinations = list(itertools.product(*(axis.choices for axis in axes)))
    for chosen in combinations:
        scheme, resolution = _labels(axes, chosen)
        settings = {key: value for choice in chosen for key, value in choice.settings.items()}
        asked = settings.pop(RANKS, base.get(RANKS, 1))
        values = {axis.name: choice.value for axis, choice in zip(axes, chosen, strict=True)}
        try:
            scene = _scene(data, {k: v for k, v in base.items() if k != RANKS}, settings, until)
            ranks = _check(scene, asked)
            points.append(Point(values, scheme, resolution, scene, ranks))
        except SceneError as error:
            for problem in error.problems:
                label = ", ".join(filter(None, (scheme, resolution)))
                found.setdefault(str(problem), (problem, []))[1].append(label)
    for problem, labels in found.values():
        problems.append(replace(problem, rule=f"{problem.rule} ({_where(labels, len(combinations))})"))
    return points


def unused(points: Sequence[Point]) -> list[str]:
    """Return what points say and nothing in them uses, each once, with how many say it."""
    found: dict[str, list[str]] = {}
    for point in points:
        for one in point.scene.unused:
            found.setdefault(str(one), []).append(point.label)
    return [f"{text} ({_where(labels, len(points))})" for text, labels in found.items()]


def _where(labels: list[str], total: int) -> str:
    if len(labels) == total:
        return "in every point"
    return f"in {len(labels)} of {total} points, such as {show(labels[0])}"


def _labels(axes: Sequence[Axis], chosen: Sequence[Choice]) -> tuple[str, str]:
    """Return scheme and resolution in words, from the axes that offer a choice."""
    offered = [(axis, choice) for axis, choice in zip(axes, chosen, strict=True) if len(axis.choices) > 1]
    scheme = [words(axis.name, choice.value) for axis, choice in offered if not axis.refines]
    resolution = [words(axis.name, choice.value) for axis, choice in offered if axis.refines]
    return ", ".join(scheme), ", ".join(resolution)


def _scene(data: Sections, base: Values, settings: Values, until: float) -> Scene:
    """Return the scene of one point, with the steps and the dt that end at `until`."""
    merged = {name: dict(table) for name, table in data.items() if name != "output"}
    for layer in (base, settings):
        for key, value in layer.items():
            section, name = key.split(".")
            merged.setdefault(section, {})[name] = value
            for other in alternatives(key):
                if other not in layer:
                    merged[section].pop(other.split(".")[1], None)
    merged["time"] = {**merged.get("time", {}), "steps": 1}
    wanted = Scene.from_dict(merged)
    if until / wanted.dt > MOST_STEPS:
        rule = f"makes more than {MOST_STEPS} steps until {until:g}"
        raise SceneError([Problem("time.dt" if wanted.time.cfl is None else "time.cfl", wanted.dt, rule)])
    steps, dt = fit_steps(until, wanted.dt)
    time = {key: value for key, value in merged["time"].items() if key != "cfl"}
    return Scene.from_dict({**merged, "time": {**time, "dt": dt, "steps": steps}})


def _check(scene: Scene, ranks: object) -> int:
    """Return the number of ranks; raise SceneError if it is none, or the scene cannot be run on it or in a study."""
    if isinstance(ranks, bool) or not isinstance(ranks, int) or ranks < 1:
        raise SceneError([Problem(RANKS, ranks, "must be a whole number, 1 or above")])
    check_ranks(scene, ranks)
    if not scene.values.has(EXACT_SOLUTION):
        raise SceneError([Problem("initial.profile", scene.initial.profile, "has no exact solution to compare with")])
    return ranks


def differing(points: Sequence[Point]) -> Iterator[str]:
    """Yield the scene keys in which the points differ, ranks among them."""
    scenes = [{**_dotted(point.scene), RANKS: point.ranks} for point in points]
    order = [f"{section}.{name}" for section, names in sections().items() for name in names]
    for key in (*order, RANKS):
        if any(scene.get(key) != scenes[0].get(key) for scene in scenes):
            yield key


def _dotted(scene: Scene) -> Values:
    return {f"{section}.{key}": value for section, table in scene.to_dict().items() for key, value in table.items()}

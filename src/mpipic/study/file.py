"""Study files: settings of a scene to sweep, expanded into points that all run to the same physical time.

    title = "Filters against each other"
    scene = "../paper.toml"               # base scene, from the study file's folder; without it, the defaults
    until = 1.0                           # physical time that every point runs to
    repeats = 3                           # runs of a point; the median of their times counts
    error = "density.l2"                  # the norm in tables, picture and recommendations
    timeout = 300.0                       # seconds that one run may take

    [base]                                # what every point changes in the base scene; also ranks
    time.cfl = 0.125
    [axes]                                # every combination of these becomes a point
    filter.kind = ["local", "exact"]
    grid.cells = [[32], [64], [128]]
    ranks = [1, 2]
    layout = [                            # an axis of a name of its own sets several keys together
        { name = "lattice" },
        { name = "jittered", particles.layout = "jittered", particles.jitter = 0.4 },
    ]
    [[scheme]]                            # the same, as tables; combined with every axis
    name = "paper"
    filter.kind = "local"

Keys are those of a scene file, in sections or dotted, and each point is checked as a scene. `time.steps` and `output`
are the study's own: a point takes as many steps of its dt or cfl as `until` needs, and its dt is made to fit.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mpipic.files import Unreadable, read_text
from mpipic.parts import file_keys
from mpipic.scene.records import Problem, Scene, SceneError, with_absolute_paths
from mpipic.scene.text import parse_toml
from mpipic.study.points import NOTHING, RANKS, SCHEME, Axis, Choice, Point, Values, expand
from mpipic.wording import closest, escape, show, show_key

QUANTITIES, NORMS = ("density", "velocity"), ("l1", "l2", "linf")
ERRORS = tuple(f"{quantity}.{norm}" for quantity in QUANTITIES for norm in NORMS)
MOST_POINTS = 10_000
TABLES = ("base", "axes", "scheme")

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Settings(BaseModel):
    """Holds the keys at the top of a study file; each description completes the sentence 'the value must be ...'."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")

    title: str = Field(default="", description="text")
    scene: str = Field(default="", description="the name of a scene file")
    until: Positive = Field(description="a finite number above 0, the physical time that every point runs to")
    repeats: Annotated[int, Field(ge=1, le=1000)] = Field(default=3, description="a whole number from 1 to 1000")
    error: str = Field(default="density.l2", pattern="|".join(map(re.escape, ERRORS)), description=", ".join(ERRORS))
    timeout: Positive = Field(default=300.0, description="a finite number of seconds above 0")


@dataclass(frozen=True)
class Study:
    """A study file, checked and expanded; `source` is its text."""

    name: str
    source: str
    settings: Settings
    axes: tuple[Axis, ...]
    points: tuple[Point, ...]

    @property
    def title(self) -> str:
        """The study's `title`, else the name of its file."""
        return escape(self.settings.title) or self.name


def load(path: Path) -> Study:
    """Read a study file and check every point of it.

    Raises
    ------
    SceneError
        With every mistake in the file and in all points; one that several points share appears once.
    """
    source = _read(path)
    data = parse_toml(source, str(path))
    problems: list[Problem] = []
    settings = _settings(data, problems)
    scene_data = _base_scene(settings.scene, path.parent, problems)
    base = _flat("base", data.get("base", {}), problems)
    axes = _axes(data, problems)
    for table in (base, *(choice.settings for axis in axes for choice in axis.choices)):
        for name in file_keys():
            if isinstance(place := table.get(name), str) and place:
                table[name] = str((path.parent / place).absolute())
    points: list[Point] = []
    if scene_data is not None and math.prod(len(axis.choices) for axis in axes) <= MOST_POINTS:
        points = expand(scene_data, base, axes, settings.until, problems)
    if problems:
        raise SceneError(problems)
    return Study(escape(path.stem), source, settings, tuple(axes), tuple(points))


def _read(path: Path) -> str:
    try:
        return read_text(path)
    except Unreadable as error:
        raise SceneError([Problem(escape(str(path)), None, str(error))]) from None


def _settings(data: Mapping[str, object], problems: list[Problem]) -> Settings:
    """Return the keys at the top; a wrong one is reported and stands at its default: the rest is checked too."""
    fields = Settings.model_fields
    names = (*fields, *TABLES)
    for key in data:
        if key not in names:
            rule = f"there is no such key; a study has {', '.join(names)}; scene keys go into base, axes, scheme"
            problems.append(Problem(show_key(key), None, rule, names, closest(key, names)))
    given = {key: value for key, value in data.items() if key in fields}
    try:
        return Settings.model_validate(given)
    except ValidationError as error:
        wrong = {str(item["loc"][0]) for item in error.errors(include_url=False, include_input=False)}
    for key in sorted(wrong):
        rule = f"must be {'one of ' if key == 'error' else ''}{fields[key].description}"
        choices = ERRORS if key == "error" else ()
        problems.append(Problem(key, given.get(key), rule, choices, closest(given.get(key), choices)))
    return Settings.model_validate({"until": 1.0, **{key: value for key, value in given.items() if key not in wrong}})


def _base_scene(name: str, folder: Path, problems: list[Problem]) -> dict[str, dict[str, object]] | None:
    """Return the base scene's sections as the file gives them; None if it cannot be used."""
    if not name:
        return {}
    path = folder / name
    try:
        Scene.load(path)
        data = parse_toml(_read(path), str(path))
    except SceneError as error:
        problems.extend(
            replace(p, key=p.key if str(path) in p.key else f"scene {name}: {p.key}") for p in error.problems
        )
        return None
    return with_absolute_paths(data, path.parent)


def _flat(where: str, table: object, problems: list[Problem]) -> Values:
    """Return keys of a table as dotted names, whether they stand in sections or are dotted already."""
    if not isinstance(table, Mapping):
        problems.append(Problem(where, table, "must be a table of scene keys, for example filter.kind, and ranks"))
        return {}
    flat: Values = {}
    for name, value in table.items():
        found = {f"{name}.{key}": item for key, item in value.items()} if isinstance(value, Mapping) else {name: value}
        for key, item in found.items():
            rule = "is set twice, in a section and dotted" if key in flat else _reserved(key)
            if rule:
                problems.append(Problem(f"{where}: {escape(key)}", item, rule))
            else:
                flat[key] = item
    return flat


def _reserved(key: str) -> str | None:
    """Return why a study cannot set this key, if so; whether a scene has it is for the scene to say."""
    if key == "time.steps" or key.split(".")[0] == "output":
        return "is the study's own: every point takes the steps that `until` needs, and reports at the last"
    if key != RANKS and not re.fullmatch(r"[^.]+\.[^.]+", key):
        return "must be a scene key, section.key, for example filter.kind, or ranks"
    return None


def _axes(data: Mapping[str, object], problems: list[Problem]) -> list[Axis]:
    """Return the schemes, as the first axis, and the axes; report those that are empty, repeat or contradict others."""
    axes = []
    if SCHEME in data:
        axes.append(_named_axis(SCHEME, data[SCHEME], problems))
    table = data.get("axes", {})
    if not isinstance(table, Mapping):
        problems.append(Problem("axes", table, "must be a table of lists, for example grid.cells = [[32], [64]]"))
        table = {}
    for name, value in table.items():
        entries = {f"{name}.{k}": v for k, v in value.items()} if isinstance(value, Mapping) else {name: value}
        for key, choices in entries.items():
            own_name = "." not in key and key != RANKS
            axes.append(_named_axis(key, choices, problems) if own_name else _key_axis(key, choices, problems))
    count = math.prod(len(axis.choices) for axis in axes)
    if count > MOST_POINTS:
        problems.append(Problem("axes", None, f"make {count} points; a study has at most {MOST_POINTS}"))
    for first, second in itertools.combinations(axes, 2):
        for key in sorted(first.keys & second.keys) or ([first.name] if first.name == second.name else []):
            problems.append(Problem(escape(key), None, f"is set by {escape(first.name)} and by {escape(second.name)}"))
    return axes


def _key_axis(key: str, values: object, problems: list[Problem]) -> Axis:
    where = f"axes: {escape(key)}"
    rule = _reserved(key)
    given = values if isinstance(values, list) else []
    if rule is None and not given:
        rule = 'must be a list of at least one value, for example filter.kind = ["local"] or grid.cells = [[32], [64]]'
    elif rule is None and len({repr(value) for value in given}) < len(given):
        rule = "must not hold a value twice"
    if rule:
        problems.append(Problem(where, values, rule))
        return Axis(key, NOTHING)
    return Axis(key, tuple(Choice(value, {key: value}) for value in given))


def _named_axis(name: str, tables: object, problems: list[Problem]) -> Axis:
    where = "[[scheme]]" if name == SCHEME else f"axes: {escape(name)}"
    if not (isinstance(tables, list) and tables and all(isinstance(table, Mapping) for table in tables)):
        rule = (
            'must be a scene key, ranks, or a list of tables with a name, such as { name = "fine", grid.cells = [64] }'
        )
        problems.append(Problem(where, tables, rule))
        return Axis(name, NOTHING)
    names = [table.get("name") for table in tables]
    if not all(isinstance(own, str) and own for own in names) or len(set(names)) < len(names):
        problems.append(Problem(where, names, "every one needs a name, text that no other one has"))
        return Axis(name, NOTHING)
    found = []
    for table in tables:
        settings = {key: value for key, value in table.items() if key != "name"}
        found.append(Choice(table["name"], _flat(f"{where} {show(table['name'])}", settings, problems)))
    return Axis(name, tuple(found))

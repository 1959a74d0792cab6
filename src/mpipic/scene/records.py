"""Scene files: TOML read into frozen records, with every mistake found at once.

A `Scene` says what a run does and nothing about how: no MPI, no PETSc, no arrays. Its sections hold the keys of the
parts that it names, see `mpipic.parts`, as given or at their defaults, which may depend on the dimension, the number of
entries of ``grid.cells``. Times, lengths and densities are in any consistent units.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from mpipic import parts
from mpipic.arguments import told
from mpipic.files import Unreadable, read_text
from mpipic.parts import Part, Values
from mpipic.scene.checks import check
from mpipic.scene.presets import check_preset, with_preset
from mpipic.scene.text import Problem, SceneError, Unused, apply_overrides, parse_toml, write_toml
from mpipic.wording import closest, escape

__all__ = ["Problem", "Scene", "SceneError", "Section", "Unused", "with_absolute_paths"]


class Section:
    """The keys of one section that the chosen parts take, as attributes; frozen."""

    __slots__ = ("_values",)
    _values: dict[str, Any]

    def __init__(self, values: Mapping[str, Any]) -> None:
        object.__setattr__(self, "_values", dict(values))

    def __getattr__(self, name: str) -> Any:
        try:
            return object.__getattribute__(self, "_values")[name]
        except KeyError:
            raise AttributeError(f"no chosen part has a key {name}") from None

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"a scene is frozen: {name} cannot be set")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Section) and self._values == other._values

    def __hash__(self) -> int:
        return hash(tuple(self._values.items()))

    def __reduce__(self) -> tuple[type[Section], tuple[dict[str, Any]]]:
        return Section, (self._values,)

    def __repr__(self) -> str:
        return f"Section({self._values!r})"

    def to_dict(self) -> dict[str, Any]:
        """Return the keys and values, in plain JSON types, without those that are not given."""
        pairs = ((name, value) for name, value in self._values.items() if value is not None)
        return {name: list(value) if isinstance(value, tuple) else value for name, value in pairs}


@dataclass(frozen=True)
class Scene:
    """Everything a scene file says, checked and complete. Make one with `load`, `from_toml` or `from_dict`.

    Two scenes are equal when all values are; the name does not count.
    """

    values: Values = field(default_factory=lambda: Values(check({}, [])[0]))
    name: str = field(default="paper", compare=False)
    unused: tuple[Unused, ...] = field(default=(), compare=False)

    def __getattr__(self, name: str) -> Section:
        if name.startswith("_") or name == "values" or name not in self._sections:
            raise AttributeError(f"the scene has no section {name}")
        return self._sections[name]

    def __hash__(self) -> int:
        return hash(tuple(self.values.items()))

    @cached_property
    def _sections(self) -> dict[str, Section]:
        found: dict[str, dict[str, Any]] = {}
        for dotted, value in self.values.items():
            section, name = dotted.split(".")
            found.setdefault(section, {})[name] = value
        return {section: Section(table) for section, table in found.items()}

    @classmethod
    def load(cls, path: Path | str | None, overrides: Sequence[str] = (), preset: str | None = None) -> Scene:
        """Read a scene file, or the defaults for None, and apply overrides such as ``filter.kind=none``.

        An override of time.dt takes the place of a time.cfl in the file, and the other way round. A preset, a name in
        `mpipic.scene.presets`, takes the place of the file's scheme before that.

        Raises
        ------
        SceneError
            With every mistake in the file and the overrides, or the reason why the file cannot be read.
        """
        if preset is not None:
            check_preset(preset)
        if path is None:
            return cls.from_dict(with_preset({}, preset) if preset is not None else {}, overrides, name="paper")
        path = Path(path)
        data = parse_toml(_read(path), str(path))
        data = with_preset(data, preset) if preset is not None else data
        return cls.from_dict(with_absolute_paths(data, path.parent), overrides, name=path.stem)

    @classmethod
    def from_toml(cls, text: str, overrides: Sequence[str] = ()) -> Scene:
        """Make a scene named "scene" from the text of a scene file; see `load`."""
        return cls.from_dict(parse_toml(text, "scene"), overrides)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], overrides: Sequence[str] = (), name: str = "scene") -> Scene:
        """Make a scene from sections of keys and values, as `to_dict` returns them; see `load`. Not modified.

        NumPy's numbers, truth values, text and arrays count as Python's.
        """
        if not isinstance(data, Mapping):
            raise TypeError(f"data must be sections by name, each of values by key, not {told(data)}")
        if isinstance(overrides, str):
            raise TypeError(f"overrides must be a list of texts such as 'filter.kind=none', not {told(overrides)}")
        problems: list[Problem] = []
        merged = with_absolute_paths(apply_overrides(data, overrides, problems), Path())
        values, unused = check(merged, problems)
        return cls(Values(values), escape(name), tuple(unused))

    def having(self, **sections: Mapping[str, Any]) -> Scene:
        """Return the scene with other values of keys that it has, which are not checked."""
        other = {f"{section}.{name}": value for section, table in sections.items() for name, value in table.items()}
        return Scene(Values({**self.values, **other}), self.name, self.unused)

    def to_dict(self) -> dict[str, dict[str, Any]]:
        """Return every value in plain JSON types; of time.dt and time.cfl the one that the scene gives."""
        return {name: section.to_dict() for name, section in self._sections.items()}

    def to_toml(self) -> str:
        """Return a scene file with every value written out; `from_toml` makes an equal scene of it."""
        return write_toml(self.to_dict())

    def part(self, slot: str) -> type[Part]:
        """Return the part that the scene names for a slot, such as ``filter.kind``."""
        return self.values.part(slot)

    def settings(self, slot: str) -> dict[str, Any]:
        """Return the values of the keys that this part takes, by name."""
        return self.values.settings(self.values.part(slot))

    @property
    def dim(self) -> int:
        """Number of axes, 1 to 3."""
        return self.values.dim

    @cached_property
    def h(self) -> tuple[float, ...]:
        """Node spacing per axis, length / cells."""
        return self.values.h

    @cached_property
    def dt(self) -> float:
        """Time step, as given or cfl min(h) / signal speed."""
        return self.values.dt

    @cached_property
    def cfl(self) -> float:
        """Cells that the fastest signal travels in a step, relative to the particles."""
        return self.values.cfl

    @property
    def duration(self) -> float:
        """Time simulated, steps times dt."""
        return float(self.time.steps * self.dt)

    @property
    def cell_count(self) -> int:
        """Number of cells, equal to that of nodes in a periodic box."""
        return self.values.cell_count

    @property
    def particle_count(self) -> int | None:
        """Number of particles; None when a file decides."""
        return self.values.particle_count


def _read(path: Path) -> str:
    try:
        return read_text(path)
    except Unreadable as error:
        near = None if path.is_file() else closest(path.name, _scene_files(path.parent))
        suggestion = str(path.parent / near) if near else None
        raise SceneError([Problem(escape(str(path)), None, str(error), (), suggestion)]) from None


def _scene_files(folder: Path) -> list[str]:
    try:
        return sorted(entry.name for entry in folder.glob("*.toml"))
    except (OSError, ValueError):
        return []


def with_absolute_paths(data: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return a copy of `data` in which file names start at the root instead of at `folder`."""
    result = dict(data)
    for dotted in parts.file_keys():
        section, name = dotted.split(".")
        table = result.get(section)
        if isinstance(table, Mapping) and isinstance(table.get(name), str) and table[name]:
            result[section] = {**table, name: str((folder / table[name]).absolute())}
    return result

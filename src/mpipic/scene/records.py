"""Scene files: TOML read into frozen records, with every mistake found at once.

A `Scene` says what a run does and nothing about how: no MPI, no PETSc, no arrays. What a scene leaves out has the
default of the records below, which say what each key means. Times, lengths and densities are in any consistent units.

In 1D the defaults are those shown. In 2D and 3D (the dimension is the number of entries of ``grid.cells``) what is not
given becomes: ``length`` 1 per axis, ``flow`` 0.05 along x and 0 along the others, ``center`` the middle of the box (in
1D too), ``wave`` (1, 0, 0), or (1, 1, 1) for a standing wave, ``per_cell`` 2 per axis, or 4 in all for random.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from mpipic.files import Unreadable, read_text
from mpipic.mesh.decomposition import process_grid
from mpipic.scene.checks import CHOICES, FIXED_FOR_NOW, USED_WITH, available, check
from mpipic.scene.presets import PRESETS, with_preset
from mpipic.scene.rules import particle_count, spacing
from mpipic.scene.text import Problem, SceneError, apply_overrides, closest, escape, parse_toml, write_toml

__all__ = ["CHOICES", "FIXED_FOR_NOW", "USED_WITH", "Problem", "Scene", "SceneError", "available", "process_grid"]

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]
CountOrZero = Annotated[int, Field(ge=0)]
SmallOrder = Annotated[int, Field(ge=1, le=8)]
SmallOrderOrZero = Annotated[int, Field(ge=0, le=8)]
EvenOrder = Annotated[int, Field(ge=2, le=12, multiple_of=2)]
Steps = Annotated[tuple[CountOrZero, ...], AfterValidator(lambda steps: tuple(sorted(set(steps))))]

_ABOVE_0 = "a finite number above 0"
_FROM_0 = "a whole number, 0 or above"
_FROM_1 = "a whole number, 1 or above"
_CHOICE = "one of the names in CHOICES"


def _axes(default: tuple[Any, ...], description: str) -> Any:
    return Field(default, min_length=1, max_length=3, description=description)


class Section(BaseModel):
    """A section of a scene file; each description completes the sentence 'the value must be ...'."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")


class GridSection(Section):
    """Periodic box of uniform cells: `cells` per axis (1 to 3 axes, fewer than 2^31 in all), `length` per axis."""

    cells: tuple[Count, ...] = _axes((100,), "a list of 1 to 3 whole numbers, each 1 or above, for example [100]")
    length: tuple[Positive, ...] = _axes((1.0,), "a list of finite numbers above 0, one per axis, for example [1.0]")


class ParticlesSection(Section):
    """Where the particles start.

    `layout`; `per_cell`, per axis, or for random one number, the average per cell; `jitter`, for layout jittered, the
    largest displacement in particle spacings; `seed` for what is drawn at random; for layout file the `path` of an HDF5
    file with position (n, d) and optional density (n,), velocity (n, d). A relative path in a scene file starts at that
    file's folder, one in an override at the working directory; the record holds it absolute.
    """

    layout: str = Field(default="lattice", description=_CHOICE)
    per_cell: tuple[Count, ...] = _axes((2,), "a list of whole numbers, each 1 or above, for example [2]")
    jitter: NotNegative = Field(default=0.0, description="a finite number, 0 or above")
    seed: CountOrZero = Field(default=0, description="a whole number from 0 to 2^63 - 1")
    path: str = Field(default="", description="the name of a file")


class GasSection(Section):
    """Background state: `sound_speed` c, uniform velocity `flow` v per axis, `density` rho_0."""

    sound_speed: Positive = Field(default=1.0, description=_ABOVE_0)
    flow: tuple[Finite, ...] = _axes((0.05,), "a list of finite numbers, one per axis, for example [0.05]")
    density: Positive = Field(default=1.0, description=_ABOVE_0)


class InitialSection(Section):
    """Initial density: `profile`; exp(-`sharpness` |x - `center`|^2) over all images, or `wave` periods per axis."""

    profile: str = Field(default="gaussian", description=_CHOICE)
    center: tuple[Finite, ...] = _axes((0.5,), "a list of finite numbers, one per axis, for example [0.5]")
    sharpness: Positive = Field(default=60.0, description=_ABOVE_0)
    wave: tuple[int, ...] = _axes((1,), "a list of whole numbers, periods per axis, for example [1]")


class MappingSection(Section):
    """Particles to nodes and back: B-spline `basis`, `mass` matrix, `gradient`; the other keys belong to one choice."""

    basis: str = Field(default="linear", description=_CHOICE)
    mass: str = Field(default="lumped", description=_CHOICE)
    penalty: Positive = Field(default=0.1, description=_ABOVE_0)
    penalty_order: SmallOrder = Field(default=4, description="a whole number from 1 to 8")
    gradient: str = Field(default="direct", description=_CHOICE)
    gradient_order: EvenOrder = Field(default=10, description="an even whole number from 2 to 12")


class FilterSection(Section):
    """The null-space filter: `kind`; number of terms `order`; relative residual `tolerance` of its solver."""

    kind: str = Field(default="local", description=_CHOICE)
    order: Count = Field(default=2, description=_FROM_1)
    tolerance: Annotated[float, Field(gt=0, lt=1)] = Field(default=1e-10, description="a number above 0 and below 1")


class DampingSection(Section):
    """Of grid-scale waves: `order` of the low-pass, 0 for none, and its `strength`; of noise in the `null_space`.

    Both rates are per cell that sound travels: of the shortest wave a step takes the share strength c dt / h, of what
    particles hold beside their nodal fields null_space c dt / h, but at most all.
    """

    order: SmallOrderOrZero = Field(default=0, description="a whole number from 0 to 8")
    strength: Positive = Field(default=1.0, description=_ABOVE_0)
    null_space: Annotated[float, Field(ge=0, allow_inf_nan=False)] = Field(
        default=0.0, description="a finite number, 0 or above"
    )


class TimeSection(Section):
    """Either `dt` or `cfl` = c dt / min h, the other is None; the run ends unstable at `blow_up` times the start."""

    dt: Positive | None = Field(default=1.25e-3, description=_ABOVE_0)
    cfl: Positive | None = Field(default=None, description=_ABOVE_0)
    blow_up: Annotated[float, Field(gt=1, allow_inf_nan=False)] = Field(
        default=100.0, description="a finite number above 1"
    )
    steps: CountOrZero = Field(default=1000, description=_FROM_0)
    integrator: str = Field(default="symplectic", description=_CHOICE)


class OutputSection(Section):
    """Steps between snapshots and between checkpoints, 0 for none; steps `report_at` to report on.

    At those steps errors are recorded, and the share of the density gradient that no node sees, which costs about as
    much as a step with the exact filter; at the last step errors always are.
    """

    every: CountOrZero = Field(default=0, description=_FROM_0)
    checkpoint_every: CountOrZero = Field(default=0, description=_FROM_0)
    report_at: Steps = Field(
        default=(), description="a list of whole numbers, each 0 or above, for example [100, 1000]"
    )


@dataclass(frozen=True)
class Scene:
    """Everything a scene file says, checked and complete. Make one with `load`, `from_toml` or `from_dict`.

    Two scenes are equal when all values are; the name does not count.
    """

    grid: GridSection = field(default_factory=GridSection)
    particles: ParticlesSection = field(default_factory=ParticlesSection)
    gas: GasSection = field(default_factory=GasSection)
    initial: InitialSection = field(default_factory=InitialSection)
    mapping: MappingSection = field(default_factory=MappingSection)
    filter: FilterSection = field(default_factory=FilterSection)
    damping: DampingSection = field(default_factory=DampingSection)
    time: TimeSection = field(default_factory=TimeSection)
    output: OutputSection = field(default_factory=OutputSection)
    name: str = field(default="paper", compare=False)

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
        if preset is not None and preset not in PRESETS:
            choices = tuple(PRESETS)
            rule = "must be one of " + ", ".join(choices)
            raise SceneError([Problem("--preset", preset, rule, choices, closest(preset, choices))])
        if path is None:
            return cls.from_dict(with_preset({}, preset) if preset else {}, overrides, name="paper")
        path = Path(path)
        data = parse_toml(_read(path), str(path))
        data = with_preset(data, preset) if preset else data
        return cls.from_dict(_with_absolute_path(data, path.parent), overrides, name=path.stem)

    @classmethod
    def from_toml(cls, text: str, overrides: Sequence[str] = ()) -> Scene:
        """Make a scene named "scene" from the text of a scene file; see `load`."""
        return cls.from_dict(parse_toml(text, "scene"), overrides)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], overrides: Sequence[str] = (), name: str = "scene") -> Scene:
        """Make a scene from sections of keys and values, as `to_dict` returns them; see `load`. Not modified."""
        problems: list[Problem] = []
        merged = _with_absolute_path(apply_overrides(data, overrides, problems), Path())
        values = check(merged, SECTIONS, problems)
        sections: dict[str, Any] = {
            section: model.model_validate({key: values[f"{section}.{key}"] for key in model.model_fields})
            for section, model in SECTIONS.items()
        }
        return cls(name=name, **sections)

    def to_dict(self) -> dict[str, dict[str, Any]]:
        """Return every value in plain JSON types; of time.dt and time.cfl the one that the scene gives."""
        return {section: getattr(self, section).model_dump(mode="json", exclude_none=True) for section in SECTIONS}

    def to_toml(self) -> str:
        """Return a scene file with every value written out; `from_toml` makes an equal scene of it."""
        return write_toml(self.to_dict())

    @property
    def dim(self) -> int:
        """Number of axes, 1 to 3."""
        return len(self.grid.cells)

    @property
    def h(self) -> tuple[float, ...]:
        """Node spacing per axis, length / cells."""
        return spacing(self.grid.length, self.grid.cells)

    @property
    def dt(self) -> float:
        """Time step, as given or cfl min(h) / sound_speed."""
        if self.time.dt is not None:
            return self.time.dt
        assert self.time.cfl is not None
        return self.time.cfl * min(self.h) / self.gas.sound_speed

    @property
    def cfl(self) -> float:
        """Cells that sound travels in a step, sound_speed dt / min(h)."""
        return self.gas.sound_speed * self.dt / min(self.h) if self.time.cfl is None else self.time.cfl

    @property
    def duration(self) -> float:
        """Time simulated, steps times dt."""
        return self.time.steps * self.dt

    @property
    def cell_count(self) -> int:
        """Number of cells, equal to that of nodes in a periodic box."""
        return math.prod(self.grid.cells)

    @property
    def particle_count(self) -> int | None:
        """Number of particles; None when a file decides."""
        if self.particles.layout == "file":
            return None
        return particle_count(self.grid.cells, self.particles.per_cell)

    def check_ranks(self, size: int) -> None:
        """Raise SceneError when the cells cannot be divided among `size` ranks; names the nearest count below."""
        if process_grid(self.grid.cells, size) is not None:
            return
        rule = "must be at least 1"
        if size > 1:
            fewer = min(size - 1, self.cell_count)
            while process_grid(self.grid.cells, fewer) is None:
                fewer -= 1
            cells = list(self.grid.cells)
            rule = f"cannot divide grid.cells = {cells} into blocks; the nearest smaller number that can is {fewer}"
        raise SceneError([Problem("number of ranks", size, rule)])


SECTIONS: dict[str, type[Section]] = {
    "grid": GridSection,
    "particles": ParticlesSection,
    "gas": GasSection,
    "initial": InitialSection,
    "mapping": MappingSection,
    "filter": FilterSection,
    "damping": DampingSection,
    "time": TimeSection,
    "output": OutputSection,
}


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


def _with_absolute_path(data: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return a copy of `data` in which particles.path starts at the root."""
    result = dict(data)
    table = result.get("particles")
    if isinstance(table, Mapping) and isinstance(table.get("path"), str) and table["path"]:
        result["particles"] = {**table, "path": str((folder / table["path"]).absolute())}
    return result

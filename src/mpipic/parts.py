"""Parts: what a scene can name, and what each of them says about itself.

A part is a class. It names its slot, the key of a scene that chooses it (``filter.kind``), and its `kind`, the value
that key then has; or, where there is nothing to choose, the section that it is (``gas``). It says which keys it takes,
with defaults, rules and meaning, what it needs of other parts, what it leaves unused, how to describe itself, the
memory it takes and what it brings in. Scenes, `mpipic check`, messages and the table of keys read all of that from
here; so a new part is one class, imported by `mpipic.run.parts`.

    class Wide(NodalFilter):
        kind = "wide"
        about = "a filter of wide stencils"

        class Settings(Keys):
            width: Count = key(3, FROM_1, "cells on either side")

Importing a part must load nothing heavier than NumPy: no MPI, PETSc, HDF5 or compiled loops.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar, cast

from pydantic import ValidationError

from mpipic.arguments import told
from mpipic.keys import Key, Keys, plain
from mpipic.wording import closest, listed

ORDER = (
    "physics.kind", "grid", "particles.layout", "gas", "initial.profile", "mapping.basis", "mapping.mass",
    "mapping.gradient", "filter.kind", "damping", "time", "time.integrator", "output",
)  # fmt: skip
"""Slots in the order of a scene file; others, which a physics brings, come after `gas`."""
OTHERS = ORDER.index("gas")

# What parts of one slot may need to know of another; see `Part.traits`.
A_FILTER = "a filter"
NODAL_FILTER = "a filter with a nodal form"
SOLVED_FILTER = "a filter that solves with the Gram matrix"
NODAL_GRADIENTS = "gradients taken on the nodes"
LEAST_SQUARES = "least-squares fields"
GRAM_SOLVER = "a mass that solves with the Gram matrix itself"
PENALTY = "a mass with a penalty"
SIGNALS = "signals, whose speed is known"
EXACT_SOLUTION = "an exact solution"


class Values(Mapping[str, Any]):
    """Values of a scene by dotted key, of the chosen parts alone, and what follows from them."""

    def __init__(self, found: Mapping[str, Any]) -> None:
        self._found = found

    def __getitem__(self, dotted: str) -> Any:
        return self._found[dotted]

    def __iter__(self) -> Iterator[str]:
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)

    def __repr__(self) -> str:
        return f"Values({self._found!r})"

    def part(self, slot: str) -> type[Part]:
        """Return the part that is chosen for a slot."""
        return choices(slot, self["physics.kind"])[self[slot] if "." in slot else ""]

    def has(self, trait: str) -> bool:
        """Return whether any chosen part has a trait."""
        return any(part.has(trait) for part in chosen(self))

    def settings(self, part: type[Part]) -> dict[str, Any]:
        """Return the values of the keys that a chosen part takes, by their names in its section."""
        return {name: self[one.dotted] for name, one in part.keys().items() if one.dotted in self}

    @property
    def dim(self) -> int:
        """Number of axes, 1 to 3."""
        return len(self["grid.cells"])

    @property
    def h(self) -> tuple[float, ...]:
        """Node spacing per axis, length / cells."""
        return tuple(x / n for x, n in zip(self["grid.length"], self["grid.cells"], strict=True))

    @property
    def cell_count(self) -> int:
        """Number of cells, equal to that of nodes in a periodic box."""
        return math.prod(self["grid.cells"])

    @property
    def particle_count(self) -> int | None:
        """Number of particles, as the layout says; None where a file decides."""
        return self.part("particles.layout").count(self)

    @property
    def signal_speed(self) -> float:
        """Speed of the fastest signal relative to the particles, as the physics says."""
        return self.part("physics.kind").signal_speed_of(self)

    @property
    def dt(self) -> float:
        """Time step, as given or cfl min(h) / signal speed."""
        if self["time.cfl"] is None:
            return float(self["time.dt"])
        return float(self["time.cfl"] * min(self.h) / self.signal_speed)

    @property
    def cfl(self) -> float:
        """Cells that the fastest signal travels in a step."""
        given = self["time.cfl"]
        return self.signal_speed * self.dt / min(self.h) if given is None else float(given)


Broken = tuple[str, str]
"""The key to blame, and what its value has to satisfy."""


@dataclass(frozen=True)
class Rule:
    """Must hold between values: it is tried when `keys` are all there and none of them is wrong."""

    keys: tuple[str, ...]
    broken: Callable[[Values], Broken | None]


def rule(*keys: str) -> Callable[[Callable[[Values], Broken | None]], Rule]:
    """Make a rule of a part out of a function of the values that returns what is broken, or None."""
    return lambda function: Rule(keys, function)


# ---------------------------------------------------------------- parts

_registered: list[type[Part]] = []


class Part:
    """Base of all parts; a subclass that names its `kind`, or a section as its slot, is registered.

    Attributes
    ----------
    slot
        The dotted key that chooses the part, or the section that the part is.
    kind
        The value of that key.
    about
        One line for the table of keys.
    is_default
        Whether it is chosen where a scene names none.
    physics
        The `physics.kind` that it belongs to; None: any.
    brings_in
        What `mpipic check` lists as left out where no part brings it in.
    argument
        The key that may follow the kind after a colon, where parts are named in words, as in order:5.
    traits
        What parts of other slots may rely on, besides those of the base classes.
    either
        Keys of which a scene gives one; the first has the default.
    """

    slot: ClassVar[str] = ""
    kind: ClassVar[str] = ""
    about: ClassVar[str] = ""
    is_default: ClassVar[bool] = False
    physics: ClassVar[str | None] = None
    brings_in: ClassVar[tuple[str, ...]] = ()
    argument: ClassVar[str | None] = None
    traits: ClassVar[tuple[str, ...]] = ()
    either: ClassVar[tuple[str, ...]] = ()

    class Settings(Keys):
        """The keys that the part takes in its section."""

    def __init_subclass__(cls, **keywords: object) -> None:
        super().__init_subclass__(**keywords)
        own = vars(cls)
        if own.get("kind") or ("slot" in own and "." not in cls.slot):
            if find(cls.slot, cls.kind, cls.physics) is not None:
                raise ValueError(f"there is a part {cls.slot} = {cls.kind!r} already")
            _registered.append(cls)
            _registered.sort(key=_place)

    @classmethod
    def section(cls) -> str:
        """Return the section of a scene that the part's keys are in."""
        return cls.slot.split(".")[0]

    @classmethod
    def keys(cls) -> dict[str, Key]:
        """Return the keys that the part takes, by their names in its section."""
        return {name: Key(f"{cls.section()}.{name}", info) for name, info in cls.Settings.model_fields.items()}

    @classmethod
    def has(cls, trait: str) -> bool:
        """Return whether the part has a trait, of its own or from a base class."""
        return any(trait in vars(base).get("traits", ()) for base in cls.__mro__)

    @classmethod
    def rules(cls) -> list[Rule]:
        """Return what the part needs and excludes."""
        return [item for base in reversed(cls.__mro__) for item in vars(base).values() if isinstance(item, Rule)]

    @classmethod
    def idle(cls, v: Values) -> Mapping[str, str]:
        """Return the part's own keys that do nothing with these values, each with the reason."""
        return {}

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return a few words for the banner and `mpipic check`."""
        return cls.kind

    @classmethod
    def pace(cls, v: Values) -> str:
        """Return what a physics says of its time step beside the CFL number; nothing: ""."""
        return ""

    @classmethod
    def brings(cls, v: Values) -> tuple[str, ...]:
        """Return those of `brings_in` that the part brings in with these values."""
        return cls.brings_in

    @classmethod
    def solvers(cls, v: Values) -> tuple[str, ...]:
        """Return how PETSc's options of the part's solvers begin: prefix and class, such as filter_ksp."""
        return ()

    @classmethod
    def node_doubles(cls, v: Values) -> int:
        """Return the numbers of 8 bytes that the part keeps on every node."""
        return 0

    @classmethod
    def particle_doubles(cls, v: Values) -> int:
        """Return the numbers of 8 bytes that every particle carries for the part."""
        return 0

    @classmethod
    def count(cls, v: Values) -> int | None:
        """Return the number of particles; None where none is known."""
        return None

    @classmethod
    def signal_speed_of(cls, v: Values) -> float:
        """Return the speed of the fastest signal relative to the particles; 0 where there are none."""
        return 0.0


def find(slot: str, kind: str, physics: str | None) -> type[Part] | None:
    """Return the registered part of this slot and kind for a physics, or None."""
    same = (part for part in _registered if (part.slot, part.kind) == (slot, kind))
    return next((part for part in same if part.physics in (None, physics)), None)


def forget(part: type[Part]) -> None:
    """Take a part out of the registry again."""
    _registered.remove(part)


def registered() -> Sequence[type[Part]]:
    """Return all parts in the order of a scene file; the choices of a slot in the order in which they were made."""
    return tuple(_registered)


def _place(part: type[Part]) -> float:
    return ORDER.index(part.slot) if part.slot in ORDER else OTHERS + 0.5


def sections() -> dict[str, list[str]]:
    """Return every section of a scene, of any physics, with all keys that any part takes there, choosers first."""
    found: dict[str, list[str]] = {}
    for part in registered():
        keys = found.setdefault(part.section(), [])
        own = [*part.slot.split(".")[1:], *part.keys()]
        keys += [name for name in own if name not in keys]
    return found


def slots(physics: str | None) -> list[str]:
    """Return the slots that a scene of this physics has, in the order of a scene file."""
    return list(dict.fromkeys(part.slot for part in registered() if part.physics in (None, physics)))


def choices(slot: str, physics: str | None) -> dict[str, type[Part]]:
    """Return what a scene of this physics can choose for a slot, kind to part; a plain section has the kind ""."""
    return {part.kind: part for part in registered() if part.slot == slot and part.physics in (None, physics)}


def kinds_with(slot: str, trait: str, physics: str | None) -> list[str]:
    """Return the choices for a slot that have a trait."""
    return [kind for kind, part in choices(slot, physics).items() if part.has(trait)]


def default_of(slot: str, physics: str | None) -> str:
    """Return the kind that a scene has where it names none."""
    return next(kind for kind, part in choices(slot, physics).items() if vars(part).get("is_default") or not kind)


def chosen(v: Values) -> list[type[Part]]:
    """Return the parts of a scene, in the order of a scene file; without those whose name is wrong."""
    physics = v["physics.kind"]
    named = [(choices(slot, physics), v.get(slot, "")) for slot in slots(physics)]
    return [parts[kind] for parts, kind in named if isinstance(kind, str) and kind in parts]


def settings_of(part: type[Part], known: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a part's keys from those known by their names in its section; the rest at the default."""
    return {name: known.get(name, one.default) for name, one in part.keys().items()}


def checked_settings(part: type[Part], given: Mapping[str, object]) -> dict[str, Any]:
    """Return values of a part's keys as numbers of Python, by their names in its section, of those given.

    Raises ValueError naming each that breaks its rule, and the rule.
    """
    values = {name: plain(value) for name, value in given.items()}
    try:
        known = part.Settings.model_validate(values).model_dump()
        return {name: known[name] for name in values}
    except ValidationError as error:
        wrong = dict.fromkeys(str(item["loc"][0]) for item in error.errors(include_url=False, include_input=False))
        keys = part.keys()
        rules = [f"{name} must be {keys[name].rule}, not {told(given[name])}" for name in wrong]
        raise ValueError("; ".join(rules)) from None


def file_keys() -> list[str]:
    """Return the dotted keys that name files."""
    return [one.dotted for part in registered() for one in part.keys().values() if one.is_file]


def alternatives(dotted: str) -> list[str]:
    """Return the keys that giving this one takes the place of."""
    groups = [[f"{part.section()}.{name}" for name in part.either] for part in registered()]
    return [other for group in groups if dotted in group for other in group if other != dotted]


P = TypeVar("P", bound=Part)


class Choices(Mapping[str, type[P]], Generic[P]):
    """A live view of the registered parts that derive from `base`, kind to class."""

    def __init__(self, base: type) -> None:
        self._base = base

    def __getitem__(self, kind: str) -> type[P]:
        found = self._parts()
        if kind not in found:
            near = closest(kind, list(found))
            raise KeyError(
                f"there is no {kind!r}, only {listed(found)}" + (f'; did you mean "{near}"?' if near else "")
            )
        return found[kind]

    def __iter__(self) -> Iterator[str]:
        return iter(self._parts())

    def __len__(self) -> int:
        return len(self._parts())

    def _parts(self) -> dict[str, type[P]]:
        return {part.kind: part for part in cast(Iterable[type[P]], registered()) if issubclass(part, self._base)}

"""Keys of scenes: the types that their values can have, and how a part declares them."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel, ConfigDict, Field
from pydantic.fields import FieldInfo

if TYPE_CHECKING:
    from mpipic.parts import Values

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(gt=0, lt=1)]
Count = Annotated[int, Field(ge=1)]
CountOrZero = Annotated[int, Field(ge=0)]
UpTo1000 = Annotated[int, Field(ge=1, le=1000)]
UpTo8 = Annotated[int, Field(ge=1, le=8)]
UpTo8OrZero = Annotated[int, Field(ge=0, le=8)]
EvenUpTo12 = Annotated[int, Field(ge=2, le=12, multiple_of=2)]

ABOVE_0 = "a finite number above 0"
NOT_BELOW_0 = "a finite number, 0 or above"
IN_0_1 = "a number above 0 and below 1"
FROM_0 = "a whole number, 0 or above"
FROM_1 = "a whole number, 1 or above"


class Keys(BaseModel):
    """Base of every part's `Settings`: the keys that it takes in its section, each made by `key`."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")


@dataclass(frozen=True)
class ByScene:
    """A default that depends on the scene: on its dimension, or on the values of `needs`; `text` says how."""

    text: str
    of: Callable[[Values], Any]
    needs: tuple[str, ...] = ()


def key(
    default: object, rule: str, meaning: str, *, unit: str = "", per_axis: bool = False, is_file: bool = False
) -> Any:
    """Declare a key of a part.

    Parameters
    ----------
    default
        A value, or how it follows from the scene.
    rule
        Completes the sentence 'the value must be ...'.
    meaning, unit
        One line for the table of keys.
    per_axis
        Whether the value is a list with an entry per axis.
    is_file
        Whether it names a file, from the folder of the scene that says so.
    """
    extra: dict[str, Any] = {"unit": unit, "per_axis": per_axis, "is_file": is_file}
    if isinstance(default, ByScene):
        extra["by_scene"], default = default, None
    limits: dict[str, Any] = {"min_length": 1, "max_length": 3} if per_axis else {}
    return Field(default, title=meaning, description=rule, json_schema_extra=extra, **limits)


@dataclass(frozen=True)
class Key:
    """A key of a part, as `key` declared it."""

    dotted: str
    info: FieldInfo

    @property
    def rule(self) -> str:
        """Completes the sentence 'the value must be ...'."""
        return self.info.description or ""

    @property
    def meaning(self) -> str:
        """One line for the table of keys, with the unit."""
        unit = self._extra.get("unit")
        return f"{self.info.title} ({unit})" if unit else self.info.title or ""

    @property
    def default(self) -> Any:
        """The default, or a `ByScene`."""
        return self._extra.get("by_scene", self.info.default)

    @property
    def per_axis(self) -> bool:
        """Whether the value has an entry per axis."""
        return bool(self._extra.get("per_axis"))

    @property
    def is_file(self) -> bool:
        """Whether it names a file."""
        return bool(self._extra.get("is_file"))

    @property
    def _extra(self) -> dict[str, Any]:
        extra = self.info.json_schema_extra
        return extra if isinstance(extra, dict) else {}


def is_normal(*numbers: float) -> bool:
    """Return whether all are above 0, and both they and their inverses are numbers of full precision."""
    least = sys.float_info.min
    return all(least <= number <= 1 / least for number in numbers)


def plain(value: Any, depth: int = 3) -> Any:
    """Return lists as tuples, down to a depth that no key has, and arrays and numbers of NumPy as Python's."""
    value = value.tolist() if hasattr(value, "tolist") else value
    if depth and isinstance(value, (list, tuple)):
        return tuple(plain(item, depth - 1) for item in value)
    # a longdouble remains one
    return float(value) if hasattr(value, "dtype") and value.dtype.kind == "f" and value.ndim == 0 else value

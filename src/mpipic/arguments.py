"""Arguments of the library's callers, as it works with them, or refused: by name, with what was given and the rule.

All of it looks at types and shapes, never at the numbers of an array, and costs no more for a million of them than for
one. Plain arrays; no ranks: `mesh.agreement` lets all ranks raise together.
"""

from __future__ import annotations

import numbers
import operator
from collections.abc import Iterable, Mapping, Sequence, Set
from typing import SupportsIndex, cast

import numpy as np
import numpy.typing as npt

from mpipic.arrays import FloatArray, Shape
from mpipic.wording import closest, listed

MOST_AXES = 8
"""The most axes that the value of one particle or node may have."""

RealArray = npt.NDArray[np.generic]
"""An array of real numbers of any type: whole, floating-point, or boolean."""


def told(given: object) -> str:
    """Return what was given, in a few words: the shape and type of an array, else the value."""
    if isinstance(given, np.ndarray):
        return f"an array of shape {given.shape} and type {given.dtype}"
    if isinstance(given, (str, numbers.Number, np.generic)) or given is None:
        return repr(given)[:80]
    return f"{type(given).__name__} {repr(given)[:80]}"


# ---------------------------------------------------------------- single values


def axes_of(name: str, given: object) -> list[object]:
    """Return the entries of an argument that has one for each of one to three axes."""
    try:
        if isinstance(given, (str, bytes, Mapping, Set)):
            raise TypeError
        return list(cast(Iterable[object], given))
    except TypeError:
        raise TypeError(f"{name} must be a list with one entry an axis, such as [8], not {told(given)}") from None


def whole_number(name: str, given: object, least: int) -> int:
    """Return a whole number, Python's or NumPy's, that is not below `least`."""
    wrong = isinstance(given, (bool, np.bool_)) or not isinstance(given, numbers.Integral)
    if wrong or operator.index(cast(SupportsIndex, given)) < least:
        raise (TypeError if wrong else ValueError)(
            f"{name} must be a whole number, {least} or above, not {told(given)}"
        )
    return operator.index(cast(SupportsIndex, given))


def real_number(name: str, given: object, rule: str = "a number") -> float:
    """Return a real number, Python's or NumPy's."""
    if isinstance(given, (bool, np.bool_)) or not isinstance(given, numbers.Real):
        raise TypeError(f"{name} must be {rule}, not {told(given)}")
    try:
        return float(given)
    except OverflowError:
        raise ValueError(f"{name} must be {rule}, not {told(given)}") from None


def choice(name: str, given: object, known: Sequence[str]) -> str:
    """Return one of the known names."""
    if isinstance(given, str) and given in known:
        return given
    near = closest(given, known)
    text = f"{name} must be {listed(known, 'or')}, not {told(given)}"
    raise (ValueError if isinstance(given, str) else TypeError)(text + (f'; did you mean "{near}"?' if near else ""))


# ---------------------------------------------------------------- arrays


def real_array(name: str, given: object) -> RealArray:
    """Return an array of real numbers of the type that was given; complex, masked, text and objects are refused.

    Raises
    ------
    TypeError
    """
    if isinstance(given, np.ma.MaskedArray):
        raise TypeError(f"{name} must not be a masked array: masks are not known here; give the numbers alone")
    try:
        array = np.asarray(given)
    except Exception as error:
        raise TypeError(f"{name} must be an array of real numbers, not {told(given)}: {error}") from None
    if array.dtype.kind not in "biuf":
        raise TypeError(f"{name} must be an array of real numbers, not {told(given if array.ndim == 0 else array)}")
    return array if array.dtype.isnative else array.astype(array.dtype.newbyteorder("="))


def rows(name: str, given: object, count: int, last: int | None = None) -> RealArray:
    """Return the values of `count` particles, (count, *shape); where `last` is given, that is how shape must end.

    Of no particles an array (0,) will do for values of any shape.
    """
    array = real_array(name, given)
    if count == 0 and array.shape == (0,):
        return array if last is None else np.empty((0, last))
    fits = array.ndim > 0 and len(array) == count and (last is None or (array.ndim > 1 and array.shape[-1] == last))
    if not fits or array.ndim > MOST_AXES + 1:
        end = "" if last is None else f", {last}"
        forms = f"({count},) or ({count}, ...)" if last is None else f"({count}, ...{end})"
        raise ValueError(
            f"{name} must have shape {forms}, a row for each of this rank's {count} particles and at most "
            f"{MOST_AXES} axes more, not {array.shape}"
        )
    return array


def positions(name: str, given: object, dim: int, count: int | None = None) -> FloatArray:
    """Return vectors, one a particle, as (n, d), n = `count` if known; of no particles an array (0,) will do."""
    array = real_array(name, given)
    if array.shape == (0,):
        array = array.reshape(0, dim)
    if array.ndim != 2 or array.shape[1] != dim or count not in (None, len(array)):
        turned = "; rows are particles, columns are axes: transpose it" if array.shape[:1] == (dim,) else ""
        turned = f"; {name}[:, None] has it" if dim == 1 and array.ndim == 1 else turned
        n = "n" if count is None else count
        raise ValueError(f"{name} must have shape ({n}, {dim}), one row a particle, not {array.shape}{turned}")
    return np.asarray(array, dtype=np.float64)


def nodal_rows(name: str, given: object, nodes: int, own: Shape, last: int | None = None) -> RealArray:
    """Return nodal values, (nodes, *shape), own and ghost nodes; where `last` is given, that is how shape must end."""
    array = real_array(name, given)
    fits = array.ndim > 0 and len(array) == nodes and (last is None or (array.ndim > 1 and array.shape[-1] == last))
    if not fits or array.ndim > MOST_AXES + 1:
        forms = f"({nodes},) or ({nodes}, ...)" if last is None else f"({nodes}, ..., {last})"
        cut = "; own nodes alone, as Grid.owned shows them, do not do" if array.shape[: len(own)] == own else ""
        raise ValueError(f"{name} must have shape {forms}, a row for each own and ghost node, not {array.shape}{cut}")
    return array


def nodal_array(name: str, given: object, nodes: int, own: Shape, in_place: bool) -> npt.NDArray[np.generic]:
    """Return a nodal array (nodes, *shape) itself, to look into or, `in_place`, to be changed."""
    if not isinstance(given, np.ndarray) or isinstance(given, np.ma.MaskedArray):
        raise TypeError(f"{name} must be a NumPy array of shape ({nodes}, ...), not {told(given)}")
    nodal_rows(name, given, nodes, own)
    if in_place and not (given.dtype == np.float64 and given.flags.c_contiguous and given.flags.writeable):
        flaw = given.dtype if given.flags.c_contiguous and given.flags.writeable else "not, or is read-only"
        raise TypeError(f"{name} is changed in place: it must be a C-contiguous array of float64, and is {flaw}")
    return given

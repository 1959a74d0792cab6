"""Arguments of the library's callers, as it works with them, or refused: by name, with what was given and the rule.

All of it looks at types and shapes, never at the numbers of an array, and costs no more for a million of them than for
one. Plain arrays; no ranks: `mesh.agreement` lets all ranks raise together.
"""

from __future__ import annotations

import numbers
import operator
from collections.abc import Mapping, Sequence, Set

import numpy as np
import numpy.typing as npt

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
        return list(given)  # type: ignore[call-overload, no-any-return]
    except TypeError:
        raise TypeError(f"{name} must be a list with one entry an axis, such as [8], not {told(given)}") from None


def whole_number(name: str, given: object, least: int) -> int:
    """Return a whole number, Python's or NumPy's, that is not below `least`."""
    wrong = isinstance(given, (bool, np.bool_)) or not isinstance(given, numbers.Integral)
    if wrong or operator.index(given) < least:  # type: ignore[arg-type]
        raise (TypeError if wrong else ValueError)(
            f"{name} must be a whole number, {least} or above, not {told(given)}"
        )
    return operator.index(given)  # type: ignore[arg-type]


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
    """Return an array of real numbers of whatever type was given; complex, masked, text and objects are refused.

    Raises
    ------
    TypeError
    """
    if isinstance(given, np.ma.MaskedArray):
        raise TypeError(f"{name} must not be a masked array: masks are not known here; give the numbers alone")
    try:
        array = np.asarray(given)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name} must be an array of real numbers, not {told(given)}: {error}") from None
    if array.dtype.kind not in "biuf":
        what = f"numbers of type {array.dtype}" if array.dtype.kind == "c" else told(given)
        raise TypeError(f"{name} must be an array of real numbers, not {what} (type {array.dtype})")
    return array

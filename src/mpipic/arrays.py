"""Arrays as all rooms write them: types, and values of any shape as columns."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, TypeVar

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Number = TypeVar("Number", bound=np.generic)
Shape = tuple[int, ...]
"""The shape of one value: () for a scalar, (d,) for a vector, (d, d) for a tensor."""


class ParticleArrays(Protocol):
    """The particles of one rank, as files and pictures take them."""

    @property
    def ids(self) -> IntArray:
        """Global ids, (n,)."""
        ...

    @property
    def position(self) -> FloatArray:
        """Positions in units of length, (n, d)."""
        ...

    @property
    def fields(self) -> Mapping[str, FloatArray]:
        """Name to values, (n, *shape)."""
        ...


def columns_of(values: npt.ArrayLike) -> FloatArray:
    """Return values (n, *shape) as floats in a C-contiguous array (n, k), one column a component.

    Copied only where needed. Whole numbers become the nearest floats, as NumPy makes them: above 2^53 digits get lost.
    """
    return side_by_side(np.asarray(values, dtype=np.float64))


def side_by_side(values: npt.NDArray[Number]) -> npt.NDArray[Number]:
    """Return values (n, *shape) as a C-contiguous array (n, k) of the same type; copied only where needed."""
    return np.ascontiguousarray(values.reshape(len(values), size_of(values.shape[1:])))


def size_of(shape: Shape) -> int:
    """Return the number of components of a value of this shape."""
    return int(np.prod(shape, dtype=np.int64))

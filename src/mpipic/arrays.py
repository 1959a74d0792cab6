"""Arrays as all rooms write them: types, and values of any shape as columns."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
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
    """Return values (n, *shape) as a C-contiguous array (n, k), one column a component; copied only where needed."""
    array = np.asarray(values, dtype=np.float64)
    return np.ascontiguousarray(array.reshape(len(array), size_of(array.shape[1:])))


def size_of(shape: Shape) -> int:
    """Return the number of components of a value of this shape."""
    return int(np.prod(shape, dtype=np.int64))

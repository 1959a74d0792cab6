"""Arrays as all rooms write them: types, and values of any shape as columns."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


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
    """Values (n,) or (n, k) as a C-contiguous array (n, k), copied only where they are not one."""
    array = np.asarray(values, dtype=np.float64)
    return np.ascontiguousarray(array if array.ndim == 2 else array[:, None])

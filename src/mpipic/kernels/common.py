"""What every compiled loop shares: compiler settings, and where a particle lies in the grid.

The loops read and write flat views of C-contiguous arrays and index them with unsigned integers: the compiler then
drops Python's negative-index rule and sees that neighbouring columns are contiguous, which is what lets it put the
columns of one particle or node into one vector register. Numba leaves that optimisation (superword-level parallelism)
off by default; it halves the time of the three-dimensional loops, so it is switched on here, before anything compiles.

Compiled code is kept between runs. Numba checks the age of the file that a loop is in, but not of the files that it
calls into, so the folder's name carries a digest of all of them: an edited helper can never meet stale callers.
"""

import hashlib
import os
from pathlib import Path

import numba
import numpy as np
from numba import njit


def _cache_folder():
    sources = b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "mpipic" / hashlib.sha256(sources).hexdigest()[:16]


if "NUMBA_SLP_VECTORIZE" not in os.environ:
    numba.config.SLP_VECTORIZE = 1
if "NUMBA_CACHE_DIR" not in os.environ:
    numba.config.CACHE_DIR = str(_cache_folder())

U = np.uintp

# Contraction to fused multiply-add is the only liberty taken with the arithmetic: no reassociation, NaN stays NaN.
hot = njit(cache=True, fastmath={"contract"}, error_model="numpy")
inlined = njit(inline="always")
# No contraction: which cell a particle is in must not depend on where the compiler fuses.
exactly = njit(cache=True, error_model="numpy")


@exactly
def cell_and_fraction(x, tolerance):
    """Cell that coordinate x >= -tolerance (in cells) lies in, and the local coordinate in [0, 1) within it; exact.

    Within `tolerance` of a node x counts as on it and belongs to the right-hand cell.
    """
    c = np.int32(x + tolerance)
    return c, max(x - np.float64(c), 0.0)

"""Every compiled loop shares this: how it is compiled and kept, and where a particle lies in the grid.

The loops read and write flat views of C-contiguous arrays and index them with unsigned integers: the compiler then
drops Python's negative-index rule and sees that neighbouring columns are contiguous, which is what lets it put the
columns of one particle or node into one vector register. Numba leaves that optimisation (superword-level parallelism)
off; it halves the time of the three-dimensional loops, so it is on while a loop of ours compiles, and then as it was.

Compiled code is kept between runs, in a folder of ours. Numba checks the age of the file that a loop is in, but not of
the files that it calls into, so the folder's name carries a digest of all of them: an edited helper can never meet
stale callers. `NUMBA_CACHE_DIR` and `NUMBA_SLP_VECTORIZE` have their usual meaning.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
from numba import config, njit
from numba.core.compiler import Compiler
from numba.core.compiler_lock import global_compiler_lock

from mpipic.kernels.kept import Kept, find_folder

U = np.uintp

Loop = Callable[..., Any]


@contextmanager
def _numba_option(name: str, value: object) -> Iterator[None]:
    """Change one of Numba's options while the block runs, and meanwhile let no other thread compile."""
    with global_compiler_lock:
        before = getattr(config, name)
        setattr(config, name, value)
        try:
            yield
        finally:
            setattr(config, name, before)


class LoopCompiler(Compiler):
    """Compiles as Numba does, and besides puts into one vector register what are neighbours in memory."""

    def compile_extra(self, func):
        """Compile as Numba does, with its option for that switched on."""
        slp = config.SLP_VECTORIZE if "NUMBA_SLP_VECTORIZE" in os.environ else 1
        with _numba_option("SLP_VECTORIZE", slp):
            return super().compile_extra(func)


CACHE = find_folder()


def compiled(**options: object) -> Callable[[Loop], Loop]:
    """Return a decorator: compile a loop when it is first called, without Python objects, and keep it in `CACHE`."""
    options = {"error_model": "numpy", "no_cfunc_wrapper": True, "pipeline_class": LoopCompiler, **options}

    def decorate(function: Loop) -> Loop:
        loop = njit(**options)(function)
        if CACHE:
            with _numba_option("CACHE_DIR", CACHE), suppress(RuntimeError):  # a folder that has gone is no folder
                loop._cache = Kept(function)
        found: Loop = loop
        return found

    return decorate


# Contraction to fused multiply-add is the only liberty taken with the arithmetic: no reassociation, NaN stays NaN.
hot = compiled(fastmath={"contract"})
# No contraction: which cell a particle is in must not depend on where the compiler fuses.
exactly = compiled()
# The same, called by other loops only: no entrance from Python, which takes a good part of the time to compile.
inner = compiled(fastmath={"contract"}, no_cpython_wrapper=True)
inner_exactly = compiled(no_cpython_wrapper=True)
inlined = njit(inline="always")


@inner_exactly
def cell_and_fraction(x, tolerance):
    """Return the cell that coordinate x >= -tolerance (in cells) lies in, and the local coordinate in [0, 1); exact.

    Within `tolerance` of a node x counts as on it and belongs to the right-hand cell.
    """
    c = np.int32(x + tolerance)
    return c, max(x - np.float64(c), 0.0)

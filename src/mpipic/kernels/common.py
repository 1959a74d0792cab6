"""Every compiled loop shares this: how it is compiled and kept, and where a particle lies in the grid.

The loops read and write flat views of C-contiguous arrays and index them with unsigned integers: the compiler then
drops Python's negative-index rule and sees that neighbouring columns are contiguous, which is what lets it put the
columns of one particle or node into one vector register. Numba leaves that optimisation (superword-level parallelism)
off; it halves the time of the three-dimensional loops, so it is on while a loop of ours compiles, and then as it was.

Compiled code is kept between runs, in a folder of ours. Numba checks the age of the file that a loop is in, but not of
the files that it calls into, so the folder's name carries a digest of all of them: an edited helper can never meet
stale callers. `NUMBA_CACHE_DIR` and `NUMBA_SLP_VECTORIZE` have their usual meaning.
"""

import hashlib
import os
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numba import config, njit
from numba.core.compiler import Compiler
from numba.core.compiler_lock import global_compiler_lock

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


def _find_cache() -> str:
    """Return the folder of compiled loops; nothing, with a warning, if it cannot be written to."""
    sources = b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))
    chosen, cache = os.environ.get("NUMBA_CACHE_DIR"), os.environ.get("XDG_CACHE_HOME")
    base = Path(chosen) if chosen else Path(cache) if cache else Path.home() / ".cache"
    folder = base / "mpipic" / hashlib.sha256(sources).hexdigest()[:16]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        advice = "every start takes longer; NUMBA_CACHE_DIR names another folder"
        warnings.warn(f"compiled loops are not kept: {error}; {advice}", RuntimeWarning, stacklevel=2)
        return ""
    return str(folder)


CACHE = _find_cache()


def compiled(**options: object) -> Callable[[Loop], Loop]:
    """Return a decorator: compile a loop when it is first called, without Python objects, and keep it in `CACHE`."""
    options = {"error_model": "numpy", "no_cfunc_wrapper": True, "pipeline_class": LoopCompiler, **options}

    def decorate(function: Loop) -> Loop:
        with _numba_option("CACHE_DIR", CACHE):  # looked up here, once for each loop
            loop: Loop = njit(cache=bool(CACHE), **options)(function)
        return loop

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

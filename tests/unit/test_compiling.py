"""Claims about the compiled loops: kept between processes, never stale, and none of the host program's business."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from helpers import ROOT, environment

KERNELS = ROOT / "src" / "mpipic" / "kernels"
LOCATE = """
import numpy as np
from mpipic.kernels.generic import locate
cell, fraction = np.empty(1, np.int32), np.empty((1, 1))
zero = np.zeros(1, np.int64)
locate(np.array([[2.25]]), np.array([1e-9]), zero, zero + 8, cell, fraction)
print(cell[0], sum(locate.stats.cache_hits.values()), sum(locate.stats.cache_misses.values()))
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A copy of the kernels alone, to be edited, with a cache of its own."""
    shutil.copytree(KERNELS, tmp_path / "mpipic" / "kernels", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "mpipic" / "__init__.py").touch()
    return tmp_path


def run(package: Path, code: str, **more: str) -> str:
    settings = environment(XDG_CACHE_HOME=str(package / "cache"), PYTHONPATH=str(package), **more)
    ended = subprocess.run([sys.executable, "-c", code], env=settings, text=True, capture_output=True, timeout=120)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout + ended.stderr


def test_a_second_process_compiles_nothing(package: Path) -> None:
    """What is printed: the cell, loops found in the cache, loops compiled."""
    assert run(package, LOCATE).split() == ["2", "0", "1"]
    assert run(package, LOCATE).split() == ["2", "1", "0"]


def test_an_edited_helper_in_another_file_makes_its_callers_compile_anew(package: Path) -> None:
    assert run(package, LOCATE).split() == ["2", "0", "1"]
    helper = package / "mpipic" / "kernels" / "common.py"
    text = helper.read_text()
    assert "c = np.int32(x + tolerance)" in text
    helper.write_text(text.replace("c = np.int32(x + tolerance)", "c = np.int32(x + tolerance) + np.int32(1)"))
    assert run(package, LOCATE).split() == ["3", "0", "1"]


def test_the_user_names_the_folder_of_compiled_loops(package: Path) -> None:
    run(package, LOCATE, NUMBA_CACHE_DIR=str(package / "named"))
    assert list((package / "named").rglob("*.nbi")) and not (package / "cache").exists()


def test_without_a_writable_home_loops_are_kept_in_a_private_temporary_folder(package: Path) -> None:
    (package / "cache").write_text("a file where the folder would be")
    (package / "temporary").mkdir()
    for counts in (["2", "0", "1"], ["2", "1", "0"]):
        first, *warning = run(package, LOCATE, TMPDIR=str(package / "temporary")).splitlines()
        assert first.split() == counts
        assert sum("compiled loops are kept in" in line and "NUMBA_CACHE_DIR" in line for line in warning) == 1
    (private,) = (package / "temporary").iterdir()
    assert private.stat().st_mode & 0o777 == 0o700
    private.chmod(0o777)
    first, *warning = run(package, LOCATE, TMPDIR=str(package / "temporary")).splitlines()
    assert first.split() == ["2", "0", "1"], "what others may write to is not used"
    assert any("compiled loops are not kept" in line and "open to others" in line for line in warning)


def test_a_cache_that_takes_no_more_or_is_damaged_costs_time_and_a_warning_only(package: Path) -> None:
    full = LOCATE.replace("cell,", "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))\ncell,", 1)
    first, *warning = run(package, full).splitlines()
    assert first.split() == ["2", "0", "1"]
    assert sum("compiled loops are not kept" in line and "File too large" in line for line in warning) == 1
    run(package, LOCATE)
    for kept in (package / "cache").rglob("*.nb?"):
        kept.write_bytes(kept.read_bytes()[:40])
    assert run(package, LOCATE).split() == ["2", "0", "1"]
    assert run(package, LOCATE).split() == ["2", "1", "0"], "and is mended"


HOST = """
import numba
from numba import config
before = config.SLP_VECTORIZE, config.CACHE_DIR
loops = numba.njit(cache=True)(lambda x: x + 1)
import mpipic.kernels
from mpipic.kernels import advance, blocks, cells, generic, spline, stencil
assert (config.SLP_VECTORIZE, config.CACHE_DIR) == before, "importing the loops"
import numpy as np
generic.invert(np.ones(3), np.ones(3))
assert generic.invert.stats.cache_misses, "that compiled"
assert (config.SLP_VECTORIZE, config.CACHE_DIR) == before, "compiling a loop"

def pair(a, out):
    i = np.uintp(2 * (a.size // 2) - 2)
    out[i], out[i + np.uintp(1)] = a[i] * 3.0, a[i + np.uintp(1)] * 3.0

from mpipic.kernels.common import compiled
a = np.ones(2)
ours, theirs = compiled()(pair), numba.njit(error_model="numpy")(pair)
ours(a, a), theirs(a, a)
in_vectors = [any("fmul <2 x double>" in text for text in loop.inspect_llvm().values()) for loop in (ours, theirs)]
assert in_vectors == [True, False], in_vectors

@compiled()
def bad(a):
    return a.nothing

try:
    bad(a)
except numba.TypingError:
    assert (config.SLP_VECTORIZE, config.CACHE_DIR) == before, "compiling what does not compile"
    print("as it was")
"""


def test_the_host_program_keeps_its_options_of_numba_and_compiles_by_them(package: Path) -> None:
    (package / "host.py").write_text(HOST)
    assert run(package, "import host").split() == ["as", "it", "was"]


RUN = """
import sys
from mpi4py import MPI
from numba.core import event
from mpipic import Scene, Simulation
from mpipic.run.warmup import compile_loops
from run_helpers import Reports

class Compiled(event.Listener):
    names = []
    def on_start(self, event):
        self.names.append(event.data["dispatcher"].__name__)
    def on_end(self, event):
        pass

event.register("numba:compile", Compiled())
words = ["time.steps=3", "output.report_at=[2]", *sys.argv[1:]]
scene = Scene.load(None, words)
compile_loops(scene)
before = len(Compiled.names)
simulation = Simulation(scene, MPI.COMM_SELF)
outcome = simulation.run(Reports())
simulation.close()
print(before, outcome.status, *Compiled.names[before:])
"""
SCENES = {
    "the paper's": (),
    "2D, random, exact": ("grid.cells=[6,6]", "particles.layout=random", "particles.per_cell=[4]", "filter.kind=exact"),
}


@pytest.mark.slow
@pytest.mark.parametrize("words", SCENES.values(), ids=SCENES)
def test_a_run_compiles_nothing_after_its_loops_were_compiled_ahead(tmp_path: Path, words: tuple[str, ...]) -> None:
    """With a report and the Krylov solve that it takes."""
    settings = environment(XDG_CACHE_HOME=str(tmp_path))
    command = [sys.executable, "-c", RUN, *words]
    ended = subprocess.run(command, env=settings, text=True, capture_output=True, timeout=120)
    assert ended.returncode == 0, ended.stderr
    before, *after = ended.stdout.split()
    assert int(before) > 20
    assert after == ["completed"]

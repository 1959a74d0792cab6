"""Claims about what is left out: a library that a scene does not need is not imported."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from helpers import HANG, TESTS, finish, mpipic, run_ranks, start
from mpipic import __version__

MODULES = TESTS / "parallel" / "modules_helpers.py"
PAPER = str(TESTS.parent / "configs" / "paper.toml")


def modules(folder: Path, ranks: int, *arguments: str) -> list[set[str]]:
    """What each rank has imported after `mpipic arguments`; what was printed goes to the file `printed`."""
    place = folder / "modules"
    place.mkdir()
    if ranks == 1:
        ended = finish(start([sys.executable, MODULES, place, *arguments], folder))
    else:
        ended = run_ranks(ranks, MODULES, str(place), *arguments)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    (folder / "printed").write_text(ended.stdout)
    return [set((place / str(rank)).read_text().split()) for rank in range(ranks)]


def run(folder: Path, ranks: int, *more: str) -> list[set[str]]:
    return modules(folder, ranks, "run", PAPER, "--output", str(folder / "out"), *more)


def test_the_paper_scene_imports_neither_slepc_nor_h5py_nor_with_no_plots_matplotlib(tmp_path: Path) -> None:
    (found,) = run(tmp_path, 1, "--no-plots")
    assert {"numpy", "mpi4py", "petsc4py", "numba", "rich"} <= found
    assert found.isdisjoint({"slepc4py", "h5py", "matplotlib", "pandas"})


SOLVERS = {"slepc4py", "mpipic.mapping.gram_stencil", "mpipic.filters.row_space"}
# kinds of filters: what they import of SOLVERS, and what PETSc and SLEPc build for them
BUILT: dict[str, tuple[set[str], set[str]]] = {
    "none local order chebyshev": (set(), set()),
    "exact": ({"mpipic.mapping.gram_stencil"}, {"Krylov Solver", "Matrix"}),
    "svd": ({"slepc4py", "mpipic.filters.row_space"}, {"SVD Solver", "Matrix"}),
}


@pytest.mark.parametrize("kinds", BUILT)
def test_a_scene_imports_and_builds_the_solvers_of_its_filter_and_no_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kinds: str
) -> None:
    """Without reports, that is: a report on the share that no node sees solves for it."""
    monkeypatch.setenv("PETSC_OPTIONS", "-log_view")  # lists, at the end, what kinds of objects there were
    words = []
    for kind in kinds.split():
        short = ["--no-plots", "--set", "time.steps=4", "--set", "output.report_at=[]"]
        words += ["then", "run", PAPER, "--output", str(tmp_path / kind), "--set", f"filter.kind={kind}", *short]
    (found,) = modules(tmp_path, 1, *words[1:])
    objects = set(re.findall(r"^ +(\w[\w ]*?) +\d+ +\d+$", (tmp_path / "printed").read_text(), re.MULTILINE))
    assert "Star Forest Graph" in objects, "every scene has one"
    imported, built = found & SOLVERS, objects & {"Krylov Solver", "SVD Solver", "Matrix"}
    if kinds == "svd":  # its CFL limit is that of the exact filter, the same operator, and found with that
        imported, built = imported - {"mpipic.mapping.gram_stencil"}, built - {"Krylov Solver"}
    assert (imported, built) == BUILT[kinds]


@pytest.mark.mpi
def test_pictures_and_words_are_rank_0s_and_snapshots_bring_in_h5py(tmp_path: Path) -> None:
    more = ["--set", "output.every=2", "--set", "time.steps=4", "--set", "output.report_at=[]"]
    first, second = run(tmp_path, 2, *more)
    assert {"rich", "matplotlib", "h5py"} <= first
    assert "h5py" in second and second.isdisjoint({"rich", "matplotlib", "slepc4py"})


@pytest.mark.mpi
def test_check_imports_nothing_that_only_a_run_needs(tmp_path: Path) -> None:
    first, second = modules(tmp_path, 2, "check", PAPER)
    for found in (first, second):
        assert "mpi4py" in found and found.isdisjoint({"h5py", "matplotlib", "slepc4py"})
    assert "rich" in first and "rich" not in second


def test_the_package_itself_imports_neither_mpi_nor_numpy() -> None:
    code = "import mpipic, sys; print(mpipic.__version__, *sorted(sys.modules))"
    ended = subprocess.run([sys.executable, "-c", code], text=True, capture_output=True, timeout=HANG, check=True)
    version, *names = ended.stdout.split()
    assert version.count(".") == 2 and "mpipic" in names
    assert {name.split(".")[0] for name in names}.isdisjoint({"mpi4py", "numpy", "petsc4py", "numba", "typer", "h5py"})


def test_looking_at_a_scene_starts_no_mpi() -> None:
    code = "import sys; from mpipic import Scene; Scene.load(None); print(*sys.modules)"
    ended = subprocess.run([sys.executable, "-c", code], text=True, capture_output=True, timeout=HANG, check=True)
    heavy = {"mpi4py", "petsc4py", "slepc4py", "numba", "h5py"}
    assert {name.split(".")[0] for name in ended.stdout.split()}.isdisjoint(heavy)


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_help_and_version_start_no_mpi(tmp_path: Path, option: str) -> None:
    (found,) = modules(tmp_path, 1, option)
    assert found.isdisjoint({"mpi4py", "petsc4py", "numba", "h5py"})


@pytest.mark.parametrize("ranks", [1, pytest.param(2, marks=pytest.mark.mpi)])
def test_the_version_is_printed_once_on_any_number_of_ranks(ranks: int) -> None:
    ended = mpipic("--version", ranks=ranks)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, f"mpipic {__version__}\n", "")

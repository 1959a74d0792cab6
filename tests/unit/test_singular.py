"""The row space of the mapping matrix: its basis, what is found out about it, and what it is refused for."""

import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from dense_helpers import GRIDS, Dense, close, few_cases, pattern
from mpipic import memory
from mpipic.filters import ExactFilter, SvdFilter
from mpipic.filters import row_space as singular
from mpipic.filters.row_space import RowSpace, TooLarge, bytes_needed, check_memory, describe
from mpipic.mapping.mapping import Mapping
from mpipic.memory import available_bytes
from serial_helpers import grid_of, values

any_case = pytest.mark.parametrize(("weighted", "box", "name"), few_cases((False, True)))
weights = pytest.mark.parametrize("weighted", [False, True])


def rows_of(box, name, weighted=False):
    """Row space and, dense, S V^-½, which it is that of."""
    cells, length = GRIDS[box]
    position = pattern(name, cells, length)
    weight = 10.0 ** np.random.default_rng(2).uniform(-1.0, 1.0, len(position)) if weighted else None
    dense = Dense(cells, length, position, weight)
    return RowSpace(Mapping(grid_of(cells, length), position, weight)), dense.S / np.sqrt(dense.weight)


# ---------------------------------------------------------------- the basis and its facts


@any_case
def test_the_basis_is_orthonormal_and_spans_the_rows(box, name, weighted):
    rows, matrix = rows_of(box, name, weighted)
    assert rows.basis.shape == (matrix.shape[1], rows.facts["rank"]) and rows.nbytes == rows.basis.nbytes
    close(rows.basis.T @ rows.basis, np.eye(rows.facts["rank"]))
    close(matrix @ rows.basis @ rows.basis.T, matrix)


@any_case
def test_rank_cut_and_the_singular_values_at_it_are_those_of_numpy(box, name, weighted):
    rows, matrix = rows_of(box, name, weighted)
    wanted = np.linalg.svd(matrix, compute_uv=False)
    rank = np.linalg.matrix_rank(matrix)
    facts = rows.facts
    assert facts["rank"] == rank
    assert facts["cut"] == pytest.approx(max(matrix.shape) * np.finfo(float).eps * wanted[0], rel=1e-9)
    assert facts["above_cut"] == pytest.approx(wanted[rank - 1], rel=1e-9)
    if rank == min(matrix.shape):
        assert facts["below_cut"] is None
    else:
        assert 0.0 <= facts["below_cut"] <= facts["cut"]
    assert facts["solver"] in ("trlanczos", "lapack")


def test_patterns_of_full_and_of_deficient_rank_are_among_these():
    ranks = {(box, name): rows_of(box, name) for box, name in [("2D", "random"), ("2D", "lattice"), ("2D", "few")]}
    nodes = 20
    assert ranks["2D", "random"][0].facts["rank"] == nodes
    assert ranks["2D", "few"][0].facts["rank"] < nodes
    assert rows_of("1D", "coincident")[0].facts["rank"] == 1


@pytest.mark.parametrize("kind", ["lapack", "trlanczos", "cross"])
def test_the_solver_can_be_chosen_by_an_option_of_petsc(kind):
    chosen = PETSc.Options("filter_")
    chosen["svd_type"] = kind
    try:
        rows, matrix = rows_of("2D", "random")
    finally:
        chosen.delValue("svd_type")
    assert rows.facts["solver"] == kind
    close(matrix @ rows.basis @ rows.basis.T, matrix)
    assert rows_of("2D", "random")[0].facts["solver"] == "trlanczos"


def test_no_particles_have_no_row_space():
    grid = grid_of(*GRIDS["2D"])
    rows = RowSpace(Mapping(grid, np.empty((0, 2))))
    assert rows.facts == {"rank": 0, "cut": 0.0, "above_cut": None, "below_cut": None, "solver": "none"}
    assert rows.basis.shape == (0, 0) and rows.project(np.empty((0, 2))).shape == (0, 2)


@weights
def test_projecting_is_the_matrix_of_the_basis_between_roots_of_the_weights(weighted):
    cells, length = GRIDS["2D"]
    position = pattern("random", cells, length)
    weight = np.random.default_rng(3).random(len(position)) + 0.1 if weighted else None
    grid = grid_of(cells, length)
    rows, q = RowSpace(Mapping(grid, position, weight)), values(len(position), 3)
    before = q.copy()
    root = np.sqrt(weight)[:, None] if weighted else 1.0
    reductions = grid.reductions
    close(rows.project(q), rows.basis @ (rows.basis.T @ (root * q)) / root, 1e-13)
    assert grid.reductions == reductions + 1 and np.array_equal(q, before)
    close(rows.project(q[:, 1:2]), rows.project(q)[:, 1:2], 1e-13)


def test_the_facts_in_words():
    facts = {"rank": 20, "cut": 1.25e-14, "above_cut": 0.5, "below_cut": None, "solver": "trlanczos"}
    assert describe(facts) == "rank 20, cut at 1.25e-14, smallest kept 0.5, nothing below it"
    assert describe({**facts, "below_cut": 3e-17}).endswith("smallest kept 0.5, next singular value 3e-17")
    nothing = {"rank": 0, "cut": 0.0, "above_cut": None, "below_cut": None, "solver": "none"}
    assert describe(nothing) == "rank 0, cut at 0, nothing below it"


# ---------------------------------------------------------------- memory


def test_a_decomposition_that_does_not_fit_is_refused_and_exact_recommended(monkeypatch):
    """2 r (m + n) + 6 r² numbers of 8 bytes, r = min(m, n)."""
    needed = 8 * 1000 * (2 * 5000 + 6 * 1000)
    assert bytes_needed(1000, 4000, 1) == bytes_needed(4000, 1000, 1) == needed
    monkeypatch.setattr(memory, "available_bytes", lambda: float(needed))
    check_memory(1000, 4000, MPI.COMM_SELF)
    monkeypatch.setattr(memory, "available_bytes", lambda: needed - 1.0)
    with pytest.raises(TooLarge) as caught:
        check_memory(1000, 4000, MPI.COMM_SELF)
    assert str(caught.value) == (
        "svd of 1000 nodes and 4000 particles needs about 0.128 GB on 1 rank, and 0.128 GB are free; "
        'filter.kind = "exact" is the same operator and takes memory in proportion to nodes'
    )
    assert isinstance(caught.value, MemoryError)


def test_a_filter_asks_for_memory_before_it_takes_any(monkeypatch):
    cells, length = GRIDS["2D"]
    mapping = Mapping(grid_of(cells, length), pattern("random", cells, length))
    q = values(mapping.count)
    monkeypatch.setattr(memory, "available_bytes", lambda: 1000.0)
    monkeypatch.setattr(singular, "_all_triplets", lambda *_: pytest.fail("it began all the same"))
    with pytest.raises(TooLarge, match=r"svd of 20 nodes and 80 particles needs about .* 1e-06 GB are free.*exact"):
        SvdFilter(mapping).apply(q)
    assert np.isfinite(ExactFilter(mapping).apply(q)).all()


def test_what_is_free_is_what_the_system_says():
    """Memory of a machine that runs these tests: above 10 MB, below 100 TB."""
    assert 1e7 < available_bytes() < 1e14


def test_what_is_free_is_the_least_of_what_machine_and_control_group_leave(monkeypatch):
    files = {}

    def read_text(path):
        if str(path) not in files:
            raise FileNotFoundError(path)
        return files[str(path)]

    monkeypatch.setattr(memory.psutil, "virtual_memory", lambda: SimpleNamespace(available=5000 * 1024))
    monkeypatch.setattr(memory.Path, "read_text", read_text)
    assert available_bytes() == 5000 * 1024
    files["/sys/fs/cgroup/memory.max"], files["/sys/fs/cgroup/memory.current"] = "max\n", "70\n"
    assert available_bytes() == 5000 * 1024
    files["/sys/fs/cgroup/memory.max"] = "1000070\n"
    assert available_bytes() == 1_000_000


# ---------------------------------------------------------------- imports


PROGRAM = """
import sys
import numpy as np
from mpi4py import MPI
from mpipic.filters import FILTERS, ExactFilter, LocalFilter
from mpipic.mesh.grid import Grid
from mpipic.mapping.mapping import Mapping
mapping = Mapping(Grid((4,), (1.0,), MPI.COMM_SELF), np.linspace(0.05, 0.95, 9)[:, None])
assert "mpipic.mapping.gram_stencil" not in sys.modules and "mpipic.filters.row_space" not in sys.modules
assert LocalFilter(mapping).apply(np.ones(9)).shape == ExactFilter(mapping).apply(np.ones(9)).shape
svd = FILTERS["svd"](mapping)
print(sorted(name for name in sys.modules if name.startswith("slepc4py")))
svd.apply(np.ones(9))
print("slepc4py" in sys.modules)
"""


def test_slepc_is_imported_when_svd_is_first_applied_and_not_before():
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split("\n")[:2] == ["[]", "True"]

"""Claims about one rank's mistake: collective verbs raise on all ranks, none waits, and right calls still work."""

from __future__ import annotations

from pathlib import Path

import pytest

from helpers import run_ranks

pytestmark = pytest.mark.mpi

HELPERS = Path(__file__).with_name("arguments_helpers.py")


@pytest.mark.parametrize(("ranks", "cases"), [(2, 200), (3, 60)])
def test_mistakes_of_some_ranks_are_raised_on_all_and_what_follows_is_right(ranks: int, cases: int) -> None:
    ended = run_ranks(ranks, HELPERS, str(cases), timeout=60)
    assert ended.returncode == 0 and f"walked {4 * cases}" in ended.stdout, ended.stdout + ended.stderr


ENDING = """
import gc
from mpipic.runtime import start
COMM = start()
import numpy as np
from mpipic import FILTERS, Grid, Mapping, Placement

class Held:
    def __init__(self, kind):
        self.grid = Grid((8, 8), (1.0, 1.0), COMM)
        placed = Placement(self.grid, np.random.default_rng(COMM.rank).random((40, 2)))
        self.filter = FILTERS[kind](Mapping(self.grid, placed.position))
        self.filter(np.ones(len(placed.position)))
        self.itself = self

for kind in ("local", "exact", "svd", "exact"):
    Held(kind)
    if COMM.rank == 0:
        gc.collect()
kept = Held("exact")
"""


@pytest.mark.parametrize("ranks", [1, 2, 3])
def test_a_program_ends_wherever_the_collector_has_been(tmp_path: Path, ranks: int) -> None:
    """Solvers that cycles of references keep go at other times on other ranks; one lives to the end on all."""
    program = tmp_path / "program.py"
    program.write_text(ENDING)
    ended = run_ranks(ranks, program, timeout=60)
    assert ended.returncode == 0, ended.stdout + ended.stderr

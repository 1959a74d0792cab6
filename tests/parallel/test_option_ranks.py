"""Claims about PETSc's options on two ranks: refused or right on all together, and no signal at the end."""

from __future__ import annotations

from pathlib import Path

import pytest

from helpers import run_ranks

HELPERS = Path(__file__).with_name("option_rank_helpers.py")


@pytest.mark.mpi
def test_every_solver_that_petsc_knows_is_right_or_refused_and_what_is_half_made_ends_in_order() -> None:
    ended = run_ranks(2, HELPERS)
    assert ended.stdout.count("tried all") == 2, ended.stdout + ended.stderr
    assert ended.returncode == 7 and "signal" not in ended.stderr, ended.stderr

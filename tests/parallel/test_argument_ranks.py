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

"""Claims about failure: one rank's exception ends all ranks at once, with its traceback and an exit code."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from helpers import environment, finish, run_python, run_ranks, start

HELPERS = Path(__file__).with_name("failing_helpers.py")
pytestmark = pytest.mark.mpi


def fail(ranks: int, case: str, *args: str) -> subprocess.CompletedProcess[str]:
    """Run a case that must fail; where a rank would go on, it does so for longer than any test waits."""
    ended = run_ranks(ranks, HELPERS, case, *args)
    assert ended.returncode != 0 and "reached the end" not in ended.stdout, ended.stdout + ended.stderr
    return ended


@pytest.mark.parametrize("ranks", [2, 3])
def test_an_exception_ends_the_ranks_that_wait(ranks: int) -> None:
    said = fail(ranks, "exception").stderr
    assert said.count("rank 1 of") == 1 and f"rank 1 of {ranks} failed; ending all ranks" in said
    assert said.count("ZeroDivisionError: the ninth part of nothing") == 1
    assert said.count("in fail_deep_inside") == 1, "the traceback goes down to the line that failed"


def test_an_exception_ends_ranks_that_are_busy_with_something_else() -> None:
    assert "rank 2 of 3 failed" in fail(3, "delay").stderr


def test_an_exception_in_the_middle_of_a_run_ends_it_at_once(tmp_path: Path) -> None:
    said = fail(2, "exception_in_run", str(tmp_path / "out")).stderr
    assert said.count("rank 1 of 2 failed") == 1 and said.count("in fail_deep_inside") == 1
    assert not (tmp_path / "out" / "summary.json").exists(), "no results are claimed"


@pytest.mark.parametrize("ranks", [1, 3])
def test_a_lost_particle_is_noticed_and_counted(ranks: int) -> None:
    said = fail(ranks, "theft").stderr
    assert "LostParticles: there are 39 particles at step " in said and ", not 40" in said, said


@pytest.mark.parametrize("verb", ["run", "check"])
def test_the_launcher_of_another_mpi_is_named_with_both_numbers(tmp_path: Path, verb: str) -> None:
    command = [sys.executable, "-m", "mpipic", verb]
    ended = finish(start(command, tmp_path, env=environment(OMPI_COMM_WORLD_SIZE="2")))
    assert ended.returncode not in (0, 2, 3, 130)
    assert ended.stderr.count("the launcher started 2 processes (OMPI_COMM_WORLD_SIZE), but MPI sees 1") == 1
    assert ended.stdout == "" and not list(tmp_path.iterdir()), "nothing was started"


def test_the_right_launcher_is_accepted() -> None:
    # one write a rank: the pieces of a print from two ranks may come out mixed
    say_size = r"import os; from mpipic.runtime import start; os.write(1, b'size %d\n' % start().size)"
    ended = run_python(2, "-c", say_size)
    assert ended.returncode == 0 and ended.stdout.count("size 2") == 2

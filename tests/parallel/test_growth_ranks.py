"""Claims about growth per step on several ranks: it is the number that one rank finds, and all ranks know it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from helpers import run_ranks

HELPERS = Path(__file__).with_name("growth_helpers.py")
CASES = ("1d-paper-random", "1d-paper-lattice", "1d-recommended-random", "2d-paper-jittered")
GROWS = [name for name in CASES if "paper" in name]

pytestmark = pytest.mark.mpi

Found = list[dict[str, Any]]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int, str, str], Found]:
    """What a run on so many ranks found of a case, then what each of its ranks did; each number is started once."""
    said: dict[int, Any] = {}

    def result(ranks: int, case: str, solver: str) -> Found:
        if ranks not in said:
            file = tmp_path_factory.mktemp("growth") / f"{ranks}.json"
            ended = run_ranks(ranks, HELPERS, str(file))
            said[ranks] = ended.stdout + ended.stderr
            assert ended.returncode == 0, said[ranks]
            said[ranks] = json.loads(file.read_text(encoding="utf-8"))
        assert isinstance(said[ranks], dict), said[ranks]
        return said[ranks][f"{case} {solver}"]

    return result


@pytest.mark.parametrize("solver", ["lapack", "krylovschur"])
@pytest.mark.parametrize("case", CASES)
def test_growth_on_two_ranks_is_that_on_one(results: Callable[..., Found], case: str, solver: str) -> None:
    one, many = results(1, case, solver), results(2, case, solver)
    assert (one[0]["ranks"], many[0]["ranks"], len(many)) == (1, 2, 3)
    assert (one[0]["growth_per_step"] > 1e-4) == (case in GROWS)
    assert abs(many[0]["growth_per_step"] - one[0]["growth_per_step"]) < 1e-8
    assert abs(one[0]["growth_per_step"] - results(1, case, "lapack")[0]["growth_per_step"]) < 1e-8
    if solver == "lapack":
        assert many[0]["norm_bound"] == pytest.approx(one[0]["norm_bound"], rel=1e-8)
    assert many[0]["unknowns"] == one[0]["unknowns"] and many[0]["period_steps"] == one[0]["period_steps"]


@pytest.mark.parametrize("solver", ["lapack", "krylovschur"])
@pytest.mark.parametrize("case", CASES)
def test_both_ranks_know_the_same(results: Callable[..., Found], case: str, solver: str) -> None:
    first, second = results(2, case, solver)[1:]
    assert first["growth_per_step"] == second["growth_per_step"]
    assert first["wave"] == second["wave"] and first["null_space_share"] == second["null_space_share"]
    assert first["noise_step"] == second["noise_step"]

"""Claims about halos of any width: ghosts are copies of their nodes, also where blocks are smaller than the width."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from helpers import run_ranks

HELPERS = Path(__file__).with_name("halo_helpers.py")

pytestmark = pytest.mark.mpi

RANKS = pytest.mark.parametrize("ranks", [1, 2, 3, 4])
Cases = Callable[[int], list[dict[str, Any]]]


@pytest.fixture(scope="module")
def cases(tmp_path_factory: pytest.TempPathFactory) -> Cases:
    """What the ranks found; every number of ranks is started once."""
    folder = tmp_path_factory.mktemp("halo")

    def found(ranks: int) -> list[dict[str, Any]]:
        file, tried = folder / f"{ranks}.json", folder / f"{ranks}.tried"
        if not tried.exists():
            tried.touch()
            ended = run_ranks(ranks, HELPERS, str(file), timeout=60)
            assert ended.returncode == 0, ended.stdout + ended.stderr
        return json.loads(file.read_text())

    return found


def name(case: dict[str, Any]) -> tuple[Any, ...]:
    return case["cells"], case["width"], case["reach"]


@RANKS
def test_every_ghost_in_reach_is_the_value_of_its_node_and_no_other_is_touched(cases: Cases, ranks: int) -> None:
    for case in cases(ranks):
        for rank in case["ranks"]:
            assert rank["ghosts"] > 0
            assert [columns["wrong_ghosts"] for columns in rank["columns"]] == [0, 0], name(case)


@RANKS
def test_add_gives_every_node_all_its_copies_and_is_the_adjoint_of_fill(cases: Cases, ranks: int) -> None:
    for case in cases(ranks):
        for rank in case["ranks"]:
            for columns in rank["columns"]:
                assert (columns["wrong_sums"], columns["changed_ghosts"]) == (0, 0), name(case)
                left, right = columns["products"]
                assert left == right != 0, name(case)


@RANKS
def test_the_cases_have_blocks_smaller_than_the_width_and_all_dimensions(cases: Cases, ranks: int) -> None:
    small = [case for case in cases(ranks) if any(min(rank["shape"]) < case["width"] for rank in case["ranks"])]
    assert {len(case["cells"]) for case in small} == {1, 2, 3}
    assert {tuple(case["cells"]) for case in small} >= {(5,), (3, 4)} or ranks == 1
    assert {case["width"] for case in small} == {2, 3} and len(cases(ranks)) >= 42

"""Claims about who talks to whom: a step is for neighbours alone, however many ranks there are."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from helpers import run_ranks

HELPERS = Path(__file__).with_name("messages_helpers.py")

pytestmark = pytest.mark.mpi

Facts = Callable[[int], dict[str, Any]]
RANKS = (2, 4, 8)
STEPS = 6
SOLVER = ("KSPSolve", "MatMult", "PCApply")
EQUAL = ("1d", "2d", "3d", "1d-single")  # equal blocks on 2, 4 and 8 ranks
# a particle within rounding of a face may end on either side: where a moved block's faces fall on those of blocks
# (still, along-x, and whole steps of cells), both sides are met
GENERIC = ("forward", "back", "across", "far", "past")


@pytest.fixture(scope="module")
def facts(tmp_path_factory: pytest.TempPathFactory) -> Facts:
    """What the ranks found out; every number of ranks is started once."""
    folder = tmp_path_factory.mktemp("messages")

    def found(ranks: int) -> dict[str, Any]:
        file, tried = folder / f"{ranks}.json", folder / f"{ranks}.tried"
        if not tried.exists():
            tried.touch()
            ended = run_ranks(ranks, HELPERS, str(file), timeout=90)
            assert ended.returncode == 0, ended.stdout + ended.stderr
        return json.loads(file.read_text())

    return found


def destinations(facts: Facts, ranks: int, box: str, move: str) -> int:
    """The most destinations of any rank."""
    (case,) = (case for case in facts(ranks)["routes"] if (case["box"], case["move"]) == (box, move))
    return max(len(rank["destinations"]) for rank in case["ranks"])


@pytest.mark.parametrize("ranks", RANKS)
def test_what_one_rank_sends_to_the_other_receives_from(facts: Facts, ranks: int) -> None:
    for case in facts(ranks)["routes"]:
        sent = {(a, b) for a, rank in enumerate(case["ranks"]) for b in rank["destinations"]}
        received = {(a, b) for b, rank in enumerate(case["ranks"]) for a in rank["sources"]}
        assert sent == received, (case["box"], case["move"])


@pytest.mark.parametrize("ranks", RANKS)
def test_every_particle_finds_a_route(facts: Facts, ranks: int) -> None:
    several = 0
    for case in facts(ranks)["routes"]:
        for rank in case["ranks"]:
            assert set(rank["reached"]) <= set(rank["destinations"]), (case["box"], case["move"])
            several += len(rank["reached"]) > 1
    assert several > ranks * 10, "too few journeys leave a rank to trust this"


@pytest.mark.parametrize("ranks", RANKS)
def test_equal_blocks_send_to_two_ranks_per_axis_however_far_particles_go(facts: Facts, ranks: int) -> None:
    for box, move in product(EQUAL, GENERIC):
        assert destinations(facts, ranks, box, move) <= 2 ** int(box[0]), (box, move)


@pytest.mark.parametrize("ranks", RANKS)
def test_any_blocks_and_journeys_need_three_ranks_per_axis_at_most(facts: Facts, ranks: int) -> None:
    for case in facts(ranks)["routes"]:
        assert max(len(rank["destinations"]) for rank in case["ranks"]) <= 3 ** case["dim"]


def test_eight_ranks_have_no_more_destinations_than_four(facts: Facts) -> None:
    for box, move in product(("1d", "1d-single"), GENERIC):
        assert destinations(facts, 8, box, move) == destinations(facts, 4, box, move) == 2, (box, move)


# at their default orders: order and chebyshev apply the Gram matrix once more than local
NEIGHBOURLY = ("none", "local", "order", "chebyshev")


@pytest.mark.parametrize("ranks", RANKS)
@pytest.mark.parametrize("kind", NEIGHBOURLY)
def test_a_step_calls_neighbours_only_once_for_counts_and_once_for_particles(
    facts: Facts, kind: str, ranks: int
) -> None:
    step = facts(ranks)["step"][kind]
    assert min(step["migrated"]) > 0
    for rank in step["ranks"]:
        assert rank["counted"] >= 2, "the communicators of the run and of its routes must be watched"
        assert rank["calls"] == {"Neighbor_alltoall": STEPS, "Neighbor_alltoallv": STEPS}
        assert rank["petsc_reductions"] == 0
        assert not any(rank["events"][name] for name in SOLVER)


@pytest.mark.parametrize("kind", NEIGHBOURLY)
def test_halo_messages_of_a_rank_do_not_grow_with_the_number_of_ranks(facts: Facts, kind: str) -> None:
    most = {ranks: max(rank["halo_messages"] for rank in facts(ranks)["step"][kind]["ranks"]) for ranks in RANKS}
    assert most[2] == most[4] > 0, "slabs"
    assert most[8] <= 3 * most[2], "2 x 4 blocks: across a side, across the other, across the corner"


# a step of the exact filter solves for the divergence, and for both components of the gradient together
SOLVES = 2 * STEPS


@pytest.mark.parametrize("ranks", RANKS)
def test_the_exact_filter_reduces_once_a_move_twice_a_solve_and_twice_an_iteration(facts: Facts, ranks: int) -> None:
    step = facts(ranks)["step"]["exact"]
    assert min(step["migrated"]) > 0
    for rank in step["ranks"]:
        events = rank["events"]
        iterations = events["MatMult"] - SOLVES  # one more a solve, of the first guess
        assert events["KSPSolve"] == SOLVES and iterations > 2 * SOLVES
        assert rank["calls"] == {
            "Neighbor_alltoall": STEPS, "Neighbor_alltoallv": STEPS, "Allreduce": STEPS + 2 * SOLVES,
        }  # fmt: skip
        assert 2 * iterations <= rank["petsc_reductions"] <= 2 * iterations + 2 * SOLVES


@pytest.mark.parametrize("ranks", RANKS)
def test_an_iteration_of_the_exact_filter_exchanges_the_halo_twice(facts: Facts, ranks: int) -> None:
    for rank, local in zip(*(facts(ranks)["step"][kind]["ranks"] for kind in ("exact", "local")), strict=True):
        events = rank["events"]
        assert events["SFReduceBegin"] == local["events"]["SFReduceBegin"] + STEPS, "the stencil, in one message"
        # filled besides: the stencil and its diagonal once a move, every answer
        besides = events["SFBcastBegin"] - local["events"]["SFBcastBegin"] - 2 * STEPS - SOLVES
        assert 0 < besides <= events["MatMult"] + events["PCApply"]
        assert events["PCApply"] <= events["MatMult"] + SOLVES


def test_the_exact_filter_sends_to_neighbours_and_iterates_alike_on_any_number_of_ranks(facts: Facts) -> None:
    found = {ranks: facts(ranks)["step"]["exact"]["ranks"] for ranks in RANKS}
    each = {
        ranks: max(r["halo_messages"] / (r["events"]["SFBcastBegin"] + r["events"]["SFReduceBegin"]) for r in here)
        for ranks, here in found.items()
    }
    assert 0 < each[4] <= 2 * each[2], "slabs: one neighbour, or two"
    assert each[8] <= 5 * each[2], "2 x 4 blocks: five of the seven others"
    mults = {rank["events"]["MatMult"] for here in found.values() for rank in here}
    assert max(mults) - min(mults) <= SOLVES


def test_all_ranks_talk_only_at_the_looks_that_a_run_agrees_on(facts: Facts) -> None:
    # 500 steps: 251 looks that are monitored, a few that a clock asks for, and 2 reductions of the report at the end
    calls = facts(2)["run"]
    assert all(call == calls[0] for call in calls)
    assert set(calls[0]) <= {"Allreduce", "allreduce"}
    assert all(251 <= count < 450 for count in calls[0].values()), calls[0]


def test_a_particle_with_no_route_to_its_owner_is_lost_by_name(facts: Facts) -> None:
    said = facts(4)["astray"]
    for rank, text in enumerate(said):
        assert text == f"rank {rank} must send a particle to rank {(rank + 2) % 4}, which it has no route to"

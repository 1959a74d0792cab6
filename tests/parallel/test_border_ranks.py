"""The border: another physics on the same particles, mapping, motion and loop, the same on any number of ranks."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from helpers import TESTS, run_ranks

pytestmark = pytest.mark.mpi

PROGRAM = TESTS / "parallel" / "border_helpers.py"
PARTICLES = 12 * 10 * 3
Results = Callable[[int], dict[str, np.ndarray]]
several_ranks = pytest.mark.parametrize("ranks", [2, 3, 4])


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """What the program saves, by number of ranks; each is started once."""
    folder, found = tmp_path_factory.mktemp("border"), {}

    def result(ranks: int) -> dict[str, np.ndarray]:
        if ranks not in found:
            place = folder / str(ranks)
            place.mkdir()
            ended = run_ranks(ranks, PROGRAM, str(place))
            assert ended.returncode == 0, ended.stdout + ended.stderr
            with np.load(place / "swirl.npz") as arrays:
                found[ranks] = dict(arrays)
        return found[ranks]

    return result


@several_ranks
def test_tracers_that_each_move_by_themselves_are_the_same_by_id_on_any_ranks(results: Results, ranks: int) -> None:
    one, several = results(1), results(ranks)
    assert several["arrived"] > 4 * PARTICLES and one["arrived"] == 0, "particles crossed between ranks, many times"
    assert np.unique(several["owner"]).size == ranks
    assert np.array_equal(one["ids"], np.arange(PARTICLES)) and np.array_equal(several["ids"], one["ids"])
    for name in ("coordinate", "velocity", "mass", "stress"):
        assert np.array_equal(several[name], one[name]), name


@pytest.mark.parametrize("ranks", [1, 2, 3, 4])
def test_what_tracers_carry_is_untouched_however_far_they_go(results: Results, ranks: int) -> None:
    found = results(ranks)
    assert np.abs(found["coordinate"] - found["coordinate_before"]).max(axis=1).mean() > 1.0, (
        "most have left their cell"
    )
    for name in ("mass", "stress"):
        assert np.array_equal(found[name], found[f"{name}_before"]), name
        start, end = found[f"sum_{name}"]
        np.testing.assert_allclose(end, start, rtol=1e-13)


@several_ranks
def test_means_weighted_by_the_mass_agree_on_any_ranks(results: Results, ranks: int) -> None:
    one, several = results(1), results(ranks)
    for name in ("nodal_velocity", "nodal_stress"):
        assert np.abs(one[name]).max() > 0.1
        np.testing.assert_allclose(several[name], one[name], atol=1e-12, rtol=0.0)

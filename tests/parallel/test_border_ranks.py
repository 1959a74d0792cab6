"""The border: another physics on the same particles, mapping, motion and loop, the same on any number of ranks."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import h5py
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
                found[ranks] = {**arrays, "folder": np.array(str(place)), "said": np.array(ended.stdout)}
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


@pytest.mark.parametrize("ranks", [1, 3])
def test_a_run_of_another_physics_leaves_what_any_run_leaves(results: Results, ranks: int) -> None:
    """Banner, progress, errors, history, snapshots and pictures work from the names that the physics gives."""
    found = results(ranks)
    folder, said = Path(str(found["folder"])) / "run", str(found["said"])
    assert "max |mass| =" in said and "swirl" in said
    rows = list(csv.DictReader((folder / "history.csv").read_text().splitlines()))
    assert list(rows[0])[:4] == ["step", "time", "max_mass", "mass_l1"] and "stress_linf" in rows[0]
    assert float(rows[0]["mass_l2"]) == float(rows[0]["stress_l2"]) == 0.0
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["status"] == "completed" and set(summary["conserved"]) == {"mass", "stress"}
    start, end = map(np.array, summary["conserved"]["stress"])
    np.testing.assert_allclose(end, start, rtol=1e-13)
    with h5py.File(folder / "particles.h5") as file:
        (species,) = file["/data/40/particles"].values()
        assert {"mass", "velocity", "stress"} <= set(species) and set(species["stress"]) == {"xx", "xy", "yx", "yy"}
        order = np.argsort(species["id"][:])
        first = next(iter(file["/data/0/particles"].values()))
        before = np.argsort(first["id"][:])
        assert np.array_equal(species["stress/xy"][:][order], first["stress/xy"][:][before])
        assert not np.array_equal(species["position/x"][:][order], first["position/x"][:][before])
    for picture in ("error.png", "solution.png"):
        assert (folder / picture).read_bytes().startswith(b"\x89PNG")

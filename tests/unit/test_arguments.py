"""Every verb of the library answers rightly or refuses by name, whatever it is given; thousands of generated cases."""

import numpy as np
import pytest
from mpi4py import MPI

import mpipic
from argument_helpers import World
from moving_helpers import MovingWalk
from walk_helpers import Walk

CASES = 2500
WORLDS = [(1, "box", False), (2, "box", True), (3, "box", False), (2, "none", False), (2, "corner", True)]


@pytest.mark.parametrize(("dim", "spread", "weighted"), WORLDS)
def test_any_argument_is_answered_as_the_dense_matrices_do_or_refused_by_name(dim, spread, weighted):
    walk = Walk(World(MPI.COMM_SELF, dim, spread, weighted), seed=dim)
    for _ in range(CASES):
        walk.step()
    assert walk.seen.total() >= CASES
    for outcome in ("refused", "answered"):
        kinds = {kind for kind, found in walk.seen if found == outcome}
        assert {"sums", "p2g", "exact", "svd", "placed", "g2p", "positions", "weights", "grid", "filter"} <= kinds


def test_particles_of_a_run_are_moved_and_put_elsewhere_or_stay_where_they_are():
    walk = MovingWalk(MPI.COMM_SELF, seed=1)
    for _ in range(60):
        walk.step()


def test_names_that_there_are_not_are_answered_with_those_that_there_are():
    assert set(mpipic.__all__) < set(dir(mpipic))
    with pytest.raises(AttributeError, match="no attribute 'Maping'; did you mean 'Mapping'"):
        mpipic.Maping  # noqa: B018
    with pytest.raises(KeyError, match='only local, order, chebyshev, exact and svd; did you mean \\"local'):
        mpipic.FILTERS["lokal"]


@pytest.mark.parametrize("number", [np.int8, np.uint64, np.int64, lambda n: np.array(n), lambda n: np.array([n])[0]])
def test_scenes_take_numbers_of_numpy_as_pythons(number):
    sections = {
        "grid": {"cells": [number(4), number(3)], "length": np.array([1, 2], dtype="f4") * 1.0},
        "filter": {"kind": np.str_("order"), "order": number(3)},
        "time": {"steps": number(7), "dt": np.longdouble(0.25)},
        "output": {"report_at": np.array([2, 3], dtype=np.uint8)},
    }
    scene = mpipic.Scene.from_dict(sections)
    assert scene.grid.cells == (4, 3) and scene.filter.order == 3 and scene.time.steps == 7 and scene.dt == 0.25
    assert all(type(n) is int for n in (*scene.grid.cells, scene.filter.order, *scene.output.report_at))
    assert scene == mpipic.Scene.from_toml(scene.to_toml())
    for wrong in (np.float64(4.5), np.nan, np.bool_(True), np.array([[4]]), 1j, np.datetime64("2020"), np.ma.masked):
        with pytest.raises(mpipic.SceneError, match="whole numbers"):
            mpipic.Scene.from_dict({"grid": {"cells": [wrong]}})
    for wrong in (None, 3, [1], "grid"):
        with pytest.raises((TypeError, mpipic.SceneError)):
            mpipic.Scene.from_dict(wrong)

"""The filters between the local one and the exact projection, at orders other than the default."""

from itertools import pairwise

import numpy as np
import pytest

from covering_helpers import covering
from dense_helpers import GRIDS, Dense, close, pattern
from mpipic.filters import ChebyshevFilter, LocalFilter, OrderFilter, create
from mpipic.mapping.mapping import Mapping
from mpipic.scene.records import Scene
from serial_helpers import grid_of

SERIES = {OrderFilter: Dense.order, ChebyshevFilter: Dense.chebyshev}
every_class = pytest.mark.parametrize("cls", SERIES)
every_grid = pytest.mark.parametrize("box", ["1D", "2D", "3D"])


def case(box, name):
    cells, length = GRIDS[box]
    position = pattern(name, cells, length)
    return Mapping(grid_of(cells, length), position), Dense(cells, length, position)


def matrix(filter_, n):
    return filter_.apply(np.eye(n))


@pytest.mark.parametrize(
    ("cls", "k", "box", "name"),
    covering(2, SERIES, (1, 3, 6), ("1D", "2D", "3D"), ("lattice", "jittered", "random", "few")),
)
def test_a_series_is_its_formula_at_every_order(cls, box, name, k):
    mapping, dense = case(box, name)
    close(matrix(cls(mapping, order=k), len(dense.phi)), SERIES[cls](dense, k), scale=1.0)


@every_class
@every_grid
def test_order_1_is_the_local_filter(cls, box):
    mapping, dense = case(box, "random")
    q = np.random.default_rng(3).standard_normal(len(dense.phi))
    assert np.array_equal(cls(mapping, order=1).apply(q), LocalFilter(mapping).apply(q))


@every_class
@every_grid
def test_a_series_converges_to_the_projection(cls, box):
    mapping, dense = case(box, "lattice")
    n, exact = len(dense.phi), dense.projection()
    away = [np.linalg.norm(matrix(cls(mapping, order=k), n) - exact, 2) for k in (1, 2, 4, 8)]
    assert away[0] > 0.3 and all(later < earlier for earlier, later in pairwise(away))
    assert np.linalg.norm(matrix(cls(mapping, order=300), n) - exact, 2) < 1e-3


@pytest.mark.parametrize(("box", "name", "k"), covering(2, ("1D", "2D", "3D"), ("lattice", "jittered"), (2, 3, 5, 8)))
def test_chebyshev_is_never_further_from_the_projection_than_the_same_order_on_filled_grids(box, name, k):
    mapping, dense = case(box, name)
    n, exact = len(dense.phi), dense.projection()
    distance = {cls: np.linalg.norm(matrix(cls(mapping, order=k), n) - exact, 2) for cls in SERIES}
    assert 0 < distance[ChebyshevFilter] <= distance[OrderFilter] * (1 + 1e-12)


def waves(dense):
    """Eigenvalues λ of SΦ above zero, and for each a wave on the particles that ΦS multiplies by λ."""
    root = np.where(dense.seen, np.where(dense.seen, dense.d, 1.0) ** -0.5, 0.0)
    values, vectors = np.linalg.eigh(root[:, None] * dense.G * root)
    kept = values > 1e-8
    return values[kept], (dense.phi @ (root[:, None] * vectors))[:, kept]


def sparse():
    """Hardly more particles than nodes: many eigenvalues far below (1/3)^d."""
    position = np.random.default_rng(2).random((90, 2))
    return Mapping(grid_of((8, 8), (1.0, 1.0)), position), Dense((8, 8), (1.0, 1.0), position)


@every_class
@pytest.mark.parametrize("k", [2, 7, 20])
def test_waves_below_the_lower_bound_are_damped_never_amplified(cls, k):
    mapping, dense = sparse()
    eigenvalues, wave = waves(dense)
    below = eigenvalues < 1 / 9
    assert below.sum() > 3
    gain = np.sum(cls(mapping, order=k).apply(wave) * wave, axis=0) / np.sum(wave**2, axis=0)
    assert np.all(gain[below] > 0) and np.all(gain[below] < 1)


@pytest.mark.parametrize("k", [2, 7, 20])
def test_chebyshev_overshoots_by_no_more_than_its_polynomial(k):
    mapping, dense = case("2D", "random")
    eigenvalues, wave = waves(dense)
    gain = np.sum(ChebyshevFilter(mapping, order=k).apply(wave) * wave, axis=0) / np.sum(wave**2, axis=0)
    bound = (1 - eigenvalues) / np.cosh((k - 1) * np.arccosh((1 + 1 / 9) / (1 - 1 / 9)))
    assert gain.max() > 1
    assert np.all(gain <= 1 + np.maximum(bound, 0) + 1e-9)


@every_class
def test_an_order_below_1_is_refused(cls):
    with pytest.raises(ValueError, match="order must be a whole number from 1 to 1000, not 0"):
        cls(case("1D", "lattice")[0], order=0)


def test_a_filter_takes_its_order_from_the_scene():
    mapping, _ = case("1D", "lattice")
    settings = Scene.load(None, ["filter.kind=order", "filter.order=5"]).settings("filter.kind")
    assert create("order", mapping, settings).order == 5
    assert not hasattr(create("local", mapping, {}), "order")

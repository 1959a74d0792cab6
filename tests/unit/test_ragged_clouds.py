"""The exact filter on particles that cover only part of their cells: the projection to the tolerance, or refused."""

from collections import Counter

import numpy as np
import pytest

from cloud_helpers import KINDS, Cloud, block, clouds, projected
from mpipic.errors import NotConverged
from mpipic.filters import ExactFilter
from mpipic.filters.measures import share_unseen
from mpipic.mapping.direct_solver import ROUNDING, DirectSolver
from mpipic.mapping.mapping import Mapping
from mpipic.mapping.projection import Projection
from mpipic.mapping.solver import GramSolver
from mpipic.mesh.grid import Grid

TOLERANCE = 1e-10


def turned_block():
    """256 particles in a 4 x 2 box of 12 x 9 cells, turned by 26.6 degrees, cubic: the scaled G goes down to 2e-10."""
    x = np.stack(np.meshgrid(*[(np.arange(16) + 0.5) / 16 - 0.5] * 2), axis=-1).reshape(-1, 2) * (1.9, 0.6)
    turn = np.array([[2.0, -1.0], [1.0, 2.0]]) / np.sqrt(5.0)
    return Mapping(Grid((12, 9), (4.0, 2.0), basis="cubic"), x @ turn.T + (2.0, 1.0))


def probes(reference, rng):
    """Noise, and the directions that are hardest to get right, in columns."""
    noise = rng.standard_normal((len(reference.vectors), 4))
    return np.concatenate([noise / np.linalg.norm(noise, axis=0), reference.vectors[:, -4:]], axis=1)


def largest(columns):
    return np.linalg.norm(columns, axis=0).max()


@pytest.fixture(scope="module")
def judged():
    """For each of 200 clouds: itself, smallest singular value, ‖P² - P‖ and ‖P - P_svd‖ or why not, factorised."""
    rng, found = np.random.default_rng(5), []
    for cloud in clouds(200):
        mapping = cloud.mapping()
        reference = projected(mapping)
        q, filter_ = probes(reference, rng), ExactFilter(mapping, TOLERANCE)
        try:
            once = filter_.apply(q)
            result = largest(filter_.apply(once) - once), largest(once - reference(q))
        except NotConverged as error:
            result = str(error)
        found.append((cloud, reference.values[-1], result, filter_.solver.factorised))
    return found


def test_on_any_cloud_the_projection_is_had_to_its_tolerance_or_refused(judged):
    assert Counter(cloud.kind for cloud, *_ in judged) == dict.fromkeys(KINDS, 20)
    for cloud, least, result, _ in judged:
        if not isinstance(result, str):
            assert max(result) <= 10 * TOLERANCE, (cloud.name, least, result)


def test_only_what_rounding_leaves_uncertain_is_refused(judged):
    refused = [(cloud, least, result) for cloud, least, result, _ in judged if isinstance(result, str)]
    for cloud, least, why in refused:
        assert least < 1.2 * ROUNDING / TOLERANCE, (cloud.name, least, why)
        assert "particles determine some nodes hardly" in why and "the tolerance is 1e-10" in why
    assert 2 <= len(refused) <= 30
    sure = [result for _, least, result, _ in judged if least > 2.0 * ROUNDING / TOLERANCE]
    assert len(sure) > 160 and not any(isinstance(result, str) for result in sure)


def test_clouds_that_fill_their_cells_are_left_to_conjugate_gradients(judged):
    by_factors = sum(factorised for *_, factorised in judged)
    assert 40 < by_factors < 160
    mapping = Mapping(Grid((12, 12), (1.0, 1.0)), np.random.default_rng(3).random((1200, 2)))
    filter_ = ExactFilter(mapping)
    filter_.apply(np.ones(1200))
    assert not filter_.solver.factorised and filter_.facts()["iterations"] > 2


@pytest.mark.parametrize("tolerance", [1e-6, 1e-8, 1e-10])
def test_the_turned_block_is_projected_to_the_tolerance_asked_for(tolerance):
    mapping = turned_block()
    filter_, reference = ExactFilter(mapping, tolerance), projected(mapping)
    q = probes(reference, np.random.default_rng(1))
    once = filter_.apply(q)
    assert largest(once - reference(q)) <= 10 * tolerance and largest(filter_.apply(once) - once) <= 10 * tolerance
    # what conjugate gradients alone make of it
    alone = mapping.g2p(GramSolver(mapping, 1e-10).solve(mapping.sums(q)))
    assert largest(alone - reference(q)) > 1e-6


def test_a_tolerance_beyond_rounding_is_refused_with_what_helps():
    mapping = turned_block()
    with pytest.raises(NotConverged, match=r"singular value .* 1e-05\).*tolerance is 1e-13.*filter.tolerance = "):
        ExactFilter(mapping, 1e-13).apply(np.ones(256))


def test_weights_count_on_ragged_clouds_too():
    cloud = next(c for c in clouds(50) if c.kind == "turned block" and c.basis == "cubic" and len(c.cells) == 2)
    weight = np.random.default_rng(2).uniform(0.1, 3.0, len(cloud.position))
    mapping = Mapping(Grid(cloud.cells, (1.0, 1.0), basis="cubic"), cloud.position, weight)
    filter_, q = ExactFilter(mapping), np.random.default_rng(3).standard_normal((len(weight), 2))
    once = filter_.apply(q)
    assert filter_.solver.factorised
    np.testing.assert_allclose(filter_.apply(once), once, rtol=0, atol=1e-9 * largest(q))
    np.testing.assert_allclose(weight @ once, weight @ q, rtol=0, atol=1e-8)
    # orthogonal in the weighted product: nodes see nothing of what was taken away
    np.testing.assert_allclose(mapping.sums(q - once), 0.0, atol=1e-9 * largest(q))


def test_columns_that_are_no_numbers_leave_others_alone():
    mapping = turned_block()
    q = np.random.default_rng(4).standard_normal((256, 3))
    q[7, 1] = np.nan
    answer = ExactFilter(mapping).apply(q)
    clean = ExactFilter(mapping).apply(q[:, [0, 2]])
    assert np.isnan(answer[:, 1]).all()
    np.testing.assert_allclose(answer[:, [0, 2]], clean, rtol=0, atol=1e-12)


def test_a_filter_that_moves_from_ragged_to_filled_and_back_follows():
    """The factorisation is kept for a while, then conjugate gradients are tried again."""
    ragged, filled = np.asarray(block(np.random.default_rng(0), 2, 12, 2)), np.random.default_rng(6).random((576, 2))
    mapping = Mapping(Grid((12, 12), (1.0, 1.0), basis="cubic"), ragged)
    filter_, q, ways = ExactFilter(mapping), np.random.default_rng(7).standard_normal(576), []
    for position in [ragged] * 2 + [filled] * 12 + [ragged] * 2:
        mapping.update(position)
        np.testing.assert_allclose(filter_.apply(q), projected(mapping)(q), rtol=0, atol=1e-8)
        ways.append(filter_.solver.factorised)
    assert ways[0] and not ways[13] and ways[-1]


def test_in_a_run_what_is_hardly_determined_is_damped_and_said():
    cloud = next(c for c in clouds(200) if projected(c.mapping()).values[-1] < 1e-7)
    mapping = cloud.mapping()
    reference, q = projected(mapping), np.random.default_rng(8).standard_normal(len(cloud.position))
    filter_ = ExactFilter(mapping)
    with pytest.raises(NotConverged):
        filter_.apply(q)
    filter_.strict = False
    once = filter_.apply(q)
    assert np.linalg.norm(once) <= np.linalg.norm(q)
    sure = reference.vectors[:, reference.values > 1e-5]
    np.testing.assert_allclose(sure.T @ once, sure.T @ q, rtol=0, atol=1e-5)
    (remark,) = filter_.remarks()
    assert "particles determined the projection to" in remark and "damped" in remark
    assert 0.0 <= share_unseen(mapping, q[:, None]) <= 1.0


def test_where_there_are_too_many_nodes_to_factorise_iterations_go_on(monkeypatch):
    monkeypatch.setattr("mpipic.mapping.direct_solver.MOST_NODES", {1: 0, 2: 0, 3: 0})
    cloud = Cloud("sparse", "linear", (24, 24), np.random.default_rng(0).random((1152, 2)))
    mapping = cloud.mapping()
    reference, filter_ = projected(mapping), ExactFilter(mapping, 1e-8)
    q = probes(reference, np.random.default_rng(1))
    assert largest(filter_.apply(q) - reference(q)) <= 1e-7
    assert not filter_.solver.factorised and GramSolver(mapping, 1e-8).smallest == np.inf
    hard, q = ExactFilter(turned_block(), TOLERANCE), np.random.default_rng(2).standard_normal(256)
    with pytest.raises(NotConverged, match="too many nodes for a factorisation"):
        hard.apply(q)
    hard.strict = False
    assert np.linalg.norm(hard.apply(q)) <= np.linalg.norm(q) and "determined the projection to" in hard.remarks()[0]


def test_options_of_a_user_are_followed_alone():
    from petsc4py import PETSc

    options = PETSc.Options("filter_")
    options["ksp_max_it"] = 40
    try:
        with pytest.raises(NotConverged, match="after 40 iterations"):
            ExactFilter(turned_block()).apply(np.random.default_rng(2).standard_normal(256))
    finally:
        options.delValue("ksp_max_it")


def test_a_refused_cloud_leaves_the_solver_usable():
    mapping = turned_block()
    solver = DirectSolver(mapping, 1e-13)
    sums = mapping.sums(np.ones(256))
    with pytest.raises(NotConverged):
        solver.solve(sums)
    np.testing.assert_allclose(mapping.g2p(solver.solve(sums, strict=False)), 1.0, atol=1e-9)
    assert Projection(mapping, 1e-8).solve(sums).shape == sums.shape

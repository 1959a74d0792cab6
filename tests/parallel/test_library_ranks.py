"""Claims about the library on several ranks: particles held anywhere are placed, mapped, filtered and given back."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from helpers import run_ranks

HELPERS = Path(__file__).with_name("library_helpers.py")
_spec = importlib.util.spec_from_file_location("library_helpers", HELPERS)
program = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(program)

pytestmark = pytest.mark.mpi

RANKS = (1, 2, 3, 4)
TOLERANCE = {"local": 1e-12, "svd": 1e-12, "exact": 1e-10}
"""Of values of size 1; exact is solved to a residual of 1e-12, and the error may be larger than the residual."""
Answer = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int, str, int], Answer]:
    """What came back, in the order of ids; every number of ranks is started once."""
    folder = tmp_path_factory.mktemp("library")
    said: dict[int, str] = {}

    def answer(dim: int, distribution: str, ranks: int) -> Answer:
        place = folder / str(ranks)
        if ranks not in said:
            said[ranks] = "see the first test that failed"
            place.mkdir()
            ended = run_ranks(ranks, HELPERS, str(place), timeout=60)
            said[ranks] = ended.stdout + ended.stderr
            assert ended.returncode == 0 and "all refused" in ended.stdout, said[ranks]
        file = place / f"{dim}d-{distribution}.npz"
        assert file.exists(), said[ranks]
        with np.load(file) as arrays:
            return dict(arrays)

    return answer


def dense(dim: int, distribution: str) -> tuple[np.ndarray, list[np.ndarray]]:
    """Φ and its derivatives D^a of the linear basis as full matrices, nodes x fastest: the definition, plainly."""
    cells, length = program.BOXES[dim]
    position = program.particles(dim, distribution)["position"]
    h = np.array(length) / cells
    cell = np.floor(position / h + 1e-10).astype(int)
    fraction = position / h - cell
    phi = np.zeros((len(position), int(np.prod(cells))))
    slopes = [np.zeros_like(phi) for _ in range(dim)]
    for corner in product((0, 1), repeat=dim):
        weight = np.where(corner, fraction, 1.0 - fraction)
        node = np.ravel_multi_index(((cell + corner) % cells).T[::-1], cells[::-1])
        rows = np.arange(len(position))
        np.add.at(phi, (rows, node), weight.prod(axis=1))
        for axis in range(dim):
            others = np.delete(weight, axis, axis=1).prod(axis=1)
            np.add.at(slopes[axis], (rows, node), (2 * corner[axis] - 1) / h[axis] * others)
    return phi, slopes


everywhere = pytest.mark.parametrize(("dim", "distribution"), list(product((1, 2, 3), program.DISTRIBUTIONS)))


@everywhere
def test_values_go_to_the_owners_and_come_back_in_the_callers_order(
    answers: Callable[..., Answer], dim: int, distribution: str
) -> None:
    whole = program.particles(dim, distribution)
    for ranks in RANKS:
        found = answers(dim, distribution, ranks)
        assert np.array_equal(found["ids"], np.arange(program.COUNT)), ranks
        assert np.array_equal(found["round_trip"], whole["scalar"]), ranks
        assert np.array_equal(found["round_trip_vector"], whole["vector"]), ranks
        if ranks > 1:
            assert np.count_nonzero(found["owner"] != found["holder"]) > program.COUNT / 8, "few were placed elsewhere"
            assert (set(found["owner"]) == set(range(ranks))) == (distribution != "corner"), "ranks that own particles"


@everywhere
def test_mapping_and_filter_are_the_dense_matrices(answers: Callable[..., Answer], dim: int, distribution: str) -> None:
    whole = program.particles(dim, distribution)
    phi, slopes = dense(dim, distribution)
    weights = phi.sum(axis=0)
    means = np.divide(phi.T, weights[:, None], out=np.zeros_like(phi.T), where=weights[:, None] > 0)
    nodal = means @ whole["vector"]
    expected = {
        "local": phi @ (means @ whole["scalar"]),
        "local_vector": phi @ nodal,
        "slope": np.stack([slope @ nodal[:, 0] for slope in slopes], axis=1),
        "divergence": np.sum([slope @ nodal[:, axis] for axis, slope in enumerate(slopes)], axis=0),
        "sums": whole["vector"].sum(axis=0),
    }
    for ranks in RANKS:
        found = answers(dim, distribution, ranks)
        for name, values in expected.items():
            difference = float(np.abs(found[name] - values).max())
            assert difference < 1e-12 * float(np.abs(values).max()), (ranks, name)
        assert abs(float(found["weights"]) - program.COUNT) < 1e-10, ranks
    changed = float(np.abs(expected["local"] - whole["scalar"]).max())
    assert changed > 0.1, "a filter that does nothing must not pass"


def projection(phi: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
    """Φ (ΦᵀVΦ)⁺ ΦᵀV as a full matrix, by the singular values of V^½ Φ; V is the identity without weights."""
    each = np.ones(len(phi)) if weight is None else np.sqrt(weight)
    u, s, _ = np.linalg.svd(each[:, None] * phi, full_matrices=False)
    kept = s > 1e-10 * s[0]
    assert np.all(s[kept] > 1e-6 * s[0]), "rank must not be a matter of rounding"
    return (u[:, kept] @ u[:, kept].T) * each / each[:, None]


@pytest.mark.parametrize("kind", ["exact", "svd"])
@everywhere
def test_the_global_filters_are_the_dense_projection(
    answers: Callable[..., Answer], dim: int, distribution: str, kind: str
) -> None:
    whole = program.particles(dim, distribution)
    keep = projection(dense(dim, distribution)[0])
    for ranks, (name, values) in product(RANKS, ((kind, whole["scalar"]), (f"{kind}_vector", whole["vector"]))):
        found, expected = answers(dim, distribution, ranks), keep @ values
        assert float(np.abs(found[name] - expected).max()) < TOLERANCE[kind], ranks
        assert float(np.abs(expected - found[name.replace(kind, "local")]).max()) > 0.1, "not the local filter"


@pytest.mark.parametrize("ranks", RANKS)
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_filters_of_weighted_particles_are_the_dense_matrices_and_keep_the_weighted_sum(
    answers: Callable[..., Answer], dim: int, ranks: int
) -> None:
    found, whole = answers(dim, "weighted", ranks), program.particles(dim, program.WEIGHTED)
    phi, weight, q = dense(dim, program.WEIGHTED)[0], whole["weight"], whole["vector"]
    local = phi @ ((phi.T * weight) / (phi.T @ weight)[:, None])
    for kind, keep in {"local": local, "exact": projection(phi, weight), "svd": projection(phi, weight)}.items():
        assert float(np.abs(found[kind] - keep @ q).max()) < TOLERANCE[kind], kind
        lost = float(np.abs(weight @ found[kind] - weight @ q).max())
        assert lost < 1e-11 * float(weight @ np.abs(q).max(axis=1)), kind
        assert np.abs(found[kind].sum(axis=0) - q.sum(axis=0)).max() > 0.1, "the plain sum is another"

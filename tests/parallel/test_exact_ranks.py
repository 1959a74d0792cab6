"""Claims about the exact filter's solver on several ranks: what it does is independent of how the nodes are split."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from helpers import run_ranks

HELPERS = Path(__file__).with_name("exact_helpers.py")
_spec = importlib.util.spec_from_file_location("exact_helpers", HELPERS)
program = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(program)

pytestmark = pytest.mark.mpi

RANKS = (1, 2, 3, 4)
AGREEMENT = 1e-8
"""Of answers to values of size 1, each solved to a residual of 1e-10: the error may be larger than the residual."""

Answer = dict[str, np.ndarray]
Answers = Callable[..., Answer]
every_case = pytest.mark.parametrize("case", program.CASES)


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> Answers:
    """Answers and iterations by case, ranks and PETSc's options; every pair of the two is started once."""
    folder = tmp_path_factory.mktemp("exact")
    said: dict[Path, str] = {}

    def answer(case: str, ranks: int, options: str = "") -> Answer:
        place = folder / f"{ranks}{options.replace(' ', '')}"
        if place not in said:
            said[place] = "see the first test that failed"
            place.mkdir()
            with pytest.MonkeyPatch.context() as patch:
                patch.setenv("PETSC_OPTIONS", options)
                ended = run_ranks(ranks, HELPERS, str(place), timeout=60)
            said[place] = ended.stdout + ended.stderr
            assert ended.returncode == 0, said[place]
        assert (place / f"{case}.npz").exists(), said[place]
        with np.load(place / f"{case}.npz") as arrays:
            return {**arrays, "said": np.array(said[place])}

    return answer


@every_case
def test_iterations_do_not_depend_on_the_number_of_ranks(answers: Answers, case: str) -> None:
    counts = []
    for ranks in RANKS:
        everywhere = answers(case, ranks)["iterations"]
        assert everywhere.shape == (2, ranks), "two positions, the ranks"
        assert np.all(everywhere == everywhere[:, :1]), "all ranks of a run count the same"
        counts.append(everywhere[:, 0])
    assert np.min(counts) > 3, "nothing to solve"
    assert np.all(np.ptp(counts, axis=0) <= 2), counts


@pytest.mark.parametrize("ranks", [2, 3, 4])
@every_case
def test_answers_do_not_depend_on_the_number_of_ranks(answers: Answers, case: str, ranks: int) -> None:
    one, many = answers(case, 1)["answers"], answers(case, ranks)["answers"]
    values = program.particles(case)[1]
    assert float(np.abs(many - one).max()) < AGREEMENT
    for answer in one:
        assert 0.2 < np.linalg.norm(answer) / np.linalg.norm(values) < 0.8, "a part is kept, a part is removed"
    assert float(np.abs(one[1] - one[0]).max()) > 0.1, "the filter went with the particles"


@pytest.mark.parametrize("kind", ["gamg", "bjacobi"])
@every_case
def test_preconditioners_that_need_matrix_entries_get_them_and_agree(answers: Answers, case: str, kind: str) -> None:
    usual, other = answers(case, 2), answers(case, 2, f"-filter_pc_type {kind} -filter_ksp_view")
    assert f"type: {kind}" in str(other["said"]) and "type: mpiaij" in str(other["said"])
    assert f"type: {kind}" not in str(usual["said"])
    assert float(np.abs(other["answers"] - usual["answers"]).max()) < AGREEMENT
    assert other["iterations"].max() < 35, "without any it takes 42 to 78"


@pytest.mark.parametrize("ranks", RANKS)
def test_a_ragged_cloud_is_projected_alike_on_any_number_of_ranks_by_factors(answers: Answers, ranks: int) -> None:
    found = answers("block", ranks)
    assert found["told"].tolist() == [""] * ranks and found["factorised"].all()
    assert float(np.abs(found["answers"] - answers("block", 1)["answers"]).max()) < AGREEMENT
    assert 0.2 < np.linalg.norm(found["answers"]) / np.linalg.norm(program.cloud("block")[1]) < 0.9


@pytest.mark.parametrize("ranks", RANKS)
def test_a_cloud_that_does_not_determine_the_projection_is_refused_on_all_ranks(answers: Answers, ranks: int) -> None:
    found = answers("line", ranks)
    (told,) = set(found["told"].tolist())
    assert "particles determine some nodes hardly" in told and "filter.kind" in told
    np.testing.assert_array_equal(found["answers"], program.cloud("line")[1])

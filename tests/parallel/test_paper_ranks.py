"""Claims about `mpipic paper`: any number of ranks leaves the same figures, and a page that holds them."""

from __future__ import annotations

import base64
import csv
import re
from pathlib import Path

import numpy as np
import pytest

from helpers import mpipic_here, run_ranks

HELPERS = Path(__file__).with_name("paper_helpers.py")
FIGURES = [f"figure-{number}" for number in range(1, 9)]


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """What one and two ranks left."""
    found = {}
    for ranks in (1, 2):
        found[ranks] = tmp_path_factory.mktemp("paper") / str(ranks)
        ended = run_ranks(ranks, HELPERS, str(found[ranks]), timeout=120)
        assert ended.returncode == 0, ended.stdout + ended.stderr
    return found


def columns(file: Path) -> tuple[list[str], np.ndarray]:
    with file.open(newline="") as stream:
        header, *rows = csv.reader(stream)
    return header, np.array(rows, dtype=float)


@pytest.mark.mpi
@pytest.mark.parametrize("name", FIGURES)
def test_one_and_two_ranks_leave_the_same_numbers(folders: dict[int, Path], name: str) -> None:
    (header, one), (again, two) = (columns(folders[ranks] / f"{name}.csv") for ranks in (1, 2))
    assert header == again and one.shape == two.shape == (32, len(header))
    assert np.abs(one[:, 1:]).max() > 0.0
    assert np.abs(one - two).max() <= 1e-10 * np.abs(one).max()


@pytest.mark.mpi
def test_one_and_two_ranks_leave_the_same_maps(folders: dict[int, Path]) -> None:
    one, two = (list(csv.DictReader((folders[ranks] / "maps.csv").read_text().splitlines())) for ranks in (1, 2))
    assert len(one) == len(two) == 4 * (2 * 3 + 2) and {row["filter"] for row in one} >= {"svd", "local"}
    for row, other in zip(one, two, strict=True):
        words, numbers = list(row)[:2], list(row)[2:]
        assert [row[name] for name in words] == [other[name] for name in words]
        for name in numbers:
            found, again = (float(it[name]) if it[name] else -1.0 for it in (row, other))
            assert found == pytest.approx(again, rel=1e-6, abs=1e-9), (row, name)
    assert {row["last_good_step"] == "" for row in one} == {True, False}
    assert all((row["error"] == "") == row["part"].startswith("dimensions") for row in one)


@pytest.mark.mpi
def test_the_page_holds_every_picture_and_a_verdict_on_every_claim(folders: dict[int, Path]) -> None:
    page = (folders[2] / "paper.html").read_text("utf-8")
    images = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    pictures = [(folders[2] / f"{name}.png").read_bytes() for name in [*FIGURES, "costs", "map-steps", "map-errors"]]
    assert [base64.b64decode(image) for image in images] == pictures
    assert not re.search(r'(src|href)="(?!data:)', page)
    claims, verdicts = page.count("<blockquote>"), re.findall(r'class="verdict ([a-z-]+)"', page)
    assert claims >= 12 and len(verdicts) == 2 * claims
    assert {*verdicts} <= {"confirmed", "confirmed-with-a-limit", "contradicted"}
    assert "&lt;span" not in page and "[filter]" not in page and "per_cell" in page
    assert "measured by --long" in page


@pytest.mark.mpi
def test_an_earlier_page_is_kept_and_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "paper.html").write_text("earlier")
    refused = mpipic_here("paper", "-o", tmp_path)
    assert refused.returncode == 2 and "--overwrite" in refused.stderr and "Traceback" not in refused.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["paper.html"]
    refused = mpipic_here("paper", "-o", tmp_path / "paper.html")
    assert refused.returncode == 1 and "cannot be written" in refused.stderr

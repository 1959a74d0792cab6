"""Claims about unstable runs: they end with exit code 3, say where it happened, and keep the last good output."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from helpers import ROOT, mpipic

# A step so long that waves grow from the start, from the signal and not from rounding. The ranks look for a blow-up at
# steps 0 and 1, then every fifth.
GROWING = [
    "grid.cells=[12, 9]", "gas.flow=[0.3, -0.2]", "particles.layout=random", "particles.per_cell=[6]",
    "initial.sharpness=15", "filter.kind=none", "time.cfl=1.2", "time.steps=4000", "time.blow_up=1.5",
    "output.every=5", "output.report_at=[1]",
]  # fmt: skip

Run = dict[str, Any]


def run(folder: Path, ranks: int, *arguments: str | Path) -> Run:
    ended = mpipic("run", *arguments, "--output", folder, ranks=ranks)
    assert ended.returncode == 3, f"{ended.returncode}\n{ended.stdout}\n{ended.stderr}"
    summary = json.loads((folder / "summary.json").read_text())
    return {"summary": summary, "said": ended.stderr, "printed": ended.stdout, "folder": folder}


@pytest.fixture(scope="module")
def growing(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], Run]:
    """The growing scene on a number of ranks, run once each."""
    done: dict[int, Run] = {}

    def result(ranks: int) -> Run:
        if ranks not in done:
            overrides = [word for text in GROWING for word in ("--set", text)]
            folder = tmp_path_factory.mktemp("growing") / str(ranks)
            done[ranks] = run(folder, ranks, *overrides, *([] if ranks == 2 else ["--no-plots"]))
        return done[ranks]

    return result


pytestmark = pytest.mark.mpi
RANKS = pytest.mark.parametrize("ranks", [1, 2, 3])


@RANKS
def test_the_message_names_step_time_cell_rank_and_cfl_once(growing: Callable[[int], Run], ranks: int) -> None:
    found = growing(ranks)
    bad, summary = found["summary"]["blow_up"], found["summary"]
    errors = [line for line in found["said"].splitlines() if line.startswith("error: ")]
    assert len(errors) == 1 and "Traceback" not in found["said"]
    pattern = r"unstable: .*at step (\d+), t = ([\d.e-]+), in cell \[(\d+), (\d+)\] on rank (\d+); CFL 1\.2\b"
    step, time, i, j, rank = re.search(pattern, errors[0]).groups()
    assert (int(step), [int(i), int(j)], int(rank)) == (bad["step"], bad["cell"], bad["rank"])
    assert math.isclose(float(time), bad["step"] * 0.1, rel_tol=1e-5)  # dt = 1.2 / 12
    assert summary["status"] == "unstable" and summary["cfl"] == 1.2 and summary["ranks"] == ranks
    assert 0 <= int(rank) < ranks


@RANKS
def test_the_blow_up_is_dated_to_the_same_step_and_cell_on_any_number_of_ranks(
    growing: Callable[[int], Run], ranks: int
) -> None:
    one, found = growing(1)["summary"], growing(ranks)["summary"]
    assert found["blow_up"]["step"] == found["steps"] == one["steps"] > 1
    assert found["blow_up"]["cell"] == one["blow_up"]["cell"]
    assert math.isclose(found["blow_up"]["value"], one["blow_up"]["value"], rel_tol=1e-9)


def test_the_date_is_the_first_step_beyond_the_limit(growing: Callable[[int], Run], tmp_path: Path) -> None:
    """On 2 ranks: on any other number it is the same date, see above."""
    bad = growing(2)["summary"]["blow_up"]
    limit = 1.5 * initial_peak(growing(2)["folder"])
    assert bad["value"] > limit
    assert bad["step"] % 5 and bad["step"] % 10 and bad["step"] > 1, "a step at which the ranks do not talk"
    words = [word for text in GROWING for word in ("--set", text)]
    before = ["--set", f"time.steps={bad['step'] - 1}", "--no-plots", "--output", tmp_path / "before"]
    ended = mpipic("run", *words, *before, ranks=2)
    assert ended.returncode == 0, ended.stderr
    assert json.loads((tmp_path / "before" / "summary.json").read_text())["status"] == "completed"


def initial_peak(folder: Path) -> float:
    with h5py.File(folder / "particles.h5") as file:
        return float(np.abs(file["data/0/particles/gas/density"][:]).max())


@RANKS
def test_the_good_snapshots_are_kept(growing: Callable[[int], Run], ranks: int) -> None:
    found = growing(ranks)
    limit = 1.5 * initial_peak(found["folder"])
    with h5py.File(found["folder"] / "particles.h5") as file:
        steps = sorted(map(int, file["data"]))
        assert steps == list(range(0, found["summary"]["steps"], 5)) and len(steps) > 1
        for step in steps:
            density = file[f"data/{step}/particles/gas/density"][:]
            assert len(density) == 12 * 9 * 6 and np.abs(density).max() <= limit
    assert [error["step"] for error in found["summary"]["errors"]] == [1]
    assert not [path for path in found["folder"].iterdir() if path.suffix in (".part", ".tmp")]


def test_pictures_of_an_unstable_run_are_drawn(growing: Callable[[int], Run]) -> None:
    assert all((growing(2)["folder"] / name).stat().st_size > 5000 for name in ("error.png", "solution.png"))


def test_the_papers_unfiltered_scene_ends_unstable_before_step_1000_on_1_2_and_3_ranks(tmp_path: Path) -> None:
    scene = ROOT / "configs" / "paper-unfiltered.toml"
    ends = []
    for ranks in (1, 2, 3):
        found = run(tmp_path / str(ranks), ranks, scene, "--no-plots")
        ends.append(found["summary"]["steps"])
        by_step = {error["step"]: error["density"]["l2"] for error in found["summary"]["errors"]}
        assert math.isclose(by_step[100], 5.3581e-3, rel_tol=1e-4), "the number that the scene's header states"
    assert min(ends) > 700 and max(ends) < 1000
    assert max(ends) - min(ends) <= 50, f"noise grows from rounding, 5 % a step: {ends}"


@pytest.mark.parametrize("ranks", [1, 2])
def test_a_run_that_overflows_is_unstable_and_its_summary_still_json(tmp_path: Path, ranks: int) -> None:
    words = ["time.cfl=1e120", "time.blow_up=1e300", "time.steps=50", "grid.cells=[10]", "gas.flow=[1e-121]"]
    found = run(tmp_path / "out", ranks, "--no-plots", *[word for text in words for word in ("--set", text)])
    bad = found["summary"]["blow_up"]
    assert found["summary"]["status"] == "unstable" and 1 <= bad["step"] <= 3
    assert bad["value"] is None or bad["value"] > 1e300
    assert "Traceback" not in found["said"] and "Warning" not in found["said"]
    text = (tmp_path / "out" / "summary.json").read_text() + (tmp_path / "out" / "history.csv").read_text()
    assert "NaN" not in text and "Infinity" not in text

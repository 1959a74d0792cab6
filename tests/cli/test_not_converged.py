"""Claims about solvers that fail: exit code 4, one line that says what was reached, and all output until then."""

from __future__ import annotations

import csv
import json
import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from helpers import mpipic

pytestmark = pytest.mark.mpi
RANKS = pytest.mark.parametrize("ranks", [1, 2])
CELLS = 40


def overrides(*texts: str) -> list[str]:
    return [word for text in texts for word in ("--set", text)]


RANDOM = overrides("grid.cells=[12, 10]", "particles.layout=random", "initial.sharpness=15", "filter.kind=exact")


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "history.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def check_refusal(ended: subprocess.CompletedProcess[str], most: int) -> None:
    """Exit code 4, and one line about a solve that took `most` iterations and missed its tolerance."""
    assert ended.returncode == 4, f"{ended.returncode}\n{ended.stdout}\n{ended.stderr}"
    (line,) = (line for line in ended.stderr.splitlines() if line.startswith("error: "))
    pattern = r"ended at residual ([\d.e+-]+) after (\d+) iterations .*asked for is 1e-10 of the right-hand side's norm"
    residual, iterations = re.search(pattern, line).groups()
    assert float(residual) > 1e-10 and int(iterations) == most
    for word in ("Traceback", "PETSC ERROR", "unstable"):
        assert word not in ended.stdout + ended.stderr
    assert "results in" not in ended.stdout


@RANKS
def test_a_solver_that_is_cut_short_at_once_ends_the_run_with_exit_code_4(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ranks: int
) -> None:
    monkeypatch.setenv("PETSC_OPTIONS", "-filter_ksp_max_it 1")
    ended = mpipic("run", *RANDOM, *overrides("time.steps=20"), "--output", tmp_path / "out", ranks=ranks)
    check_refusal(ended, most=1)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"scene.toml", "history.csv"}
    (row,) = rows_of(tmp_path / "out")
    assert row["step"] == "0" and float(row["max_density"]) > 0.9


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], SimpleNamespace]:
    """A run that gets harder: particles begin near the nodes and move to the middles of the cells. Run once each."""
    folder = tmp_path_factory.mktemp("late")
    with h5py.File(folder / "particles.h5", "w") as file:
        near = 0.02 + 0.05 * np.random.default_rng(1).random(CELLS)
        file["position"] = ((np.arange(CELLS) + near) / CELLS)[:, None]
    scene = overrides(
        f"grid.cells=[{CELLS}]", "particles.layout=file", f"particles.path={folder / 'particles.h5'}", "gas.flow=[0.4]",
        "filter.kind=exact", "time.cfl=0.05", "time.steps=40", "output.every=1", "output.report_at=[0, 2]",
    )  # fmt: skip
    done: dict[int, SimpleNamespace] = {}

    def result(ranks: int) -> SimpleNamespace:
        if ranks not in done:
            out = folder / str(ranks)
            with pytest.MonkeyPatch.context() as patch:
                patch.setenv("PETSC_OPTIONS", "-filter_ksp_max_it 10")
                done[ranks] = SimpleNamespace(ended=mpipic("run", *scene, "--output", out, ranks=ranks), folder=out)
        return done[ranks]

    return result


@RANKS
def test_a_solver_that_fails_later_ends_the_run_the_same_way(
    late: Callable[[int], SimpleNamespace], ranks: int
) -> None:
    check_refusal(late(ranks).ended, most=10)


@RANKS
def test_history_and_snapshots_until_then_are_kept(late: Callable[[int], SimpleNamespace], ranks: int) -> None:
    folder = late(ranks).folder
    assert {path.name for path in folder.iterdir()} == {"scene.toml", "history.csv", "particles.h5"}
    rows = rows_of(folder)
    steps = [int(row["step"]) for row in rows]
    assert steps == list(range(len(steps))) and 3 < len(steps) < 40
    assert [row["step"] for row in rows if row["density_l2"]] == ["0", "2"]
    with h5py.File(folder / "particles.h5") as file:
        assert sorted(map(int, file["data"])) == steps
        for step in steps:
            assert np.abs(file[f"data/{step}/particles/gas/density"][:]).max() < 1.1


def run_unstable(folder: Path, ranks: int, *texts: str) -> dict[str, object]:
    words = [*overrides(*texts), "--no-plots", "--output", folder]
    ended = mpipic("run", *words, ranks=ranks)
    assert ended.returncode == 3, f"{ended.returncode}\n{ended.stdout}\n{ended.stderr}"
    assert ended.stderr.count("error: unstable: ") == 1 and "residual" not in ended.stderr
    assert "Traceback" not in ended.stderr and "Warning" not in ended.stderr
    return json.loads((folder / "summary.json").read_text())


@pytest.mark.parametrize(("ranks", "limit"), [(1, "1e80"), (2, "100")])
def test_a_run_that_blows_up_under_the_exact_filter_is_unstable(tmp_path: Path, ranks: int, limit: str) -> None:
    """Also where values grow by many orders of magnitude before it counts as one."""
    more = ["time.cfl=3", "time.steps=4000", f"time.blow_up={limit}"]
    summary = run_unstable(tmp_path / "out", ranks, *RANDOM[1::2], *more)
    assert summary["status"] == "unstable"
    assert (summary["steps"] > 50) == (limit == "1e80")


@pytest.mark.parametrize("kind", ["exact", "svd"])
def test_a_run_that_overflows_is_unstable(tmp_path: Path, kind: str) -> None:
    words = ["time.cfl=1e120", "time.blow_up=1e300", "time.steps=50", "grid.cells=[10]", "gas.flow=[1e-121]"]
    summary = run_unstable(tmp_path / "out", 1, *words, f"filter.kind={kind}")
    assert summary["status"] == "unstable" and 1 <= summary["steps"] <= 3

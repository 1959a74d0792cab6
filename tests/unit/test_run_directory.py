"""Claims about the run directory and its text files."""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from helpers import HISTORY_COLUMNS
from mpipic.errors import OutputError
from mpipic.io import run_directory
from mpipic.io.run_directory import SCENE_HEADER, RunDirectory

COMM = MPI.COMM_SELF
SCENE = SimpleNamespace(name="wave", to_toml=lambda: "[grid]\ncells = [4]\n")


def test_a_run_directory_is_created_with_its_parents(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / "a" / "b", COMM)
    assert run.path == tmp_path / "a" / "b" and run.path.is_dir()


@pytest.mark.parametrize("name", ["summary.json", "history.csv", "particles.h5", "particles.h5.part"])
def test_results_of_another_run_are_refused_by_name_and_replaced_only_on_request(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("old")
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "scene.toml").write_text(SCENE_HEADER)
    with pytest.raises(OutputError, match=re.escape(str(tmp_path)) + ".*" + re.escape(name) + ".*--overwrite"):
        RunDirectory(tmp_path, COMM)
    assert (tmp_path / name).read_text() == "old"
    RunDirectory(tmp_path, COMM, overwrite=True)
    assert not (tmp_path / name).exists()
    assert (tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("name", ["scene.toml", "summary.json", "history.csv", "particles.h5"])
def test_what_no_run_wrote_is_never_cleared(tmp_path: Path, name: str, overwrite: bool) -> None:
    (tmp_path / name).write_text("# mine\n[grid]\n")
    with pytest.raises(OutputError, match=re.escape(name) + ", which no run of this program left"):
        RunDirectory(tmp_path, COMM, overwrite)
    assert (tmp_path / name).read_text() == "# mine\n[grid]\n"


def test_the_working_folder_is_never_cleared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    RunDirectory(tmp_path, COMM).write_scene(SCENE)
    (tmp_path / "history.csv").write_text("step\n")
    monkeypatch.chdir(tmp_path)
    for path in (Path(), tmp_path, Path("..") / tmp_path.name):
        with pytest.raises(OutputError, match="working folder"):
            RunDirectory(path, COMM, overwrite=True)
    assert (tmp_path / "history.csv").read_text() == "step\n"


def test_looking_whether_a_folder_can_be_used_changes_nothing(tmp_path: Path) -> None:
    RunDirectory.check(tmp_path / "new", COMM, overwrite=False)
    RunDirectory.check(tmp_path, COMM, overwrite=True)
    assert not list(tmp_path.iterdir())


def test_a_folder_where_only_a_run_wrote_its_scene_can_be_used_again(tmp_path: Path) -> None:
    RunDirectory(tmp_path, COMM).write_scene(SCENE)
    assert "cells = [4]" in (tmp_path / "scene.toml").read_text()
    RunDirectory(tmp_path, COMM)


def test_a_file_in_place_of_the_folder_is_an_output_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OutputError, match=re.escape(str(path))):
            RunDirectory(path, COMM)
    with pytest.raises(OutputError, match="file"):
        RunDirectory.default("wave", COMM, tmp_path / "file")


def test_default_names_are_dated_free_and_made_of_plain_characters(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(run_directory.time, "strftime", lambda form: "20300102-030405")
    names = [RunDirectory.default("my wave/2", COMM, tmp_path).name for _ in range(3)]
    assert names == [f"my-wave-2-20300102-030405{end}" for end in ("", "-2", "-3")]
    assert RunDirectory.default("../..", COMM, tmp_path).parent == tmp_path


def test_other_ranks_write_nothing(tmp_path: Path) -> None:
    other = SimpleNamespace(rank=1, bcast=lambda value: value)
    run = RunDirectory(tmp_path, other)
    run.write_scene(SCENE)
    run.write_summary({})
    run.write_history(HISTORY_COLUMNS, [])
    assert list(tmp_path.iterdir()) == []


# --- text files ----------------------------------------------------------------------------------------------------


@dataclass
class Report:
    step: int
    share: float | None


def test_summary_is_strict_json(tmp_path: Path) -> None:
    summary = {
        "nan": float("nan"), "list": (1.5, np.inf, np.float64("-inf")), "array": np.array([1.0, np.nan]),
        "n": np.int64(3), "flag": np.bool_(True), "errors": [Report(7, None)], "path": Path("a/b"),
        "nested": {1: {"x": np.float32(0.5)}}, "name": "ρ",
    }  # fmt: skip
    RunDirectory(tmp_path, COMM).write_summary(summary)

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    assert json.loads((tmp_path / "summary.json").read_text("utf-8"), parse_constant=refuse) == {
        "nan": None, "list": [1.5, None, None], "array": [1.0, None], "n": 3, "flag": True,
        "errors": [{"step": 7, "share": None}], "path": "a/b", "nested": {"1": {"x": 0.5}}, "name": "ρ",
    }  # fmt: skip


def test_history_reads_back_to_the_same_bits_and_none_is_empty(tmp_path: Path) -> None:
    rows = [
        {"step": 0, "time": 0.0, "max_density": np.float64(1 / 3), "density_l2": None},
        {"step": np.int64(10), "time": 0.1 + 0.2, "max_density": np.nan, "density_l2": 5e-324, "extra": "a,b"},
    ]
    RunDirectory(tmp_path, COMM).write_history(HISTORY_COLUMNS, rows)
    with open(tmp_path / "history.csv", newline="") as stream:
        table = list(csv.DictReader(stream))
    assert tuple(table[0]) == (*HISTORY_COLUMNS, "extra")
    assert [row["step"] for row in table] == ["0", "10"]
    assert float(table[0]["max_density"]) == 1 / 3 and float(table[1]["time"]) == 0.1 + 0.2
    assert float(table[1]["density_l2"]) == 5e-324 and np.isnan(float(table[1]["max_density"]))
    assert table[0]["density_l2"] == table[0]["seconds"] == table[0]["extra"] == ""
    assert table[1]["extra"] == "a,b"


def test_a_run_without_snapshots_never_imports_h5py() -> None:
    code = (
        "import sys; import mpipic.io.run_directory, mpipic.plots.solution, mpipic.console;"
        "print({'h5py', 'matplotlib', 'rich'}.intersection(sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "set()\n"

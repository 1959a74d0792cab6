"""Claims about the verb `study`: no point can end it, what is done stays done, and it goes on where it stopped."""

from __future__ import annotations

import csv
import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import psutil
import pytest

from helpers import end, environment, finish, launcher, mpipic, run_python, start, wait_until

STUDY = """
title = "Four ends"
until = 0.5
repeats = 1
timeout = 200
[base]
grid.cells = [12]
time.blow_up = 1.5
[axes]
how = [
    { name = "good", time.cfl = 0.5 },
    { name = "unstable", time.cfl = 2.5, filter.kind = "none", gas.flow = [0.4] },
    { name = "launched by what cannot", time.cfl = 0.5, ranks = 2 },
    { name = "better", time.cfl = 0.25 },
]
"""
FILES = {"points.jsonl", "scenes", "study.csv", "study.json", "work-precision.png", "report.html"}
ENDS = ["completed", "unstable", "crashed", "completed"]
NO_LAUNCHER = {"MPIPIC_MPIEXEC": "false"}


@pytest.fixture
def study(tmp_path: Path) -> Path:
    path = tmp_path / "four.toml"
    path.write_text(STUDY)
    return path


def lines(folder: Path) -> list[dict[str, Any]]:
    path = folder / "points.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "study.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def run(study: Path, folder: Path, *more: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "mpipic", "study", study, "--output", folder, *more]
    return finish(start(command, env=environment(**NO_LAUNCHER)))


def running(folder: Path) -> list[str]:
    """Command lines of all processes that name this folder."""
    every = (" ".join(process.info["cmdline"] or ()) for process in psutil.process_iter(["cmdline"]))
    return [words for words in every if str(folder) in words]


def test_an_interrupted_study_goes_on_where_it_stopped_and_no_point_can_end_it(study: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    command = [sys.executable, "-m", "mpipic", "study", study, "--output", folder]
    process = start(command, env=environment(**NO_LAUNCHER))
    wait_until(lambda: len(lines(folder)) == 1 and len(running(folder)) > 1, process)
    process.send_signal(signal.SIGINT)
    stopped = finish(process)
    assert stopped.returncode == 130 and "goes on from here" in stopped.stderr, stopped.stderr
    assert "Traceback" not in stopped.stderr and running(folder) == []
    first = lines(folder)
    assert [r["status"] for r in first] == ["completed"]
    assert [row["status"] for row in rows(folder)] == ["completed", "not run", "not run", "not run"]
    assert {path.name for path in folder.iterdir()} == FILES

    resumed = run(study, folder)
    assert resumed.returncode == 0 and "3 of 4 runs to do" in resumed.stdout, resumed.stdout + resumed.stderr
    assert "crashed: exit code 1" in resumed.stderr and "Traceback" not in resumed.stderr
    every = lines(folder)
    assert every[0] == first[0] and [r["status"] for r in every] == ENDS
    assert [row["status"] for row in rows(folder)] == ENDS
    check_table(rows(folder))
    assert {path.name for path in folder.iterdir()} == FILES
    assert len(list((folder / "scenes").glob("*.toml"))) == 4

    better = rows(folder)[3]["density_l2"]
    again = run(study, folder, "--recommend", f"error={better}", "--recommend", "error=1e-9", "--recommend", "speed=1")
    assert again.returncode == 2 and "--recommend speed=1: must be" in again.stderr
    again = run(study, folder, "--recommend", f"error={better}", "--recommend", "error=1e-9")
    assert again.returncode == 0 and lines(folder) == every
    assert f"better: error {float(better):.3e}" in again.stdout and "no completed point; the most accur" in again.stdout

    whole = tmp_path / "whole"
    assert run(study, whole).returncode == 0
    for one, other in zip(rows(folder), rows(whole), strict=True):
        for name in ("id", "label", "status", "steps", "dt", "time", "density_l2", "velocity_linf", "message"):
            assert one[name] == other[name], name


def check_table(found: list[dict[str, str]]) -> None:
    good, unstable, crashed, better = found
    assert 0 < float(better["density_l2"]) < float(good["density_l2"]) < 0.5
    assert float(good["time"]) == float(better["time"]) == 0.5
    assert int(good["steps"]) * float(good["dt"]) == 0.5
    assert 0 < int(unstable["steps"]) < 5 + 0.5 / float(unstable["dt"]) and unstable["density_l2"] == ""
    assert "|density|" in unstable["message"] and crashed["seconds"] == crashed["steps"] == ""
    for row in (good, unstable, better):
        assert 0 < float(row["seconds_min"]) <= float(row["seconds"]) <= float(row["seconds_max"])
        assert 3e7 < float(row["peak_memory"]) < 3e9
    assert float(good["particle_steps_per_second"]) > 1
    assert better["on_front"] == "true" and unstable["on_front"] == crashed["on_front"] == "false"


def test_a_changed_study_runs_only_what_is_new_and_a_scene_file_gives_the_same(tmp_path: Path) -> None:
    study, folder = tmp_path / "s.toml", tmp_path / "out"
    study.write_text("until = 0.1\nrepeats = 1\n[axes]\ngrid.cells = [[8]]")
    assert run(study, folder).returncode == 0
    (first,) = lines(folder)
    study.write_text("title = 'more'\nuntil = 0.1\nrepeats = 1\n[axes]\ngrid.cells = [[8], [9]]")
    assert run(study, folder).returncode == 0
    assert lines(folder)[0] == first and len(lines(folder)) == 2
    scene = folder / "scenes" / f"{first['id']}.toml"
    assert mpipic("run", scene, "--output", tmp_path / "one", "--no-plots").returncode == 0
    summary = json.loads((tmp_path / "one" / "summary.json").read_text())
    assert summary["errors"][-1] == first["errors"] and summary["time"] == 0.1


def test_every_mistake_is_said_before_anything_runs(tmp_path: Path) -> None:
    study, folder = tmp_path / "s.toml", tmp_path / "out"
    study.write_text("until = -1\n[axes]\nfilter.kind = ['locl', 'exact']\ngrid.cells = [[8], [0]]")
    ended = run(study, folder)
    assert ended.returncode == 2 and not folder.exists() and "Traceback" not in ended.stderr
    for part in ("until = -1", 'filter.kind = "locl"', "grid.cells = [0]"):
        assert ended.stderr.count(part) == 1, ended.stderr


@pytest.mark.mpi
def test_a_study_refuses_several_ranks_and_under_mpiexec_starts_ranks_itself(tmp_path: Path) -> None:
    study, folder = tmp_path / "s.toml", tmp_path / "out"
    study.write_text("until = 0.1\nrepeats = 1\n[base]\nranks = 2\ngrid.cells = [8]")
    arguments = ["-m", "mpipic", "study", study, "--output", folder]
    refused = run_python(2, *arguments)
    assert refused.returncode == 2 and not folder.exists()
    assert refused.stderr.count("a study runs on one process") == 1
    launched = [*launcher(1), sys.executable, *arguments]
    ended = finish(start(launched))
    assert ended.returncode == 0, ended.stdout + ended.stderr
    (record,) = lines(folder)
    assert (record["status"], record["ranks"], record["particles"]) == ("completed", 2, 16)


def test_two_studies_do_not_share_a_folder(study: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    process = start([sys.executable, "-m", "mpipic", "study", study, "--output", folder], env=environment())
    try:
        wait_until(lambda: (folder / "scenes").exists(), process)
        second = run(study, folder)
        assert second.returncode == 2 and "another study is writing" in second.stderr
    finally:
        end(process)
    assert running(folder) == []

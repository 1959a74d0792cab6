"""Claims about what surrounds a run: full disks, terminals and locales, launchers; none ends it but in order."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import tracemalloc
from pathlib import Path

import h5py
import pytest
from mpi4py import MPI

from helpers import environment, finish, mpipic_here, run_python, start
from mpipic.run.loop import Simulation
from run_helpers import Reports, scene_of

LIMITED = Path(__file__).with_name("limited_helpers.py")
SNAPSHOTS = ["--no-plots", "--set", "output.every=1", "--set", "time.steps=50", "--set", "output.report_at=[0]"]
SOON = 90.0
"""Seconds after which a run counts as hanging; on a busy machine it may have to compile first."""

# ---------------------------------------------------------------- disks


def limited(folder: Path, size: int, ranks: int, which: str, *more: str) -> subprocess.CompletedProcess[str]:
    """A run in which the ranks `which` can write `size` bytes to a file at most."""
    ended = run_python(ranks, LIMITED, str(size), which, "run", "--quiet", "--output", folder, *more, timeout=SOON)
    assert "Traceback" not in ended.stderr and "signal" not in ended.stderr, ended.stderr
    return ended


@pytest.mark.mpi
@pytest.mark.parametrize(("size", "ranks", "which"), [(60_000, 1, "0"), (90_000, 2, "0"), (90_000, 2, "1")])
def test_a_disk_that_takes_no_more_ends_a_run_with_the_reason(
    tmp_path: Path, size: int, ranks: int, which: str
) -> None:
    folder = tmp_path / "out"
    ended = limited(folder, size, ranks, which, *SNAPSHOTS)
    assert ended.returncode == 1 and "File too large; raise the limit" in ended.stderr, ended.stderr
    assert ended.stderr.count("error: snapshot of step") == 1 and "particles.h5.part" in ended.stderr
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["status"] == "failed" and "snapshot" in summary["lost"][0]
    with h5py.File(folder / "particles.h5") as file:
        assert len(file["data"]) == summary["steps"] > 0
        assert all(len(file[f"data/{step}/particles/gas/density"][:]) == 200 for step in file["data"])
    with (folder / "history.csv").open(newline="") as stream:
        assert [int(row["step"]) for row in csv.DictReader(stream)] == list(range(summary["steps"] + 1))


def test_a_picture_that_cannot_be_written_is_said_and_the_rest_is_there(tmp_path: Path) -> None:
    ended = limited(tmp_path / "out", 15_000, 1, "0", "--set", "time.steps=2")
    assert ended.returncode == 1 and "error.png cannot be written: File too large" in ended.stderr, ended.stderr
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["status"] == "completed"
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"scene.toml", "summary.json", "history.csv"}


# ---------------------------------------------------------------- terminals


def test_what_a_terminal_cannot_show_or_take_ends_nothing(tmp_path: Path) -> None:
    """Encodings without Greek, full devices, closed streams: the exit code and the results are as ever."""
    program = f"{sys.executable} -m mpipic"
    run = f"exec {program} run --no-plots --set time.steps=3 --output"
    cases = {
        "latin-1": (f"PYTHONIOENCODING=latin-1 {run} latin-1", 0, "max |rho|"),
        "ascii": (f"PYTHONIOENCODING=ascii TERM=dumb COLUMNS=20 {run} ascii", 0, "max |rho|"),
        "locale": (f"LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0 {run} locale", 0, "max |rho|"),
        "full": (f"{run} full >/dev/full 2>/dev/full", 0, ""),
        "closed": (f"{run} closed >&- 2>&- <&-", 0, ""),
        "check": (f"exec {program} check >/dev/full", 0, ""),
        "help": (f"exec {program} --help >&-", 0, ""),
        "misused": (f"exec {program} --no-such-option 2>/dev/full", 2, ""),
    }
    processes = {name: start(["/bin/sh", "-c", command], tmp_path) for name, (command, _, _) in cases.items()}
    for name, (_, code, words) in cases.items():
        ended = finish(processes[name])
        assert ended.returncode == code and words in ended.stdout and not ended.stderr, (name, ended)
    for name in ("latin-1", "ascii", "locale", "full", "closed"):
        assert json.loads((tmp_path / name / "summary.json").read_text())["status"] == "completed"


# ---------------------------------------------------------------- the command line, and launchers


@pytest.mark.parametrize("verb", ["run", "spectrum", "filters", "stability", "trials", "bench", "study x.toml"])
def test_a_folder_without_a_name_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: str) -> None:
    monkeypatch.chdir(tmp_path)
    for empty in ("", "  "):
        ended = mpipic_here(*verb.split(), "--output", empty)
        assert ended.returncode == 2 and "--output" in ended.stderr and "empty" in ended.stderr
    assert not list(tmp_path.iterdir())


def test_copies_of_one_process_under_srun_are_refused_and_one_process_of_a_job_is_not(tmp_path: Path) -> None:
    step = {"SLURM_JOB_ID": "7", "SLURM_NTASKS": "4", "SLURM_PROCID": "0"}
    command = [sys.executable, "-m", "mpipic", "run", "--no-plots", "--quiet", "--set", "time.steps=2", "--output"]
    tasks = [step | {"SLURM_PROCID": number, "SLURM_STEP_NUM_TASKS": "4"} for number in "01"]
    copies = [start([*command, "copies"], tmp_path, env=environment(**task)) for task in tasks]
    batch = start([*command, "batch"], tmp_path, env=environment(**step))
    first, second = map(finish, copies)
    assert first.returncode == second.returncode == 1 and second.stderr == ""
    assert "srun started 4 tasks" in first.stderr and "mpiexec" in first.stderr
    assert finish(batch).returncode == 0
    assert [path.name for path in tmp_path.iterdir()] == ["batch"]


def test_the_loop_needs_no_memory_for_steps_to_come() -> None:
    scene = scene_of(time={"steps": 300_000_000, "dt": 1e-3}, output={"every": 1})
    simulation = Simulation(scene, MPI.COMM_SELF)
    tracemalloc.start()
    try:
        assert simulation.run(Reports(), interrupted=lambda: True).step == 0
        assert tracemalloc.get_traced_memory()[1] < 1e6
    finally:
        tracemalloc.stop()

"""Claims about a run directory: what is in it, that it agrees with itself, and that it repeats."""

from __future__ import annotations

import csv
import json
import math
import re
import sys
import tomllib
from pathlib import Path
from typing import Any

import h5py
import matplotlib.image
import numpy as np
import pytest

from helpers import HISTORY_COLUMNS, ROOT, mpipic, mpipic_here, start

PAPER = ROOT / "configs" / "paper.toml"
# a scene in which particles change rank and every file is written
SMALL = [
    "grid.cells=[10, 8]", "gas.flow=[0.7, -0.4]", "particles.layout=random", "initial.sharpness=15", "time.cfl=0.2",
    "time.steps=30", "output.report_at=[10, 20]",
]  # fmt: skip
NORMS = {"l1", "l2", "linf"}


def sets(*texts: str) -> list[str]:
    return [word for text in texts for word in ("--set", text)]


def read_summary(folder: Path) -> dict[str, Any]:
    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is not JSON")

    return json.loads((folder / "summary.json").read_text(), parse_constant=refuse)


def read_history(folder: Path) -> list[dict[str, str]]:
    with (folder / "history.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def final_particles(folder: Path, step: int) -> dict[str, np.ndarray]:
    """Particles of a snapshot in the order of their ids."""
    with h5py.File(folder / "particles.h5") as file:
        gas = file[f"data/{step}/particles/gas"]
        order = np.argsort(gas["id"][:])
        names = ["id", "density", *(f"{name}/{axis}" for name in ("position", "velocity") for axis in gas[name])]
        return {name: gas[name][:][order] for name in names}


@pytest.fixture(scope="module")
def paper(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, str]:
    """The paper's scene on 2 ranks: folder, what was printed, what went to standard error."""
    folder = tmp_path_factory.mktemp("paper") / "out"
    ended = mpipic("run", PAPER, "--output", folder, ranks=2)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return folder, ended.stdout, ended.stderr


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A small scene on 2 ranks with snapshots, and what was printed."""
    folder = tmp_path_factory.mktemp("small") / "out"
    arguments = ["run", "--output", folder, "--no-plots", *sets(*SMALL, "output.every=15")]
    ended = mpipic(*arguments, ranks=2)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return folder, ended.stdout


@pytest.mark.mpi
def test_the_summary_holds_what_is_promised(paper: tuple[Path, str, str]) -> None:
    found = read_summary(paper[0])
    counts = {name: found[name] for name in ("status", "steps", "ranks", "particles", "nodes")}
    assert counts == {"status": "completed", "steps": 1000, "ranks": 2, "particles": 200, "nodes": 100}
    assert found["time"] == 1000 * 1.25e-3
    assert [(error["step"], error["time"]) for error in found["errors"]] == [
        (step, step * 1.25e-3) for step in (100, 600, 700, 1000)
    ]
    for error in found["errors"]:
        assert set(error) >= {"step", "time", "density", "velocity", "null_space_fraction"}
        for field in ("density", "velocity"):
            assert set(error[field]) == NORMS
            assert 0 < error[field]["l1"] <= error[field]["l2"] <= error[field]["linf"] < 0.1
    assert set(found["seconds"]) >= {"total", "setup", "step", "phases"}
    seconds, phases = found["seconds"], found["seconds"]["phases"]
    assert 0 < seconds["step"] < seconds["total"] and 0 < seconds["setup"] < seconds["total"]
    assert phases and sum(phases.values()) <= seconds["total"] * 1.02
    assert math.isclose(found["particle_steps_per_second"], 200 * 1000 / seconds["step"], rel_tol=1e-6)
    assert {"mpipic", "numpy", "mpi4py", "petsc4py", "python", "mpi"} <= set(found["versions"])
    assert found["scene"] == tomllib.loads((paper[0] / "scene.toml").read_text())


@pytest.mark.mpi
def test_the_history_has_its_columns_and_the_errors_of_the_summary(paper: tuple[Path, str, str]) -> None:
    rows, errors = read_history(paper[0]), read_summary(paper[0])["errors"]
    assert tuple(rows[0]) == HISTORY_COLUMNS
    steps = [int(row["step"]) for row in rows]
    assert steps[0] == 0 and steps[-1] == 1000 and steps == sorted(set(steps)) and len(steps) > 300
    assert all(float(row["time"]) == step * 1.25e-3 for row, step in zip(rows, steps, strict=True))
    assert all(0.3 < float(row["max_density"]) < 1.01 for row in rows)
    seconds = [float(row["seconds"]) for row in rows]
    assert seconds == sorted(seconds)
    reported = [row for row in rows if row["density_l2"]]
    assert [int(row["step"]) for row in reported] == [error["step"] for error in errors]
    for row, error in zip(reported, errors, strict=True):
        for field in ("density", "velocity"):
            assert {norm: float(row[f"{field}_{norm}"]) for norm in NORMS} == error[field]


@pytest.mark.mpi
@pytest.mark.parametrize("name", ["error.png", "solution.png"])
def test_pictures_are_drawn(paper: tuple[Path, str, str], name: str) -> None:
    picture = matplotlib.image.imread(paper[0] / name)
    height, width = picture.shape[:2]
    assert min(height, width) > 300
    colours = np.unique((picture[..., :3] * 255).astype(np.uint8).reshape(-1, 3), axis=0)
    assert len(colours) > 20, "an empty frame has few"
    paper_white = np.all(picture[..., :3] > 0.99, axis=2).mean()
    assert 0.2 < paper_white < 0.99


@pytest.mark.mpi
def test_nothing_else_is_left_in_the_directory(paper: tuple[Path, str, str], small: tuple[Path, str]) -> None:
    texts = {"scene.toml", "summary.json", "history.csv"}
    assert {path.name for path in paper[0].iterdir()} == texts | {"error.png", "solution.png"}
    assert {path.name for path in small[0].iterdir()} == texts | {"particles.h5"}


@pytest.mark.mpi
def test_the_banner_says_what_runs_and_what_is_left_out(paper: tuple[Path, str, str]) -> None:
    lines = paper[1].splitlines()
    banner = {line.split()[0]: line for line in lines[: next(n for n, line in enumerate(lines) if "step" in line[:4])]}
    assert "1D, 100 cells" in banner["grid"]
    assert "200" in banner["particles"] and "2 a cell" in banner["particles"]
    assert re.search(r"\b2\b", banner["ranks"])
    assert "local" in banner["filter"]
    assert "CFL 0.125" in paper[1]
    (left_out,) = (line for line in lines if line.startswith("left out"))
    assert "SLEPc" in left_out and "h5py" in left_out and "filter" not in left_out
    assert paper[1].count("left out") == 1, "one rank speaks"


def is_plain(text: str) -> bool:
    return "\x1b" not in text and "\r" not in text


@pytest.mark.mpi
def test_what_is_said_to_a_file_on_2_ranks_is_plain_lines(
    paper: tuple[Path, str, str], small: tuple[Path, str]
) -> None:
    for said in (paper[1], paper[2], small[1]):
        assert is_plain(said)
    assert re.search(r"^step 1000/1000 .*particle-steps/s", paper[1], re.MULTILINE)
    assert str(paper[0]) in paper[1].splitlines()[-1], "where to look comes last"


def test_one_rank_says_plain_lines_and_quiet_says_nothing(tmp_path: Path) -> None:
    words = ["run", "--no-plots", *sets("time.steps=20"), "--output"]
    said = mpipic(*words, tmp_path / "loud")
    assert said.returncode == 0 and is_plain(said.stdout + said.stderr) and "step 20/20" in said.stdout
    silent = mpipic(*words, tmp_path / "quiet", "--quiet")
    assert (silent.returncode, silent.stdout, silent.stderr) == (0, "", "")
    assert read_summary(tmp_path / "quiet")["status"] == "completed"


@pytest.mark.mpi
def test_the_kept_scene_runs_again_to_the_same_numbers(small: tuple[Path, str], tmp_path: Path) -> None:
    again = tmp_path / "again"
    ended = mpipic("run", small[0] / "scene.toml", "--output", again, "--no-plots", ranks=2)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert (again / "scene.toml").read_text() == (small[0] / "scene.toml").read_text()
    for mine, old in zip(read_history(again), read_history(small[0]), strict=True):
        del mine["seconds"], old["seconds"]
        assert mine == old
    for name, values in final_particles(again, 30).items():
        assert np.array_equal(values, final_particles(small[0], 30)[name]), name


@pytest.mark.mpi
def test_snapshots_are_at_their_steps_and_complete(small: tuple[Path, str]) -> None:
    with h5py.File(small[0] / "particles.h5") as file:
        assert sorted(map(int, file["data"])) == [0, 15, 30]
        cfl_step = 0.2 * min(1 / 10, 1 / 8)
        for step in (0, 15, 30):
            assert math.isclose(file[f"data/{step}"].attrs["time"], step * cfl_step)
            gas = file[f"data/{step}/particles/gas"]
            assert np.array_equal(np.sort(gas["id"][:]), np.arange(320))
            assert len(gas["particlePatches/numParticles"]) == 2 and sum(gas["particlePatches/numParticles"]) == 320
            assert np.abs(gas["density"][:]).max() <= 1.01
            assert file[f"data/{step}/fields/density"].shape == (10, 8)
        held = [set(file[f"data/{step}/particles/gas/id"][:160]) for step in (0, 30)]
        assert len(held[0] - held[1]) > 20, "particles changed rank"


@pytest.mark.mpi
def test_writing_snapshots_changes_no_result(small: tuple[Path, str], tmp_path: Path) -> None:
    silent = tmp_path / "silent"
    ended = mpipic("run", "--output", silent, "--no-plots", *sets(*SMALL), ranks=2)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert not (silent / "particles.h5").exists()
    errors = read_summary(silent)["errors"]
    assert errors == read_summary(small[0])["errors"], "to the last bit"
    assert errors[-1]["step"] == 30 and errors[-1]["density"]["l2"] > 1e-4


@pytest.mark.mpi
def test_without_a_scene_and_a_folder_the_papers_scene_goes_to_runs(
    tmp_path: Path, paper: tuple[Path, str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        ended = mpipic_here("run", "--no-plots", "--quiet")
        assert ended.returncode == 0, ended.stderr
    folders = sorted((tmp_path / "runs").iterdir())
    assert len(folders) == 2 and all(re.fullmatch(r"paper-\d{8}-\d{6}(-2)?", path.name) for path in folders)
    found, expected = read_summary(folders[0])["errors"][-1], read_summary(paper[0])["errors"][-1]
    assert found["step"] == 1000
    assert math.isclose(found["density"]["l2"], expected["density"]["l2"], rel_tol=1e-9)
    assert math.isclose(found["density"]["l2"], 2.2561e-2, rel_tol=1e-4), "the number that configs/paper.toml states"


@pytest.mark.mpi
@pytest.mark.parametrize("ranks", [1, 2])
def test_hwloc_s_warnings_of_a_machine_without_sysfs_are_not_taken_for_ours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ranks: int
) -> None:
    """As in some containers; hwloc sees the machine through the folder that HWLOC_FSROOT names."""
    (tmp_path / "proc").symlink_to("/proc")
    monkeypatch.setenv("HWLOC_FSROOT", str(tmp_path))
    words = ["run", "--no-plots", "--quiet", *sets("time.steps=2"), "--output", str(tmp_path / "out")]
    said = mpipic(*words, ranks=ranks)
    assert (said.returncode, said.stdout, said.stderr) == (0, "", "")
    refused = mpipic(*words, ranks=ranks)
    assert refused.returncode == 2 and len(refused.stderr.splitlines()) == 1


def test_overwrite_replaces_the_results_of_the_earlier_run(tmp_path: Path) -> None:
    words = ["run", "--no-plots", "--quiet", "--output", str(tmp_path / "out")]
    assert mpipic_here(*words, *sets("time.steps=6", "output.every=2")).returncode == 0
    assert mpipic_here(*words, *sets("time.steps=3")).returncode == 2
    assert read_summary(tmp_path / "out")["steps"] == 6
    assert mpipic_here(*words, "--overwrite", *sets("time.steps=3")).returncode == 0
    assert read_summary(tmp_path / "out")["steps"] == 3
    assert not (tmp_path / "out" / "particles.h5").exists(), "no snapshot of another run stays"


@pytest.mark.mpi
def test_check_says_bytes_per_particle_and_memory_per_rank(tmp_path: Path) -> None:
    square = ["grid.cells=[50, 50]", "grid.length=[1.0, 1.0]", "particles.per_cell=[2, 2]"]
    square += ["gas.flow=[0.1, 0.0]", "initial.center=[0.5, 0.5]"]
    ended = mpipic("check", PAPER, *sets(*square), ranks=2, cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    said = ended.stdout
    assert "10,000" in said and "2D, 50 x 50 cells" in said and is_plain(said)
    (each,) = re.findall(r"(\d+) bytes a particle,", said)
    assert int(each) == 8 * (2 + 1 + 2 + 1), "coordinate, density, velocity and id"
    (megabytes,) = re.findall(r"per rank +([\d.]+) MB", said)
    assert 10_000 / 2 * int(each) / 1e6 < float(megabytes) < 10
    assert said.count("left out") == 1 and not list(tmp_path.iterdir()), "nothing is run or written"


def test_a_run_outlives_the_reader_of_its_output(tmp_path):
    """Without mpiexec, that is: Open MPI's ends its ranks when its own output breaks."""
    with start([sys.executable, "-m", "mpipic", "run", "-o", tmp_path / "run", "--no-plots"]) as process:
        assert process.stdout is not None and process.stderr is not None
        assert process.stdout.readline().startswith("scene")
        process.stdout.close()
        errors = process.stderr.read()
        assert process.wait(timeout=120) == 0, errors
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["status"] == "completed"

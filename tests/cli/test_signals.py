"""Claims about being stopped: a run ends its step, keeps what it has, and says that it was interrupted."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import pytest

from helpers import HISTORY_COLUMNS, ROOT, end, finish, start, start_ranks, wait_until

ENDLESS = [
    "--no-plots", "--set", "grid.cells=[20]", "--set", "gas.flow=[0.5]", "--set", "time.steps=10000000",
    "--set", "output.report_at=[0, 20]",
]  # fmt: skip
SNAPSHOTS = ["--set", "output.every=2500000"]
PROMISED = {
    "status", "steps", "time", "ranks", "particles", "nodes", "errors", "seconds", "particle_steps_per_second",
    "scene", "versions",
}  # fmt: skip
SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGUSR1]


def is_stepping(folder: Path) -> Callable[[], bool]:
    """Whether a run has come past its report of step 20."""
    history = folder / "history.csv"
    return lambda: history.exists() and len(history.read_text().splitlines()) >= 2 and "\n20," in history.read_text()


def stop(process: subprocess.Popen[str], folder: Path, send: Callable[[], None]) -> subprocess.CompletedProcess[str]:
    """Wait until the run steps, send the signal, wait for the end."""
    wait_until(is_stepping(folder), process)
    send()
    return finish(process)


def check_kept(folder: Path, ranks: int, snapshots: bool = False) -> None:
    """Everything in the run directory is complete, and nothing else is there."""
    summary = json.loads((folder / "summary.json").read_text())
    assert set(summary) >= PROMISED
    assert (summary["status"], summary["ranks"], summary["particles"]) == ("interrupted", ranks, 40)
    assert 20 <= summary["steps"] < 10_000_000
    assert summary["time"] == summary["steps"] * 1.25e-3
    assert [error["step"] for error in summary["errors"]] == [0, 20]
    with (folder / "history.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == HISTORY_COLUMNS and all(None not in row.values() for row in rows)
    steps = [int(row["step"]) for row in rows]
    expected = sorted({0, 20, *range(0, 10_000_000, 25_000)})
    assert steps == [step for step in expected if step < summary["steps"] or step in steps], "no row is missing"
    assert all(float(row["max_density"]) < 1.01 for row in rows)
    files = {"scene.toml", "summary.json", "history.csv"} | ({"particles.h5"} if snapshots else set())
    assert {path.name for path in folder.iterdir()} == files
    if snapshots:
        with h5py.File(folder / "particles.h5") as file:
            assert list(file["data"]) == ["0"] and len(file["data/0/particles/gas/id"]) == 40


def children(process: subprocess.Popen[str]) -> list[int]:
    """Processes that a process started, by the kernel's list."""
    return [int(pid) for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]


@pytest.mark.parametrize("number", SIGNALS)
def test_one_process_ends_in_order_with_130(tmp_path: Path, number: signal.Signals) -> None:
    folder = tmp_path / "out"
    more = SNAPSHOTS if number == signal.SIGTERM else []
    process = start([sys.executable, "-m", "mpipic", "run", "--output", folder, *ENDLESS, *more])
    ended = stop(process, folder, lambda: process.send_signal(number))
    assert ended.returncode == 130, ended.stderr
    assert len(re.findall("interrupted after step", ended.stderr)) == 1 and "Traceback" not in ended.stderr
    check_kept(folder, 1, snapshots=bool(more))


@pytest.mark.mpi
def test_a_signal_that_mpiexec_passes_on_ends_all_ranks_in_order(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    process = start_ranks(2, "-m", "mpipic", "run", "--output", folder, *ENDLESS, *SNAPSHOTS)
    ended = stop(process, folder, lambda: process.send_signal(signal.SIGUSR1))
    assert ended.returncode == 130 and ended.stderr.count("interrupted after step") == 1, ended.stderr
    check_kept(folder, 2, snapshots=True)


@pytest.mark.mpi
def test_ending_mpiexec_ends_all_ranks_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Open MPI's mpiexec kills its ranks a second after it asked them to end: enough, but not on a busy machine, nor
    # where four ranks that wait for each other keep two cores from those who could go on
    monkeypatch.setenv("OMPI_MCA_odls_base_sigkill_timeout", "10")
    monkeypatch.setenv("OMPI_MCA_mpi_yield_when_idle", "1")
    runs = []
    for number in (signal.SIGINT, signal.SIGTERM):
        folder = tmp_path / number.name
        runs.append((folder, number, start_ranks(2, "-m", "mpipic", "run", "--output", folder, *ENDLESS)))
    try:
        for folder, number, process in runs:
            wait_until(is_stepping(folder), process)
            process.send_signal(number)
        ended = [finish(process) for _, _, process in runs]
    finally:
        for _, _, process in runs:
            if process.poll() is None:
                end(process)
    for (folder, _, _), result in zip(runs, ended, strict=True):
        assert result.returncode != 0
        assert result.stderr.count("interrupted after step") == 1 and "Traceback" not in result.stderr
        check_kept(folder, 2)


@pytest.mark.mpi
@pytest.mark.parametrize(("rank", "number"), [(0, signal.SIGTERM), (1, signal.SIGUSR1)])
def test_a_signal_to_one_rank_ends_all_in_order(tmp_path: Path, rank: int, number: signal.Signals) -> None:
    folder = tmp_path / "out"
    process = start_ranks(2, "-m", "mpipic", "run", "--output", folder, *ENDLESS, *SNAPSHOTS)

    def send() -> None:
        ranks = sorted(children(process))
        assert len(ranks) == 2
        os.kill(ranks[rank], number)

    ended = stop(process, folder, send)
    assert ended.returncode == 130 and ended.stderr.count("interrupted after step") == 1, ended.stderr
    check_kept(folder, 2, snapshots=True)


@pytest.mark.mpi
@pytest.mark.skipif(not (ROOT / ".venv" / ".stamp").exists(), reason="./run would set up an environment first")
@pytest.mark.skipif(shutil.which("setsid") is None, reason="./run leaves signals to mpiexec without setsid")
def test_ctrl_c_on_the_run_script_ends_all_ranks_in_order(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    command = [ROOT / "run", "-n", "2", "run", "--output", folder, *ENDLESS, *SNAPSHOTS]
    process = start(command, start_new_session=True)  # a process group of its own, as a terminal gives to a job
    ended = stop(process, folder, lambda: os.killpg(process.pid, signal.SIGINT))
    assert ended.returncode == 130 and ended.stderr.count("interrupted after step") == 1, ended.stderr
    check_kept(folder, 2, snapshots=True)


# ---------------------------------------------------------------- other verbs, and what comes before the first step

LONG = {
    "run": ["--no-plots", "--set", "time.steps=10000000"],
    "stability": ["--map", "gas.flow=0:0.5:40", "--map", "time.cfl=0.1:0.4:40", "--max-period", "500"],
    "trials": [],
    "spectrum": ["--set", "grid.cells=[400, 400]", "--filters", "order:300"],
    "filters": ["--set", "grid.cells=[400, 400]", "--filters", "order:3000"],
    "bench": ["--particles", "2e6", "--repeats", "1000"],
}
"""Verbs to what keeps them busy for longer than any signal is late."""
APART = 0.27
"""Seconds."""


def listen(process: subprocess.Popen[str], ranks: int) -> Callable[[], bool]:
    """Whether it is the program that answers signals: in its first hundredths of a second, it is Python itself."""

    def catches(pid: int) -> bool:
        (line,) = re.findall(r"^SigCgt:\s*(\w+)$", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE)
        return bool(int(line, 16) & (1 << (signal.SIGUSR1 - 1)))

    def all_catch() -> bool:
        pids = children(process) if ranks > 1 else [process.pid]
        return len(pids) == ranks and all(map(catches, pids))

    return all_catch


def interrupt(processes: list[subprocess.Popen[str]], number: signal.Signals, ranks: int = 1) -> None:
    """Send the signal to one process after the other, each at another point of its way, and judge the ends."""
    try:
        for delay, process in enumerate(processes):
            time.sleep(APART if delay else 0.0)
            wait_until(listen(process, ranks), process, timeout=30.0)
            process.send_signal(number)
        for process in processes:
            ended = finish(process, 30.0)
            said = (process.args, ended.returncode, ended.stderr)
            assert ended.returncode == 130 and "Traceback" not in ended.stderr and "rror" not in ended.stderr, said
            assert ended.stderr.count("interrupted") <= 1, said
    finally:
        for process in processes:
            if process.poll() is None:
                end(process)


@pytest.mark.parametrize("number", SIGNALS[:2])
def test_any_verb_ends_with_130_at_any_moment_and_leaves_nothing_half_written(
    tmp_path: Path, number: signal.Signals
) -> None:
    turn = SIGNALS.index(number) * 2
    verbs = [*LONG, *LONG][turn : turn + len(LONG)]
    words = [[sys.executable, "-m", "mpipic", verb, *LONG[verb], "--output", tmp_path / verb] for verb in verbs]
    interrupt([start(command, tmp_path) for command in words], number)
    assert not list(tmp_path.rglob("*.tmp"))


@pytest.mark.mpi
def test_any_verb_ends_on_two_ranks_with_130_at_any_moment(tmp_path: Path) -> None:
    words = [[verb, *LONG[verb], "--output", tmp_path / verb] for verb in ("bench", "stability", "spectrum")]
    interrupt([start_ranks(2, "-m", "mpipic", *more, cwd=tmp_path) for more in words], signal.SIGUSR1, ranks=2)

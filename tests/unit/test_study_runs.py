"""Claims about running points: whatever becomes of a process is a record, and journal survive."""

from __future__ import annotations

import json
import os
import re
import signal
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import pytest

from helpers import HANG
from mpipic.errors import OutputError
from mpipic.study import runs as study_runs
from mpipic.study.file import Study, load
from mpipic.study.journal import Journal
from mpipic.study.runs import command, environment, launch, run_once, scene_file, write_scenes
from mpipic.study.verb import outstanding


@pytest.fixture
def study(tmp_path: Path) -> Study:
    path = tmp_path / "s.toml"
    path.write_text("until = 0.01\nrepeats = 2\n[axes]\ngrid.cells = [[8], [16]]")
    return load(path)


def python(code: str) -> list[str]:
    return [sys.executable, "-c", code]


def has_ended(place: Path) -> bool:
    """Whether the process that wrote its number there runs no more, though nobody may have asked how it ended."""
    try:
        return psutil.Process(int(place.read_text())).status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def launched(code: str, tmp_path: Path, timeout: float = HANG) -> tuple[Any, str]:
    with (tmp_path / "log").open("w") as log:
        ended = launch(python(code), dict(os.environ), timeout, log)
    return ended, (tmp_path / "log").read_text()


def test_a_process_gives_code_time_memory_and_what_it_said(tmp_path: Path) -> None:
    code = "import sys, time; x = bytearray(300_000_000); time.sleep(.2); print('hm', file=sys.stderr); sys.exit(3)"
    ended, said = launched(code, tmp_path)
    assert ended.code == 3 and said == "hm\n"
    assert ended.seconds >= 0.2 and 3e8 < ended.peak_memory < 2e9


def test_a_signal_is_a_negative_code(tmp_path: Path) -> None:
    ended, _ = launched("import os; os.kill(os.getpid(), 9)", tmp_path)
    assert ended.code == -9


DEAF = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"


def endless(place: Path, then: str = "") -> str:
    """A program that writes its number, and goes on for longer than any test waits."""
    return f"import os, time; open({str(place)!r}, 'w').write(str(os.getpid())); {then}time.sleep(3600)"


def run_out_of_time(monkeypatch: Any, place: Path) -> None:
    """Let the time of a run be over as soon as it has written its number, however long the machine takes for that."""
    real = time.monotonic

    def is_ready() -> bool:
        return place.exists() and place.stat().st_size > 0

    monkeypatch.setattr(study_runs, "GRACE", 0.3)
    monkeypatch.setattr(study_runs.time, "monotonic", lambda: real() + (2 * HANG if is_ready() else 0.0))


@pytest.mark.parametrize("deaf", [False, True])
def test_a_process_that_takes_too_long_is_ended_even_if_deaf(tmp_path: Path, monkeypatch: Any, deaf: bool) -> None:
    place = tmp_path / "pid"
    run_out_of_time(monkeypatch, place)
    ended, _ = launched((DEAF if deaf else "") + endless(place), tmp_path)
    assert ended.code is None and has_ended(place)


def test_what_a_process_started_in_a_session_of_its_own_is_ended_with_it(tmp_path: Path, monkeypatch: Any) -> None:
    """As the ranks of an mpiexec that has to be killed."""
    place = tmp_path / "pid"
    run_out_of_time(monkeypatch, place)
    launcher = f"{DEAF}import subprocess; subprocess.run({python(DEAF + endless(place))!r}, start_new_session=True)"
    ended, _ = launched(launcher, tmp_path)
    assert ended.code is None and has_ended(place)


def test_an_interruption_ends_the_process(tmp_path: Path) -> None:
    place = tmp_path / "pid"
    before = signal.signal(signal.SIGUSR2, lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    try:
        with pytest.raises(KeyboardInterrupt):
            launched(endless(place, f"os.kill({os.getpid()}, {int(signal.SIGUSR2)}); "), tmp_path)
    finally:
        signal.signal(signal.SIGUSR2, before)
    assert has_ended(place)


BANNERS = f"""[hwloc/linux] failed to find sysfs cpu topology directory, aborting linux discovery.
Traceback (most recent call last):
ValueError: oh
{"-" * 74}
MPI_ABORT was invoked on rank 1 in communicator MPI_COMM_WORLD
{"-" * 74}
"""


@pytest.mark.parametrize(
    ("code", "status", "message"),
    [
        ("import sys; print('error: residual', file=sys.stderr); sys.exit(4)", "not converged", "residual"),
        ("import sys; print('error: no', file=sys.stderr); sys.exit(2)", "refused", "no"),
        ("raise ValueError('oh')", "crashed", "exit code 1; ValueError: oh"),
        ("import os; os.kill(os.getpid(), 11)", "crashed", "signal SIGSEGV"),
        (f"import sys; sys.stderr.write({BANNERS!r}); sys.exit(1)", "crashed", "exit code 1; ValueError: oh"),
        ("pass", "crashed", "exit code 0"),
        ("import time; time.sleep(3600)", "timeout", r"ended after \d+ s"),
    ],
)
def test_every_way_to_fail_is_a_record(
    study: Study, tmp_path: Path, monkeypatch: Any, code: str, status: str, message: str
) -> None:
    monkeypatch.setattr(study_runs, "command", lambda ranks, *arguments: python(code))
    write_scenes(tmp_path, study.points)
    point = study.points[0]
    record = run_once(point, scene_file(tmp_path, point), 1, 1.0 if status == "timeout" else HANG)
    assert (record["id"], record["status"]) == (point.id, status)
    assert re.fullmatch(message, record["message"])
    assert record["errors"] is None and list(tmp_path.glob(".run-*")) == []
    json.dumps(record, allow_nan=False)


def test_one_rank_needs_no_launcher_and_two_do() -> None:
    assert command(1, "run") == [sys.executable, "-m", "mpipic", "run"]
    two = command(2, "run")
    assert two[-6:] == ["-n", "2", sys.executable, "-m", "mpipic", "run"] and "mpiexec" in two[0]


def test_nothing_of_a_launcher_above_is_passed_on(monkeypatch: Any) -> None:
    for name in ("OMPI_COMM_WORLD_RANK", "PMIX_RANK", "OMPI_MCA_orte_hnp_uri", "OMPI_MCA_ess", "PMI_RANK"):
        monkeypatch.setenv(name, "0")
    monkeypatch.setenv("OMPI_MCA_btl", "self,vader")
    monkeypatch.setenv("OMPI_MCA_ess_singleton_isolated", "1")
    found = environment(1)
    left = {name for name in found if name.startswith(("OMPI_COMM", "PMI", "OMPI_MCA_orte"))}
    assert not left and "OMPI_MCA_ess" not in found
    assert (found["OMPI_MCA_btl"], found["OMPI_MCA_ess_singleton_isolated"]) == ("self,vader", "1")
    assert environment(10_000)["OMPI_MCA_rmaps_base_oversubscribe"] == "1"


def record(point: Any, repeat: int, status: str = "completed", **more: Any) -> dict[str, Any]:
    return {"id": point.id, "repeat": repeat, "status": status, "timeout": 5.0, "seconds": float("nan"), **more}


def test_records_survive_and_a_torn_line_is_dropped(study: Study, tmp_path: Path) -> None:
    first, second = study.points
    journal = Journal(tmp_path)
    journal.add(record(first, 1))
    journal.add(record(second, 1))
    journal.close()
    path = tmp_path / "points.jsonl"
    whole = path.read_bytes()
    path.write_bytes(whole + b'{"id": "' + first.id.encode() + b'", "repeat": 2, "sta')
    again = Journal(tmp_path)
    assert path.read_bytes() == whole
    assert [r["repeat"] for r in again.of(first)] == [1] and again.of(second)[0]["seconds"] is None
    assert outstanding(study, again) == [(first, 2), (second, 2)]
    again.add(record(first, 2))
    again.close()
    assert len(path.read_text().splitlines()) == 3
    fresh = Journal(tmp_path, fresh=True)
    assert path.read_bytes() == b"" and len(outstanding(study, fresh)) == 4
    fresh.close()


def test_all_points_run_once_before_any_runs_again_and_failures_do_not(study: Study, tmp_path: Path) -> None:
    first, second = study.points
    journal = Journal(tmp_path)
    assert outstanding(study, journal) == [(first, 1), (second, 1), (first, 2), (second, 2)]
    journal.add(record(first, 1, "timeout"))
    assert outstanding(study, journal) == [(second, 1), (second, 2)]
    journal.forget(study.points, 5.0)
    assert len(outstanding(study, journal)) == 2, "no more time than before"
    journal.forget(study.points, 6.0)
    assert len(outstanding(study, journal)) == 4
    journal.add(record(second, 1, "crashed"))
    journal.forget(study.points, 5.0, ("crashed",))
    assert len(outstanding(study, journal)) == 4
    journal.close()


def test_two_studies_do_not_write_to_one_folder(tmp_path: Path) -> None:
    journal = Journal(tmp_path)
    with pytest.raises(OutputError, match="another study is writing"):
        Journal(tmp_path)
    journal.close()
    Journal(tmp_path).close()


def test_scene_files_run_the_point_again(study: Study, tmp_path: Path) -> None:
    from mpipic.scene.records import Scene

    write_scenes(tmp_path, study.points)
    for point in study.points:
        path = scene_file(tmp_path, point)
        assert Scene.load(path) == point.scene and path.read_text().startswith(f"# {point.label}: ")

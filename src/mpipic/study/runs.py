"""Running the points of a study, each in a process of its own.

A run that crashes, blows up, or takes too long is a record like any other. Nothing here starts MPI.
"""

from __future__ import annotations

import os
import platform
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import IO, cast

import psutil

from mpipic.files import Unreadable, json_object, read_text, write_text
from mpipic.io.run_directory import SUMMARY
from mpipic.runtime import without_launcher, without_launcher_variables
from mpipic.study.journal import (
    COMPLETED,
    CRASHED,
    NOT_CONVERGED,
    REFUSED,
    TIMEOUT,
    UNSTABLE,
    Errors,
    Machine,
    Record,
    Told,
)
from mpipic.study.points import Point
from mpipic.wording import escape

STATUS_OF_CODE = {0: COMPLETED, 2: REFUSED, 3: UNSTABLE, 4: NOT_CONVERGED}
SCENES = "scenes"
LOOK, GRACE, KILLED = 0.02, 10.0, 1.0
"""Seconds between looks at a run, that it has to end when asked, and that what was killed may take to go."""


def launcher() -> list[str] | None:
    """Return what starts ranks: this environment's own mpiexec, what MPIPIC_MPIEXEC names, or the mpiexec on PATH."""
    own = Path(sys.prefix) / "bin" / "mpiexec"
    if own.exists():
        return [str(own)]
    named = shlex.split(os.environ.get("MPIPIC_MPIEXEC", ""))
    found = shutil.which("mpiexec")
    return named or ([found] if found else None)


def command(ranks: int, *arguments: str) -> list[str]:
    """Return the words of `mpipic ARGUMENTS` on so many ranks; one rank needs no launcher."""
    alone = [sys.executable, "-m", "mpipic", *arguments]
    return alone if ranks == 1 else [*(launcher() or ["mpiexec"]), "-n", str(ranks), *alone]


def environment(ranks: int) -> dict[str, str]:
    """Return this process's environment for a launcher: nothing of one above it, many ranks and root allowed."""
    found = without_launcher_variables(os.environ)
    if os.geteuid() == 0:
        found |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    if ranks > machine()["cores"]:
        found["OMPI_MCA_rmaps_base_oversubscribe"] = "1"
        found.setdefault("PRTE_MCA_rmaps_default_mapping_policy", ":oversubscribe")
    return found


@dataclass(frozen=True)
class Ended:
    """How a process ended: exit code, minus the signal that ended it, or None if it had to be ended for its time."""

    code: int | None
    seconds: float
    peak_memory: int


def launch(arguments: Sequence[str], variables: Mapping[str, str], timeout: float, log: IO[str]) -> Ended:
    """Run a command to its end, standard error into `log`; end it after `timeout` seconds, or when interrupted.

    The process has a session of its own: what a terminal sends to this one does not reach it. Where setpriv is there,
    it ends with this process even if that is killed. `peak_memory` is the resident bytes of the largest process, as the
    system counts them: no less than this process had when it began the other.
    """
    guard = [*_watch(), *arguments]
    began = time.monotonic()
    process = subprocess.Popen(
        guard, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=log, env=variables, start_new_session=True
    )
    memory, late = None, False
    try:
        memory = _wait(process, began + timeout)
        late = memory is None
    finally:
        if memory is None:
            memory = _end(process)
    return Ended(None if late else process.returncode, time.monotonic() - began, memory)


def _watch() -> list[str]:
    found = shutil.which("setpriv")
    return [found, "--pdeathsig", "TERM"] if found else []


def _wait(process: subprocess.Popen[bytes], deadline: float) -> int | None:
    """Return the peak memory of a process that ends before the deadline, else None."""
    while True:
        pid, status, usage = os.wait4(process.pid, os.WNOHANG)
        if pid:
            process.returncode = os.waitstatus_to_exitcode(status)
            return usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
        if time.monotonic() > deadline:
            return None
        time.sleep(LOOK)


def _end(process: subprocess.Popen[bytes]) -> int:
    """End a process and all that it started, and return its peak memory.

    mpiexec is asked first, so that it takes its ranks along; they have process groups of their own, and would outlive
    one that has to be killed.
    """
    try:
        below = psutil.Process(process.pid).children(recursive=True)
    except psutil.NoSuchProcess:
        below = []
    memory = None
    with suppress(ProcessLookupError, ChildProcessError):
        for number in (signal.SIGTERM, signal.SIGKILL):
            os.killpg(process.pid, number)
            memory = _wait(process, time.monotonic() + GRACE)
            if memory is not None:
                break
    for left in below:
        with suppress(psutil.NoSuchProcess):
            left.kill()
    psutil.wait_procs(below, KILLED)
    return memory or 0


def run_once(point: Point, scene_file: Path, repeat: int, timeout: float) -> Record:
    """Run a point once; returns what there is to say about it, whatever became of it."""
    with tempfile.TemporaryDirectory(prefix=".run-", dir=scene_file.parent.parent) as folder:
        output, log = Path(folder) / "output", Path(folder) / "log"
        arguments = command(point.ranks, "run", str(scene_file), "--output", str(output), "--no-plots", "--quiet")
        with log.open("w") as stream:
            ended = launch(arguments, environment(point.ranks), timeout, stream)
        summary = _summary(output / SUMMARY)
        said = log.read_text("utf-8", "replace")
    status = TIMEOUT if ended.code is None else STATUS_OF_CODE.get(ended.code, CRASHED)
    if status in (COMPLETED, UNSTABLE) and summary.get("status") != status:
        status = CRASHED
    errors = summary.get("errors") if status == COMPLETED else None
    told = cast(Told, {name: summary.get(name) for name in Told.__annotations__})
    return {
        **told, "id": point.id, "repeat": repeat, "status": status, "message": _message(status, ended, said),
        "errors": cast("list[Errors]", errors)[-1] if errors else None,
        "wall_seconds": ended.seconds, "peak_memory": ended.peak_memory, "timeout": timeout,
        "finished": time.strftime("%Y-%m-%dT%H:%M:%S%z"), "machine": machine(),
    }  # fmt: skip


def _summary(path: Path) -> Mapping[str, object]:
    """Return what a run's summary.json holds, nothing where there is none."""
    try:
        return json_object(read_text(path))
    except Unreadable:
        return {}


def _message(status: str, ended: Ended, said: str) -> str:
    """Return why a run did not complete: its own words, else how it ended."""
    if status == COMPLETED:
        return ""
    if status == TIMEOUT:
        return f"ended after {ended.seconds:.0f} s"
    lines = [line.strip() for line in without_launcher(said).splitlines() if line.strip()]
    own = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")] or lines[-1:]
    own = [line.removeprefix(f"{status}: ") for line in own]
    code = ended.code or 0
    how = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
    return escape("; ".join(own)[:500] or how) if status != CRASHED else escape("; ".join([how, *own])[:500])


def write_scenes(folder: Path, points: Sequence[Point]) -> None:
    """Write a scene file for every point, to run it again by hand."""
    (folder / SCENES).mkdir(parents=True, exist_ok=True)
    for point in points:
        launch_with = f"mpiexec -n {point.ranks} " if point.ranks > 1 else ""
        header = f"# {escape(point.label)}: {launch_with}python -m mpipic run {SCENES}/{point.id}.toml\n"
        write_text(scene_file(folder, point), header + point.scene.to_toml())


def scene_file(folder: Path, point: Point) -> Path:
    """Return where the scene of a point is."""
    return folder.absolute() / SCENES / f"{point.id}.toml"


@cache
def machine() -> Machine:
    """Return facts of this machine: processor, whole cores and threads that this process may use, memory, system."""
    own = psutil.Process()
    threads = len(own.cpu_affinity()) if hasattr(own, "cpu_affinity") else psutil.cpu_count() or 1
    return {
        "processor": _processor(),
        "cores": min(psutil.cpu_count(logical=False) or threads, threads),
        "threads": threads,
        "memory_bytes": psutil.virtual_memory().total,
        "system": platform.platform(),
        "host": platform.node(),
    }


def _processor() -> str:
    """Return the model of the processor as Linux names it, or what Python knows of it elsewhere."""
    with suppress(Unreadable):
        named = re.search(r"^model name\s*:\s*(.+)$", read_text(Path("/proc/cpuinfo")), re.MULTILINE)
        if named:
            return named[1]
    return platform.processor() or platform.machine()


ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)


@contextmanager
def interruptible() -> Iterator[None]:
    """Within the block Ctrl-C, SIGTERM, SIGHUP and SIGUSR1 raise KeyboardInterrupt."""

    def stop(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, stop) for number in ENDING}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

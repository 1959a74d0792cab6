"""What tests on several ranks share: starting programs under mpiexec, always with a time limit."""

from __future__ import annotations

import io
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from unittest import mock

from mpipic.runtime import without_launcher

TESTS = Path(__file__).parent
ROOT = TESTS.parent
HISTORY_COLUMNS = (
    "step", "time", "max_density", "density_l1", "density_l2", "density_linf", "velocity_l1", "velocity_l2",
    "velocity_linf", "null_space_fraction", "seconds",
)  # fmt: skip
"""What history.csv holds of acoustics."""
HANG = 240.0
"""Seconds after which a process counts as hanging: far above what any takes on a machine busy with other work."""


def launcher(ranks: int) -> list[str]:
    """The command that starts `ranks` processes, also more than there are cores, also as root."""
    own = Path(sys.prefix) / "bin" / "mpiexec"
    program = str(own) if own.exists() else shutil.which("mpiexec")
    assert program, "no mpiexec on this machine"
    return [program, "-n", str(ranks)]


def environment(**more: str) -> dict[str, str]:
    """This process's environment and `more`, without what an MPI-initialised parent leaves in it."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("OMPI_COMM", "OMPI_UNIVERSE", "PMIX_", "PMI_"))}
    cores = len(os.sched_getaffinity(0))
    settings = {
        "OMPI_ALLOW_RUN_AS_ROOT": "1",
        "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "NUMBA_NUM_THREADS": "1",
        "H5PY_ALWAYS_USE_MPI": "1",
        "MPLBACKEND": "Agg",
        "PYTHONPATH": os.pathsep.join(filter(None, [str(TESTS), kept.get("PYTHONPATH", "")])),
    }
    return {**kept, **settings, "MPIPIC_TEST_CORES": str(cores), **more}


def start(command: list[str | Path], cwd: Path | None = None, **options: object) -> subprocess.Popen[str]:
    """Start a command with its output in pipes and return at once; the caller must wait with a time limit."""
    options = {"env": environment(), **options}
    return subprocess.Popen(
        list(map(str, command)), cwd=cwd, text=True, stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options,
    )  # fmt: skip


def start_ranks(ranks: int, *args: str | Path, cwd: Path | None = None) -> subprocess.Popen[str]:
    """Start python with `args` on that many ranks and return at once; the caller must wait with a time limit."""
    variables = environment()
    if ranks > int(variables["MPIPIC_TEST_CORES"]):
        variables["OMPI_MCA_rmaps_base_oversubscribe"] = "1"
    return start([*launcher(ranks), sys.executable, *args], cwd, env=variables)


def finish(process: subprocess.Popen[str], timeout: float = HANG) -> subprocess.CompletedProcess[str]:
    """Wait for a process; ended, and the test failed, after `timeout` seconds.

    Its standard error is without what launcher and libraries add: hwloc, for one, warns in containers without sysfs.
    """
    try:
        out, err = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        out, err = end(process)
        raise AssertionError(f"still running after {timeout} s: {process.args}\n{out}\n{err}") from None
    return subprocess.CompletedProcess(process.args, process.returncode, out, without_launcher(err))


def end(process: subprocess.Popen[str]) -> tuple[str, str]:
    """End a process whatever its state: mpiexec is asked first, so that it takes its ranks along."""
    process.terminate()
    try:
        return process.communicate(timeout=30)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.communicate()


def wait_until(sign: Callable[[], bool], process: subprocess.Popen[str], timeout: float = HANG) -> None:
    """Return once `sign` is true; the test fails if the process ends before, or after `timeout` seconds."""
    deadline = time.monotonic() + timeout
    while not sign():
        if process.poll() is not None or time.monotonic() > deadline:
            state = f"ended with {process.returncode}" if process.poll() is not None else f"silent for {timeout} s"
            out, err = end(process)
            raise AssertionError(f"{state}: {process.args}\n{out}\n{err}")
        time.sleep(0.02)


def run_python(
    ranks: int, *args: str | Path, timeout: float = HANG, cwd: Path | None = None
) -> subprocess.CompletedProcess[str]:
    """Run python with `args` on that many ranks; ended, and the test failed, after `timeout` seconds."""
    return finish(start_ranks(ranks, *args, cwd=cwd), timeout)


def run_ranks(ranks: int, script: Path, *args: str, timeout: float = HANG) -> subprocess.CompletedProcess[str]:
    """Run a script on that many ranks."""
    return run_python(ranks, script, *args, timeout=timeout)


def mpipic(
    *args: str | Path, ranks: int = 1, timeout: float = HANG, cwd: Path | None = None
) -> subprocess.CompletedProcess[str]:
    """Run the command line `mpipic args`; on one rank without mpiexec."""
    if ranks > 1:
        return run_python(ranks, "-m", "mpipic", *args, timeout=timeout, cwd=cwd)
    return finish(start([sys.executable, "-m", "mpipic", *args], cwd), timeout)


def mpipic_here(*args: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the command line on one rank in this process, which saves the second that a new one takes to begin.

    For what a verb does, says and answers with; how a process begins and ends shows in a new one only.
    """
    from mpipic import cli

    out, err, words = io.StringIO(), io.StringIO(), ["mpipic", *map(str, args)]
    with redirect_stdout(out), redirect_stderr(err), mock.patch.object(sys, "argv", words):
        try:
            cli.main()
        except SystemExit as end:
            code = end.code
    return subprocess.CompletedProcess(words, int(code or 0), out.getvalue(), err.getvalue())

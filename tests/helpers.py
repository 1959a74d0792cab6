"""What tests on several ranks share: starting programs under mpiexec, always with a time limit."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

Finished = subprocess.CompletedProcess[str]
TESTS = Path(__file__).parent


def launcher(ranks: int) -> list[str]:
    """The command that starts `ranks` processes, also more than there are cores, also as root."""
    own = Path(sys.prefix) / "bin" / "mpiexec"
    program = str(own) if own.exists() else shutil.which("mpiexec")
    assert program, "no mpiexec on this machine"
    return [program, "-n", str(ranks)]


def environment() -> dict[str, str]:
    """This process's environment, without what an MPI-initialised parent leaves in it."""
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
    return {**kept, **settings, "MPIPIC_TEST_CORES": str(cores)}


def start_ranks(ranks: int, *args: str | Path, cwd: Path | None = None) -> subprocess.Popen[str]:
    """Start python with `args` on that many ranks and return at once; the caller must wait with a time limit."""
    variables = environment()
    if ranks > int(variables["MPIPIC_TEST_CORES"]):
        variables["OMPI_MCA_rmaps_base_oversubscribe"] = "1"
    command = [*launcher(ranks), sys.executable, *map(str, args)]
    return subprocess.Popen(
        command, env=variables, cwd=cwd, text=True, stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def run_python(ranks: int, *args: str | Path, timeout: float = 120, cwd: Path | None = None) -> Finished:
    """Run python with `args` on that many ranks; ended, and the test failed, after `timeout` seconds."""
    process = start_ranks(ranks, *args, cwd=cwd)
    try:
        out, err = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        process.kill()
        out, err = process.communicate()
        raise AssertionError(f"still running after {timeout} s on {ranks} ranks\n{out}\n{err}") from None
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


def run_ranks(ranks: int, script: Path, *args: str, timeout: float = 120) -> Finished:
    """Run a script on that many ranks."""
    return run_python(ranks, script, *args, timeout=timeout)


def mpipic(*args: str | Path, ranks: int = 1, timeout: float = 120, cwd: Path | None = None) -> Finished:
    """Run the command line `mpipic args`; on one rank without mpiexec."""
    if ranks > 1:
        return run_python(ranks, "-m", "mpipic", *args, timeout=timeout, cwd=cwd)
    command = [sys.executable, "-m", "mpipic", *map(str, args)]
    return subprocess.run(
        command, env=environment(), cwd=cwd, text=True, stdin=subprocess.DEVNULL, capture_output=True, timeout=timeout
    )

"""How a process lives among the ranks: one thread each, no rank left hanging, an orderly end when asked to stop."""

from __future__ import annotations

import atexit
import os
import re
import signal
import sys
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from types import FrameType, TracebackType
from typing import TYPE_CHECKING

from mpipic.interrupts import RANKS, STOP_SIGNALS

if TYPE_CHECKING:
    from mpi4py import MPI

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
ANNOUNCED = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "MV2_COMM_WORLD_SIZE")
SLURM_RANK, SLURM_TASKS = "SLURM_PROCID", "SLURM_STEP_NUM_TASKS"
"""Variables that srun sets in its tasks; a batch script without srun has the first of them only."""
LAUNCHED = (
    "OMPI_COMM_WORLD_", "OMPI_MCA_orte_", "OMPI_MCA_ess", "OMPI_MCA_pmix", "OMPI_MCA_initial_wdir", "OMPI_APP_CTX",
    "OMPI_MCA_mpi_oversubscribe", "OMPI_UNIVERSE", "OMPI_NUM_APP", "OMPI_FIRST", "OMPI_FILE", "OMPI_COMMAND",
    "OMPI_ARGV", "PMIX_", "PMI_", "PMI2_", "MV2_COMM_WORLD_", "MPI_LOCAL", "HYDI_",
)  # fmt: skip
"""How variables are called that launchers of Open MPI and MPICH leave; what starts with them passes for a rank."""
BANNER = re.compile(r"^-{60,}\n(?:.*\n)*?-{60,}\n?", re.MULTILINE)
"""Matches what Open MPI says between two rules, such as that a rank has failed."""
FOREIGN = re.compile(
    r"\[?hwloc\b|\*"  # hwloc where it does not understand the machine: a line, or a box of stars
    r"|\[[^\]]+:\d+\] (?:\d+ more process|Set MCA parameter)"  # Open MPI on banners that it has left out
    r"|=+$|=   |application called MPI_Abort|\[(?:proxy|mpiexec)[:@]"  # MPICH's launcher
)


def settle() -> None:
    """Set what libraries read when they are imported: one thread a rank, unless told otherwise; signals are ours.

    Call before NumPy is imported.
    """
    for name in THREADS:
        os.environ.setdefault(name, "1")
    if os.path.expanduser("~") == "~":  # a user that the system does not know: Open MPI dies of a home that is none
        os.environ["HOME"] = "/"
    # Debian's h5py otherwise loads its serial build, also where it is asked for parallel files
    os.environ.setdefault("H5PY_ALWAYS_USE_MPI", "1")
    # for coloured messages Numba wakes colorama, if that is installed, which writes to standard output at the end
    os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")
    # PETSc would end the run with a report of its own when a reader of the output goes away (`mpipic run | head`)
    os.environ["PETSC_OPTIONS"] = f"{os.environ.get('PETSC_OPTIONS', '')} -no_signal_handler".strip()


@dataclass(frozen=True)
class Launched:
    """A launcher tells a process this: its rank, of how many."""

    rank: int
    size: int


def launched() -> Launched:
    """Return this process's rank and the number of ranks as its launcher says, 0 of 1 without one; needs no MPI."""
    rank, size = (
        next((int(os.environ[name]) for name in names if os.environ.get(name, "").isdigit()), default)
        for names, default in ((RANKS, 0), (ANNOUNCED, 1))
    )
    if not any(name in os.environ for name in (*RANKS, *ANNOUNCED)):
        step = [os.environ.get(name, "") for name in (SLURM_RANK, SLURM_TASKS)]
        if all(word.isdigit() for word in step) and int(step[1]) > 1:
            rank, size = map(int, step)
    return Launched(rank, size)


def start() -> MPI.Intracomm:
    """Settle, and return COMM_WORLD after checking that it is what the launcher started. Call before NumPy is imported.

    Every later exception ends all ranks.

    Ends with exit code 2 if PETSc refuses its options, and with 1 if the launcher announces another number of processes
    than MPI sees: the launcher of one MPI with the library of another silently runs N copies of a serial program.
    """
    settle()
    from mpi4py import MPI

    comm = MPI.COMM_WORLD
    for name in ANNOUNCED:
        announced = os.environ.get(name, "")
        if announced.isdigit() and int(announced) != comm.size:
            library = MPI.Get_library_version().splitlines()[0].strip("\0 ")
            if launched().rank == 0:
                sys.stderr.write(
                    f"error: the launcher started {announced} processes ({name}), but MPI sees {comm.size}: "
                    f"this mpiexec does not belong to the MPI that mpi4py uses ({library})\n"
                )
            raise SystemExit(1)
    if comm.size == 1 and launched().size > 1:
        if launched().rank == 0:
            sys.stderr.write(
                f"error: srun started {launched().size} tasks ({SLURM_TASKS}), but MPI sees one process in each: they "
                "would write over each other; start them by mpiexec, or by srun --mpi=pmix (srun --mpi=list names "
                f"others), or, if copies are meant, each by: env -u {SLURM_TASKS} ...\n"
            )
        raise SystemExit(1)
    if comm.size > 1:
        sys.excepthook = _abort_all
    _begin_petsc()
    atexit.register(_end_petsc)
    return comm


def _begin_petsc() -> None:
    """Import PETSc, which reads its options; end with exit code 2, on all ranks, if it does not begin with them."""
    try:
        import petsc4py.PETSc  # noqa: F401
    except ImportError:
        raise
    except Exception as error:  # PETSc's own class of errors could not be imported
        if launched().rank == 0:
            given = os.environ["PETSC_OPTIONS"].removesuffix("-no_signal_handler").strip()
            sys.stderr.write(
                f"error: PETSc does not begin ({error}): one of its options is wrong, in PETSC_OPTIONS, which is now "
                f'"{given}", or in a file .petscrc or petscrc here or .petscrc at home\n'
            )
        raise SystemExit(2) from None


def _end_petsc() -> None:
    """End PETSc while Python lives: what an error has left half made would call back into it later, and crash."""
    objects, petsc = (sys.modules.get(name) for name in ("mpipic.mesh.petsc_objects", "petsc4py.PETSc"))
    if objects is not None:  # imported before `start`, it would be asked too late
        objects.close_all()
    if petsc is not None:
        petsc._finalize()


def _abort_all(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """End all ranks with this one's traceback; the others would wait for ever in their next message."""
    from mpi4py import MPI

    lines = "".join(traceback.format_exception(kind, error, trace))
    sys.stderr.write(f"rank {MPI.COMM_WORLD.rank} of {MPI.COMM_WORLD.size} failed; ending all ranks\n{lines}")
    sys.stdout.flush()
    sys.stderr.flush()
    MPI.COMM_WORLD.Abort(1)


def without_launcher(said: str) -> str:
    """Return what ranks said on standard error without what their launcher and the libraries below them added."""
    lines = BANNER.sub("", said).splitlines(keepends=True)
    return "".join(line for line in lines if not FOREIGN.match(line))


def without_launcher_variables(variables: Mapping[str, str]) -> dict[str, str]:
    """Return an environment for a process that is no rank: without what a launcher left there, if there was one."""
    found = dict(variables)
    if any(name in found for name in RANKS):
        isolated = found.get("OMPI_MCA_ess_singleton_isolated")
        found = {name: value for name, value in found.items() if not name.startswith(LAUNCHED)}
        found |= {"OMPI_MCA_ess_singleton_isolated": isolated} if isolated else {}
    return found


class StopRequest:
    """Becomes true once Ctrl-C, SIGTERM or SIGUSR1 has come. A second Ctrl-C acts as if there were none of this.

    A launcher may follow one signal by another, so only Ctrl-C counts as impatience. SIGUSR1 is what mpiexec passes on
    to its ranks without setting out to end them.
    """

    def __init__(self) -> None:
        self._stop = False
        self._interrupts = 0
        self._before = {number: signal.signal(number, self._ask) for number in map(_number, STOP_SIGNALS)}

    def __call__(self) -> bool:
        """Return whether to stop."""
        return self._stop

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self._stop = True
        self._interrupts += number == signal.SIGINT
        if self._interrupts > 1:
            self.release()
            before = self._before[signal.SIGINT]
            if callable(before):
                before(number, frame)

    def release(self) -> None:
        """Give the signals back to whoever had them."""
        for number, handler in self._before.items():
            signal.signal(number, handler)


def _number(name: str) -> signal.Signals:
    return signal.Signals[name]

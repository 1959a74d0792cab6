"""Ending when asked to: a signal ends all ranks at once, from before anything else is imported.

A run, and a study, end in order instead, once they have begun; see `mpipic.runtime.StopRequest`.
"""

import os
import signal
import sys

STOP_SIGNALS = ("SIGINT", "SIGTERM", "SIGUSR1")
RANKS = ("OMPI_COMM_WORLD_RANK", "PMI_RANK", "MV2_COMM_WORLD_RANK")
INTERRUPTED = 130
SHOW_CURSOR = b"\x1b[?25h"
unfinished: set[str] = set()
"""Files under a temporary name, which must not outlive the process."""


def end_when_asked() -> None:
    """From now on end this process at once, with exit code 130, on Ctrl-C, SIGTERM or SIGUSR1; so end all ranks.

    Python's way, an exception wherever the program is, goes through compiled code that does not pass it on. Local.
    """
    for name in STOP_SIGNALS:
        signal.signal(signal.Signals[name], _end_now)


def _end_now(number: int, frame: object) -> None:
    """End without a word of Python, MPI or PETSc: what they would clear up goes with the process."""
    rank = next((os.environ[name] for name in RANKS if name in os.environ), None)
    try:
        if rank is None and os.isatty(1):
            os.write(1, SHOW_CURSOR)
        if rank in (None, "0"):
            os.write(2, b"interrupted\n")
        for path in tuple(unfinished):
            os.unlink(path)
    except OSError:  # nobody reads, or the file is not there yet
        pass
    # Open MPI's mpiexec ends all ranks when one ends, and at times waits for ever where several abort together
    if RANKS[0] not in os.environ:
        _abort()
    os._exit(INTERRUPTED)


def _abort() -> None:
    mpi = getattr(sys.modules.get("mpi4py"), "MPI", None)
    if mpi is not None and mpi.Is_initialized() and not mpi.Is_finalized() and mpi.COMM_WORLD.size > 1:
        mpi.COMM_WORLD.Abort(INTERRUPTED)

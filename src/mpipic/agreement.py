"""Ranks agree on whether what they did together went well, and end in the same error if it did not."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol, TypeVar, cast

from mpipic.errors import OutputError, WriteFailed
from mpipic.files import reason

T = TypeVar("T")


class Ranks(Protocol):
    """The processes that work together: an mpi4py communicator, or what stands for one."""

    @property
    def rank(self) -> int:
        """Number of this process."""
        ...

    @property
    def size(self) -> int:
        """Number of processes."""
        ...

    def bcast(self, obj: T) -> T:
        """Return what rank 0 gives."""
        ...

    def allgather(self, sendobj: T) -> list[T]:
        """Return what each rank gives."""
        ...


@contextmanager
def together(comm: Ranks, what: str) -> Iterator[None]:
    """Run a block on all ranks, and raise the same error on all of them where it fails on any.

    `WriteFailed` for what the system refuses, `OutputError` for arguments that do not fit; `what` begins the message.
    Collective; one exchange of a word a rank.
    """
    problem: tuple[type[OutputError], str] | None = None
    try:
        yield
    except OSError as error:
        problem = WriteFailed, reason(error)
    except (ValueError, RuntimeError, KeyError) as error:
        problem = OutputError, str(error)
    for rank, found in enumerate(comm.allgather(problem)):
        if found:
            kind, why = found
            raise kind(f"{what}: {why}" + (f" (rank {rank})" if comm.size > 1 else ""))


def on_first(comm: Ranks, action: Callable[[], T]) -> T:
    """Return on all ranks what `action` returns on rank 0, or raise on all that it cannot write there. Collective."""
    result: T | None = None
    problem: tuple[type[OutputError], str] | None = None
    if comm.rank == 0:
        try:
            result = action()
        except OutputError as error:
            problem = type(error), str(error)
        except OSError as error:
            problem = WriteFailed, f"{error.filename or 'output'} cannot be written: {reason(error)}"
    result, problem = comm.bcast((result, problem))
    if problem:
        # made here: an exception that this function's own variable holds would keep all of a run's objects alive
        raise problem[0](problem[1])
    return cast(T, result)

"""All ranks raise together, or none does: what a collective verb asks before anything is sent.

A rank that raises alone leaves the others waiting for its messages. So every collective verb of the library first lets
the ranks agree: each says what it was given, or why it refuses that, and the answer is one reduction of a few numbers.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple, TypeVar

import numpy as np
from mpi4py import MPI

from mpipic.arguments import RealArray, told
from mpipic.arrays import FloatArray

FACTS = 12
"""Room for the numbers that ranks compare: the verb, how many there are, and these."""
NO_SAY = [-np.inf] * 2 * FACTS
KINDS = [np.dtype(code) for code in "?bhilqBHILQefdg"]
"""The types of real numbers; ranks compare their places in this list."""

Found = TypeVar("Found")


class Said(NamedTuple):
    """Tells what one rank brings to a collective verb.

    Attributes
    ----------
    facts : at most FACTS - 2 numbers
        They must be the same on all ranks that bind.
    words
        Says the same in a message, if it comes to one.
    binds
        Whether the rank has a say: one without particles follows the others.
    """

    facts: Sequence[float] = ()
    words: Callable[[], str] = str
    binds: bool = True


def agree(comm: MPI.Comm, verb: str, said: Said | Exception) -> tuple[float, ...]:
    """Return the facts that bind all ranks, or raise on all of them.

    Where no rank binds, the facts are the largest that any gives, so that they are the same everywhere.

    Raises
    ------
    ValueError, TypeError
        A rank has a problem, which all raise, naming the lowest such rank; or the facts of ranks that bind differ, or
        ranks are in different verbs.

    Notes
    -----
    Collective; one reduction of 38 numbers, none on a single rank.
    """
    if comm.size == 1:
        if isinstance(said, Exception):
            raise _named(0, said) from None
        return tuple(said.facts)
    failed = isinstance(said, Exception)
    facts, binds = ((), False) if isinstance(said, Exception) else (tuple(said.facts), said.binds)
    sent = _numbers(verb, facts, binds, failed)
    numbers = sent.copy()
    comm.Allreduce(MPI.IN_PLACE, numbers, op=MPI.MAX)
    if binds and numbers.tobytes() == sent.tobytes():
        return facts
    found = numbers.tolist()
    loose, high, low = found[2 : 2 + FACTS], found[2 + FACTS : 2 + 2 * FACTS], found[2 + 2 * FACTS :]
    bound = high[0] > -np.inf
    if found[0] or found[1] != -loose[0] or (bound and high != [-x for x in low]):
        _raise(comm, verb, said)
    common = high if bound else loose
    return tuple(common[2 : 2 + int(common[1])])


@lru_cache(maxsize=256)
def _numbers(verb: str, facts: tuple[float, ...], binds: bool, failed: bool) -> FloatArray:
    """Return what a rank sends; the largest of all then shows differences, since it holds numbers with either sign."""
    tag = float(zlib.crc32(verb.encode()))
    known = [tag, float(len(facts)), *facts, *[0.0] * (FACTS - 2 - len(facts))]
    return np.array([float(failed), -tag, *known, *([*known, *[-x for x in known]] if binds else NO_SAY)])


def together(
    comm: MPI.Comm, verb: str, check: Callable[[], Found], say: Callable[[Found], Said] = lambda found: Said()
) -> tuple[Found, tuple[float, ...]]:
    """Return what `check` finds on this rank, and the facts that bind all, once no rank's check raises. Collective.

    Errors of `check` are raised on all ranks; so are differences in what ranks `say` of their findings. See `agree`.
    """
    try:
        found = check()
        said = say(found)
    except Exception as error:
        agree(comm, verb, error)
        raise
    return found, agree(comm, verb, said)


def values_together(comm: MPI.Comm, verb: str, check: Callable[[], RealArray], typed: bool = False) -> RealArray:
    """Return the values (n, *shape) that `check` finds, whose shape all ranks agree on. Collective; see `agree`.

    A rank without particles gets an empty array of the shape that the others have, and if `typed`, of their type, which
    must then be the same too.
    """

    def say(values: RealArray) -> Said:
        kind = float(KINDS.index(values.dtype)) if typed else 0.0

        def words() -> str:
            shape = ", ".join(["n", *map(str, values.shape[1:])]) + "," * (values.ndim == 1)
            return f"values of shape ({shape})" + (f" and type {values.dtype}" if typed else "")

        return Said((kind, *values.shape[1:]), words, len(values) > 0)

    values, (kind, *shape) = together(comm, verb, check, say)
    if len(values):
        return values
    return np.empty((0, *map(int, shape)), KINDS[int(kind)] if typed else np.float64)


def communicator(given: object) -> MPI.Intracomm:
    """Return a communicator of mpi4py, or raise TypeError. Local: there is no other to agree over."""
    if not isinstance(given, MPI.Intracomm) or given == MPI.COMM_NULL:
        raise TypeError(f"comm must be a communicator of mpi4py, such as MPI.COMM_WORLD, not {told(given)}")
    return given


def _raise(comm: MPI.Comm, verb: str, said: Said | Exception) -> None:
    """Raise what is wrong, the same on all ranks. Collective."""
    if isinstance(said, Exception):
        mine = ("", str(_plain(said)), isinstance(said, TypeError))
    else:
        mine = (verb, said.words(), said.binds)
    everybody = comm.allgather(mine)
    for rank, (name, text, is_type) in enumerate(everybody):
        if not name:
            raise _named(rank, TypeError(text) if is_type else ValueError(text))
    mixed = len({name for name, _, _ in everybody}) > 1
    calls = [
        (rank, f"{name} with {words}" if words else name)
        for rank, (name, words, binds) in enumerate(everybody)
        if binds or mixed
    ]
    first, other = calls[0], next(call for call in calls if call[1] != calls[0][1])
    raise ValueError(
        f"ranks must call the same together: rank {first[0]} calls {first[1]}, rank {other[0]} calls {other[1]}"
    )


def _named(rank: int, problem: Exception) -> Exception:
    plain = _plain(problem)
    return type(plain)(f"rank {rank}: {plain}")


def _plain(problem: Exception) -> TypeError | ValueError:
    """Return the problem as one of the two kinds that the library raises for arguments."""
    if isinstance(problem, TypeError):
        return TypeError(str(problem))
    return ValueError(str(problem) if isinstance(problem, ValueError) else f"{type(problem).__name__}: {problem}")

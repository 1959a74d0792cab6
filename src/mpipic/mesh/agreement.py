"""All ranks raise together, or none does: what a collective verb asks before anything is sent.

A rank that raises alone leaves the others waiting for its messages. So every collective verb of the library first lets
the ranks agree: each says what it was given, or why it refuses that, and the answer is one reduction of a few numbers.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

FACTS = 12
"""Room for the numbers that ranks compare: the verb, how many there are, and these."""
NO_SAY = [-np.inf] * 2 * FACTS


@dataclass(frozen=True)
class Said:
    """Tells what one rank brings to a collective verb.

    Attributes
    ----------
    facts : at most FACTS - 2 numbers
        They must be the same on all ranks that bind.
    words
        The same for a message.
    binds
        Whether the rank has a say: one without particles follows the others.
    """

    facts: Sequence[float] = ()
    words: str = ""
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
    facts = () if isinstance(said, Exception) else said.facts
    tag = float(zlib.crc32(verb.encode()))
    known = [tag, float(len(facts)), *facts, *[0.0] * (FACTS - 2 - len(facts))]
    binding = [*known, *[-x for x in known]] if not isinstance(said, Exception) and said.binds else NO_SAY
    numbers = np.array([float(failed), -tag, *known, *binding])
    comm.Allreduce(MPI.IN_PLACE, numbers, op=MPI.MAX)
    found = numbers.tolist()
    loose, high, low = found[2 : 2 + FACTS], found[2 + FACTS : 2 + 2 * FACTS], found[2 + 2 * FACTS :]
    bound = high[0] > -np.inf
    if found[0] or found[1] != -loose[0] or (bound and high != [-x for x in low]):
        _raise(comm, verb, said)
    common = high if bound else loose
    return tuple(common[2 : 2 + int(common[1])])


def raise_together(comm: MPI.Comm, problem: Exception | None) -> None:
    """Raise on all ranks the problem of the lowest rank that has one. Collective; one reduction."""
    agree(comm, "the same", problem or Said())


def _raise(comm: MPI.Comm, verb: str, said: Said | Exception) -> None:
    """Raise what is wrong, the same on all ranks. Collective."""
    if isinstance(said, Exception):
        mine = ("", str(said), isinstance(said, TypeError))
    else:
        mine = (verb, said.words, said.binds)
    told = comm.allgather(mine)
    for rank, (name, text, is_type) in enumerate(told):
        if not name:
            raise _named(rank, TypeError(text) if is_type else ValueError(text))
    everyone = len({name for name, _, _ in told}) > 1
    calls = [
        (rank, f"{name} with {words}" if words else name)
        for rank, (name, words, binds) in enumerate(told)
        if binds or everyone
    ]
    first, other = calls[0], next(call for call in calls if call[1] != calls[0][1])
    raise ValueError(
        f"ranks must call the same together: rank {first[0]} calls {first[1]}, rank {other[0]} calls {other[1]}"
    )


def _named(rank: int, problem: Exception) -> Exception:
    return (TypeError if isinstance(problem, TypeError) else ValueError)(f"rank {rank}: {problem}")

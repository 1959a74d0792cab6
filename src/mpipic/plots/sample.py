"""A sample of the particles of all ranks, for pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mpipic.arrays import ParticleArrays
from mpipic.draws import golden_turns

if TYPE_CHECKING:
    from mpi4py import MPI

SAMPLE = 20_000


Sample = dict[str, NDArray[np.generic]]


def gather_sample(particles: ParticleArrays, comm: MPI.Comm, at_most: int = SAMPLE) -> Sample | None:
    """Bring at most `at_most` particles to rank 0, the same ones on any number of ranks.

    All particles when they are no more than that. Otherwise a particle is taken when the fractional part of (golden
    ratio × id) is below at_most / n: even in id, and never in step with the rows of a lattice as every k-th id can be.

    Parameters
    ----------
    particles : has `ids` (n_local,), `position` (n_local, d), `fields`, name -> (n_local,) or (n_local, k)
    comm : mpi4py communicator

    Returns
    -------
    dict on rank 0, None elsewhere
        `ids`, `position` and every field, in the order of the ids.

    Notes
    -----
    Collective. Rank 0 receives about `at_most` particles, in all.
    """
    total = comm.allreduce(len(particles.ids))
    ids = np.asarray(particles.ids)
    columns = {"ids": ids, "position": particles.position, **particles.fields}
    keep = np.arange(len(ids))
    if total > at_most:
        keep = np.flatnonzero(golden_turns(ids) < np.uint64(int(at_most / total * 2**64)))
    parts = comm.gather({name: np.asarray(values)[keep] for name, values in columns.items()})
    if parts is None:
        return None
    sample = {name: np.concatenate([part[name] for part in parts]) for name in columns}
    first = np.argsort(golden_turns(sample["ids"]), kind="stable")[:at_most]
    order = first[np.argsort(sample["ids"][first], kind="stable")]
    return {name: values[order] for name, values in sample.items()}
